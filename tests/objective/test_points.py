"""The reference's points: which are chosen, and where they are seen from elsewhere or at another moment."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from observed import CAMERA, SMALL, build, jit_error, make_reference, random_motions, random_pair, smooth_pair

from gavo_jax.image.levels import Levels
from gavo_jax.image.pyramid import NO_PIXEL, PyramidLevel
from gavo_jax.objective.losses import student_t
from gavo_jax.objective.points import central_gradient, make_references, move_reference, undo_rolling_shutter

jit_move = jax.jit(move_reference)
jit_undo = jax.jit(undo_rolling_shutter)


@pytest.mark.parametrize("cell", [2, 3])
def test_a_cell_gives_its_steepest_point_with_a_reading(cell: int) -> None:
    pair = random_pair(6)
    grey, inverse_depth = (jnp.asarray(image, jnp.float32) for image in pair[1:3])
    inverse_depth = inverse_depth.at[:6, :6].set(0.0)
    every = make_reference(PyramidLevel(grey, inverse_depth), SMALL)
    chosen = make_reference(PyramidLevel(grey, inverse_depth), SMALL, cell)
    assert chosen.grey.shape == ((18 // cell) * (24 // cell),)
    rows = np.rint(np.asarray(chosen.points.y) * SMALL.fy + SMALL.cy).astype(int)
    columns = np.rint(np.asarray(chosen.points.x) * SMALL.fx + SMALL.cx).astype(int)
    pixel = rows * SMALL.width + columns
    for own, of_all in zip(jax.tree.leaves(chosen), jax.tree.leaves(every), strict=True):
        np.testing.assert_array_equal(own, np.asarray(of_all)[pixel])
    blocks = rows // cell * (24 // cell) + columns // cell
    np.testing.assert_array_equal(blocks, np.arange(chosen.grey.size))
    steepness = np.asarray(every.grey_u**2 + every.grey_v**2).reshape(18, 24)
    seen = np.asarray(inverse_depth) > 0
    for i in range(chosen.grey.size):
        block = np.s_[rows[i] // cell * cell :, columns[i] // cell * cell :]
        inside = np.where(seen, steepness, -1)[block][:cell, :cell]
        assert np.where(seen, steepness, -1)[rows[i], columns[i]] == inside.max()


def test_several_levels_give_the_points_of_each_alone() -> None:
    levels = [PyramidLevel(*(jnp.asarray(i, jnp.float32) for i in random_pair(6)[1:3]))]
    rng = np.random.default_rng(2)
    levels += [
        PyramidLevel(*(jnp.asarray(rng.uniform(0.1, 200.0, size), jnp.float32) for _ in range(2)))
        for size in ((9, 12), (4, 6))
    ]
    points = (48, 30, 48)
    together = jax.jit(lambda levels: make_references(levels, SMALL, Levels.of(SMALL, (2, 1, 0), points)))(
        tuple(levels)
    )
    for row, level, cell in ((0, 2, 1), (1, 1, 2), (2, 0, 3)):
        alone = make_reference(levels[level], SMALL.level(level), cell)
        count = alone.grey.shape[0]
        for seen, expected in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(seen[row, :count], expected, rtol=1e-6)
        assert not np.any(together.points.q[row, count:])


def test_gradients_at_the_border_take_the_pixel_for_what_is_missing() -> None:
    grey = np.random.default_rng(3).uniform(0, 255, (6, 7)).astype(np.float32)
    wide = np.pad(grey, 1, mode="edge")
    expected = [0.5 * (wide[1:-1, 2:] - wide[1:-1, :-2]), 0.5 * (wide[2:, 1:-1] - wide[:-2, 1:-1])]
    np.testing.assert_allclose(central_gradient(jnp.pad(grey, 1, constant_values=NO_PIXEL)), expected, rtol=1e-5)


def test_moved_points_are_seen_as_from_their_own_camera() -> None:
    pair = random_pair(7)
    reference = make_reference(PyramidLevel(*(jnp.asarray(i, jnp.float32) for i in pair[1:3])), SMALL)
    anchor_T_view, target_T_anchor = random_motions(2, 0.1)
    objective = build(pair, student_t, (20.0, 0.02, 0.0))
    moved = replace(objective, reference=jit_move(reference, anchor_T_view))
    error, overlap = jit_error(moved, target_T_anchor)
    expected, expected_overlap = jit_error(objective, target_T_anchor @ anchor_T_view)
    assert float(error) == pytest.approx(float(expected), rel=1e-3)
    assert float(overlap) == pytest.approx(float(expected_overlap))


def test_points_moved_behind_the_camera_lose_their_reading() -> None:
    pair = random_pair(7)
    reference = make_reference(PyramidLevel(*(jnp.asarray(i, jnp.float32) for i in pair[1:3])), SMALL)
    back = jnp.eye(4).at[2, 3].set(-10.0)
    moved = jit_move(reference, back)
    assert not np.any(moved.points.q > 0)
    assert all(np.all(np.isfinite(leaf)) for leaf in moved.points)


def test_with_the_shutter_undone_points_are_where_they_were_in_the_middle_of_the_readout() -> None:
    pair = smooth_pair(rim=1)
    reference = make_reference(PyramidLevel(*(jnp.asarray(i, jnp.float32) for i in pair[1:3])), CAMERA)
    twist = np.array([0.02, -0.01, 0.015, 0.01, -0.02, 0.015])
    undone = jit_undo(reference, twist.astype(np.float32))
    assert not np.any(undone.row_time)
    before, after = (np.stack(points, dtype=float) for points in (reference.points, undone.points))
    for i in (70, 1000, 2900):
        row = i // CAMERA.width
        x, y, q = before[:, i]
        moment = (row + 0.5) / CAMERA.height - 0.5
        expected = oracle.expm(-moment * twist) @ [x / q, y / q, 1 / q, 1.0]
        found = np.array([*after[:2, i], 1.0]) / after[2, i]
        assert np.abs(found - expected[:3]).max() < 3e-4 < np.abs(np.array([x, y, 1.0]) / q - expected[:3]).max() / 10
