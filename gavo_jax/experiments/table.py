"""The results table: a folder of Parquet files, one row per run.

A run's file is named after the run's hash, written under a temporary name and then renamed. So a row is never partly
written, concurrent writers need no lock, and a run that is done twice is in the table once.
"""

import json
import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_type_hints

from gavo_jax.errors import GavoError
from gavo_jax.odometry.metrics import FRAMES_PER_SECOND, Metrics
from gavo_jax.output.files import prepare_folder

SUFFIX = ".parquet"
ROWS = "runs"
"""Name of the table's folder within an experiment's folder."""

TEXT, WHOLE, REAL, FLAG = "string", "int64", "float64", "bool"
COLUMN_OF = {str: TEXT, int: WHOLE, float: REAL, float | None: REAL}
"""Column type by the Python type of a figure."""
COLUMNS = {
    "run": TEXT,
    "experiment": TEXT,
    "sequence": TEXT,
    "method": TEXT,
    "preset": TEXT,
    "variant": TEXT,
    "label": TEXT,
    "seed": WHOLE,
    **{name: COLUMN_OF[kind] for name, kind in get_type_hints(Metrics).items() if kind in COLUMN_OF},
    "runs_together": WHOLE,
    "pixels": WHOLE,
    "configuration": TEXT,
    "versions": TEXT,
    "git_commit": TEXT,
    "git_modified": FLAG,
    "host": TEXT,
    "finished": TEXT,
}
"""Columns and their types. The metrics are those of metrics.json; `runs_together` is the number of runs that shared the
machine while it was timed. `configuration` and `versions` are JSON; `git_commit` is that of the package's own checkout,
if it is in one; `finished` is in UTC."""


MAPPINGS = ("configuration", "versions")
NON_NULL = ("sequence", "method", "label", "lost_pairs", FRAMES_PER_SECOND, "runs_together", "pixels", *MAPPINGS)
"""Columns that have a value in every row."""


class Table:
    """The results table in an experiment's folder."""

    def __init__(self, folder: str | Path) -> None:
        """Set the experiment's folder, without creating anything."""
        self.folder = Path(folder) / ROWS

    def done(self) -> set[str]:
        """Return the hashes of the runs in the table."""
        files = (path for path in self.folder.glob(f"*{SUFFIX}") if not path.name.startswith("."))
        return {path.stem for path in files if path.stat().st_size}

    def require_library(self) -> None:
        """Check that rows can be read and written, before anything runs.

        Raises:
            GavoError: pyarrow is missing.
        """
        _parquet()

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row atomically, replacing any row of the same run.

        Args:
            row: A value or None for each of `COLUMNS`; mappings become JSON.

        Raises:
            GavoError: The table cannot be written, or pyarrow is missing.
        """
        parquet, schema = _parquet(), _schema()
        prepare_folder(self.folder)
        values = {name: [json.dumps(v) if isinstance(v := row[name], Mapping) else v] for name in COLUMNS}
        partial = self.folder / f".{uuid.uuid4().hex}.partial"
        try:
            parquet.write_table(
                _arrow().table(values, schema=schema), partial, use_dictionary=False, write_statistics=False
            )
            with partial.open("rb+") as file:  # else a power cut may leave the name of an empty file
                os.fsync(file.fileno())
            os.replace(partial, self.folder / f"{row['run']}{SUFFIX}")
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise GavoError(f"{self.folder}: cannot be written to: {error.strerror or error}") from None

    def read(self) -> list[dict[str, Any]]:
        """Return all rows, ordered by hash.

        Raises:
            GavoError: There is no table, one of its files is damaged, or pyarrow is missing.
        """
        parquet = _parquet()
        if not self.done():
            raise GavoError(f"{self.folder.parent}: no experiment results: {self._lacking()}")
        rows = []
        for run in sorted(self.done()):
            path = self.folder / f"{run}{SUFFIX}"
            try:
                found = parquet.read_table(path, schema=_schema(), partitioning=None).to_pylist()
            except (OSError, KeyError, TypeError, ValueError, _arrow().ArrowException) as error:
                raise GavoError(f"{path}: not a row of results: {' '.join(str(error).split())[:300]}") from None
            if fault := _fault(found, run):
                raise GavoError(f"{path}: not a row of results: {fault}")
            rows += found
        return rows

    def _lacking(self) -> str:
        """Say why there are no rows."""
        if self.folder.is_dir():
            return f"no rows in its folder {ROWS}"
        return "pass the folder above it" if Table(self.folder.parent.parent).done() else f"no folder {ROWS} in it"


def _fault(rows: list[dict[str, Any]], run: str) -> str:
    """Describe what is wrong with the rows of a run's file; empty if nothing is."""
    if len(rows) != 1:
        return f"{len(rows)} rows"
    (row,) = rows
    if row["run"] != run:
        return "belongs to another run than its name says"
    for name in NON_NULL:
        if row[name] is None:
            return f"{name} is missing"
    if not row[FRAMES_PER_SECOND] > 0:
        return f"{FRAMES_PER_SECOND} of {row[FRAMES_PER_SECOND]}"
    for name in MAPPINGS:
        try:
            value = json.loads(row[name])
        except (ValueError, RecursionError):
            value = None
        if not isinstance(value, dict):
            return f"{name} is not a JSON object"
    return ""


def _arrow() -> Any:
    try:
        import pyarrow
    except ImportError:
        raise GavoError("results tables need pyarrow: pip install 'gavo-jax[experiments]'") from None
    return pyarrow


def _parquet() -> Any:
    _arrow()
    import pyarrow.parquet

    return pyarrow.parquet


def _schema() -> Any:
    arrow = _arrow()
    types = {TEXT: arrow.string(), WHOLE: arrow.int64(), REAL: arrow.float64(), FLAG: arrow.bool_()}
    return arrow.schema([(name, types[kind]) for name, kind in COLUMNS.items()])
