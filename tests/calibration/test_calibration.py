"""What is found of a small rendered camera, how a least is found, even clocks, and the camera file."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from small import CAMERA

from gavo_jax.calibration import estimate as estimate_module
from gavo_jax.calibration.estimate import Found, Wanted, estimate_camera
from gavo_jax.calibration.file import write_camera_file
from gavo_jax.calibration.pairs import Kinematics, Matched, Stretch, Unknowns, depth_moved, evened, smoothed_depth
from gavo_jax.calibration.scan import coarse, refine
from gavo_jax.calibration.vignetting import lens_vignetting
from gavo_jax.camera import vignetting_gain
from gavo_jax.camera_files.calibration import Calibration, load_calibration
from gavo_jax.cli.calibrate import calibration_of, with_total_delay
from gavo_jax.datasets.assembly import DepthImage, DepthUnit, FrameAssembler
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.depth_unit import KINECT_STEP
from gavo_jax.datasets.rendered.sensor_noise import NONE
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.se3 import exp
from gavo_jax.trajectory import Trajectory

READOUT, DELAY = 0.02, 0.01
WRONG_LENS = 1.04
"""What the camera says of its focal length, over the true one."""
LEVEL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""A camera that looks along the world's x axis, whose z points up."""


def shaken(stamps: np.ndarray) -> Trajectory:
    """A hand that shakes a camera."""
    poses = []
    for t in stamps:
        turn = [0.08 * np.sin(14 * t), 0.07 * np.sin(11 * t + 1), 0.03 * np.sin(9 * t)]
        shift = [0.04 * np.sin(12 * t + 2), 0.03 * np.sin(10 * t), 0.02 * np.sin(8 * t)]
        poses.append(LEVEL @ np.asarray(exp(jnp.array([*shift, *turn])), np.float64))
    return Trajectory(stamps, np.stack(poses))


class Shaken:
    """Frames whose depth is late by `DELAY`, of a camera whose shutter rolls."""

    name, ground_truth = "shaken", None

    def __init__(self, frames: int = 22):
        fine = np.arange(-0.1, frames / 30 + 0.2, 0.005)
        sequence = SyntheticSequence(noise=NONE, camera=replace(CAMERA, readout=READOUT), trajectory=shaken(fine))
        self.camera = replace(CAMERA, readout=0.0, fx=WRONG_LENS * CAMERA.fx, fy=WRONG_LENS * CAMERA.fy)
        self.timestamps = np.arange(frames) / 30
        at = [int(np.argmin(abs(fine - t))) for t in self.timestamps]
        self.frames = [Frame(sequence[i].grey, sequence[i + round(DELAY / 0.005)].depth, float(fine[i])) for i in at]

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.frames[index]


def test_shutter_delay_and_lens_are_found_from_the_images():
    estimate = estimate_camera(Shaken(), ("readout", "depth_delay", "focal_length"), rounds=1)  # pyright: ignore
    readout, delay, focal = (estimate.found[name] for name in ("readout", "depth_delay", "fx"))
    assert focal.value == pytest.approx(CAMERA.fx, rel=0.02), focal
    assert readout.value == pytest.approx(READOUT, abs=0.003), readout
    assert delay.value == pytest.approx(DELAY, abs=0.003), delay
    assert estimate.camera.readout == readout.value and estimate.depth_delay == delay.value


def test_a_delay_is_found_in_a_large_room() -> None:
    """The depth residuals' scale stood at the lower bound that searches keep to, whatever the delay."""
    shaken: Any = Shaken()
    shaken.camera = replace(
        shaken.camera, readout=READOUT, fx=CAMERA.fx, fy=CAMERA.fy, depth_scale=CAMERA.depth_scale / 8
    )
    delay: Any = estimate_camera(shaken, ("depth_delay",), rounds=1).found["depth_delay"]
    assert delay.value == pytest.approx(DELAY, abs=0.003), delay


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5])
def test_depth_is_smoothed_by_the_same_wherever_it_is_moved(shift: float) -> None:
    """By linear interpolation it was smoothed least at a delay of 0, and seemed to agree least there."""
    noise = np.random.default_rng(0).normal(0.0, 1e-3, (CAMERA.height, CAMERA.width))
    depth = jnp.asarray(0.5 + noise, jnp.float32)
    move = jnp.eye(4).at[:2, 3].set(shift / np.array([CAMERA.fx, CAMERA.fy]) / 0.5)
    moved = np.asarray(depth_moved(smoothed_depth(depth), CAMERA, move))[4:-4, 4:-4]
    assert moved.mean() == pytest.approx(0.5, abs=1e-4)
    assert moved.std() / 1e-3 == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("amount", [0.0, 0.8])
