"""Watches a run: one thread draws; the main thread waits for the end of the run, the end of the display, or Ctrl-C."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
from collections.abc import Iterator

import rerun as rr

from caraware_viewer import access
from caraware_viewer.display import Display, has_screen
from caraware_viewer.link import RunLink, connect, find_run
from caraware_viewer.scene import Scene
from caraware_viewer.views import blueprint
from caraware_viewer.wire import FrameError

_POLL_INTERVAL_S = 0.25
_FLUSH_LIMIT_S = 5.0


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
        recording = rr.RecordingStream("caraware", recording_id=f"{run.run}/{run.env}")
        views = blueprint(run_map["map"]["bounds_m"], run_map.get("real_time_factor", 0.0))
        recording.set_sinks(*_sinks(options, display), default_blueprint=views)
        print(f"watching run {run.run} at {options.endpoint}", file=sys.stderr)
        if display is not None and display.page is not None:
            print(f"open {display.page.url} in a browser", file=sys.stderr)
        drawing = threading.Thread(
            target=_draw_frames,
            args=(link, Scene(recording, run_map, options.vehicle, options.lidar)),
            name="draw",
            daemon=True,
        )
        drawing.start()
        try:
            _wait_for_end(drawing, link, display)
        finally:
            link.frames.close()
            _finish(recording, drawing, display)
    print(f"run {run.run} has ended" if link.frames.ended else "the display was closed", file=sys.stderr)
    return 0


def _wait_for_end(drawing: threading.Thread, link: RunLink, display: Display | None) -> None:
    """Waits until the run has ended and is drawn, or the display was closed."""
    while drawing.is_alive() and not (display is not None and display.closed):
        drawing.join(_POLL_INTERVAL_S)


def _finish(recording: rr.RecordingStream, drawing: threading.Thread, display: Display | None) -> None:
    """Writes the rest of the recording. Abandons a display that accepts no data, for which rerun waits without end."""

    def write() -> None:
        drawing.join()
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


def _draw_frames(link: RunLink, scene: Scene) -> None:
    reported: set[str] = set()
    while True:
        # Read before taking, so that everything stored before the end is drawn.
        closed = link.frames.closed
        scene.lost = link.frames.lost
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
        if closed:
            return
        link.subscribe_clouds(scene.cloud_vehicles())


def _sinks(options: argparse.Namespace, display: Display | None) -> Iterator[rr.GrpcSink | rr.FileSink]:
    if options.save:
        yield rr.FileSink(options.save)
    if options.connect:
        yield rr.GrpcSink(options.connect)
    if display is not None:
        yield rr.GrpcSink(display.url)


def _open_display(options: argparse.Namespace) -> contextlib.AbstractContextManager[Display | None]:
    if options.web or options.web_port:
        return Display.web(options.web_port)
    if options.save or options.connect:
        return contextlib.nullcontext()
    if not has_screen():
        print("no screen was found (DISPLAY is not set): serving a browser instead, as with --web", file=sys.stderr)
        return Display.web()
    return Display.window()
