"""Figures: what they show, and what they are written to."""

import itertools

import cv2
import numpy as np
import pytest
from matplotlib.text import Annotation

from gavo_jax.errors import GavoError
from gavo_jax.evaluation import distance_error
from gavo_jax.output import figure_parts, plots
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
    lines = [line for line in axes.get_lines() if line.get_label() in errors]
    assert [line.get_label() for line in lines] == list(errors)
    assert np.allclose(np.asarray(lines[3].get_ydata())[-1], 0.3) and np.asarray(lines[3].get_xdata())[-1] == 1.0
    assert len({(line.get_linestyle(), line.get_marker()) for line in lines}) == len(lines)


@pytest.mark.parametrize("with_truth", [True, False])
def test_trajectories_are_seen_from_the_first_camera(with_truth):
    estimate, truth = straight(1.0), straight(2.0)
    moved = truth.world_T_camera.copy()
    moved[:, :3, 3] += [5.0, -3.0, 1.0]
    truth = Trajectory(truth.timestamps, moved) if with_truth else None
    above, upright = plots.plot_trajectories({"ga": estimate}, truth).axes
    assert above.get_xlabel() == "x, right (m)" and above.get_ylabel() == "z, forward (m)"
    ends = {str(line.get_label()): np.asarray(line.get_ydata())[-1] for line in above.get_lines()}
    assert ends == pytest.approx({"ga": 1.0, "ground truth": 2.0} if with_truth else {"ga": 1.0})
    assert len(upright.get_lines()) == len(ends)
    assert upright.get_xlabel() == "z, forward (m)" and upright.get_ylabel() == "−y, up (m)"


def sideways(length: float) -> Trajectory:
    """A camera that moves to the right, and a little downwards."""
    trajectory = straight(0.0)
    world_T_camera = trajectory.world_T_camera.copy()
    world_T_camera[:, 0, 3], world_T_camera[:, 1, 3] = (np.linspace(0, end, 30) for end in (length, 0.1 * length))
    return Trajectory(trajectory.timestamps, world_T_camera)


def diagonal(length: float) -> Trajectory:
    """A camera that moves upwards, forward, and to the right."""
    trajectory = straight(length)
    world_T_camera = trajectory.world_T_camera.copy()
    world_T_camera[:, :2, 3] = np.linspace(0, length, 30)[:, None] * [1.0, -0.5]
    return Trajectory(trajectory.timestamps, world_T_camera)


@pytest.mark.parametrize("trajectory", [straight(0.02), straight(4.0), sideways(0.6)])
def test_panels_hold_the_path_at_one_scale_and_name_the_start(trajectory):
    figure = plots.plot_trajectories({"ga": trajectory, "pso": trajectory}, None)
    figure.draw_without_rendering()
    for axes in figure.axes:
        assert "start" in [text.get_text() for text in axes.texts]
        for line in axes.get_lines():
            data = np.asarray(line.get_data(), float)
            for values, limits in zip(data, (axes.get_xlim(), axes.get_ylim()), strict=True):
                assert limits[0] < values.min() and values.max() < limits[1]
    sizes = [
        (axes.bbox.width / np.ptp(axes.get_xlim()), axes.bbox.height / np.ptp(axes.get_ylim())) for axes in figure.axes
    ]
    assert np.allclose(sizes, sizes[0][0], rtol=1e-3)
    whole = figure.get_tightbbox().get_points() * figure.dpi
    assert np.all(whole[0] >= -1) and np.all(whole[1] <= [figure.bbox.width + 1, figure.bbox.height + 1])


def test_what_is_longer_to_the_side_is_seen_from_behind():
    _, upright = plots.plot_trajectories({"ga": sideways(1.0)}, None).axes
    assert upright.get_title() == "From behind" and upright.get_xlabel() == "x, right (m)"
    assert np.asarray(upright.get_lines()[0].get_ydata())[-1] == pytest.approx(-0.1)