def test_vignetting_is_found_from_the_images(amount: float) -> None:
    shaken: Any = Shaken()
    dark = vignetting_gain(replace(CAMERA, vignetting=lens_vignetting(amount)))
    shaken.frames = [replace(frame, grey=np.round(frame.grey / dark).astype(np.uint8)) for frame in shaken.frames]
    estimate = estimate_camera(shaken, ("vignetting",), rounds=1)
    found: Any = estimate.found["vignetting"]
    assert found.value == pytest.approx(amount, abs=0.1) and found.deviation < 0.1, found
    assert estimate.camera.vignetting == lens_vignetting(found.value)
    assert "no more than chance" in found.why if amount == 0.0 else "% darker than its middle" in found.why


def test_vignetting_adds_to_what_the_camera_says() -> None:
    """Frames are rectified by what is known; a second estimate is of what is left."""
    found = {"vignetting": Found(0.2, 0.03, "", "")}
    known = replace(CAMERA, vignetting=lens_vignetting(0.5))
    sequence: Any = SimpleNamespace(calibration=Calibration(known), camera=known.rectified())
    estimate: Any = SimpleNamespace(found=found, depth_delay=0.0)
    both = calibration_of(sequence, estimate).color
    gain = vignetting_gain(known) * vignetting_gain(replace(CAMERA, vignetting=lens_vignetting(0.2)))
    np.testing.assert_allclose(vignetting_gain(both), gain, rtol=1e-5)
    found["vignetting"] = Found(None, None, "", "")
    assert calibration_of(sequence, estimate).color == known


def test_the_estimates_camera_is_of_the_frames_as_given() -> None:
    """It had lost its lens: used on the same frames, they would not have been rectified."""
    known = replace(CAMERA, distortion=(0.1, -0.05, 0.0, 0.0, 0.0), vignetting=lens_vignetting(0.5))
    sequence: Any = SimpleNamespace(camera=known)
    found = estimate_module._with_found(sequence, {"vignetting": Found(0.2, 0.03, "", "")})
    gain = vignetting_gain(known) * vignetting_gain(replace(CAMERA, vignetting=lens_vignetting(0.2)))
    assert found.distortion == known.distortion
    np.testing.assert_allclose(vignetting_gain(found), gain, rtol=1e-5)


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_a_camera_at_rest_determines_no_time(noise: float) -> None:
    """Of copies of one frame, depth came out 10 ms early, to within 2 ms."""
    standing, rng = Shaken(), np.random.default_rng(0)
    first = standing[0]
    standing.frames = [
        replace(
            first,
            timestamp=stamp,
            grey=np.clip(first.grey + rng.normal(0, noise, first.grey.shape), 0, 255).astype(np.uint8),
            depth=(first.depth * (1 + 0.0015 * noise * rng.normal(size=first.depth.shape))).astype(np.uint16),
        )
        for stamp in standing.timestamps
    ]
    found = estimate_camera(standing, ("readout", "depth_delay"), rounds=1).found  # pyright: ignore
    assert found["readout"].value is None and found["depth_delay"].value is None


def test_depth_of_another_clock_has_no_delay() -> None:
    """Stamps 1000 s off, which a run takes for those of another clock, left no pair that could be aligned."""
    shaken = Shaken(4)
    own = Stretch.of([replace(frame, depth_timestamp=None) for frame in shaken.frames], shaken.camera)
    other = Stretch.of([replace(f, depth_timestamp=f.timestamp + 1e3) for f in shaken.frames], shaken.camera)
    np.testing.assert_array_equal(own.delays, other.delays)


