"""Watches a run: one thread draws; the main thread waits for the end of the run, the end of the display, or Ctrl-C."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
import time
from dataclasses import dataclass

import rerun as rr

from caraware_viewer import access
from caraware_viewer.detail import Region
from caraware_viewer.display import Display
from caraware_viewer.documents import RunMap
from caraware_viewer.link import RunLink, connect, find_run
from caraware_viewer.mounted import CAMERA, OFF, RADAR, carriers, check_choices
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
    with RunLink(session, run, messages=options.messages) as link:
        run_map = link.map(options.timeout)
        for kind, names in ((CAMERA, options.camera), (RADAR, options.radar)):
            check_choices(kind, [name for name in names or () if name != OFF], run_map)
        chosen = [name for name in (*(options.camera or ()), *(options.radar or ())) if name != OFF]
        kept, live = _recordings(options, f"{run.run}/{run.env}")
        scene = Scene(
            kept,
            run_map,
            options.vehicle or carriers(chosen, run_map),
            options.lidar,
            live=live,
            region=options.region,
            messages=options.messages,
            cameras=options.camera,
            radars=options.radar,
        )
        with _open_display(options, scene.server_mib) as display:
            _connect(live, options, display)
            scene.display_pid = None if display is None else display.pid
            _show(link, scene, Layout([one for one in (kept, live) if one], run_map, options.region), options, display)
    print(f"run {run.run} has ended" if link.frames.ended else "the display was closed", file=sys.stderr)
    return 0


def _show(link: RunLink, scene: Scene, layout: Layout, options: argparse.Namespace, display: Display | None) -> None:
    """Draws frames until the run ends or the display is closed."""
    print(f"watching run {link.run.run} at {options.endpoint}", file=sys.stderr)
    if display is not None and display.page is not None:
        print(f"open {display.page.url} in a browser", file=sys.stderr)
    layout.arrange(scene)
    page = None if display is None else display.page
    rate = FrameRate(options.rate, None if page is None else page.pace, keeps=bool(options.save))
    drawing = threading.Thread(target=_draw_frames, args=(link, scene, layout, rate), name="draw", daemon=True)
    drawing.start()
    try:
        _wait_for_end(drawing, link, display)
    finally:
        link.frames.close()
        _finish(layout.recordings, drawing, display)
        if scene.summary():
            print(scene.summary(), file=sys.stderr)


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
        self.recordings, self._map, self._region = recordings, run_map, region
        self._shown: object = None

    def arrange(self, scene: Scene) -> None:
        """Sends a new arrangement if another view has data, or one has lost its place."""
        mode = mode_of(str(self._map.get("mode", "train")), driving=scene.driving)
        cameras = scene.camera_titles
        shown = layout_of(mode, scene.figures, cameras)
        if shown == self._shown:
            return
        self._shown = shown
        views = blueprint(self._map["map"]["bounds_m"], mode, scene.figures, self._region, cameras, scene.legend_rows)
        for recording in self.recordings:
            recording.send_blueprint(views, make_active=True, make_default=True)


@dataclass(frozen=True)
class FrameRate:
    """How often a tick is drawn."""

    most_hz: float
    pace: Pace | None
    """That of the open pages; None without a page."""
    keeps: bool
    """A file keeps what is drawn, whether a page is open or not."""

    def interval_s(self) -> float:
        """Time between two ticks: what the slowest page needs, and seldom if no page is open."""
        frame_s = 0.0 if self.pace is None else self.pace.frame_s()
        is_seen = self.pace is None or frame_s > 0.0
        wanted_s = _FRAMES_OF_A_TICK * frame_s if is_seen or self.keeps else _LONGEST_INTERVAL_S
        return max(1 / self.most_hz, min(wanted_s, _LONGEST_INTERVAL_S))


def _draw_frames(link: RunLink, scene: Scene, layout: Layout, rate: FrameRate) -> None:
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
        for note in scene.take_notes():
            print(f"caraware-viewer: {note}", file=sys.stderr)
        link.subscribe_sensors(scene.sensor_topics())
        # Meanwhile newer frames replace those that wait.
        link.frames.wait_for_close(rate.interval_s() - (time.monotonic() - begun_s))


def _recordings(
    options: argparse.Namespace, recording_id: str
) -> tuple[rr.RecordingStream | None, rr.RecordingStream | None]:
    """The recording that keeps the history, in a file, and the one that shows the present, once it has its sinks."""
    kept = live = None
    if options.save:
        kept = rr.RecordingStream("caraware", recording_id=recording_id)
        kept.set_sinks(rr.FileSink(options.save))
    if options.connect or _wants_display(options):
        live = rr.RecordingStream("caraware", recording_id=recording_id)
    return kept, live


def _connect(live: rr.RecordingStream | None, options: argparse.Namespace, display: Display | None) -> None:
    """Sends the live recording, with what it has already, to where it is shown."""
    urls = [options.connect] if options.connect else []
    urls += [display.url] if display is not None else []
    if live is not None:
        live.set_sinks(*(rr.GrpcSink(url) for url in urls))


def _wants_display(options: argparse.Namespace) -> bool:
    return bool(options.web or options.web_port or not (options.save or options.connect))


def _open_display(options: argparse.Namespace, memory_mib: float) -> contextlib.AbstractContextManager[Display | None]:
    if not _wants_display(options):
        return contextlib.nullcontext()
    return Display.chosen(options.web_port, web=options.web, memory_mib=memory_mib)
