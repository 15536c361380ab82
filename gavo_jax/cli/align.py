"""`gavo align`: one pair of images, the motion between them as JSON."""

import json

import jax

from gavo_jax.alignment.pairs import align as align_pair
from gavo_jax.camera import preset_for_sequence
from gavo_jax.camera_files import Calibration, load_calibration
from gavo_jax.cli.options import Align
from gavo_jax.cli.selection import check_seed, choose_settings
from gavo_jax.compilation_cache import enable_compilation_cache
from gavo_jax.datasets.files import open_pair
from gavo_jax.interrupts import interruptible
from gavo_jax.output.files import describe
from gavo_jax.output.screen import waiting


def align(options: Align) -> int:
    """Print `target_T_reference`, `xi`, `error`, `overlap`, `covariance` and `status` of one pair."""
    check_seed(options.seed)
    calibration = _calibration(options)
    settings = choose_settings(options).settings
    pair = open_pair([(options.rgb0, options.depth0), (options.rgb1, options.depth1)], calibration)
    (reference, target), camera = pair, pair.camera
    enable_compilation_cache()
    with waiting("compiling and aligning …"):
        key = jax.random.key(options.seed)
        found = interruptible(lambda: align_pair(reference, target, camera, settings, key=key))
    answer = {
        "target_T_reference": found.target_T_reference,
        "xi": found.xi,
        "error": found.error,
        "overlap": found.overlap,
        "covariance": found.covariance,
        "status": found.status.name.lower(),
        "status_sentence": found.sentence,
    }
    print(json.dumps(describe(answer), indent=2, allow_nan=False))
    return 0


def _calibration(options: Align) -> Calibration:
    if options.camera == "auto":
        return load_calibration(preset_for_sequence(options.rgb0.absolute().parent.parent.name))
    return load_calibration(options.camera)
