"""The filters on recorded ticks: what `fusion` starts from, in the final evaluations of its preset."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caraware.baselines import Baselines
from caraware.run.config import RunConfig
from caraware.study.recording import RecordedTick, Recording


@dataclass(frozen=True)
class FilterComparison:
    """A recording of the preset `fusion`, and how many of its evaluations are the final ones."""

    recording: Recording
    final_evaluations: int

    def evaluations(self) -> list[list[RecordedTick]]:
        """The final evaluation episodes, each with a seed of its own."""
        return list(self.recording.episodes(evaluation=True))[-self.final_evaluations :]

    def filters_m(self) -> dict[str, list[float]]:
        """Mean error of the EKF and of the EKF with a map in each final evaluation."""
        config = RunConfig.from_run(self.recording.run())
        assert config.sensors is not None
        rows = [_of_filters(Baselines(config.sensors, config.lanes()), ticks) for ticks in self.evaluations()]
        return {name: [row[name] for row in rows] for name in rows[0]}


def _of_filters(baselines: Baselines, ticks: Sequence[RecordedTick]) -> dict[str, float]:
    errors: dict[str, list[float]] = {}
    for obs in ticks:
        filtered, _ = baselines.add(obs)
        for name, each in filtered.items():
            errors.setdefault(name, []).extend(each.error_m.tolist())
    return {name: float(np.mean(values)) for name, values in errors.items()}
