"""Shows a file that `--save` has written, in the same window or page as a live run."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from caraware_viewer.display import SERVER_MEMORY_MIB, Display

SUFFIX = ".rrd"
MAGIC = b"RRF"
"""How such a file begins, whichever the version."""
_LIVE_ONLY = ("run", "env", "save", "connect", "vehicle", "region", "messages", "lidar", "camera", "radar")
_POLL_INTERVAL_S = 0.1


class SavedError(RuntimeError):
    """The file cannot be shown; the message says why."""


def is_saved(source: str) -> bool:
    """True of a path to such a file, false of an endpoint."""
    return source.endswith(SUFFIX)


def show_saved(options: argparse.Namespace, default: argparse.Namespace) -> int:
    """Shows the file `options.endpoint` until its display is closed; returns the exit code.

    `default` are the options of an empty command line. Raises `SavedError` and `DisplayError`.
    """
    path = Path(options.endpoint)
    for name in _LIVE_ONLY:
        if getattr(options, name) != getattr(default, name):
            raise SavedError(f"--{name} is for a live run: {path} shows what it was saved with")
    try:
        with path.open("rb") as file:
            begins = file.read(len(MAGIC))
    except OSError as error:
        raise SavedError(f"{path}: {error.strerror}") from error
    if begins != MAGIC:
        raise SavedError(f"{path} is not a file of `caraware view --save`")
    # All of it is for browsers, and what rerun's server keeps of a file takes more than the file.
    memory_mib = SERVER_MEMORY_MIB + 3 * path.stat().st_size / 2**20
    with Display.chosen(options.web_port, web=options.web, memory_mib=memory_mib, file=path) as display:
        print(f"showing {path}", file=sys.stderr)
        if display.page is not None:
            print(f"open {display.page.url} in a browser", file=sys.stderr)
        while not display.closed:
            time.sleep(_POLL_INTERVAL_S)
    print("the display was closed", file=sys.stderr)
    return 0
