"""`gavo align`: aligns one pair of RGB-D images and prints the motion as JSON."""

import itertools
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gavo_jax.alignment.pairs import align as align_pair
from gavo_jax.alignment.result import Alignment
from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.cli.options import Align
from gavo_jax.cli.readiness import be_ready
from gavo_jax.cli.selection import check_positive, choose_settings
from gavo_jax.datasets.depth_doubts import fault_of_depth
from gavo_jax.datasets.depth_unit import lack_of_depth
from gavo_jax.datasets.files import Entry, FileSequence, Reading, open_pair, size_of_most
from gavo_jax.datasets.images import read_depth
from gavo_jax.datasets.own_camera import nearest_camera_file, preset_by_name
from gavo_jax.datasets.registry import open_source, recognise, source_around
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import rotation_angle
from gavo_jax.interrupts import interruptible
from gavo_jax.number_types import Depth
from gavo_jax.output.files import json_text
from gavo_jax.output.screen import say, waiting
from gavo_jax.settings_check import as_seed
from gavo_jax.settings_file import assignments
from gavo_jax.trajectory import inverse

MATRIX_DIGITS, TWIST_DIGITS = 7, 4
"""Significant digits shown on a terminal, for rows of four numbers and for everything else; a pipe gets all."""


def align(options: Align) -> int:
    """Print `target_T_reference`, `xi`, `error`, `overlap`, `covariance`, `status` and more for one pair."""
    as_seed(options.seed, "--seed")
    check_positive("--depth-scale", options.depth_scale, 1e6)
    if idle := [name for name in assignments(options.set) if name.startswith("odometry.")]:
        raise GavoError(f"--set: {idle[0]} applies to runs only, not to a pair")
    settings = choose_settings(options).settings
    images = [(options.rgb0, options.depth0), (options.rgb1, options.depth1)]
    for path in itertools.chain.from_iterable(images):
        if not path.is_file():
            raise GavoError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    calibration, depth_scale, depth_in = _source(options)
    pair = open_pair(images, calibration, Reading(depth_scale=depth_scale), depth_in)
    (reference, target), camera = pair, pair.camera
    if not options.force:
        faults = [
            (options.depth0, lack_of_depth(pair)),
            *((images[k][1], fault_of_depth(pair[k : k + 1])) for k in (0, 1)),
        ]
        for depth, fault in faults:
            if fault:
                raise GavoError(f"{depth}: {fault}, or continue with --force")
    be_ready()
    with waiting("compiling and aligning …"):
        key = jax.random.key(options.seed)
        found = interruptible(lambda: align_pair(reference, target, camera, settings, key=key))
    answer = {
        "target_T_reference": found.target_T_reference,
        "xi": found.xi,
        "error": found.error,
        "overlap": found.overlap,
        "covariance": found.covariance,
        "status": str(found.status),
        "status_sentence": found.sentence,
        "camera_from": calibration.origin,
        "depth_units_per_metre": pair.depth_unit.file,
    }
    on_a_screen = sys.stdout.isatty()
    print(json_text({name: rounded(value) for name, value in answer.items()} if on_a_screen else answer))
    if on_a_screen:
        say(in_words(found))
    return 0


def rounded(value: Any) -> Any:
    """Round arrays and scalars so that rows fit 80 columns; return anything else unchanged."""
    if not isinstance(value, jax.Array | np.ndarray | np.generic):
        return value
    numbers = np.asarray(value)
    if numbers.ndim == 0:
        return float(f"{float(numbers):.{TWIST_DIGITS}g}")
    digits = MATRIX_DIGITS if numbers.shape[-1] == 4 else TWIST_DIGITS
    return np.array([float(f"{number:.{digits}g}") for number in numbers.ravel()]).reshape(numbers.shape)


def in_words(found: Alignment) -> str:
    """Describe in sentences how the camera moved and how well this is known."""
    reference_T_target = inverse(np.asarray(found.target_T_reference, np.float64))
    right, down, forward = 1e3 * reference_T_target[:3, 3]
    ways = (
        f"{abs(right):.1f} mm {'right' if right >= 0 else 'left'}",
        f"{abs(down):.1f} mm {'down' if down >= 0 else 'up'}",
        f"{abs(forward):.1f} mm {'forward' if forward >= 0 else 'back'}",
    )
    length = float(np.linalg.norm(reference_T_target[:3, 3])) * 1e3
    angle = float(np.degrees(rotation_angle(reference_T_target[None, :3, :3])[0]))
    return (
        f"The camera moved by {length:.1f} mm ({', '.join(ways)}) and turned by {angle:.2f} degrees. {found.sentence} "
        f"{float(found.overlap):.0%} of the points are in view."
    )


def _source(options: Align) -> tuple[Calibration, float | None, Callable[[Path], Depth]]:
    """Return the calibration, the depth units per metre if known, and what reads a depth file, all from the images'
    source if they belong to one.

    Raises:
        GavoError: no camera is found or readable, or the source is unreadable and nothing else states the unit.
    """
    source, fault, depth_in = source_around(options.rgb0), None, read_depth
    if source is not None:
        if isinstance(kind := recognise(source), type) and issubclass(kind, FileSequence):
            depth_in = kind.depth_in
        try:
            sequence = open_source(source, Reading(options.camera, options.depth_scale))
            if isinstance(sequence, FileSequence):
                calibration = sequence.calibration.with_depth_scale(sequence.depth_unit.file)
                return calibration, options.depth_scale, sequence.depth_in
        except GavoError as error:  # faults of the source's other frames don't affect this pair
            fault = error
    size = partial(size_of_most, [Entry(0.0, options.rgb0, options.depth0)])
    if options.camera == "auto":
        folder = Path(os.path.abspath(options.rgb0)).parent
        file = nearest_camera_file(folder)
        found = preset_by_name(folder.parent) if file is None else load_calibration(file, size)
    else:
        found = load_calibration(options.camera, size)
    if fault is not None and not found.states_depth_scale and options.depth_scale is None:
        raise GavoError(f"{fault}; to ignore the other frames, pass --depth-scale")
    return found, options.depth_scale, depth_in
