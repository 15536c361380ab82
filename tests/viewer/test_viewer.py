"""The viewer: what it saves is read back with Rerun's own reader and compared with the run."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import jax
import numpy as np
import pytest
from small import CAMERA, GENETIC

from gavo_jax.alignment.search import Population
from gavo_jax.bodies.records import Body
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry
from gavo_jax.odometry.stream import track
from gavo_jax.se3 import exp
from gavo_jax.settings_file import save_settings
from gavo_jax.trajectory import Trajectory
from gavo_jax.viewer import colors, live, pictures, search_space
from gavo_jax.viewer.scene import NOTHING
from gavo_jax.viewer.seen import SeenCubes

FRAMES, GENERATIONS, PARTICLES = 4, 8 + 6, (16,) * 8 + (8,) * 6
ENTITIES_OF_A_PAIR = (
    "/curves/rmse",
    "/curves/distance_error",
    "/images/reference",
    "/images/warped",
    "/images/residual",
    "/search/truth",
)
ENTITIES_OF_A_KNOWN_MOTION = ("/world/estimate", "/world/truth")
ENTITIES_OF_A_FRAME = ("/images/target", "/world/camera", "/world/camera/image")
ENTITIES_OF_A_LEVEL = ("/search/bounds", "/search/ticks", "/search/numbers")
ENTITIES_OF_A_GENERATION = ("/search/error", "/search/particles", "/state")
LEVELS = 2


def read_recording(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Rows of every entity that change with time: values by the name of time line or component."""
    from rerun.chunk import RrdReader

    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in RrdReader(path).stream():
        if not chunk.is_static and not chunk.entity_path.startswith("/__"):
            batch = chunk.to_record_batch().to_pylist()
            rows.setdefault(chunk.entity_path, []).extend(batch)
    return rows


