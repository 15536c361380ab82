"""Sources of any kind on the command line: `gavo inspect`, and what `gavo run` says and refuses of them."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import GENETIC, Done, runner
from written_bags import COLOR, DEPTH, KINDS, Shot, record
from written_folders import CAMERA, LAYOUTS, POSES, image

from gavo_jax.cli.options import Source
from gavo_jax.cli.selection import open_sequence
from gavo_jax.datasets.layouts.tum_writing import write_tum
from gavo_jax.datasets.rendered.sensor_noise import KINECT
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.trajectory import Trajectory

INFO = "/camera/color/camera_info"
FAST = ("--method", "gauss-newton")

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def gavo(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return runner(capsys)


@pytest.fixture(scope="module")
def pristine(tmp_path_factory) -> Path:
    """Eight frames with a Kinect's noise: no test changes them."""
    folder = tmp_path_factory.mktemp("clips") / "clip"
    write_tum(SyntheticSequence(frames=8, noise=KINECT, camera=CAMERA), folder)
    return folder


@pytest.fixture
def clip(pristine, tmp_path) -> Path:
    """The same, to be damaged."""
    return shutil.copytree(pristine, tmp_path / "clip")


def is_refused(done: Done, *words: str) -> bool:
    return done.status == 2 and not done.out and done.err.count("\n") == 1 and all(word in done.err for word in words)


WITH_TIMES = (
    "tum",
    "stray",
    "arkit_scenes",
    "open_loris",
    "tartan_air_2",
    "virtual_kitti",
    "airsim",
    "rtabmap",
    "scannet_plus_plus",
    "scanner_app",
    "polycam",
)
"""Layouts whose frames say when they were taken."""


@pytest.mark.parametrize("name", LAYOUTS)
def test_run_needs_nothing_but_the_folder_and_says_which_camera(gavo, tmp_path, name):
    (tmp_path / "clip").mkdir() if name != "tum" else None
    LAYOUTS[name][1](tmp_path / "clip")
    done = gavo("run", "clip", *FAST, "--output", "out")
    assert done.status == 0, done.err
    first = done.out.splitlines()[0]
    guess = "stamps are numbers" if name == "associations" else "names are numbers"
    rate = "" if name in WITH_TIMES else f" at 30 frames/s ({guess})"
    assert first.startswith(
        f"clip: {LAYOUTS[name][0]}, 4 frames of 160x120{rate}; camera fx 131 fy 131 cx 79.5 cy 59.5 (clip/"
    )
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["lost_pairs"] == 0


FIRST_AND_THIRD = {
    "tum": ("rgb/{}.png", "depth/{}.png", "0.000000", "0.066667"),
    "seven_scenes": ("frame-{}.color.png", "frame-{}.depth.png", "000000", "000002"),
    "scannet": ("color/{}.jpg", "depth/{}.png", "0", "2"),
    "replica": ("results/frame{}.jpg", "results/depth{}.png", "000000", "000002"),
    "open3d": ("color/{}.jpg", "depth/{}.png", "000001", "000003"),
    "plain": ("rgb/{}.png", "depth/{}.tiff", "0", "2"),
    "one_folder": ("color_{}.png", "depth_{}.npy", "000", "002"),
}


@pytest.mark.parametrize("layout", FIRST_AND_THIRD)
def test_a_pair_of_a_source_has_its_camera_and_its_unit(gavo, tmp_path, layout):
    clip = tmp_path / "clip"
    clip.mkdir() if layout != "tum" else None
    LAYOUTS[layout][1](clip)
    color, depth, *names = FIRST_AND_THIRD[layout]
    done = gavo("align", *(clip / form.format(name) for name in names for form in (color, depth)), *FAST)
    assert done.status == 0, done.err
    answer = json.loads(done.out)
    units = {"tum": 5000, "replica": 6553.5, "plain": 1, "one_folder": 1}.get(layout, 1000)
    assert answer["depth_units_per_metre"] == units and str(clip) in answer["camera_from"]
    target_T_reference = np.linalg.inv(POSES[2]) @ POSES[0]
    np.testing.assert_allclose(np.array(answer["target_T_reference"])[:3, 3], target_T_reference[:3, 3], atol=2e-3)


