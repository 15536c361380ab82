"""Encodings of images in recordings, from the topic to the frame."""

from pathlib import Path

import numpy as np
from written_bags import COLOR, DEPTH, Recorder

from gavo_jax.camera import Camera
from gavo_jax.datasets.files import Reading
from gavo_jax.datasets.registry import open_source

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)


def test_depth_of_doubles_is_found_by_its_encoding(tmp_path: Path) -> None:
    """It was refused with a list of encodings that holds its own."""
    grey = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    metres = np.linspace(1, 3, grey[..., 0].size).reshape(48, 64)
    recorder = Recorder(tmp_path / "doubles", "mcap")
    for stamp in (1.0, 1.1):
        recorder.image(COLOR, stamp, grey, "bgr8")
        recorder.image(DEPTH, stamp, metres, "64FC1")
    recorder.close()
    sequence = open_source(tmp_path / "doubles", Reading(camera=CAMERA))
    np.testing.assert_allclose(sequence[0].depth / sequence.camera.depth_scale, metres, atol=2e-4)
