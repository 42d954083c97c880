"""When and what a training run commits: its environments, on rank 0 those of all ranks, and the best policy."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict

from torch import Tensor

from caraware.learn.ranks import Ranks
from caraware.learn.stored import MEMORY, RANDOM, StoredTensors
from caraware.report.evaluation import EvaluationResult
from caraware.report.metrics import Metrics
from caraware.run.checkpoint import Keeping, TrainingHistory, mark_best, save_checkpoint
from caraware.run.config import RunConfig
from caraware.run.curriculum import Curriculum
from caraware.run.environment import Environment
from caraware.run.learner import Learner
from caraware.run.manifest import Counters, checkpoint_name
from caraware.run.stream_position import StreamPosition

log = logging.getLogger("caraware.run.loop")


class CheckpointWriter:
    """Writes the checkpoints of a run, then reports to the simulation up to which tick it may forget."""

    def __init__(
        self,
        config: RunConfig,
        ranks: Ranks,
        environments: Sequence[Environment],
        curriculum: Curriculum,
        metrics: Metrics,
        stop_requested: Callable[[], bool] = lambda: False,
    ) -> None:
        """A request to stop ends the wait for space on a full disk."""
        self._stop_requested = stop_requested
        self._config, self._ranks, self._environments = config, ranks, environments
        self._curriculum, self._metrics = curriculum, metrics
        self._folder, self._commits = config.run_dir / "checkpoints", config.commits
        self.saved_updates = -1
        """Updates in the newest checkpoint; -1 before the first."""

    def write(self, learner: Learner, trained_steps: int, episode: int, vehicles: int) -> None:
        """Commit everything learned so far, from `trained_steps` samples."""
        progress = self._environments[0].progress
        next_episode, next_episode_tick = progress.starts.after(progress.committed_tick)
        counters = Counters(
            learner.ppo.updates, trained_steps, episode, progress.committed_tick, next_episode, next_episode_tick
        )
        others, of_other_ranks = self._of_other_ranks(learner)
        history = self._history(vehicles, others)
        keep, config_sha256 = Keeping.of(self._config.trainer), self._config.config_sha256
        saved = save_checkpoint(
            self._folder, learner, counters, config_sha256, keep, history, of_other_ranks, self._stop_requested
        )
        log.info("checkpoint %s, learned up to tick %d", saved.name, progress.committed_tick)
        positions = [environment.progress.position().committed() for environment in self._environments]
        self._commits.record(learner.shape().learner, dict(enumerate(positions)), self._stop_requested)
        # Ticks may be forgotten when all ranks have written their checkpoints.
        self._ranks.gather(None)
        self.saved_updates = counters.updates
        for environment in self._environments:
            if environment.progress.committed_tick >= 0:
                environment.channel.committed(environment.progress.committed_tick)

    def is_best(self, result: EvaluationResult) -> bool:
        """Whether no policy evaluated before was better by the task's headline metric.

        Ranks would have to agree on it, and environments to have finished the same phase: only a run of one decides.
        """
        if self._ranks.size > 1 or len(self._environments) > 1 or result.policy_version == 0:
            return False
        evaluated = [other for other in self._metrics.evaluations if other.policy_version > 0]
        means = [mean for other in evaluated if (mean := other.mean("ppo")) is not None]
        best = max if self._config.task.metrics[0].higher_is_better else min
        return result.mean("ppo") == best(means)

    def mark_best(self, updates: int) -> None:
        """Let `best` name the checkpoint after so many updates."""
        mark_best(self._folder / checkpoint_name(updates), self._stop_requested)

    def _of_other_ranks(self, learner: Learner) -> tuple[list[StreamPosition], StoredTensors]:
        """Positions of the other ranks' environments, states of their random numbers, and what networks remember.

        A rank stores its own environments, from which it continues; rank 0's checkpoint is that of one trainer that
        has them all.
        """
        ppo = learner.ppo
        self._ranks.check_equal("the parameters", list(ppo.updater.parameters().values()))
        states = {name: generator.get_state() for name, generator in ppo.sampling_generators().items()}
        positions = [environment.progress.position() for environment in self._environments]
        of_all = self._ranks.gather([asdict(position) for position in positions])
        random = self._ranks.gather_tensors(states)
        memory = self._ranks.gather_tensors(ppo.memory_tensors())
        if self._ranks.rank > 0:
            return [], {}
        others = [StreamPosition(**position) for theirs in of_all[1:] for position in theirs]
        stored = {RANDOM: _united(random)} | ({MEMORY: _united(memory)} if any(memory) else {})
        return others, stored

    def _history(self, vehicles: int, of_other_ranks: list[StreamPosition]) -> TrainingHistory:
        """How training went, up to what the checkpoint contains."""
        first, *others = (environment.progress.position() for environment in self._environments)
        return TrainingHistory.of(
            first,
            vehicles=vehicles,
            curriculum=self._curriculum.saved(),
            evaluations=self._metrics.evaluations,
            training=self._metrics.training,
            others=[*others, *of_other_ranks],
        )


def _united(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """All tensors of all ranks, whose names differ."""
    return {name: tensor for part in parts for name, tensor in part.items()}
