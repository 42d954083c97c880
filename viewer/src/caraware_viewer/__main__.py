"""The `caraware-viewer` command."""

from __future__ import annotations

import argparse
import faulthandler
import os
import re
import signal
import sys
import threading
from collections.abc import Sequence

# rerun reads CI when it is loaded and started: with it set, rerun sends no usage statistics.
os.environ.setdefault("CI", "1")

from caraware_viewer import access, command
from caraware_viewer.display import DisplayError
from caraware_viewer.link import LinkError
from caraware_viewer.saved import SavedError, is_saved, show_saved
from caraware_viewer.watch import watch_run

INTERRUPTED = 130
EXIT_LIMIT_S = 15.0
"""Longest time from Ctrl-C to the end. Writing the rest of a recording takes at most ten, unless a call hangs."""

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

_EXAMPLES = """Examples:
  caraware-viewer                                  the run on this machine, in a window
  caraware-viewer --web                            in a browser; prints the address to open
  caraware-viewer --save run.rrd                   record
  caraware-viewer run.rrd                          show the recording, with a time line
  caraware-viewer --web --save run.rrd             both
  caraware-viewer --vehicle cav.3 --lidar all      the 3-D view and the figures follow cav.3, with all LIDAR points
  caraware-viewer --camera cav.3@front             the images of the camera `front` of cav.3's suite, with boxes
  caraware-viewer --vehicle cav.3 --messages       what cav.3 knows from messages, and its links
  caraware-viewer tcp/127.0.0.1:7448 --run town-2  another endpoint, one of several runs there

A run on another machine listens on its own loopback. From your laptop:
  ssh -N -L 7447:127.0.0.1:7447 HOST &
  caraware-viewer

Exit codes: 0 the run ended or the window was closed, 1 there is nothing to watch, 2 usage error, 130 interrupted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Watches a run until it ends. Exit codes: 0 the run ended, 1 nothing to watch, 2 usage error, 130 Ctrl-C."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["command"]:
        return command.main(arguments[1:])
    options = parser().parse_args(arguments)
    # SIGTERM ends the viewer as Ctrl-C does: it writes the rest of the recording first.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    try:
        if is_saved(options.endpoint):
            return show_saved(options, parser().parse_args([]))
        return watch_run(options)
    except (LinkError, access.AccessError, DisplayError, SavedError) as error:
        print(f"caraware-viewer: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED


def interrupt(*_: object) -> None:
    """Interrupts the main thread. If the process has not ended in time, prints where each thread is and ends it."""
    faulthandler.dump_traceback_later(EXIT_LIMIT_S)
    end = threading.Timer(EXIT_LIMIT_S + 0.5, os._exit, (INTERRUPTED,))
    end.daemon = True
    end.start()
    raise KeyboardInterrupt


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="caraware-viewer",
        description="Watch a run of the CarAware co-simulation bridge: zenoh to rerun.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "endpoint",
        nargs="?",
        type=_endpoint,
        default=DEFAULT_ENDPOINT,
        help="the run's `fanout.listen` (default %(default)s), or a file that --save has written",
    )
    parser.add_argument("--run", metavar="NAME", help="name of the run, if the endpoint has several")
    parser.add_argument(
        "--env", metavar="N", type=int, help="number of the environment (default: the first of the run)"
    )
    parser.add_argument(
        "--timeout",
        type=_seconds,
        default=5.0,
        metavar="S",
        help="longest wait for the run to answer (default %(default)s s)",
    )
    access.add_arguments(parser.add_argument_group("credentials, if the run requires them"))
    _add_sinks(parser.add_argument_group("where to show the run (default: a window; without a screen, a browser)"))
    _add_scene(parser.add_argument_group("what to show"))
    return parser


def _add_sinks(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--web", action="store_true", help="serve a page for browsers on this machine, and print its address"
    )
    group.add_argument("--web-port", type=_port, metavar="PORT", help="port of that page (default: 9090 if it is free)")
    group.add_argument("--save", metavar="F.rrd", help="record the run to a file")
    group.add_argument(
        "--connect", metavar="URL", help="send the run to a rerun viewer that is already open (rerun+http://…/proxy)"
    )


def _add_scene(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--vehicle",
        metavar="ID",
        action="append",
        help="a vehicle to follow (repeatable): shows its figures and its point cloud; the 3-D view follows the first "
        "(default: the carriers of --camera and --radar, else a hero, else a vehicle with a LIDAR, a camera or a "
        "radar, else the first with sensors)",
    )
    group.add_argument(
        "--rate",
        type=_seconds,
        default=10.0,
        metavar="HZ",
        help="most frames drawn per second (default %(default)s); fewer for a slow browser",
    )
    group.add_argument(
        "--region",
        metavar="M",
        type=float,
        nargs=4,
        help="show the rectangle from x, y to x, y alone (four numbers, world metres), in full detail",
    )
    group.add_argument(
        "--messages",
        action="store_true",
        help="what the followed vehicle knows from V2X messages, its links, and which stations have just sent",
    )
    group.add_argument(
        "--lidar",
        choices=("interest", "all", "off"),
        default="interest",
        help="LIDAR points on road users only, with the ring of the range; all points; none (default %(default)s)",
    )
    group.add_argument(
        "--camera",
        metavar="ID[@SENSOR]",
        action="append",
        help="a camera whose images are shown beside the 3-D view, with a box around each road user (repeatable): ID "
        "is its carrier, SENSOR its name if it is a suite's (default: the camera of the followed vehicle; off: none)",
    )
    group.add_argument(
        "--radar",
        metavar="ID[@SENSOR]",
        action="append",
        help="a radar whose detections are shown in the 3-D view, coloured by radial velocity (repeatable), named in "
        "the same way (default: the radar of the followed vehicle; off: none)",
    )


def _endpoint(text: str) -> str:
    if not is_saved(text) and not re.fullmatch(r"[a-z][a-z-]*/\S+:\d{1,5}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not an endpoint: write tcp/HOST:PORT, as in {DEFAULT_ENDPOINT}")
    return text


def _port(text: str) -> int:
    value = int(text)
    if not 0 < value < 65536:
        raise argparse.ArgumentTypeError(f"{text} is not a port")
    return value


def _seconds(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} is not a time above 0 s")
    return value


if __name__ == "__main__":
    sys.exit(main())