@pytest.mark.parametrize("part", ["rgb", "rgb/late"])
@pytest.mark.parametrize("is_whole", [True, False])
def test_a_pair_named_from_within_its_folder_is_of_the_same_source(gavo, clip, monkeypatch, part, is_whole):
    """`../0.png` was looked for beside the folder that it leaves."""
    (clip / "rgb/late").mkdir()
    if not is_whole:
        (clip / "rgb.txt").unlink()
        (clip / "camera.toml").write_text("fx = 140\nfy = 140\ncx = 79.5\ncy = 59.5\nwidth = 160\nheight = 120\n")
    monkeypatch.chdir(clip / part)
    up = "../" * part.count("/")
    names = [f"{up}{there}/{stamp}.png" for stamp in ("0.000000", "0.033333") for there in (".", "../depth")]
    done = gavo("align", *names, *FAST, *(() if is_whole else ("--depth-scale", 5000)))
    assert done.status == 0, done.err
    assert "camera.toml" in json.loads(done.out)["camera_from"]


@pytest.mark.parametrize("fault", [False, True])
def test_a_pair_of_airsim_has_its_depth_the_right_way_up(gavo, tmp_path, fault):
    """Its PFM files run from the top, which only the recording as a whole knew."""
    clip = tmp_path / "clip"
    LAYOUTS["airsim"][1](clip)
    colors, depths = (sorted(clip.glob(f"images/img_SimpleFlight_0_{kind}")) for kind in ("0_*", "1_*"))
    if fault:
        (clip / "groundtruth.txt").write_text("nonsense\n")
    unit = ("--depth-scale", 1) if fault else ()
    done = gavo("align", colors[0], depths[0], colors[2], depths[2], *FAST, *unit)
    assert done.status == 0, done.err
    target_T_reference = np.linalg.inv(POSES[2]) @ POSES[0]
    np.testing.assert_allclose(np.array(json.loads(done.out)["target_T_reference"]), target_T_reference, atol=2e-3)


def test_a_pair_is_aligned_whatever_is_wrong_with_the_rest_of_its_source(gavo, clip):
    names = [clip / f"{part}/{stamp}.png" for stamp in ("0.000000", "0.033333") for part in ("rgb", "depth")]
    (clip / "groundtruth.txt").write_text("nonsense\n")
    assert gavo("align", *names, *FAST).status == 0
    assert is_refused(gavo("align", names[0], clip, *names[2:]), f"{clip}: not a file")
    assert is_refused(gavo("align", clip / "none.png", *names[1:]), "none.png: no such file")


def test_a_folder_in_the_place_of_a_file_is_refused_before_the_run(gavo, clip):
    Path("map.ply").mkdir()
    Path("camera.toml").mkdir()
    assert is_refused(gavo("run", clip, *FAST, "--map", "map.ply", "--output", "out"), "map.ply: is a folder")
    assert is_refused(gavo("calibrate", clip), "camera.toml: is a folder") and not Path("out").exists()


def test_a_folder_that_is_closed_to_the_map_is_told_before_the_run(gavo, clip, monkeypatch):
    Path("closed").mkdir()
    monkeypatch.setattr("os.access", lambda path, mode: Path(path).name != "closed")  # all folders are open to root
    refused = gavo("run", clip, *FAST, "--map", "closed/map.ply", "--output", "out")
    assert is_refused(refused, "closed/map.ply: cannot be written") and not Path("out").exists()


def test_calibrate_replaces_no_camera_file_that_nobody_named(gavo, clip, monkeypatch):
    """In the folder of a sequence that file may be the dataset's own."""
    monkeypatch.chdir(clip)
    before = Path("camera.toml").read_bytes()
    assert is_refused(gavo("calibrate", "."), "camera.toml: already exists", "--output")
    assert Path("camera.toml").read_bytes() == before


