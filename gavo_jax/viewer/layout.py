"""Layout of the viewer's window."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gavo_jax.viewer.colors import DARK

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint


IMAGES = {
    "reference": "Reference",
    "target": "Target",
    "warped": "Target, warped",
    "residual": "Residual: blue is below",
}
"""Titles of the views of the entities below `images`."""


GATHERED = ("estimate", "truth", "map", "bodies")
"""Entities below `world` to which each frame adds a piece."""


def make_blueprint() -> Blueprint:
    """Return the layout: search space, trajectories, state and curves above, the four images below.

    The timeline `frame` shows the particles of all of a frame's generations at once, `generation` those of one.
    """
    import rerun.blueprint as layout

    everything = [
        layout.VisibleTimeRange(
            timeline, start=layout.TimeRangeBoundary.infinite(), end=layout.TimeRangeBoundary.cursor_relative()
        )
        for timeline in ("frame", "generation")
    ]
    now = [
        layout.VisibleTimeRange(
            timeline,
            start=layout.TimeRangeBoundary.cursor_relative(seq=0),
            end=layout.TimeRangeBoundary.cursor_relative(seq=0),
        )
        for timeline in ("frame", "generation")
    ]
    search = layout.Spatial3DView(
        origin="search",
        name="Search space (mm)",
        background=DARK,
        eye_controls=layout.EyeControls3D(position=(30, -30, -50), look_target=(0, 0, 0), eye_up=(0, -1, 0)),
        overrides={"search/particles": layout.VisibleTimeRanges(now)},
    )
    world = layout.Spatial3DView(
        origin="world",
        name="Trajectory (m): estimate blue, truth white",
        background=DARK,
        overrides={f"world/{name}": layout.VisibleTimeRanges(everything) for name in GATHERED},
    )
    curves = layout.Vertical(
        layout.TextDocumentView(origin="state", name="State"),
        layout.TimeSeriesView(origin="curves/rmse", name="RMSE (grey levels)"),
        layout.TimeSeriesView(origin="curves/distance_error", name="Distance error (m)"),
        row_shares=[4, 3, 3],
    )
    images = [layout.Spatial2DView(origin=f"images/{name}", name=title) for name, title in IMAGES.items()]
    return layout.Blueprint(
        layout.Vertical(
            layout.Horizontal(search, world, curves, column_shares=[8, 8, 6]),
            layout.Horizontal(*images),
            row_shares=[5, 2],
        ),
        layout.TimePanel(timeline="frame", state="collapsed"),
        collapse_panels=True,
    )
