"""Search of settings with Optuna, minimising drift and time together."""

import json
import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gavo_jax import presets
from gavo_jax.datasets.base import Sequence as FrameSequence
from gavo_jax.errors import GavoError, line_of, read_toml, shown
from gavo_jax.experiments.plan import Part, frames_of
from gavo_jax.experiments.plan_file import parts_of, refuse_as_folder, require_what_loops_need
from gavo_jax.experiments.values import seeds_of, text_of, whole_of
from gavo_jax.interrupts import interruptible
from gavo_jax.odometry.metrics import DRIFT, MILLISECONDS
from gavo_jax.odometry.run import run_odometry
from gavo_jax.output.files import describe, differences
from gavo_jax.presets import PRESETS
from gavo_jax.settings import Settings
from gavo_jax.settings_file import flatten, override, refuse_unknown, refuse_unknown_method, takes_whole

KEYS = ("name", "output", "seeds", "sequences", "method", "preset", "trials", "space")
RANGE_KEYS = ("low", "high", "step", "log")
TRIALS = 50
CONFIGURATION = "configuration"
"""Attribute of a study that holds its configuration as JSON."""


@dataclass(frozen=True)
class Tuning:
    """The contents of a tuning file.

    Attributes:
        name: Name of the study.
        folder: Folder for the default storage and the Pareto front.
        parts: Frames that every trial tracks.
        seeds: Seeds; each trial tracks all frames once per seed.
        method: One of `presets.methods()`.
        preset: Preset that supplies all settings outside `space`.
        trials: Number of finished trials to reach.
        space: By dotted name of a hyperparameter, a list of choices or a table of `low`, `high`, `step`, `log`.
        skipped: One line for each missing optional sequence.
    """

    name: str
    folder: Path
    parts: tuple[Part, ...]
    seeds: tuple[int, ...]
    method: str
    preset: str
    trials: int
    space: Mapping[str, Any]
    skipped: tuple[str, ...]


class Choice(NamedTuple):
    """A trial on the Pareto front: no other one is better in drift or time without being worse in the other."""

    trial: int
    drift: float
    """Geometric mean over sequences and seeds, m/s."""
    milliseconds: float
    """Geometric mean of the median time per pair."""
    settings: dict[str, Any]


def read_tuning(path: str | Path, output: str | Path | None = None) -> Tuning:
    """Read a tuning file and check it completely.

    Raises:
        GavoError: The message names the file, the key and the fault.
    """
    path = Path(path)
    table = read_toml(path)
    refuse_unknown(str(path), table, KEYS)
    name = text_of(f"{path}: name", table.get("name", path.stem))
    refuse_as_folder(f"{path}: name", name)
    parts, skipped = parts_of(path, table)
    method, preset = table.get("method", "ga"), table.get("preset", "default")
    refuse_unknown_method(f"{path}: method", str(method))
    refuse_unknown(f"{path}: preset", [str(preset)], PRESETS, "name")
    space = flatten(f"{path}: space", table.get("space", {}), lambda value: "low" in value or "high" in value)
    if not space:
        raise GavoError(f"{path}: space: nothing to tune")
    start = presets.preset(method, preset)
    for key, spec in space.items():
        place = f"{path}: space.{key}"
        for bound in _bounds(place, spec):
            require_what_loops_need(place, override(start, {key: bound}, place))
        if isinstance(spec, Mapping) and takes_whole(start, key) and not isinstance(spec.get("step", 1), int):
            raise GavoError(f"{place}: step: must be a whole number, not {shown(spec['step'])}")
    return Tuning(
        name,
        Path(output or text_of(f"{path}: output", table.get("output", f"runs/{name}"))),
        tuple(parts),
        seeds_of(f"{path}: seeds", table.get("seeds", [0])),
        method,
        preset,
        whole_of(f"{path}: trials", table.get("trials", TRIALS), 1),
        space,
        tuple(skipped.values()),
    )


