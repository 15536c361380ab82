"""Overlays: what is drawn into every image of a run (a clock, a name, a frame around it), or attached to the camera.

An overlay stays put as the scene moves, and would hold the camera where it is. A drawing is told by its lack of noise:
no sensor gives a pixel the same level for long. `attached` tells the rest.
"""

import contextlib
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, Self

import cv2
import numpy as np
from jaxtyping import Num, UInt8

from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame, FrameError, Sequence
from gavo_jax.datasets.rectified import rectified_at
from gavo_jax.frame_checks import Finding, History, Use, check_frame
from gavo_jax.odometry.attached import Attached

if TYPE_CHECKING:
    from gavo_jax.odometry.driver import Step

STEP = 2
"""Spacing of the sampled pixels, down and to the right."""
STEEP = 10
"""Range of grey levels within 3 x 3 sampled pixels above which there is something to see."""
CHANGED, MOVED = 2, 0.5
"""Change in grey levels, and the share of pixels with something to see that has to exceed it: then the camera moves."""
FRAMES = 8
"""Consecutive images of a moving camera in which an overlay keeps its exact level."""
MIN_OVERLAY_SHARE = 5e-3
"""Share of the pixels that has to be overlay and steep. Clean clips of the TUM benchmark have 0.002 at most."""
REACH = 5
"""Sampled pixels around an overlay that coding and the search's interpolation mix with it."""
AROUND = 21
"""Sampled pixels across the surroundings whose mean replaces an overlay."""
LITTLE = 0.01
"""Weight of the whole image's mean, as a share of the surroundings, for where everything around is overlay."""


