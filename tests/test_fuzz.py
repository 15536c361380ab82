"""Files from strangers: whatever is in them, a reader returns something sound or refuses it in one line.

The fast tests take a few hundred inputs a reader; `pytest -m slow tests/test_fuzz.py` takes 100,000.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gavo_jax.camera import MAX_SIDE, Camera
from gavo_jax.camera_files.calibration import load_camera
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.errors import GavoError
from gavo_jax.experiments.plan import batches, programs
from gavo_jax.experiments.plan_file import read_plan
from gavo_jax.experiments.tuning import read_tuning
from gavo_jax.trajectory import Trajectory

NUMBERS = st.one_of(
    st.floats().map(repr),
    st.floats(-1e3, 1e3).map(lambda value: f"{value:.6f}"),
    st.integers().map(str),
    st.sampled_from(["nan", "-inf", "1e999", "-0", "0x10", "1_0", "١٢", "1e-400", "+5", ".", "1e", "9" * 400, "True"]),
)
SOUND = st.floats(-99, 99).map(lambda value: f"{value:.3f}")
PATHS = st.one_of(
    st.sampled_from(["rgb/0.png", "../x.png", "/etc/passwd", "rgb", "a\0b", "~", "rgb/../../x", "\\\\x\\y", "C:\\x"]),
    st.text(max_size=12),
    st.sampled_from("x/").map(lambda part: part * 5000),
)
NOISE = st.one_of(st.just(""), st.just("# comment"), st.text(max_size=20), st.just("\ufeff"), st.just("\0"))
ENDINGS = st.sampled_from(["\n", "\r\n", "\r", "\n\n", "\x0b", "\u2028"])


def lines(row: st.SearchStrategy[str]) -> st.SearchStrategy[bytes]:
    """Files of rows with noise between them, or of any bytes at all."""
    text = st.tuples(st.lists(st.one_of(row, row, NOISE), max_size=6), ENDINGS).map(
        lambda parts: parts[1].join(parts[0])
    )
    return st.one_of(text.map(lambda t: t.encode("utf-8", "surrogatepass")), st.binary(max_size=100))


def joined(*fields: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.tuples(st.tuples(*fields), st.sampled_from([" ", "\t", ",", "  "])).map(lambda row: row[1].join(row[0]))


TRAJECTORIES = st.one_of(
    lines(joined(*[SOUND] * 8)), lines(st.one_of(joined(*[NUMBERS] * 8), st.lists(NUMBERS, max_size=10).map(" ".join)))
)
SOUND_ROWS = lines(joined(st.integers(0, 9).map(str), st.just("rgb/0.png")))
LISTS = st.tuples(*[st.one_of(SOUND_ROWS, lines(st.one_of(joined(NUMBERS, PATHS), joined(*[NUMBERS] * 3))))] * 2)
KEYS = st.sampled_from(
    ["fx", "fy", "cx", "cy", "width", "height", "distortion", "depth_scale", "[fx]", "a.b", "", '"fx"']
)
VALUES = st.one_of(
    NUMBERS,
    st.lists(NUMBERS, max_size=6).map(lambda items: "[" + ", ".join(items) + "]"),
    st.sampled_from(
        ["true", '"640"', "{}", "[" * 3000, "1979-05-27", "'''", "[[1]]", "!!python/object:os.system", "&a", "*a"]
    ),
)
GOOD_CAMERA = {"fx": "500.0", "fy": "500.0", "cx": "320.0", "cy": "240.0", "width": "640", "height": "480"}
SMALL_CAMERA = "fx = 50.0\nfy = 50.0\ncx = 31.5\ncy = 23.5\nwidth = 64\nheight = 48\n"
"""Its frames are soon rendered: to make a plan three of them are."""


def cameras(sign: str) -> st.SearchStrategy[bytes]:
    """Camera files: any rows, and good ones of which a few values are replaced."""

    def text(values: dict[str, str]) -> bytes:
        rows = [f"{key} {sign} {value}" for key, value in {**GOOD_CAMERA, **values}.items()]
        return "\n".join(rows).encode("utf-8", "surrogatepass")

    row = st.tuples(KEYS, VALUES).map(lambda pair: f"{pair[0]} {sign} {pair[1]}")
    return st.one_of(lines(row), st.dictionaries(KEYS, VALUES, max_size=3).map(text))


def tables(*sections: tuple[str, dict[str, str]], keys: st.SearchStrategy[str]) -> st.SearchStrategy[bytes]:
    """TOML files: good ones of which a few values are replaced and a few keys added, and any rows at all."""

    def text(changes: tuple[dict[str, str], ...]) -> bytes:
        parts = []
        for (heading, good), changed in zip(sections, changes, strict=True):
            parts += [heading, *(f"{key} = {value}" for key, value in {**good, **changed}.items() if value)]
        return "\n".join(parts).encode("utf-8", "surrogatepass")

    rows = st.tuples(keys, SETTINGS).map(lambda pair: f"{pair[0]} = {pair[1]}")
    headings = st.sampled_from(
        [heading for heading, _ in sections] + ["[sequences]", "[[methods", "[[ray]]", "[[a.b]]"]
    )
    few = [st.dictionaries(st.one_of(st.sampled_from([*good]), keys), SETTINGS, max_size=2) for _, good in sections]
    one = [st.tuples(*(few[j] if i == j else st.just({}) for j in range(len(few)))) for i in range(len(sections))]
    return st.one_of(*[changes.map(text) for changes in (*one, st.tuples(*few))], lines(st.one_of(rows, headings)))


WORDS = st.sampled_from(
    """ga pso gauss-newton adam opencv-rgb default fast paper wide none huber l2 synthetic nowhere fr1 auto keyframe
    *""".split()
)
SCALARS = st.one_of(
    WORDS.map(lambda word: f'"{word}"'),
    st.integers(0, 12).map(str),
    st.sampled_from(
        ["2000000", "-1", "1e-3", "0.5", "true", "false", str(2**70), "nan", "inf", "1979-05-27", "07:32:00"]
    ),
    VALUES,
    st.sampled_from(['"' + "x" * 5000 + '"', r'"a\u0000b"', r'"a\nb"', '"../.."', '"/dev/zero"']),
    st.text(max_size=8).map(lambda text: f"'{text}'"),
)
SETTINGS = st.one_of(
    SCALARS,
    st.lists(SCALARS, max_size=5).map(lambda items: "[" + ", ".join(items) + "]"),
    st.dictionaries(
        st.sampled_from(["low", "high", "step", "log", "a", "cpus"]), st.one_of(st.integers(0, 12).map(str), SCALARS)
    ).map(lambda table: "{ " + ", ".join(f"{key} = {value}" for key, value in table.items()) + " }"),
    st.just(""),
)
DOTTED = st.sampled_from(
    """solver.population solver.population.4 solver.iterations solver.iterations.9 solver.mutation_decay solver.damping
    solver.patience solver.spread alignment.loss alignment.depth_weight alignment.robust_scale odometry.reference
    odometry.on_lost odometry sweep.solver.damping sweep.alignment.loss sweep printed printed.synthetic seeds presets
    name optional camera start frames stride path batch output cpus gpus trials space methods sequences ray "" x solver
    solver.population.x solver.iterations.² alignment.optimizer""".split()
)
PLANS = tables(
    ("", {"seeds": "2"}),
    ("[[sequences]]", {"path": '"synthetic"', "camera": '"camera.toml"', "frames": "3", "name": '"a"'}),
    ("[[methods]]", {"name": '"ga"', "presets": '["fast"]', "solver.patience": "5", "sweep.alignment.loss": '["l2"]'}),
    ("[[methods]]", {"name": '"opencv-rgb"', "printed.a": "0.1"}),
    ("[ray]", {"cpus": "1"}),
    keys=DOTTED,
)
TUNINGS = tables(
    ("", {"method": '"gauss-newton"', "preset": '"fast"', "trials": "2"}),
    ("[[sequences]]", {"path": '"synthetic"', "frames": "3"}),
    (
        "[space]",
        {
            "solver.damping": "{ low = 1e-6, high = 1e-2, log = true }",
            "solver.iterations.4": "{ low = 8, high = 9 }",
            "alignment.loss": '["huber", "l2"]',
        },
    ),
    keys=DOTTED,
)


def read_trajectory(folder: Path, content: bytes) -> None:
    (folder / "file.txt").write_bytes(content)
    trajectory = Trajectory.read_tum(folder / "file.txt")
    assert len(trajectory) > 0 and np.isfinite(trajectory.world_T_camera).all()
    assert np.all(np.diff(trajectory.timestamps) > 0)


def read_lists(folder: Path, content: tuple[bytes, bytes]) -> None:
    for name, data in zip(("rgb.txt", "depth.txt"), content, strict=True):
        (folder / name).write_bytes(data)
    sequence = TumSequence(folder, Camera(50.0, 50.0, 31.5, 23.5, 64, 48))
    assert len(sequence) > 0 and np.all(np.diff(sequence.timestamps) >= 0)
    sequence.check()
    pytest.fail("there is no image in the folder")


def read_camera(suffix: str) -> Callable[[Path, bytes], None]:
    def read(folder: Path, content: bytes) -> None:
        (folder / f"camera{suffix}").write_bytes(content)
        camera = load_camera(folder / f"camera{suffix}")
        assert 16 <= camera.width <= MAX_SIDE and 16 <= camera.height <= MAX_SIDE
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.depth_scale, *camera.distortion]
        assert all(isinstance(number, float) and math.isfinite(number) for number in numbers)

    return read


def read_experiment(folder: Path, content: bytes) -> None:
    (folder / "experiment.toml").write_bytes(content)
    (folder / "camera.toml").write_text(SMALL_CAMERA)
    plan = read_plan(folder / "experiment.toml")
    assert plan.runs and len({run.id for run in plan.runs}) == len(plan.runs) and plan.batch >= 1
    assert all(run.pairs >= 1 for run in plan.runs) and 0 <= programs(plan.runs) <= len(plan.runs)
    assert sum(len(batch.runs) for batch in batches(plan.runs, plan.batch)) == len(plan.runs)


def read_study(folder: Path, content: bytes) -> None:
    (folder / "tuning.toml").write_bytes(content)
    tuning = read_tuning(folder / "tuning.toml")
    assert tuning.parts and tuning.space and tuning.trials >= 1 and tuning.seeds


READERS: dict[str, tuple[st.SearchStrategy[Any], Callable[[Path, Any], None]]] = {
    "trajectory": (TRAJECTORIES, read_trajectory),
    "lists": (LISTS, read_lists),
    "toml": (cameras("="), read_camera(".toml")),
    "yaml": (cameras(":"), read_camera(".yaml")),
    "experiment": (PLANS, read_experiment),
    "tuning": (TUNINGS, read_study),
}


def fuzz(reader: str, folder: Path, examples: int) -> int:
    """Feed a reader with so many inputs; return how many it took."""
    contents, read = READERS[reader]
    taken = 0

    @settings(
        max_examples=examples, database=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much]
    )
    @given(content=contents)
    def feed(content: Any) -> None:
        nonlocal taken
        try:
            read(folder, content)
            taken += 1
        except GavoError as error:
            message = str(error)
            assert str(folder) in message and len(message.splitlines()) == 1 and len(message) < 2000

    feed()
    return taken


@pytest.mark.filterwarnings("ignore:.* left out")
@pytest.mark.parametrize("reader", READERS)
def test_readers_raise_nothing_else(tmp_path, reader):
    taken = fuzz(reader, tmp_path, 300)
    assert taken > 0 or reader == "lists", "the inputs never came past the first check"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* left out")
@pytest.mark.parametrize("reader", READERS)
def test_readers_raise_nothing_else_at_length(tmp_path, reader):
    fuzz(reader, tmp_path, 100_000)


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt"])
def test_lists_of_gigabytes_are_refused_unread(tmp_path, name):
    for other in ("rgb.txt", "depth.txt"):
        (tmp_path / other).write_text("0.0 x.png\n")
    with (tmp_path / name).open("wb") as file:
        file.truncate(3 * 2**30)
    with pytest.raises(GavoError, match="larger than"):
        TumSequence(tmp_path, "fr1")


@pytest.mark.parametrize("name", ["rgb.txt", "camera.toml"])
def test_what_is_no_file_is_not_waited_for(tmp_path, name):
    """Devices, pipes and folders under the names of files."""
    (tmp_path / "depth.txt").write_text("0.0 x.png\n")
    for make in (Path.mkdir, lambda path: path.symlink_to("/dev/zero"), os.mkfifo):
        path = tmp_path / name
        make(path)
        with pytest.raises(GavoError, match="not a file"):
            load_camera(path) if name == "camera.toml" else TumSequence(tmp_path, "fr1")
        path.rmdir() if path.is_dir() else path.unlink()
