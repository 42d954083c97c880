"""A disk that is full at times: flushing a file fails, as on a file system that reserves space late."""

import errno
import os
from collections import Counter
from pathlib import Path

import pytest
from caraware.ipc import storage


class FullDisk:
    """From now on the first `times` attempts to flush each file end with ENOSPC, and waiting takes no time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, times: int) -> None:
        self.refused: Counter[str] = Counter()
        """How often a file was refused, by the name under which it was flushed."""
        self._times, self._flush = times, os.fsync
        monkeypatch.setattr(os, "fsync", self._fsync)
        monkeypatch.setattr(storage, "RETRY_S", 0.0)

    def fill(self) -> None:
        """From now on every attempt fails."""
        self._times = 10**9

    def _fsync(self, descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        if path.is_file() and self.refused[path.name] < self._times:
            self.refused[path.name] += 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._flush(descriptor)


def partial_files(folder: Path) -> list[Path]:
    """Whatever is there under a temporary name."""
    return sorted(folder.rglob("*.partial"))
