"""The points of a reference frame: their selection, and their transfer to other cameras and row times."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer

from gavo_jax.camera import Camera, to_pixels, to_ray
from gavo_jax.image.levels import ImagePlane, Levels
from gavo_jax.image.pyramid import NO_PIXEL, Pyramid, make_atlas
from gavo_jax.image.sampling import inverse_depth_slopes
from gavo_jax.image.shutter import row_time
from gavo_jax.image.warp import Points, moved

SATURATED = 250.0
"""Grey level from which a pixel counts as saturated: the scene was at least as bright."""


class Reference(NamedTuple):
    """Points of one level of the reference frame, as arrays of N; with a leading axis of views for several frames."""

    points: Points
    grey: Float[Array, "*views n"]
    grey_u: Float[Array, "*views n"]
    """Intensity gradient along u (grey levels per pixel), and `grey_v` along v."""
    grey_v: Float[Array, "*views n"]
    slope_u: Float[Array, "*views n"]
    """Inverse-depth slope along u (1/m per pixel), and `slope_v` along v."""
    slope_v: Float[Array, "*views n"]
    facing: Float[Array, "*views n"]
    """Cosine of the surface's inclination: turns a residual along the ray into a point-to-plane distance."""
    row_time: Float[Array, "*views n"]
    """Time at which the point's row was exposed; see `Shutter`."""
    lit: Float[Array, "*views n"]
    """1 where the grey is below `SATURATED`, else 0."""

    def brightened(self, gain: Float[Array, "*#n"], bias: Float[Array, "*#n"] | float = 0.0) -> "Reference":
        """Return the same points with another gain and bias of the image."""
        return self._replace(grey=gain * self.grey + bias, grey_u=gain * self.grey_u, grey_v=gain * self.grey_v)


def central_gradient(grey: Float[Array, "h+2 w+2"]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Return ∂/∂u and ∂/∂v of an image with a margin of one pixel, by central differences.

    A neighbour that is `NO_PIXEL` is replaced by the pixel itself.
    """
    middle = grey[1:-1, 1:-1]

    def along(before: jax.Array, after: jax.Array) -> jax.Array:
        return 0.5 * (jnp.where(after == NO_PIXEL, middle, after) - jnp.where(before == NO_PIXEL, middle, before))

    return along(grey[1:-1, :-2], grey[1:-1, 2:]), along(grey[:-2, 1:-1], grey[2:, 1:-1])


def make_references(pyramid: Pyramid, camera: Camera, levels: Levels) -> Reference:
    """Select points on some levels, [L, N]: per square block of pixels the one with a reading and the steepest grey.

    The selection is stratified, so it costs little accuracy, and N is static. Shorter levels are padded with points
    without a reading.

    Args:
        pyramid: Pyramid of the reference frame.
        camera: Camera of level 0.
        levels: The levels, in the order of the result.
    """
    layout = levels.layout
    grey, inverse_depth = (image[:-1, :-1] for image in make_atlas([pyramid[number] for number in levels.numbers]))
    gradient, slopes = central_gradient(grey), inverse_depth_slopes(inverse_depth)
    grey, inverse_depth = grey[1:-1, 1:-1], inverse_depth[1:-1, 1:-1]
    steepness = jnp.where(inverse_depth > 0, gradient[0] ** 2 + gradient[1] ** 2, -1.0)
    chosen = []
    for (height, width), (row, column), cell in zip(levels.sizes, layout.corners, levels.cells, strict=True):
        u, v = _steepest_of_blocks(steepness[row : row + height, column : column + width], cell)
        chosen.append(((v + row) * layout.width + u + column).reshape(-1))
    place = jnp.stack([jnp.pad(p, (0, levels.most_points - p.shape[0]), constant_values=layout.gap) for p in chosen])
    q, grey, grey_u, grey_v, slope_u, slope_v = (
        image.reshape(-1).at[place].get(mode="promise_in_bounds") for image in (inverse_depth, grey, *gradient, *slopes)
    )
    plane = jax.tree.map(lambda leaf: leaf[:, None], levels.planes(camera))
    row, column = np.array(layout.corners).T[..., None]
    u, v = (axis.astype(jnp.float32) for axis in (place % layout.width - column, place // layout.width - row))
    near = jnp.maximum(q, 1e-3)
    facing = jax.lax.rsqrt(1.0 + (plane.fx * slope_u / near) ** 2 + (plane.fy * slope_v / near) ** 2)
    rays = Points(*to_ray(plane, u, v), q)
    lit = (grey < SATURATED).astype(jnp.float32)
    return Reference(rays, grey, grey_u, grey_v, slope_u, slope_v, facing, row_time(v, plane), lit)


def _steepest_of_blocks(steepness: Float[Array, "h w"], cell: int) -> tuple[Integer[Array, "r c"], ...]:
    """Return the column and row of the largest pixel of each cell x cell block, the first of equal ones."""
    rows, columns = (size // cell for size in steepness.shape)
    blocks = steepness[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell).transpose(0, 2, 1, 3)
    within = jnp.argmax(blocks.reshape(rows, columns, cell * cell), axis=-1)
    return jnp.arange(columns) * cell + within % cell, jnp.arange(rows)[:, None] * cell + within // cell


def move_reference(reference: Reference, camera_T_reference: Float[Array, "4 4"]) -> Reference:
    """Return the points as rays of another camera; those behind it lose their reading."""
    return reference._replace(points=_rays(moved(reference.points, camera_T_reference), reference.points.q))


def undo_rolling_shutter(reference: Reference, twist: Float[Array, " 6"]) -> Reference:
    """Return the points where they were at their frame's timestamp instead of when their rows were exposed.

    Args:
        reference: Points as seen by the rolling shutter.
        twist: Motion of the points in the camera during one readout, small.
    """
    points = swept(reference.points, twist, -reference.row_time)
    return reference._replace(points=points, row_time=jnp.zeros_like(reference.row_time))


def swept(points: Points, twist: Float[Array, " 6"], share: Float[Array, "*n"]) -> Points:
    """Move points by a share of a small twist, each by its own; to first order."""
    (v, w), (x, y, q) = (twist[:3], twist[3:]), points
    moved_by = (
        x + share * (w[1] - w[2] * y + v[0] * q),
        y + share * (w[2] * x - w[0] + v[1] * q),
        1.0 + share * (w[0] * y - w[1] * x + v[2] * q),
    )
    return _rays(moved_by, q)


@jax.jit
def apply_rolling_shutter(reference: Reference, twist: Float[Array, " 6"], planes: ImagePlane) -> Reference:
    """Return the points where their rows saw them; the inverse of `undo_rolling_shutter` with the same twist.

    Args:
        reference: Points with the rolling shutter undone, [L, N].
        twist: The same twist.
        planes: Planes of its levels, [L].
    """
    plane = jax.tree.map(lambda leaf: leaf[:, None], planes)
    seen = reference
    for _ in range(2):  # iterated, as a point's row depends on where it was seen
        row = row_time(to_pixels(plane, seen.points.x, seen.points.y)[1], plane)
        seen = undo_rolling_shutter(reference._replace(row_time=row), -twist)._replace(row_time=row)
    return seen


def _rays(coordinates: tuple[jax.Array, jax.Array, jax.Array], q: jax.Array) -> Points:
    """Make points from coordinates that are scaled by the old inverse depth; those behind the camera lose their
    reading.
    """
    before = (q > 0) & (coordinates[2] > 1e-3)
    depth = jnp.where(before, coordinates[2], 1.0)
    return Points(coordinates[0] / depth, coordinates[1] / depth, jnp.where(before, q / depth, 0.0))
