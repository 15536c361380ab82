"""The state of a driver between two frames."""

from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float64

from gavo_jax.bodies.records import Numbering
from gavo_jax.datasets.base import Frame
from gavo_jax.frame_checks import History, credible_time
from gavo_jax.odometry.aligners import expecting
from gavo_jax.odometry.beginnings import Beginning
from gavo_jax.odometry.depth_watch import DepthWatch
from gavo_jax.odometry.leaps import Leap
from gavo_jax.odometry.misplaced import Arrival
from gavo_jax.odometry.overlays import Overlays
from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS
from gavo_jax.odometry.tracking import Clock
from gavo_jax.odometry.way import Way


class Progress(NamedTuple):
    """State of a driver between two frames: all that decides what it makes of the next ones."""

    tracker: Any = None
    """The aligner's state; None until a usable frame was seen."""
    last_index: int = -1
    """Index of the last frame in the sequence."""
    reference_timestamp: float = 0.0
    reference_late: float = 0.0
    """Seconds by which that timestamp came too late, as the next ones told."""
    world_T_reference: Float64[np.ndarray, "4 4"] = np.eye(4)
    world_T_camera: Float64[np.ndarray, "4 4"] = np.eye(4)
    """Recorded pose of the last frame."""
    held: int = 0
    """Frames since the reference was renewed."""
    way: Way = Way()
    """Where the camera was found since the reference was renewed."""
    history: History = History()
    segment: int = 0
    """Number of the segment that the reference belongs to."""
    last_segment: int = 0
    """Largest number given to a segment so far."""
    adrift: int = 0
    """Frames since the start of a segment that nothing ties to earlier ones; 0 in one that is tied."""
    doubted: bool = False
    """Whether the last frame's depth disagreed with its image."""
    unknown: int = 0
    """Number of the last motions in the chain of poses that are guesses."""
    leap: Leap | None = None
    """The leap that the last frame may have made; that frame is lost until the next one confirms it."""
    arrival: Arrival | None = None
    """How the reference was reached, where its image may be of another moment."""
    beginning: Beginning | None = None
    """How the track began, as long as it may have followed a body."""
    depth: DepthWatch | None = None
    """What is known of the reference's depth, and how depth has changed; None before the first reference."""
    overlays: Overlays = Overlays()
    """What stays put in every image."""
    numbering: Numbering = Numbering()
    """Numbers of the bodies so far."""

    def since_reference(self, timestamp: float) -> float:
        """Seconds from the reference's moment to a timestamp; 0 or less after a clock was set back."""
        seconds = timestamp - self.reference_timestamp
        return seconds + self.reference_late if seconds > 0 else seconds

    def tracker_at(self, timestamp: float) -> Any:
        """The aligner's state for a frame at a timestamp, with the motion predicted from the way so far."""
        seconds = self.since_reference(timestamp)
        xi = self.way.at(seconds, self.history)
        return self.tracker if xi is None else expecting(self.tracker, xi, seconds)

    def in_new_segment(self) -> Self:
        """Begin a segment that nothing ties to earlier ones, under a number of its own."""
        number = self.last_segment + 1
        return self._replace(segment=number, last_segment=number, adrift=1)

    def clock(self, frame: Frame) -> Clock:
        """When a frame was taken that is already counted as the last one.

        A timestamp that follows the reference's too soon for the recording's rate is wrong, or that one is. Then the
        usual time counts: a velocity of a whole step in a fraction of its time would put shutter and depth far from
        where they belong. If the clock was set back since the reference, the elapsed time is unknown.
        """
        elapsed = self.since_reference(frame.timestamp)
        elapsed = credible_time(elapsed, self.history) if elapsed > 0 else UNKNOWN_SECONDS
        return Clock(np.float32(elapsed), np.float32(frame.depth_delay), np.uint32(self.last_index))
