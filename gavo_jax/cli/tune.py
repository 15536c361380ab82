"""`gavo tune`: searches the Pareto front of settings with small drift and short run time."""

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from gavo_jax import presets
from gavo_jax.cli.options import Tune
from gavo_jax.cli.readiness import be_ready
from gavo_jax.errors import GavoError
from gavo_jax.experiments.tuning import Choice, Tuning, read_tuning, without_password
from gavo_jax.experiments.tuning import tune as search
from gavo_jax.locks import hold
from gavo_jax.output.files import prepare_folder, remove_files, write_json
from gavo_jax.output.screen import DASH, number, print_table, say
from gavo_jax.settings_file import override, save_settings

STUDY, FRONT = "study.db", "front.json"
TRIAL = re.compile(r"trial-\d+\.toml")
"""Name of the file with the settings of a trial on the front."""


def tune(options: Tune) -> int:
    """Bring the study up to its number of trials; print the front and write front.json."""
    tuning = read_tuning(options.file, options.output)
    trials = tuning.trials if options.trials is None else options.trials
    if trials < 1:
        raise GavoError(f"--trials: must be at least 1, not {trials}")
    if TRIAL.fullmatch(options.file.name) and options.file.resolve().parent == tuning.folder.resolve():
        raise GavoError(f"{options.file}: tuning writes files of this name to {tuning.folder}; choose another --output")
    folder = prepare_folder(tuning.folder)
    with hold(folder):
        return _search(tuning, options, trials, folder)


def _search(tuning: Tuning, options: Tune, trials: int, folder: Path) -> int:
    storage = options.storage or f"sqlite:///{(folder / STUDY).resolve()}"
    be_ready()
    for line in tuning.skipped:
        say(line)
    say(f"study {tuning.name}: {trials} trials of {tuning.method}, {tuning.preset}, in {without_password(storage)}")

    def show(trial: int, drift: float, milliseconds: float) -> None:
        drifts = f"{number(drift, 5)} m/s" if np.isfinite(drift) else "lost the camera"
        say(f"trial {trial}: {drifts}, {number(milliseconds, 1)} ms/pair")

    try:
        front = search(tuning, storage, trials, show)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(": the same command resumes from there") from None
    names = list(tuning.space)
    rows = [_row(choice, names) for choice in front]
    print_table("Pareto front of drift and time", ("trial", "m/s", "ms/pair", *names), rows)
    remove_files(folder, *(path.name for path in folder.iterdir() if TRIAL.fullmatch(path.name)))
    write_json(folder / FRONT, [choice._asdict() for choice in front])
    for choice in front:
        values = override(presets.preset(tuning.method, tuning.preset), choice.settings)
        save_settings(folder / f"trial-{choice.trial}.toml", values, tuning.method, tuning.preset)
    say(f"front in {folder / FRONT}; to use its settings:")
    say(f"gavo run --settings {shlex.quote(str(folder / f'trial-{front[0].trial}.toml'))}")
    return 0


def _row(choice: Choice, names: list[str]) -> list[Any]:
    settings = [choice.settings.get(name, DASH) for name in names]
    return [choice.trial, number(choice.drift, 5), number(choice.milliseconds, 1), *map(_short, settings)]


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
