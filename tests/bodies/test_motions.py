"""Bodies' motions: in the world, under a rolling shutter, and where images do not tell them."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import jax
import numpy as np
import pytest
from carded import BOX, CAMERA, TRACKED, field

from gavo_jax.alignment.result import no_alignment
from gavo_jax.bodies import motions
from gavo_jax.bodies.aligner import BodyAware
from gavo_jax.bodies.identity import BodyTracks, associate
from gavo_jax.bodies.records import Seen, in_world
from gavo_jax.datasets.layouts.tum import TumSequence
from gavo_jax.datasets.rendered.synthetic import SyntheticSequence
from gavo_jax.odometry.aligners import Search
from gavo_jax.odometry.driver import Step
from gavo_jax.odometry.plausibility import UNKNOWN_SECONDS
from gavo_jax.odometry.stream import track
from gavo_jax.odometry.tracking import Clock
from gavo_jax.output.bodies import BODY_COLUMNS, body_rows
from gavo_jax.presets import preset
from gavo_jax.status import AlignmentStatus


def test_a_motion_in_the_camera_is_one_in_the_world() -> None:
    step = np.eye(4)
    step[0, 3] = 0.05
    in_camera = no_alignment(AlignmentStatus.OK)._replace(target_T_reference=step)
    turned = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    seen = Seen(4, field(BOX), 0.1, np.array([0.0, 0, 2]), in_camera)
    body = in_world(seen, turned, turned, (120, 160))
    assert body.displacement == pytest.approx([0, 0.05, 0]) and body.rotation == pytest.approx(np.zeros(3))
    assert body.centroid == pytest.approx([1, 2, 5])
    assert body.mask.shape == (120, 160) and body.mask[40, 40] and not body.mask[100, 100]
    assert "mask" not in vars(body), "the masks of a run would fill the memory"
    still = in_world(seen._replace(alignment=None), turned, turned, (120, 160))
    of_lost = in_world(seen, turned, None, (120, 160))
    assert np.isnan([of_lost.displacement, of_lost.rotation]).all(), "the camera's own part is not known"
    pose, status = np.eye(4), no_alignment(AlignmentStatus.OK)
    rows = body_rows(Step(1, 0.0, 0.1, status, pose, 1.0, False, bodies=(body, still)))
    assert all(len(row) == len(BODY_COLUMNS) for row in rows)
    assert rows[0][0] == "0.100000" and rows[0][-1] == "ok" and rows[1][-1] == "seen"
    assert float(rows[0][BODY_COLUMNS.index("dy")]) == 0.05 and np.isnan(float(rows[1][BODY_COLUMNS.index("dx")]))


def test_bodies_that_a_frame_shows_are_where_their_readings_are() -> None:
    """Catches a place in another unit, and a body that is told of a frame that does not show it."""
    shown, hidden = np.s_[20:40, 10:20], np.s_[5:15, 60:70]
    found, inverse_depth = np.zeros((60, 80), np.int32), np.zeros((60, 80))
    found[shown], found[hidden] = 1, 2
    tracks = associate(found, BodyTracks.empty((60, 80)))
    found[hidden] = 0
    inverse_depth[20:40, 10:16] = 0.25  # the others have no reading
    parts: dict[str, Any] = {
        "segmenter": SimpleNamespace(camera=CAMERA),
        "state": SimpleNamespace(scene=SimpleNamespace(tracks=tracks)),
        "belief": SimpleNamespace(moving=np.where(found > 0, 0.0, 0.5)),
        "frame": None,
        "clock": None,
    }
    after, (body,) = motions.find_motions(None, found=found, inverse_depth=inverse_depth, **parts)
    assert (body.number, body.share, body.alignment) == (1, pytest.approx(20 * 10 / 4800), None)
    np.testing.assert_array_equal(body.field > 0, found > 0)
    x, y = (12.5 - CAMERA.cx) / CAMERA.fx, (29.5 - CAMERA.cy) / CAMERA.fy
    np.testing.assert_allclose(body.centroid, [4 * x, 4 * y, 4.0])
    assert after.ages[:2].tolist() == [0, 1] and after.labels[hidden].min() == 2
    _, (unread,) = motions.find_motions(None, found=found, inverse_depth=0 * inverse_depth, **parts)
    assert np.isnan(unread.centroid).all() and unread.centroid.shape == (3,)


def test_a_bodys_motion_is_its_own_under_a_rolling_shutter() -> None:
    """Rows see a body go its own way: moved to the frame's moment along the camera's, it was off by 8 mm and 1.3°."""
    sequence = SyntheticSequence(14, camera=replace(CAMERA, readout=0.03), bodies=1)
    world_T_first, truth = sequence.ground_truth.world_T_camera[0], sequence.bodies_truth[0].world_T_part[0]
    apart, turned = [], []
    for step in track(sequence, TRACKED):
        for body in step.bodies[:1]:
            if not np.isfinite(body.displacement).all():
                continue
            moved = truth[step.index] @ np.linalg.inv(truth[step.index - 1])
            moved = np.linalg.inv(world_T_first) @ moved @ world_T_first
            before = np.linalg.inv(moved) @ np.append(body.centroid, 1.0)
            apart.append(np.linalg.norm(body.displacement - body.centroid + before[:3]))
            turned.append(np.linalg.norm(cv2.Rodrigues(moved[:3, :3].T @ cv2.Rodrigues(body.rotation)[0])[0]))
    assert len(apart) > 3
    assert np.median(apart) < 0.002 and np.median(turned) < np.radians(0.3)


CLOCK = Clock(np.float32(1 / 30), np.float32(0), np.uint32(1))
PART = np.zeros((120, 160), bool)
PART[10:30, 10:30] = True


def found_again(before: BodyTracks) -> tuple[BodyTracks, Seen]:
    """Tracks and sight of a body that was at the same place in an earlier frame."""
    search = Search(CAMERA, TRACKED, jax.random.key(0))
    aware = BodyAware(search, search)
    blank = aware.blank_state()
    assert aware.segmenter.size == PART.shape
    state = blank._replace(scene=blank.scene._replace(tracks=before))
    belief: Any = SimpleNamespace(moving=PART.astype(np.float32))
    frame: Any = None
    parts, nearness = PART.astype(np.int32), np.ones(PART.shape)
    tracks, seen = motions.find_motions(search, aware.segmenter, state, frame, CLOCK, parts, belief, nearness)
    return tracks, seen[0]


@pytest.mark.parametrize("status", [AlignmentStatus.OK, AlignmentStatus.LOW_TEXTURE])
def test_what_a_bodys_images_do_not_tell_is_not_its_last_motion(
    status: AlignmentStatus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next motion is judged by it, and its search begins there. Where it is not known the body was not at rest."""
    xi = np.full(6, 0.01, np.float32)
    found = no_alignment(status)._replace(xi=xi)
    monkeypatch.setattr(motions, "_align", lambda *_: found)
    tracks, seen = found_again(associate(PART.astype(np.int32), BodyTracks.empty(PART.shape)))
    assert seen.alignment is found
    place = list(tracks.numbers).index(seen.number)
    is_known = status is AlignmentStatus.OK
    np.testing.assert_array_equal(tracks.motions[place], xi if is_known else np.zeros(6))
    assert tracks.seconds[place] == (CLOCK.elapsed if is_known else UNKNOWN_SECONDS)