def test_a_readout_is_no_longer_than_the_time_between_two_frames() -> None:
    """Images that ask for 37 ms at 30 Hz: 37 ms were written, and a run then used them."""

    def score(kind: str, change: Any) -> Any:
        del kind, change
        return lambda value: (1.0 + (value - 0.037) ** 2 * np.ones(20), np.ones(20, bool))

    trial: Any = SimpleNamespace(score=score, unknowns=Unknowns.of(CAMERA), image_speed=lambda: 300.0)
    leasts = estimate_module._find_readout(trial, 1 / 30, True)
    assert leasts["readout"].value == trial.unknowns.readout == 1 / 30
    found = estimate_module._judged(leasts, trial, 1 / 30, "names are numbers")["readout"]
    assert found.why.split("; ")[1:] == [
        "this is the longest possible, the time between two frames",
        "only as accurate as the stamps, which are a guess (names are numbers)",
    ]


@pytest.mark.parametrize(
    ("wanted", "supposed"), [("readout", 0.0), ("depth_delay", READOUT), ("focal_length", READOUT)]
)
def test_a_readout_that_is_not_asked_for_is_what_the_camera_says(
    monkeypatch: pytest.MonkeyPatch, wanted: Wanted, supposed: float
) -> None:
    readouts = []

    def match(stretch: object, kinematics: Kinematics, unknowns: Unknowns, *, camera: object) -> Matched:
        readouts.append(float(unknowns.readout))
        pairs = len(kinematics.velocity) - 1
        ones = np.ones(pairs)
        return Matched(ones, ones, np.zeros((pairs, 6)), np.tile(np.eye(4), (pairs, 1, 1)), ones)  # pyright: ignore

    monkeypatch.setattr(estimate_module, "match_pairs", match)
    shape = (CAMERA.height, CAMERA.width)

    class Blank(list[Frame]):
        name, camera, timestamps = "blank", replace(CAMERA, readout=READOUT), np.arange(15) / 30

    sequence = Blank(Frame(np.zeros(shape, np.uint8), np.zeros(shape, np.uint16), i / 30) for i in range(15))
    estimate = estimate_camera(sequence, (wanted,), rounds=1)  # pyright: ignore
    first = readouts[:3] if wanted == "readout" else readouts  # what is asked for varies afterwards
    np.testing.assert_allclose(first, supposed, rtol=1e-6)
    if wanted != "readout":
        assert estimate.camera.readout == READOUT