def test_inspect_says_what_a_source_is(gavo, clip):
    done = gavo("inspect", clip)
    assert done.status == 0 and not done.err
    lines = dict(line.split(": ", 1) for line in done.out.splitlines())
    assert lines["source"] == "clip, TUM RGB-D folder" and lines["frames used"] == "8 of 8"
    assert "30.0 frames/s, no gap" in lines["time"]
    assert lines["camera"].startswith("160x120, fx 131 fy 131 cx 79.5 cy 59.5, from")
    assert "5000 per metre" in lines["depth"] and "8 of 8 frames covered" in lines["ground truth"]


def test_inspect_tells_of_depth_that_stands_still(gavo, clip):
    for file in sorted((clip / "depth").iterdir())[1:]:
        file.write_bytes(sorted((clip / "depth").iterdir())[0].read_bytes())
    done = gavo("inspect", clip)
    assert (
        done.status == 0
        and "frames used: 8 of 8\nof these, 7 frozen: depth repeats that of the previous frame" in done.out
    )


def test_inspect_tells_of_an_image_that_stands_still_in_part(gavo, clip):
    """It ended in a traceback."""
    grey, last = (sorted((clip / "rgb").iterdir())[at] for at in (-2, -1))
    before, image = (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in (grey, last))
    assert before is not None and image is not None
    image[60:] = before[60:]
    assert cv2.imwrite(str(last), image)
    done = gavo("inspect", clip)
    assert done.status == 0 and "\nof these, 1 moving_body: part of the image repeats the previous one" in done.out


def test_inspect_tells_of_depth_that_is_mirrored(gavo, data_dir, tmp_path):
    source, folder = data_dir / "fr1_desk", tmp_path / "mirrored"
    folder.mkdir()
    (folder / "rgb").symlink_to(source / "rgb", target_is_directory=True)
    for name in ("rgb.txt", "depth.txt"):
        (folder / name).write_text("\n".join((source / name).read_text().splitlines()[:24]) + "\n")
    (folder / "depth").mkdir()
    for file in sorted((source / "depth").iterdir())[:24]:
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert depth is not None and cv2.imwrite(str(folder / "depth" / file.name), depth[:, ::-1])
    done = gavo("inspect", folder, "--camera", "fr1")
    assert done.status == 0
    assert "depth image: WRONG? mirrored relative to the colour image, judging by the edges of both\n" in done.out
    assert "WRONG" not in gavo("inspect", source, "--frames", 21, "--camera", "fr1").out


def test_inspect_does_not_say_that_a_frame_after_a_gap_is_used_in_part(gavo, clip):
    lists = [clip / "rgb.txt", clip / "depth.txt"]
    for path in lists:
        rows = path.read_text().splitlines()
        path.write_text("\n".join(rows[:-4] + rows[-1:]) + "\n")
    done = gavo("inspect", clip)
    assert done.status == 0 and "of these, 1 gap: frames are missing before it; used in full\n" in done.out
    assert re.search(r"frames/s, 1 gap of \d\.\d\d s\n", done.out)


def test_inspect_counts_frames_that_no_camera_of_that_rate_takes(gavo, clip):
    for path in (clip / "rgb.txt", clip / "depth.txt"):
        *rows, last = path.read_text().splitlines()
        path.write_text("\n".join([*rows, f"{float(rows[-1].split()[0]) + 0.004:.6f} {last.split()[1]}"]) + "\n")
    done = gavo("inspect", clip)
    assert done.status == 0 and "frames/s, no gap, 1 frame too soon after the last\n" in done.out


