"""Whether two keyframes show the same place, and where they stand to each other: aligned there and back."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.pairs import Images, align_rows
from gavo_jax.alignment.result import Alignment, on_host
from gavo_jax.camera import Camera
from gavo_jax.mapping.candidates import MOST, Candidate
from gavo_jax.mapping.motions import between, carried, size
from gavo_jax.settings import AlignmentOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

SETTINGS = Settings(
    GaussNewton(iterations=(12, 12, 15, 20, 0), patience=2),
    AlignmentOptions(
        points=(4800, 1200, 1200, 1200, 1200), depth_weight=(0.05, 0.05, 0.3, 0.3, 0.3), views=(1, 1, 1, 1, 1)
    ),
)
"""Gauss-Newton from the guess, both ways. The images have half the size, so that a level here is the next coarser one
of the frame's."""
MIN_OVERLAP = 0.5
"""Of the alignment, either way."""
MAX_DISAGREEMENT = (0.02, 0.02)
"""Metres and radians between the motions found there and back."""
FLOOR = 1e-3
"""Metres and radians that a pair of keyframes is off by beside what its covariance says: each keyframe's velocity,
hence its rolling shutter, is known to a few per cent."""
SHARED = 4.0
"""On the covariance, for what a keyframe's edges have in common: its blur, its depth, its velocity."""


class Edge(NamedTuple):
    """What is known of the motion between two keyframes."""

    earlier: int
    later: int
    earlier_T_later: Float64[np.ndarray, "4 4"]
    covariance: Float64[np.ndarray, "6 6"]
    """Of δ in earlier_T_later · exp(δ), metres and radians."""
    overlap: float = 1.0
    disagreement: tuple[float, float] = (0.0, 0.0)
    """Metres and radians between there and back."""
    alignment: Alignment | None = None
    """There: the earlier keyframe is the reference."""


@dataclass(frozen=True)
class Verifier:
    """Aligns candidates both ways, from the guess.

    Attributes:
        camera: Of the keyframes' images.
        settings: How.
    """

    camera: Camera
    settings: Settings = SETTINGS

    def warm_up(self) -> None:
        """Compile the program, or load it."""
        empty = np.zeros((2 * MOST, self.camera.height, self.camera.width))
        self._align(Images(empty.astype(np.uint8), empty.astype(np.uint16)), np.tile(np.eye(4), (2 * MOST, 1, 1)), 0)

    def verify(self, candidates: list[Candidate]) -> list[Edge | None]:
        """Edges of the candidates that stand; None for the others."""
        edges: list[Edge | None] = []
        for start in range(0, len(candidates), MOST):
            edges += self._verify(candidates[start : start + MOST])
        return edges

    def _verify(self, candidates: list[Candidate]) -> list[Edge | None]:
        earlier = [candidate.earlier.images for candidate in candidates]
        later = [candidate.later.images for candidate in candidates]
        assert all(images is not None for images in earlier + later)
        guesses = np.stack([candidate.later_T_earlier for candidate in candidates])
        guesses = np.concatenate([guesses, inverse(guesses)])
        padding = [(0, 2 * MOST - len(guesses)), (0, 0), (0, 0)]
        images: list[Images] = [
            Images(*(np.pad(np.stack(rows), padding) for rows in zip(*side, strict=True)))  # pyright: ignore
            for side in (earlier + later, later + earlier)
        ]
        guesses_padded = np.pad(guesses, padding)
        result = self._align_sides(images[0], images[1], guesses_padded, len(guesses))
        n = len(candidates)
        return [_edge(candidates[k], result, k, k + n) for k in range(n)]

    def _align(self, images: Images, guesses: np.ndarray, count: int):
        return self._align_sides(images, images, guesses, count)

    def _align_sides(self, references: Images, targets: Images, guesses: np.ndarray, count: int):
        keys = jax.random.split(jax.random.key(0), len(guesses))
        sides = [Images(jnp.asarray(side.grey), jnp.asarray(side.depth)) for side in (references, targets)]
        rows = align_rows(sides, self.camera, self.settings, keys, jnp.asarray(guesses, jnp.float32), count)
        return on_host(rows)


def _edge(candidate: Candidate, result, there: int, back: int) -> Edge | None:
    """The edge of a candidate that was aligned there and back, if both stand and agree."""
    if any(result.status[k] != AlignmentStatus.OK or result.overlap[k] < MIN_OVERLAP for k in (there, back)):
        return None
    later_T_earlier = result.target_T_reference[there]
    by_way_there, by_way_back = inverse(later_T_earlier), result.target_T_reference[back]
    disagreement = tuple(float(part) for part in size(inverse(by_way_there) @ by_way_back))
    if any(part > most for part, most in zip(disagreement, MAX_DISAGREEMENT, strict=True)):
        return None
    covariance = carried(later_T_earlier, result.covariance[there].astype(np.float64))
    covariance = 0.5 * (covariance + result.covariance[back].astype(np.float64))
    return Edge(
        candidate.earlier.number,
        candidate.later.number,
        between(by_way_there, by_way_back, 0.5),
        SHARED * (covariance + FLOOR**2 * np.eye(6)),
        float(min(result.overlap[there], result.overlap[back])),
        disagreement,  # pyright: ignore[reportArgumentType]
        jax.tree.map(lambda leaf: leaf[there], result)._replace(status=AlignmentStatus.OK),
    )
