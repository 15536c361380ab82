"""loops.csv: one row per loop of a run."""

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax.mapping.mapper import Loops
from gavo_jax.mapping.pose_graph import COUNTED
from gavo_jax.output.files import LOOPS
from gavo_jax.output.frames import DEVIATIONS
from gavo_jax.trajectory import write_lines

LOOP_COLUMNS = (
    ("earlier", "later", "earlier_timestamp", "later_timestamp", "counted", "overlap")
    + tuple(f"residual_{name}" for name in ("vx", "vy", "vz", "wx", "wy", "wz"))
    + DEVIATIONS
    + ("disagreement_m", "disagreement_rad")
)
"""Columns of loops.csv: indices and timestamps (s) of both keyframes, whether the loop counts (0: it is false), and
their overlap. Then the residual between the alignment and the map and the alignment's standard deviations, both in the
later camera, and the difference between the alignments there and back; all in m and rad.
"""


def write_loops(folder: Path, loops: Loops) -> None:
    """Write loops.csv atomically.

    Raises:
        GavoError: It cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(LOOP_COLUMNS)
    for edge, weight, residual in zip(loops.edges, loops.solution.weights, loops.solution.residuals, strict=True):
        earlier, later = (loops.keyframes[number] for number in (edge.earlier, edge.later))
        row: list[Any] = [earlier.index, later.index, f"{earlier.timestamp:.6f}", f"{later.timestamp:.6f}"]
        row += [int(weight > COUNTED), f"{edge.overlap:.4f}"]
        numbers = [*residual, *np.sqrt(np.diag(edge.covariance)), *edge.disagreement]
        writer.writerow(row + [f"{number:.6g}" for number in numbers])
    write_lines(folder / LOOPS, text.getvalue().splitlines())
