"""The examples run, with nothing downloaded, and find what they look for."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image
from small import CAMERA, GENETIC

import gavo_jax as gavo
from gavo_jax import presets
from gavo_jax.cli import main
from gavo_jax.cli.options import Run
from gavo_jax.cli.selection import choose_settings
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.status import AlignmentStatus

FOLDER = Path(__file__).parent.parent / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_run_here() -> None:
    tested = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert {path.stem for path in FOLDER.glob("*.py")} <= tested


def test_one_pair(capsys: pytest.CaptureFixture[str]) -> None:
    pair = load("one_pair").main()
    assert pair.status is AlignmentStatus.OK
    assert "target_T_reference" in capsys.readouterr().out


def test_sequence(capsys: pytest.CaptureFixture[str]) -> None:
    run = load("sequence").main(frames=5)
    assert run.metrics["lost_pairs"] == 0
    assert run.metrics["distance_error_final_m"] < 0.01
    assert len(capsys.readouterr().out.splitlines()) == 4 + len(run.metrics)


def test_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    module, room = load("film"), gavo.SyntheticSequence
    monkeypatch.setattr(gavo, "SyntheticSequence", lambda frames, color: room(frames, camera=CAMERA, color=color))
    monkeypatch.setattr(gavo, "preset", lambda _: GENETIC)
    pictures = module.main(str(tmp_path / "film.webp"), frames=2, stride=2)
    with Image.open(tmp_path / "film.webp") as film:
        assert film.format == "WEBP" and getattr(film, "n_frames", 1) == len(pictures) > 5
    assert pictures[0].size == (900, 310)
    assert "film.webp" in capsys.readouterr().out


def test_own_dataset(capsys: pytest.CaptureFixture[str]) -> None:
    module = load("own_dataset")
    run = module.main(frames=4)
    truth = SyntheticSequence(frames=4).ground_truth.world_T_camera
    moved = np.linalg.inv(truth[0]) @ truth[-1]
    assert np.linalg.norm(run.trajectory.world_T_camera[-1][:3, 3] - moved[:3, 3]) < 0.01
    assert capsys.readouterr().out == "room: 4 frames, 0 pairs lost\n"
    short = module.ArraySequence("short", None, np.zeros((2, 4, 4)), np.zeros((1, 4, 4)), np.zeros(2))
    with pytest.raises(gavo.GavoError, match="differ in length"):
        gavo.run_odometry(short)


def test_live_frames(capsys: pytest.CaptureFixture[str]) -> None:
    world_T_camera = load("live_frames").main(frames=4)
    truth = SyntheticSequence(frames=4).ground_truth.world_T_camera
    moved = np.linalg.inv(truth[0]) @ truth[-1]
    assert np.linalg.norm(world_T_camera[:3, 3] - moved[:3, 3]) < 0.01
    assert capsys.readouterr().out.count("The motion was found.") == 3


def test_seeds_batch(capsys: pytest.CaptureFixture[str]) -> None:
    errors = load("seeds_batch").main(seeds=4, decays=(0.7, 0.9))
    assert errors.shape == (2, 4)
    assert np.isfinite(errors).all() and len(np.unique(errors)) > 4
    assert errors.max() < 1.2 * errors.min()
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_custom_loss() -> None:
    pair = load("custom_loss").main()
    world_T_camera = SyntheticSequence(frames=2).ground_truth.world_T_camera
    exact = np.linalg.inv(world_T_camera[1]) @ world_T_camera[0]
    assert np.linalg.norm(pair.target_T_reference[:3, 3] - exact[:3, 3]) < 0.005


def test_own_solver(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presets, "_registered", {})
    pair = load("own_solver").main()
    assert pair.status is AlignmentStatus.OK
    world_T_camera = SyntheticSequence(frames=2).ground_truth.world_T_camera
    exact = np.linalg.inv(world_T_camera[1]) @ world_T_camera[0]
    assert np.linalg.norm(pair.target_T_reference[:3, 3] - exact[:3, 3]) < 0.001
    chosen = choose_settings(Run(method="differential-evolution", set=("solver.weight=0.5",)))
    assert chosen.method == "differential-evolution" and chosen.settings.solver != gavo.preset(chosen.method).solver
    assert chosen.settings.solver.weight == 0.5  # pyright: ignore[reportAttributeAccessIssue]
    capsys.readouterr()
    assert main(["run", "synthetic", "--method", chosen.method, "--preset", "fast"]) == 2
    assert "has no preset 'fast'" in capsys.readouterr().err
