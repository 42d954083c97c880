"""The `caraware-viewer` command."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence

# rerun reads this when it is loaded and started: a viewer of one's own simulation does not report on its user.
os.environ.setdefault("CI", "1")

import rerun as rr

from caraware_viewer.layout import blueprint
from caraware_viewer.link import Link, LinkError, choose, connect
from caraware_viewer.scene import Scene
from caraware_viewer.wire import FrameError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

_LOOK_S = 0.5


def main(arguments: Sequence[str] | None = None) -> int:
    """Watches a run until it ends. Exit code 0: it ended, 1: nothing to watch, 2: usage, 130: interrupted."""
    options = _parser().parse_args(arguments)
    try:
        return watch(options)
    except LinkError as error:
        print(f"caraware-viewer: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def watch(options: argparse.Namespace) -> int:
    """Connects, opens the recording, and draws what comes."""
    session = connect(options.endpoint, options.timeout)
    try:
        run = choose(session, options.endpoint, options.run, options.timeout)
    except BaseException:
        session.close()
        raise
    with Link(session, run) as link:
        run_map = link.map(options.timeout)
        recording = rr.RecordingStream("caraware", recording_id=f"{run.run}/{run.env}")
        _open_sink(recording, options, blueprint(run_map["map"]["bounds_m"]))
        print(f"watching run {run.run} at {options.endpoint}", file=sys.stderr)
        try:
            _draw(link, Scene(recording, run_map))
        finally:
            recording.flush()
            recording.disconnect()
    print(f"run {run.run} has ended", file=sys.stderr)
    return 0


def _draw(link: Link, scene: Scene) -> None:
    refused = 0
    while True:
        # Looked at before taking: what was stored before the end is drawn.
        ended = link.frames.closed
        for topic, frame in link.frames.take(_LOOK_S).items():
            try:
                scene.draw(topic, frame)
            except FrameError as error:
                refused += 1
                if refused == 1:
                    print(f"caraware-viewer: {topic}: {error} (later ones are left out in silence)", file=sys.stderr)
        if ended:
            return


def _open_sink(recording: rr.RecordingStream, options: argparse.Namespace, views: rr.blueprint.Blueprint) -> None:
    if options.save:
        recording.save(options.save, default_blueprint=views)
    elif options.connect:
        recording.connect_grpc(options.connect, default_blueprint=views)
    else:
        recording.spawn(default_blueprint=views)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="caraware-viewer", description="Watch a run of the CarAware co-simulation bridge: zenoh to rerun."
    )
    parser.add_argument(
        "endpoint",
        nargs="?",
        type=_endpoint,
        default=DEFAULT_ENDPOINT,
        help="the run's `fanout.listen` (default %(default)s)",
    )
    parser.add_argument("--run", metavar="NAME", help="name of the run, if several are fanned out there")
    parser.add_argument(
        "--timeout", type=_seconds, default=5.0, metavar="S", help="longest wait for an answer (default %(default)s s)"
    )
    sink = parser.add_mutually_exclusive_group()
    sink.add_argument("--save", metavar="F.rrd", help="record to a file instead of showing")
    sink.add_argument("--connect", metavar="URL", help="show in a rerun viewer that is already open (rerun+http://…)")
    sink.add_argument("--spawn", action="store_true", help="open a rerun viewer (the default)")
    return parser


def _endpoint(text: str) -> str:
    if not re.fullmatch(r"[a-z][a-z-]*/\S+:\d{1,5}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no endpoint: write tcp/HOST:PORT, as in {DEFAULT_ENDPOINT}")
    return text


def _seconds(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} is not a time above 0 s")
    return value


if __name__ == "__main__":
    sys.exit(main())
