"""Every benchmark runs, on a few small frames, and its figures follow from what it measured."""

import importlib
import itertools
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small import ALONE, CAMERA, GENETIC, NEWTON, Rendered

from gavo_jax import presets
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.experiments.table import COLUMNS, FLAG, REAL, TEXT, Table
from gavo_jax.odometry.metrics import DRIFT
from gavo_jax.se3 import log
from gavo_jax.settings import AlignmentOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.trajectory import inverse

FOLDER = Path(__file__).parent.parent / "benchmarks"
CLIP = "small"


WALK = Rendered(8, rate=5.0, speed=0.2)
QUICK = {"gauss-newton": replace(NEWTON, solver=GaussNewton(iterations=(0, 10, 10, 15, 20))), "ga": GENETIC}


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch):
    """Return what imports a benchmark, with a slow walk of 8 frames in 1.4 s behind every clip's name."""
    monkeypatch.syspath_prepend(str(FOLDER))
    common = importlib.import_module("common")
    monkeypatch.setattr(common, "open_clip", lambda _: WALK)
    return importlib.import_module


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the methods' names stand for settings that are soon compiled, where any motion will do."""
    _have_names_stand_for(lambda method, settings: QUICK.get(method, settings), monkeypatch)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have them stand for the search alone, where nothing else is measured."""
    _have_names_stand_for(lambda _, settings: replace(settings, odometry=ALONE), monkeypatch)


def _have_names_stand_for(change: Callable[[str, Settings], Settings], monkeypatch: pytest.MonkeyPatch) -> None:
    own = presets._own
    monkeypatch.setattr(presets, "_own", lambda method, name: change(method, own(method, name)))


def read(path: Path) -> dict[str, Any]:
    record = json.loads(path.read_text())
    assert {"benchmark", "date", "processor", "cores", "device", "versions"} <= set(record)
    return record


def test_drift_compares_methods_with_peers(load, quick, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drift: ModuleType = load("drift")
    drift.main(clips=CLIP, methods="ga,gauss-newton,opencv-rgb", seeds=2, json=tmp_path / "drift.json", figure=tmp_path)
    record = read(tmp_path / "drift.json")
    assert [(run["name"], run["seed"]) for run in record["runs"]] == [
        ("ga", 0),
        ("gauss-newton", 0),
        ("opencv-rgb", 0),
        ("ga", 1),
        ("gauss-newton", 1),
    ]
    genetic, newton, peer = record["summary"]
    drifts = [run["rpe_translation_rmse_m_per_s"] for run in record["runs"] if run["name"] == "ga"]
    assert genetic["translation"] == pytest.approx(np.median(drifts))
    assert genetic["translation_spread"] == pytest.approx(max(drifts) / min(drifts))
    ratios = {ratio["name"]: ratio["by_clip"][CLIP] for ratio in record["ratios"]}
    assert ratios["ga / best peer, rotation"] == pytest.approx(genetic["rotation"] / peer["rotation"])
    assert ratios["ga / gauss-newton, translation"] == pytest.approx(genetic["translation"] / newton["translation"])
    assert "ratios of the medians" in capsys.readouterr().out
    assert drift.drifts(record["runs"])[CLIP]["ga"].shape == (2, 2)
    first = (tmp_path / "drift.svg").read_text()
    drift.main(recorded=str(tmp_path / "drift.json"), figure=tmp_path / "again")
    assert (tmp_path / "again" / "drift.svg").read_text().count("<use") == first.count("<use")
    for file in ("nowhere.json", "drift.svg"):
        with pytest.raises(GavoError, match=file):
            drift.main(recorded=str(tmp_path / file))


def test_drift_refuses_unknown_methods(load) -> None:
    with pytest.raises(GavoError, match="nonsense"):
        load("drift").main(clips=CLIP, methods="ga:nonsense")


def test_ablation_compares_with_the_full_preset(load, tmp_path: Path) -> None:
    load("ablation").main(clips=CLIP, variants="recover", seeds=1, json=tmp_path / "ablation.json")
    record = read(tmp_path / "ablation.json")
    assert [summary["name"] for summary in record["summary"]] == ["full", "recover: no second try"]
    full, without = record["summary"]
    assert record["ratios"][0]["translation"]["mean"] == pytest.approx(without["translation"] / full["translation"])


def test_ablation_switches_off_what_it_says(load) -> None:
    ablation: ModuleType = load("ablation")
    for name, (_, switch_off) in ablation.VARIANTS.items():
        full = ablation.presets.preset("ga", "default")
        assert switch_off(full) != full, name


def test_basin_counts_successes_and_flags(load, quick, tmp_path: Path) -> None:
    basin: ModuleType = load("basin")
    basin.main(
        clip=CLIP, gaps="1,3", methods="gauss-newton,opencv-rgb", step=2, json=tmp_path / "basin.json", figure=tmp_path
    )
    record = read(tmp_path / "basin.json")
    assert [(row["gap"], row["pairs"]) for row in record["success"]] == [(1, 4), (3, 3)]
    assert record["success"][0]["success"] == {"gauss-newton": 1.0, "opencv-rgb": 1.0}
    assert (tmp_path / "basin.svg").exists()
    basin.main(recorded=str(tmp_path / "basin.json"), figure=tmp_path / "again")
    assert (tmp_path / "again" / "basin.svg").exists()
    with pytest.raises(GavoError, match=r"drift\.py"):
        load("drift").main(recorded=str(tmp_path / "basin.json"))
    assert record["success"][1]["motion_deg"] > record["success"][0]["motion_deg"]
    attempts = [dict(found=True, flagged=True), dict(found=False, flagged=True), dict(found=False, flagged=False)]
    [agreement] = basin.status_agreement([dict(method="x", milliseconds=1.0, **attempt) for attempt in attempts])
    assert (agreement["precision"], agreement["recall"]) == (0.5, 0.5)


def test_optimality_is_judged_from_below(load, quick, tmp_path: Path) -> None:
    load("optimality").main(clips=CLIP, json=tmp_path / "optimality.json")
    record = read(tmp_path / "optimality.json")
    [row] = record["summary"]
    assert row["pairs"] == 7
    assert -0.01 <= row["median"] <= row["p90"] <= row["p95"] <= row["max"] < np.inf
    pairs = record["pairs"][CLIP]
    assert np.all(np.array(pairs["minimum_from_genetic"]) <= np.array(pairs["genetic"]) * (1 + 1e-4))


def test_kernel_formulations_agree_and_are_timed(load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel: ModuleType = load("kernel")
    monkeypatch.setattr(kernel, "LEAST_SECONDS", 0.01)
    kernel.main(levels="3,4", population=8, rounds=1, json=tmp_path / "kernel.json")
    record = read(tmp_path / "kernel.json")
    assert list(record["nanoseconds"]) == ["80x60", "40x30"]
    for times in record["nanoseconds"].values():
        assert {"score", "score, no barrier", "score, two marks", "plain vmap", "numba"} <= set(times)
        assert all(time > 0 for time in times.values())
    times = record["nanoseconds"]["80x60"]
    assert record["ratios"]["score / numba"]["80x60"] == pytest.approx(times["score"] / times["numba"])


def test_faults_are_counted(load, quick, tmp_path: Path) -> None:
    faults: ModuleType = load("faults")
    slow = Rendered(20, camera=CAMERA, rate=10.0, speed=0.2)
    faults.common.open_clip = lambda _: slow
    chosen = "black,truncated PNG,equal stamps"
    faults.main(clips=CLIP, method="gauss-newton", faults=chosen, json=tmp_path / "faults.json")
    record = read(tmp_path / "faults.json")
    assert [row["fault"] for row in record["faults"]] == chosen.split(",")
    for row, status in zip(record["faults"], ("blank", "unreadable", "bad_timestamp"), strict=True):
        assert row["flagged"] == 1.0 and row["statuses"] == {status: 5} and not row["crashed"]
        assert row["ratio"] == pytest.approx(row["drift"] / row["clean_drift"])
    [clean] = record["clean"]
    assert clean["pairs"] == 19 and clean["false_alarms"] == 1 - clean["statuses"].get("ok", 0) / 19
    with pytest.raises(GavoError, match="nonsense"):
        faults.main(clips=CLIP, faults="nonsense")


def test_faults_go_by_the_clips_rate_and_units(load) -> None:
    """The last stamp was that of a clip of 30 Hz, and depth of 2 m was 10 m where it is in millimetres."""
    faults: ModuleType = load("faults")
    slow = Rendered(4, camera=replace(CAMERA, depth_scale=1000.0), rate=5.0)
    np.testing.assert_allclose(np.diff(faults.duplicated(slow, []).timestamps), 0.1)
    assert np.all(faults.FAULTS["depth of 2 m"](slow, [1])[1].depth == 2000)


def test_conditions_are_compared_with_the_clip_as_it_is(load, tmp_path: Path) -> None:
    conditions: ModuleType = load("conditions")
    conditions.main(
        clips=CLIP, method="gauss-newton", conditions="bands of 4 %,every second", json=tmp_path / "conditions.json"
    )
    clean, lit, fewer = read(tmp_path / "conditions.json")["conditions"]
    assert clean["condition"] == "as it is" and clean["ratio"] == 1.0 and 0.3 < fewer["ratio"] < 3.0
    assert lit["ratio"] == pytest.approx(lit["drift"] / clean["drift"]) and lit["bodies"] == 0.0
    with pytest.raises(GavoError, match="nonsense"):
        conditions.main(clips=CLIP, conditions="nonsense")


@pytest.mark.parametrize(
    "name",
    ["bands of 8 %", "vignette", "a known vignette", "shade", "black bars", "JPEG 30", "half size", "middle quarter"],
)
def test_a_condition_keeps_images_and_camera_alike(load, name: str) -> None:
    conditions: ModuleType = load("conditions")
    changed = conditions.CONDITIONS[name](WALK)
    for index in (0, len(WALK) - 1):
        frame = changed[index]
        size = (changed.camera.height, changed.camera.width)
        assert frame.grey.dtype == np.uint8 and frame.grey.shape == frame.depth.shape == size
        assert frame.timestamp == WALK.timestamps[index]
        assert frame.grey.shape != WALK[index].grey.shape or not np.array_equal(frame.grey, WALK[index].grey)


def test_depth_that_is_always_wrong_is_measured(load, quick, tmp_path: Path) -> None:
    wrong_depth: ModuleType = load("wrong_depth")
    walk = Rendered(20, camera=CAMERA, rate=15.0, speed=0.5)
    wrong_depth.common.open_clip = lambda _: walk
    wrong_depth.main(clips=CLIP, method="gauss-newton", faults="depth upside down", json=tmp_path / "wrong.json")
    clean, damaged = read(tmp_path / "wrong.json")["faults"]
    assert (clean["fault"], damaged["fault"]) == ("clean", "depth upside down") and clean["ratio"] == 1.0
    assert clean["flagged"] == 0.0 and clean["most_left"] < 0.5 * wrong_depth.MOST_LEFT < damaged["most_left"]
    assert damaged["flagged"] > 0.5 and damaged["silent"] <= damaged["wrong"]
    with pytest.raises(GavoError, match="nonsense"):
        wrong_depth.main(clips=CLIP, faults="nonsense")


def test_a_foreign_frame_has_depth_in_the_units_of_the_map(load) -> None:
    """Depth in millimetres was handed to a map in fifths of them: the foreign scene was five times too near."""
    loops: ModuleType = load("loops")
    own = replace(CAMERA, depth_scale=1000.0)
    depth = np.full((CAMERA.height, CAMERA.width), 1500, np.uint16)
    depth[0, :3] = 0, 65535, 20000
    frame = Frame(np.zeros(depth.shape, np.uint8), depth, 0.0)
    seen = loops.seen_by(replace(CAMERA, depth_scale=5000.0), frame, own)
    assert seen.depth.dtype == np.uint16 and seen.depth[1, 0] == 7500 and not seen.depth[0, :3].any()
    with pytest.raises(GavoError, match="not of the map's size"):
        loops.seen_by(CAMERA.binned(2), frame, own)


def test_clips_are_found_by_name(monkeypatch: pytest.MonkeyPatch, data_dir: Path) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    open_clip = importlib.import_module("common").open_clip
    monkeypatch.setenv("HOME", str(data_dir.parent))
    monkeypatch.setenv("GAVO_DATA", f"~/{data_dir.name}")  # no shell expands it in environment files
    assert len(open_clip("fr1_xyz")) == 90
    assert len(open_clip("fr1_xyz:12")) == 12
    assert len(open_clip("synthetic:3")) == 3
    for text in ("fr1_xyz:1", "fr1_xyz:x", "no_such_clip"):
        with pytest.raises(GavoError, match=text.partition(":")[0]):
            open_clip(text)


def test_throughput_counts_frames_from_files_to_poses(load, quick, tmp_path: Path) -> None:
    throughput: ModuleType = load("throughput")
    throughput.main(
        clip=CLIP,
        methods="gauss-newton,opencv-rgb",
        frames=3,
        rounds=2,
        together=2,
        json=tmp_path / "throughput.json",
    )
    record = read(tmp_path / "throughput.json")
    assert record["frames"] == 3 and record["frame_ms"] > 0 and record["row_kB"] > 1
    assert min(record["together"]["gauss-newton"].values()) > 0
    ours, peer = (record["contenders"][name] for name in ("gauss-newton", "opencv-rgb"))
    assert ours["compile_seconds"] > peer["compile_seconds"] == 0
    assert ours["frames_per_second"] == pytest.approx(3 / np.median(ours["seconds"]))
    ratios = np.array(ours["seconds"]) / np.array(peer["seconds"])
    assert ours["over"] == {"opencv-rgb": pytest.approx(np.median(ratios))}
    assert peer["over"] == {"opencv-rgb": 1.0}
    with pytest.raises(GavoError, match="two frames"):
        throughput.main(clip=CLIP, methods="gauss-newton", frames=1)


def test_scaling_fits_the_exponent_of_the_large_calls(load, quick, tmp_path: Path) -> None:
    scaling: ModuleType = load("scaling")
    file = tmp_path / "scaling.json"
    scaling.main(levels="3,2", populations="8,64", batches="1,2", methods="gauss-newton", rounds=1, json=file)
    record = read(file)
    sizes = [(row["size"], row["candidates"]) for row in record["scoring"]]
    assert sizes == [("80x60", 8), ("80x60", 64), ("160x120", 8), ("160x120", 64)]
    assert record["exponent"] is None
    for row in record["batches"]["gauss-newton"]:
        assert row["per_second"] == pytest.approx(row["pairs"] / row["milliseconds"] * 1e3)
    rows = [{"pixels": 10**k, "candidates": 9, "milliseconds": 3.0 * 10 ** (1.1 * k)} for k in (6, 7, 8)]
    small = {"pixels": 10, "candidates": 9, "milliseconds": 1.0}
    assert scaling.exponent([small, *rows]) == pytest.approx(1.1)
    with pytest.raises(GavoError, match="8,x"):
        scaling.main(populations="8,x")


def test_gpu_reports_on_a_cpu_too(
    load, alone, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gpu: ModuleType = load("gpu")
    monkeypatch.setattr(gpu, "COPIED", 2**16)
    gpu.main(clip=CLIP, methods="gauss-newton", batches="2", populations="8", rounds=1, json=tmp_path / "gpu.json")
    record = read(tmp_path / "gpu.json")
    assert capsys.readouterr().out.startswith("no GPU here")
    assert max(record["agreement"]["gauss-newton"].values()) < 1e-9  # poses are made rigid in double precision
    assert min(record["latency"]["gauss-newton"].values()) > 0
    [row] = record["memory"]["scoring"]
    limit = 28 * 640 * 480 * 8 / (record["memory"]["gigabytes_per_second"] * 1e9)
    assert row["share"] == pytest.approx(limit * 1e3 / row["milliseconds"])


GROWING = """
import pathlib, sys, time
held = bytearray(b"x") * (int(sys.argv[1]) * 2**20)
time.sleep(0.1)
run = pathlib.Path(sys.argv[2])
run.mkdir(exist_ok=True)
(run / "trajectory.txt").write_text("# header\\n0\\n1\\n")
"""


def test_footprint_tells_a_process_that_grows(load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    footprint: ModuleType = load("footprint")

    def growing(scratch: Path, name: str, frames: int) -> list[str]:
        return [sys.executable, "-c", GROWING, str(frames), str(scratch / "run")]

    monkeypatch.setattr(footprint, "gavo_run", growing)
    footprint.main(clip=CLIP, methods="gauss-newton", starts=2, lengths="200,700", json=tmp_path / "footprint.json")
    figures = read(tmp_path / "footprint.json")["methods"]["gauss-newton"]
    for times in figures["start"].values():
        assert len(times) == 2 and min(times) > 0.1
    short, long = figures["megabytes"].values()
    assert short < 300 and long > 700 and figures["ratio"] == pytest.approx(long / short) and figures["ratio"] > 1.5


@pytest.mark.slow
def test_footprint_times_and_weighs_processes(load, tmp_path: Path) -> None:
    footprint: ModuleType = load("footprint")
    footprint.common.open_clip = lambda _: SyntheticSequence(4, camera=CAMERA, speed=0.2)
    footprint.main(clip=CLIP, methods="gauss-newton", starts=1, lengths="3,9", json=tmp_path / "footprint.json")
    figures = read(tmp_path / "footprint.json")["methods"]["gauss-newton"]
    [empty], [filled] = figures["start"].values()
    assert empty > filled > 0.5
    short, long = figures["megabytes"].values()
    assert 100 < short < 4000 and figures["ratio"] == pytest.approx(long / short)


def test_together_counts_programs_and_equal_runs(load, quick, tmp_path: Path) -> None:
    load("together").main(clip=CLIP, methods="gauss-newton", runs=2, repeats=1, json=tmp_path / "together.json")
    figures = read(tmp_path / "together.json")["gauss-newton"]
    assert (figures["more_programs"], figures["equal"]) == (0, 2) and figures["ratio"] > 0
    assert min(figures["core_milliseconds_a_pair"].values()) > 0


def test_calibration_weighs_errors_by_their_covariance(load, quick, tmp_path: Path) -> None:
    calibration: ModuleType = load("calibration")
    calibration.main(frames=3, seeds=1, clips=CLIP, json=tmp_path / "calibration.json")
    *_, synthetic, clip = read(tmp_path / "calibration.json")["rows"]
    assert synthetic["pairs"] == 2 * len(calibration.NOISE) and clip["pairs"] == 7
    for row in (synthetic, clip):
        assert 0.5 < row["mean"] < 30 and row["share_within"] > 0.5
        assert 0 < row["millimetres"] < 5


def test_shutter_compares_readouts(load, alone, tmp_path: Path) -> None:
    shutter: ModuleType = load("shutter")
    walk = Rendered(8, rate=5.0, speed=0.4)
    shutter.common.open_clip = lambda _: walk
    shutter.main(clips=CLIP, readouts="0,30", json=tmp_path / "shutter.json")
    [rows] = read(tmp_path / "shutter.json")["clips"].values()
    assert [row["readout_ms"] for row in rows] == [0, 30] and rows[0]["error"] == 1
    # the synthetic camera exposes all rows at once
    assert rows[1]["error"] > 1.01 and rows[1]["translation"] > 2 * rows[0]["translation"]


def test_depth_weight_compares_the_channels(load, tmp_path: Path) -> None:
    load("depth_weight").main(clips=CLIP, json=tmp_path / "depth_weight.json")
    [levels] = read(tmp_path / "depth_weight.json")["clips"].values()
    assert list(levels) == ["4", "3", "2", "1"]
    for row in levels.values():
        # rendered depth has no error that the whole image shares, so the channels disagree as their scatters promise
        assert 0.05 < row["disagreement"] < 20 and 0 < row["by_disagreement"] <= row["by_scatter"]


def test_viewer_is_weighed_against_a_run_without(load, quick, tmp_path: Path) -> None:
    viewer: ModuleType = load("viewer")
    viewer.common.open_clip = lambda _: SyntheticSequence(8, camera=CAMERA, rate=5.0, speed=0.2)
    viewer.main(clip=CLIP, methods="gauss-newton", rounds=1, json=tmp_path / "viewer.json")
    figures = read(tmp_path / "viewer.json")["methods"]["gauss-newton"]
    [without], [saved] = figures["runs"]["none"], figures["runs"]["save"]
    assert figures["ratio"] == pytest.approx(saved["milliseconds"] / without["milliseconds"])
    assert without["megabytes"] == 0 < figures["megabytes"] < 1


def test_surfaces_that_tell_little_are_told(load, quick, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texture: ModuleType = load("texture")
    monkeypatch.setattr(texture, "CAMERA", CAMERA)
    cases = []
    for scene in ("upright bands", "textured wall"):  # two pairs each, by the program that aligns one
        texture.main(methods="gauss-newton", scenes=scene, noise="1", json=tmp_path / "t.json")
        cases += read(tmp_path / "t.json")["cases"]
    assert [case["status"] for case in cases] == ["low_texture"] * 2 + ["ok"] * 2
    assert all(case["fine"] for case in cases) and cases[0]["undetermined"].startswith("translation along y")
    assert len({case["scene"] for case in cases}) == 2


def test_accelerations_are_those_of_the_path(load, tmp_path: Path) -> None:
    acceleration: ModuleType = load("acceleration")
    acceleration.common.open_clip = lambda _: SyntheticSequence(20)
    acceleration.main(clips=CLIP, json=tmp_path / "a.json")
    figures = read(tmp_path / "a.json")
    assert len(figures["rows"]) == 3 and all(0 < row["m/s"] < 5 and 0 < row["m/s²"] < 15 for row in figures["rows"])
    for row in figures["sways"]:  # on a smooth path half of what the mean velocity changes by
        assert 0.4 < row["sway, rad/s"] / row["change, rad/s"] < 0.6


def test_moving_bodies_are_scored(load, quick, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moving: ModuleType = load("moving")
    slow = Rendered(20, camera=CAMERA, rate=10.0, speed=0.2)
    moving.common.open_clip = lambda _: slow
    moving.common.preset_of = lambda _: NEWTON
    methods = "gauss-newton,opencv-depth"
    moving.main(clips=CLIP, shares="0.2", rooms="", methods=methods, seeds=1, json=tmp_path / "moving.json")
    record = read(tmp_path / "moving.json")
    assert [(run["method"], run["body"]) for run in record["runs"]] == [
        (name, "card 0.2") for name in methods.split(",")
    ]
    for run in record["runs"]:
        assert run["drift"] is None or run["ratio"] == pytest.approx(run["drift"] / run["clean_drift"])
        assert run["wrong"] + run["right"] > 10 and run["wrong_flagged"] <= run["wrong"]
    assert record["below_peers"]["gauss-newton"][1] == 1
    assert "below every peer" in capsys.readouterr().out
    with pytest.raises(GavoError, match="2"):
        moving.main(clips=CLIP, shares="2")
    case = next(moving.cases(CLIP, "0.2", "", range(1), 20))
    told, seen, where = moving.Told(case.sequence)[5], case.sequence[5], case.sequence.part_labels(5) > 0
    assert seen.depth[where].any() and not told.depth[where].any()
    assert np.mean(told.depth != seen.depth) < 2 * where.mean()
    assert moving.with_bodies(NEWTON, "told").odometry.bodies == "off"
    assert [case.body for case in moving.cases("", "0.1", "1,2", range(2), 3)] == ["1 moving", "2 moving"] * 2


def test_a_card_is_where_its_truth_says(load) -> None:
    clips: ModuleType = load("moving_clips")
    still = SyntheticSequence(16, camera=CAMERA, rate=10.0, speed=0.2, noise=NONE)
    card = clips.CardClip(still, 0.2)
    assert len(card) == 14 and list(card.timestamps) == list(still.timestamps[1:-1])
    assert np.median([card.part_labels(i).mean() for i in range(len(card))]) == pytest.approx(0.2, abs=0.05)
    [truth] = card.bodies_truth
    rows, columns = np.nonzero(card.part_labels(5))
    depth = card[5].depth[rows, columns] / CAMERA.depth_scale
    points = CAMERA.back_project(np.stack([columns, rows], axis=-1).astype(float), depth)
    card_T_camera = inverse(truth.world_T_part[0, 5]) @ card.camera_at(card.timestamps[5:6])[0]
    height = np.abs(points @ card_T_camera[2, :3] + card_T_camera[2, 3])
    assert np.median(height) < 3e-3
    beside = card.part_labels(5) == 0
    np.testing.assert_array_equal(card[5].depth[beside], still[6].depth[beside])
    for look in clips.LOOKS:
        assert clips.texture(look.texture, np.random.default_rng(0)).shape == (480, 640)
    with pytest.raises(GavoError, match="granite"):
        clips.texture("granite", np.random.default_rng(0))


def test_found_bodies_are_compared_with_the_true_ones(load) -> None:
    """Bodies and masks made of the truth have no error; what is made of another motion has."""
    moving: ModuleType = load("moving")
    room = SyntheticSequence(6, camera=CAMERA, rate=15.0, bodies=2)
    labels, first = room.part_labels(5), room.ground_truth.world_T_camera[0]
    masks = moving.bodies_in(room, labels)
    assert list(masks) == [1, 2]
    name, overlap = moving.best_match(masks[1], {7: masks[1], 8: masks[2]})
    assert (name, overlap) == (7, 1.0) and moving.best_match(masks[1], {}) == (None, 0.0)
    before, after = room.bodies_truth[0].world_T_part[0, [4, 5]]
    motion = inverse(first) @ after @ inverse(before) @ first
    centroid = (inverse(first) @ after)[:3, 3]
    moved = centroid - (inverse(first) @ before)[:3, 3]
    turned = np.asarray(log(motion))[3:]
    found = SimpleNamespace(centroid=centroid, displacement=moved, rotation=turned)
    apart, angle = moving.motion_errors(room, 5, 1, labels, found, first)
    assert apart < 0.01 and angle < 0.01
    apart, angle = moving.motion_errors(room, 4, 1, labels, found, first)
    assert apart > 1 and angle > 0.05
    assert moving.motion_errors(room, 5, 2, labels, found, first)[1] is None


def test_pairs_that_are_wrong_and_told_so_are_counted(load) -> None:
    moving: ModuleType = load("moving")
    score = moving.Score("clip", "card", "x", 0, 0.3, 0.1)
    far, off, near = (0.03, 0.0), (0.01, 0.1), (0.0, 0.5)
    for error, flagged in ((far, True), (far, False), (off, True), (near, False), (near, False)):
        moving.count(score, error, flagged)
    summary = moving.summarise("clip", "card", [score])
    assert (summary.precision, summary.recall, summary.false_alarms) == (0.5, 0.5, pytest.approx(1 / 3))
    assert (score.exact, summary.exact_flagged) == (2, 0.0)
    assert summary.ratio_worst == pytest.approx(3.0) and summary.overlap is None


def test_table_1_is_made_of_the_experiment_and_recorded(
    load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    load("table1")
    table, labels = Table(tmp_path), ("ga", "pso")
    for i, (label, seed) in enumerate(itertools.product(labels, range(6))):
        blank = {name: {TEXT: "{}", REAL: 1.0, FLAG: False}.get(kind, 0) for name, kind in COLUMNS.items()}
        figures = {DRIFT: 0.01 * (1 + 0.1 * i), "run": str(i), "sequence": "clip", "label": label, "seed": seed}
        table.append({**blank, **figures, "runs_together": 1, "pixels": 1})
    plan = {
        "printed": [{"sequence": "clip", "label": "ga", "drift": 0.04}],
        "order": [["clip", name] for name in labels],
    }
    (tmp_path / "experiment.json").write_text(json.dumps(plan))
    file = tmp_path / "table1.toml"
    monkeypatch.setattr(sys, "argv", ["benchmarks/table1.py", "--results", str(tmp_path), "--record", str(file)])
    monkeypatch.setattr(sys.modules["common"], "_printed", [])
    sys.modules["common"].command(sys.modules["table1"].main)
    record = load("records").read_record(file)
    assert record.command == f"python benchmarks/table1.py --results {tmp_path}" and "JAX" in record.versions
    means, tests = record.tables
    assert [row[:3] for row in means.rows] == [("ga", "6", "0.01250"), ("pso", "6", "0.01850")]
    assert means.rows[0][5] == "0.04000" and means.rows[1][5] == "–"
    assert tests.rows[0][0] == "ga / pso" and "recorded in" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["benchmarks/table1.py", "--record"])
    with pytest.raises(SystemExit):
        sys.modules["common"].command(sys.modules["table1"].main)
    assert "--record: name the file" in capsys.readouterr().err


def test_sway_compares_velocities(load, alone, tmp_path: Path) -> None:
    sway: ModuleType = load("sway")
    walk = Rendered(8, rate=5.0, speed=0.4, camera=replace(CAMERA, readout=0.1))
    sway.common.open_clip = lambda _: walk
    sway.common.preset_of = lambda _: replace(NEWTON, alignment=AlignmentOptions(depth=False))
    sway.main(clips=CLIP, json=tmp_path / "sway.json")
    [rows] = read(tmp_path / "sway.json")["clips"].values()
    assert [row["velocity"] for row in rows] == list(sway.VELOCITIES)
    assert all(0 < row["pair_m"] <= row["worst_m"] < 0.05 for row in rows) and rows[0]["pair_m"] != rows[1]["pair_m"]
