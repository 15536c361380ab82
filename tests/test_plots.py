"""Figures: what they show, and what they are written to."""

import numpy as np
import pytest

from gavo_jax import plots
from gavo_jax.errors import GavoError
from gavo_jax.evaluation import distance_error
from gavo_jax.trajectory import Trajectory


def straight(length: float, count: int = 30) -> Trajectory:
    """A camera that moves forward at constant speed for a second."""
    world_T_camera = np.tile(np.eye(4), (count, 1, 1))
    world_T_camera[:, 2, 3] = np.linspace(0, length, count)
    return Trajectory(np.linspace(10, 11, count), world_T_camera)


def test_distance_error_shows_every_run_in_its_own_style():
    truth = straight(1.0)
    errors = {f"run {i}": distance_error(straight(1.0 + 0.1 * i), truth) for i in range(8)}
    (axes,) = plots.plot_distance_error(errors).axes
    assert axes.get_xlabel() == "time (s)" and axes.get_ylabel() == "distance error (m)"
    lines = axes.get_lines()
    assert [line.get_label() for line in lines] == list(errors)
    assert np.allclose(np.asarray(lines[3].get_ydata())[-1], 0.3) and np.asarray(lines[3].get_xdata())[-1] == 1.0
    assert len({(line.get_linestyle(), line.get_marker()) for line in lines}) == len(lines)


@pytest.mark.parametrize("with_truth", [True, False])
def test_trajectories_are_seen_from_the_first_camera(with_truth):
    estimate, truth = straight(1.0), straight(2.0)
    moved = truth.world_T_camera.copy()
    moved[:, :3, 3] += [5.0, -3.0, 1.0]
    truth = Trajectory(truth.timestamps, moved) if with_truth else None
    above, space = plots.plot_trajectories({"ga": estimate}, truth).axes
    assert above.get_xlabel() == "x, right (m)" and above.get_ylabel() == "z, forward (m)"
    ends = {str(line.get_label()): np.asarray(line.get_ydata())[-1] for line in above.get_lines()}
    assert ends == pytest.approx({"ga": 1.0, "ground truth": 2.0} if with_truth else {"ga": 1.0})
    assert len(space.get_lines()) == len(ends)


def test_truth_that_covers_nothing_is_left_out():
    estimate = straight(1.0)
    truth = Trajectory(estimate.timestamps + 100, estimate.world_T_camera)
    above, _ = plots.plot_trajectories({"ga": estimate}, truth).axes
    assert [line.get_label() for line in above.get_lines()] == ["ga"]


def test_save(tmp_path):
    figure = plots.plot_trajectories({"ga": straight(1.0)}, None)
    paths = plots.save(figure, tmp_path, "trajectory")
    assert [path.name for path in paths] == ["trajectory.png", "trajectory.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG") and "<svg" in paths[1].read_text()
    with pytest.raises(GavoError, match="nowhere"):
        plots.save(figure, tmp_path / "nowhere", "trajectory")
