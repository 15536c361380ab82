"""The command `gavo`, in process: files, exit statuses, refusals."""

import csv
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from command import GENETIC, Done, runner
from small import CAMERA

from gavo_jax import presets
from gavo_jax.alignment.result import no_alignment
from gavo_jax.camera import vignetting_gain
from gavo_jax.cli import compare, options, run, view
from gavo_jax.cli.align import in_words, rounded
from gavo_jax.cli.usage import COMMANDS
from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.rendered.sensor_noise import KINECT
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.evaluation import relative_pose_error
from gavo_jax.odometry.driver import Step
from gavo_jax.output import tracked
from gavo_jax.output.files import json_text
from gavo_jax.output.frames import FRAME_COLUMNS, read_run
from gavo_jax.presets import METHODS, PRESETS
from gavo_jax.rigid_motions import exp
from gavo_jax.status import AlignmentStatus
from gavo_jax.trajectory import Trajectory, inverse
from gavo_jax.viewer.base import NO_VIEWER

METRICS = """sequence method preset seed device frames pairs lost_pairs rpe_translation_rmse_m_per_s
rpe_rotation_rmse_deg_per_s rpe_translation_rmse_m_per_frame ate_translation_rmse_m distance_error_final_m
compile_seconds milliseconds_per_pair_median frames_per_second""".split()
FAST = ("--method", "gauss-newton")


@pytest.fixture
def gavo(capsys, monkeypatch, tmp_path):
    """Run the command in a folder of its own and return status, standard output and standard error."""
    monkeypatch.chdir(tmp_path)
    return runner(capsys)


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> Path:
    """Thirty-six frames of 160×120 pixels over 1.2 s: no test changes them."""
    folder = tmp_path_factory.mktemp("clips") / "clip"
    write_tum(SyntheticSequence(frames=36, noise=KINECT, camera=CAMERA), folder)
    return folder


@pytest.fixture
def clip(pristine, tmp_path) -> Path:
    """The first six frames, to be damaged."""
    folder = tmp_path / "clip"
    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True)
        rows = (pristine / f"{part}.txt").read_text().splitlines()[:7]
        (folder / f"{part}.txt").write_text("\n".join(rows) + "\n")
        for row in rows[1:]:
            shutil.copy(pristine / row.split()[1], folder / row.split()[1])
    for name in ("groundtruth.txt", "camera.toml"):
        shutil.copy(pristine / name, folder / name)
    return folder


def images(folder: Path, part: str) -> list[Path]:
    return [folder / row.split()[1] for row in (folder / f"{part}.txt").read_text().splitlines()[1:]]


def read_json(path: Path) -> Any:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


def read_rows(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "frames.csv").read_text().splitlines()))


def is_refused(done: Done, *words: str) -> bool:
    """Status 2, nothing on standard output, one line on standard error that holds every word."""
    return done.status == 2 and not done.out and done.err.count("\n") == 1 and all(word in done.err for word in words)


def test_run_writes_its_files(gavo, pristine, tmp_path):
    camera = ("--camera", pristine / "camera.toml")
    done = gavo("run", pristine, *camera, "--seed", 3, "--output", tmp_path / "out", *FAST)
    assert done.status == 0 and "times the size" not in done.out, done.err
    out = tmp_path / "out"
    metrics = read_json(out / "metrics.json")
    assert set(METRICS) <= set(metrics)
    assert [metrics[key] for key in ("sequence", "method", "seed", "frames", "pairs")] == [
        "clip",
        "gauss-newton",
        3,
        36,
        35,
    ]
    assert metrics["lost_pairs"] == 0 and metrics["complete"] and metrics["rpe_translation_rmse_m_per_s"] < 0.1
    estimate, truth = Trajectory.read_tum(out / "trajectory.txt"), Trajectory.read_tum(pristine / "groundtruth.txt")
    assert len(estimate) == 36 and np.array_equal(estimate.world_T_camera[0], np.eye(4))
    assert relative_pose_error(estimate, truth).translation.rmse == pytest.approx(
        metrics["rpe_translation_rmse_m_per_s"], rel=1e-12
    )
    rows = read_rows(out)
    assert tuple(rows[0]) == FRAME_COLUMNS and len(rows) == 35
    assert all(float(row[f"std_{axis}"]) > 0 for row in rows for axis in ("vx", "vy", "vz", "wx", "wy", "wz"))
    config = read_json(out / "config.json")
    assert config["solver"]["type"] == "GaussNewton" and config["options"]["seed"] == 3
    assert {"gavo-jax", "jax", "numpy", "opencv", "python"} <= set(config["versions"])
    for name in ("trajectory", "distance_error", "convergence", "landscape"):
        assert (out / f"{name}.png").stat().st_size and (out / f"{name}.svg").stat().st_size

    evaluated = gavo("evaluate", out / "trajectory.txt", pristine / "groundtruth.txt")
    assert evaluated.out.count("┏") == 1  # one table of 80 columns
    assert evaluated.status == 0 and f"{metrics['rpe_translation_rmse_m_per_s']:.6f}" in evaluated.out


@pytest.mark.usefixtures("undrawn")
def test_run_with_loops_writes_both_trajectories(gavo, pristine, tmp_path, monkeypatch):
    pytest.importorskip("gtsam")
    out, camera = tmp_path / "out", ("--camera", pristine / "camera.toml")
    command = ("run", pristine, *camera, "--output", out, *FAST, "--loops")
    drawn: dict[str, Trajectory] = {}
    monkeypatch.setattr(run, "draw", lambda _folder, curves, *_: drawn.update(curves))
    assert gavo(*command).status == 0
    assert list(drawn) == ["gauss-newton with loops", "odometry"]
    metrics = read_json(out / "metrics.json")
    assert {"odometry_rpe_translation_rmse_m_per_s", "odometry_ate_translation_rmse_m", "loops"} <= set(metrics)
    assert len(Trajectory.read_tum(out / "trajectory.txt")) == len(Trajectory.read_tum(out / "odometry.txt")) == 36
    loops = list(csv.DictReader((out / "loops.csv").read_text().splitlines()))
    assert len(loops) == metrics["loops"] + metrics["loops_refused"]
    assert {row["origin"] for row in read_rows(out)} == {"tracked"}
    found, corrected = (Trajectory.read_tum(out / "odometry.txt") for _ in range(2))
    corrected.world_T_camera[:, :3, 3] *= 2
    shutil.copytree(out, tmp_path / "corrected")
    corrected.write_tum(tmp_path / "corrected" / "trajectory.txt")
    step = read_run(tmp_path / "corrected").steps[20]
    motion = inverse(found.world_T_camera[21]) @ found.world_T_camera[20]
    np.testing.assert_allclose(step.alignment.target_T_reference, motion, atol=1e-6)  # what the search found
    np.testing.assert_allclose(step.world_T_camera, corrected.world_T_camera[21], atol=1e-6)
    assert gavo(*command, "--resume").status == 0
    assert gavo(*command[:-1]).status == 0 and not (out / "odometry.txt").exists() and not (out / "loops.csv").exists()