def tune(
    tuning: Tuning, storage: str, trials: int, on_trial: Callable[[int, float, float], None] = lambda *_: None
) -> list[Choice]:
    """Bring a study up to a number of finished trials and return its Pareto front, fastest first.

    Args:
        tuning: Contents of the tuning file.
        storage: Any Optuna storage. A study of the same name in it is continued; several machines may share it.
        trials: Number of finished trials to reach.
        on_trial: Called after each finished trial with its number, drift and milliseconds.

    Raises:
        GavoError: A sequence has no ground truth over a second, every trial lost the camera, Optuna is missing, the
            storage cannot be used, or its study of that name has other frames or settings.
    """
    try:
        import optuna
    except ImportError:
        raise GavoError("tuning needs Optuna: pip install 'gavo-jax[tune]'") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sequences = [part.open() for part in tuning.parts]
    for part, sequence in zip(tuning.parts, sequences, strict=True):
        _refuse_without_drift(part.name, sequence)
    start = presets.preset(tuning.method, tuning.preset)
    told = without_password(storage)
    with _storage_faults(told):
        study = optuna.create_study(
            storage=storage, study_name=tuning.name, directions=["minimize", "minimize"], load_if_exists=True
        )
        _refuse_another(study, _configuration(tuning, sequences, start), told)
    while True:
        with _storage_faults(told):
            if len(_finished(optuna, study)) >= trials:
                front = [Choice(t.number, t.values[0], t.values[1], dict(t.params)) for t in study.best_trials]
                return sorted(_tracked(tuning, front), key=lambda choice: choice.milliseconds)
            trial = study.ask()
        try:
            with _storage_faults(told):
                values = {
                    key: _suggest(trial, key, spec, takes_whole(start, key)) for key, spec in tuning.space.items()
                }
            settings = override(start, values, f"trial {trial.number}")
            drift, milliseconds = interruptible(partial(measure, sequences, settings, tuning.seeds))
        except BaseException:
            with suppress(Exception):  # a failing storage has been reported, or will be
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
            raise
        with _storage_faults(told):
            study.tell(trial, [drift, milliseconds])
        on_trial(trial.number, drift, milliseconds)


def without_password(storage: str) -> str:
    """Return a storage's address with the password masked, for display."""
    return re.sub(r"(://[^:/@]*):[^@]*@", r"\1:…@", storage)


@contextmanager
def _storage_faults(storage: str) -> Iterator[None]:
    """Turn any exception of Optuna into a GavoError: a damaged storage can raise almost anything."""
    try:
        yield
    except GavoError:
        raise
    except Exception as error:
        raise GavoError(f"{storage}: cannot be used as storage: {line_of(error)}") from None


def _configuration(tuning: Tuning, sequences: Sequence[FrameSequence], start: Settings) -> dict[str, Any]:
    """Everything that defines a study: its search space, the settings it starts from, its seeds and its frames."""
    parts = [frames_of(part.name, sequence) for part, sequence in zip(tuning.parts, sequences, strict=True)]
    return describe(
        {
            "method": tuning.method,
            "preset": tuning.preset,
            "settings": start,
            "space": tuning.space,
            "seeds": tuning.seeds,
            "sequences": {part["name"]: part for part in parts},
        }
    )


def _refuse_another(study: Any, configuration: dict[str, Any], storage: str) -> None:
    """Record the configuration of a new study; raise GavoError if an existing one has a different configuration."""
    kept = study.user_attrs.get(CONFIGURATION)
    if kept is None and not study.get_trials(deepcopy=False):
        study.set_user_attr(CONFIGURATION, json.dumps(configuration))
        return
    advice = "give this study another name or another --output"
    if kept is None:
        raise GavoError(f"{storage}: the study {study.study_name!r} does not record what it tunes: {advice}")
    there, now = json.loads(kept), json.loads(json.dumps(configuration))
    if set(there["sequences"]) != set(now["sequences"]):
        names = [", ".join(some["sequences"]) for some in (there, now)]
        raise GavoError(f"{storage}: the study {study.study_name!r} is for {names[0]}, not for {names[1]}: {advice}")
    for name, before, after in differences(there, now):
        raise GavoError(
            f"{storage}: the study {study.study_name!r} is a different one ({name} was {before}, now {after}): {advice}"
        )


