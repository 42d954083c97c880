"""Logs entities into a rerun recording, on the timelines of the run."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

TIMELINE = "sim_time"
"""Simulated time since the start of the run; episodes follow one another."""

Colors = NDArray[np.uint32] | list[int]


def on_screen(points_m: NDArray[np.floating]) -> NDArray[np.float32]:
    """World x, y `[…, 2]` in rerun's 2-D view, where y points down."""
    flipped: NDArray[np.float64] = np.asarray(points_m) * np.array([1.0, -1.0])
    return flipped.astype(np.float32)


class Canvas:
    """A rerun recording with the timelines `tick`, `sim_time` and `episode`."""

    def __init__(self, recording: rr.RecordingStream, tick_s: float) -> None:
        self._recording = recording
        self._tick_s = tick_s

    def set_tick(self, tick: int, episode: int | None = None) -> None:
        """Sets the tick, and the episode, of everything that is logged from now on."""
        self._recording.set_time("tick", sequence=tick)
        self._recording.set_time(TIMELINE, duration=(tick + 1) * self._tick_s)
        if episode is not None:
            self._recording.set_time("episode", sequence=episode)

    def log(self, path: str, archetype: rr.AsComponents, *, static: bool = False) -> None:
        """Logs an entity."""
        rr.log(path, archetype, static=static, recording=self._recording)

    def scalar(self, path: str, value: float | None) -> None:
        """Logs a figure, if it is finite."""
        if value is not None and np.isfinite(value):
            self.log(path, rr.Scalars(value))

    def series(self, path: str, name: str, color: Colors) -> None:
        """Sets the name and colour of a plotted figure."""
        self.log(path, rr.SeriesLines(names=name, colors=color), static=True)

    def points(self, path: str, points_m: NDArray[np.floating], color: Colors, radius: float, order: float) -> None:
        """Logs points of the top view, `radius` in pixels."""
        points = rr.Points2D(on_screen(points_m), colors=color, radii=rr.Radius.ui_points(radius), draw_order=order)
        self.log(path, points)
