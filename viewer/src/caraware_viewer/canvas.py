"""Logs entities into rerun recordings, on the timelines of the run.

What is kept and what is shown live are two recordings. The kept one has the history of every entity. In the live one
each entity of a frame replaces the one before, so that neither rerun's server nor a browser grows with the length of
the run; it has the history of figures alone.
"""

from __future__ import annotations

from collections.abc import Sequence

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
    """Recordings with the timelines `tick`, `sim_time` and `episode`: one that is kept, one that is live, or both."""

    def __init__(self, kept: rr.RecordingStream | None, tick_s: float, live: rr.RecordingStream | None = None) -> None:
        self._kept, self._live = kept, live
        self._recordings = [recording for recording in (kept, live) if recording is not None]
        self._tick_s = tick_s
        self._static: dict[str, rr.AsComponents] = {}
        self.live_bytes = 0
        """Bytes logged into the live recording."""
        self.figures: set[str] = set()
        """Paths that have at least one value or shape: the views of these are not empty."""

    def set_tick(self, tick: int, episode: int | None = None) -> None:
        """Sets the tick, and the episode, of everything that is logged from now on."""
        for recording in self._recordings:
            recording.set_time("tick", sequence=tick)
            recording.set_time(TIMELINE, duration=(tick + 1) * self._tick_s)
            if episode is not None:
                recording.set_time("episode", sequence=episode)

    def log(self, path: str, archetype: rr.AsComponents, *, static: bool = False) -> None:
        """Logs an entity of the map, which never changes (`static`), or of the current tick."""
        if static:
            self._static[path] = archetype
        if self._kept is not None:
            rr.log(path, archetype, static=static, recording=self._kept)
        self._log_live(path, archetype, static=True)

    def _log_live(self, path: str, archetype: rr.AsComponents, *, static: bool) -> None:
        if self._live is not None:
            self.live_bytes += _bytes_of(archetype)
            rr.log(path, archetype, static=static, recording=self._live)

    def repeat_static(self) -> None:
        """Logs the map into the live recording again: the server drops the oldest data, and a new browser needs it."""
        for path, archetype in self._static.items():
            self._log_live(path, archetype, static=True)

    def scalar(self, path: str, value: float | None) -> None:
        """Logs a figure, if it is finite."""
        if value is not None and np.isfinite(value):
            self.figures.add(path)
            scalar = rr.Scalars(value)
            if self._kept is not None:
                rr.log(path, scalar, recording=self._kept)
            self._log_live(path, scalar, static=False)

    def curve(self, path: str, ticks: Sequence[int], values: Sequence[float], *, live_only: bool = False) -> None:
        """Logs figures of earlier ticks."""
        if not len(ticks):
            return
        self.figures.add(path)
        times = np.asarray(ticks, np.int64)
        columns = rr.Scalars.columns(scalars=np.asarray(values, np.float64))
        indexes = [
            rr.TimeColumn("tick", sequence=times),
            rr.TimeColumn(TIMELINE, duration=(times + 1) * self._tick_s),
        ]
        for recording in [self._live] if live_only else self._recordings:
            if recording is not None:
                rr.send_columns(path, indexes=indexes, columns=columns, recording=recording)
        self.live_bytes += 24 * len(times)

    def series(self, path: str, name: str, color: Colors) -> None:
        """Sets the name and colour of a plotted figure."""
        self.log(path, rr.SeriesLines(names=name, colors=color, widths=1.6), static=True)

    def points(self, path: str, points_m: NDArray[np.floating], color: Colors, radius: float, order: float) -> None:
        """Logs points of the top view, `radius` in pixels."""
        points = rr.Points2D(on_screen(points_m), colors=color, radii=rr.Radius.ui_points(radius), draw_order=order)
        self.log(path, points)

    def filled(self, path: str, count: int) -> None:
        """Notes that an entity has `count` shapes: a view of it is empty until one has."""
        if count:
            self.figures.add(path)


def _bytes_of(archetype: rr.AsComponents) -> int:
    """Bytes of the data of an archetype."""
    return sum(batch.as_arrow_array().nbytes for batch in archetype.as_component_batches())
