"""loops.csv: the loops of a run, one row each."""

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
"""Indices and stamps of the two frames, whether the loop counts (0: it was found to be wrong), the overlap of the two,
what is left between the alignment and the map (m, rad, in the later camera), the standard deviations that it was
weighted with, and how far the alignments there and back were apart."""


def write_loops(folder: Path, loops: Loops) -> None:
    """Write loops.csv, whole or not at all.

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