@pytest.mark.usefixtures("undrawn")
def test_frames_of_the_room_are_rendered_and_not_read(gavo, clip, tmp_path):
    arguments = (*FAST, "--frames", 2, "--output", tmp_path / "out")
    room, read = gavo("run", *arguments), gavo("run", clip, "--camera", clip / "camera.toml", *arguments)
    assert "speed, rendering included" in room.out and "speed, reading and decoding included" in read.out


@pytest.mark.usefixtures("undrawn")
def test_same_seed_same_bytes_and_default_folder(gavo, clip, tmp_path):
    arguments = ("run", "clip", "--camera", clip / "camera.toml", *FAST, "--frames", 3, "--seed", 7)
    assert gavo(*arguments).status == 0
    assert gavo(*arguments, "--output", "again").status == 0
    first = tmp_path / "runs" / "clip-gauss-newton-default" / "trajectory.txt"
    assert first.read_bytes() == (tmp_path / "again" / "trajectory.txt").read_bytes()


@pytest.mark.usefixtures("undrawn")
def test_range_of_frames(gavo, clip, tmp_path):
    camera = ("--camera", clip / "camera.toml")
    done = gavo("run", clip, *camera, *FAST, "--start", 1, "--stride", 2, "--frames", 2, "--output", tmp_path / "out")
    assert done.status == 0, done.err
    stamps = [float(image.stem) for image in images(clip, "rgb")]
    assert Trajectory.read_tum(tmp_path / "out" / "trajectory.txt").timestamps.tolist() == [stamps[1], stamps[3]]


def test_without_ground_truth_errors_are_null(gavo, clip, tmp_path):
    (clip / "groundtruth.txt").unlink()
    done = gavo("run", clip, "--camera", clip / "camera.toml", *FAST, "--output", tmp_path / "out")
    assert done.status == 0, done.err
    metrics = read_json(tmp_path / "out" / "metrics.json")
    assert metrics["rpe_translation_rmse_m_per_s"] is None and metrics["ate_translation_rmse_m"] is None
    assert (tmp_path / "out" / "trajectory.png").exists()
    assert not (tmp_path / "out" / "distance_error.png").exists()


def test_torn_frame_is_flagged_and_the_run_goes_on(gavo, clip, tmp_path):
    torn = images(clip, "rgb")[2]
    torn.write_bytes(torn.read_bytes()[:3000])
    arguments = ("run", clip, "--camera", clip / "camera.toml", *FAST, "--output", tmp_path / "out")
    assert gavo(*arguments).status == 0
    metrics = read_json(tmp_path / "out" / "metrics.json")
    rows = read_rows(tmp_path / "out")
    assert metrics["frames"] == 6 and metrics["lost_pairs"] == sum(int(row["lost"]) for row in rows) >= 1
    assert [row["status"] for row in rows].count("unreadable") == 1 and len(rows) == 5
    assert all(row["on_lost"] == ("hold" if row["lost"] == "1" else "") for row in rows)
    assert metrics["statuses"]["unreadable"] == 1 and sum(metrics["statuses"].values()) == 5
    assert gavo(*arguments, "--strict").status == 3


def test_equal_stamps_are_flagged_and_have_no_pose(gavo, pristine, tmp_path):
    clip = tmp_path / "clip"
    shutil.copytree(pristine, clip)
    rows = (clip / "rgb.txt").read_text().splitlines()
    rows[8] = f"{rows[7].split()[0]} {rows[8].split()[1]}"
    (clip / "rgb.txt").write_text("\n".join(rows) + "\n")
    done = gavo("run", clip, "--camera", clip / "camera.toml", *FAST, "--frames", 14, "--output", tmp_path / "out")
    assert done.status == 0 and "bad_timestamp" in done.out
    table = read_rows(tmp_path / "out")
    assert [row["index"] for row in table if row["status"] == "bad_timestamp"] == ["6", "7"]
    assert [row["status"] for row in table].count("ok") >= 10
    stamps = Trajectory.read_tum(tmp_path / "out" / "trajectory.txt").timestamps
    assert len(stamps) == 12 and np.all(np.diff(stamps) > 0)
    assert read_json(tmp_path / "out" / "metrics.json")["frames"] == 14


def test_interrupted_run_keeps_what_is_done(gavo, clip, tmp_path, monkeypatch):
    track = tracked.track

    def interrupted(*arguments: Any, **settings: Any) -> Any:
        for i, step in enumerate(track(*arguments, **settings)):
            if i == 2:
                raise KeyboardInterrupt
            yield step

    monkeypatch.setattr(tracked, "track", interrupted)
    done = gavo("run", clip, "--camera", clip / "camera.toml", *FAST, "--output", tmp_path / "out")
    assert done.status == 130 and "Traceback" not in done.err
    metrics = read_json(tmp_path / "out" / "metrics.json")
    assert metrics["frames"] == 3 and metrics["complete"] is False and "--resume to continue from there" in done.out
    assert len(Trajectory.read_tum(tmp_path / "out" / "trajectory.txt")) == 3


@pytest.mark.usefixtures("undrawn")
def test_a_run_that_dies_leaves_nothing_that_looks_whole(gavo, clip, tmp_path, monkeypatch):
    arguments = ("run", clip, "--camera", clip / "camera.toml", *FAST, "--output", tmp_path / "out")
    assert gavo(*arguments).status == 0

    def dies(*arguments: Any, **settings: Any) -> Any:
        raise RuntimeError("power")

    monkeypatch.setattr(tracked, "track", dies)
    with pytest.raises(RuntimeError, match="power"):
        gavo(*arguments)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "bodies.csv",
        "config.json",
        "frames.csv",
        "trajectory.txt",
    ]


def test_refused_run_leaves_an_earlier_one_alone(gavo, clip, tmp_path):
    arguments = ("run", clip, "--camera", clip / "camera.toml", *FAST, "--output", tmp_path / "out")
    assert gavo(*arguments).status == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    images(clip, "rgb")[3].unlink()
    assert is_refused(gavo(*arguments), "missing")
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


