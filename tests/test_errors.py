"""Files that are written whole or not at all."""

import math
import pickle

import pytest

from gavo_jax.errors import PARTIAL, GavoError, number, printable, write_bytes


def test_a_planted_link_is_not_followed(tmp_path):
    foreign = tmp_path / "foreign.txt"
    foreign.write_text("somebody else's")
    (tmp_path / ("metrics.json" + PARTIAL)).symlink_to(foreign)
    write_bytes(tmp_path / "metrics.json", b"{}")
    assert foreign.read_text() == "somebody else's"
    assert (tmp_path / "metrics.json").read_bytes() == b"{}" and not (tmp_path / "metrics.json").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["foreign.txt", "metrics.json"]


def test_what_a_kill_left_is_replaced(tmp_path):
    (tmp_path / ("rows.txt" + PARTIAL)).write_bytes(b"half")
    write_bytes(tmp_path / "rows.txt", b"whole")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("rows.txt", b"whole")]


def test_a_folder_in_the_way_is_one_line(tmp_path):
    (tmp_path / ("rows.txt" + PARTIAL)).mkdir()
    with pytest.raises(GavoError, match="rows.txt: cannot be written: ") as fault:
        write_bytes(tmp_path / "rows.txt", b"whole")
    assert "\n" not in str(fault.value) and not (tmp_path / "rows.txt").exists()


@pytest.mark.parametrize(
    "text", ["\x1b[31m", "\x9b31m", "\x07", "a\nb", "\u202eevil", "\udcff", "\x7f", "\u2028", "\x00"]
)
def test_what_would_command_a_terminal_is_shown_as_code(text):
    shown = printable(text)
    assert shown.isprintable() and "\\" in shown
    assert str(GavoError(f"{text}: not a file")).isprintable()


def test_words_of_any_language_stay_as_they_are():
    for text in ("Bäume/日本語/πλάτος", "C:\\new\\x1b", "a b", ""):
        assert printable(text) == text


@pytest.mark.parametrize("text", ["1.#INF", "-1.#INF00", "1.#QNAN", "-1.#IND0", "1.#J", "1.#SNAN000"])
def test_no_number_may_be_written_as_windows_does(text):
    assert math.isnan(number(text))


@pytest.mark.parametrize("text", ["#", "1#", "2.#INF", "1.#", "1.#inf", "1.#INF1", "1_0", "\u0661", ""])
def test_what_is_no_number_is_not_taken_for_one(text):
    with pytest.raises(ValueError):
        number(text)


def test_the_message_outlives_a_process_border():
    fault = GavoError("a\x1bb:  twice\nas long")
    assert str(fault) == "a\\x1bb: twice as long" == str(pickle.loads(pickle.dumps(fault)))
