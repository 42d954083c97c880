"""Free TCP ports that no other test takes."""

from __future__ import annotations

import fcntl
import os
import socket
import tempfile
from pathlib import Path
from typing import BinaryIO

_FIRST, _COUNT = 20_000, 10_000
"""Below Linux's ephemeral ports (32768 to 60999), which outgoing connections of other programs may take at any time."""

_locks: list[BinaryIO] = []
"""Lock files of the ports that this process has taken; `fanout/tests/harness` uses the same files."""


def free_port() -> int:
    """A port that this process holds until it ends."""
    directory = Path(tempfile.gettempdir()) / "caraware-test-ports"
    directory.mkdir(exist_ok=True)
    for offset in range(_COUNT):
        port = _FIRST + (os.getpid() + offset) % _COUNT
        lock = (directory / str(port)).open("wb")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            lock.close()
            continue
        _locks.append(lock)
        return port
    raise RuntimeError("no port is free")