@pytest.mark.usefixtures("undrawn")
def test_a_viewer_that_does_not_open_leaves_an_earlier_run_alone(gavo, clip, tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise RuntimeError("no window")

    arguments = ("run", clip, "--camera", clip / "camera.toml", *FAST, "--output", tmp_path / "out")
    assert gavo(*arguments).status == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    monkeypatch.setattr("gavo_jax.viewer.live.RerunViewer._open_window", fail)
    monkeypatch.setattr("gavo_jax.viewer.live._has_screen", lambda: True)
    assert is_refused(gavo(*arguments, "--viewer", "spawn"), "--viewer spawn")
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def write(name: str, text: str) -> Any:
    return lambda clip: (clip / name).write_text(text)


def replace_image(part: str, index: int, content: Any) -> Any:
    def damage(clip: Path) -> None:
        path = images(clip, part)[index]
        path.unlink() if content is None else path.write_bytes(content(clip))

    return damage


DAMAGES = {
    "missing folder": (shutil.rmtree, ["clip", "no such folder"]),
    "no rgb.txt": (lambda clip: (clip / "rgb.txt").unlink(), ["rgb.txt"]),
    "no depth.txt": (lambda clip: (clip / "depth.txt").unlink(), ["depth.txt"]),
    "empty list": (write("rgb.txt", "# nothing\n"), ["rgb.txt"]),
    "malformed line": (write("depth.txt", "not a line at all\n"), ["depth.txt:1"]),
    "path leaves the folder": (write("rgb.txt", "0.0 ../../etc/passwd\n"), ["rgb.txt:1"]),
    "missing image": (replace_image("depth", 1, None), ["depth/", "missing"]),
    "first frame is no image": (replace_image("rgb", 0, lambda clip: b"hello"), ["rgb/"]),
    "first depth of 8 bits": (
        replace_image("depth", 0, lambda clip: images(clip, "rgb")[0].read_bytes()),
        ["depth/", "16 bits"],
    ),
    "nothing associates": (write("depth.txt", "99.0 depth/0.000000.png\n"), ["rgb.txt", "depth.txt"]),
    "empty ground truth": (write("groundtruth.txt", ""), ["groundtruth.txt"]),
    "ground truth of NaN": (write("groundtruth.txt", "nan nan nan nan nan nan nan nan\n"), ["groundtruth.txt:1"]),
    "camera of another size": (lambda clip: None, ["160x120", "640x480"]),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_sequence_is_refused(gavo, clip, tmp_path, name):
    camera = tmp_path / "camera.toml"
    shutil.copy(clip / "camera.toml", camera)
    damage, words = DAMAGES[name]
    damage(clip)
    done = gavo("run", clip, "--camera", "fr1" if "another size" in name else camera, "--output", tmp_path / "out")
    assert is_refused(done, *words), done
    assert not (tmp_path / "out").exists()


BAD_OPTIONS = {
    "no method": (["--method", "nonsense"], ["--method", "gauss-newton"]),
    "no preset": (["--preset", "nonsense"], ["--preset"]),
    "no camera": (["--camera", "nonsense"], ["nonsense", "fr1"]),
    "no camera file": (["--camera", "nonsense.toml"], ["nonsense.toml"]),
    "camera by name of folder": (["--camera", "auto"], ["clip", "--camera"]),
    "one frame": (["--frames", "1"], ["--frames"]),
    "no frames": (["--frames", "0"], ["--frames"]),
    "text for frames": (["--frames", "many"], ["--frames"]),
    "start after the end": (["--start", "6"], ["clip", "start"]),
    "one frame left": (["--start", "5"], ["clip", "start"]),
    "negative start": (["--start", "-1"], ["--start"]),
    "no stride": (["--stride", "0"], ["--stride"]),
    "negative seed": (["--seed", "-1"], ["--seed"]),
    "unknown option": (["--nonsense"], ["--nonsense"]),
    "rate of stamps": (["--rate", "10"], ["clip", "--rate", "stamps"]),
    "topic of a folder": (["--depth-topic", "/depth"], ["clip", "--depth-topic", "TUM RGB-D folder"]),
    "no voxel": (["--voxel", "0"], ["voxel", "from"]),
    "negative voxel of a mesh": (["--map-shape", "mesh", "--voxel", "-5"], ["voxel", "not -5"]),
    "voxel of no map": (["--voxel", "0.02"], ["--voxel", "applies only with --map FILE"]),
    "shape of no map": (["--map-shape", "mesh"], ["--map-shape", "applies only with --map FILE"]),
    "output is a file": (["--output", "clip/rgb.txt"], ["clip/rgb.txt"]),
    "output below a file": (["--output", "clip/rgb.txt/out"], ["clip/rgb.txt/out"]),
}


@pytest.mark.parametrize("name", BAD_OPTIONS)
def test_bad_option_is_refused(gavo, clip, name):
    bad, words = BAD_OPTIONS[name]
    (clip / "camera.toml").rename("camera.toml")
    camera = [] if "--camera" in bad else ["--camera", "camera.toml"]
    assert is_refused(gavo("run", "clip", *camera, *bad), *words)


USAGE = {
    "": ("missing command: expected one of run, compare,",),
    "runn": ("unknown command 'runn'; did you mean 'run'?",),
    "help": ("unknown command 'help'; expected one of run, compare,",),
    "run --frame 3": ("unknown option --frame; did you mean --frames? (see gavo run --help)",),
    "run -- FOLDER --frames 3": ("--frames: comes after --, which ends the options (see gavo run --help)",),
    "run --solver ga": ("unknown option --solver; did you mean --method? (see gavo run --help)",),
    "doctor --solver": ("unknown option --solver (see gavo doctor --help)",),
    "run --xyzzy": ("unknown option --xyzzy (see",),
    "doctor --json": ("unknown option --json (see gavo doctor --help)",),
    "run one two": ("unexpected argument 'two'",),
    "run --frames ten": ("--frames: must be a whole number, not 'ten'",),
    "run --seed 1.5": ("--seed: must be a whole number, not '1.5'",),
    "run --voxel 1cm": ("--voxel: must be a number, not '1cm'",),
    "run --rate x": ("--rate: must be a number, not 'x'",),
    "run --seed": ("--seed: a value is missing",),
    "run --preset fst": ("--preset: 'fst' is not one of default, fast, paper, wide",),
    "run --bodies on": ("--bodies: 'on' is not one of mask, off, track",),
    "align a.png": ("missing: DEPTH0, RGB1, DEPTH1 (see gavo align --help)",),
}


@pytest.mark.parametrize("arguments", USAGE)
def test_usage_error_says_what_would_help(gavo, arguments):
    assert is_refused(gavo(*arguments.split()), *USAGE[arguments])


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        (("run", "synthetic", "--output", ""), "--output"),
        (("run", "synthetic", "--output="), "--output"),
        (("view", ""), "view"),
        (("view", " "), "view"),
        (("run", "synthetic", "--output=\t"), "--output"),
    ],
)
def test_an_empty_argument_is_not_the_current_folder(gavo, arguments, where):
    """A variable that is not set wrote a run's files wherever the user was."""
    assert is_refused(gavo(*arguments), f"{where}: empty argument; is a variable not set?")


def test_every_command_is_one_that_usage_knows():
    assert set(COMMANDS) == {get_args(one)[1].name for one in get_args(options.Command)}


@pytest.mark.parametrize(
    "command", [get_args(one)[0] for one in get_args(options.Command)], ids=lambda one: one.__name__
)
def test_every_command_is_a_function_of_its_name(command):
    name = command.__name__.lower()
    assert callable(getattr(importlib.import_module(f"gavo_jax.cli.{name}"), name))


@pytest.mark.parametrize("arguments", [(), ("nonsense",), ("align", "a.png"), ("evaluate", "one.txt")], ids=str)
def test_usage_error_is_one_line(gavo, arguments):
    assert is_refused(gavo(*arguments), "--help")


