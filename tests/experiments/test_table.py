"""The results table under several writers."""

import multiprocessing
import re
from pathlib import Path
from typing import Any

import pytest

from gavo_jax.cli import main
from gavo_jax.errors import GavoError
from gavo_jax.experiments.table import COLUMNS, FLAG, REAL, ROWS, TEXT, Table


def row(run: str, drift: float | None = 0.01) -> dict[str, Any]:
    values: dict[str, Any] = {name: {TEXT: "", REAL: 1.5, FLAG: True}.get(kind, 2) for name, kind in COLUMNS.items()}
    return values | {
        "run": run,
        "rpe_translation_rmse_m_per_s": drift,
        "configuration": {"a": [1, None]},
        "versions": {},
        "seed": None,
    }


def write_many(folder: Path, start: Any, name: str) -> None:
    start.wait()
    for i in range(40):
        Table(folder).append(row(f"{name}{i}"))
        Table(folder).append(row(f"shared{i}"))


def test_a_row_comes_back(tmp_path):
    table = Table(tmp_path)
    assert table.done() == set()
    table.append(row("b", None))
    table.append(row("a"))
    assert table.done() == {"a", "b"}
    rows = table.read()
    assert [found["run"] for found in rows] == ["a", "b"] and tuple(rows[0]) == tuple(COLUMNS)
    assert rows[1]["rpe_translation_rmse_m_per_s"] is None and rows[0]["seed"] is None
    assert rows[0]["configuration"] == '{"a": [1, null]}' and rows[0]["git_modified"] is True


def test_a_row_that_a_power_cut_left_empty_is_none(tmp_path):
    """The run counted as done, and its table could not be read."""
    table = Table(tmp_path)
    table.append(row("a"))
    (table.folder / "b.parquet").write_bytes(b"")
    assert table.done() == {"a"} and [found["run"] for found in table.read()] == ["a"]
    table.append(row("b"))
    assert table.done() == {"a", "b"}


def test_two_writers_lose_nothing_and_double_nothing(tmp_path):
    context = multiprocessing.get_context("spawn")
    start = context.Event()
    writers = [context.Process(target=write_many, args=(tmp_path, start, name)) for name in "xy"]
    for writer in writers:
        writer.start()
    start.set()
    for writer in writers:
        writer.join(60)
        assert writer.exitcode == 0
    runs = [found["run"] for found in Table(tmp_path).read()]
    assert len(runs) == len(set(runs)) == 120
    assert not [path for path in Table(tmp_path).folder.iterdir() if path.suffix != ".parquet"]


def test_a_torn_file_is_named_and_a_partial_one_is_no_row(tmp_path):
    table = Table(tmp_path)
    table.append(row("a"))
    (table.folder / ".b.partial").write_bytes(b"PAR1")
    assert len(table.read()) == 1
    whole = (table.folder / "a.parquet").read_bytes()
    (table.folder / "a.parquet").write_bytes(whole[:100])
    with pytest.raises(GavoError, match="a.parquet"):
        table.read()


def test_no_table(tmp_path):
    """The message named a folder that is not there."""
    where = re.escape(str(tmp_path))
    with pytest.raises(GavoError, match=f"^{where}: no experiment results: no folder runs in it$"):
        Table(tmp_path).read()
    (tmp_path / ROWS).mkdir()
    with pytest.raises(GavoError, match=f"^{where}: no experiment results: no rows in its folder runs$"):
        Table(tmp_path).read()
    Table(tmp_path).append(row("a"))
    with pytest.raises(GavoError, match=f"^{where}/runs: no experiment results: pass the folder above it$"):
        Table(tmp_path / ROWS).read()


def test_any_parquet_reader_sees_one_table(tmp_path):
    dataset = pytest.importorskip("pyarrow.dataset")
    for run in "abc":
        Table(tmp_path).append(row(run))
    (Table(tmp_path).folder / ".d.partial").write_bytes(b"")
    assert dataset.dataset(Table(tmp_path).folder).to_table().num_rows == 3


FOREIGN = {
    "other columns": {"a": [1, 2]},
    "no column at all": {},
    "two rows": {name: [value, value] for name, value in {**row("x"), "configuration": "{}", "versions": "{}"}.items()},
    "another run": {name: [value] for name, value in {**row("y"), "configuration": "{}", "versions": "{}"}.items()},
    "other types": {name: ["text"] for name in COLUMNS},
    "no object": {name: [value] for name, value in {**row("x"), "configuration": "[]", "versions": "{}"}.items()},
    "no JSON": {name: [value] for name, value in {**row("x"), "configuration": "{", "versions": "{}"}.items()},
    "no time": {
        name: [value]
        for name, value in {**row("x"), "configuration": "{}", "versions": "{}", "frames_per_second": 0.0}.items()
    },
}


@pytest.mark.parametrize("columns", FOREIGN.values(), ids=FOREIGN.keys())
def test_a_foreign_file_is_named_in_one_line(tmp_path, columns, capsys):
    """Whatever it holds, a Parquet file that is no row of a run is neither reported nor a traceback."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    Table(tmp_path).append(row("a"))
    parquet.write_table(arrow.table(columns), Table(tmp_path).folder / "x.parquet")
    assert main(["experiment", "report", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "x.parquet: not a row of results" in error
