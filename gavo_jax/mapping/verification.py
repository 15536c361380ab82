"""Whether two keyframes show the same place, and their relative pose, by aligning them there and back.

Before a repetitive wall both ways may agree on a motion that is off by a period; such a pair gives no edge.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from gavo_jax.alignment.pairs import align_rows
from gavo_jax.alignment.repetition import another_period_is_in_reach
from gavo_jax.alignment.result import Alignment, on_host
from gavo_jax.alignment.stacking import Images
from gavo_jax.camera import Camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.image.motion_compensation import CompensatedImages
from gavo_jax.mapping.candidates import MAX_CANDIDATES, LoopCandidate
from gavo_jax.presets import HALF_SIZE_OBJECTIVE
from gavo_jax.rigid_motions import interpolate, length_and_angle, transport_covariance
from gavo_jax.settings import Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse

SETTINGS = Settings(GaussNewton(iterations=(12, 12, 15, 20, 0), patience=2), HALF_SIZE_OBJECTIVE)
"""Gauss-Newton from the guess, both ways."""
MIN_OVERLAP = 0.5
"""Smallest overlap of the alignment, in both directions."""
MAX_DISAGREEMENT = (0.02, 0.02)
"""Largest difference between the motions found there and back, metres and radians."""
FLOOR = 1e-3
"""Standard deviation, metres and radians, of a pair's error beyond what its covariance says. Each keyframe's velocity,
and so its rolling shutter, is known only to a few per cent.
"""
SIDE_BY_SIDE = min(os.cpu_count() or 1, 8)
"""Maximum number of batches of candidates that are aligned in parallel."""
SHARED = 4.0
"""Factor on the covariance for errors that a keyframe's edges share: its blur, its depth, its velocity."""


class Edge(NamedTuple):
    """The motion between two keyframes, and its uncertainty."""

    earlier: int
    later: int
    earlier_T_later: Float64[np.ndarray, "4 4"]
    covariance: Float64[np.ndarray, "6 6"]
    """Covariance of δ in earlier_T_later · exp(δ), metres and radians."""
    overlap: float = 1.0
    disagreement: tuple[float, float] = (0.0, 0.0)
    """Difference between the motions found there and back, metres and radians."""
    alignment: Alignment | None = None
    """Alignment with the earlier keyframe as the reference. A map's edges are kept without it."""


@dataclass(frozen=True)
class Verifier:
    """Aligns candidates both ways, from the guess.

    Attributes:
        camera: Camera of the keyframes' images.
        settings: Settings of the alignment.
    """

    camera: Camera
    settings: Settings = SETTINGS

    def warm_up(self) -> None:
        """Compile the program, or load it."""
        size = (MAX_CANDIDATES, self.camera.height, self.camera.width)
        nothing = Images(np.zeros(size, np.uint8), np.zeros(size, np.uint16))
        self._align(nothing, nothing, np.tile(np.eye(4), (MAX_CANDIDATES, 1, 1)), 0)

    def verify(self, candidates: list[LoopCandidate]) -> list[Edge | None]:
        """Verify candidates: return an edge for each one that stands, None for the others.

        At the end of a run there are candidates of many keyframes, and nothing else is computed: batches of them are
        aligned in parallel.
        """
        lots = [candidates[start : start + MAX_CANDIDATES] for start in range(0, len(candidates), MAX_CANDIDATES)]
        if len(lots) < 2:
            return self._verify(candidates)
        with ThreadPoolExecutor(min(SIDE_BY_SIDE, len(lots))) as workers:
            return [edge for edges in workers.map(in_32_bits(self._verify), lots) for edge in edges]

    def _verify(self, candidates: list[LoopCandidate]) -> list[Edge | None]:
        """Align there, then back only what stands; each from the guess, so that the two are independent."""
        guesses = [candidate.later_T_earlier for candidate in candidates]
        sides = ([candidate.earlier.images for candidate in candidates], [c.later.images for c in candidates])
        there = self._one_way(sides[0], sides[1], guesses)
        standing = [k for k in range(len(candidates)) if _stands(there[k]) and self._is_unique(candidates[k], there[k])]
        earlier, later = ([side[k] for k in standing] for side in sides)
        back = self._one_way(later, earlier, [inverse(guesses[k]) for k in standing])
        edges: list[Edge | None] = [None] * len(candidates)
        for k, result in zip(standing, back, strict=True):
            if _stands(result):
                edges[k] = _edge(candidates[k], there[k], result)
        return edges

    def _is_unique(self, candidate: LoopCandidate, there: Alignment) -> bool:
        """Whether no other motion explains the images as well, as is the case before a repetitive pattern.

        The map's guess cannot tell which motion is right, as its drift is unknown.
        """
        images = candidate.earlier.images
        assert images is not None
        motion = np.asarray(there.target_T_reference)
        return not another_period_is_in_reach(motion, there.error, np.inf, images.grey, images.depth, self.camera)

    def _one_way(
        self,
        references: list[CompensatedImages | None],
        targets: list[CompensatedImages | None],
        guesses: list[np.ndarray],
    ) -> list[Alignment]:
        if not guesses:
            return []
        padding = [(0, MAX_CANDIDATES - len(guesses)), (0, 0), (0, 0)]

        def stacked(side: list[CompensatedImages | None]) -> Images:
            known = [images for images in side if images is not None]
            return Images(
                np.pad(np.stack([images.grey for images in known]), padding),
                np.pad(np.stack([images.depth for images in known]), padding),
            )

        result = self._align(stacked(references), stacked(targets), np.pad(np.stack(guesses), padding), len(guesses))
        return [jax.tree.map(lambda leaf, k=k: leaf[k], result) for k in range(len(guesses))]

    def _align(self, references: Images, targets: Images, guesses: np.ndarray, count: int) -> Alignment:
        keys = jax.random.split(jax.random.key(0), len(guesses))
        sides = [Images(jnp.asarray(side.grey), jnp.asarray(side.depth)) for side in (references, targets)]
        rows = align_rows(sides, self.camera, self.settings, keys, jnp.asarray(guesses, jnp.float32)[:, None], count)
        return on_host(rows)


def _stands(result: Alignment) -> bool:
    return result.status == AlignmentStatus.OK and float(result.overlap) >= MIN_OVERLAP


def _edge(candidate: LoopCandidate, there: Alignment, back: Alignment) -> Edge | None:
    """The edge of a candidate that was aligned there and back; None if the two disagree."""
    by_way_there, by_way_back = inverse(np.asarray(there.target_T_reference)), np.asarray(back.target_T_reference)
    metres, radians = (float(part) for part in length_and_angle(inverse(by_way_there) @ by_way_back))
    if metres > MAX_DISAGREEMENT[0] or radians > MAX_DISAGREEMENT[1]:
        return None
    covariance = transport_covariance(inverse(by_way_there), np.asarray(there.covariance, np.float64))
    covariance = 0.5 * (covariance + np.asarray(back.covariance, np.float64))
    return Edge(
        candidate.earlier.number,
        candidate.later.number,
        interpolate(by_way_there, by_way_back, 0.5),
        SHARED * (covariance + FLOOR**2 * np.eye(6)),
        float(min(there.overlap, back.overlap)),
        (metres, radians),
        there._replace(status=AlignmentStatus.OK),
    )