def test_align_prints_json(gavo, clip):
    rgb, depth = images(clip, "rgb"), images(clip, "depth")
    done = gavo("align", rgb[0], depth[0], rgb[2], depth[2], *FAST)
    assert done.status == 0, done.err
    answer = json.loads(done.out)
    assert answer["camera_from"] == str(clip / "camera.toml") and answer["depth_units_per_metre"] == 5000
    target_T_reference, covariance = np.array(answer["target_T_reference"]), np.array(answer["covariance"])
    assert target_T_reference.shape == (4, 4) and len(answer["xi"]) == 6 and answer["status"] == "ok"
    assert covariance.shape == (6, 6) and np.array_equal(covariance, covariance.T)
    truth = Trajectory.read_tum(clip / "groundtruth.txt").world_T_camera
    reference_T_target = np.linalg.inv(truth[0]) @ truth[2]
    assert np.linalg.norm((reference_T_target @ target_T_reference)[:3, 3]) < 0.01


def test_align_says_the_motion_in_words():
    target_T_reference = np.eye(4)
    target_T_reference[:3, 3] = -0.003, 0.0, 0.004
    words = in_words(no_alignment(AlignmentStatus.OK)._replace(target_T_reference=target_T_reference))
    assert "moved by 5.0 mm (3.0 mm right, 0.0 mm down, 4.0 mm back) and turned by 0.00 degrees" in words


def test_align_fits_a_terminal():
    longest = {
        "target_T_reference": np.full((4, 4), -1.23456789e-05),
        "xi": np.full(6, -1.23456789e-03),
        "covariance": np.full((6, 6), -1.23456789e-05),
    }
    text = json_text({name: rounded(value) for name, value in longest.items()})
    assert max(map(len, text.splitlines())) <= 80
    assert json.loads(text)["xi"][0] == -0.001235 and rounded(None) is None and rounded("ok") == "ok"
    assert np.isnan(rounded(np.array([np.nan])))
    assert rounded(np.float32(12.345678)) == 12.35 and rounded(6553.5) == 6553.5


@pytest.mark.parametrize("role", range(4))
@pytest.mark.parametrize("fault", ["missing", "text", "other kind", "folder"])
def test_align_refuses_a_bad_image(gavo, clip, role, fault):
    rgb, depth = images(clip, "rgb"), images(clip, "depth")
    files = [rgb[0], depth[0], rgb[1], depth[1]]
    text = clip / "text.png"
    text.write_text("hello")
    bad = {"missing": clip / "none.png", "text": text, "other kind": files[role ^ 1], "folder": clip}[fault]
    files[role] = bad
    assert is_refused(gavo("align", *files, "--camera", clip / "camera.toml"), str(bad))


def test_align_needs_a_camera_and_a_likely_unit(gavo, clip):
    rgb, depth = images(clip, "rgb")[0], images(clip, "depth")[0]
    (clip / "camera.toml").unlink()
    assert is_refused(gavo("align", rgb, depth, rgb, depth), "clip", "--camera")
    (clip / "intrinsics.txt").write_text(f"{CAMERA.fx} {CAMERA.fy} {CAMERA.cx} {CAMERA.cy}\n")
    assert is_refused(gavo("align", rgb, depth, rgb, depth, "--depth-scale", 1), str(depth), "--force")
    assert is_refused(gavo("align", rgb, depth, rgb, depth, "--depth-scale", 0), "--depth-scale", "0.001")


def test_align_does_not_mix_floats_and_whole_numbers(gavo, clip):
    """The other image's median was told of the one in metres; with the unit that was proposed the motion was wrong."""
    rgb, depth = images(clip, "rgb"), images(clip, "depth")
    raw = cv2.imread(str(depth[1]), cv2.IMREAD_UNCHANGED)
    assert raw is not None
    np.save(clip / "depth.npy", raw / np.float32(CAMERA.depth_scale))
    for pair in ((depth[0], clip / "depth.npy"), (clip / "depth.npy", depth[0])):
        done = gavo("align", rgb[0], pair[0], rgb[1], pair[1])
        assert is_refused(done, f"{depth[0]}: depth in whole numbers, but floats in {clip / 'depth.npy'}")


