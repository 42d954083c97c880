"""The learned estimator on recorded ticks: trained from several seeds, beside the filters that it starts from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from caraware.baselines import Baselines
from caraware.fusion.carrier import COLUMNS, Carried
from caraware.fusion.estimating import Estimating
from caraware.fusion.learner import Episode, FusionConfig, FusionLearner
from caraware.learn.config import ConfigError
from caraware.run.config import RunConfig
from caraware.study.recording import RecordedTick, Recording


@dataclass(frozen=True)
class FusionComparison:
    """A recording of the preset `fusion`, and how many of its evaluations are the final ones."""

    recording: Recording
    final_evaluations: int

    def evaluations(self) -> list[list[RecordedTick]]:
        """The final evaluation episodes, each with a seed of its own."""
        return list(self.recording.episodes(evaluation=True))[-self.final_evaluations :]

    def trained(self, seed: int) -> FusionLearner:
        """A new estimator, trained on all training episodes. Raises `ConfigError`."""
        run = self.recording.run()
        config, fusion = RunConfig.from_run(run), FusionConfig.from_run(run)
        if config.sensors is None:
            raise ConfigError("the recorded run has no sensor tables", "record it with `caraware train fusion`")
        trainer, size = replace(config.trainer, seed=seed), len(run["config"]["observation"]["fields"])
        learner = FusionLearner(trainer, fusion, fusion.pieces(run), config.bounds, size)
        carrier = learner.carrier(config.sensors)
        for ticks in self.recording.episodes(evaluation=False):
            carrier.reset()
            tables = [carrier.step(obs) for obs in ticks]
            valid = torch.from_numpy(np.stack([obs.valid for obs in ticks])).float()
            table = torch.stack(
                [torch.nn.functional.pad(rows, (0, 0, 0, valid.shape[1] - len(rows))) for rows in tables]
            )
            truth_m = torch.stack([obs.truth[:, :2] for obs in ticks]) - learner.estimator.centre_m
            counts = valid * (Carried.of(table).running[..., 0] > 0)
            assert table.shape[-1] == COLUMNS
            learner.learn(Episode(table, truth_m, counts), config.progress(ticks[0].episode))
        return learner

    def errors_m(self, learner: FusionLearner) -> list[float]:
        """Mean error of the estimator in each final evaluation."""
        noise = RunConfig.from_run(self.recording.run()).sensors
        assert noise is not None
        means: list[float] = []
        for ticks in self.evaluations():
            estimating, sums = Estimating(learner, learner.carrier(noise)), []
            for obs in ticks:
                estimate_m, _ = estimating.step(obs)
                sums.append((estimate_m - obs.truth[:, :2])[torch.from_numpy(obs.valid)].double().norm(dim=1))
            means.append(torch.cat(sums).mean().item())
        return means

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