def test_a_body_that_was_hidden_in_the_last_frame_has_no_motion_since(monkeypatch: pytest.MonkeyPatch) -> None:
    """It got that of what stood before it: its own old place was searched in the last frame."""
    monkeypatch.setattr(motions, "_align", lambda *_: no_alignment(AlignmentStatus.OK))
    shown = associate(PART.astype(np.int32), BodyTracks.empty(PART.shape))
    hidden = associate(np.zeros(PART.shape, np.int32), shown)
    _, seen = found_again(hidden)
    assert seen.number == shown.numbers[0] and seen.alignment is None


def test_a_body_whose_motion_was_once_in_doubt_is_known_again() -> None:
    """It was taken to have been at rest, so that no motion of half a metre a second was possible after that."""
    bodies = [body for step in track(SyntheticSequence(14, camera=CAMERA, bodies=2), TRACKED) for body in step.bodies]
    statuses = [body.status for body in bodies]
    assert statuses.count("ok") > len(bodies) // 2
    against = [list(body.alignment.statuses) for body in bodies if body.alignment is not None]
    assert [AlignmentStatus.IMPLAUSIBLE_MOTION] not in against, "what the images tell well was not believed"


def test_depth_may_tell_by_itself_how_a_body_moves(data_dir: Path, clips: ModuleType) -> None:
    """A few steep points hid it: two of three motions of the card were `low_texture`."""
    card = clips.CardClip(TumSequence(data_dir / "fr1_rpy")[:32], 0.1, 0, clips.LOOKS[0])
    settings = preset("ga", "fast")
    settings = replace(settings, odometry=replace(settings.odometry, bodies="track"))
    statuses = [body.status for step in track(card, settings) for body in step.bodies if body.alignment is not None]
    assert len(statuses) > 10 and statuses.count("ok") > 0.75 * len(statuses), statuses