def test_rivals_are_grey_and_no_two_of_ours_share_a_colour():
    runs = {name: straight(1.0) for name in ("ga", "opencv-rgb", "pso", "sift-pnp", "gauss-newton", "adam")}
    ours = ["ga", "pso", "gauss-newton", "adam"]
    figures = (
        plots.plot_trajectories(runs, None, ours),
        plots.plot_distance_error({name: distance_error(run, straight(1.1)) for name, run in runs.items()}, ours),
        plots.plot_basin(np.array([2.0, 7.0]), {name: np.array([1.0, 0.5]) for name in runs}, "clip", ours),
    )
    for figure in figures:
        colors = {line.get_label(): str(line.get_color()) for line in figure.axes[0].get_lines()}
        assert len({colors[name] for name in ours}) == 4 and all(colors[name] in figure_parts.COLORS for name in ours)
        greys = [float(colors[name]) for name in runs if name not in ours]
        assert len(set(greys)) == 2 and max(greys) <= 0.6  # still read on white
    many = plots.plot_trajectories({f"run {i}": straight(1.0 + i) for i in range(8)}, None).axes[0]
    assert len({line.get_color() for line in many.get_lines()}) == 8


def test_methods_that_coincide_are_drawn_narrower_one_upon_the_other():
    above = plots.plot_trajectories({name: straight(1.0) for name in ("ga", "pso", "adam")}, None).axes[0]
    widths = [line.get_linewidth() for line in above.get_lines()]
    assert widths == sorted(widths, reverse=True) and len(set(widths)) == 3


def test_the_frame_axis_counts_no_frame_that_is_not_there():
    truth = straight(1.0, 34)
    figure = plots.plot_distance_error({"ga": distance_error(truth, truth)})
    figure.draw_without_rendering()
    (top,) = figure.axes[0].child_axes
    ticks, (first, last) = top.get_xticks(), top.get_xlim()
    assert last == pytest.approx(33) and first == pytest.approx(0)
    to_place = top.transData.transform
    shown = [tick for tick in ticks if to_place((tick, 0))[0] <= to_place((last, 0))[0] + 0.5]
    assert max(shown) <= 33


def test_names_stand_at_the_ends_of_the_errors_curves():
    errors = {f"run {i}": distance_error(straight(1.0 + 0.1 * i), straight(1.0)) for i in range(3)}
    (axes,) = plots.plot_distance_error(errors).axes
    names = [text.get_text() for text in axes.texts if text.get_text()]
    assert names == ["run 2", "run 1", "run 0"] and axes.get_legend() is None


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


def test_the_same_figure_is_the_same_bytes(tmp_path):
    errors = {"ga": distance_error(straight(1.1), straight(1.0))}
    first, second = (
        [path.read_bytes() for path in plots.save(plots.plot_distance_error(errors), tmp_path, "errors")] for _ in "ab"
    )
    assert first == second


def test_a_saved_figure_is_filled_to_its_edges(tmp_path):
    figure = plots.plot_convergence({1: np.array([[4.0, 2.0, 1.0]]), 2: np.array([[9.0, 2.0, 1.0]])})
    picture, vector = plots.save(figure, tmp_path, "convergence")
    ink = np.argwhere(np.asarray(cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)) < 128)
    size = np.array([0.9 * 3.8, 5.0]) * 120  # inches by dots; the caption leaves room at the right
    assert np.all(ink.min(axis=0) < 0.06 * size) and np.all(ink.max(axis=0) > 0.94 * size)
    frames = [axes.get_window_extent() for axes in figure.axes]
    assert frames[0].x1 < frames[1].x0 and frames[1].x1 > 0.94 * figure.bbox.width
    assert 'width="360pt" height="273.6pt"' in vector.read_text()


def labels(figure) -> list[str]:
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


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
        assert caption.startswith(plots.CAPTIONS[name])
        for axes in figure.axes:
            assert axes.get_xlabel(), name
    landscape.errors[1][0, 0] = np.inf
    for caption, has_gaps in (
        (figures["landscape"].get_supxlabel(), False),
        (plots.plot_landscape(landscape).get_supxlabel(), True),
    ):
        assert ("Gaps:" in str(caption)) == has_gaps


def test_convergence_carries_the_last_error_on_and_counts_from_it():
    figure = plots.plot_convergence({4: np.array([[4.0, 2.0, 1.0]] * 3), 1: np.array([[3.0, np.nan, np.nan]] * 3)})
    coarse, fine = figure.axes
    assert np.asarray(coarse.get_lines()[0].get_ydata()).tolist() == pytest.approx([300.0, 100.0])
    assert np.asarray(fine.get_lines()[0].get_ydata()).tolist() == [plots.SMALLEST_EXCESS] * 2
    assert coarse.get_title() == "level 4" and fine.get_title() == "level 1"
    assert [coarse.yaxis.get_major_formatter()(value) for value in (0.001, 0.1, 100.0)] == ["≤ 0.001", "0.1", "100"]


