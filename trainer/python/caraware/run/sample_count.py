"""The samples of a run: how many came, how fast, and how far raw GNSS was off in them."""

import time

from caraware.ipc.arrays import FloatArray
from caraware.report.evaluation import Mean


class SampleCount:
    """Counts training samples, and measures between two updates."""

    def __init__(self, env_steps: int = 0) -> None:
        self.env_steps = env_steps
        """Samples seen."""
        self.passed_steps = 0
        """Those among them that came when no horizon could be filled any more."""
        self._raw_gnss_error_m = Mean()
        self._clock = (time.monotonic(), env_steps)

    def add(self, raw_m: FloatArray, *, learns: bool) -> None:
        """Count the samples of one tick; `raw_m` are the errors of raw GNSS on its valid rows."""
        self._raw_gnss_error_m.add(raw_m)
        self.env_steps += len(raw_m)
        self.passed_steps += 0 if learns else len(raw_m)

    def since_last_update(self) -> tuple[float, float]:
        """Samples per second of wall time, and the mean error of raw GNSS (m); the next call counts from here."""
        raw_gnss_error_m, self._raw_gnss_error_m = self._raw_gnss_error_m.value(), Mean()
        now, (since, steps) = time.monotonic(), self._clock
        self._clock = (now, self.env_steps)
        return (self.env_steps - steps) / max(now - since, 1e-9), raw_gnss_error_m
