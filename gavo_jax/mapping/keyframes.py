"""Keyframes: the frames that a map is made of, few enough to bound memory, close enough to overlap."""

from dataclasses import dataclass, field
from typing import NamedTuple, Self

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from gavo_jax.alignment.corners import NEAREST
from gavo_jax.camera import Camera, in_image, to_pixels, to_ray
from gavo_jax.datasets.base import Frame
from gavo_jax.features import Features
from gavo_jax.image.motion_compensation import CompensatedImages, compensate_motion
from gavo_jax.rigid_motions import length_and_angle
from gavo_jax.trajectory import inverse

MAX_IMAGES = 300
"""Maximum number of keyframes that keep their images, and what was made of these: some 0.45 MB each at 640 x 480.
Beyond it the most redundant keyframe gives them up, and keeps what the graph needs, some 2 kB.
"""
SPACING = 0.15
"""Image shift, radians, after which a new keyframe is due: 9 degrees, or 15 cm at 1 m."""
SMALLER = 3
"""Pyramid level, counted from the keyframe's images, of the small blurred image that tells whether two keyframes look
alike (Klein and Murray, ECCV 2008). It has 40 x 30 pixels for a frame of 640 x 480.
"""
FEWEST_PIXELS = 60
"""Fewest pixels of the small image; it is of a finer level where frames are smaller than about 150 x 110."""
BLUR = 1.0
"""Standard deviation of the small image's blur, in its pixels."""
FEWEST = 30
"""Fewest points that have to be visible for two thumbnails to be compared."""
USUAL_DISTANCE = 2.0
"""Median depth, metres, that is assumed where there is no depth."""


class Thumbnail(NamedTuple):
    """A small blurred image, and the 3-D points that it shows."""

    small: Float32[np.ndarray, "h w"]
    points: Float64[np.ndarray, "3 n"]
    """Points that the pixels with a reading show, metres in the camera."""
    grey: Float32[np.ndarray, " n"]
    """Grey of the pixels with a reading."""

    @classmethod
    def of(cls, images: CompensatedImages, camera: Camera) -> Self:
        """The thumbnail of a keyframe's images, taken by `camera`."""
        level = level_of_thumbnail(camera)
        tiny, side = camera.level(level), 2**level
        small = cv2.resize(images.grey, (tiny.width, tiny.height), interpolation=cv2.INTER_AREA).astype(np.float32)
        small = cv2.GaussianBlur(small, (0, 0), BLUR)
        depth = images.depth[side // 2 :: side, side // 2 :: side][: tiny.height, : tiny.width]
        v, u = np.nonzero(depth)
        z = depth[v, u] / camera.depth_scale
        x, y = to_ray(tiny, u, v)
        return cls(small, np.stack([x * z, y * z, z]).astype(np.float64), small[v, u])

    @property
    def distance(self) -> float:
        """Median depth, metres."""
        return float(np.median(self.points[2])) if self.points.size else USUAL_DISTANCE

    def agreement(
        self, other: "Thumbnail", other_T_self: Float64[np.ndarray, "4 4"], camera: Camera
    ) -> tuple[float, float]:
        """How well another thumbnail shows the same from another pose.

        Args:
            other: The other keyframe's thumbnail.
            other_T_self: Maps points of this keyframe's camera into the other one's.
            camera: Camera of the keyframes' images, half the size of the frames.

        Returns:
            Share of the points that it sees, and the correlation of their grey in the two; 0 where too few are seen.
        """
        seen = other_T_self[:3, :3] @ self.points + other_T_self[:3, 3:]
        tiny, z = camera.level(level_of_thumbnail(camera)), np.where(seen[2] > NEAREST, seen[2], 1.0)
        u, v = to_pixels(tiny, seen[0], seen[1], 1.0 / z)
        inside = (seen[2] > NEAREST) & in_image(tiny, u, v)
        if inside.sum() < FEWEST:
            return 0.0, 0.0
        column, row = (axis[inside].astype(np.float32)[None] for axis in (u, v))
        there = cv2.remap(other.small, column, row, cv2.INTER_LINEAR)[0]
        return float(inside.mean()), correlation(self.grey[inside], there)


def level_of_thumbnail(camera: Camera) -> int:
    """Pyramid level of the small image, counted from the images of a camera's keyframes."""
    coarse_to_fine = range(SMALLER, 0, -1)
    return next((k for k in coarse_to_fine if (camera.width >> k) * (camera.height >> k) >= FEWEST_PIXELS), 0)


NOTHING_SEEN = Thumbnail(np.zeros((0, 0), np.float32), np.zeros((3, 0)), np.zeros(0, np.float32))
"""Thumbnail of a keyframe without images."""


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson correlation; 0 where one of the two is flat."""
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float((a * b).sum()) / size if size > 1e-3 else 0.0


@dataclass(eq=False)
class Keyframe:
    """A frame of the map.

    Attributes:
        number: Its place among the keyframes.
        index: Index of the frame in the sequence.
        timestamp: Colour timestamp, seconds.
        segment: Segment of the odometry's trajectory that it belongs to.
        world_T_odometry: Its pose by the odometry alone.
        world_T_camera: Its pose as the map has corrected it.
        step: Covariance of the odometry's motion from the keyframe before, of δ in a_T_b · exp(δ); None where that is
            unknown.
        images: Grey and depth at half the size; None once they were dropped.
        thumbnail: What it looks like from afar; `NOTHING_SEEN` once the images were dropped.
        features: Its keypoints; None until they are needed.
    """

    number: int
    index: int
    timestamp: float
    segment: int
    world_T_odometry: Float64[np.ndarray, "4 4"]
    world_T_camera: Float64[np.ndarray, "4 4"]
    step: Float64[np.ndarray, "6 6"] | None
    images: CompensatedImages | None
    thumbnail: Thumbnail
    tried: dict[int, Float64[np.ndarray, "4 4"]] = field(default_factory=dict)
    """Guesses from which it was aligned with earlier keyframes, by their numbers."""
    linked: set[int] = field(default_factory=set)
    """Numbers of the earlier keyframes that it has an edge to."""
    features: Features | None = None
    in_doubt: bool = False
    """Whether something speaks against the odometry's motion from the keyframe before."""

    def give_up_images(self) -> None:
        """Drop all that takes memory; the pose stays."""
        self.images, self.thumbnail, self.features = None, NOTHING_SEEN, None
        self.tried.clear()


def shift(a_T_b: Float64[np.ndarray, "*n 4 4"], distance: float) -> Float64[np.ndarray, "*n"]:
    """About how far motions shift the image of a scene at a distance in metres, radians."""
    length, angle = length_and_angle(a_T_b)
    return angle + length / max(distance, 0.1)


def shifts(world_T_camera: Float64[np.ndarray, "n 4 4"], distance: float) -> Float64[np.ndarray, "n n"]:
    """`shift` between any two of some poses."""
    # entry by entry: for matrices this small the threads of BLAS cost many times what they save
    trace = sum(entry[:, None] * entry for entry in world_T_camera[:, :3, :3].reshape(-1, 9).T)
    squared = sum((axis[:, None] - axis) ** 2 for axis in world_T_camera[:, :3, 3].T)
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)) + np.sqrt(squared) / max(distance, 0.1)