def test_population_shows_best_median_and_spread_of_what_was_searched():
    error = np.array([[100.0, 16.0, np.inf], [9.0, 4.0, 1.0], [np.nan] * 3])
    figure = plots.plot_population({3: error})
    (axes,) = figure.axes
    lines = {line.get_label(): np.asarray(line.get_ydata()).tolist() for line in axes.get_lines()}
    assert lines["best"] == [4.0, 1.0] and lines["median"] == [7.0, 2.0]
    assert labels(figure) == ["median", "middle 80 %", "best"]


@pytest.mark.filterwarnings("error")
def test_searches_that_leave_nothing_to_draw_are_drawn_without_it():
    """A level of one iteration ended a finished run in a traceback."""
    plots.plot_convergence({4: np.array([[4.0]]), 3: np.array([[9.0, 2.0]])})
    plots.plot_population({4: np.full((2, 3), np.nan), 3: np.full((2, 3), np.inf)})


def test_names_are_no_formulas(tmp_path):
    estimates = {"run$a_$": straight(1.0), "price$1$x": straight(2.0)}
    figure = plots.plot_trajectories(estimates, None)
    plots.save(figure, tmp_path, "trajectory")
    errors = {name: distance_error(estimate, straight(1.0)) for name, estimate in estimates.items()}
    plots.save(plots.plot_distance_error(errors), tmp_path, "errors")
    assert [line.get_label() for line in figure.axes[0].get_lines()] == [r"run\$a_\$", r"price\$1\$x"]


def test_landscape_leaves_gaps_where_a_motion_is_worthless():
    errors = {4: np.array([[np.inf, 4.0, 9.0], [1.0, 4.0, np.inf]])}
    worst, best = plots.plot_landscape(Landscape(np.array([-0.1, 0.0, 0.1]), np.eye(6)[:2], errors)).axes
    curves = [{line.get_label(): line for line in axes.get_lines()} for axes in (worst, best)]
    assert np.array_equal(curves[0]["level 4"].get_ydata(), [np.nan, 2.0, 3.0], equal_nan=True)
    assert np.asarray(curves[1]["level 4"].get_xdata()).tolist() == [-100.0, 0.0, 100.0]
    assert all("motion found" in lines for lines in curves)


def test_landscape_says_what_else_the_motion_was_found_with_only_where_there_was_more():
    landscape = Landscape(np.linspace(-0.1, 0.1, 5), np.eye(6)[:2], {1: np.full((2, 5), 4.0)})
    with_keyframe = plots.plot_landscape(landscape, "frames 3 and 4", ["a keyframe"])
    assert "with a keyframe, too" in " ".join(with_keyframe.get_supxlabel().split())
    assert with_keyframe.get_suptitle() == "frames 3 and 4"
    assert "keyframe" not in plots.plot_landscape(landscape).get_supxlabel()


def test_the_directions_of_a_landscape_have_units():
    landscape = Landscape(np.linspace(-0.1, 0.1, 5), np.eye(6)[[1, 5]], {1: np.full((2, 5), 4.0)})
    worst, best = (axes.get_xlabel() for axes in plots.plot_landscape(landscape).axes)
    assert worst == "step s, with v = s (0.00, 1.00, 0.00) mm\nand w = s (0.00, 0.00, 0.00) mrad"
    assert "(0.00, 0.00, 1.00) mrad" in best


@pytest.mark.parametrize("trajectory", [straight(0.38), sideways(1.0), diagonal(0.02), diagonal(-0.5)])
def test_names_and_numbers_of_a_trajectorys_panels_have_room(trajectory):
    """No two ticks' numbers touch, and the start's name lies inside the panel and clear of the scale bar."""
    figure = plots.plot_trajectories({"ga": trajectory}, None)
    figure.draw_without_rendering()
    for axes in figure.axes:
        shown = [text for text in axes.get_xticklabels() if axes.get_xlim()[0] < text.get_position()[0]]
        boxes = [text.get_window_extent() for text in shown if text.get_position()[0] < axes.get_xlim()[1]]
        assert all(one.x1 + 8 < other.x0 for one, other in itertools.pairwise(boxes))
        (start,) = (text for text in axes.texts if text.get_text() == "start")
        name, panel = start.get_window_extent(), axes.get_window_extent()
        assert panel.x0 < name.x0 < name.x1 < panel.x1 and panel.y0 < name.y0
        others = [text.get_window_extent() for text in axes.texts if text is not start]
        bars = [line.get_window_extent() for line in axes.lines if str(line.get_label()).startswith("_")]
        assert not any(name.overlaps(other) for other in others + bars)


