"""The arrangement of the views, which is sent with the recording."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from caraware_viewer import plots
from caraware_viewer.canvas import TIMELINE

_MARGIN = 0.02
_PLOT_WINDOW_S = 60.0
_BACKGROUND = [20, 23, 29]


def blueprint(bounds_m: Sequence[float], real_time_factor: float = 0.0) -> rrb.Blueprint:
    """Top view of the map (`bounds_m`: x_min, y_min, x_max, y_max), HUD, 3-D view, and plots.

    In a run paced at `real_time_factor`, the plots show the last minute of wall time; otherwise they show everything.
    """
    return rrb.Blueprint(
        rrb.Horizontal(
            _top_view(bounds_m),
            rrb.Vertical(_hud(), _space(), row_shares=[3, 2]),
            rrb.Vertical(*_plots(real_time_factor)),
            column_shares=[5, 3, 3],
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _top_view(bounds_m: Sequence[float]) -> rrb.Spatial2DView:
    x_min, y_min, x_max, y_max = bounds_m
    x_margin, y_margin = _MARGIN * (x_max - x_min), _MARGIN * (y_max - y_min)
    visible = rrb.VisualBounds2D(
        x_range=[x_min - x_margin, x_max + x_margin],
        y_range=[-y_max - y_margin, -y_min + y_margin],
    )
    return rrb.Spatial2DView(name="Top view", origin="/top", background=_BACKGROUND, visual_bounds=visible)


def _hud() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(name="Run and vehicle", origin="/hud")


def _space() -> rrb.Spatial3DView:
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=(-18.0, -9.0, 12.0), look_target=(6.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
    )
    return rrb.Spatial3DView(
        name="Vehicle and its LIDAR", origin="/space", background=_BACKGROUND, line_grid=False, eye_controls=eye
    )


def _plots(real_time_factor: float) -> list[rrb.TimeSeriesView]:
    ranges = None
    if real_time_factor > 0:
        ranges = rrb.VisibleTimeRanges(
            timeline=TIMELINE,
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_PLOT_WINDOW_S * real_time_factor),
            end=rrb.TimeRangeBoundary.cursor_relative(seconds=0),
        )
    views = {
        "Mean error (m)": plots.ERRORS,
        "Policy: σ": plots.STD,
        "Reward": plots.REWARD,
        "Vehicle-steps per second": plots.STEPS,
        "Real-time factor": plots.REAL_TIME,
    }
    return [rrb.TimeSeriesView(name=name, origin=f"/{path}", time_ranges=ranges) for name, path in views.items()]
