"""Wall time and processor time of a loop, with the processes that it started."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class LoopCost:
    """What some steps of vehicles or agents took."""

    steps: int
    wall_s: float
    cpu_s: float
    """Of this process and of all that it has started and that still run."""

    @property
    def rate(self) -> float:
        """Steps per wall second."""
        return self.steps / self.wall_s

    @property
    def cpu_us(self) -> float:
        """Processor time of a step, microseconds."""
        return 1e6 * self.cpu_s / self.steps


def cpu_s() -> float:
    """Processor time so far of this process and of its living descendants, seconds; theirs in ticks of the kernel."""
    return time.process_time() + sum(_ticks(child) * TICK_S for child in _descendants(os.getpid()))


def _descendants(parent: int) -> list[int]:
    found: list[int] = []
    for file in Path(f"/proc/{parent}/task").glob("*/children"):
        try:
            children = [int(child) for child in file.read_text().split()]
        except OSError:
            continue
        for child in children:
            found += [child, *_descendants(child)]
    return found


def _ticks(process: int) -> int:
    """User and system time of a process; 0 once it has ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0
    return int(fields[11]) + int(fields[12])


def thread_time_s(process: int) -> float:
    """Processor time so far of the living threads of a process, to the nanosecond, seconds."""
    of_threads = (file.read_text().split()[0] for file in Path(f"/proc/{process}/task").glob("*/schedstat"))
    return sum(int(nanoseconds) for nanoseconds in of_threads) * 1e-9
