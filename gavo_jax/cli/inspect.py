"""`gavo inspect`: describes a source, and which of its frames a run would use."""

from typing import Any

from gavo_jax.cli.options import Inspect
from gavo_jax.cli.selection import open_sequence
from gavo_jax.inspection import inspect_sequence, unit_of
from gavo_jax.output.files import json_text
from gavo_jax.output.screen import counted, frame_progress, say

NOTES = {
    "gap": "frames are missing before it; used in full",
    "frozen": "depth repeats that of the previous frame; only the image is used",
    "no_depth": "too few depth readings; aligned to an earlier frame; no later frame is aligned to it",
    "partial_depth": "much of the usual depth is missing; aligned to an earlier frame; no later frame is aligned to it",
    "depth_units": "depth may be in other units; used in full",
    "moving_body": "part of the image repeats the previous one; used in full",
}
"""How a run treats doubtful frames, by status."""


def inspect(options: Inspect) -> int:
    """Inspect every chosen frame and print the findings as text or JSON."""
    sequence = open_sequence(options, force=True)
    with frame_progress(sequence.name, len(sequence)) as on_frame:
        facts = inspect_sequence(sequence, on_frame)
    if options.json:
        print(json_text(facts))
    else:
        for what, words in _lines(facts):
            say(f"{what}: {words}")
    return 0


def _lines(facts: dict[str, Any]) -> list[tuple[str, str]]:
    lines = [("source", f"{facts['name']}, {facts['kind']}"), ("frames", str(facts["frames"]))]
    if facts["topics"]:
        lines.insert(1, ("topics", " and ".join(facts["topics"])))
    lines += [("left out", line) for line in facts["left_out"]]
    refused = "".join(f", {count} {status}" for status, count in facts["frames_not_used"].items())
    lines.append(("frames used", f"{facts['frames_used']} of {facts['frames']}{refused}"))
    lines += [("not used", line) for line in facts["why_not"]]
    lines += [(f"of these, {count} {status}", NOTES[status]) for status, count in facts["frames_doubted"].items()]
    lines += [("time", _time(facts)), ("camera", _camera(facts["camera"]) + f", from {facts['camera_from']}")]
    lines += _recorded(facts["recorded_camera"], facts["camera"])
    if not facts["camera"]["readout"]:
        lines.append(("shutter", "all rows are assumed to be exposed at once; gavo calibrate checks whether they are"))
    lines += [("depth", _depth(facts))]
    if fault := facts["depth"]["fault"]:
        lines.append(("depth scale", f"WRONG? {fault}"))
    if doubt := facts["depth"]["doubt"]:
        lines.append(("depth in doubt", doubt))
    if fault := facts["depth"]["lies"]:
        lines.append(("depth image", f"WRONG? {fault} relative to the colour image, judging by the edges of both"))
    if (delay := facts["delay_of_depth_ms"]) is not None:
        side = "before" if delay["median"] < 0 else "after"
        words = f"median {abs(delay['median']):.1f} ms {side} colour, from {delay['least']:.1f} to {delay['most']:.1f}"
        lines.append(("delay of depth", words))
    return [*lines, ("ground truth", _truth(facts))]


def _time(facts: dict[str, Any]) -> str:
    rate = "no rate" if facts["rate_hz"] is None else f"{facts['rate_hz']:.1f} frames/s"
    gaps = "no gap"
    if facts["gaps"]:
        several = ", the longest" if facts["gaps"] > 1 else ""
        gaps = f"{counted(facts['gaps'], 'gap')}{several} of {facts['longest_gap_s']:.2f} s"
    guess = f" ({facts['times_guessed']})" if facts["times_guessed"] else ""
    soon = f", {counted(facts['too_soon'], 'frame')} too soon after the last" if facts["too_soon"] else ""
    return f"{facts['duration_s']:.2f} s from {facts['first_timestamp']:.6f}, {rate}{guess}, {gaps}{soon}"


def _camera(camera: dict[str, Any]) -> str:
    size = f"{camera['width']}x{camera['height']}"
    intrinsics = " ".join(f"{name} {camera[name]:g}" for name in ("fx", "fy", "cx", "cy"))
    lens = f", {camera['model']} distortion {camera['distortion']}" if _is_distorted(camera) else ""
    dark = f", vignetting {camera['vignetting']}" if any(camera["vignetting"]) else ""
    shutter = f", rolling shutter of {round(1e3 * camera['readout'], 1):g} ms" if camera["readout"] else ""
    return f"{size}, {intrinsics}{lens}{dark}{shutter}"


def _is_distorted(camera: dict[str, Any]) -> bool:
    return camera["model"] == "fisheye" or any(camera["distortion"])


def _recorded(recorded: dict[str, Any] | None, camera: dict[str, Any]) -> list[tuple[str, str]]:
    """Describe the cameras before rectification, pixel averaging and registration, where they differ."""
    if recorded is None:
        return []
    color = recorded["color"]
    is_other = _is_distorted(color) or any(color["vignetting"]) or color["width"] != camera["width"]
    lines = [("colour as recorded", _camera(color))] if is_other else []
    if "depth" in recorded:
        lines.append(("depth camera", _camera(recorded["depth"]) + ", registered to colour"))
    return lines


def _depth(facts: dict[str, Any]) -> str:
    depth, unit = facts["depth"], unit_of(facts)
    if depth["median_m"] is None:
        return f"no reading; in {unit}"
    span = f"{depth['near_m']:.2f} to {depth['far_m']:.2f} m, median {depth['median_m']:.2f} m"
    return f"{span}, at {100 * depth['coverage']:.0f} % of the pixels; in {unit}"


def _truth(facts: dict[str, Any]) -> str:
    truth = facts["ground_truth"]
    if truth is None:
        return "none"
    covered = f"{truth['frames_covered']} of {facts['frames']} frames covered"
    return f"{truth['poses']} poses over {truth['duration_s']:.2f} s and {truth['path_m']:.2f} m, {covered}"
