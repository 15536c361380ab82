"""Named settings: what `--method` and `--preset` stand for, and registration of custom methods."""

import re
from functools import cache
from importlib.metadata import entry_points
from typing import Any

import jax
import numpy as np

from gavo_jax.errors import GavoError, blamed
from gavo_jax.objective.losses import l2
from gavo_jax.settings import AlignmentOptions, OdometryOptions, Settings, as_settings
from gavo_jax.solvers.base import Solver
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.solvers.genetic import GeneticAlgorithm
from gavo_jax.solvers.gradient import GradientDescent
from gavo_jax.solvers.particle_swarm import ParticleSwarm

METHODS = ("ga", "pso", "gauss-newton", "adam")
PRESETS = ("default", "paper", "fast", "wide")
PLUGINS = "gavo_jax.solvers"
"""Group of entry points through which packages provide settings or solvers, by method name."""


PAPER_OBJECTIVE = AlignmentOptions(
    loss=l2,
    depth=False,
    brightness=False,
    robust_scale=False,
    last_step=False,
    precondition=False,
    points=None,
    min_overlap=0.5,
    bounds=(0.06, 0.06),
    bounds_factor=0.5,
)
"""The paper's error on every pixel, searched in ξ itself. Two choices are not given in the paper. A candidate must keep
half of the points in view. The bounds are ±6 cm and ±0.06 rad (3.4°) per gene about the guess at level 4, halved at
each finer level about the last level's best."""
HALF_SIZE_OBJECTIVE = AlignmentOptions(
    points=(4800, 1200, 1200, 1200, 1200), depth_weight=(0.05, 0.05, 0.3, 0.3, 0.3), views=(1, 1, 1, 1, 1)
)
"""For pairs of images of half the size, without a third view. A level is the next coarser one of the whole images, so
that level 0 is the odometry's finest."""


def _paper_solver(method: str) -> Any:
    """Return a method's solver as in the paper, on pyramid levels 4 to 0.

    Not given in the paper: 40 chromosomes; 40 generations at level 4 falling to 8 at level 0; 8 generations without
    progress end a level; half-width 0.25 of the crossover's extra range. The swarm gets as many evaluations.
    """
    population, iterations, patience = (40,) * 5, (8, 12, 20, 30, 40), 8
    if method == "ga":
        return GeneticAlgorithm(
            population=population,
            iterations=iterations,
            patience=patience,
            surrogate=False,
            spread=None,
            mutation_step=None,
            mutation_decay=1.0,
        )
    if method == "pso":
        return ParticleSwarm(population=population, iterations=iterations, patience=patience, spread=None)
    if method == "gauss-newton":
        return GaussNewton(iterations=(10, 10, 15, 20, 20))
    return GradientDescent(
        iterations=(20, 30, 40, 50, 60), learning_rate=(0.0005, 0.001, 0.002, 0.004, 0.008), decay=0.95
    )


_DEFAULT = {"ga": GeneticAlgorithm(), "pso": ParticleSwarm(), "gauss-newton": GaussNewton(), "adam": GradientDescent()}

_FAST = {
    "ga": GeneticAlgorithm(
        population=(0, 16, 16, 24, 48),
        iterations=(0, 3, 5, 7, 10),
        patience=2,
        progress=(0.003, 0.01, 0.03, 0.03, 0.03),
    ),
    "pso": ParticleSwarm(population=(0, 12, 16, 20, 32), iterations=(0, 8, 10, 12, 16)),
    "gauss-newton": GaussNewton(iterations=(0, 6, 8, 10, 12), patience=2),
    "adam": GradientDescent(iterations=(0, 15, 20, 30, 40)),
}

_FAST_POINTS = (4800, 4800, 1200, 1200, 1200)
"""The finest level decides the accuracy; on the coarser ones a quarter of its points are enough."""

_WIDE = {
    "ga": GeneticAlgorithm(
        population=(0, 16, 20, 24, 16),
        iterations=(0, 12, 12, 10, 12),
        spread=(0.5, 0.5, 1.0, 3.0, 15.0),
        mutation_step=(1.0, 1.0, 2.0, 5.0, 15.0),
    ),
    "pso": ParticleSwarm(population=(0, 20, 24, 24, 16), iterations=(0, 12, 14, 16, 20)),
    "gauss-newton": GaussNewton(),
    "adam": GradientDescent(),
}
WIDE_OBJECTIVE = AlignmentOptions(
    centred=True,
    symmetric=True,
    refine=True,
    features="both",
    points=19200,
    estimation_points=None,
    depth_weight=(0.1, 0.1, 1.0, 0.3, 0.3),
    doubt_depth=True,
    islands=(1, 1, 1, 16, 96),
    scouts=8192,
    scout_spread=(0.2, 0.5),
    min_overlap=0.2,
    outside_cost=1.0,
    bounds=(1.0, 1.7),
)
"""For motions of up to 1 m and 97° from the guess. Thousands of scouts start 96 populations at level 4. The 16 with the
most evidence go on to level 3 and 4 are refined, beside the motions that a single pair's features suggest. A point out
of view costs as much as a typical one in view, so that leaving the view is neither rewarded nor punished. Exposure
changes over such motions, so residuals are taken about their mean. Close to a mode grey alone separates motions badly,
so depth counts as much; at the finest levels, which decide the accuracy, a tenth of that. Over a wide baseline one
frame may be blurred and each sees what the other doesn't, so both directions count, on more points than in tracking."""


