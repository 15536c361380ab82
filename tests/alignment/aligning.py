"""A room with its true motions, and how far an alignment is off."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from gavo_jax import presets
from gavo_jax.alignment.pairs import align
from gavo_jax.alignment.result import Alignment
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence

FRAMES = (0, 1, 8, 9, 14, 15, 22, 23)
Images = tuple[np.ndarray, np.ndarray]
"""Grey and depth."""


def target_T_reference(sequence: SyntheticSequence, reference: int, target: int) -> np.ndarray:
    world_T_camera = sequence.ground_truth.world_T_camera
    return np.linalg.inv(world_T_camera[target]) @ world_T_camera[reference]


def difference(estimate: Any, truth: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two motions."""
    delta = np.linalg.inv(truth) @ np.asarray(estimate, np.float64)
    sine = np.linalg.norm(delta[:3, :3] - delta[:3, :3].T) / np.sqrt(8)
    return float(np.linalg.norm(delta[:3, 3])), float(np.degrees(np.arctan2(sine, (np.trace(delta[:3, :3]) - 1) / 2)))


def run(method: str, reference: Frame | Images, target: Frame | Images, camera: Camera, seed: int = 0) -> Alignment:
    """Align by a method's default preset."""
    return align(reference, target, camera, presets.preset(method), key=jax.random.key(seed))


def wide_search(reference: Frame | Images, target: Frame | Images, camera: Camera, **changes: Any) -> Alignment:
    wide = presets.preset("ga", "wide")
    return align(reference, target, camera, replace(wide, alignment=replace(wide.alignment, **changes)))
