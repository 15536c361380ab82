"""Vignetting from surfaces that came nearer to the middle of the image, or went away from it.

A lens darkens by (1 + a r²)⁻², where r is the tangent of the angle to the axis; a is 0 without vignetting, and 1 for an
ideal lens, which darkens by the cosine's fourth power. The light of a surface is assumed to be the same in both frames
of a pair up to a gain, so what else changes with r is the lens's.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from gavo_jax.calibration.scan import Minimum
from gavo_jax.camera import Camera, in_image, to_pixels, to_ray

SIDE = 80
"""Largest number of blocks along a side of the image; these are compared by their means."""
DARK, BRIGHT = 20.0, 235.0
"""Grey levels between which a block's mean is proportional to the light."""
SAME_SURFACE = 0.05
"""Largest relative difference of a block's depth from the expected one."""
LEAST_MOTION = 0.003
"""Smallest spread of the change of r² in a pair, two pixels of 640 or so: what moved less, noise moves as much."""
FEWEST_BLOCKS, FEWEST_PAIRS = 200, 6
"""Fewest blocks that a pair needs, and fewest pairs."""
ROUNDS = 6
"""Rounds of re-weighting."""
LEAST = -0.3
"""Smallest a r², of a lens whose corners are bright."""


class Blocks(NamedTuple):
    """A frame divided into blocks."""

    light: Float[np.ndarray, "h w"]
    """Mean grey level."""
    inverse_depth: Float[np.ndarray, "h w"]
    """1/m in the middle; 0 = no reading."""
    camera: Camera
    """Camera whose pixels are the blocks."""

    @classmethod
    def of(cls, grey: Any, inverse_depth: Any, camera: Camera) -> "Blocks":
        """Divide a frame's images, of any one size."""
        side = -(-max(camera.width, camera.height) // SIDE)
        small = camera.binned(side)
        rows, columns = side * small.height, side * small.width
        light = cv2.resize(
            np.asarray(grey, np.float32)[:rows, :columns], (small.width, small.height), interpolation=cv2.INTER_AREA
        )
        middle = np.asarray(inverse_depth)[side // 2 : rows : side, side // 2 : columns : side]
        return cls(light, middle, small)


class Seen(NamedTuple):
    """Surfaces that both frames of a pair see."""

    change: Float[np.ndarray, " n"]
    """Logarithm of the light in the second frame over that in the first."""
    before: Float[np.ndarray, " n"]
    """r² in the first frame."""
    after: Float[np.ndarray, " n"]
    """r² in the second frame."""


def seen_twice(reference: Blocks, target: Blocks, target_T_reference: Float[np.ndarray, "4 4"]) -> Seen | None:
    """Match the blocks of two frames by the motion between them; None if they are too few, or hardly moved."""
    camera, light = reference.camera, reference.light
    known = (reference.inverse_depth > 0) & (light > DARK) & (light < BRIGHT)
    if np.count_nonzero(known) < FEWEST_BLOCKS:
        return None
    v, u = np.nonzero(known)
    x, y = to_ray(camera, u, v)
    depth, light = 1 / reference.inverse_depth[known], light[known]
    points = np.stack([x * depth, y * depth, depth], -1) @ target_T_reference[:3, :3].T + target_T_reference[:3, 3]
    z = np.maximum(points[:, 2], 0.05)
    to_x, to_y = points[:, 0] / z, points[:, 1] / z
    u, v = to_pixels(camera, to_x, to_y)
    inside = in_image(camera, u, v) & (points[:, 2] > 0.1)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    there = cv2.remap(target.light, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR).ravel()
    expected = target.inverse_depth[np.round(v).astype(int), np.round(u).astype(int)] * z
    same = inside & (np.abs(expected - 1) < SAME_SURFACE) & (there > DARK) & (there < BRIGHT)
    if np.count_nonzero(same) < FEWEST_BLOCKS:
        return None
    before, after = (x**2 + y**2)[same], (to_x**2 + to_y**2)[same]
    return Seen(np.log(there[same] / light[same]), before, after) if np.std(after - before) > LEAST_MOTION else None


def fit_vignetting(pairs: list[Seen]) -> Minimum:
    """Fit a to all pairs; the deviation is by their scatter, and infinite if there are too few."""
    amount, deviation = 0.0, np.inf
    if len(pairs) < FEWEST_PAIRS:
        return Minimum(amount, deviation)
    farthest = max(float(np.max([*pair.before, *pair.after])) for pair in pairs)
    for _ in range(ROUNDS):
        steps, information = np.array([_step(pair, amount) for pair in pairs]).T
        spread = 1.48 * np.median(np.abs(steps - np.median(steps))) + 1e-9
        weights = information / (1 + ((steps - np.median(steps)) / (2 * spread)) ** 2)
        step = float(np.sum(weights * steps) / weights.sum())
        deviation = float(np.sqrt(np.sum((weights * (steps - step)) ** 2)) / weights.sum())
        amount = max(amount + step, LEAST / farthest)
    return Minimum(amount, deviation)


def _step(pair: Seen, amount: float) -> tuple[float, float]:
    """Return the change of a that a pair asks for, and its information."""
    before, after = 1 + amount * pair.before, 1 + amount * pair.after
    residual = pair.change + 2 * np.log(after / before)
    effect = -2 * (pair.after / after - pair.before / before)
    weights, step, scale = np.ones_like(residual), 0.0, 1.0
    for _ in range(ROUNDS):
        centred = effect - np.average(effect, weights=weights)
        step = float(np.sum(weights * centred * residual) / (np.sum(weights * centred**2) + 1e-12))
        left = residual - step * effect
        left = left - np.median(left)
        scale = 1.48 * float(np.median(np.abs(left))) + 1e-6
        weights = 1 / (1 + (left / (2 * scale)) ** 2)
    return step, float(np.sum(weights * (effect - np.average(effect, weights=weights)) ** 2)) / scale**2 + 1e-12


def corner_darkness(amount: float, camera: Camera) -> float:
    """Return by which share the image's corner is darker than its middle."""
    x, y = to_ray(camera, 0.0, 0.0)
    return 1 - (1 + amount * (x**2 + y**2)) ** -2


def together(first: tuple[float, ...], second: tuple[float, ...]) -> tuple[float, ...]:
    """Return the coefficients of two vignettings, one undone after the other."""
    product = np.polynomial.polynomial.polymul([1.0, *first], [1.0, *second])
    return tuple(float(value) for value in product[1:])


def lens_vignetting(amount: float) -> tuple[float, ...]:
    """Return a as coefficients of `Camera.vignetting`; none for 0."""
    return (2 * amount, amount**2) if amount else ()
