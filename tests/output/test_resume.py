"""Runs that are cut short: killed, interrupted, out of disk; and their other half."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from small import CAMERA, GENETIC

from gavo_jax.cli import main, run
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.composition import blank_of
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.leaps import Leap
from gavo_jax.odometry.overlays import Overlays
from gavo_jax.odometry.progress import Progress
from gavo_jax.odometry.run import run_odometry
from gavo_jax.odometry.stream import track
from gavo_jax.odometry.tracking import blank_state
from gavo_jax.output.checkpoint import Checkpoint, Mark, load_checkpoint, save_checkpoint
from gavo_jax.output.files import RECORDING, VIEW
from gavo_jax.output.run_folder import RunFolder
from gavo_jax.output.trajectories import BAG_METADATA, FILES
from gavo_jax.presets import preset
from gavo_jax.settings import Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.trajectory import Trajectory

READ_ONLY_CACHE = {**os.environ, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "1e9"}
"""JAX writes its cache of programs in place: a process that dies meanwhile would spoil it for the others."""
READ_ONLY_CACHE.pop("TF_CPP_MIN_LOG_LEVEL", None)  # JAX has set it here; the command sets its own
NEWTON = preset("gauss-newton")
"""As the command runs it here."""
SOLVER = GaussNewton(iterations=(0, 0, 15, 0, 0))
TIMINGS = {"compile_seconds", "milliseconds_per_pair_median", "frames_per_second"}
OFTEN = "import sys; from gavo_jax.cli import main, run; run.CHECKPOINT_SECONDS = 0.1; sys.exit(main(sys.argv[1:]))"
"""The command, with more checkpoints than it needs."""


@pytest.fixture(scope="session")
def clip(tmp_path_factory, forty_frames) -> Path:
    """Forty frames of 160×120 pixels, one of them torn, one white: no test changes them."""
    folder = tmp_path_factory.mktemp("clips") / "clip"
    shutil.copytree(forty_frames, folder)
    rgb = [folder / row.split()[1] for row in (folder / "rgb.txt").read_text().splitlines()[1:]]
    rgb[9].write_bytes(rgb[9].read_bytes()[:2000])
    return folder


def arguments(clip: Path, output: Path, *more: str) -> list[str]:
    camera = str(clip / "camera.toml")
    return ["run", str(clip), "--camera", camera, "--method", "gauss-newton", "--output", str(output), *more]


@pytest.fixture(scope="session")
def whole(clip, tmp_path_factory) -> Path:
    """The files of a run in one go."""
    folder = tmp_path_factory.mktemp("whole")
    assert main(arguments(clip, folder)) == 0
    return folder


def same_ending(one: Path, other: Path, drawn: bool = True) -> bool:
    """Whether two runs ended with the same files, byte by byte but for the times they took; figures alone by name."""

    def rows(folder: Path) -> list[dict[str, str]]:
        table = csv.DictReader((folder / "frames.csv").read_text().splitlines())
        return [{name: value for name, value in row.items() if name != "milliseconds"} for row in table]

    def figures(folder: Path) -> dict[str, Any]:
        metrics = json.loads((folder / "metrics.json").read_text())
        return {key: value for key, value in metrics.items() if key not in TIMINGS}

    left_out = () if drawn else (".png", ".svg")
    names = [sorted(path.name for path in folder.iterdir() if path.suffix not in left_out) for folder in (one, other)]
    return (
        names[0] == names[1]
        and (one / "trajectory.txt").read_bytes() == (other / "trajectory.txt").read_bytes()
        and rows(one) == rows(other)
        and figures(one) == figures(other)
    )


class Power(Exception):
    """Goes out."""


def cut_short(monkeypatch: pytest.MonkeyPatch, after: int, fault: type[BaseException], every: float = 0.0) -> None:
    """Let the fault happen in the middle of the row of frame `after` + 1, between its two files."""
    append = RunFolder.add
    count = 0

    def add(self: RunFolder, step: Any, progress: Progress | None = None) -> None:
        nonlocal count
        count += 1
        if count > after:
            self._files["frames.csv"].append("torn")
            raise fault
        append(self, step, progress)

    monkeypatch.setattr(RunFolder, "add", add)
    monkeypatch.setattr(run, "CHECKPOINT_SECONDS", every)


@pytest.mark.parametrize(("after", "every"), [(1, 0.0), (9, 0.0), (20, 0.05), (20, 1e9), (38, 0.0)])
def test_resumed_run_ends_as_one_in_one_go(clip, whole, tmp_path, monkeypatch, undrawn, after, every):
    with monkeypatch.context() as patch:
        cut_short(patch, after, Power, every)
        with pytest.raises(Power):
            main(arguments(clip, tmp_path / "out"))
    assert not (tmp_path / "out" / "metrics.json").exists()
    assert len(Trajectory.read_tum(tmp_path / "out" / "trajectory.txt")) == after + 1
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert same_ending(tmp_path / "out", whole, drawn=False)


LOOPS = ("--loops", "--frames", "24")
"""So many frames that a loop is closed among them."""


def close_loops_soon(patch: pytest.MonkeyPatch) -> None:
    """Let loops close within the second that the clip lasts."""
    pytest.importorskip("gtsam")
    patch.setattr("gavo_jax.mapping.candidates.MIN_SECONDS", 0.2)
    patch.setattr("gavo_jax.mapping.keyframes.SPACING", 0.03)


@pytest.fixture(scope="module")
def whole_with_loops(clip, tmp_path_factory) -> Path:
    """The files of a run with loops in one go."""
    folder = tmp_path_factory.mktemp("loops")
    with pytest.MonkeyPatch.context() as patch:
        close_loops_soon(patch)
        assert main(arguments(clip, folder, *LOOPS)) == 0
    assert len((folder / "loops.csv").read_text().splitlines()) > 1, "there are loops"
    return folder


@pytest.mark.parametrize(("after", "fault"), [(9, Power), (20, KeyboardInterrupt), (22, Power)])
def test_resumed_run_with_loops_ends_as_one_in_one_go(
    clip, whole_with_loops, tmp_path, monkeypatch, undrawn, after, fault
):
    close_loops_soon(monkeypatch)
    out = arguments(clip, tmp_path / "out", *LOOPS)
    with monkeypatch.context() as patch:
        cut_short(patch, after, fault)
        if fault is Power:
            with pytest.raises(Power):
                main(out)
        else:
            assert main(out) == 130
    assert main([*out, "--resume"]) == 0
    assert same_ending(tmp_path / "out", whole_with_loops, drawn=False)
    for name in ("loops.csv", "motions.csv", "odometry.txt"):
        assert (tmp_path / "out" / name).read_bytes() == (whole_with_loops / name).read_bytes()


def test_interrupted_run_is_resumed(clip, whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        cut_short(patch, 5, KeyboardInterrupt, 1e9)
        assert main(arguments(clip, tmp_path / "out")) == 130
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["complete"] is False and metrics["frames"] == 6
    assert len((tmp_path / "out" / "frames.csv").read_text().splitlines()) == 6, "the torn row is gone"
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert same_ending(tmp_path / "out", whole)


def test_nothing_to_resume(clip, whole, tmp_path, capsys):
    """An empty folder is a run from the start; of a run that came to its end nothing is touched."""
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert f"nothing to resume in {tmp_path / 'out'}: starting a new run\n" in capsys.readouterr().out
    assert same_ending(tmp_path / "out", whole)
    before = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    done = capsys.readouterr()
    assert "nothing to resume" in done.err and "lost pairs" in done.out
    assert main(arguments(clip, tmp_path / "out", "--resume", "--strict")) == 3
    assert {path: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


@pytest.fixture(scope="module")
def cut(clip, tmp_path_factory) -> Path:
    """The folder of a run that was cut short, with a checkpoint: no test changes it."""
    folder = tmp_path_factory.mktemp("cut") / "out"
    with pytest.MonkeyPatch.context() as patch:
        cut_short(patch, 4, Power)
        with pytest.raises(Power):
            main(arguments(clip, folder))
    return folder


@pytest.fixture
def broken(cut, tmp_path) -> Path:
    """The same, to be damaged."""
    return shutil.copytree(cut, tmp_path / "out")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--seed", "1"), ("seed was 0, now 1",)),
        (("--frames", "20"), ("sequence.frames was 40, now 20",)),
        (("--on-lost", "predict"), ("odometry.on_lost",)),
        (("--preset", "fast"), ("config.json",)),
    ],
)
def test_another_run_is_not_resumed(clip, broken, capsys, more, words):
    before = {path: path.read_bytes() for path in broken.iterdir()}
    capsys.readouterr()
    assert main(arguments(clip, broken, "--resume", *more)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(broken / "config.json") in error and all(word in error for word in words)
    assert {path: path.read_bytes() for path in broken.iterdir()} == before


def test_what_an_interrupted_run_wrote_of_its_end_is_not_the_whole_one_s(clip, broken, undrawn):
    """The trajectory in other formats, and recordings, ended where the run was interrupted, beside the whole one."""
    for name in (*FILES.values(), RECORDING, VIEW):
        if name not in ("trajectory.txt", FILES["bag"]):
            (broken / name).write_text("of the first frames")
    (broken / FILES["bag"]).mkdir()
    (broken / FILES["bag"] / BAG_METADATA).write_text("of the first frames")
    assert main(arguments(clip, broken, "--resume", "--trajectory-format", "kitti")) == 0
    assert len((broken / FILES["kitti"]).read_text().splitlines()) == 40
    assert not [
        name for name in (FILES["euroc"], FILES["json"], FILES["bag"], RECORDING, VIEW) if (broken / name).exists()
    ]


def test_a_run_of_another_lens_is_not_resumed(clip, broken, tmp_path, capsys):
    """Frames have no distortion either way: their camera is the same."""
    camera = tmp_path / "camera.toml"
    own = (clip / "camera.toml").read_text()
    camera.write_text(re.sub(r"distortion = .*", "distortion = [0.1, 0, 0, 0, 0]", own))
    capsys.readouterr()
    assert main(arguments(clip, broken, "--resume", "--camera", str(camera))) == 2
    assert "sequence.recorded.color.distortion" in capsys.readouterr().err


def altered(path: Path, **changes: Any) -> None:
    """Write a checkpoint again with other arrays, as it may be written."""
    with np.load(path) as stored:
        arrays = dict(stored)
    for name, change in changes.items():
        arrays[name] = change(arrays[name]) if callable(change) else change
    np.savez(path, **arrays)


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("checkpoint.npz", halve),
        ("checkpoint.npz", lambda path: path.write_bytes(b"")),
        ("checkpoint.npz", lambda path: np.savez(path, numbers=np.array("[]"))),
        ("checkpoint.npz", lambda path: np.savez(path, numbers=np.array([print], dtype=object))),
        ("checkpoint.npz", lambda path: np.savez_compressed(path, numbers=np.zeros(10**8))),
        ("trajectory.txt", halve),
        ("frames.csv", Path.unlink),
        ("config.json", halve),
        ("config.json", lambda path: path.write_text("[]")),
        ("config.json", Path.unlink),
        ("checkpoint.npz", lambda path: altered(path, world_T_camera=np.eye(4))),
        ("checkpoint.npz", lambda path: altered(path, tracker_0=lambda leaf: leaf + 1)),
        (
            "checkpoint.npz",
            lambda path: altered(path, numbers=lambda old: np.array(str(old).replace('"held": 0', '"held": 1'))),
        ),
        ("trajectory.txt", lambda path: path.write_bytes(path.read_bytes().replace(b"0.0333", b"0.0334", 1))),
        ("frames.csv", lambda path: path.write_bytes(path.read_bytes().replace(b"ok", b"OK", 1))),
        ("trajectory.txt", lambda path: path.rename(path.with_suffix(".kept")) and path.symlink_to("trajectory.kept")),
    ],
)
def test_damaged_files_are_not_resumed(clip, broken, capsys, name, damage):
    damage(broken / name)
    capsys.readouterr()
    assert main(arguments(clip, broken, "--resume")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(broken / name) in error


def test_a_damaged_checkpoint_is_always_one_line(tmp_path):
    """Whatever bytes change, the file is refused in one way or read as it was."""
    path, rng = tmp_path / "checkpoint.npz", np.random.default_rng(0)
    blank = blank_state(CAMERA.level(3), SOLVER, NEWTON.alignment)
    save_checkpoint(path, Checkpoint(Progress(blank, 3), {"frames.csv": Mark(7, "")}))
    whole, refused = path.read_bytes(), 0
    for _ in range(300):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), int(rng.integers(1, 4))):
            data[place] = rng.integers(256)
        path.write_bytes(data)
        try:
            found = load_checkpoint(path, blank)
        except GavoError as fault:
            refused += "damaged or incomplete checkpoint" in str(fault) or "larger than" in str(fault)
        else:
            assert found.progress.last_index == 3 and found.files == {"frames.csv": Mark(7, "")}
            refused += 1
    assert refused == 300


@pytest.mark.parametrize("part", ["rgb", "depth"])
def test_images_that_changed_are_noticed(clip, tmp_path, monkeypatch, capsys, undrawn, part):
    """Of the frames that were seen; what comes after them is read as it is now."""
    own = tmp_path / "clip"
    shutil.copytree(clip, own)
    with monkeypatch.context() as patch:
        cut_short(patch, 4, Power)
        with pytest.raises(Power):
            main(arguments(own, tmp_path / "out"))
    shutil.rmtree(own)
    shutil.copytree(clip, own, copy_function=shutil.copy)  # other times, the same images
    (out := tmp_path / "again").mkdir()
    for path in (tmp_path / "out").iterdir():
        shutil.copy(path, out)
    assert main(arguments(own, out, "--resume")) == 0
    image = sorted((own / part).iterdir())[2]
    picture = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    picture[7, 7] += 1
    cv2.imwrite(str(image), picture)
    capsys.readouterr()
    assert main(arguments(own, tmp_path / "out", "--resume")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "the images differ from those" in error


def test_a_run_that_ended_at_a_lost_pair_says_so(clip, tmp_path, capsys, undrawn):
    """It was told that the images had changed: those of all frames were compared with those that it had seen."""
    assert main(arguments(clip, tmp_path / "out", "--on-lost", "stop")) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert not metrics["complete"]
    assert f"ended at its first lost pair: {metrics['frames']} of 40 frames" in capsys.readouterr().out
    assert main(arguments(clip, tmp_path / "out", "--on-lost", "stop", "--resume")) == 0
    assert "the run ended at its first lost pair: nothing to resume" in capsys.readouterr().err


def test_an_interrupted_run_whose_checkpoint_is_gone_is_no_finished_one(clip, tmp_path, capsys, undrawn):
    """It was said to have ended at a lost pair."""
    assert main(arguments(clip, tmp_path / "out")) == 0
    path = tmp_path / "out" / "metrics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "complete": False}))
    capsys.readouterr()
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "its checkpoint is gone: run again without --resume" in error


def test_a_finished_run_that_nothing_tells_of_is_not_shown_for_another(whole, clip, tmp_path, capsys):
    shutil.copytree(whole, tmp_path / "out")
    (tmp_path / "out" / "config.json").unlink()
    assert main(arguments(clip, tmp_path / "out", "--resume", "--seed", "7")) == 2
    assert "config.json: no such file" in capsys.readouterr().err


def test_images_that_changed_after_a_complete_run_are_noticed(clip, tmp_path, capsys, undrawn):
    """They would make a map with the poses of others."""
    own = tmp_path / "clip"
    shutil.copytree(clip, own)
    assert main(arguments(own, tmp_path / "out")) == 0
    assert main(arguments(own, tmp_path / "out", "--resume")) == 0
    image = sorted((own / "depth").iterdir())[-1]
    picture = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    cv2.imwrite(str(image), picture[::-1])
    capsys.readouterr()
    assert main(arguments(own, tmp_path / "out", "--resume")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "the images differ from those" in error


def test_ctrl_c_in_the_last_row_leaves_the_row_and_the_figures(clip, whole, tmp_path, monkeypatch, capsys):
    append = RunFolder.add

    def add(self: RunFolder, step: Any, progress: Progress | None = None) -> None:
        append(self, step, progress)
        if step.index == 39:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "add", add)
        assert main(arguments(clip, tmp_path / "out")) == 130
    told = capsys.readouterr().err
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert "interrupted after 39 of 39 pairs" in told and metrics["pairs"] == 39 and metrics["complete"] is False
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert same_ending(tmp_path / "out", whole)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {path.name for path in whole.iterdir()}


def test_figures_that_were_interrupted_are_drawn_later(clip, tmp_path, monkeypatch, capsys):
    def stop(*arguments: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run, "draw", stop)
        assert main(arguments(clip, tmp_path / "out")) == 130
    assert not list((tmp_path / "out").glob("*.png"))
    assert "--resume to draw the figures" in capsys.readouterr().out
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert (tmp_path / "out" / "trajectory.png").exists() and (tmp_path / "out" / "distance_error.png").exists()
    for name in ("distance_error.svg", "trajectory.png"):  # as if killed between two of them
        (tmp_path / "out" / name).unlink()
        assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
        assert (tmp_path / "out" / name).exists()


def test_metrics_are_there_before_the_figures(clip, tmp_path, monkeypatch, capsys):
    def full(*arguments: Any) -> None:
        raise GavoError("trajectory.png: cannot be written: No space left on device")

    monkeypatch.setattr(run, "draw", full)
    assert main(arguments(clip, tmp_path / "out")) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["complete"] is True


def test_a_checkpoint_of_another_camera_is_refused(tmp_path):
    own, other = (blank_state(camera, SOLVER, NEWTON.alignment) for camera in (CAMERA, CAMERA.level(1)))
    save_checkpoint(tmp_path / "checkpoint.npz", Checkpoint(Progress(own, 3), {}))
    with pytest.raises(GavoError, match="another camera"):
        load_checkpoint(tmp_path / "checkpoint.npz", other)


def test_a_leap_is_kept_in_mind(tmp_path):
    leap = Leap(np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) / 3, 0.4, 1.1)
    blank = blank_state(CAMERA, SOLVER, NEWTON.alignment)
    for progress in (Progress(blank, 3), Progress(blank, 3, leap=leap)):
        save_checkpoint(tmp_path / "checkpoint.npz", Checkpoint(progress, {}))
        kept = load_checkpoint(tmp_path / "checkpoint.npz", blank).progress.leap
        assert (kept is None) == (progress.leap is None)
    assert kept is not None and kept[1:] == leap[1:]
    np.testing.assert_array_equal(kept.target_T_reference, leap.target_T_reference)


@pytest.mark.parametrize(("settings", "at"), [(NEWTON, 1), (NEWTON, 4), (GENETIC, 3)])
def test_a_driver_goes_on_from_a_saved_progress(tmp_path, settings: Settings, at):
    sequence = SyntheticSequence(frames=7, camera=CAMERA)
    straight = run_odometry(sequence, settings).trajectory.world_T_camera
    first = Odometry(CAMERA, settings)
    for step in track(sequence, odometry=first):
        if step.index == at:
            break
    save_checkpoint(tmp_path / "checkpoint.npz", Checkpoint(first.progress, {"frames.csv": Mark(7, "")}))
    second = Odometry(CAMERA, settings)
    blank = blank_of(second.aligner)
    second.progress, files, _ = load_checkpoint(tmp_path / "checkpoint.npz", blank)
    rest = list(track(sequence, odometry=second))
    assert files == {"frames.csv": Mark(7, "")}
    assert [step.index for step in rest] == list(range(at + 1, 7))
    np.testing.assert_array_equal([step.world_T_camera for step in rest], straight[at + 1 :])


SMALL = """import resource, sys; from gavo_jax.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY)); sys.exit(main(sys.argv[2:]))"""
"""The command where no file can grow beyond so many bytes: as with a full disk, only the error's words differ."""