class Overlays(NamedTuple):
    """What is known of overlays, on every `STEP`th pixel."""

    last: Num[np.ndarray, "h w"] | None = None
    """The last image; None before the first."""
    counts: UInt8[np.ndarray, "h w"] = np.zeros((0, 0), np.uint8)
    """Number of images of a moving camera, up to the last one, in which each pixel kept its level."""
    attached: Attached = Attached()
    """What is known of parts of the camera's carrier."""

    @property
    def is_drawn(self) -> bool:
        """Whether enough of the image keeps its level for something to be drawn there."""
        return self.counts.size > 0 and bool(np.mean(self.counts >= FRAMES) >= MIN_OVERLAY_SHARE)

    @property
    def is_any(self) -> bool:
        """Whether there is an overlay of either kind."""
        return self.is_drawn or bool(self.attached.edges.any())

    def after(self, grey: np.ndarray, world_T_camera: np.ndarray) -> Self:
        """Update with one more image, and the camera's pose at the one before."""
        some = np.ascontiguousarray(np.asarray(grey)[::STEP, ::STEP])
        if some.dtype != np.uint8:
            some = np.clip(np.nan_to_num(some.astype(np.float64)), 0.0, 255.0).astype(np.float32)
        attached = self.attached.after(some, world_T_camera)
        if self.last is None or (self.last.shape, self.last.dtype) != (some.shape, some.dtype):
            return self._replace(last=some, counts=np.zeros(some.shape, np.uint8), attached=attached)
        change = cv2.absdiff(some, self.last)
        seen = change[::STEP, ::STEP][_is_steep(some)[::STEP, ::STEP]]
        if not seen.size or np.mean(seen > CHANGED) < MOVED:
            return self._replace(last=some, attached=attached)
        counts = np.where(change == 0, np.minimum(self.counts, FRAMES) + np.uint8(1), np.uint8(0))
        return self._replace(last=some, counts=counts, attached=attached)

    def without(self, frame: Frame) -> Frame:
        """The last frame with overlays replaced by the mean of their surroundings, and without depth there."""
        if self.last is None or not self.is_any:
            return frame
        edges = (self.counts >= FRAMES) & _is_steep(self.last)
        if np.count_nonzero(edges) < MIN_OVERLAY_SHARE * edges.size:
            edges[:] = False
        if self.attached.edges.any():
            attached = cv2.resize(
                self.attached.edges.astype(np.uint8), edges.shape[::-1], interpolation=cv2.INTER_NEAREST
            )
            edges |= attached > 0
        if not edges.any():
            return frame
        drawn = cv2.dilate(edges.astype(np.uint8), np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)) > 0
        grey, depth = np.asarray(frame.grey), np.asarray(frame.depth)
        share = cv2.blur((~drawn).astype(np.float32), (AROUND, AROUND)) + LITTLE
        rest = np.where(drawn, np.float32(0), self.last.astype(np.float32))
        everywhere = LITTLE * float(np.mean(self.last[~drawn])) if not drawn.all() else 0.0
        mean = cv2.blur((cv2.blur(rest, (AROUND, AROUND)) + everywhere) / share, (AROUND, AROUND))
        size = grey.shape[::-1]
        mask = cv2.resize(drawn.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        filled = np.where(mask, cv2.resize(mean, size), grey).astype(grey.dtype)
        return replace(frame, grey=filled, depth=np.where(mask, depth.dtype.type(0), depth))


class Sight(NamedTuple):
    """What is known of a run's images before they are aligned."""

    history: History = History()
    """What the checks remember of them."""
    overlays: Overlays = Overlays()
    """What stays put in them."""

    def after(
        self, frame: Frame | FrameError | None, timestamp: float, camera: Camera, world_T_camera: np.ndarray
    ) -> tuple[Self, Frame | None, Finding]:
        """Look at one more frame; one that the checks refuse says nothing of overlays.

        Args:
            frame: The frame, without distortion, or why there is none.
            timestamp: Its colour timestamp, seconds.
            camera: Camera of the frame.
            world_T_camera: The camera's pose at the frame before.

        Returns:
            What is known now; the frame without overlays, None where there is none; and the finding of the checks.
        """
        overlays, freed = self.overlays, None
        if isinstance(frame, Frame):
            overlays = overlays.after(frame.grey, world_T_camera)
            freed = overlays.without(frame)
            frame = replace(freed, depth=frame.depth)  # no fault of the sensor's
        finding, history = check_frame(frame, timestamp, camera, self.history)
        known = self.overlays if finding.use is Use.NOTHING else overlays
        return self._replace(history=history, overlays=known), freed, finding


class AsTracked:
    """Frames of a run as they were tracked, read again from the first one on.

    Without `is_drawn_on` there are no overlays, and only the frames that are asked for are decoded.
    """

    def __init__(self, sequence: Sequence, steps: Iterable["Step"], is_drawn_on: bool = True) -> None:
        self._sequence, self._is_drawn_on = sequence, is_drawn_on
        self._poses = {step.index: step.world_T_camera for step in steps}
        self._camera, self._sight, self._next, self._pose = sequence.camera.rectified(), Sight(), 0, np.eye(4)

    def __getitem__(self, index: int) -> Frame:
        """A frame after those that were asked for before, without distortion and overlays.

        Raises:
            FrameError: It cannot be read.
        """
        for number in range(self._next, index) if self._is_drawn_on else ():
            with contextlib.suppress(FrameError):
                self._look_at(number)
        self._next = index + 1
        return self._look_at(index) if self._is_drawn_on else rectified_at(self._sequence, index)

    def _look_at(self, index: int) -> Frame:
        """The frame as the driver saw it, which has seen those before."""
        self._pose = self._poses.get(index - 1, self._pose)
        try:
            frame = rectified_at(self._sequence, index)
        except FrameError as error:
            frame = error
        stamp = float(self._sequence.timestamps[index])
        self._sight, freed, _ = self._sight.after(frame, stamp, self._camera, self._pose)
        if isinstance(frame, FrameError):
            raise frame
        return frame if freed is None else freed


def _is_steep(image: np.ndarray) -> np.ndarray:
    around = np.ones((3, 3), np.uint8)
    return cv2.dilate(image, around) - cv2.erode(image, around) > STEEP
