"""Memory of processes of this machine."""

from __future__ import annotations

import math
import os
from pathlib import Path


def resident_mb(pid: int | None = -1) -> float:
    """Resident memory of a process, MB: of this one for -1, NaN for `None` or where the system does not say."""
    if pid is None:
        return math.nan
    try:
        pages = int(Path(f"/proc/{os.getpid() if pid == -1 else pid}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return math.nan
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6
