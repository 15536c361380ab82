"""Bodies: a card that moves before a rendered room is found, left out of the camera's motion, and tracked."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from gavo_jax.bodies.identity import Roll, identify, parts
from gavo_jax.datasets.base import Frame
from gavo_jax.datasets.synthetic import DEFAULT_CAMERA, SyntheticSequence
from gavo_jax.odometry.aligners import blank_of
from gavo_jax.odometry.driver import Odometry, Step, track
from gavo_jax.output.bodies import BODY_COLUMNS, body_rows
from gavo_jax.settings import OdometryOptions, Settings
from gavo_jax.solvers.gauss_newton import GaussNewton
from gavo_jax.status import AlignmentStatus

CAMERA = DEFAULT_CAMERA.level(1)
FRAMES = 5
DISTANCE, STEP = 0.7, 0.015
"""Of the card from the camera, and its way from frame to frame, to the right, metres."""
TRACKED = Settings(GaussNewton(iterations=(0, 15, 0, 0, 20)), odometry=OdometryOptions(recover=False, bodies="track"))
"""Of a program that other tests use, too."""
IGNORED = replace(TRACKED, odometry=replace(TRACKED.odometry, bodies="off"))


class Carded:
    """A still camera before a room; a textured card that covers a sixth of the image moves to the right."""

    name, camera, ground_truth = "card", CAMERA, None

    def __init__(self, moves: bool = True) -> None:
        self.scene = SyntheticSequence(frames=1, camera=CAMERA)[0]
        self.timestamps = np.arange(FRAMES) / 30
        noise = np.random.default_rng(0).normal(0, 60, (36, 48)).clip(-110, 110) + 125
        self.texture = np.kron(noise, np.ones((3, 3)))
        self.moves = moves

    def __len__(self) -> int:
        return FRAMES

    def mask(self, index: int) -> np.ndarray:
        """Pixels of the card."""
        left = 60 + CAMERA.fx * STEP / DISTANCE * index * self.moves
        mask = np.zeros((CAMERA.height, CAMERA.width), bool)
        mask[40:148, round(left) : round(left) + 144] = True
        return mask

    def __getitem__(self, index: int) -> Frame:
        left = 60 + CAMERA.fx * STEP / DISTANCE * index * self.moves
        grey, depth = self.scene.grey.astype(float), np.array(self.scene.depth)
        on = self.mask(index)
        v, u = np.nonzero(on)
        column = np.clip(u - left, 0, 142)
        low = np.floor(column).astype(int)
        part, rows = column - low, self.texture[v - 40]
        places = np.arange(len(u))
        grey[on] = (1 - part) * rows[places, low] + part * rows[places, low + 1]
        depth[on] = round(DISTANCE * CAMERA.depth_scale)
        return Frame(grey.round().astype(np.uint8), depth, timestamp=float(self.timestamps[index]))


def run(sequence: Any, settings: Settings) -> list[Step]:
    return list(track(sequence, odometry=Odometry(CAMERA, settings)))


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    return run(Carded(), TRACKED)


def way(step: Step) -> float:
    """How far the camera seems to have moved since the first frame, metres."""
    return float(np.linalg.norm(step.world_T_camera[:3, 3]))


def test_a_body_does_not_take_the_camera_along(steps: list[Step]) -> None:
    assert way(steps[-1]) < 0.01


def test_a_body_is_found_where_it_is(steps: list[Step]) -> None:
    sequence = Carded()
    for step in steps[1:]:
        (body,) = step.bodies
        true = sequence.mask(step.index)
        assert np.sum(body.mask & true) / np.sum(body.mask | true) > 0.75
        assert body.share == pytest.approx(np.mean(true), rel=0.25)
    assert len({body.number for step in steps[1:] for body in step.bodies}) == 1


def test_a_body_is_tracked(steps: list[Step]) -> None:
    for step in steps[2:]:
        (body,) = step.bodies
        assert body.displacement == pytest.approx([STEP, 0.0, 0.0], abs=0.006)
        assert np.linalg.norm(body.rotation) < np.radians(1.5)
        assert body.centroid[2] == pytest.approx(DISTANCE, abs=0.05)
        assert body.alignment is not None and body.alignment.covariance.shape == (6, 6)


def test_what_stands_still_is_part_of_the_scene() -> None:
    sequence = Carded(moves=False)
    aware, ignoring = run(sequence, TRACKED), run(sequence, IGNORED)
    assert not any(step.bodies for step in aware)
    np.testing.assert_array_equal([step.world_T_camera for step in aware], [step.world_T_camera for step in ignoring])


def test_rows_of_bodies(steps: list[Step]) -> None:
    rows = [row for step in steps for row in body_rows(step)]
    assert all(len(row) == len(BODY_COLUMNS) for row in rows)
    first, last = rows[0], rows[-1]
    assert first[-1] == "seen" and np.isnan(float(first[BODY_COLUMNS.index("dx")]))
    assert last[-1] == AlignmentStatus.OK.name.lower() and float(last[BODY_COLUMNS.index("dx")]) > 0


def test_a_state_keeps_its_shape() -> None:
    odometry = Odometry(CAMERA, TRACKED)
    odometry.register(Carded()[0], 0.0)
    shapes = [
        [(np.shape(leaf), np.asarray(leaf).dtype) for leaf in jax.tree.leaves(state)]
        for state in (blank_of(odometry.aligner), odometry.progress.tracker)
    ]
    assert shapes[0] == shapes[1]


def field(*boxes: tuple[slice, slice]) -> np.ndarray:
    image = np.full((60, 80), -1.0, np.float32)
    for box in boxes:
        image[box] = 1.0
    return image


BOX, OTHER, THIN = np.s_[10:30, 10:30], np.s_[35:55, 50:75], np.s_[0:60, 40:43]


def test_what_is_thin_is_no_body() -> None:
    nowhere = np.zeros((60, 80), bool)
    assert set(np.unique(parts(field(BOX, THIN), field(BOX, THIN), nowhere))) == {0, 1}
    assert not np.any(parts(field(THIN), field(THIN), nowhere))


def test_a_body_that_was_known_needs_less() -> None:
    nowhere, there = np.zeros((60, 80), bool), field(BOX) > 0
    little = 0.2 * field(BOX)
    assert not np.any(parts(field(BOX), little, nowhere))
    assert np.any(parts(field(BOX), little, there))


def test_bodies_keep_their_numbers() -> None:
    nowhere = np.zeros((60, 80), bool)
    both = parts(field(BOX, OTHER), field(BOX, OTHER), nowhere)
    roll = identify(both, Roll.empty((60, 80)))
    number = roll.labels[20, 20]
    moved = np.s_[12:32, 14:34]
    alone = identify(parts(field(moved), field(moved), nowhere), roll)
    assert alone.labels[20, 20] == number
    again = identify(both, alone)
    assert set(again.numbers[again.numbers > 0]) == {1, 2} and again.labels[20, 20] == number
