"""A textured, furnished room made of boxes: every surface is a rectangle.

World frame: metres, z up, the origin on the floor below the middle of the room.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from gavo_jax.datasets.rendered.textures import Atlas, paint

MARGIN_X, MARGIN_Y = 2.2, 1.75
"""Furniture stands within these distances (m) of the walls across x and across y; the middle of the room stays free."""
LOWEST_VIEW, HIGHEST_VIEW = 0.95, 0.4
"""The free space ends this far (m) above the floor and below the ceiling."""


@dataclass(frozen=True)
class Box:
    """A box that stands upright: centre of its bottom (x, y, z), edge lengths (m), turn about z (degrees), look."""

    at: tuple[float, float, float]
    size: tuple[float, float, float]
    texture: str
    yaw: float = 0.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Faces:
    """F rectangles: origin + s u + t v, s and t from 0 to the two sizes; seen from the side that `normal` points to.

    origin, u, v, normal: [F, 3] in the world frame, metres; size: [F, 2] metres; tint: [F, 3] colour factors of luma 1.
    """

    origin: np.ndarray
    u: np.ndarray
    v: np.ndarray
    normal: np.ndarray
    size: np.ndarray
    tint: np.ndarray
    textures: tuple[str, ...]

    def corners(self) -> np.ndarray:
        """The rectangles' corners, [F, 4, 3]."""
        s, t = self.size[:, :1] * self.u, self.size[:, 1:] * self.v
        return np.stack([self.origin, self.origin + s, self.origin + s + t, self.origin + t], axis=1)


@dataclass(frozen=True)
class Room:
    """A furnished room: what `render` needs, and the half extents (x, y) and height (m) that it was built with."""

    half_extent: tuple[float, float]
    height: float
    faces: Faces
    atlas: Atlas


@lru_cache(maxsize=2)
def build_room(seed: int, half_extent: tuple[float, float] = (3.0, 2.5), height: float = 3.0) -> Room:
    """Build the room of a seed.

    The furniture is always the same, each piece at a fixed distance from a wall; the seed only changes the textures.
    Faces that cannot be seen from `free_space`, where cameras belong, are left out.

    Args:
        seed: of the textures.
        half_extent: from the middle to the walls across x and across y, metres.
        height: metres.
    """
    faces = _collect_faces(half_extent, height)
    return Room(half_extent, height, faces, paint(faces.textures, faces.size, shine(faces.normal), seed))


def shine(normal: np.ndarray) -> np.ndarray:
    """Shading factors [F] on the albedo of surfaces with unit normals [F, 3] in the world frame."""
    return 0.82 + 0.18 * (normal @ np.array([-0.45, 0.3, 0.84]))