def test_inspect_as_json_counts_what_cannot_be_used(gavo, clip):
    rows = (clip / "rgb.txt").read_text().splitlines()
    torn, frozen = (clip / rows[at].split()[1] for at in (4, 7))
    torn.write_bytes(torn.read_bytes()[:2000])
    frozen.write_bytes((clip / rows[6].split()[1]).read_bytes())
    (clip / "depth.txt").write_text("\n".join((clip / "depth.txt").read_text().splitlines()[:-1]) + "\n")
    done = gavo("inspect", clip, "--json", "--camera", clip / "camera.toml")
    assert done.status == 0, done.err
    facts = json.loads(done.out)
    assert [facts[key] for key in ("kind", "frames", "frames_used")] == ["TUM RGB-D folder", 7, 5]
    assert facts["frames_not_used"] == {"unreadable": 1, "frozen": 1} and torn.name in facts["why_not"][0]
    assert facts["left_out"] == ["1 colour images: no depth image within 0.02 s that is not paired with another"]
    assert facts["rate_hz"] == pytest.approx(30, rel=1e-3) and facts["gaps"] == facts["too_soon"] == 0
    assert facts["delay_of_depth_ms"] == {"median": 0, "least": 0, "most": 0}
    assert facts["camera"]["fx"] == 131 and facts["camera_from"].endswith("camera.toml")
    depth = facts["depth"]
    assert 0.5 < depth["near_m"] < depth["median_m"] < depth["far_m"] < 8 and depth["fault"] is None
    assert 0.5 < depth["coverage"] <= 1 and facts["depth_units_per_metre"] == 5000
    assert facts["ground_truth"]["frames_covered"] == 7 and facts["ground_truth"]["path_m"] > 0


def test_a_wrong_depth_scale_is_refused_and_shown(gavo, clip):
    done = gavo("run", clip, *FAST, "--depth-scale", 1000, "--output", "out")
    assert is_refused(done, "clip: ", "5000", "--depth-scale 5000", "--force") and not Path("out").exists()
    done = gavo("inspect", clip, "--depth-scale", 1000)
    assert done.status == 0 and "depth scale: WRONG? " in done.out
    assert gavo("run", clip, *FAST, "--depth-scale", 1000, "--force", "--frames", 2, "--output", "out").status == 0


def test_run_says_what_makes_no_frame(gavo, clip, tmp_path):
    rows = (clip / "depth.txt").read_text().splitlines(True)
    (clip / "depth.txt").write_text("".join(rows[:4] + rows[6:]))
    done = gavo("run", clip, *FAST, "--output", "out")
    line = "2 colour images: no depth image within 0.02 s that is not paired with another"
    assert (
        done.status == 0 and done.out.splitlines()[1] == "left out: 2 colour images; metrics.json says why (left_out)"
    )
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["left_out"] == [line]


def test_view_finds_the_source_of_a_run_again(gavo, tmp_path):
    (tmp_path / "clip").mkdir()
    LAYOUTS["seven_scenes"][1](tmp_path / "clip")
    assert gavo("run", "clip", *GENETIC, "--rate", 15, "--output", "out").status == 0
    done = gavo("view", "out", "--viewer", "save")
    assert done.status == 0 and not done.err, done


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_runs_by_its_name_alone(gavo, tmp_path, kind):
    room = SyntheticSequence(frames=4, camera=CAMERA)
    some = [Shot(f.timestamp + 1, np.dstack([f.grey] * 3), np.round(f.depth / 5).astype(np.uint16)) for f in room]
    path = record(tmp_path / "walk", kind, "raw", some, CAMERA)
    done = gavo("run", path, *FAST, "--output", "out")
    assert done.status == 0, done.err
    source = f"walk: ROS bag of {COLOR} and {DEPTH}, 4 frames of 160x120"
    first = f"{source}; camera fx 131 fy 131 cx 79.5 cy 59.5 ({INFO}); depth in millimetres"
    assert done.out.splitlines()[0] == first
    assert gavo("inspect", path).out.splitlines()[:2] == ["source: walk, ROS bag", f"topics: {COLOR} and {DEPTH}"]
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["lost_pairs"] == 0
    done = gavo("inspect", path, "--colour-topic", COLOR, "--depth-topic", DEPTH, "--camera", "fr1")
    assert is_refused(done, "walk", COLOR, "160x120", "640x480")
    assert is_refused(gavo("run", path, "--depth-topic", "/nowhere"), "--depth-topic", DEPTH)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--rate", "0"], ["--rate"]),
        (["--rate", "nan"], ["--rate"]),
        (["--depth-scale", "-1"], ["--depth-scale"]),
        (["--depth-scale", "inf"], ["--depth-scale"]),
        (["--camera", "nonsense.json"], ["nonsense.json: no such file"]),
        (["--moving", "1"], ["--moving", "synthetic"]),
    ],
)
@pytest.mark.parametrize("command", ["run", "inspect"])
def test_bad_options_are_refused(gavo, clip, command, arguments, words):
    assert is_refused(gavo(command, clip, *arguments), *words)


