"""The arrangement of views that is sent with the stream."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from caraware_viewer.scene import TIMELINE

_MARGIN = 0.05
_WINDOW_S = 60.0


def blueprint(bounds_m: Sequence[float]) -> rrb.Blueprint:
    """Top view of the map (`bounds_m`: x_min, y_min, x_max, y_max) beside the plots of the last minute."""
    return rrb.Blueprint(
        rrb.Horizontal(_top_view(bounds_m), rrb.Vertical(*_plots()), column_shares=[2, 1]),
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
    return rrb.Spatial2DView(name="Top view", origin="/top", background=[16, 18, 24], visual_bounds=visible)


def _plots() -> list[rrb.TimeSeriesView]:
    window = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0),
    )
    return [
        rrb.TimeSeriesView(name="Mean error (m): policy and raw GNSS", origin="/plots/error_m", time_ranges=window),
        rrb.TimeSeriesView(name="Policy: standard deviation, reward", origin="/plots/policy"),
    ]