def free_space(half_extent: tuple[float, float], height: float) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner [3] (m) of the empty box in the middle of a room, where cameras may be."""
    x, y = half_extent[0] - MARGIN_X, half_extent[1] - MARGIN_Y
    return np.array([-x, -y, LOWEST_VIEW]), np.array([x, y, height - HIGHEST_VIEW])


def _collect_faces(half_extent: tuple[float, float], height: float) -> Faces:
    hull = Box((0.0, 0.0, 0.0), (2 * half_extent[0], 2 * half_extent[1], height), "")
    walls = ["wallpaper", "wallpaper", "wallpaper", "wallpaper", "floor", "ceiling"]
    parts = box_faces(hull, walls, inwards=True)
    for box in _furniture(*half_extent):
        parts += box_faces(box, [box.texture] * 6, inwards=False)
    low, high = free_space(half_extent, height)
    views = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    seen = [part for part in parts if np.any((views - part[0]) @ part[3] > 0)]
    origin, u, v, normal, size, tint, textures = zip(*seen, strict=True)
    return Faces(*(np.array(field) for field in (origin, u, v, normal, size, tint)), textures=textures)


def box_faces(box: Box, textures: list[str], inwards: bool) -> list[tuple]:
    """Rectangles of a box in the order -x, +x, -y, +y, -z, +z, seen from inside or outside; v points down walls."""
    cos, sin = math.cos(math.radians(box.yaw)), math.sin(math.radians(box.yaw))
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    centre = np.array(box.at) + [0.0, 0.0, box.size[2] / 2]
    luma = np.dot(box.tint, [0.299, 0.587, 0.114])
    faces = []
    for axis, (iu, iv) in enumerate(((1, 2), (0, 2), (0, 1))):
        for side in (-1.0, 1.0):
            u, v = axes[iu], axes[iv] * (-1.0 if iv == 2 else 1.0)
            size = np.array([box.size[iu], box.size[iv]])
            origin = centre + side * box.size[axis] / 2 * axes[axis] - size[0] / 2 * u - size[1] / 2 * v
            normal = axes[axis] * (-side if inwards else side)
            faces.append((origin, u, v, normal, size, np.array(box.tint) / luma, textures[len(faces)]))
    return faces


def _place(parts: list[Box], x: float, y: float, yaw: float, z: float = 0.0) -> list[Box]:
    """Transform boxes from the frame of a piece of furniture to its place in the room."""
    cos, sin = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    return [
        replace(
            p,
            at=(x + cos * p.at[0] - sin * p.at[1], y + sin * p.at[0] + cos * p.at[1], z + p.at[2]),
            yaw=p.yaw + yaw,
        )
        for p in parts
    ]


def _table(length: float, depth: float, height: float, tint: tuple[float, float, float]) -> list[Box]:
    """A table top on four legs; its length along y."""
    x, y = depth / 2 - 0.06, length / 2 - 0.06
    legs = [
        Box((sx * x, sy * y, 0.0), (0.06, 0.06, height - 0.04), "wood", 0.0, tint) for sx in (-1, 1) for sy in (-1, 1)
    ]
    return [*legs, Box((0.0, 0.0, height - 0.04), (depth, length, 0.04), "wood", 0.0, tint)]


def _desk(length: float, depth: float, height: float, tint: tuple[float, float, float]) -> list[Box]:
    """A desk with closed sides and drawers down to the floor; its length along y."""
    body = Box((0.0, 0.0, 0.0), (depth - 0.02, length - 0.02, height - 0.04), "drawers", 0.0, tint)
    return [body, Box((0.0, 0.0, height - 0.04), (depth, length, 0.04), "wood", 0.0, tint)]


def _shelf(width: float, depth: float, tint: tuple[float, float, float]) -> list[Box]:
    """A bookcase of four storeys, its width along y, open towards -x, filled with rows of books."""
    storey, board = 0.46, 0.03
    height = 4 * storey + board
    sides = [Box((0.0, s * (width + board) / 2, 0.0), (depth, board, height), "wood", 0.0, tint) for s in (-1, 1)]
    boards = [Box((0.0, 0.0, k * storey), (depth, width, board), "wood", 0.0, tint) for k in range(5)]
    fills = [(0.92, 0.0, 0.33), (0.7, -0.12, 0.29), (0.8, 0.08, 0.36), (0.55, 0.2, 0.27)]
    books = [
        Box(
            (0.04, shift * width, k * storey + board),
            (depth - 0.1, share * width, tall),
            "books",
            0.0,
            (1.0, 0.95, 0.85),
        )
        for k, (share, shift, tall) in enumerate(fills)
    ]
    back = Box((depth / 2 - 0.01, 0.0, board), (0.015, width, height - 2 * board), "wood", 0.0, tint)
    return [*sides, *boards, *books, back]


def _sofa(length: float) -> list[Box]:
    """A sofa with its length along x, its back towards +y."""
    tint = (0.75, 0.95, 1.3)
    arms = [Box((s * (length / 2 + 0.1), 0.0, 0.0), (0.2, 0.9, 0.62), "fabric", 0.0, tint) for s in (-1, 1)]
    cushions = [
        Box((s * length / 4, 0.24, 0.43), (0.46, 0.14, 0.42), "checker", 8.0 * s, (1.3, 0.9, 0.7)) for s in (-1, 1)
    ]
    seat = Box((0.0, -0.05, 0.0), (length, 0.8, 0.43), "fabric", 0.0, tint)
    return [*arms, *cushions, seat, Box((0.0, 0.4, 0.0), (length, 0.2, 0.85), "fabric", 0.0, tint)]


def _chair() -> list[Box]:
    """A chair that faces +x."""
    tint = (1.2, 0.95, 0.7)
    legs = [Box((sx * 0.19, sy * 0.19, 0.0), (0.04, 0.04, 0.45), "wood", 0.0, tint) for sx in (-1, 1) for sy in (-1, 1)]
    seat = Box((0.0, 0.0, 0.45), (0.44, 0.44, 0.05), "checker", 0.0, (1.3, 0.8, 0.8))
    return [*legs, seat, Box((-0.2, 0.0, 0.5), (0.04, 0.42, 0.4), "wood", 0.0, tint)]


def _desktop() -> list[Box]:
    """The things on the desk: a screen on its stand, two piles of books, a carton, a cup, a keyboard."""
    return [
        Box((0.15, 0.0, 0.0), (0.18, 0.24, 0.02), "plain"),
        Box((0.18, 0.0, 0.02), (0.04, 0.06, 0.1), "plain"),
        Box((0.16, 0.0, 0.12), (0.05, 0.56, 0.34), "screen", 4.0, (0.8, 1.0, 1.2)),
        Box((0.0, 0.52, 0.0), (0.22, 0.3, 0.09), "books", 12.0),
        Box((0.01, 0.53, 0.09), (0.19, 0.26, 0.06), "books", -9.0, (1.2, 0.95, 0.8)),
        Box((0.05, -0.58, 0.0), (0.26, 0.3, 0.24), "carton", 20.0, (1.25, 0.98, 0.65)),
        Box((-0.2, 0.26, 0.0), (0.08, 0.08, 0.1), "checker", 30.0, (0.7, 1.0, 1.4)),
        Box((-0.18, -0.05, 0.0), (0.15, 0.42, 0.025), "keys"),
    ]


def _furniture(half_x: float, half_y: float) -> list[Box]:
    """All the room's boxes. Each piece keeps its distance to its wall when the room is built larger."""
    oak, pine, walnut = (1.2, 0.97, 0.7), (1.15, 1.0, 0.75), (1.25, 0.94, 0.75)
    desk = _place([*_desk(1.7, 0.8, 0.74, oak), *_place(_desktop(), 0.0, 0.0, 0.0, z=0.74)], half_x - 1.1, 0.15, 6.0)
    shelves = _place(_shelf(1.1, 0.32, walnut), half_x - 0.18, 1.55, 0.0) + _place(
        _shelf(0.9, 0.3, pine), -half_x + 0.18, -1.3, 180.0
    )
    drawers = [
        Box((half_x - 0.28, -1.65, 0.0), (0.5, 1.0, 1.0), "drawers", 0.0, pine),
        Box((half_x - 0.28, -1.85, 1.0), (0.3, 0.36, 0.28), "carton", -15.0, (1.25, 0.98, 0.65)),
        Box((half_x - 0.26, -1.35, 1.0), (0.16, 0.2, 0.42), "checker", 25.0, (0.8, 1.15, 0.8)),
        Box((-half_x + 0.35, 1.2, 0.0), (0.6, 1.6, 2.1), "drawers", 0.0, walnut),
    ]
    seats = _place(_sofa(1.7), 0.25, half_y - 0.6, 0.0) + _place(_chair(), -1.25, -half_y + 0.65, 70.0)
    bench = _place(_table(1.4, 0.55, 0.5, walnut), 0.3, -half_y + 0.45, 90.0) + _place(
        [
            Box((0.0, 0.35, 0.5), (0.3, 0.42, 0.3), "carton", 15.0, (1.25, 0.98, 0.65)),
            Box((0.05, -0.3, 0.5), (0.28, 0.5, 0.2), "books", 5.0),
        ],
        0.3,
        -half_y + 0.45,
        90.0,
    )
    floor = [
        Box((0.0, 0.0, 0.0), (2.4, 1.7, 0.012), "rug", 10.0, (1.3, 0.88, 0.8)),
        Box((half_x - 0.95, -1.3, 0.0), (0.5, 0.45, 0.4), "carton", 35.0, (1.25, 0.98, 0.65)),
        Box((half_x - 0.9, -1.33, 0.4), (0.34, 0.34, 0.28), "carton", 15.0, (1.2, 1.0, 0.7)),
        Box((half_x - 0.95, 1.95, 0.0), (0.4, 0.4, 0.5), "carton", -20.0, (1.25, 0.98, 0.65)),
        Box((-half_x + 0.9, -0.2, 0.0), (0.45, 0.6, 0.45), "fabric", 20.0, (0.8, 1.1, 0.85)),
    ]
    pictures = [
        Box((half_x - 0.015, 0.15, 1.35), (0.03, 1.2, 0.85), "picture"),
        Box((half_x - 0.015, -1.35, 1.6), (0.03, 0.7, 0.9), "picture", 0.0, (1.2, 0.95, 0.8)),
        Box((half_x - 0.015, -0.75, 1.2), (0.03, 0.35, 0.5), "picture", 0.0, (0.85, 1.0, 1.3)),
        Box((0.5, half_y - 0.015, 1.25), (1.3, 0.03, 0.9), "picture", 0.0, (0.9, 1.0, 1.2)),
        Box((half_x - 1.1, half_y - 0.015, 1.0), (0.6, 0.03, 0.8), "picture"),
        Box((-1.1, half_y - 0.015, 1.3), (0.6, 0.03, 0.8), "picture", 0.0, (1.2, 1.0, 0.7)),
        Box((0.5, -half_y + 0.015, 1.1), (1.4, 0.03, 1.0), "picture", 0.0, (1.1, 1.0, 0.8)),
        Box((-1.2, -half_y + 0.015, 1.2), (0.7, 0.03, 0.9), "picture", 0.0, (0.8, 1.0, 1.4)),
        Box((half_x - 0.9, -half_y + 0.015, 1.1), (0.8, 0.03, 1.1), "picture"),
        Box((-half_x + 0.015, 0.0, 1.3), (0.03, 0.6, 0.8), "picture", 0.0, (1.2, 0.95, 0.9)),
    ]
    return [*desk, *shelves, *drawers, *seats, *bench, *floor, *pictures]
