"""Times of numbered frames that a list beside the images states."""

import json
from pathlib import Path

import numpy as np
import pytest
from written_folders import CAMERA_TOML, GREYS, METRES, image, open3d, raw

from gavo_jax.datasets.files import FileSequence, Reading
from gavo_jax.datasets.registry import open_source
from gavo_jax.errors import GavoError

STEPS = np.array([0.0, 0.033, 0.1, 0.133])[: len(GREYS)]
"""Times of the frames, seconds: the second gap is that of a dropped frame."""


def folder_of(folder: Path, name: str = "{i:04d}.png") -> Path:
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(folder / "rgb" / name.format(i=i, t=1000 + i / 15), grey)
        image(folder / "depth" / name.format(i=i, t=1000 + i / 15), raw(metres, 1000))
    (folder / "camera.toml").write_text(CAMERA_TOML)
    return folder


def rows(form: str, scale: float = 1.0, start: float = 0.0) -> str:
    stamps = [(start + step) * scale for step in STEPS]
    return "".join(form.format(i=i, t=t, n=round(t)) + "\n" for i, t in enumerate(stamps))


@pytest.mark.parametrize("name", ["timestamps.txt", "timestamp.txt", "times.txt", "timestamps.csv", "rgb/times.txt"])
@pytest.mark.parametrize(
    "text",
    [
        rows("{t:.3f}"),
        rows("{t:.6e}"),  # KITTI's odometry
        rows("{t:.6f}", 1, 1.6e9),
        rows("{n}", 1e9, 1.6e9),
        rows("{n}", 1e3, 1.6e9),
        rows("{n}", 1e6, 12.0),
        rows("{i} {t:.3f}"),
        rows("{i:06d} {t:.3f}"),
        rows("{t:.3f} rgb/{i:04d}.png"),
        rows("{n},{i:04d}.png", 1e9, 1.6e9),
        "timestamp,file\n" + rows("{t:.3f},{i:04d}.png"),
        "#timestamp [ns],filename\n" + rows("{n},{i:04d}.png", 1e9, 1.6e9),  # EuRoC's
        "\n".join(reversed(rows("{i:04d} {t:.3f}").splitlines())),
        rows("{i:04d} {t:.3f}") + "0009 5.0\n",
        rows("2011-09-26 13:02:{t:.9f}", 1, 25.5),  # KITTI's raw data
    ],
)
def test_frames_have_the_times_of_the_list(tmp_path: Path, name: str, text: str) -> None:
    folder_of(tmp_path)
    (tmp_path / name).write_text(text)
    sequence = open_source(tmp_path)
    assert np.allclose(np.asarray(sequence.timestamps) - sequence.timestamps[0], STEPS, atol=2e-6)
    is_guess = text == rows("{n}", 1e6, 12.0)
    assert getattr(sequence, "times_guessed", "") == f"{Path(name).name} taken for microseconds" * is_guess
    assert not getattr(sequence, "left_out", [])


@pytest.mark.parametrize("start", [1e6, 3e9])
def test_slow_times_are_no_nanoseconds(tmp_path: Path, start: float) -> None:
    """Microseconds in steps of 2 s counted as nanoseconds, without a word; short numbers may be either."""
    folder_of(tmp_path)
    (tmp_path / "times.txt").write_text("".join(f"{start + 2e6 * i:.0f}\n" for i in range(len(GREYS))))
    sequence = open_source(tmp_path)
    assert isinstance(sequence, FileSequence)
    is_read = start > 1e9
    assert sequence.timestamps[1] - sequence.timestamps[0] == pytest.approx(2 if is_read else 1 / 30)
    assert sequence.times_guessed == ("times.txt taken for microseconds" if is_read else "names are numbers")
    assert ["its rows are no times of a known unit" in line for line in sequence.left_out] == [True] * (not is_read)


def test_numbers_that_count_neither_frames_nor_time_are_refused(tmp_path: Path) -> None:
    """At 30 frames per second, the frames were hours apart."""
    for i, (grey, metres) in enumerate(zip(GREYS, METRES, strict=True)):
        image(tmp_path / f"rgb/{20000000 + 1300017 * i}.png", grey)
        image(tmp_path / f"depth/{20000000 + 1300017 * i}.png", raw(metres, 1000))
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    with pytest.raises(GavoError, match=r"such as 20000000\.png, are 1300017 apart: .* in a timestamps\.txt"):
        open_source(tmp_path)
    assert len(open_source(tmp_path, Reading(rate=1e6))) == len(GREYS)
    (tmp_path / "timestamps.txt").write_text(rows("{t:.3f}"))
    np.testing.assert_allclose(open_source(tmp_path).timestamps, STEPS, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (rows("{t:.3f}") + "0.2\n", f"{len(GREYS) + 1} rows, but {len(GREYS)} colour images"),
        ("", f"0 rows, but {len(GREYS)} colour images"),
        (rows("{i}"), "its rows are no times of a known unit"),
        (rows("some {i} words {t:.3f}"), "its rows are no times"),
        (rows("1e999"), "its rows are no times of a known unit"),
        (rows("{i:04d} {t:.3f}", -1.0), "they do not increase from frame to frame"),
        (rows("rgb/{i:04d}.png {t:.3f}") + rows("depth/{i:04d}.png {t:.4f}"), "more than one row for an image"),
        (rows("{t:.3f}", 0.0), "they do not increase from frame to frame"),
        ("\n".join(rows("{i:04d} {t:.3f}").splitlines()[1:]), "no row for 0000.png"),
        (rows("9" * 5000), "its rows are no times of a known unit"),
    ],
)
def test_a_list_that_is_not_read_is_told(tmp_path: Path, text: str, why: str) -> None:
    folder_of(tmp_path)
    (tmp_path / "times.txt").write_text(text)
    sequence = open_source(tmp_path)
    told = f"times.txt: times are not read from it ({why}): name the images by them, or pass --rate"
    assert list(getattr(sequence, "left_out", [])) == [told]
    assert sequence.timestamps[1] - sequence.timestamps[0] == pytest.approx(1 / 30)


