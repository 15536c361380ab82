"""Files that are written whole or not at all."""

import math
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import gavo_jax as gavo
from gavo_jax.errors import PARTIAL, GavoError, number, partial_of, printable, write_bytes
from gavo_jax.output.files import remove_files


def test_a_planted_link_is_not_followed(tmp_path):
    foreign = tmp_path / "foreign.txt"
    foreign.write_text("somebody else's")
    partial_of(tmp_path / "metrics.json").symlink_to(foreign)
    write_bytes(tmp_path / "metrics.json", b"{}")
    assert foreign.read_text() == "somebody else's"
    assert (tmp_path / "metrics.json").read_bytes() == b"{}" and not (tmp_path / "metrics.json").is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["foreign.txt", "metrics.json"]


def test_what_an_interruption_cut_short_goes(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_bytes(tmp_path / "camera.toml", b"")
    assert not list(tmp_path.iterdir())


def test_what_a_kill_left_is_replaced(tmp_path):
    partial_of(tmp_path / "rows.txt").write_bytes(b"half")
    write_bytes(tmp_path / "rows.txt", b"whole")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("rows.txt", b"whole")]


def test_what_a_kill_left_goes_with_the_file_that_it_was_of(tmp_path):
    for name in ("rows.txt", f"rows.txt.123-4{PARTIAL}", f"other.txt.123-4{PARTIAL}"):
        (tmp_path / name).write_bytes(b"half")
    remove_files(tmp_path, "rows.txt")
    assert [path.name for path in tmp_path.iterdir()] == [f"other.txt.123-4{PARTIAL}"]


def test_several_threads_write_one_file(tmp_path):
    """Each one removed what the other one was writing: a third of them failed."""
    path = tmp_path / "rows.txt"
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda k: write_bytes(path, b"%d" % k * 10_000), [k % 10 for k in range(200)]))
    assert len(set(path.read_bytes())) == 1 and [file.name for file in tmp_path.iterdir()] == ["rows.txt"]


def test_a_folder_in_the_way_is_one_line(tmp_path):
    partial_of(tmp_path / "rows.txt").mkdir()
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


TAKERS = {
    "open_source": gavo.open_source,
    "TumSequence": gavo.TumSequence,
    "load_settings": gavo.load_settings,
    "save_settings": lambda path: gavo.save_settings(path, gavo.preset("ga")),
    "load_calibration": gavo.load_calibration,
    "load_camera": gavo.load_camera,
    "read_tum": gavo.Trajectory.read_tum,
    "write_trajectory": lambda path: gavo.write_trajectory(gavo.Trajectory(np.zeros(1), np.eye(4)[None]), path, "tum"),
    "write_tum": lambda path: gavo.write_tum(gavo.SyntheticSequence(1), path),
    "enable_compilation_cache": gavo.enable_compilation_cache,
}


@pytest.mark.parametrize("wrong", [3, b"x", ["a"], np.zeros(2)], ids=str)
@pytest.mark.parametrize("taker", TAKERS)
def test_what_is_no_path_is_one_line(taker, wrong):
    """It was a TypeError of pathlib's."""
    with pytest.raises(GavoError, match="expected the path of a file or folder, got "):
        TAKERS[taker](wrong)
