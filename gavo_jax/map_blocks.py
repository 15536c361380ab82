"""Depth images in which Open3D finds all the voxel blocks that a frame touches.

It samples one pixel of many, which leaves holes in the map where a sampled pixel has no reading, or where several
blocks lie between two samples.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float

from gavo_jax.camera import Camera

BLOCK = 8
"""Voxels along the side of a block."""
MOST_BLOCKS = 100_000
"""Largest number of blocks of a map, some 1 GB; with voxels of 1 cm about 300 m² of surface."""
SAMPLING_STRIDE = 4
"""Stride, along either axis, of the pixels that Open3D samples to find a frame's blocks."""
MOST_ENLARGED = 16
"""Largest factor by which an image is enlarged so that no block lies between samples."""


def image_for_blocks(
    metres: Float[np.ndarray, "h w"], camera: Camera, voxel: float
) -> tuple[Float[np.ndarray, "h2 w2"], Float[np.ndarray, "3 3"]]:
    """Return depth and camera matrix of an image in which Open3D finds all blocks of a frame.

    Args:
        metres: The frame's depth, 0 = no reading.
        camera: The frame's camera, without distortion.
        voxel: Side of a voxel, metres.
    """
    filled = with_samples_filled(metres)
    apart = SAMPLING_STRIDE * float(metres.max()) / min(float(camera.fx), float(camera.fy))
    times = min(MOST_ENLARGED, max(1, int(np.ceil(apart / (BLOCK * voxel)))))
    if times == 1:
        return filled, camera.matrix
    fx, fy, cx, cy = camera.scaled(times)
    enlarged = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, width=times * camera.width, height=times * camera.height)
    return np.repeat(np.repeat(filled, times, axis=0), times, axis=1), enlarged.matrix


def with_samples_filled(metres: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Fill the pixels that Open3D samples, each fourth of each fourth row, from a reading near them.

    A sensor may leave out exactly those rows.
    """
    filled, samples = metres.copy(), np.s_[::SAMPLING_STRIDE, ::SAMPLING_STRIDE]
    near = cv2.dilate(metres, np.ones((2 * SAMPLING_STRIDE - 1,) * 2))[samples]
    filled[samples] = np.where(metres[samples] > 0, metres[samples], near)
    return filled
