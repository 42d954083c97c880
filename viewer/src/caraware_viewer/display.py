"""Shows a recording with the `rerun` program of the wheel: in a window, or served to browsers on loopback.

rerun's own Python functions for this listen on every network interface.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import rerun_cli  # type: ignore[import-untyped]  # the wheel that holds the program has no stubs

from caraware_viewer.child import end_with_parent
from caraware_viewer.page import Page

HOST = "127.0.0.1"
GRPC_PORT = 9876
WEB_PORT = 9090
SERVER_MEMORY_MIB = 8.0
"""Data that rerun's server keeps for browsers that join later, beside the map; it drops the oldest. A browser goes
through all of it before it shows the present."""
WINDOW_MEMORY = "1GiB"
"""Most memory of a window, which drops the oldest data. A browser has no such setting: there rerun's is 2.3 GiB."""

_START_LIMIT_S = 30.0
_POLL_INTERVAL_S = 0.05


class DisplayError(RuntimeError):
    """rerun does not start; the message says why and what to do."""


def has_screen(environment: Mapping[str, str] = os.environ) -> bool:
    """True if a window can be opened."""
    return sys.platform == "darwin" or any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def free_port(wanted: int) -> int:
    """`wanted` if no program listens on it on this machine, else another free port."""
    for port in (wanted, 0):
        with socket.socket() as attempt, contextlib.suppress(OSError):
            attempt.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            attempt.bind((HOST, port))
            port_number: int = attempt.getsockname()[1]
            return port_number
    raise DisplayError(f"no port is free on {HOST}")


class Display:
    """A `rerun` process that ends with this one. Use as a context manager."""

    def __init__(self, process: subprocess.Popen[bytes], grpc_port: int, page: Page | None = None) -> None:
        self.url = f"rerun+http://{HOST}:{grpc_port}/proxy"
        """Address to which a recording is sent."""
        self.page = page
        """The page for browsers; `None` for a window."""
        self._process = process

    @classmethod
    def window(cls, file: Path | None = None) -> Display:
        """Opens a window, which shows `file` if there is one."""
        port = free_port(GRPC_PORT)
        options = ["--port", str(port), "--hide-welcome-screen", "--memory-limit", WINDOW_MEMORY]
        process = _start(*options, *(["--expect-data-soon"] if file is None else [str(file)]))
        _wait_for(process, port)
        return cls(process, port)

    @classmethod
    def web(
        cls, web_port: int | None = None, memory_mib: float = SERVER_MEMORY_MIB, file: Path | None = None
    ) -> Display:
        """Serves browsers at `web_port`; without one, at 9090 if it is free, else at another port.

        rerun's server keeps `memory_mib` for browsers that join later. It serves `file` if there is one.
        """
        grpc_port, upstream_port = free_port(GRPC_PORT), free_port(0)
        options = ["--port", str(grpc_port), "--web-viewer-port", str(upstream_port)]
        options += ["--server-memory-limit", f"{memory_mib:.0f}MiB"]
        process = _start("--serve-web", *options, *([] if file is None else [str(file)]))
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

    @classmethod
    def chosen(
        cls, web_port: int | None, *, web: bool, memory_mib: float = SERVER_MEMORY_MIB, file: Path | None = None
    ) -> Display:
        """A window; browsers if `web` or `web_port` asks for them, or if there is no screen."""
        if not (web or web_port or has_screen()):
            print("no screen was found (DISPLAY is not set): serving a browser instead, as with --web", file=sys.stderr)
            web = True
        if web or web_port:
            return cls.web(web_port, memory_mib, file)
        return cls.window(file)

    @property
    def pid(self) -> int:
        """Identity of rerun's process: the window, or the server for browsers."""
        return self._process.pid

    @property
    def closed(self) -> bool:
        """True once the window was closed or the server ended."""
        return self._process.poll() is not None

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Ends the page and the process; does nothing the second time."""
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
        raise DisplayError(f"{program} is missing: install rerun-sdk again (`pip install --force-reinstall rerun-sdk`)")
    # With CI set, rerun sends no usage statistics.
    environment = {"RUST_LOG": "error"} | os.environ | {"CI": "1"}
    return subprocess.Popen(
        [str(program), "--bind", HOST, *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
        preexec_fn=end_with_parent(),
    )


def _wait_for(process: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + _START_LIMIT_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise DisplayError(
                f"rerun ended at once (exit code {process.returncode}); without a screen use --web or --save F.rrd"
            )
        with contextlib.suppress(OSError), socket.create_connection((HOST, port), timeout=1):
            return
        time.sleep(_POLL_INTERVAL_S)
    process.kill()
    raise DisplayError(f"rerun did not listen at {HOST}:{port} within {_START_LIMIT_S:g} s")