def _refuse_without_drift(name: str, sequence: FrameSequence) -> None:
    """Raise GavoError if no drift can be computed on a sequence, before any trial."""
    lasts = float(np.ptp(sequence.timestamps))
    if sequence.ground_truth is None:
        raise GavoError(f"{name}: no ground truth, so no drift to tune by")
    if lasts < 1:
        raise GavoError(f"{name}: drift is measured over 1 s, but these frames last {lasts:.2f} s")


def measure(sequences: list[FrameSequence], settings: Settings, seeds: tuple[int, ...]) -> tuple[float, float]:
    """Return the geometric means of drift (m/s) and of the median time per pair (ms).

    Runs are made one at a time, so that none shares the machine. The drift is infinite if the camera is lost before any
    stretch lasts a second.

    Raises:
        GavoError: A sequence has no ground truth over a second.
    """
    figures = []
    for sequence in sequences:
        for seed in seeds:
            metrics = run_odometry(sequence, settings, seed=seed).metrics
            drift, is_whole = metrics[DRIFT], metrics["segments"] == 1 and metrics["complete"]
            if drift is None and is_whole:
                raise GavoError(f"{sequence.name}: no ground truth over any second of it")
            figures.append((np.inf if drift is None else drift, metrics[MILLISECONDS]))
    drift, milliseconds = np.exp(np.mean(np.log(figures), axis=0))
    return float(drift), float(milliseconds)


def _tracked(tuning: Tuning, front: list[Choice]) -> list[Choice]:
    """Return the choices with a finite drift; raise GavoError if every trial lost the camera."""
    kept = [choice for choice in front if np.isfinite(choice.drift)]
    if not kept:
        raise GavoError(f"{tuning.name}: every trial lost the camera within a second: no drift to choose by")
    return kept


def _finished(optuna: Any, study: Any) -> list[Any]:
    return study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))


def _bounds(place: str, spec: Any) -> list[Any]:
    """Check a search space entry and return the values to validate: all choices, or both ends of a range."""
    if isinstance(spec, list) and spec:
        return spec
    if not isinstance(spec, Mapping):
        raise GavoError(f"{place}: neither a list of choices nor a table with low and high")
    refuse_unknown(place, spec, RANGE_KEYS)
    ends: list[Any] = [spec.get("low"), spec.get("high")]
    if any(isinstance(end, bool) or not isinstance(end, int | float) for end in ends) or not ends[0] < ends[1]:
        raise GavoError(f"{place}: low and high must be numbers, low below high")
    step, log = spec.get("step"), spec.get("log", False)
    if not isinstance(log, bool) or (log and (step is not None or ends[0] <= 0)):
        raise GavoError(f"{place}: log: must be true or false; a logarithmic range starts above 0 and has no step")
    if step is not None and (isinstance(step, bool) or not isinstance(step, int | float)):
        raise GavoError(f"{place}: step: must be a number, not {shown(step)}")
    if step is not None and not 0 < step <= ends[1] - ends[0]:
        raise GavoError(f"{place}: step: must be above 0 and at most high - low, not {shown(step)}")
    return ends


def _suggest(trial: Any, key: str, spec: Any, whole: bool) -> Any:
    if isinstance(spec, list):
        with warnings.catch_warnings():  # a choice may be a list: it is found again in the study by its text
            warnings.filterwarnings("ignore", "Choices for a categorical distribution", UserWarning)
            return trial.suggest_categorical(key, spec)
    low, high, step, log = spec["low"], spec["high"], spec.get("step"), spec.get("log", False)
    if step is not None:  # the last value reached by whole steps
        high = low + step * math.floor((high - low) / step + 1e-9)
    if whole:
        return trial.suggest_int(key, low, high, step=step or 1, log=log)
    return trial.suggest_float(key, low, high, step=step, log=log)