def test_align_says_which_images_unit_is_doubted(gavo, clip):
    rgb, depth = images(clip, "rgb"), images(clip, "depth")
    raw = cv2.imread(str(depth[1]), cv2.IMREAD_UNCHANGED)
    assert raw is not None
    depth[1].write_bytes(cv2.imencode(".png", raw // 50)[1].tobytes())
    assert is_refused(gavo("align", rgb[0], depth[0], rgb[1], depth[1]), f"{depth[1]}: depth with depth_scale")


def test_a_run_of_changed_settings_is_none_of_a_preset(gavo, clip, tmp_path, undrawn):
    for more, preset in (((), "default"), (("--set", "solver.patience=7"), None), (("--bodies", "off"), "default")):
        command = ("run", clip, "--camera", clip / "camera.toml", *FAST, "--frames", 3, "--output", tmp_path / "out")
        assert gavo(*command, *more).status == 0
        assert read_json(tmp_path / "out" / "metrics.json")["preset"] == preset


def test_align_takes_no_unit_from_nowhere_where_the_clip_cannot_be_read(gavo, clip):
    """Its lists are torn: what its depth counts is open if the camera's file does not say it."""
    rgb, depth = images(clip, "rgb"), images(clip, "depth")
    command = ["align", rgb[0], depth[0], rgb[1], depth[1], *FAST]
    (clip / "rgb.txt").write_text("hello\n")
    assert gavo(*command).status == 0
    (clip / "camera.toml").unlink()
    (clip / "intrinsics.txt").write_text(f"{CAMERA.fx} {CAMERA.fy} {CAMERA.cx} {CAMERA.cy}\n")
    assert is_refused(gavo(*command), "rgb.txt:1", "pass --depth-scale")
    assert gavo(*command, "--depth-scale", CAMERA.depth_scale).status == 0


def test_evaluate_refuses(gavo, clip):
    truth = clip / "groundtruth.txt"
    assert is_refused(gavo("evaluate", clip / "none.txt", truth), "none.txt")
    assert is_refused(gavo("evaluate", truth, truth, "--delta", 0), "gavo: --delta: must be a positive number, not 0")
    half = ("--delta", 0.5, "--unit", "frames")
    assert is_refused(gavo("evaluate", truth, truth, *half), "gavo: --delta: must be a whole number of frames, not 0.5")
    assert "over 1 frame, all pairs" in gavo("evaluate", truth, truth, "--delta", 1, "--unit", "frames").out
    assert is_refused(gavo("evaluate", truth, truth, "--delta", 100), "groundtruth.txt", "100", "--unit frames")
    later = clip / "later.txt"
    later.write_text("9000 0 0 0 0 0 0 1\n9002 0 0 0 0 0 0 1\n")
    assert is_refused(gavo("evaluate", later, truth), "later.txt", "9000.000 to 9002.000 s, the truth 0.000")


def stamped(folder: Path, name: str, first: float, unit: float, decimals: int) -> Path:
    """Forty poses of 30 Hz whose stamps count a unit."""
    times = first + np.arange(40) / 30 + 0.001 * (np.arange(40) % 3)
    rows = (f"{time / unit:.{decimals}f} {0.01 * i:.3f} 0 0 0 0 0 1\n" for i, time in enumerate(times))
    (folder / name).write_text("".join(rows))
    return folder / name


@pytest.mark.parametrize("first", [0.0, 77.0, 1305031102.175])
@pytest.mark.parametrize(("unit", "name"), [(1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")])
def test_evaluate_takes_whole_numbers_for_what_they_count(gavo, tmp_path, first, unit, name):
    odd, usual = stamped(tmp_path, "odd.txt", first, unit, 0), stamped(tmp_path, "usual.txt", first, 1.0, 6)
    for pair in ((odd, usual), (usual, odd), (odd, odd)):
        done = gavo("evaluate", *pair, "--json")
        assert done.status == 0, done.err
        assert json.loads(done.out)["ate"]["count"] == 40 and json.loads(done.out)["rpe_translation"]["rmse"] < 1e-6
    assert f"odd.txt: its stamps are taken as {name}" in gavo("evaluate", odd, usual).out


@pytest.mark.parametrize("first", [0.0, 77.0])
@pytest.mark.parametrize("whose", ["estimate", "truth"])
def test_evaluate_refuses_stamps_of_another_unit(gavo, tmp_path, first, whose):
    odd, usual = stamped(tmp_path, "odd.txt", first, 1e-3, 3), stamped(tmp_path, "usual.txt", first, 1.0, 6)
    pair = (odd, usual) if whose == "estimate" else (usual, odd)
    assert is_refused(gavo("evaluate", *pair), f"the stamps of the {whose} look like milliseconds", "seconds")


def test_evaluate_takes_numbers_of_frames_for_the_same_in_both_files(gavo, tmp_path):
    """Keyframes, of which the truth has every frame: their steps alone would be those of milliseconds."""
    sparse, every = tmp_path / "sparse.txt", tmp_path / "every.txt"
    row = "{} {:.3f} 0 0 0 0 0 1\n".format
    sparse.write_text("".join(row(i, 0.01 * i) for i in (0, 12, 25, 37, 50, 62, 74, 87, 99, 112)))
    every.write_text("".join(row(i, 0.01 * i) for i in range(140)))
    done = gavo("evaluate", sparse, every, "--unit", "frames", "--json")
    assert done.status == 0 and json.loads(done.out)["ate"]["count"] == 10, done.err


def test_evaluate_tells_quaternions_of_the_other_order(gavo, tmp_path):
    rows = [(i / 30, np.cos(i / 60), np.sin(i / 60) * 0.6, np.sin(i / 60) * 0.8) for i in range(60)]
    lines = {
        "right": (f"{t} 0 0 0 {x} 0 {z} {w}\n" for t, w, x, z in rows),
        "other": (f"{t} 0 0 0 {w} {x} 0 {z}\n" for t, w, x, z in rows),
    }
    for name, text in lines.items():
        (tmp_path / name).write_text("".join(text))
    words = "agree only if its quaternions are read as w x y z"
    assert f"other: its rotations {words}" in gavo("evaluate", tmp_path / "right", tmp_path / "other").out
    assert words not in gavo("evaluate", tmp_path / "right", tmp_path / "right").out


def test_a_truth_of_inverse_poses_in_other_axes_or_in_millimetres_is_told(gavo, pristine, tmp_path):
    """Of one in millimetres it was said that depth had 5 units per metre, which was refused; of other axes nothing."""
    source, camera = tmp_path / "source", ("--camera", pristine / "camera.toml")
    shutil.copytree(pristine, source)
    truth = Trajectory.read_tum(pristine / "groundtruth.txt")
    large = truth.world_T_camera * np.array([1, 1, 1, 1e3])
    large[:, 3, 3] = 1.0
    in_opengl = truth.world_T_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    for poses, words in (
        (inverse(truth.world_T_camera), "poses are inverted"),
        (large, "in millimetres"),
        (in_opengl, "x, y, z axes are the other's x, -y, -z"),
    ):
        replace(truth, world_T_camera=poses).write_tum(source / "groundtruth.txt")
        done = gavo("run", source, *camera, "--output", tmp_path / "out", *FAST)
        assert done.status == 0 and words in done.out and "units per metre (--depth-scale)" not in done.out, done.out
        done = gavo("evaluate", tmp_path / "out/trajectory.txt", source / "groundtruth.txt")
        assert words in done.out, done.out


@pytest.mark.parametrize("units", [CAMERA.depth_scale, 1.0])
def test_a_size_unlike_the_ground_truths_is_told(gavo, pristine, tmp_path, units):
    """As of depth in a unit that is plausible, and wrong; nothing within a run shows it."""
    source, camera, out = tmp_path / "source", ("--camera", pristine / "camera.toml"), tmp_path / "out"
    shutil.copytree(pristine, source)
    if units == 1:
        for file in images(source, "depth"):
            metres = np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), np.float32) / CAMERA.depth_scale
            cv2.imwrite(str(file.with_suffix(".tiff")), metres.astype(np.float32))
        (source / "depth.txt").write_text((source / "depth.txt").read_text().replace(".png", ".tiff"))
    done = gavo("run", source, *camera, "--depth-scale", 1.5 * units, "--output", out, *FAST)
    told = re.search(
        r"The trajectory has (0\.\d+) times the size of the ground truth\. .* depth had ([\d.]+) units", done.out
    )
    assert done.status == 0 and told, done.out
    assert float(told[1]) == pytest.approx(1 / 1.5, rel=0.05)
    assert float(told[2]) == pytest.approx(units, rel=0.05)
    truth = pristine / "groundtruth.txt"
    assert "times the size of" in gavo("evaluate", out / "trajectory.txt", truth).out
    assert "times the size" not in gavo("evaluate", truth, truth).out


def test_a_run_tells_depth_that_was_cut_off(gavo, pristine, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(pristine, source)
    files = list(images(source, "depth"))
    most = np.uint16(np.median(np.asarray(cv2.imread(str(files[0]), cv2.IMREAD_UNCHANGED))))
    for file in files:
        cv2.imwrite(str(file), np.minimum(np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)), most))
    done = gavo("run", source, "--camera", pristine / "camera.toml", "--output", tmp_path / "out", *FAST)
    assert done.status == 0 and re.search(r"depth in doubt: \d+ % of the readings are .* m, the farthest", done.out)


def test_dark_corners_are_told_and_the_camera_file_removes_them(gavo, pristine, tmp_path):
    """They draw the motion with them, most in corridors, and every pair is ok."""
    source, out = tmp_path / "source", tmp_path / "out"
    shutil.copytree(pristine, source)
    gain = vignetting_gain(replace(CAMERA, vignetting=(1.2, 0.36)))[..., None]
    for file in images(source, "rgb"):
        image = cv2.imread(str(file))
        assert image is not None
        cv2.imwrite(str(file), np.round(image / gain).astype(np.uint8))
    words = r"The images' corners are (\d+) % darker than their middle, .* gavo calibrate finds"
    told = re.search(words, gavo("run", source, "--output", out, *FAST).out)
    assert told and int(told[1]) == pytest.approx(45, abs=3)
    assert not re.search(words, gavo("run", pristine, "--output", out, *FAST).out)
    with (source / "camera.toml").open("a") as file:
        file.write("vignetting = [1.2, 0.36]\n")
    assert "vignetting [1.2, 0.36]" in gavo("inspect", source).out
    assert not re.search(words, gavo("run", source, "--output", out, *FAST).out)
    assert view._recorded_camera(read_run(out), out) == CAMERA.rectified()


def test_evaluate_tells_what_can_be_had(gavo, tmp_path):
    """A truth of 5 Hz between the estimate's stamps has no pose at any of them."""
    poses = np.tile(np.eye(4), (61, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(61)
    stamps = 100.0 + np.arange(61) / 30
    Trajectory(stamps, poses).write_tum(tmp_path / "estimate.txt")
    Trajectory(stamps[::6] + 0.005, poses[::6]).write_tum(tmp_path / "truth.txt")
    done = gavo("evaluate", "estimate.txt", "truth.txt", "--json")
    figures = json.loads(done.out)
    assert done.status == 0 and figures["rpe_translation"]["rmse"] < 0.01 and figures["ate"]["rmse"] < 0.01
    assert figures["distance_error"] is None and "distance error: the ground truth covers no pose" in done.err
    assert "distance error: the ground truth" in gavo("evaluate", "estimate.txt", "truth.txt").out


def test_evaluate_tells_how_much_the_truth_covers(gavo, tmp_path):
    """The errors were of a third of the trajectory, which only their number showed."""
    poses = np.tile(np.eye(4), (91, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(91)
    stamps = 100.0 + np.arange(91) / 30
    Trajectory(stamps, poses).write_tum(tmp_path / "estimate.txt")
    Trajectory(stamps[:46], poses[:46]).write_tum(tmp_path / "truth.txt")
    assert "The ground truth covers 46 of 91 poses" in gavo("evaluate", "estimate.txt", "truth.txt").out
    assert "covers" not in gavo("evaluate", "truth.txt", "estimate.txt").out


def test_evaluate_as_json_and_figures(gavo, clip, tmp_path):
    truth = clip / "groundtruth.txt"
    done = gavo("evaluate", truth, truth, "--delta", 1, "--unit", "frames", "--json", "--plot", tmp_path / "figures")
    assert done.status == 0, done.err
    answer = json.loads(done.out)
    assert answer["ate"]["rmse"] < 1e-9 and answer["rpe_rotation"]["unit"] == "deg" and answer["delta"] == 1
    assert (tmp_path / "figures" / "trajectory.png").exists() and (tmp_path / "figures" / "distance_error.svg").exists()


def test_compare(gavo, pristine, tmp_path):
    arguments = ("compare", pristine, "--camera", pristine / "camera.toml", "--output", tmp_path / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "comparison.json").write_text("[]")
    done = gavo(*arguments, "--methods", "gauss-newton,opencv-rgb", "--frames", 34)
    assert done.status == 0, done.err
    assert "gauss-newton" in done.out and "opencv-rgb" in done.out
    lines = done.out.splitlines()
    assert max(len(line) for line in lines if line.startswith(("┃", "│"))) <= 80 and "decoding included" in lines[-2]
    assert "the earlier comparison in" in lines[0] and "34 frames" in lines[1] and "camera fx" in lines[1]
    table = read_json(tmp_path / "out" / "comparison.json")
    assert [row["method"] for row in table] == ["gauss-newton", "opencv-rgb"]
    assert all(set(METRICS) <= set(row) and row["frames"] == 34 for row in table)
    assert table[0]["rpe_translation_rmse_m_per_s"] < 0.1 and table[1]["rpe_translation_rmse_m_per_s"] < 0.5
    figures = ("trajectory", "distance_error", "drift")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "comparison.json",
        "report.html",
        "gauss-newton.txt",
        "opencv-rgb.txt",
        *(f"{name}.{suffix}" for name in figures for suffix in ("png", "svg")),
    }
    report = (tmp_path / "out" / "report.html").read_text()
    assert f"<td>{table[1]['rpe_translation_rmse_m_per_s']:.4f}</td>" in report and report.count("<img") == 3


@pytest.mark.usefixtures("undrawn")
def test_compare_without_truth_tells_of_the_paths(gavo, clip, tmp_path):
    (clip / "groundtruth.txt").unlink()
    arguments = ("compare", clip, "--camera", clip / "camera.toml", "--output", tmp_path / "out")
    done = gavo(*arguments, "--methods", "gauss-newton,opencv-rgbd")
    assert done.status == 0, done.err
    lines = done.out.splitlines()
    [heads] = [line for line in lines if line.startswith("┃")]
    assert "path m ┃" in heads and "end m: x y z ┃" in heads and len(heads) <= 80
    [row] = [line for line in lines if line.startswith("│ gauss-newton")]
    assert re.search(r"│ +\d\.\d{4} │ [+-]\d\.\d{4} [+-]\d\.\d{4} [+-]\d\.\d{4} │", row)
    assert any(line.startswith("end: position seen from the first frame") for line in lines)


def test_run_is_recorded_and_viewed_again(gavo, clip, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ("run", "clip", "--camera", "clip/camera.toml", *GENETIC, "--output", "out", "--viewer", "save")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "config.json").write_text('{"odometry": {}}')
    done = gavo(*arguments)
    assert done.status == 0 and "the earlier run in out is replaced" in done.out, done
    assert (tmp_path / "out" / "run.rrd").stat().st_size and (tmp_path / "out" / "population.svg").exists()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    done = gavo("view", "../out", "--viewer", "save")
    assert done.status == 0 and not done.err, done
    whole = (tmp_path / "out" / "view.rrd").stat().st_size
    shutil.rmtree(clip)
    done = gavo("view", "../out", "--viewer", "save")
    assert done.status == 0 and done.err.count("\n") == 1 and "no such folder" in done.err
    assert 0 < (tmp_path / "out" / "view.rrd").stat().st_size < whole / 2


@pytest.mark.parametrize(("lost", "origin"), [(True, "guessed"), (False, "relocalised"), (False, "tracked")])
def test_view_compares_motions_of_the_search_alone(monkeypatch, capsys, lost, origin):
    """Of a lost pair the files have what was recorded, of a relocalised one the way from a keyframe: it was said that
    the search comes out elsewhere.
    """
    found = no_alignment(AlignmentStatus.OK)._replace(target_T_reference=exp(np.full(6, 0.1)))
    [recorded, now] = [
        Step(1, 0.0, 0.1, alignment, np.eye(4), 1.0, lost, origin=origin)
        for alignment in (no_alignment(AlignmentStatus.OK), found)
    ]
    monkeypatch.setattr(view, "track", lambda *_, **__: iter([now]))
    monkeypatch.setattr(view, "be_ready", lambda: None)
    run: Any = SimpleNamespace(steps=[recorded])
    driver: Any = SimpleNamespace(warm_up=lambda: 0.0)
    unmoved: Any = None
    view._show_with_search(run, unmoved, SyntheticSequence(2), driver, NO_VIEWER)
    assert ("the repeated search differs" in capsys.readouterr().err) == (origin == "tracked")


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("fault", ["frames.csv", "trajectory.txt", "config.json"])
def test_view_refuses_what_is_no_run(gavo, clip, tmp_path, fault):
    assert is_refused(gavo("view", "nowhere"), "nowhere: no such folder", "output folder")
    assert is_refused(gavo("view", clip / "camera.toml"), "camera.toml: not a folder", "output folder")
    assert gavo("run", clip, "--camera", clip / "camera.toml", *FAST, "--output", "out").status == 0
    path = tmp_path / "out" / fault
    path.write_text("index\n7\n" if fault == "frames.csv" else "{")
    assert is_refused(gavo("view", "out", "--viewer", "save"), fault)
    path.unlink()
    why = "not an output folder of `gavo run`" if fault == "config.json" else "no such file"
    assert is_refused(gavo("view", "out", "--viewer", "save"), fault, why)
    assert not (tmp_path / "out" / "view.rrd").exists()


def test_a_method_that_the_settings_contradict_is_told(gavo, pristine, tmp_path):
    """What the file names counts, and the option was left aside without a word."""
    (tmp_path / "own.toml").write_text('method = "gauss-newton"\npreset = "fast"\n')
    source = ("run", pristine, "--camera", pristine / "camera.toml", "--settings", tmp_path / "own.toml")
    assert is_refused(gavo(*source, "--method", "pso"), "--method pso: ", "says gauss-newton", "omit one of them")
    assert is_refused(gavo(*source, "--preset", "wide"), "--preset wide: ", "says fast")
    assert is_refused(gavo(*source, "--method", "ga"), "--method ga: ", "says gauss-newton"), "though the default"
    assert is_refused(gavo(*source, "--preset", "default"), "--preset default: ", "says fast")
    done = gavo(*source, "--frames", 3, "--output", tmp_path / "out")
    assert done.status == 0, done.err
    assert read_json(tmp_path / "out" / "metrics.json")["preset"] == "fast", "as the file says, though none is given"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run", "--set", "odometry.bodies=off", "--bodies", "track"), "--bodies: --set odometry.bodies says the same"),
        (("run", "--set", "odometry.loops=false", "--loops"), "--loops: --set odometry.loops says the same"),
        (("align", "a", "b", "c", "d", "--set", "odometry.bodies=track"), "odometry.bodies applies to runs only"),
    ],
)
def test_options_that_overrule_others_are_refused(gavo, arguments, words):
    """One of two that contradict each other was left aside without a word, as was one without effect."""
    assert is_refused(gavo(*arguments), words)


def test_presets_of_one_method_are_compared(gavo, pristine, tmp_path):
    """A method of one's own, which has `default` alone, could not stand beside a preset of another one."""
    arguments = ("compare", pristine, "--camera", pristine / "camera.toml", "--frames", 4, "--output", tmp_path / "out")
    done = gavo(*arguments, "--preset", "fast", "--methods", "gauss-newton,gauss-newton:default")
    assert done.status == 0, done.err
    found = {(run["method"], run["preset"]) for run in read_json(tmp_path / "out" / "comparison.json")}
    assert found == {("gauss-newton", "fast"), ("gauss-newton", "default")} and "gauss-newton:default" in done.out
    names = {path.name for path in (tmp_path / "out").glob("*.txt")}
    assert names == {"gauss-newton.txt", "gauss-newton-default.txt"}
    for methods, words in (
        ("gauss-newton:fast,gauss-newton", "--methods: gauss-newton is given twice"),
        ("orb-pnp:fast", "orb-pnp:fast: another library's method has no preset"),
        ("gauss-newton:slow", "--methods: gauss-newton:slow: unknown preset 'slow'"),
        ("newton:fast", "unknown method 'newton'"),
    ):
        assert is_refused(gavo(*arguments, "--preset", "fast", "--methods", methods), words)
    assert gavo(*arguments, "--methods", "orb-pnp").status == 0
    assert {path.name for path in (tmp_path / "out").glob("*.txt")} == {"orb-pnp.txt"}


def test_an_interrupted_comparison_says_so(gavo, pristine, tmp_path, monkeypatch):
    """It printed its table and `files in`, as if it were whole."""
    run_contender = compare._run_contender

    def interrupted(sequence, contender, *rest):
        if contender.method == "opencv-rgb":
            raise KeyboardInterrupt
        return run_contender(sequence, contender, *rest)

    monkeypatch.setattr(compare, "_run_contender", interrupted)
    names = "opencv-rgbd,opencv-rgb,sift-pnp"
    arguments = ("compare", pristine, "--camera", pristine / "camera.toml", "--frames", 5, "--methods", names)
    done = gavo(*arguments, "--output", tmp_path / "out")
    assert done.status == 130 and "interrupted: 1 of 3 runs were done" in done.err
    assert "interrupted: 1 of 3 runs were done" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("drifts", "typical"), [((0.1, None, 0.3), 2), ((0.2, None, None), 1), ((None, 0.2), 1), ((None, None), 0)]
)
def test_a_lost_run_is_worse_than_any_other(drifts, typical):
    """With one lost run, the first seed stood in the table, though another was in the middle."""
    figures = [{compare.DRIFT: drift, compare.ROTATION_DRIFT: drift} for drift in drifts]
    one = Trajectory(np.zeros(1), np.eye(4)[None])
    runs = [compare.Entry("ga", metrics, one) for metrics in figures]
    assert compare._typical_runs(runs) == [runs[typical]]


def test_a_range_with_a_lost_run_has_no_end():
    """It spanned the runs that were left, and the figure was left out without a word."""
    one = Trajectory(np.zeros(1), np.eye(4)[None])
    figures = dict.fromkeys((key for _, key, _ in compare.COLUMNS), 0.02) | {"segments": 1}
    lost = figures | {compare.DRIFT: None, compare.ROTATION_DRIFT: None}
    runs = [compare.Entry("ga", metrics, one) for metrics in (lost, figures, figures)]
    (row,) = compare._rows(runs, compare._typical_runs(runs))
    assert row[-3:] == [3, "0.0200", compare.DASH]
    assert compare._drifts(runs)["ga"][:, 0].tolist() == [np.inf, 0.02, 0.02]
    (line,) = compare._without_drift(runs)
    assert line.startswith("No drift in 1 of 3 runs of ga, which count as infinite")
    assert compare._drifts(runs[:1]) == {} and compare._without_drift(runs[:1]) == []


@pytest.mark.parametrize("name", ["report.html", "ga.txt", "drift.svg", "trajectory.png", "experiment.json"])
def test_compare_replaces_only_what_a_comparison_wrote(gavo, pristine, tmp_path, name):
    """A user's own files were removed or replaced, and an experiment's report, without a word."""
    (tmp_path / name).write_text("mine")
    source = (pristine, "--camera", pristine / "camera.toml", "--frames", 5, "--methods", "opencv-rgb")
    assert is_refused(gavo("compare", *source, "--output", tmp_path), name, "choose another folder")
    assert (tmp_path / name).read_text() == "mine"


def test_results_of_two_kinds_do_not_share_a_folder(gavo, pristine, tmp_path):
    """Figures have the same names: a comparison replaced a finished run's, and a run a comparison's."""
    for name, file in (("run", "frames.csv"), ("both", "comparison.json")):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).write_text("")
    source = (pristine, "--camera", pristine / "camera.toml", "--frames", 5)
    truth = pristine / "groundtruth.txt"
    for arguments, word in (
        (("compare", *source, "--methods", "opencv-rgb", "--output", tmp_path / "run"), "run"),
        (("evaluate", truth, truth, "--plot", tmp_path / "run"), "run"),
        (("evaluate", truth, truth, "--plot", tmp_path / "both"), "comparison"),
        (("run", *source, "--method", "gauss-newton", "--output", tmp_path / "both"), "comparison"),
    ):
        assert is_refused(gavo(*arguments), f"contains a {word}", "choose another folder")


@pytest.mark.parametrize(
    "arguments", [("view", "a" * 300), ("align", "a" * 300, "b", "c", "d"), ("inspect", "a" * 300)]
)
def test_a_name_that_no_file_can_have_is_one_line(gavo, arguments):
    assert is_refused(gavo(*arguments), "aaaa")


@pytest.mark.parametrize("methods", ["nonsense", "", "ga,,pso", "ga,ga"])
def test_compare_refuses_methods(gavo, clip, methods):
    assert is_refused(gavo("compare", clip, "--camera", clip / "camera.toml", "--methods", methods), "--methods")


def test_compare_refuses_a_method_without_the_preset_before_it_replaces_anything(gavo, clip, monkeypatch):
    monkeypatch.setattr(presets, "_registered", {"own": presets.preset("gauss-newton", "fast")})
    out = clip / "out"
    out.mkdir()
    (out / "comparison.json").write_text("{}")
    command = ("compare", clip, "--methods", "ga,own", "--preset", "fast", "--output", out)
    assert is_refused(gavo(*command), "'own' has no preset 'fast'")
    assert (out / "comparison.json").read_text() == "{}"


def test_names_of_options_are_those_of_the_presets():
    assert options.METHOD == "{" + ",".join(METHODS) + "}"
    assert get_args(options.PresetName) == PRESETS


@pytest.mark.parametrize(
    ("encoding", "arguments"),
    [
        ("latin-1", ["--help"]),
        ("latin-1", ["run", "--help"]),
        ("latin-1", ["evaluate", "\u2192.txt", "b.txt"]),
        ("utf-16", ["evaluate", "\u2192.txt", "b.txt"]),
    ],
)
def test_any_encoding_of_the_screen_will_do(encoding, arguments):
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "1"}
    done = subprocess.run([sys.executable, "-m", "gavo_jax", *arguments], capture_output=True, env=environment)
    assert done.returncode == (0 if "--help" in arguments else 2), done.stderr
    assert b"Traceback" not in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="closes a stream by the shell")