def test_motion_between_frames_further_apart_is_that_of_the_pairs_between():
    stamps, twist = np.arange(10) / 30, np.array([0.3, 0, -0.1, 0.2, 0.1, 0])
    step = np.asarray(exp(jnp.asarray(twist / 30, jnp.float32)))
    steady = jnp.tile(jnp.asarray(twist), (10, 1))
    whole = Kinematics(steady, steady, steady, jnp.tile(jnp.asarray(step), (10, 1, 1)))
    apart = whole.some(np.array([1, 4, 7]), stamps)
    np.testing.assert_allclose(apart.guesses[:2], np.tile(step @ step @ step, (2, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(apart.between[:2], np.tile(twist, (2, 1)), atol=1e-5)
    assert apart.velocity.shape == (3, 6)


def test_depth_scale_is_not_made_up():
    estimate = estimate_camera(SyntheticSequence(3, noise=NONE, camera=CAMERA), ("depth_scale",))
    found = estimate.found["depth_scale"]
    assert found.value is None and "cannot tell" in found.why
    assert estimate.camera.depth_scale == CAMERA.depth_scale


class Floats:
    """A first Kinect's depth in files of floats."""

    name, ground_truth = "floats", None

    def __init__(self, file: float, stated: float):
        """Files of so many units per metre, stated or taken to be of others; frames have 5000."""
        self.camera, self.depth_unit = replace(CAMERA, depth_scale=5000.0), DepthUnit(stated, 5000.0)
        self.calibration = Calibration(replace(CAMERA, depth_scale=stated))
        steps = np.round(1 / np.linspace(0.8, 4.0, CAMERA.width * CAMERA.height) / KINECT_STEP)
        self.raw = (file / (steps * KINECT_STEP)).astype(np.float32).reshape(CAMERA.height, CAMERA.width)

    def __len__(self) -> int:
        return 3

    def raw_depth(self, index: int) -> np.ndarray:
        return self.raw


@pytest.mark.parametrize(("file", "stated", "of_frames"), [(1.0, 1.0, 5000.0), (5000.0, 1000.0, 25000.0)])
def test_a_depth_scale_is_of_the_file_in_the_file_and_of_the_frames_in_their_camera(
    file: float, stated: float, of_frames: float
) -> None:
    sequence: Any = Floats(file, stated)
    estimate = estimate_camera(sequence, ("depth_scale",))
    assert estimate.found["depth_scale"].value == file
    assert estimate.camera.depth_scale == of_frames
    assert calibration_of(sequence, estimate).color.depth_scale == file
    nothing: Any = SimpleNamespace(found={}, depth_delay=0.0)
    assert calibration_of(sequence, nothing).color.depth_scale == stated


def test_a_unit_that_floats_were_found_to_have_is_what_the_file_says():
    """Their camera's scale is of whole numbers, and was not what they were read by."""
    sequence: Any = Floats(1000.0, 1000.0)
    sequence.calibration = Calibration(replace(CAMERA, depth_scale=5000.0), states_depth_scale=False)
    nothing: Any = SimpleNamespace(found={}, depth_delay=0.0)
    written = calibration_of(sequence, nothing)
    assert written.color.depth_scale == 1000.0 and written.states_depth_scale


def test_a_least_comes_with_how_sure_it_is():
    rng = np.random.default_rng(1)
    middles, everywhere = 0.3 + 0.1 * rng.standard_normal(100), np.ones(100, bool)

    def score(value):
        return (value - middles) ** 2, everywhere

    assert coarse(score, np.linspace(-1, 1, 9)) == 0.25
    least = refine(score, -0.5, 0.1, -1, 1, rounds=8)
    assert least.value == pytest.approx(middles.mean(), abs=1e-6)
    assert least.deviation == pytest.approx(0.1 / 10, rel=0.3)
    flat = refine(lambda _: (rng.standard_normal(100), everywhere), 0.0, 0.1, -1, 1)
    assert flat.deviation > 0.05
    assert refine(lambda v: (np.full(100, v), everywhere), 0.0, 0.1, -1, 1).deviation == np.inf
    rounded = refine(lambda v: (np.float32(-7.6009) + np.full(100, 5e-7 * v**2), everywhere), 0.0, 0.1, -1, 1)
    assert rounded.deviation == np.inf, "the cost stood at its floor, and the delay was -0.0406 ± 0.002 s on any clip"
    assert refine(lambda v: (np.full(100, v), ~everywhere), 0.0, 0.1, -1, 1).deviation == np.inf


def test_stamps_with_jitter_are_those_of_an_even_clock():
    rng = np.random.default_rng(2)
    ticks = np.delete(np.arange(40), [7, 20, 21])
    stamps = ticks / 30 + rng.uniform(-0.004, 0.004, len(ticks))
    np.testing.assert_allclose(np.diff(evened(stamps)), np.diff(ticks) / 30, atol=5e-4)
    uneven = np.cumsum(rng.uniform(0.02, 0.2, 30))
    np.testing.assert_array_equal(evened(uneven), uneven)
    repeated = np.repeat(np.arange(10) / 10, 3)
    np.testing.assert_array_equal(evened(repeated), repeated)


def test_something_else_that_is_wanted_is_refused():
    """A name alone became its letters, and nothing was found."""
    with pytest.raises(GavoError, match="wanted: unknown a, .*: not one of depth_scale, readout"):
        estimate_camera(SyntheticSequence(3, noise=NONE, camera=CAMERA), "readout")  # pyright: ignore


def test_a_camera_file_holds_what_was_found(tmp_path):
    rig = Calibration(
        replace(CAMERA, distortion=(0.1, -0.2, 0.0, 0.001, 0.0), readout=0.03, vignetting=(0.5, 0.1)),
        *(CAMERA, np.eye(4)),
        depth_delay=-0.015,
    )
    write_camera_file(tmp_path / "camera.toml", rig, ("a remark",))
    read = load_calibration(tmp_path / "camera.toml")
    assert (read.color, read.depth_delay) == (rig.color, rig.depth_delay)
    assert read.depth is not None and read.depth.matrix.tolist() == CAMERA.matrix.tolist()
    (tmp_path / "bad.toml").write_text((tmp_path / "camera.toml").read_text().replace("-0.015", "15"))
    with pytest.raises(GavoError, match="depth_delay: must be a number from -0.1 to 0.1"):
        load_calibration(tmp_path / "bad.toml")


def test_a_delay_moves_depths_stamp_or_makes_one():
    shape = (CAMERA.height, CAMERA.width)
    assembler = FrameAssembler(Calibration(CAMERA, depth_delay=-0.015), DepthUnit(5000.0, 5000.0))
    images = (np.zeros((*shape, 3), np.uint8), DepthImage(np.zeros(shape, np.uint16), "depth"), "colour")
    assert assembler.frame(*images, 2.0).depth_timestamp == pytest.approx(1.985)
    assert assembler.frame(*images, 2.0, 2.01).depth_timestamp == pytest.approx(1.995)


@pytest.mark.parametrize(
    ("delay", "stamp", "total"),
    [
        (0.1, None, 0.1),
        (-0.1, None, -0.1),
        (0.09, 0.02, 0.1),
        (-0.1, -0.02, -0.1),
        (-0.05, 0.09, 0.04),
        (0.03, 7, 0.03),
    ],
)
def test_a_stated_delay_counts_whatever_the_stamps_say(delay, stamp, total):
    """Where both made more than a tenth of a second, or the stamps were of two clocks, depth had no delay at all."""
    shape, time = (CAMERA.height, CAMERA.width), 1305031102.175304
    assembler = FrameAssembler(Calibration(CAMERA, depth_delay=delay), DepthUnit(5000.0, 5000.0))
    images = (np.zeros((*shape, 3), np.uint8), DepthImage(np.zeros(shape, np.uint16), "depth"), "colour")
    frame = assembler.frame(*images, time, None if stamp is None else time + stamp)
    assert frame.depth_delay == pytest.approx(total, abs=1e-6)


@pytest.mark.parametrize("delay", [0.11, -0.3, float("nan")])
def test_a_delay_that_no_frame_can_have_is_refused(tmp_path, delay):
    """Beyond a tenth of a second it was read and then ignored."""
    with pytest.raises(GavoError, match=r"depth_delay: must be from -0\.1 to 0\.1 s, not"):
        Calibration(CAMERA, depth_delay=delay)
    write_camera_file(tmp_path / "camera.toml", Calibration(CAMERA, depth_delay=0.1), ())
    assert load_calibration(tmp_path / "camera.toml").depth_delay == 0.1
    (tmp_path / "camera.toml").write_text((tmp_path / "camera.toml").read_text().replace("0.1\n", f"{delay}\n"))
    with pytest.raises(GavoError, match=r"camera\.toml: depth_delay: must be a number from -0\.1 to 0\.1, not"):
        load_calibration(tmp_path / "camera.toml")


def test_what_is_not_determined_stays_as_it_was():
    class Estimate:
        found = {"readout": Found(None, None, "s", ""), "depth_scale": Found(1000.0, None, "", "")}
        camera, depth_delay = replace(CAMERA, readout=0.5, depth_scale=1000.0), 0.01

    sequence = type("Recorded", (), {"calibration": Calibration(CAMERA, depth_delay=0.02), "camera": CAMERA})
    calibration = calibration_of(sequence, Estimate)  # pyright: ignore
    assert (calibration.color.readout, calibration.color.depth_scale) == (CAMERA.readout, 1000.0)
    assert calibration.depth_delay == pytest.approx(0.03)


def test_a_delay_is_told_as_it_stands_in_the_file():
    """Of a camera whose delay was known already, the table said what was left of it."""
    found = {"depth_delay": Found(-0.0003, 0.0024, "s", "depth residuals"), "readout": Found(None, None, "s", "no")}
    told = with_total_delay(found, -0.0237)["depth_delay"]
    assert told.value == -0.0237 and told.deviation == 0.0024 and "-0.0003 s of it is new" in told.why
    assert with_total_delay(found, -0.0003) == found and with_total_delay({}, 0.1) == {}
