"""Traced programs are kept between processes, and used again only where they would be traced the same."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from gavo_jax import AlignmentOptions, AlignmentStatus, Camera, presets
from gavo_jax.alignment.result import no_alignment
from gavo_jax.compilation import programs
from gavo_jax.compilation.programs import CachedProgram, Foreign, identify, keep_programs_in
from gavo_jax.compilation.waits import Stopwatch, told_of_waits
from gavo_jax.image.warp import Points
from gavo_jax.objective.losses import geman_mcclure, huber
from gavo_jax.odometry.aligners import Search
from gavo_jax.presets import METHODS, PRESETS

OPTIONS = AlignmentOptions(points=100)
NUMBERS = np.arange(4, dtype=np.float32)


class Twice(NamedTuple):
    """What the program below returns."""

    doubled: jax.Array
    points: Points | None


traces = 0


def double(numbers: jax.Array, options: AlignmentOptions, *, points: bool = False) -> Twice:
    """A small program that counts how often it is traced."""
    global traces
    traces += 1
    row = 2.0 * numbers * options.min_overlap
    return Twice(row, Points(row, row, row) if points else None)


program: Any = CachedProgram(double, static=("points",), returns=(Twice,))


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Where programs are kept, with nothing traced yet."""
    global traces
    traces = 0
    jax.clear_caches()
    keep_programs_in(tmp_path / "traced")
    yield tmp_path / "traced"
    keep_programs_in(None)


def start_anew(folder: Path) -> None:
    """As if another process began: nothing is known but what the folder holds."""
    jax.clear_caches()
    keep_programs_in(None)
    keep_programs_in(folder)


def test_a_program_is_traced_once_and_found_by_the_next_process(folder: Path) -> None:
    first = program(NUMBERS, OPTIONS, points=True)
    assert traces == 1
    for _ in range(2):
        start_anew(folder)
        again = program(NUMBERS, OPTIONS, points=True)
        assert traces == 1
        assert isinstance(again, Twice)
        assert isinstance(again.points, Points)
        np.testing.assert_array_equal(again.doubled, first.doubled)
    np.testing.assert_allclose(first.doubled, 2.0 * NUMBERS * OPTIONS.min_overlap)
    assert len(list(folder.iterdir())) == 1


def test_what_the_programs_of_frames_and_pairs_return_can_be_kept() -> None:
    settings = presets.preset("ga", "fast")
    state = Search(Camera.preset("icl"), settings, jax.random.key(0)).blank_state()
    for result in (state, no_alignment(AlignmentStatus.GAP)._replace(status=0)):
        leaves, structure = jax.tree.flatten(result)
        kept = export.export(jax.jit(lambda *leaves, of=structure: jax.tree.unflatten(of, leaves)))
        assert kept(*map(jnp.asarray, leaves)).serialize()


def test_its_own_results_are_no_new_program(folder: Path) -> None:
    result = program(NUMBERS, OPTIONS)
    for _ in range(3):
        result = program(result.doubled, OPTIONS)
    assert traces == 1
    assert len(programs._loaded) == 1


def test_functions_of_one_name_are_different_programs(folder: Path) -> None:
    def make(factor: float) -> Any:
        def double(numbers: jax.Array) -> jax.Array:
            return factor * numbers

        double.__module__ = f"tests.of_{factor}"
        return CachedProgram(double)

    for factor in (2.0, 3.0):
        np.testing.assert_array_equal(make(factor)(NUMBERS), factor * NUMBERS)
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize(
    ("change", "is_new"),
    [
        ({"min_overlap": 0.25}, False),  # an input
        ({"min_overlap": np.float32(0.25)}, True),  # of another type
        ({"points": 200}, True),
        ({"loss": huber}, True),
    ],
    ids=["number", "type", "size", "loss"],
)
def test_what_shapes_a_program_tells_it_from_others(folder: Path, change: dict[str, Any], is_new: bool) -> None:
    program(NUMBERS, OPTIONS)
    start_anew(folder)
    found = program(NUMBERS, replace(OPTIONS, **change))
    assert traces == 1 + is_new
    assert len(list(folder.iterdir())) == 1 + is_new
    np.testing.assert_allclose(found.doubled, 2.0 * NUMBERS * change.get("min_overlap", OPTIONS.min_overlap))


def test_shapes_static_arguments_and_jax_settings_tell_programs_apart(folder: Path) -> None:
    program(NUMBERS, OPTIONS)
    assert program(NUMBERS[:2], OPTIONS).doubled.shape == (2,)
    assert program(NUMBERS, OPTIONS, points=True).points is not None
    assert traces == 3
    start_anew(folder)
    with jax.default_matmul_precision("highest"):
        program(NUMBERS, OPTIONS)
    assert traces == 4


def test_jax_settings_that_change_within_a_process_tell_programs_apart(folder: Path) -> None:
    def draw(seed: Any) -> jax.Array:
        return jax.random.uniform(jax.random.key(seed), (8,))

    drawing: Any = CachedProgram(draw)
    was = bool(jax.config.values["jax_threefry_partitionable"])
    found = []
    for partitionable in (was, not was, was):
        with jax.threefry_partitionable(partitionable):
            found.append(drawing(np.uint32(1)))
            np.testing.assert_array_equal(found[-1], draw(np.uint32(1)))
            assert drawing.is_kept(np.uint32(1))
    assert not np.array_equal(found[0], found[1])