@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-"])
@pytest.mark.parametrize(("words", "status"), [("--help", 0), ("evaluate a.txt b.txt", 2)])
def test_a_closed_stream_is_no_fault(closed, words, status):
    command = f"'{sys.executable}' -m gavo_jax {words} {closed}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True)
    assert done.returncode == status and "Traceback" not in done.stderr


@pytest.mark.parametrize("variable", ["JAX_PLATFORMS", "JAX_DEFAULT_DEVICE"])
@pytest.mark.parametrize(
    ("command", "told"), [("run", ""), ("experiment plan.toml --output out", ""), ("doctor", "gavo-jax: ")]
)
def test_without_a_device_nothing_is_begun_and_one_line_says_so(variable, command, told, tmp_path):
    """A device that is asked for and not there was a traceback. The versions are for an issue."""
    plan = tmp_path / "plan.toml"
    plan.write_text('[[sequences]]\npath = "synthetic"\n[[methods]]\nname = "ga"\n')
    environment = {**os.environ, variable: "tpu"}
    words = [sys.executable, "-m", "gavo_jax", *command.split()]
    done = subprocess.run(words, capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert bool(done.stdout) == bool(told) and done.stdout.startswith(told)
    assert is_refused(Done(done.returncode, "", done.stderr), "JAX has no device", f"{variable}='tpu'")
    assert list(tmp_path.iterdir()) == [plan]


def test_help_and_version(gavo):
    assert "compare" in gavo("--help").out
    assert "--on-lost" in gavo("run", "--help").out
    assert gavo("--version").out.startswith("gavo-jax ")
    assert re.search(" --version +print the version and exit ", gavo("--help").out)
    for words in (("run", "--help"), ("run", "--version", "--help")):
        assert "--version" not in gavo(*words).out


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_pages_of_help_fit_the_screen(gavo, monkeypatch, command):
    monkeypatch.setenv("COLUMNS", "80")
    page = gavo(*command.split(), "--help").out
    assert not [line for line in page.splitlines() if len(line) > 80]
    assert ("realsense" in page) == (command == "run")


def test_no_text_of_an_option_has_lines_of_its_own():
    """They would end where the source's do."""
    texts = re.findall(r'^    """([^"]*)"""$', Path(options.__file__).read_text(encoding="utf-8"), re.M)
    assert len(texts) > 40 and not [text for text in texts if "\n" in text and "\n\n" not in text]


def test_help_tells_what_an_option_does_once_it_is_given(gavo):
    assert "Do not track the frames again" in " ".join(gavo("view", "--help").out.replace("│", "").split())
    for words in (("experiment", "--help"), ("experiment", "report", "--help")):
        assert "{FILE.toml,report} [DIR]" in gavo(*words).out.splitlines()[0]


def test_help_lists_every_method_a_package_brings_and_loads_none(tmp_path):
    """The package is broken: that is told where its method is used, and not by the help."""
    info = tmp_path / "quick-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: quick\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[gavo_jax.solvers]\nquick = no_such_package:SOLVER\n")
    places = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": places, "COLUMNS": "80"}
    for command, names in (("run", "{ga,pso,gauss-newton,adam,quick}"), ("compare", "adam, quick, opencv-rgb")):
        done = subprocess.run(
            [sys.executable, "-m", "gavo_jax", command, "--help"], capture_output=True, text=True, env=environment
        )
        assert done.returncode == 0, done.stderr
        assert names in " ".join(done.stdout.replace("│", "").split())


def test_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "gavo_jax", "run", "nowhere", "--camera", "fr1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert is_refused(Done(done.returncode, done.stdout, done.stderr), "nowhere")


def test_real_clip(gavo, data_dir, tmp_path):
    """By its name the folder brings its camera; the drift over the first second is that of a working odometry."""
    done = gavo("run", data_dir / "fr1_xyz", *FAST, "--frames", 34, "--output", tmp_path / "out")
    assert done.status == 0, done.err
    assert read_json(tmp_path / "out" / "metrics.json")["rpe_translation_rmse_m_per_s"] < 0.05
