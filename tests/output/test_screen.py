"""Tables on the screen."""

import pytest

from gavo_jax.output.screen import known_columns, number, print_table


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


def test_a_column_of_dashes_alone_is_left_out() -> None:
    rows = [["ga", number(None), number(1.0)], ["pso", number(None), number(None)]]
    assert known_columns(("method", "m/s", "ms"), rows) == (["method", "ms"], [["ga", "1.0000"], ["pso", "–"]])
    assert known_columns(("method", "m/s"), []) == (["method", "m/s"], [])
