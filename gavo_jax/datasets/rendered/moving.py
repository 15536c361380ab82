"""Rigid parts that move through the rendered room on given paths, and their ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int, UInt8

from gavo_jax.datasets.rendered.room import Box, Faces, Room, box_faces, build_room, shine
from gavo_jax.datasets.rendered.textures import TEXTURES, Atlas, paint
from gavo_jax.errors import GavoError, blamed
from gavo_jax.se3 import is_rigid
from gavo_jax.trajectory import Trajectory

Path = Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 4 4"]]
"""Maps seconds since the sequence's first frame to `world_T_part`, metres; z up."""

MOST_PARTS = 254
"""Largest number of rigid parts: labels are bytes, and 0 is the room."""
LARGEST_EDGE = 10.0
"""Largest edge of a body's box, metres."""
_TEXTURE_STREAM = 1 << 40


@dataclass(frozen=True)
class MovingPart:
    """Boxes that move together as one rigid body.

    Attributes:
        boxes: in the part's own frame, z up.
        path: pose of that frame over the seconds since the sequence's first frame. Either a function, called at
            whatever times a rolling shutter needs, or a trajectory whose `world_T_camera` is `world_T_part`.
            A trajectory is interpolated (linear and slerp); the part stands still before its start and after its end.
    """

    boxes: tuple[Box, ...]
    path: Path | Trajectory

    def world_T_part(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """Return the poses of the part at times in seconds since the sequence's first frame.

        Raises:
            GavoError: the path is empty, or does not give rigid transforms.
        """
        seconds = np.asarray(seconds, np.float64)
        if isinstance(self.path, Trajectory):
            if len(self.path) == 0:
                raise GavoError("synthetic: bodies: a path is empty")
            within = np.clip(seconds, self.path.timestamps.min(), self.path.timestamps.max())
            poses, _ = self.path.interpolate(within, max_gap=math.inf)
        else:
            poses = np.asarray(self.path(seconds), np.float64)
        if poses.shape != (len(seconds), 4, 4):
            raise GavoError(f"synthetic: bodies: a path returns {poses.shape} for {len(seconds)} times, not [n, 4, 4]")
        if not np.all(is_rigid(poses, 1e-6)):
            raise GavoError("synthetic: bodies: a path returns matrices that are not finite, or not rigid motions")
        return poses


@dataclass(frozen=True)
class MovingBody:
    """A moving body: one rigid part, or several parts that each follow their own path, such as limbs."""

    name: str
    parts: tuple[MovingPart, ...]


@dataclass(frozen=True, eq=False)
class BodyTruth:
    """Ground truth poses of a body. The frame of a part is the one that its boxes are given in.

    Attributes:
        name: of its `MovingBody`.
        label: its value in `SyntheticSequence.body_labels`, from 1.
        part_labels: its parts' values in `SyntheticSequence.part_labels`, from 1.
        timestamps: of every frame of the whole sequence, seconds.
        world_T_part: of each part at each of these stamps, metres; the world of the sequence's ground truth, z up.
    """

    name: str
    label: int
    part_labels: tuple[int, ...]
    timestamps: Float[np.ndarray, " frames"]
    world_T_part: Float[np.ndarray, "parts frames 4 4"]

    @property
    def rigid(self) -> bool:
        """Whether the body is a single rigid part."""
        return len(self.part_labels) == 1


@dataclass(frozen=True, eq=False)
class Scene:
    """A room and the parts in it; its faces are the room's, then each part's in the part's own frame.

    Attributes:
        room: faces and textures of the room and of all parts.
        label: of each face: 0 for the room's, k for those of the k-th part.
        parts: in the order of their labels.
    """

    room: Room
    label: Int[np.ndarray, " faces"]
    parts: tuple[MovingPart, ...] = ()

    def at(self, seconds: float) -> Room:
        """The room with all parts at their poses at a time since the first frame; faces in the world frame."""
        if not self.parts:
            return self.room
        poses = np.concatenate([np.eye(4)[None], *(part.world_T_part(np.array([seconds])) for part in self.parts)])
        moved = self.label > 0
        pose, faces = poses[self.label[moved]], self.room.faces
        turned = {}
        for name in ("origin", "u", "v", "normal"):
            turned[name] = getattr(faces, name).copy()
            turned[name][moved] = np.einsum("fij,fj->fi", pose[:, :3, :3], turned[name][moved])
        turned["origin"][moved] += pose[:, :3, 3]
        placed = Faces(**turned, size=faces.size, tint=faces.tint, textures=faces.textures)
        return Room(self.room.half_extent, self.room.height, placed, self.room.atlas)


def build_scene(seed: int, half_extent: tuple[float, float], height: float, bodies: Sequence[MovingBody]) -> Scene:
    """Build the room of a seed with bodies in it; without bodies, just the room."""
    parts = tuple(part for body in bodies for part in body.parts)
    if not parts:
        room = build_room(seed, half_extent, height)
        return Scene(room, np.zeros(len(room.faces.textures), int))
    room, label = _furnish(seed, half_extent, height, tuple(tuple(part.boxes) for part in parts))
    return Scene(room, label, parts)


@lru_cache(maxsize=2)
def _furnish(
    seed: int, half_extent: tuple[float, float], height: float, boxes: tuple[tuple[Box, ...], ...]
) -> tuple[Room, np.ndarray]:
    """The room's faces followed by the parts' (each in the part's own frame), and the labels of all faces.

    Parts are lit in their own frames, so that a surface keeps its brightness as it moves.
    """
    room = build_room(seed, half_extent, height)
    faces = [face for part in boxes for box in part for face in box_faces(box, [box.texture] * 6, inwards=False)]
    origin, u, v, normal, size, tint, textures = zip(*faces, strict=True)
    own = Faces(*(np.array(field) for field in (origin, u, v, normal, size, tint)), textures=textures)
    atlas = paint(own.textures, own.size, shine(own.normal), seed + _TEXTURE_STREAM)
    joined = {
        field.name: np.concatenate([getattr(room.faces, field.name), getattr(own, field.name)])
        for field in fields(Faces)
        if field.name != "textures"
    }
    all_faces = Faces(**joined, textures=(*room.faces.textures, *own.textures))
    counts = [len(room.faces.textures), *(6 * len(part) for part in boxes)]
    return Room(half_extent, height, all_faces, _join(room.atlas, atlas)), np.repeat(np.arange(len(counts)), counts)


def _join(first: Atlas, second: Atlas) -> Atlas:
    """Join two atlases in one image: the first in place, the second below it."""
    width = max(first.image.shape[1], second.image.shape[1])
    images = [np.pad(atlas.image, ((0, 0), (0, width - atlas.image.shape[1]))) for atlas in (first, second)]
    corner = np.concatenate([first.corner, second.corner + [0, len(first.image)]])
    return Atlas(np.concatenate(images), corner, np.concatenate([first.texel, second.texel]))


@blamed("synthetic: bodies")
def truths(bodies: Sequence[MovingBody], timestamps: Float[np.ndarray, " frames"]) -> tuple[BodyTruth, ...]:
    """The ground truth of every body at the frames' timestamps.

    Raises:
        GavoError: a value is not a `MovingBody`, a body has no parts, a part no boxes, a box is invalid, there are more
            than `MOST_PARTS` parts, or a path raises or does not give rigid transforms.
    """
    for body in bodies:
        if not isinstance(body, MovingBody):
            raise GavoError(f"synthetic: bodies: expected a MovingBody, got {type(body).__name__}")
    if any(not body.parts or not all(part.boxes for part in body.parts) for body in bodies):
        raise GavoError("synthetic: bodies: every body needs a part, and every part a box")
    for box in (box for body in bodies for part in body.parts for box in part.boxes):
        if box.texture not in TEXTURES:
            raise GavoError(f"synthetic: bodies: texture {box.texture!r}: not one of {', '.join(TEXTURES)}")
        if not all(math.isfinite(edge) and 0 < edge <= LARGEST_EDGE for edge in box.size):
            raise GavoError(f"synthetic: bodies: size {box.size}: each must be above 0, and at most {LARGEST_EDGE:g} m")
    if (count := sum(len(body.parts) for body in bodies)) > MOST_PARTS:
        raise GavoError(f"synthetic: bodies: must have at most {MOST_PARTS} parts, not {count}")
    seconds, found, last = timestamps - timestamps[0], [], 0
    for label, body in enumerate(bodies, 1):
        labels = tuple(range(last + 1, last + 1 + len(body.parts)))
        poses = np.stack([part.world_T_part(seconds) for part in body.parts])
        found.append(BodyTruth(body.name, label, labels, timestamps, poses))
        last = labels[-1]
    return tuple(found)


def body_of_part(bodies: Sequence[BodyTruth]) -> UInt8[np.ndarray, " labels"]:
    """Lookup table from part label to body label; 0 stays 0."""
    lookup = [0, *(body.label for body in bodies for _ in body.part_labels)]
    return np.array(lookup, np.uint8)
