"""A duel between two motions since one frame, the anchor: either may be the camera's.

The first motion is that of the search on the whole image. The other one, its rival, is that of the image's far part
alone. The rival wins if the anchor's pixels vote for it, or if it is well determined and contradicts the first motion.
It loses if the two agree, and is given up if nothing is decided for too long.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from gavo_jax.alignment.result import Alignment
from gavo_jax.bodies.votes import Margin
from gavo_jax.rigid_motions import length_and_angle, log, transport_covariance
from gavo_jax.trajectory import inverse

TOGETHER = (0.008, np.radians(0.5))
"""Metres and radians within which the two motions count as the same."""
APART = (0.025, np.radians(1.0))
"""Metres and radians between the two motions above which the choice matters."""
AGREED_AFTER, DROPPED_AFTER = 0.15, 0.42
"""Seconds after which a rival is dropped: if both motions agree, and if nothing is decided. A body takes time to move
away, whatever the frame rate.
"""
DROPPED_EARLY, LEAST_DOUBT = 0.15, 20.0
"""Seconds after which the rival is dropped if the squared Mahalanobis distance of the two motions is below
`LEAST_DOUBT`.
"""
LARGEST = 100.0
"""Squared Mahalanobis distance of the two motions at which there is no doubt that they differ."""
CONTRADICTED = 30.0
"""Squared Mahalanobis distance above which the far part contradicts the first motion."""
CLEAR, DOUBTFUL = 0.75, 0.5
"""Certainty above which the rival is taken, and above which the first motion may be a body's."""
MAJORITY, FAR_MAJORITY, FRAMES = 0.2, 0.6, 2
"""Margins in the whole image and in its far part that decide for the rival, and frames for which they have to hold."""
LANDSLIDE = 0.6
"""Margin in the whole image that decides for the rival at once."""
EXACT, EXACTER, VAGUE = 0.012, 0.008, 0.02
"""Limits of the standard deviation of the rival's translation, metres: for votes to decide, for a contradiction to
decide, and for the rival to tell anything.
"""


class Span(NamedTuple):
    """How long a condition has held."""

    frames: Any
    """Number of frames; -1 where the condition does not hold."""
    seconds: Any

    @property
    def lasts(self) -> bool:
        """Whether the condition holds."""
        return int(self.frames) >= 0

    def later(self, elapsed: float) -> "Span":
        """The span one frame later."""
        return Span(np.int32(int(self.frames) + 1), np.float32(float(self.seconds) + elapsed))


BEGUN, OVER = (Span(np.int32(frames), np.float32(0.0)) for frames in (0, -1))


class Motions(NamedTuple):
    """Motions since the anchor, by the first search and by the rival's."""

    first_T_anchor: Float[np.ndarray, "4 4"]
    rival_T_anchor: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of the rival's motion, for a step on the target's side: the errors of its frames add up."""

    @classmethod
    def none(cls) -> "Motions":
        """The motions at the anchor itself."""
        still = np.eye(4, dtype=np.float32)
        return cls(still, still, np.zeros((6, 6), np.float32))

    def exact(self) -> "Motions":
        """The motions in double precision."""
        return Motions(*(np.asarray(leaf, np.float64) for leaf in self))

    def after(self, first: Alignment, rival: Alignment) -> "Motions":
        """Both motions, extended by one frame."""
        before = self.exact()
        onward = np.asarray(rival.target_T_reference, np.float64)
        return Motions(
            np.asarray(first.target_T_reference) @ before.first_T_anchor,
            onward @ before.rival_T_anchor,
            transport_covariance(onward, before.covariance) + _in_target(rival),
        )

    def stored(self) -> "Motions":
        """The motions in single precision, as a state stores them."""
        return Motions(*(np.asarray(leaf, np.float32) for leaf in self))

    def exceed(self, limits: tuple[float, float]) -> bool:
        """Whether the two motions are more than some metres, or radians, apart."""
        first, rival, _ = self.exact()
        length, angle = length_and_angle(inverse(first) @ rival)
        return float(length) > limits[0] or float(angle) > limits[1]

    def contradiction(self, beside: Float64[np.ndarray, "6 6"] | float = 0.0) -> float:
        """Squared Mahalanobis distance of the two motions, by the rival's covariance plus `beside`."""
        first, rival, covariance = self.exact()
        step = log(first @ inverse(rival))
        return float(step @ np.linalg.solve(beside + covariance, step))

    def have_parted(self, *, clearly: bool = False) -> bool:
        """Whether the two motions differ; with `clearly`, by more than the rival's errors, too."""
        return self.exceed(TOGETHER) and not (clearly and self.contradiction() <= LEAST_DOUBT)


