"""Solvers: one protocol, one loop, four methods; and what is needed to write another one."""

from gavo_jax.objective.problem import Problem as Problem
from gavo_jax.solvers.base import Best as Best
from gavo_jax.solvers.base import Bounds as Bounds
from gavo_jax.solvers.base import Candidates as Candidates
from gavo_jax.solvers.base import PerLevel as PerLevel
from gavo_jax.solvers.base import Schedule as Schedule
from gavo_jax.solvers.base import Solver as Solver
from gavo_jax.solvers.base import static as static
from gavo_jax.solvers.base import within as within
from gavo_jax.solvers.operators import initial_population as initial_population
