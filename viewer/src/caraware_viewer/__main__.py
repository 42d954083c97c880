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

# rerun reads this when it is loaded and started: a viewer of one's own simulation does not report on its user.
os.environ.setdefault("CI", "1")

from caraware_viewer import access, command
from caraware_viewer.display import DisplayError
from caraware_viewer.link import LinkError
from caraware_viewer.watch import watch

INTERRUPTED = 130
LEAVE_WITHIN_S = 15.0
"""Longest time from Ctrl-C to the end: what is left is written within ten, unless something does not come back."""

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

_EXAMPLES = """Examples:
  caraware-viewer                                  the run on this machine, in a window
  caraware-viewer --web                            in a browser: prints the address to open
  caraware-viewer --save run.rrd                   record; look later with `rerun run.rrd`
  caraware-viewer --web --save run.rrd             both
  caraware-viewer --vehicle cav.3 --lidar all      the 3-D view and the figures follow cav.3, with its whole point cloud
  caraware-viewer tcp/127.0.0.1:7448 --run town-2  another endpoint, one of several runs there

A run on another machine listens on its own loopback. From your laptop:
  ssh -N -L 7447:127.0.0.1:7447 HOST &
  caraware-viewer

Exit codes: 0 the run ended or the window was closed, 1 nothing to watch, 2 usage, 130 interrupted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Watches a run until it ends. Exit code 0: it ended, 1: nothing to watch, 2: usage, 130: interrupted."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["command"]:
        return command.main(arguments[1:])
    options = _parser().parse_args(arguments)
    # Asked to end, it writes what is left, as at Ctrl-C.
    for asked in (signal.SIGINT, signal.SIGTERM):
        signal.signal(asked, leave)
    try:
        return watch(options)
    except (LinkError, access.AccessError, DisplayError) as error:
        print(f"caraware-viewer: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED


def leave(*_: object) -> None:
    """Interrupts the main thread. If that has not ended the process in time, says where it stands and ends it."""
    faulthandler.dump_traceback_later(LEAVE_WITHIN_S)
    end = threading.Timer(LEAVE_WITHIN_S + 0.5, os._exit, (INTERRUPTED,))
    end.daemon = True
    end.start()
    raise KeyboardInterrupt


def _parser() -> argparse.ArgumentParser:
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
        help="the run's `fanout.listen` (default %(default)s)",
    )
    parser.add_argument("--run", metavar="NAME", help="name of the run, if several are fanned out there")
    parser.add_argument("--env", metavar="N", type=int, help="environment of the run (default: its first)")
    parser.add_argument(
        "--timeout", type=_seconds, default=5.0, metavar="S", help="longest wait for an answer (default %(default)s s)"
    )
    access.add_arguments(parser.add_argument_group("who you are, if the run asks"))
    _add_sinks(parser.add_argument_group("where it is shown (a window, if nothing is said and there is a screen)"))
    _add_scene(parser.add_argument_group("what is shown"))
    return parser


def _add_sinks(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--web", action="store_true", help="serve browsers on this machine and print the address")
    group.add_argument(
        "--web-port", type=_port, metavar="PORT", help="port of that address (default 9090 if it is free)"
    )
    group.add_argument("--save", metavar="F.rrd", help="record to a file")
    group.add_argument("--connect", metavar="URL", help="a rerun viewer that is already open (rerun+http://…/proxy)")


def _add_scene(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--vehicle",
        metavar="ID",
        action="append",
        help="a vehicle to look at (repeatable): figures and point cloud; the first is in the 3-D view (default: a "
        "hero, else one with a LIDAR, else the first that senses)",
    )
    group.add_argument(
        "--lidar",
        choices=("interest", "all", "off"),
        default="interest",
        help="points on road users only, with the range ring; all points; none (default %(default)s)",
    )


def _endpoint(text: str) -> str:
    if not re.fullmatch(r"[a-z][a-z-]*/\S+:\d{1,5}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no endpoint: write tcp/HOST:PORT, as in {DEFAULT_ENDPOINT}")
    return text


def _port(text: str) -> int:
    value = int(text)
    if not 0 < value < 65536:
        raise argparse.ArgumentTypeError(f"{text} is no port")
    return value


def _seconds(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} is not a time above 0 s")
    return value


if __name__ == "__main__":
    sys.exit(main())