_registered: dict[str, Settings] = {}


def register(method: str, settings: Settings | Solver) -> None:
    """Register a custom method by name, for `preset`, experiment files and the command line.

    An installed package needs no call: an entry point in the group `gavo_jax.solvers`, named after the method, leads to
    its settings or solver.

    Args:
        method: Small letters, digits and hyphens. Registering a name again replaces its settings.
        settings: Settings of its only preset, `default`; a solver stands for the default settings with that solver.

    Raises:
        GavoError: The name is a built-in method's or malformed, or `settings` is None.
    """
    if not isinstance(method, str) or method in METHODS or not re.fullmatch("[a-z][a-z0-9-]*", method):
        raise GavoError(f"{method!r} cannot be the name of a custom method")
    if settings is None:
        raise GavoError(f"{method}: expected settings or a solver, got None")
    _registered[method] = as_settings(settings)


def methods() -> tuple[str, ...]:
    """Return the names of all methods: `METHODS`, registered ones, and those of packages that cannot be loaded."""
    known = usable_methods()
    return (*known, *(name for name in faulty_plugins() if name not in known))


def usable_methods() -> tuple[str, ...]:
    """Return the methods that have settings: `methods()` without those of packages that cannot be loaded."""
    faulty_plugins()
    return (*METHODS, *_registered)


def plugin_names() -> tuple[str, ...]:
    """Return the names of the methods that installed packages provide, without loading their code."""
    return tuple(sorted(entry.name for entry in entry_points(group=PLUGINS)))


@cache
def faulty_plugins() -> dict[str, str]:
    """Register the methods of installed packages; return why some cannot be loaded, by the method's name."""
    faults = {}
    for entry in entry_points(group=PLUGINS):
        try:
            with blamed(f"method {entry.name!r} of {entry.value}: cannot be loaded"):
                register(entry.name, entry.load())
        except GavoError as error:
            faults[entry.name] = str(error)
    return faults


def preset(method: str = "ga", name: str = "default") -> Settings:
    """Return the settings of a method's preset.

    Args:
        method: One of `methods()`.
        name: One of `PRESETS`; a registered method has `default` alone.
            `default`: preconditioned coordinates, robust grey and depth error, levels 4 to 1.
            `paper`: as printed, levels 4 to 0, frame to frame. `fast`: fewer pixels and candidates. `wide`: many
            independent populations at the coarsest level, for motions of tens of degrees.

    Raises:
        GavoError: An unknown method or preset, or a method of a package that cannot be loaded.
    """
    if not isinstance(method, str) or method not in methods():
        raise GavoError(f"unknown method {method!r}: not one of {', '.join(usable_methods())}")
    if method in _registered:
        if name != "default":
            raise GavoError(f"method {method!r} has no preset {name!r}, only default")
        return _registered[method]
    if method not in METHODS:
        raise GavoError(faulty_plugins()[method])
    if not isinstance(name, str) or name not in PRESETS:
        raise GavoError(f"unknown preset {name!r}: not one of {', '.join(PRESETS)}")
    return _own(method, name)


def names_of(settings: Settings) -> tuple[str | None, str | None]:
    """Return the method and the preset of settings; the inverse of `preset`.

    Settings that differ from every preset have no preset, and the method of their solver. A custom solver that was not
    registered has no method either.
    """
    known = {(method, name): _own(method, name) for method in METHODS for name in PRESETS}
    known |= {(method, "default"): own for method, own in _registered.items()}
    for names, one in known.items():
        if are_same(one, settings):
            return names
    return next((method for method in METHODS if type(settings.solver) is type(_DEFAULT[method])), None), None


def are_same(one: Settings, other: Settings) -> bool:
    """Whether settings are equal, including arrays in them."""
    leaves, others = jax.tree.leaves(one), jax.tree.leaves(other)
    return jax.tree.structure(one) == jax.tree.structure(other) and all(map(np.array_equal, leaves, others))


def _own(method: str, name: str) -> Settings:
    """The settings of one of `METHODS` by one of `PRESETS`."""
    if name == "paper":
        return Settings(
            _paper_solver(method),
            PAPER_OBJECTIVE,
            OdometryOptions(
                reference="previous",
                prior=False,
                synchronise=False,
                rolling_shutter=False,
                relight=False,
                recover=False,
                bodies="off",
            ),
        )
    if name == "default":
        return Settings(_DEFAULT[method], AlignmentOptions(), OdometryOptions())
    if name == "fast":
        return Settings(_FAST[method], AlignmentOptions(points=_FAST_POINTS), OdometryOptions())
    return Settings(_WIDE[method], WIDE_OBJECTIVE, OdometryOptions())