def test_bodies_move_through_the_synthetic_room(gavo):
    sequence = open_sequence(Source(frames=2, moving=2))
    assert isinstance(sequence, SyntheticSequence)
    assert [body.label for body in sequence.bodies_truth] == [1, 2]
    assert is_refused(gavo("inspect", "synthetic", "--moving", "8"), "--moving", "7")
    assert gavo("inspect", "synthetic", "--frames", "2", "--moving", "1").status == 0


def test_millimetres_with_a_benchmarks_camera_are_refused(gavo, data_dir, tmp_path):
    """What used to end with status 0 and a trajectory five times too short."""
    from gavo_jax.datasets.layouts.tum import TumSequence

    for frame in TumSequence(data_dir / "fr1_xyz", undistort=False)[:3]:
        image(tmp_path / f"fr1_mm/rgb/{frame.timestamp:.6f}.png", frame.grey)
        image(tmp_path / f"fr1_mm/depth/{frame.timestamp:.6f}.png", np.round(frame.depth / 5).astype(np.uint16))
    done = gavo("run", "fr1_mm", "--camera", "fr1", "--strict", "--output", "out")
    assert is_refused(done, "fr1_mm: ", "millimetres", "--depth-scale 1000")
    assert gavo("run", "fr1_mm", "--camera", "fr1", "--depth-scale", 1000, *FAST, "--output", "out").status == 0


RED_KITCHEN = """fx = 525.0
fy = 525.0
cx = 320.0
cy = 240.0
width = 640
height = 480
depth_scale = 1000
colour_T_depth = [
    [0.99996518012567637, 0.0026765126468950343, -0.0079041012313000904, -0.025558943178152542],
    [-0.00274093112813167, 0.99996302803027592, -0.0081504520778013286, 0.00010109636268061706],
    [0.0078819942130445332, 0.0081718328771890631, 0.99993554558014031, 0.0020318321729487039],
    [0, 0, 0, 1],
]
[depth]
fx = 585.0
fy = 585.0
cx = 320.0
cy = 240.0
width = 640
height = 480
"""
"""The calibration of a Kinect that those who work on 7-Scenes commonly register its depth by."""


def test_red_kitchen_registered_follows_the_truth_closer(gavo, data_dir, tmp_path):
    """Turning, from frame to frame and over all; over one second of the two that there are, shifts do not gain. By its
    folder alone it is followed, too.
    """
    Path("rig.toml").write_text(RED_KITCHEN)
    metrics = []
    for name, camera in (("plain", ()), ("registered", ("--camera", "rig.toml"))):
        done = gavo("run", data_dir / "redkitchen_7scenes", *FAST, *camera, "--output", name)
        assert done.status == 0 and "7-Scenes sequence, 60 frames" in done.out, done.err
        metrics.append(json.loads((tmp_path / name / "metrics.json").read_text()))
    plain, registered = metrics
    assert plain["lost_pairs"] == 0 and plain["rpe_translation_rmse_m_per_s"] < 0.02
    assert registered["lost_pairs"] == 0
    keys = ("rpe_rotation_rmse_deg_per_s", "rpe_translation_rmse_m_per_frame", "ate_translation_rmse_m")
    for key in keys:
        assert registered[key] < 0.9 * plain[key]


