"""The arrangement of the views, which is sent with the recording: by what a run has, so that no view is empty."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from caraware_viewer import course, legend, plots, space
from caraware_viewer.canvas import TIMELINE
from caraware_viewer.detail import Region
from caraware_viewer.static_map import SCALE_BELOW

_MARGIN = 0.02
BACKGROUND = [20, 23, 29]
MAX_PLOTS = 5
"""Most plots beside one another; the first rows of `PLOTS` come first."""
_STACKED_CAMERAS = 3
"""Most images below one another; of more, two are beside one another."""
_CAMERA_SHARE = 2.6
_LEGEND_SHARE = 0.6
"""Height of a row of the legend, where the top view has 10."""


@dataclass(frozen=True)
class Plot:
    """A plot of figures over time."""

    title: str
    path: str
    """Root of its figures; it is shown once one of them has a value."""
    modes: tuple[str, ...]
    """Modes that show it: `train`, `drive` (train with heroes), `simulate`, `play`."""


PLOTS = (
    Plot("Error over the whole run (m)", f"{course.ROOT}/m", ("train",)),
    Plot("How trips ended over the whole run (%)", course.ENDS, ("drive",)),
    Plot("Progress over the whole run (m/s)", f"{course.ROOT}/mps", ("drive",)),
    Plot("Beside the route over the whole run (m)", f"{course.ROOT}/m", ("drive",)),
    Plot("Share over the whole run (%)", f"{course.ROOT}/percent", ("train",)),
    Plot("Messages over the whole run (kbit/s)", f"{course.ROOT}/kbitps", ("train",)),
    Plot("Reward over the whole run", f"{course.ROOT}/reward", ("train", "drive")),
    Plot("σ of the policy over the whole run", f"{course.ROOT}/sigma", ("train",)),
    Plot("Speed of the followed vehicle (m/s)", plots.SPEED, ("drive", "play", "simulate")),
    Plot("Mean error of each tick (m)", plots.ERRORS, ("train", "drive", "play", "simulate")),
    Plot("Road users", plots.ROAD_USERS, ("simulate", "play")),
    Plot("Vehicle-steps per second", plots.STEPS, ("train", "drive")),
    Plot("Real-time factor", plots.REAL_TIME, ("simulate", "play", "train")),
)
"""Every plot, the most important of each mode first."""


_SHARED = (
    f"{course.ROOT}/m",
    f"{course.ROOT}/mps",
    f"{course.ROOT}/percent",
    course.ENDS,
    plots.ERRORS,
    plots.ROAD_USERS,
)
"""Plots with several curves, which need a legend; the title of the others says what they show."""


def mode_of(mode: str, *, driving: bool) -> str:
    """Name of the layout for a mode of the map, which is the same for both tasks."""
    return "drive" if driving and mode == "train" else mode


def shown_plots(mode: str, figures: Collection[str]) -> tuple[Plot, ...]:
    """The plots of a mode that have data."""
    of_mode = [plot for plot in PLOTS if mode in plot.modes]
    return tuple(plot for plot in of_mode if any(_is_under(path, plot.path) for path in figures))[:MAX_PLOTS]


def layout_of(mode: str, figures: Collection[str], cameras: Mapping[str, str] | None = None) -> tuple[object, ...]:
    """What a layout depends on: two equal ones need no second blueprint."""
    return (mode, shown_plots(mode, figures), space.VEHICLES in figures, tuple((cameras or {}).items()))


def blueprint(
    bounds_m: Sequence[float],
    mode: str = "train",
    figures: Collection[str] = (),
    region: Region | None = None,
    cameras: Mapping[str, str] | None = None,
    legend_rows: int = 2,
) -> rrb.Blueprint:
    """Top view of the map (`bounds_m`: x_min, y_min, x_max, y_max) or of a region, legend, HUD, 3-D view, images and
    plots.

    `figures` are the paths that have data; a view without any is left out. `cameras` are the titles of images by path.
    The legend has `legend_rows` rows.
    """
    plotted = [_plot(plot) for plot in shown_plots(mode, figures)]
    columns: list[rrb.Container | rrb.View] = [
        rrb.Vertical(
            _top_view(bounds_m if region is None else region),
            _legend(legend_rows),
            row_shares=[10, _LEGEND_SHARE * legend_rows],
        )
    ]
    shares: list[float] = [5]
    middle: list[rrb.View] = [_hud()]
    if space.VEHICLES in figures:
        middle.append(_space())
    columns.append(rrb.Vertical(*middle, row_shares=[5, 6][: len(middle)]))
    shares.append(3.4)
    if cameras:
        views = [_camera(path, title) for path, title in cameras.items()]
        stacked = len(views) <= _STACKED_CAMERAS
        columns.append(rrb.Vertical(*views) if stacked else rrb.Grid(*views, grid_columns=2))
        shares.append(_CAMERA_SHARE if stacked else 2 * _CAMERA_SHARE)
    if plotted:
        columns.append(rrb.Vertical(*plotted))
        shares.append(2.6)
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=shares),
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _is_under(path: str, root: str) -> bool:
    return path == root or path.startswith(root + "/")


def _top_view(bounds_m: Sequence[float]) -> rrb.Spatial2DView:
    x_min, y_min, x_max, y_max = bounds_m
    x_margin, y_margin = _MARGIN * (x_max - x_min), _MARGIN * (y_max - y_min)
    below = 2 * SCALE_BELOW * (y_max - y_min)
    visible = rrb.VisualBounds2D(
        x_range=[x_min - x_margin, x_max + x_margin],
        y_range=[-y_max - y_margin, -y_min + y_margin + below],
    )
    return rrb.Spatial2DView(name="Top view", origin="/top", background=BACKGROUND, visual_bounds=visible)


def _legend(rows: int) -> rrb.Spatial2DView:
    visible = rrb.VisualBounds2D(x_range=[0.0, legend.WIDTH], y_range=[0.0, rows * legend.ROW_HEIGHT])
    return rrb.Spatial2DView(
        name="Legend", origin="/legend", background=BACKGROUND, visual_bounds=visible, titlebar=False
    )


def _hud() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(name="Run and vehicle", origin="/hud")


def _space() -> rrb.Spatial3DView:
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=(-26.0, -7.0, 21.0), look_target=(9.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
    )
    return rrb.Spatial3DView(
        name="Around the followed vehicle",
        origin="/space",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=eye,
    )


def _camera(path: str, title: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(name=title, origin=f"/{path}", background=BACKGROUND)


def _plot(plot: Plot) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=plot.title,
        origin=f"/{plot.path}",
        background=rrb.archetypes.PlotBackground(color=BACKGROUND),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=plot.path in _SHARED),
        # Without a range, rerun shows a part around the cursor.
        axis_x=rrb.TimeAxis(
            view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
        ),
    )