def component(row: dict[str, Any], name: str) -> Any:
    [value] = [value for key, value in row.items() if key.endswith(f":{name}")]
    return value


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Save a short run; return its steps, its sequence and the rows of the recording."""
    path = tmp_path_factory.mktemp("viewer") / "run.rrd"
    sequence = SyntheticSequence(frames=FRAMES, camera=CAMERA)
    shown = live.make_viewer("save", path)
    odometry = Odometry(sequence.camera, GENETIC, record=shown.wants_populations)
    with shown:
        shown.open("a run", sequence.camera, sequence.timestamps, sequence.ground_truth)
        steps = list(
            track(
                sequence,
                odometry=odometry,
                watch=lambda frame, step: shown.watch(frame, step, odometry.candidates),
            )
        )
    return steps, sequence, path


@pytest.fixture(scope="module")
def rows(run):
    return read_recording(run[2])


def test_every_entity_has_its_rows(run, rows):
    pairs = FRAMES - 1
    segments = [0, *(step.segment for step in run[0])]
    expected = {
        **dict.fromkeys(ENTITIES_OF_A_KNOWN_MOTION, sum(a == b for a, b in pairwise(segments))),
        **dict.fromkeys(ENTITIES_OF_A_FRAME, FRAMES),
        **dict.fromkeys(ENTITIES_OF_A_PAIR, pairs),
        **dict.fromkeys(ENTITIES_OF_A_GENERATION, pairs * GENERATIONS),
        **dict.fromkeys(ENTITIES_OF_A_LEVEL, pairs * LEVELS),
        "/world/map": 1 + sum(not step.lost for step in run[0]),
    }
    assert {path: len(own) for path, own in rows.items()} == expected


def test_both_time_lines_count_on(rows):
    for path, own in rows.items():
        assert {"frame", "generation"} <= set(own[0]) and not {"log_time", "log_tick"} & set(own[0]), path
    particles = sorted(rows["/search/particles"], key=lambda row: row["generation"])
    assert [row["generation"] for row in particles] == list(range(1, 1 + (FRAMES - 1) * GENERATIONS))
    assert [row["frame"] for row in particles] == [i for i in range(1, FRAMES) for _ in range(GENERATIONS)]
    starts = [row["generation"] for row in rows["/curves/rmse"]]
    assert sorted(starts) == [1 + i * GENERATIONS for i in range(FRAMES - 1)]


def test_particles_curves_and_path_are_those_of_the_run(run, rows):
    steps, sequence, _ = run
    particles = sorted(rows["/search/particles"], key=lambda row: row["generation"])
    assert [len(component(row, "positions")) for row in particles] == list(PARTICLES) * (FRAMES - 1)
    for step in steps:
        found = np.linalg.inv(np.asarray(step.alignment.target_T_reference, np.float64))[:3, 3] * 1e3
        last = component(particles[step.index * GENERATIONS - 1], "positions")[0]
        assert np.allclose(last, found, atol=0.01)
        [rmse] = [row for row in rows["/curves/rmse"] if row["frame"] == step.index]
        assert component(rmse, "scalars")[0] == pytest.approx(float(np.sqrt(step.alignment.error)))
        for piece in [row for row in rows["/world/estimate"] if row["frame"] == step.index]:
            assert np.allclose(component(piece, "strips")[0][1], step.world_T_camera[:3, 3], atol=1e-6)
    texts = [component(row, "text")[0] for row in sorted(rows["/state"], key=lambda row: row["generation"])]
    assert "| 16 | 4 | 1/16 | 1 of 8 |" in texts[0] and "| 8 | 3 | 1/8 | 6 of 6 |" in texts[GENERATIONS - 1]
    [error] = re.findall(r"\| ([\d.]+) mm \|", texts[0])
    first = min(rows["/search/error"], key=lambda row: row["generation"])
    assert float(error) == pytest.approx(np.linalg.norm(component(first, "vectors")[0]), abs=0.06)
    errors = [component(row, "scalars")[0] for row in rows["/curves/distance_error"]]
    assert len(errors) == FRAMES - 1 and max(errors) < 0.2  # images of a few thousand pixels


def test_the_map_grows_by_what_is_new(rows):
    counts = [
        len(component(row, "positions") or []) for row in sorted(rows["/world/map"], key=lambda row: row["frame"])
    ]
    assert counts[0] > 200 and sum(counts[1:]) < 0.5 * counts[0] * (FRAMES - 1)


def test_a_cube_of_space_is_shown_once():
    cubes = SeenCubes()
    points = np.array([[0.01, 0.01, 1.0], [0.02, 0.02, 1.01], [-0.01, 0.01, 1.0], [5e3, -7e3, 1.0]])
    assert sorted(cubes.new(points).tolist()) == [0, 2, 3]
    assert cubes.new(points).size == 0


def test_bodies_are_tinted_left_out_of_the_map_and_have_paths(run, tmp_path):
    steps, sequence, _ = run
    field = np.where(np.arange(CAMERA.width // 8)[None] < CAMERA.width // 16, 1.0, -1.0).repeat(CAMERA.height // 8, 0)
    bodies = [
        Body(
            3, 0.5, np.array([0.1 * i, 0.0, 1.0]), np.zeros(3), np.zeros(3), None, field, (CAMERA.height, CAMERA.width)
        )
        for i in range(3)
    ]
    shown = live.make_viewer("save", tmp_path / "bodies.rrd")
    with shown:
        shown.open("bodies", sequence.camera, sequence.timestamps, None)
        for i, step in enumerate(steps[:2]):
            shown.watch(sequence[i], replace(step, lost=False, bodies=(bodies[i],)))
    found = read_recording(tmp_path / "bodies.rrd")
    [path] = found["/world/bodies"]
    assert np.allclose(component(path, "strips")[0], [[0, 0, 1], [0.1, 0, 1]], atol=1e-6)
    image = cv2.imdecode(np.frombuffer(bytes(component(found["/images/target"][0], "blob")[0]), np.uint8), 1)
    assert image is not None
    spread = np.ptp(image.astype(int), axis=2)
    assert np.median(spread[:, : image.shape[1] // 3]) > 40 > np.median(spread[:, -image.shape[1] // 3 :])
    assert min(x for x, *_ in component(found["/world/map"][0], "positions")) > steps[0].world_T_camera[0, 3] - 0.1


def test_loops_and_the_corrected_path_are_shown_in_the_end(run, tmp_path):
    steps, sequence, _ = run
    poses = np.stack([step.world_T_camera for step in steps])
    keyframes = [SimpleNamespace(world_T_camera=pose) for pose in poses]
    edges = [SimpleNamespace(earlier=0, later=2), SimpleNamespace(earlier=1, later=2)]
    residuals = np.array([[0.003, 0, 0, 0, 0, 0], [0.4, 0, 0, 0, 0, 0]])
    loops: Any = SimpleNamespace(
        keyframes=keyframes, edges=edges, solution=SimpleNamespace(weights=np.array([1.0, 0.0]), residuals=residuals)
    )
    shown = live.make_viewer("save", tmp_path / "loops.rrd")
    with shown:
        shown.open("loops", sequence.camera, sequence.timestamps, None)
        shown.watch(sequence[0], None)
        shown.show_corrected(Trajectory(sequence.timestamps[1:], poses, np.array([0, 0, 1])), loops)
    found = read_recording(tmp_path / "loops.rrd")
    [row] = found["/world/loops"]
    assert component(row, "labels") == ["3 mm left", "400 mm left"]
    assert len(set(component(row, "colors"))) == 2
    first, second = component(found["/world/corrected"][0], "strips")
    assert np.allclose([*first, *second], poses[:, :3, 3], atol=1e-6)
    assert len(second) == 1, "a line across a motion that is not known"


@pytest.mark.parametrize("half", [3.0, 40.0, 500.0])
def test_ticks_stand_at_round_numbers_on_the_box(half):
    centre, halves = np.array([7.0, -3.0, 0.5]), np.array([half, half, 0.4 * half])
    ticks = search_space.ticks_of(centre, halves)
    starts = np.array([strip[0] for strip in ticks.strips])
    assert len(ticks.labels) == len(starts) >= 8
    for start, label in zip(starts, ticks.labels, strict=True):
        axis, value = label.split()
        assert start["xyz".index(axis)] == pytest.approx(float(value)) and float(f"{float(value):.2g}") == float(value)
        assert np.sum(np.isclose(np.abs(start - centre), halves)) >= 2


def test_a_frame_is_small(run):
    assert run[2].stat().st_size / FRAMES < 2**20


def test_recording_changes_nothing(run):
    steps, sequence, _ = run
    plain = list(track(sequence, odometry=Odometry(sequence.camera, GENETIC)))
    assert all(np.array_equal(a.world_T_camera, b.world_T_camera) for a, b in zip(steps, plain, strict=True))


def test_a_lost_and_an_unreadable_frame_are_shown_as_far_as_known(run, tmp_path):
    steps, sequence, _ = run
    shown = live.make_viewer("save", tmp_path / "lost.rrd")
    with shown:
        shown.open("lost", sequence.camera, sequence.timestamps, None)
        shown.watch(sequence[0], None)
        shown.watch(None, steps[0])
        shown.watch(sequence[2], replace(steps[1], reference_timestamp=float(sequence.timestamps[1]), lost=False))
    found = read_recording(tmp_path / "lost.rrd")
    assert len(found["/images/target"]) == 2 and len(found["/world/estimate"]) == 2
    assert "/world/truth" not in found
    shown_images = [component(row, "blob") for row in found["/images/warped"]]
    assert [bytes(blob[0]) for blob in shown_images] == [NOTHING] * 2, "not those of a frame before"


def test_between_segments_nothing_is_known(run, tmp_path):
    """Nor is an error told that holds the unknown motion."""
    steps, sequence, _ = run
    apart = np.diag([1.0, 1.0, 1.0, 1.0])
    apart[0, 3] = 5.0
    placed = [steps[0], *(replace(step, segment=1, world_T_camera=apart @ step.world_T_camera) for step in steps[1:])]
    shown = live.make_viewer("save", tmp_path / "segments.rrd")
    with shown:
        shown.open("segments", sequence.camera, sequence.timestamps, sequence.ground_truth)
        for step in (None, *placed):
            shown.watch(None, step)
    found = read_recording(tmp_path / "segments.rrd")
    errors = [component(row, "scalars")[0] for row in found["/curves/distance_error"]]
    assert len(errors) == len(steps) and max(errors) < 0.2
    pieces = [np.array(component(row, "strips")[0]) for row in found["/world/estimate"]]
    assert len(pieces) == len(steps) - 1 and max(np.linalg.norm(piece[1] - piece[0]) for piece in pieces) < 0.5


def test_a_recording_has_its_name_once_it_is_whole(run, tmp_path):
    """The one before stays until then, and where the run does not come to its end."""
    _, sequence, _ = run
    path = tmp_path / "run.rrd"
    path.write_bytes(b"earlier")
    shown = live.make_viewer("save", path)
    with pytest.raises(KeyboardInterrupt), shown:
        shown.open("", sequence.camera, sequence.timestamps, None)
        shown.watch(sequence[0], None)
        raise KeyboardInterrupt
    assert path.read_bytes() == b"earlier" and list(tmp_path.iterdir()) == [path]


def test_a_page_that_nobody_serves_is_not_waited_for(tmp_path):
    live.make_viewer("web", tmp_path / "run.rrd").stay()


def test_generations_are_sorted_coloured_and_thinned():
    rng = np.random.default_rng(0)
    error = rng.uniform(4.0, 100.0, (3, 2000)).astype(np.float32)
    error[0, :5], error[2] = np.inf, np.nan
    xi = rng.normal(0, 0.01, (3, 2000, 6)).astype(np.float32)
    population = Population(np.int32(3), xi, error, np.zeros(6), np.full(6, 0.5))  # pyright: ignore[reportArgumentType]
    level = search_space.level_of(population)
    assert level is not None and level.positions.shape[0] == len(level.rmse) == 2
    assert level.positions.shape[1] <= search_space.MAX_PARTICLES and np.allclose(level.half_sizes, 500.0)
    best = xi[1, np.argmin(error[1])]
    assert np.allclose(level.positions[1, 0], search_space.camera_positions(best[None])[0] * 1e3, atol=1e-3)
    overall = int(np.argmin(error[:2].min(axis=1)))
    blue, vermilion = colors.packed(np.array([colors.BLUE, colors.VERMILION], np.uint8))
    assert level.colors[overall, 0] == blue and level.colors[0, -1] == vermilion
    assert f"{blue:08x}" == "".join(f"{value:02x}" for value in (*colors.BLUE, 255))
    texts = level.states()
    assert "| 2000 | 3 |" in texts[0] and f"| 2 of 2 | {np.sqrt(error[1].min()):.2f} |" in texts[1]
    assert search_space.level_of(population._replace(error=np.full_like(error, np.inf))) is None  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 2.0])
def test_camera_position_is_the_inverse_motion(size):
    xi = size * np.random.default_rng(1).normal(size=(10, 6))
    with jax.enable_x64(True):
        expected = np.linalg.inv(np.asarray(exp(xi)))[:, :3, 3]
    assert np.allclose(search_space.camera_positions(xi), expected, atol=1e-9)


def test_warping_back_gives_the_reference():
    sequence = SyntheticSequence(frames=2, camera=CAMERA)
    truth = sequence.ground_truth.interpolate(sequence.timestamps)[0]
    reference, target = (pictures.shrink(frame, CAMERA, CAMERA.depth_scale) for frame in sequence)
    warped, seen = pictures.warp_target(reference, target, np.linalg.inv(truth[1]) @ truth[0], CAMERA)
    still, _ = pictures.warp_target(reference, target, np.eye(4), CAMERA)

    def error(image: np.ndarray) -> float:
        return float(np.mean(np.abs(image.astype(float) - reference.grey)[seen]))

    assert seen.mean() > 0.7 and error(warped) < 0.5 * error(still)
    colors = pictures.color_residual(warped, reference.grey, seen)
    assert not colors[~seen].any()


def test_images_of_any_numbers_are_shown():
    frame = SyntheticSequence(frames=2, camera=CAMERA)[0]
    shown = pictures.shrink(frame, CAMERA, CAMERA.depth_scale)
    metric = replace(frame, grey=frame.grey.astype(np.float32), depth=frame.depth / np.float32(CAMERA.depth_scale))
    again = pictures.shrink(metric, CAMERA, 1.0)
    assert again.jpeg == shown.jpeg
    np.testing.assert_allclose(again.depth, shown.depth, rtol=1e-6)


def test_residuals_are_blue_below_and_vermilion_above():
    bright, dark = np.full((2, 3), 200, np.uint8), np.full((2, 3), 100, np.uint8)
    seen = np.array([[True, True, False]] * 2)
    for warped, reference, color in ((bright, dark, colors.VERMILION), (dark, bright, colors.BLUE)):
        shown = pictures.color_residual(warped, reference, seen)
        assert np.all(shown[seen] == color[::-1]) and not shown[~seen].any()


def test_no_viewer_asks_for_nothing(tmp_path):
    nothing = live.make_viewer("none", tmp_path / "run.rrd")
    with nothing:
        nothing.open("", CAMERA, np.zeros(1), None)
        nothing.watch(None, None)
    nothing.stay()
    assert not nothing.wants_populations and not list(tmp_path.iterdir())


def test_missing_package_and_missing_screen_are_said(tmp_path, monkeypatch):
    monkeypatch.setattr(live.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(GavoError, match="--viewer web"):
        live.make_viewer("spawn", tmp_path / "run.rrd")
    monkeypatch.setattr(live.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(GavoError, match=r"pip install 'gavo-jax\[viewer\]'"):
        live.make_viewer("save", tmp_path / "run.rrd")


def test_a_folder_where_the_recording_belongs_is_told_before_the_run(tmp_path):
    (tmp_path / "run.rrd").mkdir()
    with pytest.raises(GavoError, match=r"run\.rrd: cannot be written: it is a folder"):
        live.make_viewer("save", tmp_path / "run.rrd")


def test_a_window_that_does_not_open_is_said_in_one_line(tmp_path, forty_frames, run):
    del run  # has compiled what the command starts
    save_settings(tmp_path / "settings.toml", GENETIC)
    source = [str(forty_frames), "--camera", str(forty_frames / "camera.toml"), "--settings", "settings.toml"]
    command = [sys.executable, "-m", "gavo_jax", "run", *source, "--viewer", "spawn", "--frames", "3"]
    outside = {**os.environ, "DISPLAY": ":4711"}
    outside.pop("WAYLAND_DISPLAY", None)
    done = subprocess.run(command, cwd=tmp_path, env=outside, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2 and done.stderr.startswith("gavo: --viewer spawn: ") and done.stderr.count("\n") == 1


def test_a_fault_in_the_thread_reaches_the_user(tmp_path):
    shown = live.make_viewer("save", tmp_path / "run.rrd")
    shown.open("", CAMERA, np.zeros(1), None)
    shown.watch("no frame", None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="--viewer save"):
        shown.close()


def test_each_of_two_viewers_at_once_has_a_server_of_its_own(tmp_path, monkeypatch):
    """The second finds the ports free, as the first has not taken them yet: it is not to show the first one's page."""
    monkeypatch.setattr(live, "_has_screen", lambda: False)
    asked: list[int] = []
    free = live._free_port

    def free_port(wanted: int) -> int:
        asked.append(wanted)
        return taken.pop(0) if taken else free(wanted)

    first = live.RerunViewer("web", tmp_path / "first.rrd")
    second = live.RerunViewer("web", tmp_path / "second.rrd")
    taken: list[int] = []
    first.open("first", CAMERA, np.zeros(1), None)
    ports = [int(port) for port in re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", first.url)]
    monkeypatch.setattr(live, "_free_port", free_port)
    for clash in (ports[::-1], [ports[1], free(0)], [free(0), ports[0]]):
        taken[:] = clash
        second.open("second", CAMERA, np.zeros(1), None)
        own = [int(port) for port in re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", second.url)]
        assert len(own) == 2 and not set(own) & set(ports) and len(asked) == 4
        assert second._process is not None and set(own) <= live._listening(second._process.pid)
        second.close()
        live._end(second._process)
        asked.clear()
    first.close()
    assert first._process is not None
    live._end(first._process)
