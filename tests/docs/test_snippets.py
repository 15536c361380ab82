"""Every block of Python on a page runs, and every command on it is understood.

Blocks run on a few frames of a small camera, and with searches that other tests compile too: what is tested is that the
names, arguments and results are those that the page says.
"""

import functools
import importlib
import re
import shlex
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
import tyro
from pages import PAGES, ROOT, blocks, commands, inline_commands, name
from small import ALONE, CAMERA, GENETIC, NEWTON, PLAIN_ERROR

import gavo_jax as gavo
from gavo_jax import presets
from gavo_jax.cli import _parse, main
from gavo_jax.cli.options import Align, Command, Compare, Download, Inspect, Run
from gavo_jax.cli.selection import choose_settings
from gavo_jax.datasets.download import folder_of
from gavo_jax.experiments.plan_file import read_plan
from gavo_jax.experiments.tuning import read_tuning
from gavo_jax.peers.registry import PEERS

FRAMES = 6
WITH_PYTHON = [page for page in PAGES if blocks(page, "python")]
WITH_SETTINGS = [page for page in PAGES if blocks(page, "toml")]
WITH_COMMANDS = [page for page in PAGES if commands(page) or inline_commands(page)]
SUBCOMMANDS = tuple(get_args(one)[1].name for one in get_args(Command))
OTHER_PROGRAMS = ("cd", "git", "mkdocs", "pre-commit", "pyright", "rerun", "ruff", ".ci/run")


@pytest.fixture(scope="module")
def sequences(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sequences that the pages name."""
    folder = tmp_path_factory.mktemp("sequences")
    for sequence in ("rgbd_dataset_freiburg1_xyz", "my_sequence", "data/rgbd_dataset_freiburg1_desk"):
        gavo.write_tum(gavo.SyntheticSequence(FRAMES, camera=CAMERA, speed=0.2), folder / sequence)
    own = folder / "my_sequence"  # of two folders with numbers, as the tutorial has it
    for kind in ("rgb", "depth"):
        (own / f"{kind}.txt").unlink()
        for number, file in enumerate(sorted((own / kind).iterdir())):
            file.rename(own / kind / f"{number:04}.png")
    write_video(folder / "colour.mp4")
    return folder


def write_video(path: Path) -> None:
    """Three frames of 640 x 480, which differ."""
    images = np.random.default_rng(0).integers(0, 255, (3, 30, 40, 3), np.uint8)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (640, 480))
    for image in images:
        video.write(cv2.resize(image, (640, 480)))
    video.release()


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make what pages use small and fast."""
    align, room, options = gavo.align, gavo.SyntheticSequence, gavo.AlignmentOptions
    plain = {field.name: getattr(PLAIN_ERROR, field.name) for field in fields(PLAIN_ERROR)}

    def small_align(reference: Any, target: Any, camera: gavo.Camera, settings: Any = NEWTON, **more: Any) -> Any:
        settings = settings if isinstance(settings, gavo.Settings) else gavo.Settings(settings, PLAIN_ERROR, ALONE)
        return align(reference, target, camera, settings, **more)

    def small_room(frames: int, **more: Any) -> gavo.SyntheticSequence:
        return room(min(frames, FRAMES), camera=CAMERA, speed=0.2, **more)

    monkeypatch.setattr(gavo, "SyntheticSequence", small_room)
    monkeypatch.setattr(gavo, "align", small_align)
    monkeypatch.setattr(gavo, "GeneticAlgorithm", lambda: GENETIC.solver)
    monkeypatch.setattr(gavo, "AlignmentOptions", lambda **own: options(**plain | own))
    monkeypatch.setattr(gavo, "enable_compilation_cache", lambda: None)
    monkeypatch.setattr(presets, "_registered", {})


@pytest.mark.parametrize("page", WITH_PYTHON, ids=name)
def test_blocks_of_python_run(page: Path, small: None, sequences: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(sequences)
    if page.stem != "own-solver":  # which changes the settings it gets, and runs others
        known = gavo.preset
        monkeypatch.setattr(gavo, "preset", lambda *named: known(*named) and NEWTON)
    names: dict[str, Any] = {"__name__": "page"}
    for block in blocks(page, "python"):
        exec(compile("\n" * (block.line - 1) + block.code, str(page), "exec"), names)
    assert page.stem != "sources" or "step" in names, "the loop over the video had no frame"


@pytest.mark.parametrize("page", WITH_SETTINGS, ids=name)
def test_files_of_settings_are_read(page: Path, sequences: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(sequences)
    for block in blocks(page, "toml"):
        file = sequences / "page.toml"
        file.write_text(block.code)
        if "[[methods]]" in block.code:
            assert read_plan(file).runs
        elif "[space]" in block.code:
            assert read_tuning(file).space
        elif "[project]" in block.code:
            assert list(tomllib.loads(block.code)["project"]["entry-points"]) == [presets.PLUGINS]
        else:
            assert gavo.load_camera(file).width == 640


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=name)
def test_commands_are_understood(page: Path, sequences: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.chdir(sequences)
    gavo.save_settings("own.toml", gavo.preset("ga", "fast"))
    for command in [*commands(page), *inline_commands(page)]:
        program, *arguments = shlex.split(command)
        if program == "gavo":
            check_gavo(arguments)
        elif program == "pip":
            check_extras(command)
        elif program == "python" and arguments[0].endswith(".py"):
            assert (ROOT / arguments[0]).is_file(), command
            if arguments[0].startswith("benchmarks/") and arguments[0] != "benchmarks/records.py":
                check_benchmark(Path(arguments[0]).stem, arguments[1:])
        else:
            assert program in OTHER_PROGRAMS or [program, arguments[0]] == ["python", "-m"], command


def check_gavo(arguments: list[str]) -> None:
    """The parser takes them, and what they name exists; a subcommand that is merely mentioned needs no arguments."""
    if len(arguments) == 1:
        assert arguments[0] in ("--version", *SUBCOMMANDS)
        return
    parsed = _parse(arguments)
    if isinstance(parsed, Run | Align) and parsed.method in presets.methods():
        if parsed.settings is None or parsed.settings.is_file():
            choose_settings(parsed)
    if isinstance(parsed, Compare):
        assert {name.partition(":")[0] for name in parsed.methods.split(",")} <= {*presets.methods(), *PEERS}
    if isinstance(parsed, Download):
        folder_of(parsed.name)
    if isinstance(parsed, Inspect) and Path(parsed.sequence).is_dir():
        assert main(arguments) == 0


def check_benchmark(benchmark: str, arguments: list[str]) -> None:
    """The benchmark's parser takes them."""
    run = importlib.import_module(benchmark).main
    arguments, _ = importlib.import_module("common").take_record(arguments)
    tyro.cli(functools.wraps(run)(lambda **_: None), args=arguments)


def check_extras(command: str) -> None:
    """The package has them."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for named in re.findall(r"\[([\w,]+)\]", command):
        assert set(named.split(",")) <= set(extras), command