@pytest.mark.parametrize("limit", [1000, 4000])
def test_a_full_disk_is_one_line_and_leaves_whole_rows(clip, whole, tmp_path, undrawn, limit):
    command = [sys.executable, "-c", SMALL, str(limit), *arguments(clip, tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=READ_ONLY_CACHE)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1 and str(tmp_path / "out") in done.stderr and "File too large" in done.stderr
    assert not (tmp_path / "out" / "metrics.json").exists()
    if (tmp_path / "out" / "trajectory.txt").exists():
        rows = (tmp_path / "out" / "trajectory.txt").read_text()
        assert rows.endswith("\n") and (whole / "trajectory.txt").read_text().startswith(rows)
    assert main(arguments(clip, tmp_path / "out", "--resume")) == 0
    assert same_ending(tmp_path / "out", whole, drawn=False)


def test_full_standard_output_is_one_line(clip, tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "gavo_jax", "--help"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "No space left" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("method", ["gauss-newton", "ga"])
def test_killed_at_twenty_random_moments(clip, tmp_path, method):
    """SIGKILL at any time, then --resume: the same bytes each time."""
    rng = np.random.default_rng(0)
    whole = tmp_path / "whole"
    assert main(arguments(clip, whole, "--method", method)) == 0
    killed = 0
    for moment in range(20):
        output = tmp_path / str(moment)
        rows, delay = int(rng.integers(0, 39)), rng.uniform(0.0, 0.1)
        command = [sys.executable, "-c", OFTEN, *arguments(clip, output, "--method", method)]
        process = subprocess.Popen(command, env=READ_ONLY_CACHE)
        frames = output / "frames.csv"
        while process.poll() is None:
            if frames.exists() and frames.read_bytes().count(b"\n") > rows:
                break
            time.sleep(0.002)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        killed += process.wait() == -signal.SIGKILL
        left = Trajectory.read_tum(output / "trajectory.txt")
        assert len(left) >= rows + 1
        assert subprocess.run([*command, "--resume"], check=False, env=READ_ONLY_CACHE).returncode == 0
        assert same_ending(output, whole), f"killed after {rows} rows and {delay:.3f} s"
        shutil.rmtree(output)
    assert killed >= 15


def test_a_checkpoint_of_large_images_can_be_read(tmp_path: Path) -> None:
    """From 1920x1080 on each was larger than was allowed."""
    overlays = Overlays().after(np.zeros((1080, 1920), np.float32), np.eye(4))
    save_checkpoint(tmp_path / "checkpoint.npz", Checkpoint(Progress()._replace(overlays=overlays), {}))
    assert load_checkpoint(tmp_path / "checkpoint.npz", ()).progress.overlays.last is not None
