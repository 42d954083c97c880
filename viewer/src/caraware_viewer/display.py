"""Where a recording is shown: the `rerun` program of the wheel, as a window or as a server for browsers, on loopback.

rerun's Python functions for the same listen on every interface.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType

import rerun_cli

from caraware_viewer.page import Page

HOST = "127.0.0.1"
GRPC_PORT = 9876
WEB_PORT = 9090
SERVER_MEMORY = "256MiB"
"""What rerun's server keeps for browsers that come later; then it forgets the oldest."""

_READY_S = 30.0
_LOOK_S = 0.05
_PR_SET_PDEATHSIG = 1


class DisplayError(RuntimeError):
    """rerun does not come up; the message says why and what to do."""


def has_screen(environment: Mapping[str, str] = os.environ) -> bool:
    """True where a window can be opened."""
    return sys.platform == "darwin" or any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def free_port(wanted: int) -> int:
    """`wanted` if nobody listens there on this machine, else one that is free."""
    for port in (wanted, 0):
        with socket.socket() as attempt, contextlib.suppress(OSError):
            attempt.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            attempt.bind((HOST, port))
            return attempt.getsockname()[1]
    raise DisplayError(f"no port is free on {HOST}")


class Display:
    """A `rerun` process, ended with this one. Use as a context manager."""

    def __init__(self, process: subprocess.Popen[bytes], grpc_port: int, page: Page | None = None) -> None:
        self.url = f"rerun+http://{HOST}:{grpc_port}/proxy"
        """Where recordings are sent."""
        self.page = page
        """What a browser opens, if it is not a window."""
        self._process = process

    @classmethod
    def window(cls) -> Display:
        """Opens a window."""
        port = free_port(GRPC_PORT)
        process = _start("--port", str(port), "--hide-welcome-screen", "--expect-data-soon")
        _wait_for(process, port)
        return cls(process, port)

    @classmethod
    def web(cls, web_port: int | None = None) -> Display:
        """Serves browsers at `web_port`, or at the usual port if that is free, or at another."""
        grpc_port, upstream_port = free_port(GRPC_PORT), free_port(0)
        ports = ("--port", str(grpc_port), "--web-viewer-port", str(upstream_port))
        process = _start("--serve-web", *ports, "--server-memory-limit", SERVER_MEMORY)
        try:
            _wait_for(process, grpc_port)
            _wait_for(process, upstream_port)
            page = Page(HOST, web_port or free_port(WEB_PORT), upstream_port, grpc_port)
        except OSError as error:
            process.kill()
            raise DisplayError(
                f"cannot serve at {HOST}:{web_port}: {error.strerror}; choose another --web-port"
            ) from error
        except BaseException:
            process.kill()
            raise
        return cls(process, grpc_port, page)

    @property
    def closed(self) -> bool:
        """True once the window was closed or the server ended."""
        return self._process.poll() is not None

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Ends it, the page first; nothing if that has been done."""
        if self.page is not None:
            self.page.close()
        self._process.terminate()
        try:
            self._process.wait(3)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _start(*arguments: str) -> subprocess.Popen[bytes]:
    program = Path(rerun_cli.__file__).parent / "rerun"
    if not program.exists():
        raise DisplayError(
            f"{program} is not there: install rerun-sdk anew (`pip install --force-reinstall rerun-sdk`)"
        )
    # With CI set, rerun does not report on its user.
    environment = {"RUST_LOG": "error"} | os.environ | {"CI": "1"}
    return subprocess.Popen(
        [str(program), "--bind", HOST, *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
        preexec_fn=_die_with_parent(),
    )


def _die_with_parent() -> Callable[[], None] | None:
    """Linux ends the child even if this process is killed; elsewhere nobody does."""
    if not sys.platform.startswith("linux"):
        return None
    libc = ctypes.CDLL(None)
    return lambda: libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _wait_for(process: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + _READY_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise DisplayError(
                f"rerun ended at once (exit code {process.returncode}); without a screen use --web or --save F.rrd"
            )
        with contextlib.suppress(OSError), socket.create_connection((HOST, port), timeout=1):
            return
        time.sleep(_LOOK_S)
    process.kill()
    raise DisplayError(f"rerun did not listen at {HOST}:{port} within {_READY_S:g} s")
