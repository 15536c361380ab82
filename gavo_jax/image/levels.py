"""Geometry of the levels, from the image's size, the levels that are searched and the number of points.

`Levels` is made once per search and passed along. It is static, as it shapes programs; an `ImagePlane` is their input.
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
    """Positions of levels in an atlas: the largest on top, the others below from left to right, one pixel apart."""

    height: int
    width: int
    corners: tuple[tuple[int, int], ...]
    """Row and column of each level's first pixel."""
    gap: int
    """Index, in the flattened image, of a pixel that belongs to no level."""


class ImagePlane(NamedTuple):
    """Intrinsics and atlas position of a pyramid level, as inputs of a program that is compiled once for all levels."""

    fx: Float[Array, "*l"]
    fy: Float[Array, "*l"]
    cx: Float[Array, "*l"]
    cy: Float[Array, "*l"]
    width: Integer[Array, "*l"]
    height: Integer[Array, "*l"]
    offset: Integer[Array, "*l"]
    """Offset of the level's first pixel in the packed target."""
    stride: Integer[Array, "*l"]
    """Number of pixels from one row of the packed target to the next."""


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
        """Return the given levels of a camera."""
        return cls(camera.width, camera.height, tuple(numbers), points)

    @cached_property
    def sizes(self) -> list[tuple[int, int]]:
        """Height and width of each level."""
        return [(self.height >> number, self.width >> number) for number in self.numbers]

    @cached_property
    def layout(self) -> AtlasLayout:
        """Positions of the levels in an atlas."""
        return atlas_layout(self.sizes)

    @cached_property
    def cells(self) -> list[int]:
        """Side of the blocks of pixels that give one point each, for each level."""
        most = [self.points[number] if isinstance(self.points, tuple) else self.points for number in self.numbers]
        return [cell_of(height, width, count) for (height, width), count in zip(self.sizes, most, strict=True)]

    @cached_property
    def grids(self) -> list[tuple[int, int]]:
        """Rows and columns of points on each level."""
        return [(height // cell, width // cell) for (height, width), cell in zip(self.sizes, self.cells, strict=True)]

    @property
    def most_points(self) -> int:
        """Number of points of the level that has the most, N of `objective.points.make_references`."""
        return max(rows * columns for rows, columns in self.grids)

    def planes(self, camera: Camera) -> ImagePlane:
        """Return the planes of the levels, [L], packed together."""
        intrinsics = camera.scaled(np.float32(0.5) ** np.array(self.numbers, np.float32))
        height, width = np.array(self.sizes).T
        offset = [row * self.layout.width + column for row, column in self.layout.corners]
        columns = (*intrinsics, width, height, offset, [self.layout.width] * len(self.numbers))
        return ImagePlane(*(jnp.asarray(column) for column in columns))


def image_plane(camera: Camera) -> ImagePlane:
    """Return the plane of an image that is packed alone."""
    return jax.tree.map(lambda leaf: leaf[0], Levels.of(camera, (0,)).planes(camera))


def cell_of(height: int, width: int, points: int | None) -> int:
    """Return the side of the blocks of one point each that give at most `points`; None takes every pixel."""
    cell = 1
    while points is not None and (width // cell) * (height // cell) > points and cell < min(height, width):
        cell += 1
    return cell


def atlas_layout(sizes: Sequence[tuple[int, int]]) -> AtlasLayout:
    """Lay out levels of the given sizes (height, width); `corners` keeps their order."""
    top = max(sizes)
    corners, column, below = [], 0, 0
    for size in sizes:
        corners.append((0, 0) if size == top else (top[0] + 1, column))
        if size != top:
            column, below = column + size[1] + 1, max(below, size[0])
    width = max(top[1], column)
    return AtlasLayout(top[0] + 1 + below, width, tuple(corners), top[0] * width)
