"""Self-calibration of a camera from its images: no poses, no ground truth, no pattern.

Two frames agree best if the camera's parameters are right. Each parameter shows in certain residuals:

- **Readout** of a rolling shutter: in the grey residuals, as the camera speeds up and slows down.
- **Delay** of depth: in the depth residuals. The motion follows the images, and depth follows it late or early.
- **Vignetting**: in the light of surfaces that move towards the image's rim or away from it.
- **Focal length** and **principal point**: in the grey residuals, as a turn moves the image's rim more than its middle.
- **Depth scale**: in none of them. With depth registered to colour, a world twice as large looks the same. For a first
  Kinect and similar sensors the steps between depths show it (`datasets.depth_unit`); for others nothing does.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Integer

from gavo_jax.calibration.motion import LEAST_FRAMES, stretches_of_motion
from gavo_jax.calibration.pairs import Kinematics, Matched, Stretch, Unknowns, match_pairs
from gavo_jax.calibration.scan import Minimum, Score, coarse, refine
from gavo_jax.calibration.vignetting import (
    Blocks,
    corner_darkness,
    fit_vignetting,
    lens_vignetting,
    seen_twice,
    together,
)
from gavo_jax.camera import Camera
from gavo_jax.compilation.precision import in_32_bits
from gavo_jax.datasets.base import Sequence
from gavo_jax.datasets.depth_unit import COMMON, KINECT_VIEW, sample_sequence
from gavo_jax.datasets.rectified import without_distortion
from gavo_jax.errors import GavoError
from gavo_jax.odometry.plausibility import image_shift

Wanted = Literal["readout", "depth_delay", "depth_scale", "vignetting", "focal_length", "principal_point"]
ALWAYS: tuple[Wanted, ...] = ("readout", "depth_delay", "depth_scale", "vignetting")

APART = 3
"""Distance in frames of the pairs that determine the focal length and the principal point. The effect of these grows
with the motion, and that of the shutter doesn't."""
FAR_APART = 8
"""The same for vignetting, which needs no accurate motion."""
EDGE = 2
"""Number of pairs at either end of a stretch that do not count, as the motion beyond them is unknown."""

LONGEST_READOUT, LONGEST_DELAY = 0.05, 0.05
"""Longest readout and longest delay of depth that are tried, seconds."""
READOUT_STEP, DELAY_STEP, FOCAL_STEP, CENTRE_STEP = 0.004, 0.005, 0.015, 4.0
"""Spacing of the values that parabolas are fitted to: seconds, seconds, share, pixels."""
FOCAL_RANGE, CENTRE_RANGE = 0.25, 40.0
"""Range that is tried on either side of the given camera's values, share and pixels."""
ROUNDS = 2
"""Number of passes: each parameter is estimated with the others fixed, so all are estimated again."""

TOO_UNSURE = {"readout": 0.005, "depth_delay": 0.005, "focal_length": 0.03, "principal_point": 6.0, "vignetting": 0.1}
"""Standard deviation from which a parameter counts as undetermined: seconds, seconds, share, pixels, 1."""

LEAST_SHIFT = 0.2
"""Pixels that the image has to move in the time by which a delay may be off (`TOO_UNSURE`). If it moves less, what the
delay seems to be is due to noise."""

SHARED = {"readout": 0.002, "depth_delay": 0.002, "focal_length": 0.01, "principal_point": 2.0, "vignetting": 0.03}
"""Deviation common to all pairs, which their scatter doesn't show: the error on rendered frames of a known camera.
Seconds, seconds, share, pixels, 1."""

STEPS_DEVIATION = 0.04
"""Relative standard deviation of the depth steps' factor among cameras of that make."""
SNAP = 0.08
"""Relative difference within which a common unit of files is preferred to the one that the steps give."""


class Found(NamedTuple):
    """Estimate of one parameter of a camera."""

    value: float | None
    """None if the images do not determine it."""
    deviation: float | None
    """Standard deviation; None if the value is a common unit or unknown."""
    unit: str
    why: str
    """How the value was found, or why it was not, in a few words."""


@dataclass(frozen=True)
class CameraEstimate:
    """Estimated parameters by name, and the camera with them.

    Attributes:
        found: readout, depth_delay, depth_scale (of the files), vignetting (a of (1 + a r²)⁻², beyond the known one)
            and, on request, fx, fy, cx and cy.
        camera: camera of the frames as they were given, with the parameters that were determined.
        depth_delay: seconds, in addition to the delay by the frames' own stamps; 0 if it was not determined.
        pairs: number of pairs that were used.
    """

    found: dict[str, Found]
    camera: Camera
    depth_delay: float
    pairs: int


