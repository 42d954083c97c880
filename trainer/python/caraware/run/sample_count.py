"""The samples of a run: how many came, how fast, and what the reference metrics are on them."""

import time
from collections.abc import Mapping

from caraware.ipc.arrays import FloatArray
from caraware.report.evaluation import Mean


class SampleCount:
    """Counts training samples, and measures between two updates."""

    def __init__(self, env_steps: int = 0) -> None:
        self.env_steps = env_steps
        """Samples seen."""
        self.passed_steps = 0
        """Those among them that no update learns from: no horizon can be filled any more, or another policy drove."""
        self._references: dict[str, Mean] = {}
        self._clock = (time.monotonic(), env_steps)

    def add(self, samples: int, references: Mapping[str, FloatArray], *, learns: bool) -> None:
        """Count the samples of one tick; `references` are the reference metrics by name, on its valid rows."""
        for name, values in references.items():
            self._references.setdefault(name, Mean()).add(values)
        self.env_steps += samples
        self.passed_steps += 0 if learns else samples

    def since_last_update(self) -> tuple[float, dict[str, float]]:
        """Samples per second of wall time, and the means of the references; the next call counts from here."""
        references = {name: mean.value() for name, mean in self._references.items()}
        self._references = {}
        now, (since, steps) = time.monotonic(), self._clock
        self._clock = (now, self.env_steps)
        return (self.env_steps - steps) / max(now - since, 1e-9), references
