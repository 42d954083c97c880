"""PPO and regression on the same recorded ticks: what learning by trial costs, and what no memory can beat.

Three learners of the policy's network, each from several seeds of its own, evaluated on the recorded final evaluations:
PPO as a run trains it; regression from the same horizons by the same number of gradient steps, at PPO's learning rate;
and regression to convergence, which may walk over all samples of the run in any order as often as it wants.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from caraware.learn.adam import Adam
from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.ppo import Ppo
from caraware.learn.rollout import Horizon, Rollout
from caraware.learn.supervised import Supervised
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.study.recording import RecordedTick, Recording
from caraware.tasks.localisation import Localisation

CONVERGED_RATE = 1e-3
"""Adam's step size of the regression to convergence at its first step; it falls to 0 along a half cosine."""


@dataclass(frozen=True)
class Comparison:
    """A recording, and how its learners are configured."""

    recording: Recording
    final_evaluations: int

    @cached_property
    def config(self) -> RunConfig:
        """The run's configuration. Raises `ConfigError`."""
        return RunConfig.from_run(self.recording.run())

    @cached_property
    def evaluations(self) -> list[list[RecordedTick]]:
        """The final evaluation episodes, each with a seed of its own."""
        return list(self.recording.episodes(evaluation=True))[-self.final_evaluations :]

    def trainer(self, seed: int) -> TrainerConfig:
        """The learner's configuration with another seed; the ticks stay those of the recorded run."""
        return replace(self.config.trainer, seed=seed)

    def task(self) -> Localisation:
        """The run's task."""
        task = self.config.task
        assert isinstance(task, Localisation)
        return task

    def learner(self, seed: int) -> Learner:
        """A new policy with the regression beside it."""
        config = replace(self.config, trainer=replace(self.trainer(seed), supervised=True), resume_from=None)
        return Learner.begin(config, self.evaluations[0][0].observation.shape[1])

    def horizons(self, learner: Learner, *, episodes: int | None = None) -> Iterator[Horizon]:
        """The horizons of the run, from its first training episodes or from all."""
        rollout = Rollout(self.config.trainer.horizon, learner.ppo.observation_size, bootstrap=False)
        for number, ticks in enumerate(self.recording.episodes(evaluation=False)):
            if number == episodes:
                return
            for obs in ticks:
                rollout.add(obs)
                if rollout.full():
                    yield rollout.take()

    def errors_m(self, predict: "Predict") -> list[float]:
        """Mean error of every final evaluation, over its valid rows."""
        return [_mean_error_m(predict, ticks) for ticks in self.evaluations]

    def raw_gnss_m(self) -> list[float]:
        """The same of the newest fix."""
        means: list[float] = []
        for ticks in self.evaluations:
            ways = [(obs.gnss_m[:, :2] - obs.truth[:, :2])[torch.from_numpy(obs.valid)] for obs in ticks]
            means.append(torch.cat(ways).double().norm(dim=1).mean().item())
        return means


class Predict:
    """Positions of observations: a policy's, or a regression's."""

    def __init__(self, of: Ppo | Supervised) -> None:
        self._of = of

    def __call__(self, observation: Tensor) -> Tensor:
        """Positions `[n, 2]` (m, world)."""
        return self._of.predict_m([observation])[0] if isinstance(self._of, Ppo) else self._of.predict_m(observation)


@dataclass(frozen=True)
class Learnt:
    """What one seed of a learner reached, and what it was given."""

    name: str
    seed: int
    samples: int
    gradient_steps: int
    error_m: list[float]
    """Of every final evaluation."""

    @property
    def mean_m(self) -> float:
        """Over the final evaluations."""
        return float(np.mean(self.error_m))


def same_steps(of: Comparison, seed: int, *, ppo: bool, episodes: int | None = None) -> list[Learnt]:
    """Train both on the run's horizons in their order; with `ppo` False the regression alone, which needs no policy."""
    learner = of.learner(seed)
    beside, samples = learner.supervised, 0
    assert isinstance(beside, Supervised)
    rate, decay = of.config.trainer.learning_rate, of.config.trainer.learning_rate_decay
    for update, horizon in enumerate(of.horizons(learner, episodes=episodes)):
        batch = learner.ppo.score(horizon) if ppo else _unscored(of.task(), horizon)
        learning_rate = learner.ppo.update(batch).learning_rate if ppo else rate * decay**update
        beside.learn(batch, learning_rate)
        samples += len(batch.reward)
    steps = int(beside.optimiser.steps)
    learnt = [Learnt("regression", seed, samples, steps, of.errors_m(Predict(beside)))]
    return [Learnt("ppo", seed, samples, steps, of.errors_m(Predict(learner.ppo))), *learnt] if ppo else learnt


def _unscored(task: Localisation, horizon: Horizon) -> Batch:
    """The samples of a horizon as regression takes them: nothing was tried on them, and nothing earned."""
    rows = horizon.valid.flatten().nonzero().squeeze(1)
    none = torch.zeros(len(rows))
    return Batch(
        observation=task.network_input(horizon.observation.flatten(0, 1).index_select(0, rows)),
        action=torch.zeros(len(rows), task.actions.size),
        log_probability=none,
        reward=none,
        advantage=none,
        value_target=none,
        truth=horizon.truth.flatten(0, 1).index_select(0, rows),
        metrics={},
        vehicle=horizon.vehicle.flatten()[rows],
        tick=horizon.tick.repeat_interleave(horizon.valid.shape[1])[rows],
    )


def converged(of: Comparison, seed: int, *, epochs: int, share: int) -> Learnt:
    """Regression over every `share`-th valid row of the run, shuffled anew in each of `epochs` passes."""
    trainer = of.trainer(seed)
    observation, truth = _rows(of.recording.episodes(evaluation=False), share)
    task = of.task()
    beside = Supervised(trainer, observation.shape[1], task, torch.device("cpu"))
    rows = task.network_input(observation)
    adam, generator = Adam(beside.mlp.parameters), torch.Generator().manual_seed(seed)
    steps = epochs * math.ceil(len(rows) / trainer.batch_size)
    done = 0
    for _ in range(epochs):
        for part in torch.randperm(len(rows), generator=generator).split(trainer.batch_size):
            beside.gradient(rows[part], truth[part])
            adam.step(CONVERGED_RATE * 0.5 * (1.0 + math.cos(math.pi * done / steps)))
            done += 1
    return Learnt("regression to convergence", seed, len(rows), steps, of.errors_m(Predict(beside)))


def _rows(episodes: Iterator[Sequence[RecordedTick]], share: int) -> tuple[Tensor, Tensor]:
    observations: list[Tensor] = []
    truths: list[Tensor] = []
    for ticks in episodes:
        valid = torch.from_numpy(np.concatenate([obs.valid for obs in ticks]))
        observations.append(torch.cat([obs.observation for obs in ticks])[valid][::share])
        truths.append(torch.cat([obs.truth for obs in ticks])[valid][::share])
    return torch.cat(observations), torch.cat(truths)


@torch.no_grad()
def _mean_error_m(predict: Predict, ticks: Sequence[RecordedTick]) -> float:
    valid = torch.from_numpy(np.concatenate([obs.valid for obs in ticks]))
    observation = torch.cat([obs.observation for obs in ticks])[valid]
    truth = torch.cat([obs.truth for obs in ticks])[valid]
    return float((predict(observation) - truth[:, :2]).double().norm(dim=1).mean())