@dataclass
class _Trial:
    """Stretches, with the current estimates of the camera and its motion."""

    stretches: list[Stretch]
    stamps: list[np.ndarray]
    camera: Camera
    unknowns: Unknowns
    kinematics: list[Kinematics]
    edge: int = EDGE
    """Number of pairs at either end of a stretch that do not count."""
    order: Integer[np.ndarray, " pairs"] | None = None
    """Order in time of the pairs that count, as `scan` draws neighbours together; None if they are in order."""

    def match(self, unknowns: Unknowns) -> list[Matched]:
        size = replace(self.camera.rectified(), fx=1.0, fy=1.0, cx=0.0, cy=0.0, readout=0.0, depth_scale=1.0)
        traced = Unknowns(*(np.float32(value) for value in unknowns))
        pairs = zip(self.stretches, self.kinematics, strict=True)
        return [match_pairs(stretch, moving, traced, camera=size) for stretch, moving in pairs]

    def settle(self) -> None:
        """Estimate the camera's motion again, with the current parameters."""
        matched = self.match(self.unknowns)
        self.kinematics = [Kinematics.of(stamps, m) for stamps, m in zip(self.stamps, matched, strict=True)]

    def image_speed(self) -> float:
        """Return how fast the camera's motion moves the image, pixels per second, root mean square."""
        twists = np.concatenate([np.asarray(moving.velocity) for moving in self.kinematics])
        length, angle = (np.linalg.norm(part, axis=1) for part in (twists[:, :3], twists[:, 3:]))
        return float(self.unknowns.fx) * float(np.sqrt(np.mean(np.square(image_shift(length, angle)))))

    def apart(self, frames: int) -> "_Trial":
        """Split each stretch, without its ends, into `frames` ones that take every `frames`-th frame."""
        trial, order = _Trial([], [], self.camera, self.unknowns, [], edge=0), []
        for stretch, stamps, kinematics in zip(self.stretches, self.stamps, self.kinematics, strict=True):
            count = (len(stamps) - 2 * EDGE) // frames
            for first in range(EDGE, EDGE + frames):
                some = first + frames * np.arange(count)
                trial.stretches.append(stretch.some(some))
                trial.stamps.append(stamps[some])
                trial.kinematics.append(kinematics.some(some, stamps))
            places = np.arange(frames * (count - 1)).reshape(frames, -1)
            order.append(places.T.ravel() + sum(map(len, order)))
        trial.order = np.concatenate(order)
        return trial

    def score(self, channel: Literal["grey", "depth"], change: Callable[[Unknowns, float], Unknowns]) -> Score:
        """Return the pairs' residuals of one channel as a function of one parameter."""

        def joined(parts: list[np.ndarray]) -> np.ndarray:
            whole = np.concatenate([part[self.edge : len(part) - self.edge] for part in parts])
            return whole if self.order is None else whole[self.order]

        def evaluate(value: float) -> tuple[np.ndarray, np.ndarray]:
            matched = self.match(change(self.unknowns, value))
            costs = joined([np.asarray(getattr(m, channel)) for m in matched])
            counted = joined([np.asarray(m.usable) > 0 for m in matched])
            return np.nan_to_num(costs), counted & np.isfinite(costs)

        return evaluate


@in_32_bits
def estimate_camera(
    sequence: Sequence,
    wanted: Iterable[Wanted] = ALWAYS,
    rounds: int = ROUNDS,
    on_progress: Callable[[str], None] = lambda _: None,
) -> CameraEstimate:
    """Estimate unknown parameters of a camera from its frames.

    Args:
        sequence: at least a dozen frames of a moving camera; a second or more of quick motion is best.
        wanted: names of the parameters to estimate.
        rounds: number of passes, each estimating every parameter with the others fixed.
        on_progress: called with the name of what is being estimated.

    Raises:
        GavoError: unknown parameter, too few readable frames, or too few pairs that can be aligned.
    """
    guessed = getattr(sequence, "times_guessed", "")
    given, sequence = sequence, without_distortion(sequence)
    wanted, camera = tuple(wanted), sequence.camera
    if unknown := set(wanted) - {"depth_scale", *_STAGES}:
        raise GavoError(f"wanted: unknown {', '.join(sorted(unknown))}: not one of depth_scale, {', '.join(_STAGES)}")
    found: dict[str, Found] = {}
    if "depth_scale" in wanted:
        found["depth_scale"] = _depth_scale(sequence)
    if found.keys() == set(wanted):
        return CameraEstimate(found, _with_found(given, found), 0.0, 0)
    on_progress("looking for stretches of motion")
    stretches = [Stretch.of(frames, camera) for frames in stretches_of_motion(sequence)]
    unknowns = Unknowns.of(camera)
    if "readout" in wanted:  # searched from a global shutter on, whatever the camera says
        unknowns = unknowns._replace(readout=0.0)
    stamps = [np.asarray(stretch.stamps, float) for stretch in stretches]
    standing = [Kinematics.unknown(len(times)) for times in stamps]
    trial = _Trial(stretches, stamps, camera, unknowns, standing)
    on_progress("finding the camera's motion")
    for _ in range(2):
        trial.settle()
    pairs = int(sum(np.asarray(m.usable)[EDGE:-EDGE].sum() for m in trial.match(trial.unknowns)))
    if pairs < LEAST_FRAMES // 2:
        raise GavoError(f"{sequence.name}: only {pairs} pairs of frames can be aligned, too few to estimate anything")
    interval = min(float(np.median(np.diff(times))) for times in stamps)
    minima: dict[str, Minimum] = {}
    for number in range(rounds):
        for name, find in _STAGES.items():
            if name in wanted:
                on_progress(f"{name.replace('_', ' ')}, round {number + 1} of {rounds}")
                minima |= find(trial, interval, number == 0)
                trial.settle()
    found |= _judged(minima, trial, interval, guessed)
    delay = found["depth_delay"].value if "depth_delay" in found else None
    return CameraEstimate(found, _with_found(given, found), delay or 0.0, pairs)


