"""The files of a run, while it goes on and after."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gavo_jax.alignment.result import Alignment, no_alignment
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.progress import Progress
from gavo_jax.output.files import describe, json_text, prepare_folder, write_json
from gavo_jax.output.frames import FRAME_COLUMNS, frame_row, read_run
from gavo_jax.output.run_folder import RunFolder
from gavo_jax.rigid_motions import exp
from gavo_jax.settings import OdometryOptions
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import inverse


@dataclass(frozen=True)
class Settings:
    rate: float
    sizes: tuple[int, ...]


def step(covariance: float = 4.0) -> Step:
    alignment = Alignment(
        target_T_reference=np.eye(4, dtype=np.float32),  # pyright: ignore[reportArgumentType]
        xi=np.zeros(6, np.float32),  # pyright: ignore[reportArgumentType]
        error=np.float32(0.1),  # pyright: ignore[reportArgumentType]
        overlap=np.float32(1.0),  # pyright: ignore[reportArgumentType]
        covariance=np.eye(6, dtype=np.float32) * covariance,  # pyright: ignore[reportArgumentType]
        status=AlignmentStatus.LOW_TEXTURE,
        history=np.zeros(0, np.float32),  # pyright: ignore[reportArgumentType]
    )
    return Step(1, 100.0, 100.033333, alignment, np.eye(4), 12.5, True)


def test_row_of_a_pair():
    row = dict(zip(FRAME_COLUMNS, frame_row(step()), strict=True))
    assert row["status"] == "low_texture" and row["lost"] == 1 and row["index"] == 1
    assert row["timestamp"] == "100.033333" and np.float32(row["error"]) == np.float32(0.1)
    assert [float(row[f"std_{axis}"]) for axis in ("vx", "vy", "vz", "wx", "wy", "wz")] == [2.0] * 6


@pytest.mark.parametrize("covariance, deviation", [(math.nan, math.isnan), (-1.0, lambda value: value == 0)])
def test_deviation_of_a_useless_covariance(covariance, deviation):
    row = dict(zip(FRAME_COLUMNS, frame_row(step(covariance)), strict=True))
    assert deviation(float(row["std_vx"]))


def test_rows_are_on_disk_as_soon_as_added(tmp_path):
    with RunFolder(tmp_path / "run") as folder:
        folder.start({}, 99.0)
        folder.add(step())
        assert len((folder.path / "trajectory.txt").read_text().splitlines()) == 3
        assert len((folder.path / "frames.csv").read_text().splitlines()) == 2
        assert not (folder.path / "metrics.json").exists()


def test_rows_of_a_run_that_came_to_its_end_say_what_was_seen_later(tmp_path: Path) -> None:
    def pair(index: int, revises: int = 0) -> Step:
        result = no_alignment(AlignmentStatus.OK)._replace(covariance=np.eye(6, dtype=np.float32) / 3e6)
        return Step(index, index - 1.0, float(index), result, np.eye(4), 12.5, False, revises=revises)

    with RunFolder(tmp_path / "run") as folder:
        folder.start({}, 0.0)
        for index, revises in ((1, 0), (2, 0), (3, 2), (4, 0)):
            folder.add(pair(index, revises))
        rows = (folder.path / "frames.csv").read_text().splitlines()
        assert not any("moving_body" in row for row in rows), "it is not known yet"
        folder.finish({}, complete=False)
        assert (folder.path / "frames.csv").read_text().splitlines() == rows, "a checkpoint knows it as it was"
        assert [step.alignment.status for step in folder.steps()] == [AlignmentStatus.OK] * 4
        folder.finish({})
        assert len(folder.steps()) == 4
    after = (tmp_path / "run" / "frames.csv").read_text().splitlines()
    assert [place for place, (row, was) in enumerate(zip(after, rows, strict=True)) if row != was] == [1, 2]
    said = dict(zip(FRAME_COLUMNS, after[1].split(","), strict=True))
    assert (said["status"], said["statuses"], said["std_vx"]) == ("moving_body", "moving_body", "0.5")
    assert dict(zip(FRAME_COLUMNS, after[3].split(","), strict=True))["revises"] == "2"


def test_describe_is_strict_json():
    value = {
        "settings": Settings(0.5, (1, 2)),
        "nan": math.nan,
        "array": np.array([[1.0, math.inf]], np.float32),
        "status": AlignmentStatus.OK,
        "path": Path("a") / "b",
        "function": math.sqrt,
        "flag": True,
    }
    assert json.loads(json.dumps(describe(value), allow_nan=False)) == {
        "settings": {"type": "Settings", "rate": 0.5, "sizes": [1, 2]},
        "nan": None,
        "array": [[1.0, None]],
        "status": "ok",
        "path": str(Path("a") / "b"),
        "function": "sqrt",
        "flag": True,
    }


def test_a_list_of_numbers_is_one_line_of_json():
    value = {"matrix": [[1.5, -2e-9], [None, True]], "words": ["[\n 1 ]", "[ 2 ]"], "none": [], "of": [{"a": [1, 2]}]}
    text = json_text(value)
    assert json.loads(text) == value
    lines = [line.strip() for line in text.splitlines()]
    assert "[1.5, -2e-09]," in lines and "[null, true]" in lines and '"a": [1, 2]' in lines
    assert json_text({"name": "ü"}, ensure_ascii=False).splitlines()[1] == '  "name": "ü"'


def test_json_is_whole_or_absent(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(GavoError, match="taken"):
        write_json(tmp_path / "taken", {})
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_prepared_folder(tmp_path):
    assert prepare_folder(tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(GavoError, match="file"):
            prepare_folder(path)


def recorded(folder: Path, stamps: tuple[float, ...] = (1.0, 2.0, 3.0)) -> Path:
    """A folder of a run whose camera goes on along x."""
    with RunFolder(folder) as run:
        run.start({}, 0.0)
        for index, stamp in enumerate(stamps, start=1):
            pose = np.eye(4)
            pose[0, 3] = index
            run.add(Step(index, stamp - 1.0, stamp, no_alignment(AlignmentStatus.OK), pose, 1.0, False))
    return folder


def altered(words: str, row: int = 1) -> Callable[[Path], None]:
    def alter(folder: Path) -> None:
        lines = (folder / "frames.csv").read_text().splitlines()
        lines[row : row + 1] = [words] if words else []
        (folder / "frames.csv").write_text("\n".join(lines))

    return alter


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / "trajectory.txt").write_text("7 0 0 0 0 0 0 1\n8 0 0 0 0 0 0 1\n"), "same run"),
        (lambda folder: (folder / "odometry.txt").write_text("7 0 0 0 0 0 0 1\n8 0 0 0 0 0 0 1\n"), "odometry.txt"),
        (altered(""), "frames.csv:2: not row 1 of a run"),
        (altered("1," + "x" * 200_000), "frames.csv"),
        (lambda folder: (folder / "frames.csv").write_text("a,b\n" + "1,2\n" * 4), "frames.csv:2: not row 1 of a run"),
    ],
)
def test_files_that_are_not_of_one_run_are_told(tmp_path, damage, words):
    assert [step.world_T_camera[0, 3] for step in read_run(recorded(tmp_path / "run")).steps] == [1, 2, 3]
    damage(tmp_path / "run")
    with pytest.raises(GavoError, match=words):
        read_run(tmp_path / "run")


def test_a_row_whose_pose_is_not_written_yet_is_left_out(tmp_path):
    """A run appends the row first: `gavo view` of one that went on refused it."""
    poses = recorded(tmp_path / "run") / "trajectory.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:-1]) + "\n")
    assert len(read_run(tmp_path / "run").steps) == 2


def test_a_last_row_without_a_pose_stays_if_its_stamp_is_in_doubt(tmp_path: Path) -> None:
    """It was taken for one whose pose was not written yet: the run had a pair fewer."""
    with RunFolder(tmp_path) as run:
        run.start({}, 0.0)
        for index, status in enumerate((AlignmentStatus.OK, AlignmentStatus.BAD_TIMESTAMP), start=1):
            run.add(Step(index, 0.0, index / 10, no_alignment(status), np.eye(4), 1.0, index == 2))
        assert len(run.steps()) == 2
    assert len(read_run(tmp_path).steps) == 2


def test_metrics_that_were_edited_are_told(tmp_path: Path) -> None:
    """A number of pairs that is none ended `gavo run --resume` in a traceback."""
    with RunFolder(recorded(tmp_path / "run")) as folder:
        write_json(folder.path / "metrics.json", {"pairs": 3})
        assert folder.finished() is not None
        write_json(folder.path / "metrics.json", {"pairs": "three"})
        with pytest.raises(GavoError, match="metrics.json: pairs: expected a whole number, got 'three'"):
            folder.finished()


@pytest.mark.parametrize("name", ["frames.csv", "trajectory.txt"])
def test_a_finished_run_is_whole(tmp_path: Path, name: str) -> None:
    """`gavo view` showed what was left of it, as if it were still going on."""
    folder = recorded(tmp_path / "run")
    write_json(folder / "metrics.json", {"pairs": 3})
    assert len(read_run(folder).steps) == 3
    lines = (folder / name).read_text().splitlines()
    (folder / name).write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(
        GavoError, match="2 pairs in trajectory.txt and frames.csv, and 3 in metrics.json: files are cut off"
    ):
        read_run(folder)


def test_the_steps_of_a_run_come_back_as_they_were(tmp_path: Path) -> None:
    """Of a camera that turns: catches motions between the wrong poses or the wrong way round, and a lost origin."""
    poses = [exp(np.array([0.3, -0.1, 0.2, 0.1, -0.4, 0.3]) * i) @ exp(np.eye(6)[i % 6]) for i in range(5)]
    references = (0, 1, 0, 3)
    origins: Any = ("tracked", "guessed", "relocalised", "tracked")
    steps = []
    for i, (reference, origin) in enumerate(zip(references, origins, strict=True), start=1):
        result = no_alignment(AlignmentStatus.OK if i < 4 else AlignmentStatus.LOW_TEXTURE)._replace(
            target_T_reference=inverse(poses[i]) @ poses[reference],
            covariance=np.diag((1e-3 * np.arange(1, 7)) ** 2),
            error=np.float32(0.1 * i),
            overlap=np.float32(0.9),
        )
        world, lost = inverse(poses[0]) @ poses[i], i == 2
        steps.append(Step(i, reference / 30, i / 30, result, world, 2.5 * i, lost, segment=i // 3, origin=origin))
    with RunFolder(tmp_path / "run") as folder:
        folder.start({}, 0.0)
        for one in steps:
            folder.add(one)
    (tmp_path / "run" / "config.json").write_text("{}")
    for read, wrote in zip(read_run(tmp_path / "run").steps, steps, strict=True):
        names = ("index", "timestamp", "reference_timestamp", "milliseconds", "lost", "segment", "origin", "revises")
        assert [getattr(read, name) for name in names] == [getattr(wrote, name) for name in names]
        assert read.alignment.statuses == wrote.alignment.statuses
        assert (read.alignment.error, read.alignment.overlap) == (wrote.alignment.error, wrote.alignment.overlap)
        np.testing.assert_allclose(read.world_T_camera, wrote.world_T_camera, atol=1e-9)
        np.testing.assert_allclose(read.alignment.target_T_reference, wrote.alignment.target_T_reference, atol=1e-9)
        np.testing.assert_allclose(read.alignment.covariance, wrote.alignment.covariance, rtol=1e-9)


def test_a_run_with_loops_that_was_killed_is_read(tmp_path):
    folder = recorded(tmp_path / "run")
    (folder / "trajectory.txt").rename(folder / "odometry.txt")
    run = read_run(folder)
    assert len(run.trajectory.timestamps) == 4 and [step.world_T_camera[0, 3] for step in run.steps] == [1, 2, 3]


def test_what_loops_corrected_before_a_run_goes_on_is_not_left(tmp_path):
    """It would look whole beside the longer run, should that be killed."""
    config = {"odometry": OdometryOptions(loops=True)}
    result = no_alignment(AlignmentStatus.OK)
    with RunFolder(tmp_path, trajectory="odometry.txt") as folder:
        folder.start(config, 0.0)
        folder.add(Step(1, 0.0, 1.0, result, np.eye(4), 1.0, False), Progress(last_index=1))
        folder.save_checkpoint()
        for name in ("trajectory.txt", "loops.csv"):
            (tmp_path / name).write_text("of the part")
        folder.finish({}, complete=False)
    with RunFolder(tmp_path, trajectory="odometry.txt") as folder:
        assert folder.resume(config, {}) is not None
        assert not (tmp_path / "trajectory.txt").exists() and not (tmp_path / "loops.csv").exists()


def test_a_resumed_run_goes_on_from_the_last_pose_though_a_clock_was_set_back(tmp_path: Path) -> None:
    """The latest stamp was taken for the last one, and the next break was told from there."""

    def pair(index: int, stamp: float, segment: int) -> Step:
        return Step(index, stamp - 1.0, stamp, no_alignment(AlignmentStatus.OK), np.eye(4), 1.0, False, segment=segment)

    with RunFolder(tmp_path / "run") as folder:
        folder.start({}, 100.0)
        folder.add(pair(1, 101.0, 0))
        folder.add(pair(2, 51.0, 1), Progress(last_index=2, segment=1))
        folder.save_checkpoint()
    with RunFolder(tmp_path / "run") as folder:
        assert folder.resume({}, {}) is not None
        folder.add(pair(3, 52.0, 2))
    assert "the motion from 51.0" in (tmp_path / "run" / "trajectory.txt").read_text().splitlines()[-2]