def test_a_drift_of_single_runs_has_neither_median_nor_whiskers():
    runs = np.array([[0.01, 1.0], [0.05, 3.0]])
    several, single = (plots.plot_drift({"clip": {"ga": some}}, ["ga"]).get_supxlabel() for some in (runs, runs[:1]))
    assert "median" in several and "median" not in single


def test_a_drift_with_lost_runs_counts_them_as_the_worst():
    """The bar was the median of the runs that were left, and a method that was always lost had none."""
    lost = [np.inf, np.inf]
    runs = {"ga": np.array([[0.01, 1.0], lost, lost]), "pso": np.array([[0.02, 2.0], [0.04, 4.0], lost])}
    translation = plots.plot_drift({"clip": runs | {"adam": np.array([lost])}}, ["ga", "pso", "adam"]).axes[0]
    assert [bar.get_patch_transform().transform((1.0, 0.0))[0] for bar in translation.patches] == [0.04]
    words = [text.get_text().strip() for text in translation.texts]
    assert words == ["no drift in 2 of 3", "0.0400, none in 1 of 3", "no drift in 1 of 1"]


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
    places = {text.get_text(): text.xyann[1] for text in axes.texts if isinstance(text, Annotation) and text.get_text()}
    assert sorted(places, key=lambda name: -places[name]) == ["ga", "opencv-rgb", "sift-pnp", "orb-pnp"]
    assert np.diff(sorted(places.values())).min() >= figure_parts.LABEL_HEIGHT - 1e-9
    assert min(places.values()) >= -1e-9 and max(places.values()) <= 1.0
    colors = {line.get_label(): line.get_color() for line in axes.lines}
    shown = {text.get_text(): text.get_color() for text in axes.texts if text.get_text()}
    assert shown == {name: color for name, color in colors.items() if name in ends}


@pytest.mark.parametrize(("ends", "pieces"), [((0.5, 0.1), 0), ((0.1, 0.1), 2)])
def test_curves_that_end_at_one_point_show_a_piece_of_themselves(ends: tuple[float, float], pieces: int) -> None:
    """Ten names shared one line to one point: which curve was whose, nobody could tell."""
    success = {name: np.array([1.0, end]) for name, end in zip(("ga", "opencv-rgb"), ends, strict=True)}
    (axes,) = plots.plot_basin(np.array([7.0, 20.0]), success, "clip", ["ga"]).axes
    curves, beside = axes.lines[:2], axes.lines[2:]
    assert len(beside) == pieces
    for curve, piece in zip(curves, beside, strict=False):
        assert (piece.get_linestyle(), piece.get_marker()) == (curve.get_linestyle(), curve.get_marker())


def test_places_move_no_further_than_the_distance_asks_for():
    assert figure_parts.apart(np.array([0.9, 0.5, 0.5]), 0.1, (0.0, 1.0)) == pytest.approx([0.9, 0.55, 0.45])
    assert figure_parts.apart(np.array([1.0, 1.0]), 0.1, (0.0, 1.0)) == pytest.approx([1.0, 0.9])


def test_a_small_motion_has_a_bar_of_round_length():
    small, large = (plots.plot_trajectories({"ga": straight(scale)}, None).axes[0] for scale in (0.01, 10.0))
    (bar,) = [line for line in small.lines if str(line.get_label()).startswith("_")]
    x = np.asarray(bar.get_xdata(), float)
    text = [text.get_text() for text in small.texts if text.get_text() != "start"]
    assert text == [f"{x[1] - x[0]:g} mm"] and [text.get_text() for text in large.texts] == ["start"]


def test_bars_of_a_panel_have_as_many_decimals_as_the_smallest_needs():
    assert plots._decimals(np.array([0.0008, 0.239]), 4) == 5 and plots._decimals(np.array([0.0125, 0.0]), 4) == 4
    assert plots._decimals(np.array([0.67, 20.4]), 2) == 2
