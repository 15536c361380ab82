"""Two motions since one frame, the anchor, of which either may be the camera's: what is known of both, and who wins.

The first is that of the whole image's search, the other one, its rival, that of the image's far part alone. The rival
wins if the anchor's pixels vote for it, or if it is well determined and contradicts the first one. It loses if the two
are the same, and nothing is decided if that takes too long.
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
"""Metres and radians within which the two motions are the same."""
APART = (0.025, np.radians(1.0))
"""Metres and radians between the two motions from which on it matters which one is taken."""
AGREED_AFTER, DROPPED_AFTER = 0.15, 0.42
"""Seconds after which a rival is dropped if it is the same motion; if nothing is decided. A body takes time to move
away, however many frames are taken meanwhile."""
DROPPED_EARLY, LEAST_DOUBT = 0.15, 20.0
"""Seconds after which it is dropped where the squared Mahalanobis distance of the two motions is less than that."""
LARGEST = 100.0
"""Squared Mahalanobis distance of the two motions since the anchor that leaves no doubt that they differ."""
CONTRADICTED = 30.0
"""The same distance from which on the far part contradicts the first motion."""
CLEAR, DOUBTFUL = 0.75, 0.5
"""Certainty above which the rival is taken, and above which the first search's motion may be a body's."""
MAJORITY, FAR_MAJORITY, FRAMES = 0.2, 0.6, 2
"""Margins in the whole image and in its far part that decide for the rival, and frames for which they have to hold."""
LANDSLIDE = 0.6
"""Margin in the whole image that decides for the rival at once."""
EXACT, EXACTER, VAGUE = 0.012, 0.008, 0.02
"""Metres: deviation of the rival's translation up to which votes can have it taken, up to which the contradiction can,
and from which on it tells nothing."""


class Span(NamedTuple):
    """How long something has been so."""

    frames: Any
    """Number of frames; -1 where it is not so."""
    seconds: Any

    @property
    def lasts(self) -> bool:
        """Whether it is so."""
        return int(self.frames) >= 0

    def later(self, elapsed: float) -> "Span":
        """The same a frame later."""
        return Span(np.int32(int(self.frames) + 1), np.float32(float(self.seconds) + elapsed))


BEGUN, OVER = (Span(np.int32(frames), np.float32(0.0)) for frames in (0, -1))


class Motions(NamedTuple):
    """Motions since the anchor, by the first search and by the rival's."""

    first_T_anchor: Float[np.ndarray, "4 4"]
    rival_T_anchor: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    """Of the rival's, by a step on the target's side: errors of its frames add up."""

    @classmethod
    def none(cls) -> "Motions":
        """Those at the anchor itself."""
        still = np.eye(4, dtype=np.float32)
        return cls(still, still, np.zeros((6, 6), np.float32))

    def exact(self) -> "Motions":
        """The same, in double precision."""
        return Motions(*(np.asarray(leaf, np.float64) for leaf in self))

    def after(self, first: Alignment, rival: Alignment) -> "Motions":
        """Both with one more frame's."""
        before = self.exact()
        onward = np.asarray(rival.target_T_reference, np.float64)
        return Motions(
            np.asarray(first.target_T_reference) @ before.first_T_anchor,
            onward @ before.rival_T_anchor,
            transport_covariance(onward, before.covariance) + _in_target(rival),
        )

    def stored(self) -> "Motions":
        """The same, as a state has them."""
        return Motions(*(np.asarray(leaf, np.float32) for leaf in self))

    def exceed(self, limits: tuple[float, float]) -> bool:
        """Whether there are more than so many metres, or radians, between the two."""
        first, rival, _ = self.exact()
        length, angle = length_and_angle(inverse(first) @ rival)
        return float(length) > limits[0] or float(angle) > limits[1]

    def contradiction(self, beside: Float64[np.ndarray, "6 6"] | float = 0.0) -> float:
        """Squared Mahalanobis distance of the two, by the rival's covariance and another one `beside` it."""
        first, rival, covariance = self.exact()
        step = log(first @ inverse(rival))
        return float(step @ np.linalg.solve(beside + covariance, step))

    def have_parted(self, *, clearly: bool = False) -> bool:
        """Whether they differ; `clearly`: by more than the rival's errors, too."""
        return self.exceed(TOGETHER) and not (clearly and self.contradiction() <= LEAST_DOUBT)


@dataclass(frozen=True)
class Duel:
    """How the two motions stand at a frame.

    Attributes:
        motions: Up to that frame.
        contradiction: Squared Mahalanobis distance of the two, with the covariance of the first one's last frame.
        deviation: That of the rival's translation in its last frame, metres.
        age: Time since the anchor.
        stands_before: Whether what the rival leaves out stands before the rest of the image.
        margin: Of the rival in the votes of the anchor's pixels; None where they were not asked.
        ahead: Frames, up to this one, for which the margins have been large.
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
        """A duel in which nobody has voted, by the first one's last result."""
        return cls(motions, motions.contradiction(_in_target(first)), deviation, age, stands_before)

    @property
    def is_vague(self) -> bool:
        """Whether the rival tells nothing."""
        return not self.deviation < VAGUE

    @property
    def asks_for_votes(self) -> bool:
        """Whether it matters which motion is taken."""
        return not self.is_vague and self.motions.exceed(APART)

    @property
    def far(self) -> float:
        """Margin of the rival in the far part of the image."""
        return 0.0 if self.margin is None else float(self.margin.far)

    @property
    def is_won(self) -> bool:
        """Whether the rival's is the camera's motion: by votes, or as it contradicts the first one."""
        by_votes = self.far > 0.0 and (self.ahead >= FRAMES or self._is_landslide)
        contradicts = self._contradicts and self.deviation < EXACTER and self.certainty > CLEAR
        return contradicts or (by_votes and self.deviation < EXACT)

    @property
    def casts_doubt(self) -> bool:
        """Whether the first one's may be a body's motion."""
        return int(self.age.frames) >= FRAMES and self._contradicts and self.certainty > DOUBTFUL

    @property
    def is_lost(self) -> bool:
        """Whether nothing speaks for the rival, after some time."""
        age = float(self.age.seconds)
        are_one = age >= AGREED_AFTER and not self.motions.have_parted()
        return not self.is_vague and (are_one or (age >= DROPPED_EARLY and self.contradiction < LEAST_DOUBT))

    @property
    def is_given_up(self) -> bool:
        """Whether nothing can be decided."""
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
        """Whether the far part speaks against the first one. Where nobody was asked it is enough that what the rival
        leaves out stands before the rest.
        """
        says_so = self.stands_before if self.margin is None else self.far > 0.0
        return not self.is_vague and self.contradiction > CONTRADICTED and says_so and self.motions.have_parted()


def leads(margin: Margin) -> bool:
    """Whether margins decide for the rival, if they hold for some frames."""
    return float(margin.whole) > MAJORITY and float(margin.far) > FAR_MAJORITY


def _in_target(result: Alignment) -> Float64[np.ndarray, "6 6"]:
    """Covariance of a motion by a step on the target's side: results have it by one on the reference's."""
    return transport_covariance(
        np.asarray(result.target_T_reference, np.float64), np.asarray(result.covariance, np.float64)
    )