def _find_readout(trial: _Trial, interval: float, is_first: bool) -> dict[str, Minimum]:
    most = min(interval, LONGEST_READOUT)
    score = trial.score("grey", lambda unknowns, value: unknowns._replace(readout=value))
    start = coarse(score, np.linspace(0, most, 7)) if is_first else float(trial.unknowns.readout)
    least = refine(score, start, READOUT_STEP, -2 * READOUT_STEP, most + 2 * READOUT_STEP)
    least = least._replace(value=min(max(0.0, least.value), interval))
    trial.unknowns = trial.unknowns._replace(readout=least.value)
    return {"readout": least}


def _find_delay(trial: _Trial, interval: float, is_first: bool) -> dict[str, Minimum]:
    del interval
    score = trial.score("depth", lambda unknowns, value: unknowns._replace(delay=value))
    grid = np.arange(-LONGEST_DELAY, LONGEST_DELAY + 1e-9, 2 * DELAY_STEP)
    start = coarse(score, grid) if is_first else float(trial.unknowns.delay)
    reach = LONGEST_DELAY + 2 * DELAY_STEP
    least = refine(score, start, DELAY_STEP, -reach, reach)
    trial.unknowns = trial.unknowns._replace(delay=least.value)
    return {"depth_delay": least}


def _find_focal(trial: _Trial, interval: float, is_first: bool) -> dict[str, Minimum]:
    """Scale both focal lengths by one factor: their ratio is that of the pixels, which is known better beforehand."""
    del interval
    said, ratio = trial.camera.fx, trial.camera.fy / trial.camera.fx

    def change(unknowns: Unknowns, value: float) -> Unknowns:
        return unknowns._replace(fx=said * value, fy=said * value * ratio)

    score = trial.apart(APART).score("grey", change)
    grid = np.arange(1 - FOCAL_RANGE, 1 + FOCAL_RANGE + 1e-9, 0.05)
    start = coarse(score, grid) if is_first else float(trial.unknowns.fx) / said
    least = refine(score, start, FOCAL_STEP, 1 - FOCAL_RANGE, 1 + FOCAL_RANGE)
    trial.unknowns = change(trial.unknowns, least.value)
    return {
        "fx": Minimum(least.value * said, least.deviation * said),
        "fy": Minimum(least.value * said * ratio, least.deviation * said * ratio),
    }


def _find_centre(trial: _Trial, interval: float, is_first: bool) -> dict[str, Minimum]:
    del interval, is_first
    minima, apart = {}, trial.apart(APART)
    for name in ("cx", "cy"):
        said, now = getattr(trial.camera, name), float(getattr(trial.unknowns, name))

        def change(unknowns: Unknowns, value: float, name: str = name) -> Unknowns:
            return unknowns._replace(**{name: value})

        least = refine(apart.score("grey", change), now, CENTRE_STEP, said - CENTRE_RANGE, said + CENTRE_RANGE)
        trial.unknowns = apart.unknowns = change(trial.unknowns, least.value)
        minima[name] = least
    return minima