class Keyframes:
    """The keyframes of a run, in order.

    Args:
        camera: Camera of the frames as they come, without distortion.
        most: Largest number of keyframes that keep their images; at least 2.
        synchronise: Whether depth is moved to when the colour image was taken.
    """

    def __init__(self, camera: Camera, most: int = MAX_IMAGES, synchronise: bool = True):
        self.full, self.camera, self.most, self.synchronise = camera, camera.level(1), max(most, 2), synchronise
        self.all: list[Keyframe] = []

    def is_due(self, world_T_camera: Float64[np.ndarray, "4 4"], segment: int) -> bool:
        """Whether a frame at a pose of the odometry should become a keyframe."""
        if not self.all or self.all[-1].segment != segment:
            return True
        last = self.all[-1]
        return bool(shift(inverse(last.world_T_odometry) @ world_T_camera, last.thumbnail.distance) > SPACING)

    def make(
        self,
        frame: Frame,
        index: int,
        segment: int,
        world_T_odometry: Float64[np.ndarray, "4 4"],
        twist: Float64[np.ndarray, " 6"],
        step: Float64[np.ndarray, "6 6"] | None = None,
    ) -> Keyframe:
        """Make a keyframe of a frame, without adding it.

        Args:
            frame: The images.
            index: Index of the frame in the sequence.
            segment: Segment of the odometry's trajectory that it belongs to.
            world_T_odometry: Pose of the frame by the odometry alone.
            twist: Motion of the points in the camera at its moment, m/s and rad/s.
            step: Covariance of the odometry's motion from the last keyframe; None: unknown.
        """
        delay = frame.depth_delay if self.synchronise else 0.0
        images = compensate_motion(frame.grey, frame.depth, self.full, twist, delay)
        return Keyframe(
            number=len(self.all),
            index=index,
            timestamp=frame.timestamp,
            segment=segment,
            world_T_odometry=np.array(world_T_odometry),
            world_T_camera=np.array(world_T_odometry),
            step=step,
            images=images,
            thumbnail=Thumbnail.of(images, self.camera),
        )

    def add(self, keyframe: Keyframe) -> None:
        """Add a keyframe, corrected like the last one of its segment; drop another's images if there are too many."""
        before = next((other for other in reversed(self.all) if other.segment == keyframe.segment), None)
        if before is not None:
            correction = before.world_T_camera @ inverse(before.world_T_odometry)
            keyframe.world_T_camera = correction @ keyframe.world_T_odometry
        self.all.append(keyframe)
        self._thin()

    def searchable(self) -> list[Keyframe]:
        """Keyframes that have their images."""
        return [keyframe for keyframe in self.all if keyframe.images is not None]

    def _thin(self) -> None:
        """Drop the images of one keyframe where there are too many.

        It is the later one of the two keyframes that are nearest to each other: the older a keyframe, the more a loop
        to it tells.
        """
        kept = self.searchable()
        if len(kept) <= self.most:
            return
        apart = shifts(np.stack([keyframe.world_T_camera for keyframe in kept]), USUAL_DISTANCE)
        apart[np.triu_indices(len(kept))] = np.inf
        kept[1 + int(np.argmin(apart[1:-1].min(axis=1)))].give_up_images()
