"""`caraware panel`: serves the panel until Ctrl-C, which ends what the panel has started."""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import os
import queue
import secrets
import shutil
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from caraware_viewer.display import DisplayError, free_port
from caraware_viewer.panel.commands import END_LIMIT_S, CommandLog
from caraware_viewer.panel.server import HOST, Panel, serve

PORT = 9091
INTERRUPTED = 130
CLOSE_LIMIT_S = 20.0
"""Longest time from the end of the last command to the end of the panel."""
_KEY_BYTES = 24


def main(arguments: Sequence[str] | None = None) -> int:
    """Serves the panel. Exit codes: 130 Ctrl-C, 1 it cannot serve, 2 usage error."""
    parser = argparse.ArgumentParser(prog="caraware panel", description="Start, steer and compare runs in a browser.")
    parser.add_argument("--port", type=int, help=f"port on loopback (default: {PORT} if it is free)")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="directory that holds run directories")
    options = parser.parse_args(arguments)
    program = os.environ.get("CARAWARE") or shutil.which("caraware")
    if program is None:
        print("caraware panel: start it as `caraware panel`", file=sys.stderr)
        return 1
    key = secrets.token_urlsafe(_KEY_BYTES)
    commands = CommandLog(program)
    try:
        port = options.port or free_port(PORT)
        panel = Panel(commands, options.runs, port, key)
        server = serve(panel, port)
    except (OSError, DisplayError, SystemExit) as error:
        print(f"caraware panel: cannot serve at {HOST}:{options.port or PORT}: {error}", file=sys.stderr)
        return 1
    # A signal handler may put into such a queue at any moment.
    signals: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda received, _: signals.put(received))
    threading.Thread(target=server.serve_forever, name="server", daemon=True).start()
    print(f"open http://{HOST}:{port}/#{key} in a browser on this machine", flush=True)
    print("The address allows commands in your name. Ctrl-C ends the panel and what it has started.", flush=True)
    _wait_for(signals)
    # A panel that does not end prints where each thread is, and ends; Linux then ends what it has started.
    faulthandler.dump_traceback_later(END_LIMIT_S + CLOSE_LIMIT_S, exit=True)
    _end(commands, signals)
    server.shutdown()
    server.server_close()
    panel.live.close()
    sys.stdout.flush()
    sys.stderr.flush()
    # Threads of zenoh may still call Python, which aborts a process that tidies up.
    os._exit(INTERRUPTED)


def _wait_for(signals: queue.SimpleQueue[int]) -> None:
    """Waits for a signal. Linux may give it to any thread, and then wakes no main thread that waits without a limit."""
    while True:
        with contextlib.suppress(queue.Empty):
            signals.get(timeout=0.2)
            return


def _end(commands: CommandLog, signals: queue.SimpleQueue[int]) -> None:
    """Ends all commands in order; a second signal kills them."""
    running = commands.running()
    if running:
        print("ending, Ctrl-C again kills: " + "; ".join(command.line for command in running), flush=True)
    closing = threading.Thread(target=commands.close, name="end")
    closing.start()
    while closing.is_alive():
        with contextlib.suppress(queue.Empty):
            signals.get(timeout=0.1)
            commands.kill()


if __name__ == "__main__":
    sys.exit(main())
