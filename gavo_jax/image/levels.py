"""Geometry of the levels: what follows from an image's size, the levels that are searched and the number of points.

Made once for a search and handed along. Nothing in it is an input of a program: it shapes them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer

from gavo_jax.camera import Camera

PointsPerLevel = int | None | tuple[int, ...]
"""Largest number of points: of every level alike, None for every pixel, or one entry per level of the pyramid."""


class AtlasLayout(NamedTuple):
    """Where levels lie in an atlas: the largest on top, the others from left to right below, a pixel between them."""

    height: int
    width: int
    corners: tuple[tuple[int, int], ...]
    """Row and column of each level's first pixel."""
    gap: int
    """Place, in the flat image, of a pixel that belongs to no level."""


class ImagePlane(NamedTuple):
    """Intrinsics and place of a pyramid level as numbers that a program takes as input, so that one compiled program
    serves every level.
    """

    fx: Float[Array, "*l"]
    fy: Float[Array, "*l"]
    cx: Float[Array, "*l"]
    cy: Float[Array, "*l"]
    width: Integer[Array, "*l"]
    height: Integer[Array, "*l"]
    offset: Integer[Array, "*l"]
    """Offset of the level's first pixel in the packed target."""
    stride: Integer[Array, "*l"]
    """Pixels from one in the packed target to the one below it."""


@dataclass(frozen=True)
class Levels:
    """Some pyramid levels of a camera, in the order in which they are searched.

    Attributes:
        width: Width of level 0, pixels.
        height: Height of level 0, pixels.
        numbers: Which levels, coarsest first; 0 is the full image.
        points: Largest number of reference points of a level.
    """

    width: int
    height: int
    numbers: tuple[int, ...]
    points: PointsPerLevel = None

    @classmethod
    def of(cls, camera: Camera, numbers: tuple[int, ...], points: PointsPerLevel = None) -> Self:
        """Those of a camera."""
        return cls(camera.width, camera.height, tuple(numbers), points)

    @cached_property
    def sizes(self) -> list[tuple[int, int]]:
        """Height and width of each."""
        return [(self.height >> number, self.width >> number) for number in self.numbers]

    @cached_property
    def layout(self) -> AtlasLayout:
        """Places of the levels in an atlas."""
        return atlas_layout(self.sizes)

    @cached_property
    def cells(self) -> list[int]:
        """Side of the blocks of pixels that give one point each."""
        most = [self.points[number] if isinstance(self.points, tuple) else self.points for number in self.numbers]
        return [cell_of(height, width, count) for (height, width), count in zip(self.sizes, most, strict=True)]

    @cached_property
    def grids(self) -> list[tuple[int, int]]:
        """Rows and columns of the points of each."""
        return [(height // cell, width // cell) for (height, width), cell in zip(self.sizes, self.cells, strict=True)]

    @property
    def most_points(self) -> int:
        """Points of the level that has the most, N of `objective.points.make_references`."""
        return max(rows * columns for rows, columns in self.grids)

    def planes(self, camera: Camera) -> ImagePlane:
        """Planes of the levels, [L], packed together."""
        intrinsics = camera.scaled(np.float32(0.5) ** np.array(self.numbers, np.float32))
        height, width = np.array(self.sizes).T
        offset = [row * self.layout.width + column for row, column in self.layout.corners]
        columns = (*intrinsics, width, height, offset, [self.layout.width] * len(self.numbers))
        return ImagePlane(*(jnp.asarray(column) for column in columns))


def image_plane(camera: Camera) -> ImagePlane:
    """The plane of one image that is packed alone."""
    return jax.tree.map(lambda leaf: leaf[0], Levels.of(camera, (0,)).planes(camera))


def cell_of(height: int, width: int, points: int | None) -> int:
    """Side of the blocks that give one point each, so that an image gives at most `points`; None takes every pixel."""
    cell = 1
    while points is not None and (width // cell) * (height // cell) > points and cell < min(height, width):
        cell += 1
    return cell


def atlas_layout(sizes: Sequence[tuple[int, int]]) -> AtlasLayout:
    """The layout of levels of some sizes (height, width), whose order `corners` keeps."""
    top = max(sizes)
    corners, column, below = [], 0, 0
    for size in sizes:
        corners.append((0, 0) if size == top else (top[0] + 1, column))
        if size != top:
            column, below = column + size[1] + 1, max(below, size[0])
    width = max(top[1], column)
    return AtlasLayout(top[0] + 1 + below, width, tuple(corners), top[0] * width)
