"""Files that a run depends on: written whole, flushed to disk and renamed. A full disk is waited for."""

import errno
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

log = logging.getLogger(__name__)

RETRY_S = 0.1
"""Time between two attempts on a full disk."""

_Result = TypeVar("_Result")


def is_full(error: OSError) -> bool:
    """Whether the disk, or the user's share of it, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def when_there_is_space(
    what: Path, write: Callable[[], _Result], stop_requested: Callable[[], bool] = lambda: False
) -> _Result:
    """The result of `write`, which is called again while the disk is full, until it is not or a stop is requested."""
    waited = False
    while True:
        try:
            result = write()
        except OSError as error:
            if not is_full(error) or stop_requested():
                raise
            if not waited:
                log.warning("the disk is full: %s waits until there is space", what)
            waited = True
            time.sleep(RETRY_S)
            continue
        if waited:
            log.warning("there is space again: %s is written", what)
        return result


def write_synced(file: Path, content: bytes) -> None:
    """Write and flush to disk."""
    with file.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def write_whole(file: Path, content: bytes) -> None:
    """Write a file that has its old content or the new one at any moment. Raises `OSError`."""
    partial = file.parent / f".{file.name}.partial"
    try:
        write_synced(partial, content)
        partial.rename(file)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
    sync_directory(file.parent)


def sync_directory(folder: Path) -> None:
    """Flush the names in a directory to disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
