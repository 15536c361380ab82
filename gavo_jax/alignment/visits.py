"""The pyramid levels that a search visits, and the frames' data on each."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from gavo_jax.camera import Camera
from gavo_jax.image.levels import ImagePlane, Levels
from gavo_jax.image.pyramid import Pyramid, make_atlas
from gavo_jax.image.sampling import Target, pack_target
from gavo_jax.objective.points import Reference, make_references
from gavo_jax.settings import AlignmentOptions
from gavo_jax.solvers.base import Solver


class Exchanged(NamedTuple):
    """A pair of frames with their roles exchanged, for the symmetric error."""

    references: Reference
    """Points of the target frame; see `make_references`."""
    target: Target
    """The anchor's frame; see `prepare_target`."""


def levels_of(camera: Camera, solver: Solver, options: AlignmentOptions) -> Levels:
    """Return the levels that a solver searches, with the options' numbers of points."""
    return Levels.of(camera, solver.levels, options.points)


def prepare_target(pyramid: Pyramid, levels: Levels) -> Target:
    """Pack a target frame's levels for sampling, coarsest first."""
    return pack_target(make_atlas([pyramid[number] for number in levels.numbers]))


def prepare_pair(
    reference: Pyramid, target: Pyramid, camera: Camera, levels: Levels, options: AlignmentOptions
) -> tuple[Reference, Target, Exchanged | None]:
    """Prepare two frames for a search: reference points, packed target, and both exchanged if it is symmetric."""
    view = make_references(reference, camera, levels)
    exchanged = None
    if options.symmetric:
        exchanged = Exchanged(make_references(target, camera, levels), prepare_target(reference, levels))
    return view, prepare_target(target, levels), exchanged


class Level(NamedTuple):
    """Data of one level; with a leading axis L, the input of the scan over the levels."""

    number: Integer[Array, ""]
    """Number of the pyramid's level; 0 is the full image."""
    is_first: Bool[Array, ""]
    plane: ImagePlane
    reference: Reference
    """[V, N]: the points of all views as rays of the anchor camera."""
    points: Integer[Array, ""]
    """Number of points of a view on this level; the arrays are empty beyond."""
    columns: Integer[Array, ""]
    """Number of points of a view in one row."""
    views: Integer[Array, ""]
    """Number of views that count; the points of the others have no readings."""
    islands: Integer[Array, ""]
    """Number of independent populations; 0 skips the level, in searches that can skip some."""
    depth_weight: Float[Array, ""]
    """Weight of the depth cost."""
    exchanged: Reference | None = None
    """[1, N]: the target's points, where the error is symmetric."""
    readout: Float[Array, ""] | None = None
    """Share of the motion that passes during a rolling shutter's readout; see `Objective`."""

    @property
    def is_undecided(self) -> Bool[Array, ""]:
        """Whether the level's initial motion may be far off: nothing is aligned yet, or several motions compete."""
        return self.is_first | (self.islands > 1)

    def with_parts_exchanged(self) -> "Level":
        """Return the level of the target's points, for the symmetric error; the readout changes its sign."""
        readout = None if self.readout is None else -self.readout
        return self._replace(reference=self.exchanged, exchanged=None, readout=readout)


def stack_levels(
    views: tuple[Reference, ...],
    camera: Camera,
    levels: Levels,
    options: AlignmentOptions,
    exchanged: Exchanged | None = None,
    readout: Float[Array, ""] | None = None,
) -> Level:
    """Stack the data of the levels that a search visits, [L], coarsest first."""
    numbers, count = levels.numbers, len(levels.numbers)
    rows, columns = np.array(levels.grids).T
    counted = jnp.array([min(options.views[number], len(views)) for number in numbers])
    reference: Reference = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *views)
    left_out = jnp.arange(len(views))[:, None] >= counted[:, None, None]
    points = reference.points._replace(q=jnp.where(left_out, 0.0, reference.points.q))
    return Level(
        number=jnp.array(numbers),
        is_first=jnp.arange(count) == 0,
        plane=levels.planes(camera),
        reference=reference._replace(points=points),
        points=jnp.array(rows * columns),
        columns=jnp.array(columns),
        views=counted,
        islands=jnp.array([options.islands[number] for number in numbers]),
        depth_weight=jnp.stack([jnp.float32(options.depth_weight[number]) for number in numbers]),
        exchanged=None if exchanged is None else jax.tree.map(lambda leaf: leaf[:, None], exchanged.references),
        readout=None if readout is None else jnp.full(count, readout),
    )


def reach_of(options: AlignmentOptions) -> Float[Array, " 2"]:
    """Return the largest distance from the search's centre on every level: metres and radians."""
    return jnp.stack([jnp.float32(half) for half in options.bounds])


def visited_levels(numbers: tuple[int, ...], options: AlignmentOptions) -> tuple[int, ...]:
    """Return the levels that a solver searches, coarsest first; with `refine` only those where islands compete."""
    competing = tuple(number for number in numbers if options.islands[number] > 1)
    return competing if options.refine and competing else numbers
