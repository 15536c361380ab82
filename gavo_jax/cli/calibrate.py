"""`gavo calibrate`: estimates missing camera parameters from a recording's images and writes a camera file."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from gavo_jax.calibration.estimate import ALWAYS, CameraEstimate, Found, Wanted, estimate_camera
from gavo_jax.calibration.file import write_camera_file
from gavo_jax.calibration.vignetting import lens_vignetting, together
from gavo_jax.camera_files.calibration import Calibration
from gavo_jax.camera_files.words import FOCAL
from gavo_jax.cli.options import Calibrate
from gavo_jax.cli.readiness import be_ready
from gavo_jax.cli.selection import open_sequence
from gavo_jax.datasets.base import Sequence
from gavo_jax.errors import GavoError
from gavo_jax.interrupts import interruptible
from gavo_jax.output.files import json_text
from gavo_jax.output.screen import print_table, say, waiting


def calibrate(options: Calibrate) -> int:
    """Estimate the camera, print a table (or JSON), and write the camera file."""
    output = options.output or Path("camera.toml")
    if output.suffix.lower() != ".toml":
        raise GavoError(f"{output}: the name of a camera file must end in .toml")
    if not output.absolute().parent.is_dir():
        raise GavoError(f"{output}: no such folder: {output.parent}")
    if output.is_dir():
        raise GavoError(f"{output}: is a folder: choose a file for the camera")
    if options.output is None and os.path.lexists(output):
        raise GavoError(f"{output}: already exists: choose another file with --output, or pass this one to replace it")
    wanted: list[Wanted] = [*ALWAYS]
    if options.focal_length:
        wanted.append("focal_length")
    if options.principal_point:
        wanted.append("principal_point")
    sequence = open_sequence(options, force=True)
    be_ready()
    with waiting("looking at the frames …"):
        estimate = interruptible(lambda: estimate_camera(sequence, wanted))
    calibration = calibration_of(sequence, estimate)
    estimate = replace(estimate, found=with_total_delay(estimate.found, calibration.depth_delay))
    write_camera_file(output, calibration, ("found from the images alone by gavo calibrate", *_comments(estimate)))
    if options.json:
        print(json_text(_facts(estimate)))
        return 0
    rows = [(name, *_cells(found)) for name, found in estimate.found.items()]
    print_table(f"camera of {sequence.name}, from {estimate.pairs} pairs of frames", ("", "", "±", "unit"), rows)
    for name, found in estimate.found.items():
        say(f"{name}: {found.why}")
    say(f"camera file: {output}")
    return 0


def calibration_of(sequence: Sequence, estimate: CameraEstimate) -> Calibration:
    """Return the cameras as recorded, updated with the estimates; the new depth delay adds to the known one."""
    before = getattr(sequence, "calibration", None) or Calibration(sequence.camera)
    unit = getattr(sequence, "depth_unit", None)
    if unit is not None:  # cameras rarely state the unit of floating-point depth files
        before = before.with_depth_scale(unit.file)
    values: dict[str, Any] = {
        name: found.value for name, found in estimate.found.items() if name != "depth_delay" and found.value is not None
    }
    if "vignetting" in values:  # the frames were rectified by the known one
        values["vignetting"] = together(before.color.vignetting, lens_vignetting(values["vignetting"]))
    delay = before.depth_delay + estimate.depth_delay
    lens = replace(sequence.camera, **values).scaled(before.color.width // sequence.camera.width)
    values |= {name: value for name, value in zip(FOCAL, lens, strict=True) if name in values}
    return replace(before.with_color(replace(before.color, **values)), depth_delay=delay)


def with_total_delay(found: dict[str, Found], depth_delay: float) -> dict[str, Found]:
    """Return the estimates with the total depth delay; the estimate itself is relative to the delay already known."""
    beyond = found.get("depth_delay")
    if beyond is None or beyond.value is None or beyond.value == depth_delay:
        return found
    why = f"{beyond.why}; {beyond.value:+.4f} s of it is new"
    return found | {"depth_delay": beyond._replace(value=depth_delay, why=why)}


def _cells(found: Found) -> tuple[str, str, str]:
    if found.value is None:
        return "not determined", "", ""
    digits = {"s": 4, "": 2}.get(found.unit, 1)
    deviation = "" if found.deviation is None else f"{found.deviation:.{digits}f}"
    return f"{found.value:.{digits}f}", deviation, found.unit


def _comments(estimate: CameraEstimate) -> list[str]:
    return [f"{name}: {_in_words(found)} ({found.why})" for name, found in estimate.found.items()]


def _in_words(found: Found) -> str:
    value, deviation, unit = _cells(found)
    return " ".join(filter(None, (value, deviation and f"± {deviation}", unit)))


def _facts(estimate: CameraEstimate) -> dict[str, object]:
    return {"pairs": estimate.pairs, **{name: found._asdict() for name, found in estimate.found.items()}}