def test_changed_code_is_traced_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program(NUMBERS, OPTIONS)
    start_anew(folder)
    monkeypatch.setattr(programs, "_made_from", lambda: b"another version")
    program(NUMBERS, OPTIONS)
    assert traces == 2
    start_anew(folder)
    program(NUMBERS, OPTIONS)
    assert traces == 2
    assert len(list(folder.iterdir())) == 1


def test_the_digest_of_the_code_covers_every_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def digest() -> bytes:
        programs._made_from.cache_clear()
        return programs._made_from()

    for name in ("here/programs.py", "sub/module.py"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("x = 1\n")
    monkeypatch.setattr(programs, "__file__", str(tmp_path / "here/programs.py"))
    seen = {digest(), digest()}
    assert len(seen) == 1
    (tmp_path / "sub/module.py").write_text("x = 2\n")
    seen.add(digest())
    (tmp_path / "sub/module.py").rename(tmp_path / "sub/renamed.py")
    seen.add(digest())
    monkeypatch.setattr(programs, "version", lambda name: "0.0.1")
    seen.add(digest())
    assert len(seen) == 4
    programs._made_from.cache_clear()


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:-100], lambda data: data[:50] + b"x" * 100])
def test_a_damaged_file_is_written_anew(folder: Path, damage: Any) -> None:
    program(NUMBERS, OPTIONS)
    (path,) = folder.iterdir()
    path.write_bytes(damage(path.read_bytes()))
    for _ in range(2):
        start_anew(folder)
        program(NUMBERS, OPTIONS)
        assert traces == 2


def test_where_nothing_can_be_written_programs_run_all_the_same(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    keep_programs_in(tmp_path / "file" / "traced")
    np.testing.assert_allclose(program(NUMBERS, OPTIONS).doubled, 2.0 * NUMBERS * OPTIONS.min_overlap)


def test_nothing_is_kept_unless_a_folder_is_named(folder: Path) -> None:
    keep_programs_in(None)
    program(NUMBERS, OPTIONS)
    assert not folder.exists()


def test_inside_another_program_it_is_part_of_that(folder: Path) -> None:
    nested = jax.jit(lambda numbers: program(numbers, OPTIONS).doubled)
    np.testing.assert_allclose(nested(NUMBERS), 2.0 * NUMBERS * OPTIONS.min_overlap)
    assert not folder.exists()


def test_somebody_elses_code_is_never_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ours_no_more(s: jax.Array) -> jax.Array:
        return s

    @dataclass(frozen=True)
    class Solver:
        rate: float = 1.0

    for loss in (jnp.log1p, ours_no_more, partial(geman_mcclure), np.log1p):
        found = program(NUMBERS, replace(OPTIONS, loss=loss))
        np.testing.assert_allclose(found.doubled, 2.0 * NUMBERS * OPTIONS.min_overlap)
    with pytest.raises(Foreign):
        identify(Solver())
    monkeypatch.setattr("gavo_jax.objective.losses.geman_mcclure", ours_no_more)
    program(NUMBERS, OPTIONS)
    assert not folder.exists()


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", METHODS)
def test_every_preset_can_be_kept(method: str, preset: str) -> None:
    settings = presets.preset(method, preset)
    identified = identify((settings.solver, settings.alignment, settings.odometry))
    assert " at 0x" not in repr(identified)
    assert identified == identify((settings.solver, settings.alignment, settings.odometry))
    others = [presets.preset(method, other) for other in PRESETS if other != preset]
    assert all(identified != identify((other.solver, other.alignment, other.odometry)) for other in others)


def test_it_is_told_beforehand_whether_a_program_is_kept(folder: Path) -> None:
    assert not program.is_kept(NUMBERS, OPTIONS)
    program(NUMBERS, OPTIONS)
    assert program.is_kept(NUMBERS, OPTIONS) and not program.is_kept(NUMBERS, OPTIONS, points=True)
    start_anew(folder)
    assert program.is_kept(jnp.asarray(NUMBERS), OPTIONS) and traces == 1
    keep_programs_in(None)
    assert not program.is_kept(NUMBERS, OPTIONS)


def test_waiting_for_a_program_is_told_and_is_no_time_of_the_work(folder: Path) -> None:
    told: list[Path | None] = []
    for kept in (folder, None):  # kept between processes, and not
        start_anew(folder)
        keep_programs_in(kept)
        slow: Any = CachedProgram(slowly_traced)
        start, stopwatch = time.perf_counter(), Stopwatch()
        with told_of_waits(partial(told.append, kept)):
            slow(NUMBERS)
            waited = stopwatch.waited
            slow(NUMBERS + 1)
        assert told.count(kept) == 1
        assert waited >= 0.3
        assert stopwatch.waited == waited
        assert stopwatch.seconds < time.perf_counter() - start - 0.3
    slow(NUMBERS[:2])
    assert len(told) == 2, "nobody listens any more"


def slowly_traced(numbers: jax.Array) -> jax.Array:
    """A program that takes its time to trace."""
    time.sleep(0.3)
    return numbers + 1.0


def test_inputs_on_another_device_find_a_program_of_their_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is kept is compiled for the usual device, and refuses others' arrays by a ValueError."""
    elsewhere: Any = CachedProgram(double, static=("points",), returns=(Twice,))

    def refuses(*_: Any) -> Any:
        raise ValueError("Computation was compiled for input shardings that disagree")

    monkeypatch.setattr(elsewhere, "_load", lambda *_: refuses)
    found = elsewhere(NUMBERS, replace(OPTIONS, min_overlap=0.5))
    np.testing.assert_array_equal(found.doubled, NUMBERS)
