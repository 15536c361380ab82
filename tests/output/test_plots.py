"""Figures: what they show, and what they are written to."""

import cv2
import numpy as np
import pytest
from matplotlib.text import Annotation

from gavo_jax.errors import GavoError
from gavo_jax.evaluation import distance_error
from gavo_jax.output import plots
from gavo_jax.output.landscape import Landscape
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


def test_what_is_small_is_drawn_in_millimetres_and_truth_is_named_only_where_it_is():
    small, truth = straight(0.02), straight(0.03)
    figure = plots.plot_trajectories({"ga": small}, truth)
    above = figure.axes[0]
    assert above.get_ylabel() == "z, forward (mm)" and "truth" in str(figure.get_supxlabel())
    assert np.asarray(above.get_lines()[1].get_ydata())[-1] == pytest.approx(20.0)
    assert above.get_ylim()[1] < 40
    (axes,) = plots.plot_distance_error({"ga": distance_error(small, truth)}).axes
    assert axes.get_ylabel() == "distance error (mm)" and np.asarray(axes.get_lines()[0].get_ydata())[-1] > 9
    assert "truth" not in str(plots.plot_trajectories({"ga": small}, None).get_supxlabel())


def test_save(tmp_path):
    figure = plots.plot_trajectories({"ga": straight(1.0)}, None)
    paths = plots.save(figure, tmp_path, "trajectory")
    assert [path.name for path in paths] == ["trajectory.png", "trajectory.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG") and "<svg" in paths[1].read_text()
    with pytest.raises(GavoError, match="nowhere"):
        plots.save(figure, tmp_path / "nowhere", "trajectory")


def test_a_saved_figure_is_filled_to_its_edges(tmp_path):
    figure = plots.plot_convergence({1: np.array([[4.0, 2.0, 1.0]]), 2: np.array([[9.0, 2.0, 1.0]])})
    picture, vector = plots.save(figure, tmp_path, "convergence")
    ink = np.argwhere(np.asarray(cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)) < 128)
    size = np.array([0.9 * 3.6, 6.0]) * 120  # inches by dots; the caption leaves room at the right
    assert np.all(ink.min(axis=0) < 0.06 * size) and np.all(ink.max(axis=0) > 0.94 * size)
    frames = [axes.get_window_extent() for axes in figure.axes]
    assert frames[0].x1 < frames[1].x0 and frames[1].x1 > 0.94 * figure.bbox.width
    assert 'width="432pt" height="259.2pt"' in vector.read_text()