def test_a_short_clip_has_the_errors_that_it_can_have_and_says_why(gavo, clip):
    done = gavo("run", clip, *FAST, "--output", "out")
    assert done.status == 0, done.err
    assert "RPE over 1 frame" in done.out and "absolute error" in done.out and "drift: " not in done.out
    assert "\u2013" not in done.out
    sentences = [line for line in done.out.splitlines() if line.startswith("No drift over 1 s")]
    assert sentences == ["No drift over 1 s: the frames last 0.23 s; see the errors per frame and of the whole run."]


@pytest.mark.parametrize("truth", [True, False])
def test_tables_of_a_short_clip_have_no_dash_without_its_reason(gavo, clip, monkeypatch, truth):
    monkeypatch.setenv("COLUMNS", "80")
    if not truth:
        (clip / "groundtruth.txt").unlink()
    Path("e.toml").write_text(
        '[[sequences]]\npath = "clip"\n[[methods]]\nname = "opencv-rgb"\n[[methods]]\nname = "opencv-rgbd"\n'
    )
    compared = gavo("compare", clip, "--methods", "opencv-rgb,opencv-rgbd", "--output", "compared")
    tried = gavo("experiment", "e.toml", "--output", "tried")
    for done in (compared, tried):
        assert done.status == 0, done.err
        assert "\u2013" not in done.out and ("m/frame" in done.out) == truth
        reason = ("No drift over 1 s: ", "No drift of clip: ") if truth else ("No ground truth", "No errors of clip: ")
        assert any(line.startswith(reason) for line in done.out.splitlines()) or reason[1] in done.out
        report = next(Path("compared" if done is compared else "tried").glob("report.html")).read_text()
        assert "<td>\u2013</td>" not in report


@pytest.mark.parametrize("truth", ["none", "elsewhere"])
def test_without_a_truth_it_is_said_what_the_trajectory_tells(gavo, clip, truth):
    rows = (clip / "groundtruth.txt").read_text().splitlines()
    (clip / "groundtruth.txt").unlink()
    if truth == "elsewhere":
        (clip / "groundtruth.txt").write_text("".join(f"9{row}\n" for row in rows[1:]))
    done = gavo("run", clip, *FAST, "--output", "out")
    assert done.status == 0, done.err
    assert ("No ground truth" if truth == "none" else "covers fewer than two") in done.out
    assert done.out.count("┏") == 1 and max(map(len, (x for x in done.out.splitlines() if x[:1] in "┃│"))) <= 80
    table = {
        line.split("\u2502")[1].strip(): line.split("\u2502")[2] for line in done.out.splitlines() if "\u2502" in line
    }
    estimate = Trajectory.read_tum("out/trajectory.txt").world_T_camera
    length = np.linalg.norm(np.diff(estimate[:, :3, 3], axis=0), axis=1).sum()
    assert float(table["length of the path"]) == pytest.approx(length, abs=1e-4) and length > 0.01
    end = [float(x) for x in table["end: x right, y down, z forward"].split()]
    np.testing.assert_allclose(end, estimate[-1, :3, 3], atol=1e-4)
    assert float(table["pairs that are ok"]) == 100 and "RPE" not in done.out
    assert 0 < float(table["end: turned by"]) < 20


def test_a_clip_of_more_than_a_second_has_its_drift(gavo, tmp_path):
    write_tum(SyntheticSequence(frames=34, noise=KINECT, camera=CAMERA), tmp_path / "clip")
    done = gavo("run", "clip", *FAST, "--output", "out")
    assert "drift: RPE over 1 s, translation" in done.out and "No drift" not in done.out


def test_commands_take_the_lens_out_of_a_dataset_of_ones_own(monkeypatch):
    """The driver does so of each frame; the map, the figures and the viewer had them as they were."""
    bent = replace(CAMERA, distortion=(-0.3, 0.1, 0.0, 0.0, 0.0))
    monkeypatch.setattr("gavo_jax.cli.selection.open_part", lambda *_, **__: SyntheticSequence(2, camera=bent))
    assert not open_sequence(Source()).camera.is_distorted
