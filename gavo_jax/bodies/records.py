"""Records of moving bodies: where each one is, how it moved, and how well that is known."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64

from gavo_jax.alignment.result import Alignment
from gavo_jax.datasets.base import Frame
from gavo_jax.trajectory import inverse


class Seen(NamedTuple):
    """A body in one frame, as the camera sees it."""

    number: int
    """Number of the body, from 1; the same in all frames since the aligner was started."""
    field: Float[np.ndarray, "h w"]
    """Segmentation on the level that bodies are seen on; positive where the body is."""
    share: float
    """Share of the image that it covers."""
    centroid: Float64[np.ndarray, " 3"]
    """Centroid of the body's visible points, metres, in the camera."""
    alignment: Alignment | None = None
    """The body's motion in the camera, from the reference frame to this one. None where it was not asked for, or where
    the body was not seen before.
    """


@dataclass(frozen=True, eq=False)
class Body:
    """A body in one frame, in the world of the run."""

    number: int
    """Number of the body, from 1; the same in all frames up to a break of the track, and no other body's."""
    share: float
    """Share of the image that it covers."""
    centroid: Float64[np.ndarray, " 3"]
    """Centroid of the body's visible points, metres, in the world."""
    displacement: Float64[np.ndarray, " 3"]
    """Displacement of the centroid since the reference frame, metres, in the world; NaN where it is unknown."""
    rotation: Float64[np.ndarray, " 3"]
    """Rotation vector since the reference frame, radians, in the world; NaN where it is unknown."""
    alignment: Alignment | None
    """The body's motion in the camera from the reference frame to this one, with covariance and status. None where it
    was not asked for, or where the body was not seen before.
    """
    field: Float[np.ndarray, "h w"]
    """Segmentation on a coarse level of the image; positive where the body is. See `mask`."""
    size: tuple[int, int]
    """Height and width of the image."""

    @property  # not kept: a run's masks would fill the memory
    def mask(self) -> Bool[np.ndarray, "height width"]:
        """Pixels of the undistorted image that the body covers."""
        return self.mask_at(self.size)

    def mask_at(self, size: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
        """The body's mask for an image of another height and width."""
        height, width = size
        return cv2.resize(self.field, (width, height), interpolation=cv2.INTER_LINEAR) > 0

    def moved(self, new_T_old: Float64[np.ndarray, "4 4"]) -> Self:
        """The same body in another world frame."""
        rotation = new_T_old[:3, :3]
        return replace(
            self,
            centroid=rotation @ self.centroid + new_T_old[:3, 3],
            displacement=rotation @ self.displacement,
            rotation=rotation @ self.rotation,
        )

    @property
    def status(self) -> str:
        """The status of its motion in a word; `seen` where there is none."""
        return "seen" if self.alignment is None else str(self.alignment.status)


class Numbering(NamedTuple):
    """Numbers of a run's bodies: they go on where an aligner that is started again begins at 1."""

    last: int = 0
    """Largest number given so far."""
    before: int = 0
    """Largest number given before the aligner was last started."""

    def given_to(self, seen: Seen) -> Seen:
        """A body under the run's number."""
        return seen._replace(number=self.before + seen.number)

    def after(self, bodies: Iterable[Body], is_restarted: bool) -> Self:
        """The numbering after a frame with some bodies, at which the aligner may have been started again."""
        last = max([self.last, *(body.number for body in bodies)])
        return self._replace(last=last, before=last if is_restarted else self.before)


BORDER = 1 / 80
"""Width of the border left out around a body, over the image's width: a pixel of the level that bodies are seen on."""


def covered(bodies: Iterable[Body]) -> Bool[np.ndarray, "height width"] | None:
    """Pixels that any of a frame's bodies covers; None where there are none."""
    masks = [body.mask for body in bodies]
    return np.any(masks, axis=0) if masks else None


def without_moving(frame: Frame, moving: Bool[np.ndarray, "height width"] | None, border: float = BORDER) -> Frame:
    """A frame without depth where something moves on its own, and around it.

    Args:
        frame: The frame.
        moving: Pixels that move; None where nothing does.
        border: Width of the border left out around these, over the image's width.
    """
    if moving is None:
        return frame
    side = 2 * round(border * moving.shape[1]) + 1
    around = cv2.dilate(moving.astype(np.uint8), np.ones((side, side), np.uint8))
    return replace(frame, depth=np.where(around > 0, 0, frame.depth))


def in_world(
    seen: Seen,
    world_T_camera: Float64[np.ndarray, "4 4"],
    world_T_reference: Float64[np.ndarray, "4 4"] | None,
    size: tuple[int, int],
) -> Body:
    """A body placed in the world by the camera's poses.

    Args:
        seen: The body in the camera.
        world_T_camera: Pose of the camera at the frame.
        world_T_reference: Pose at the frame that the body's motion starts from; None where the camera's own motion
            since is unknown.
        size: Height and width of the image.
    """
    centroid = world_T_camera[:3, :3] @ seen.centroid + world_T_camera[:3, 3]
    displacement = rotation = np.full(3, np.nan)
    if seen.alignment is not None and world_T_reference is not None:
        motion = world_T_camera @ np.asarray(seen.alignment.target_T_reference) @ inverse(world_T_reference)
        before = inverse(motion)
        displacement = centroid - (before[:3, :3] @ centroid + before[:3, 3])
        rotation = cv2.Rodrigues(motion[:3, :3])[0].reshape(3)
    return Body(seen.number, seen.share, centroid, displacement, rotation, seen.alignment, seen.field, size)
