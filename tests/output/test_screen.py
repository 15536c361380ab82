"""Tables on the screen."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from gavo_jax.alignment.result import no_alignment
from gavo_jax.cli.run_table import print_run
from gavo_jax.odometry.driver import Step
from gavo_jax.output.bodies import BODY_COLUMNS
from gavo_jax.output.frames import FRAME_COLUMNS, frame_row
from gavo_jax.output.screen import known_columns, markdown_table, number, print_table, say
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory


def boxes(printed: str) -> list[list[list[str]]]:
    """The cells of each table that was printed, row by row, the heading first."""
    tables: list[list[list[str]]] = []
    for line in printed.splitlines():
        if line.startswith("┏"):
            tables.append([])
        elif line[:1] in "┃│":
            tables[-1].append([cell.strip() for cell in line.replace("┃", "│").split("│")[1:-1]])
    return tables


def test_columns_that_find_no_room_follow_below(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    columns = ("method", "alpha", "beta", "gamma", "delta")
    print_table("t", columns, [("genetic", "1.000", "2.000", "3.000", "4.000")])
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 40
    first, second = boxes(printed)
    assert first == [["method", "alpha", "beta", "gamma"], ["genetic", "1.000", "2.000", "3.000"]]
    assert second == [["method", "delta"], ["genetic", "4.000"]]


def test_nothing_is_cut(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    print_table("t", ("", "x" * 30), [("a", 1)])
    assert boxes(capsys.readouterr().out) == [[["", "x" * 30], ["a", "1"]]]


def test_a_table_of_one_column_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("t", ("method",), [("ga",), ("pso",)])
    assert boxes(capsys.readouterr().out) == [[["method"], ["ga"], ["pso"]]]


def test_a_column_of_dashes_alone_is_left_out() -> None:
    rows = [["ga", number(None), number(1.0)], ["pso", number(None), number(None)]]
    assert known_columns(("method", "m/s", "ms"), rows) == (["method", "ms"], [["ga", "1.0000"], ["pso", "–"]])
    assert known_columns(("method", "m/s"), []) == (["method", "m/s"], [])


@pytest.mark.parametrize("shares", [[], ["0.25", "0.125", "0.125"]])
def test_a_run_tells_of_the_bodies_it_saw(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shares: list[str]
) -> None:
    """Those of one frame together, and of none nothing."""
    Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))).write_tum(tmp_path / "trajectory.txt")
    stamps, numbers = ("0.0", "0.5", "0.5"), ("1", "1", "2")
    rows = [(stamp, number, share) for stamp, number, share in zip(stamps, numbers, shares, strict=False)]
    lines = [",".join([*row, *["0"] * 9, "seen"]) for row in rows]
    (tmp_path / "bodies.csv").write_text("\n".join([",".join(BODY_COLUMNS), *lines]) + "\n")
    print_run("run", {}, tmp_path, Trajectory.read_tum(tmp_path / "trajectory.txt"), truth=None)
    [table] = boxes(capsys.readouterr().out)
    told = {row[0]: row[1] for row in table}
    if shares:
        assert (told["bodies that moved"], told["frames that show one"], told["largest share of an image"]) == (
            "2",
            "2",
            "25",
        )
    else:
        assert "bodies that moved" not in told


def test_a_run_tells_whether_images_or_depth_were_frozen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))).write_tum(tmp_path / "trajectory.txt")
    frozen, ok = AlignmentStatus.FROZEN, AlignmentStatus.OK
    with (tmp_path / "frames.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(FRAME_COLUMNS)
        pairs = (frozen, np.nan), (ok, 4.5), (frozen, 4.5), (frozen, np.nan)
        for index, (status, error) in enumerate(pairs, start=1):
            alignment = no_alignment(status)._replace(error=np.float32(error))
            rows.writerow(frame_row(Step(index, 0.0, 1.0, alignment, np.eye(4), 1.0, False)))
    print_run(
        "run",
        {"statuses": {"frozen": 3, "ok": 1, "gap": 1}},
        tmp_path,
        Trajectory.read_tum(tmp_path / "trajectory.txt"),
        truth=None,
    )
    [table] = boxes(capsys.readouterr().out)
    told = {row[0]: row[1] for row in table if row[0].startswith("pairs:")}
    assert told == {
        "pairs: frozen, the image repeats": "2",
        "pairs: frozen, the depth repeats": "1",
        "pairs: gap": "1",
    }


@pytest.mark.parametrize("segments", [(0, 0), (0, 1)])
def test_of_the_end_nothing_is_said_where_the_way_there_is_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], segments: tuple[int, int]
) -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    Trajectory(np.arange(2.0), poses, np.array(segments)).write_tum(tmp_path / "trajectory.txt")
    print_run("run", {}, tmp_path, Trajectory.read_tum(tmp_path / "trajectory.txt"), truth=None)
    assert ("end: turned by" in capsys.readouterr().out) == (segments == (0, 0))


@pytest.mark.parametrize(("ends", "words"), [(1.5, "covers 2 of 4 poses"), (3.0, None)])
def test_a_truth_of_part_of_the_poses_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], ends: float, words: str | None
) -> None:
    """The distance error at the end was that of another pose than the last one, without a word."""
    trajectory = Trajectory(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1)))
    stamps = np.linspace(0.0, ends, 31)
    truth = Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))
    print_run("run", {"distance_error_final_m": 0.0}, tmp_path, trajectory, truth=truth)
    printed = capsys.readouterr().out
    assert "of 4 poses" not in printed if words is None else words in printed


LONG = "clip: a folder of frames, 40 frames of 640x480; camera fx 517.3 fy 516.5 cx 318.6 cy 255.3 (file); depth in mm"


def test_lines_fit_a_terminal_and_stay_whole_for_programs(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    say(LONG)
    assert capsys.readouterr().out == LONG + "\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    path = "/" + "x" * 90
    say(LONG)
    say(f"files in {path}")
    printed = capsys.readouterr().out
    assert max(len(line) for line in printed.splitlines() if path not in line) <= 80
    assert " ".join(printed.split()) == f"{LONG} files in {path}"


def test_a_bar_in_a_name_does_not_split_a_markdown_row() -> None:
    assert r"| a\|b | 1 |" in markdown_table(["name", "n"], [["a|b", 1]])