def labels(axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_every_figure_carries_its_definition_and_units():
    truth = straight(1.0)
    history = np.array([[4.0, 2.0, 1.0], [9.0, 2.0, np.nan]])
    landscape = Landscape(np.linspace(-0.1, 0.1, 5), np.eye(6)[:2], {1: np.full((2, 5), 4.0)})
    drifts = {"clip": {"ga": np.array([[0.01, 1.0], [0.03, 2.0]]), "opencv-rgb": np.array([[0.02, 3.0]])}}
    figures = {
        "trajectory": plots.plot_trajectories({"ga": truth}, None),
        "distance_error": plots.plot_distance_error({"ga": distance_error(truth, truth)}),
        "convergence": plots.plot_convergence({4: history}),
        "population": plots.plot_population({4: history}),
        "landscape": plots.plot_landscape(landscape),
        "drift": plots.plot_drift(drifts, ["ga"]),
        "basin": plots.plot_basin(np.array([7.0, 14.0]), {"ga": np.array([1.0, 0.5])}, "clip"),
    }
    assert set(figures) == set(plots.CAPTIONS)
    for name, figure in figures.items():
        caption = " ".join(str(figure.get_supxlabel()).split())
        assert caption == plots.CAPTIONS[name]
        for axes in figure.axes:
            assert axes.get_xlabel(), name


def test_convergence_carries_the_last_error_on_and_counts_from_it():
    figure = plots.plot_convergence({4: np.array([[4.0, 2.0, 1.0]] * 3), 1: np.array([[3.0, np.nan, np.nan]] * 3)})
    coarse, fine = figure.axes
    assert np.asarray(coarse.get_lines()[0].get_ydata()).tolist() == pytest.approx([300.0, 100.0])
    assert np.asarray(fine.get_lines()[0].get_ydata()).tolist() == [plots.SMALLEST_EXCESS] * 2
    assert coarse.get_title() == "level 4" and fine.get_title() == "level 1"


def test_population_shows_best_median_and_spread_of_what_was_searched():
    error = np.array([[100.0, 16.0, np.inf], [9.0, 4.0, 1.0], [np.nan] * 3])
    (axes,) = plots.plot_population({3: error}).axes
    lines = {line.get_label(): np.asarray(line.get_ydata()).tolist() for line in axes.get_lines()}
    assert lines["best"] == [4.0, 1.0] and lines["median"] == [7.0, 2.0]
    assert labels(axes) == ["middle 80 %", "median", "best"]


def test_landscape_leaves_gaps_where_a_motion_is_worthless():
    errors = {4: np.array([[np.inf, 4.0, 9.0], [1.0, 4.0, np.inf]])}
    worst, best = plots.plot_landscape(Landscape(np.array([-0.1, 0.0, 0.1]), np.eye(6)[:2], errors)).axes
    assert np.array_equal(worst.get_lines()[0].get_ydata(), [np.nan, 2.0, 3.0], equal_nan=True)
    assert np.asarray(best.get_lines()[0].get_xdata()).tolist() == [-100.0, 0.0, 100.0]


def test_drift_bars_are_medians_and_others_are_hatched():
    runs = np.array([[0.01, 1.0], [0.05, 3.0], [0.02, 2.0]])
    figure = plots.plot_drift({"clip": {"ga": runs, "opencv-rgb": runs[:1]}}, ["ga"])
    translation, rotation = figure.axes
    for axes, medians in ((translation, [0.02, 0.01]), (rotation, [2.0, 1.0])):
        assert [bar.get_patch_transform().transform((1.0, 0.0))[0] for bar in axes.patches] == medians
    assert [bool(bar.get_hatch()) for bar in translation.patches] == [False, True]


def test_basin_curves_run_from_small_to_large_motions():
    success = {"ga": np.array([0.5, 1.0]), "opencv-rgb": np.array([np.nan, 0.5])}
    (axes,) = plots.plot_basin(np.array([20.0, 7.0]), success, "clip", ["ga"]).axes
    assert np.asarray(axes.get_lines()[1].get_xdata()).tolist() == [7.0]  # the other one was not tried
    assert np.asarray(axes.get_lines()[0].get_xdata()).tolist() == [7.0, 20.0]
    assert np.asarray(axes.get_lines()[0].get_ydata()).tolist() == [1.0, 0.5]


def test_curves_that_end_together_have_names_apart_in_the_order_of_their_ends():
    ends = {"ga": 0.9, "sift-pnp": 0.0, "orb-pnp": 0.0, "opencv-rgb": 0.02}
    success = {name: np.array([1.0, end]) for name, end in ends.items()}
    (axes,) = plots.plot_basin(np.array([7.0, 20.0]), success, "clip", ["ga"]).axes
    places = {text.get_text(): text.xyann[1] for text in axes.texts if isinstance(text, Annotation)}
    assert sorted(places, key=lambda name: -places[name]) == ["ga", "opencv-rgb", "sift-pnp", "orb-pnp"]
    assert np.diff(sorted(places.values())).min() >= plots.LABEL_HEIGHT - 1e-9
    assert min(places.values()) >= -1e-9 and max(places.values()) <= 1.0
    colors = {line.get_label(): line.get_color() for line in axes.lines}
    assert {text.get_text(): text.get_color() for text in axes.texts} == colors


def test_places_move_no_further_than_the_distance_asks_for():
    assert plots._apart(np.array([0.9, 0.5, 0.5]), 0.1, (0.0, 1.0)) == pytest.approx([0.9, 0.55, 0.45])
    assert plots._apart(np.array([1.0, 1.0]), 0.1, (0.0, 1.0)) == pytest.approx([1.0, 0.9])


def test_a_small_motion_has_a_bar_of_round_length():
    small, large = (plots.plot_trajectories({"ga": straight(scale)}, None).axes[0] for scale in (0.01, 10.0))
    (bar,) = [line for line in small.lines if str(line.get_label()).startswith("_")]
    x = np.asarray(bar.get_xdata(), float)
    (text,) = [text.get_text() for text in small.texts]
    assert text == f"{x[1] - x[0]:g} mm" and not large.texts