@dataclass(frozen=True)
class Duel:
    """How the two motions compare at a frame.

    Attributes:
        motions: Motions up to that frame.
        contradiction: Squared Mahalanobis distance of the two, including the covariance of the first one's last frame.
        deviation: Standard deviation of the rival's translation in its last frame, metres.
        age: Time since the anchor.
        stands_before: Whether the surfaces that the rival leaves out are in front of the rest of the image.
        margin: Margin of the rival in the votes of the anchor's pixels; None without a vote.
        ahead: Consecutive frames, up to this one, with margins large enough.
    """

    motions: Motions
    contradiction: float
    deviation: float
    age: Span
    stands_before: bool
    margin: Margin | None = None
    ahead: int = 0

    @classmethod
    def of(cls, motions: Motions, first: Alignment, deviation: float, age: Span, *, stands_before: bool) -> "Duel":
        """A duel without votes, from the first search's last result."""
        return cls(motions, motions.contradiction(_in_target(first)), deviation, age, stands_before)

    @property
    def is_vague(self) -> bool:
        """Whether the rival is too uncertain to tell anything."""
        return not self.deviation < VAGUE

    @property
    def asks_for_votes(self) -> bool:
        """Whether a vote is needed: the rival is not vague, and the choice matters."""
        return not self.is_vague and self.motions.exceed(APART)

    @property
    def far(self) -> float:
        """Margin of the rival in the far part of the image."""
        return 0.0 if self.margin is None else float(self.margin.far)

    @property
    def is_won(self) -> bool:
        """Whether the rival's motion is the camera's: by votes, or because it contradicts the first one."""
        by_votes = self.far > 0.0 and (self.ahead >= FRAMES or self._is_landslide)
        contradicts = self._contradicts and self.deviation < EXACTER and self.certainty > CLEAR
        return contradicts or (by_votes and self.deviation < EXACT)

    @property
    def casts_doubt(self) -> bool:
        """Whether the first motion may be a body's."""
        return int(self.age.frames) >= FRAMES and self._contradicts and self.certainty > DOUBTFUL

    @property
    def is_rival_unsupported(self) -> bool:
        """Whether nothing speaks for the rival, after some time."""
        age = float(self.age.seconds)
        are_one = age >= AGREED_AFTER and not self.motions.have_parted()
        return not self.is_vague and (are_one or (age >= DROPPED_EARLY and self.contradiction < LEAST_DOUBT))

    @property
    def is_given_up(self) -> bool:
        """Whether the duel is to end undecided."""
        return self.is_vague or float(self.age.seconds) > DROPPED_AFTER

    @property
    def certainty(self) -> float:
        """The contradiction over `LARGEST`, at most 1, plus the far part's margin."""
        return min(self.contradiction / LARGEST, 1.0) + self.far

    @property
    def _is_landslide(self) -> bool:
        return self.margin is not None and float(self.margin.whole) > LANDSLIDE

    @property
    def _contradicts(self) -> bool:
        """Whether the far part contradicts the first motion.

        Without a vote it is enough that the surfaces which the rival leaves out are in front of the rest.
        """
        says_so = self.stands_before if self.margin is None else self.far > 0.0
        return not self.is_vague and self.contradiction > CONTRADICTED and says_so and self.motions.have_parted()


def leads(margin: Margin) -> bool:
    """Whether margins decide for the rival, provided that they hold for some frames."""
    return float(margin.whole) > MAJORITY and float(margin.far) > FAR_MAJORITY


def _in_target(result: Alignment) -> Float64[np.ndarray, "6 6"]:
    """Covariance of a motion for a step on the target's side; results have it for a step on the reference's."""
    return transport_covariance(
        np.asarray(result.target_T_reference, np.float64), np.asarray(result.covariance, np.float64)
    )
