"""Watches a run: one thread draws; the main thread waits for the end of the run, the end of the display, or Ctrl-C."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
import time

import rerun as rr

from caraware_viewer import access
from caraware_viewer.detail import Region
from caraware_viewer.display import Display, has_screen
from caraware_viewer.documents import RunMap
from caraware_viewer.link import RunLink, connect, find_run
from caraware_viewer.page import Pace
from caraware_viewer.scene import Scene
from caraware_viewer.views import blueprint, layout_of, mode_of
from caraware_viewer.wire import FrameError

_POLL_INTERVAL_S = 0.1
_FLUSH_LIMIT_S = 5.0
_LONGEST_INTERVAL_S = 5.0
"""Longest time between two ticks, however slow a browser is."""
_FRAMES_OF_A_TICK = 2.0
"""Frames that a page draws while the data of a tick comes in."""


def watch_run(options: argparse.Namespace) -> int:
    """Connects to a run, opens the recording, and draws frames until the run ends; returns the exit code."""
    session = connect(options.endpoint, options.timeout, access.credentials_from(options))
    try:
        run = find_run(session, options.endpoint, options.run, options.timeout, options.env)
    except BaseException:
        session.close()
        raise
    with RunLink(session, run) as link, _open_display(options) as display:
        run_map = link.map(options.timeout)
        kept, live = _recordings(options, display, f"{run.run}/{run.env}")
        recordings = [recording for recording in (kept, live) if recording is not None]
        print(f"watching run {run.run} at {options.endpoint}", file=sys.stderr)
        if display is not None and display.page is not None:
            print(f"open {display.page.url} in a browser", file=sys.stderr)
        scene = Scene(
            kept,
            run_map,
            options.vehicle,
            options.lidar,
            live=live,
            region=options.region,
            display_pid=None if display is None else display.pid,
        )
        layout = Layout(recordings, run_map, options.region)
        layout.arrange(scene)
        pace = Pace() if display is None or display.page is None else display.page.pace
        drawing = threading.Thread(
            target=_draw_frames, args=(link, scene, layout, options.rate, pace), name="draw", daemon=True
        )
        drawing.start()
        try:
            _wait_for_end(drawing, link, display)
        finally:
            link.frames.close()
            _finish(recordings, drawing, display)
            if scene.summary():
                print(scene.summary(), file=sys.stderr)
    print(f"run {run.run} has ended" if link.frames.ended else "the display was closed", file=sys.stderr)
    return 0


def _wait_for_end(drawing: threading.Thread, link: RunLink, display: Display | None) -> None:
    """Waits until the run has ended and is drawn, or the display was closed."""
    while drawing.is_alive() and not (display is not None and display.closed):
        drawing.join(_POLL_INTERVAL_S)


def _finish(recordings: list[rr.RecordingStream], drawing: threading.Thread, display: Display | None) -> None:
    """Writes the rest of the recordings. Abandons a display that accepts no data, for which rerun waits without end."""

    def write() -> None:
        drawing.join()
        for recording in recordings:
            recording.disconnect()

    writing = threading.Thread(target=write, name="write", daemon=True)
    writing.start()
    writing.join(_FLUSH_LIMIT_S)
    if not writing.is_alive():
        return
    print("caraware-viewer: the display no longer accepts data: the rest is not shown", file=sys.stderr)
    if display is None:
        sys.stderr.flush()
        os._exit(1)
    # The writing thread continues once the display has ended.
    display.close()
    writing.join(_FLUSH_LIMIT_S)


class Layout:
    """Arranges the views of all recordings by what the run has so far."""

    def __init__(self, recordings: list[rr.RecordingStream], run_map: RunMap, region: Region | None) -> None:
        self._recordings, self._map, self._region = recordings, run_map, region
        self._shown: object = None

    def arrange(self, scene: Scene) -> None:
        """Sends a new arrangement if another view has data, or one has lost its place."""
        mode = mode_of(str(self._map.get("mode", "train")), driving=scene.driving)
        shown = layout_of(mode, scene.figures)
        if shown == self._shown:
            return
        self._shown = shown
        views = blueprint(self._map["map"]["bounds_m"], mode, scene.figures, self._region)
        for recording in self._recordings:
            recording.send_blueprint(views, make_active=True, make_default=True)


def frame_interval_s(rate_hz: float, frame_s: float) -> float:
    """Time between two ticks that are sent to a page that takes `frame_s` to draw, at most `rate_hz`."""
    return max(1 / rate_hz, min(_FRAMES_OF_A_TICK * frame_s, _LONGEST_INTERVAL_S))


def _draw_frames(link: RunLink, scene: Scene, layout: Layout, rate_hz: float, pace: Pace) -> None:
    reported: set[str] = set()
    while True:
        begun_s = time.monotonic()
        # Read before taking, so that everything stored before the end is drawn.
        closed = link.frames.closed
        scene.lost, scene.skipped = link.frames.lost, link.frames.skipped_ticks
        for topic, sample in link.frames.take(_POLL_INTERVAL_S).items():
            try:
                scene.draw(topic, sample)
            except FrameError as error:
                scene.refused += 1
                if topic not in reported:
                    print(
                        f"caraware-viewer: {topic}: {error} (later ones are refused without a message)", file=sys.stderr
                    )
                reported.add(topic)
        layout.arrange(scene)
        if closed:
            return
        link.subscribe_clouds(scene.cloud_vehicles())
        # Meanwhile newer frames replace those that wait.
        link.frames.wait_for_close(frame_interval_s(rate_hz, pace.frame_s()) - (time.monotonic() - begun_s))


def _recordings(
    options: argparse.Namespace, display: Display | None, recording_id: str
) -> tuple[rr.RecordingStream | None, rr.RecordingStream | None]:
    """The recording that keeps the history, in a file, and the one that shows the present."""
    kept = live = None
    if options.save:
        kept = rr.RecordingStream("caraware", recording_id=recording_id)
        kept.set_sinks(rr.FileSink(options.save))
    urls = [options.connect] if options.connect else []
    urls += [display.url] if display is not None else []
    if urls:
        live = rr.RecordingStream("caraware", recording_id=recording_id)
        live.set_sinks(*(rr.GrpcSink(url) for url in urls))
    return kept, live


def _open_display(options: argparse.Namespace) -> contextlib.AbstractContextManager[Display | None]:
    if options.web or options.web_port:
        return Display.web(options.web_port)
    if options.save or options.connect:
        return contextlib.nullcontext()
    if not has_screen():
        print("no screen was found (DISPLAY is not set): serving a browser instead, as with --web", file=sys.stderr)
        return Display.web()
    return Display.window()
