"""What a camera's own motion does to each of two frames is told from the motion between them."""

from dataclasses import replace

import numpy as np

from gavo_jax.alignment.corners import track_corners
from gavo_jax.alignment.own_motion import refine_moving, with_own_motion
from gavo_jax.alignment.result import no_alignment, on_host
from gavo_jax.camera import Camera
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.rigid_motions import exp, length_and_angle
from gavo_jax.status import AlignmentStatus, bit
from gavo_jax.trajectory import Trajectory, inverse

CAMERA = replace(Camera.preset("icl").level(1), readout=0.03)
ASIDE = exp(np.array([0.01, -0.01, 0.01, 0.005, -0.008, 0.005]))


def swinging() -> SyntheticSequence:
    """A camera that swings about, up to 2 rad/s, and whose shutter rolls."""
    level = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.2], [0.0, 0.0, 0.0, 1.0]])
    stamps = np.arange(40) / 30.0
    angles = np.stack([5 * stamps, 4 * stamps, 3 * stamps, 7 * stamps, 5 * stamps + 1, 6 * stamps], axis=-1)
    twists = np.sin(angles) * np.array([0.1, 0.05, 0.05, 0.15, 0.3, 0.2])
    return SyntheticSequence(camera=CAMERA, trajectory=Trajectory(stamps, np.stack([level @ exp(t) for t in twists])))


def images(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    return frame.grey, frame.depth


def test_a_rolling_shutter_is_told_from_the_motion() -> None:
    sequence = swinging()
    poses = sequence.ground_truth.world_T_camera
    errors = {CAMERA.readout: [], 0.0: []}
    for first, second in ((5, 15), (20, 35)):
        truth = inverse(poses[second]) @ poses[first]
        pair = images(sequence[first]), images(sequence[second])
        for readout, found in errors.items():
            result = refine_moving(*pair, replace(CAMERA, readout=readout), truth @ ASIDE)
            assert result is not None
            found.append(float(length_and_angle(inverse(truth) @ result.target_T_reference)[0]))
            if readout:
                deviation = float(np.sqrt(np.diag(result.covariance)[:3].max()))
                assert found[-1] < 2.0 * deviation
    assert max(errors[CAMERA.readout]) < 0.5 * min(errors[0.0])


def test_images_of_any_numbers_have_the_same_corners() -> None:
    """OpenCV ended the program where grey was not bytes; depth in metres was taken for a metre at least."""
    frame = images(swinging()[5])
    metres = frame[0].astype(np.float32), frame[1].astype(np.float32) / np.float32(2 * CAMERA.depth_scale)
    near = frame[0], frame[1] // 2
    found = refine_moving(near, near, CAMERA, ASIDE)
    again = refine_moving(metres, metres, replace(CAMERA, depth_scale=1.0), ASIDE)
    assert found is not None and again is not None
    np.testing.assert_allclose(again.target_T_reference, found.target_T_reference, atol=1e-4)


def test_noise_has_no_corners() -> None:
    rng = np.random.default_rng(0)
    shape = (CAMERA.height, CAMERA.width)
    walls = [np.clip(128 + rng.normal(0.0, 2.0, shape), 0, 255).astype(np.uint8) for _ in range(2)]
    depth = np.full(shape, 5000, np.uint16)
    assert refine_moving((walls[0], depth), (walls[1], depth), CAMERA, np.eye(4)) is None


def test_corners_decide_whether_a_motion_is_determined() -> None:
    frame = images(swinging()[5])
    found = refine_moving(frame, frame, CAMERA, np.eye(4))
    assert found is not None
    findings = bit(AlignmentStatus.LOW_TEXTURE) | bit(AlignmentStatus.LOW_OVERLAP)
    result = no_alignment(AlignmentStatus.LOW_TEXTURE)._replace(findings=findings)
    assert with_own_motion(result, found).status == AlignmentStatus.LOW_OVERLAP
    impossible = with_own_motion(result, found._replace(covariance=-found.covariance))
    assert AlignmentStatus.LOW_TEXTURE in on_host(impossible).statuses, "a variance that is none tells nothing"
    vague = with_own_motion(result, found._replace(covariance=100.0 * found.covariance))
    assert vague.status == AlignmentStatus.LOW_OVERLAP and vague.findings == findings


def test_a_small_image_has_corners_too() -> None:
    """Below 60 pixels of width the window was a single pixel, which ended the program within OpenCV."""
    texture = (255 * np.random.default_rng(0).uniform(0, 1, (12, 12))).astype(np.uint8).repeat(4, 0).repeat(4, 1)
    camera = Camera(45.0, 45.0, 23.5, 23.5, 48, 48, depth_scale=1000.0, readout=0.02)
    frame = texture, np.full((48, 48), 2000, np.uint16)
    assert len(track_corners(frame, texture, np.eye(4), camera).reference) > 5