def _find_vignetting(trial: _Trial, interval: float, is_first: bool) -> dict[str, Minimum]:
    """Fit it to matched surfaces, not by a search: their light shows it far better than the residuals' scale."""
    del interval, is_first
    apart, pairs = trial.apart(FAR_APART), []
    camera = trial.unknowns.on(trial.camera.rectified()).level(1)
    for stretch, kinematics in zip(apart.stretches, apart.kinematics, strict=True):
        frames = [Blocks.of(*images, camera) for images in zip(stretch.grey, stretch.inverse_depth, strict=True)]
        motions = np.asarray(kinematics.guesses, np.float64)[:-1]
        pairs += [seen_twice(*both, motion) for both, motion in zip(pairwise(frames), motions, strict=True)]
    found = fit_vignetting([pair for pair in pairs if pair is not None])
    if np.isfinite(found.deviation):
        trial.unknowns = trial.unknowns._replace(vignetting=found.value)
    return {"vignetting": found}


_STAGES: dict[str, Callable[[_Trial, float, bool], dict[str, Minimum]]] = {
    "readout": _find_readout,
    "depth_delay": _find_delay,
    "vignetting": _find_vignetting,
    "focal_length": _find_focal,
    "principal_point": _find_centre,
}
"""Stages in their order: parameters with the largest effect come first."""

_KINDS: dict[str, tuple[str, str, str]] = {
    "readout": ("readout", "s", "grey residuals"),
    "depth_delay": ("depth_delay", "s", "depth residuals"),
    "vignetting": ("vignetting", "", "light of surfaces"),
    "fx": ("focal_length", "pixels", "grey residuals"),
    "fy": ("focal_length", "pixels", "grey residuals, with fx"),
    "cx": ("principal_point", "pixels", "grey residuals"),
    "cy": ("principal_point", "pixels", "grey residuals"),
}


def _judged(minima: dict[str, Minimum], trial: _Trial, interval: float, guessed: str) -> dict[str, Found]:
    """Return each parameter with its deviation, or why it is not determined.

    Args:
        minima: Minima by name.
        trial: Trial that they were found with.
        interval: Time between two frames, seconds: no readout is longer.
        guessed: Origin of the stamps if they are a guess; else empty.
    """
    found = {}
    speed = trial.image_speed()
    for name, least in minima.items():
        kind, unit, how = _KINDS[name]
        if unit == "s" and speed * TOO_UNSURE[kind] < LEAST_SHIFT:
            least = least._replace(deviation=np.inf)
        if name == "readout" and least.value >= interval:
            how += "; this is the longest possible, the time between two frames"
        if unit == "s" and guessed:
            how += f"; only as accurate as the stamps, which are a guess ({guessed})"
        scale = getattr(trial.camera, name) if kind == "focal_length" else 1.0
        deviation = float(np.hypot(least.deviation, SHARED[kind] * scale))
        if name == "vignetting" and abs(least.value) < 2 * deviation:
            least, how = least._replace(value=0.0), f"{how}; no more than chance"
        elif name == "vignetting":
            dark = corner_darkness(least.value, trial.camera)
            how += f"; the image's corners are {100 * dark:.0f} % darker than its middle (1 would be an ideal lens)"
        if least.deviation < TOO_UNSURE[kind] * scale:
            found[name] = Found(least.value, deviation, unit, how)
        else:
            found[name] = Found(None, None, unit, "the motion in these frames does not determine it")
    return found


def _depth_scale(sequence: Sequence) -> Found:
    """Find the unit of depth by the steps between depths, if the sensor is like a first Kinect."""
    sample, _ = sample_sequence(sequence)
    camera, unit = sequence.camera, "units per metre"
    looks_so = KINECT_VIEW[0] < camera.fx / max(camera.width, camera.height) < KINECT_VIEW[1]
    if sample is None or sample.kinect_scale is None or not looks_so:
        why = "images alone cannot tell: a larger world looks the same, and depth lacks the steps of a known sensor"
        return Found(None, None, unit, why)
    scale = sample.kinect_scale
    common = min(COMMON, key=lambda other: abs(np.log(scale / other)))
    if abs(scale / common - 1) < SNAP:
        why = f"the common unit nearest to {scale:.0f}, which the steps of depth indicate, like those of a first Kinect"
        return Found(common, None, unit, why)
    return Found(scale, STEPS_DEVIATION * scale, unit, "steps of depth, like those of a first Kinect")


def _with_found(sequence: Sequence, found: dict[str, Found]) -> Camera:
    """Return the frames' camera with what was found; the depth scale is converted from the files' units to theirs."""
    camera, unit = sequence.camera, getattr(sequence, "depth_unit", None)
    names = ("readout", "depth_scale", "vignetting", "fx", "fy", "cx", "cy")
    values = {name: found[name].value for name in names if name in found}
    known: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    if "vignetting" in known:
        known["vignetting"] = together(camera.vignetting, lens_vignetting(known["vignetting"]))
    if "depth_scale" in known and unit is not None:
        known["depth_scale"] *= unit.frame / unit.file
    return replace(camera, **known)
