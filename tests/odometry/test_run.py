"""A run over a sequence: what it is given is checked, the seed decides its bits, a real clip is followed."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import small
from driving import Altered, errors, known, run
from small import Rendered

from gavo_jax.datasets.base import Frame, FrameError
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.errors import GavoError
from gavo_jax.odometry.driver import Odometry, Step
from gavo_jax.odometry.run import OdometryRun, run_odometry
from gavo_jax.odometry.stream import track
from gavo_jax.presets import preset
from gavo_jax.status import AlignmentStatus


def test_what_is_no_sequence_is_refused_by_name():
    frames = list(SyntheticSequence(frames=2, camera=small.CAMERA))
    for wrong in (frames, "fr1_xyz", iter(frames), {}, None, np.zeros(3), SyntheticSequence):
        for call in (run_odometry, lambda wrong: list(track(wrong, small.NEWTON))):
            with pytest.raises(GavoError, match="expected a Sequence, got [a-zA-Z_]+: "):
                call(wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(GavoError, match="expected a Camera"):
        Odometry("fr1")  # pyright: ignore[reportArgumentType]
    odometry = Odometry(small.CAMERA, small.NEWTON)
    dark = frames[0].grey / np.float32(255.0)
    with pytest.raises(GavoError, match="multiply by 255"):
        odometry.register(replace(frames[0], grey=dark), 0.0)
    odometry.register(frames[0], 0.0)
    step = odometry.register(replace(frames[1], grey=dark), 1 / 30)  # a covered lens is no reason to end a run
    assert step is not None and step.alignment.status is not AlignmentStatus.OK


class Own:
    """A sequence of somebody's own."""

    name, camera, timestamps, ground_truth = "own", small.CAMERA, np.arange(3.0), None

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: int) -> Any:
        raise FrameError(f"frame {index}: not there")

    def check(self) -> None: ...


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"check": None, "name": None}, "Own is not a Sequence: it has no name, check"),
        ({"timestamps": np.arange(2.0)}, r"Own: timestamps: .*3 frames"),
        ({"timestamps": np.arange(3).astype("datetime64[s]")}, r"Own: timestamps: expected seconds, got datetime64"),
        ({"timestamps": ["a", "b", "c"]}, "Own: timestamps: expected seconds"),
        ({"camera": "fr1"}, "expected a Camera"),
        ({"ground_truth": "groundtruth.txt"}, "Own: ground_truth: expected a Trajectory or None"),
        ({}, "frame 0: not there"),
    ],
)
def test_what_a_sequence_of_ones_own_lacks_is_named(change, words, monkeypatch):
    """They ended in tracebacks, somewhere on the way."""
    for name, value in change.items():
        monkeypatch.delattr(Own, name) if value is None else monkeypatch.setattr(Own, name, value)
    with pytest.raises(GavoError, match=words):
        run_odometry(Own(), small.NEWTON)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("wrong", [None, "rgb/1.png", (np.zeros((120, 160), np.uint8),) * 2])
def test_a_sequence_of_what_is_no_frame_is_told(wrong: Any) -> None:
    """It ended in an AttributeError in a thread."""
    altered = Altered(Rendered(3, camera=small.CAMERA), lambda index, frame: wrong if index == 1 else frame)
    with pytest.raises(GavoError, match="expected a Frame, got (NoneType|str|tuple)"):
        run_odometry(altered, small.NEWTON)


def test_who_is_shown_a_step_may_change_its_pose() -> None:
    """In millimetres, say: the trajectory was in millimetres, too, but for its first pose."""

    def in_millimetres(step: Step) -> None:
        step.world_T_camera[:3, 3] *= 1000.0

    part = Rendered(3, camera=small.CAMERA)
    shown = run_odometry(part, small.NEWTON, on_step=in_millimetres).trajectory
    np.testing.assert_array_equal(shown.world_T_camera, run_odometry(part, small.NEWTON).trajectory.world_T_camera)


def test_a_run_over_the_room_goes_to_another_process() -> None:
    """Of its sequence's kept frames pickle knew nothing."""
    done = run_odometry(SyntheticSequence(3, camera=small.CAMERA)[1:], small.NEWTON, seed=np.uint8(1))  # pyright: ignore
    same = pickle.loads(pickle.dumps(done))
    np.testing.assert_array_equal(same.trajectory.world_T_camera, done.trajectory.world_T_camera)
    assert done.sequence is not None
    np.testing.assert_array_equal(same.sequence[1].grey, done.sequence[1].grey)


def test_follows_the_camera(sequence: SyntheticSequence, plain_run: OdometryRun) -> None:
    trajectory = plain_run.trajectory
    np.testing.assert_array_equal(trajectory.timestamps, sequence.timestamps)
    np.testing.assert_array_equal(trajectory.world_T_camera[0], np.eye(4))
    truth = sequence.ground_truth.world_T_camera[:, :3, 3]
    travelled = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert errors(plain_run, sequence)[-1] < 0.1 * travelled
    assert not any(step.lost for step in plain_run.steps)


def test_same_seed_same_bits() -> None:
    part = Rendered(frames=4)
    poses = [run_odometry(part, seed=seed).trajectory.world_T_camera for seed in (0, 0, 1)]
    np.testing.assert_array_equal(poses[0], poses[1])
    assert np.any(poses[0] != poses[2])
    np.testing.assert_allclose(poses[0], poses[2], atol=0.01)


def test_an_odometry_needs_two_frames(sequence: SyntheticSequence) -> None:
    for count in (0, 1):
        with pytest.raises(GavoError, match="two frames"):
            run(sequence[:count])


def test_a_sequence_is_checked_before_the_run(sequence: SyntheticSequence) -> None:
    class Refused(Altered):
        def check(self) -> None:
            raise GavoError("rgb.txt: nonsense")

    refused = Refused(sequence, lambda _, frame: frame)
    with pytest.raises(GavoError, match="nonsense"):
        run(refused)
    assert refused.read == []


def test_interpolated_depth(data_dir: Path) -> None:
    """Undistorted or resized as one would do it with grey: at edges and holes it is of no surface."""

    def interpolated(_: int, frame: Frame) -> Frame:
        depth = np.asarray(frame.depth, np.float32)
        moved = cv2.warpAffine(depth, np.array([[1, 0, 0.4], [0, 1, 0.4]]), depth.shape[::-1])
        return replace(frame, depth=moved.astype(np.uint16))

    clip, settings = TumSequence(data_dir / "fr1_desk"), preset("gauss-newton", "fast")
    results = [run_odometry(sequence, settings) for sequence in (clip, Altered(clip, interpolated))]
    plain, altered = (known(result.metrics["rpe_translation_rmse_m_per_s"]) for result in results)
    assert altered < 1.2 * plain, "it was nine times as much"


def test_real_frames(data_dir: Path) -> None:
    result = run_odometry(TumSequence(data_dir / "fr1_xyz")[:40])
    assert result.metrics["lost_pairs"] == 0
    assert known(result.metrics["rpe_translation_rmse_m_per_s"]) < 0.03
    assert known(result.metrics["rpe_rotation_rmse_deg_per_s"]) < 2.0
    assert known(result.metrics["ate_translation_rmse_m"]) < 0.02
