"""The aligner that settings ask for: the search, and the second thoughts that wrap it."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, TypeVar

from jaxtyping import PRNGKeyArray

from gavo_jax import presets
from gavo_jax.bodies.aligner import BodyAware
from gavo_jax.bodies.rival import WithRival
from gavo_jax.camera import Camera
from gavo_jax.image.pyramid import LEVELS
from gavo_jax.odometry.aligners import Aligner, FrameSearch, Search, side_by_side
from gavo_jax.odometry.relighting import Relighting
from gavo_jax.odometry.second_thoughts import DoubtingDepth, Polished, Recovering
from gavo_jax.settings import Settings

AlignerKind = TypeVar("AlignerKind", bound=Aligner)


def wide_search(search: Search) -> Search:
    """The wide search on the points of a search's references, against the previous frame only."""
    settings, wide = search.settings, presets.preset("ga", "wide")
    genetic: Any = wide.solver
    places = [max(level, genetic.levels[-1]) for level in range(LEVELS)]  # a level left out takes the next one's
    iterations, population = ([schedule[k] for k in places] for schedule in (genetic.iterations, genetic.population))
    iterations = tuple(count if k in settings.solver.levels else 0 for k, count in enumerate(iterations))
    wide = Settings(
        replace(genetic, iterations=iterations, population=tuple(population)),
        replace(wide.alignment, points=settings.alignment.points),
        replace(settings.odometry, reference="previous"),
    )
    return replace(search, settings=wide)


def make_aligner(camera: Camera, settings: Settings, key: PRNGKeyArray, record: bool = False) -> Aligner:
    """The aligner that the settings describe."""
    search = Search(camera, settings, key, record)
    return with_recovery(search, search)


def with_recovery(aligner: Aligner, search: Search) -> Aligner:
    """Wrap an aligner in the second thoughts that the search's settings ask for.

    These treat changed light, moving bodies and depth that disagrees with the image; the wide search is the fallback.
    """
    first, careful_search = with_light(aligner, search), with_light(search, search)
    if not search.settings.odometry.recover:
        return with_bodies(first, careful_search)
    careful = DoubtingDepth(with_bodies(first, careful_search), with_bodies(careful_search, careful_search))
    wide = wide_search(search)
    behind = with_bodies(Polished(wide, search), wide)
    # loading it takes seconds: a short run should save them, and a long one should not pause for them
    return Recovering(careful, behind, wide, is_loaded=search.settings.odometry.loops)


def warm_up_wholly(aligner: Any) -> float:
    """Compile what any pair may need, doubtful ones included, however the aligner is wrapped.

    Returns:
        The seconds this took.
    """
    second = [layer.warm_up_second for layer in _layers(aligner) if hasattr(layer, "warm_up_second")]
    return side_by_side(aligner.warm_up, lambda: [warm_up() for warm_up in second])


def blank_of(aligner: Any) -> Any:
    """The blank state of an aligner, however it is wrapped, in the shapes and types of every state."""
    return next(layer for layer in _layers(aligner) if hasattr(layer, "blank_state")).blank_state()


def _layers(aligner: Any) -> Iterator[Any]:
    """An aligner, the one that it wraps, and so on."""
    while aligner is not None:
        yield aligner
        aligner = getattr(aligner, "first", None)


def with_light(aligner: AlignerKind, search: FrameSearch) -> AlignerKind | Relighting:
    """Wrap an aligner to adapt to local changes of light, where the search's settings ask for that."""
    return Relighting(aligner, search) if search.settings.odometry.relight else aligner


def with_bodies(aligner: Aligner, search: FrameSearch) -> Aligner:
    """Wrap an aligner to leave out what moves on its own, where the search's settings ask for that."""
    if search.settings.odometry.bodies == "off":
        return aligner
    return WithRival(BodyAware(aligner, search))