def test_a_rate_and_names_that_are_times_take_precedence(tmp_path: Path) -> None:
    (folder_of(tmp_path / "a") / "times.txt").write_text(rows("{t:.3f}"))
    (folder_of(tmp_path / "b") / "times.txt").write_bytes(b"\xff\xfe")
    given = open_source(tmp_path / "a", Reading(rate=10))
    assert given.timestamps[1] - given.timestamps[0] == pytest.approx(0.1)
    assert not getattr(given, "left_out", [])
    assert "not a text file (UTF-8)" in " ".join(open_source(tmp_path / "b").left_out)  # type: ignore[attr-defined]
    folder = folder_of(tmp_path / "c", "{t:.6f}.png")
    (folder / "times.txt").write_text(rows("{t:.3f}"))
    named = open_source(folder)
    assert named.timestamps[0] == 1000
    assert not getattr(named, "left_out", [])


def test_a_list_is_told_beside_a_rate_that_the_source_states(tmp_path: Path) -> None:
    open3d(tmp_path)
    file = tmp_path / "camera_intrinsic.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "fps": 15}))
    (tmp_path / "times.txt").write_text(rows("{i}"))
    sequence = open_source(tmp_path)
    assert getattr(sequence, "kind", "") == "Open3D reconstruction folder"
    assert sequence.timestamps[1] - sequence.timestamps[0] == pytest.approx(1 / 15)
    assert [line[:9] for line in getattr(sequence, "left_out", [])] == ["times.txt"]


COUNTED = {
    "as many, from 0": (range(1, 13), range(12), 1),
    "as many, from 1": (range(12), range(1, 13), -1),
    "of a longer recording": (range(100, 112), range(200), 0),
    "before the images": (range(5, 17), range(3, 15), 2),
}


@pytest.mark.parametrize("case", COUNTED)
@pytest.mark.parametrize("file", ["groundtruth.txt", "x.gt.freiburg"])
def test_poses_by_frame_number_get_the_times_of_the_list(tmp_path: Path, case: str, file: str) -> None:
    """Poses beyond the list had its first or last time, and a list that begins at 1 or is uneven shifted all."""
    images, poses, ahead = COUNTED[case]
    for n in images:
        image(tmp_path / f"rgb/{n:04}.png", GREYS[0])
        image(tmp_path / f"depth/{n:04}.png", raw(METRES[0], 1000))
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    stamps = {n: round(50.0 + n / 15 + 0.01 * (n % 3), 3) for n in images}
    (tmp_path / "times.txt").write_text("".join(f"{n:04} {stamp:.3f}\n" for n, stamp in stamps.items()))
    (tmp_path / file).write_text("".join(f"{n} {n} 0 0 0 0 0 1\n" for n in poses))
    truth = open_source(tmp_path).ground_truth
    assert truth is not None
    ahead = ahead if file == "groundtruth.txt" else 0
    expected = {stamps[n + ahead]: n for n in poses if n + ahead in stamps}
    np.testing.assert_allclose(truth.timestamps, list(expected))
    np.testing.assert_allclose(truth.world_T_camera[:, 0, 3], list(expected.values()))


def test_a_log_has_no_time_for_a_depth_image_outside_the_list(tmp_path: Path) -> None:
    """Its pose got the time of the last frame, beside that frame's own."""
    folder_of(tmp_path, "{i:04d}.png")
    image(tmp_path / "depth/0004.png", raw(METRES[0], 1000))
    (tmp_path / "times.txt").write_text(rows("{t:.3f}"))
    pose = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    (tmp_path / "trajectory.log").write_text("".join(f"{n} {n} {n + 1}\n{pose}" for n in range(5)))
    truth = open_source(tmp_path).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps, STEPS)


def test_a_trajectory_of_icl_for_other_images_is_refused(tmp_path: Path) -> None:
    """It was of no pose, or of all poses at one time."""
    folder_of(tmp_path)
    (tmp_path / "times.txt").write_text(rows("{t:.3f}"))
    (tmp_path / "x.gt.freiburg").write_text("7 0 0 0 0 0 0 1\n8 0 0 0 0 0 0 1\n")
    with pytest.raises(GavoError, match=r"x\.gt\.freiburg: none of its frames \(7 to 8\) has an image"):
        open_source(tmp_path)
