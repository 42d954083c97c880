"""The training loop of the learned estimator: one environment, one update at the end of every training episode."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from caraware.fusion.carrier import Carried
from caraware.fusion.estimating import Estimating
from caraware.fusion.learner import FusionLearner, FusionStats
from caraware.fusion.past import Episode
from caraware.ipc.stream import Channel, Observation
from caraware.learn import rewards
from caraware.learn.ppo import NonFiniteLoss
from caraware.learn.stored import FUSION
from caraware.report.evaluation import Evaluation, Mean
from caraware.report.metrics import Metrics, TrainingPoint
from caraware.run.checkpoint import Keeping, TrainingHistory, load_checkpoint, load_history, save_checkpoint
from caraware.run.config import RunConfig
from caraware.run.continuation import Continuation
from caraware.run.manifest import Counters
from caraware.run.report_part import write_part
from caraware.run.sample_count import SampleCount
from caraware.run.stream_position import StreamProgress
from caraware.tasks.metrics import reference_names

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT_S = 0.2


@dataclass(frozen=True)
class Beginning:
    """How far training has come when a process begins."""

    counters: Counters = field(default_factory=lambda: Counters(0, 0, 0, -1))
    """The committed tick is always the last of an episode, unless another learner has committed it."""
    history: TrainingHistory = field(default_factory=TrainingHistory)

    @classmethod
    def load(cls, checkpoint: Path, learner: FusionLearner) -> "Beginning":
        """Continue `learner` from a checkpoint, with the episodes of its run. Raises `CheckpointError`."""
        counters = load_checkpoint(checkpoint, learner)
        learner.past.load(checkpoint.parents[1], counters.updates)
        return cls(counters, load_history(checkpoint))

    def follow(self, continuation: Continuation, learner: FusionLearner) -> "Beginning":
        """Continue where other learners have come since."""
        counters, history = continuation.follow(self.counters, self.history)
        learner.updates = counters.updates
        return Beginning(counters, history)


@dataclass
class Recording:
    """Rows of the episode so far, copied."""

    tables: list[Tensor] = field(default_factory=list)
    truths_m: list[Tensor] = field(default_factory=list)
    valid: list[Tensor] = field(default_factory=list)

    def add(self, table: Tensor, truth_m: Tensor, valid: Tensor) -> None:
        """One tick."""
        self.tables.append(table)
        self.truths_m.append(truth_m)
        self.valid.append(valid)

    def episode(self) -> Episode:
        """The whole episode; a slot that appeared later is empty before."""
        slots = max(len(valid) for valid in self.valid)

        def stacked(rows: list[Tensor]) -> Tensor:
            return torch.stack([torch.cat((r, r.new_zeros(slots - len(r), *r.shape[1:]))) for r in rows])

        return Episode(stacked(self.tables), stacked(self.truths_m), stacked(self.valid))


class FusionLoop:
    """One run of this trainer over one channel."""

    def __init__(
        self,
        channel: Channel,
        config: RunConfig,
        learner: FusionLearner,
        beginning: Beginning,
        stop_requested: Callable[[], bool],
        leave_requested: Callable[[], bool] = lambda: False,
        leave_now_requested: Callable[[], bool] = lambda: False,
    ) -> None:
        """Continue from `beginning`. A request to leave is met where an episode ends, or in an evaluation.

        It is met at once where no tick comes, and where it is to be met now.
        """
        assert config.sensors is not None
        self._channel, self._config, self._learner = channel, config, learner
        self._stop_requested, self._leave_requested = stop_requested, leave_requested
        self._leave_now_requested = leave_now_requested
        self._estimating = Estimating(learner, learner.carrier(config.sensors))
        counters, history = beginning.counters, beginning.history
        self._samples, self._trained_steps = SampleCount(counters.env_steps), counters.env_steps
        self._stream, self._episode = StreamProgress(history.first_position(counters)), counters.episode
        self._metrics = Metrics(config.run_dir / "tensorboard", config.task.metrics)
        if counters.updates > 0:
            self._metrics.resume(history.training, history.evaluations, counters.env_steps)
        self._saved_updates = counters.updates
        self._recording = Recording()
        self._headline, self._of_policy = config.task.metrics[0], Mean()
        self._evaluation: Evaluation | None = None
        self._evaluation_tick = -1
        self._seeds_m: list[dict[str, float]] = []
        self._vehicles = history.vehicles
        self._reward = rewards.REWARDS[config.trainer.reward]
        self._left = self._ended = False

    def run(self) -> bool:
        """Until the last tick or a request to stop. False if it left to a successor instead, after a commit."""
        while not (self._ended or self._left or self._stop_requested()):
            ticks = self._channel.receive(RECEIVE_TIMEOUT_S)
            self._left = self._leave_now_requested() or (not ticks and self._leave_requested())
            for obs in () if self._left else ticks:
                if self._stream.ledger.first_sight(obs.tick):
                    self._process(obs)
                self._channel.consumed(obs.tick)
                self._ended = obs.last and not self._left
                if self._left:
                    break
        if not self._left:
            self._finish_evaluation()
        if self._learner.updates != self._saved_updates:
            self.commit()
        self._metrics.close()
        if self._left:
            return False
        if self._config.trainer.plots:
            self._draw()
        self._write_part()
        if self._ended:
            self._channel.done()
        log.info("%s after %d updates", "run complete" if self._ended else "stopped", self._learner.updates)
        return True

    def _draw(self) -> None:
        # Loaded here: matplotlib takes a fifth of the time in which a trainer starts.
        from caraware.report.plots import plot_headline

        folder = self._config.run_dir / "plots"
        plot_headline(folder, self._headline, self._metrics.training, self._metrics.evaluations)

    def _process(self, obs: Observation) -> None:
        """Publish the estimate of one tick; only then read its truth, to evaluate or to record it."""
        estimate_m, table = self._estimating.step(obs)
        self._channel.publish_predictions(obs, estimate_m, self._learner.updates)
        task, headline = self._config.task, self._headline
        policy = task.measure_answers(obs, estimate_m)[headline.name]
        references = {name: ticks[0] for name, ticks in task.measure_references([obs]).items()}
        self._vehicles = max(self._vehicles, len(policy))
        self._stream.starts.note(obs)
        if obs.evaluation:
            # A predecessor may have evaluated ticks that it had not learned up to.
            if obs.tick > self._stream.evaluated_tick:
                self._evaluation = self._evaluation or Evaluation(
                    headline.name, self._config.sensors, lanes=self._config.lanes()
                )
                of_references = {key: references[name] for key, name in reference_names(headline).items()}
                self._evaluation.add(obs, {"ppo": policy, **of_references})
                self._evaluation_tick = obs.tick
            self._left = self._leave_requested()
            return
        self._finish_evaluation()
        self._of_policy.add(policy)
        self._samples.add(len(policy), references, learns=True)
        truth_m = torch.from_numpy(np.asarray(obs.truth)[:, :2].astype(np.float32)) - self._learner.estimator.centre_m
        counts = torch.from_numpy(np.array(obs.valid)).float() * (Carried.of(table).running[:, 0] > 0)
        self._recording.add(table, truth_m, counts)
        if obs.episode_last:
            self._learn(obs)
            self._left = self._leave_requested()

    def _learn(self, obs: Observation) -> None:
        """Learn from the episode that ends with this tick."""
        episode, self._recording = self._recording.episode(), Recording()
        if not episode.valid.any():
            log.warning(
                "episode %d had no tick that counts, and nothing is learned from it: its vehicles came too late for "
                "their filters to begin",
                obs.episode,
            )
            return
        try:
            stats = self._learner.learn(episode, self._config.progress(obs.episode), self._stop_requested)
        except NonFiniteLoss as error:
            error.batch_file = self._config.run_dir / "logs" / f"nonfinite-update-{error.update:06d}.safetensors"
            error.batch_file.parent.mkdir(parents=True, exist_ok=True)
            save_file(vars(episode), error.batch_file)
            raise
        self._trained_steps, self._episode = self._samples.env_steps, obs.episode
        self._stream.committed_tick = obs.tick
        self._record(stats, obs.episode)
        if self._learner.updates % self._config.trainer.checkpoint_interval_updates == 0:
            self.commit()

    def _record(self, stats: FusionStats, episode: int) -> None:
        rate, references = self._samples.since_last_update()
        error_m, self._of_policy = self._of_policy.value(), Mean()
        reward = float(self._reward(torch.tensor(error_m), self._config.trainer.reward_scale_m))
        metrics = {self._headline.name: error_m, **references}
        point = TrainingPoint(self._samples.env_steps, 0.0, reward, metrics, rate)
        self._metrics.updated(point, stats, tick=self._stream.committed_tick)
        self._channel.report(
            episode=episode,
            env_steps=self._samples.env_steps,
            env_steps_per_s=rate,
            policy_std=0.0,
            reward=reward,
            metrics=metrics,
            updates=self._learner.updates,
        )

    def _finish_evaluation(self) -> None:
        """Close the evaluation phase, if one is open."""
        evaluation, self._evaluation = self._evaluation, None
        result = evaluation.result(self._samples.env_steps, self._learner.updates) if evaluation else None
        if evaluation is not None and result is not None:
            self._stream.evaluated_tick = self._evaluation_tick
            self._metrics.evaluated(result)
            self._seeds_m = evaluation.seed_means()
            log.info("evaluation at %d env steps: %s", result.env_steps, result)

    def commit(self) -> None:
        """Write a checkpoint of everything learned so far."""
        position = self._stream.position()
        counters = Counters(
            updates=self._learner.updates,
            env_steps=self._trained_steps,
            episode=self._episode,
            committed_tick=position.committed_tick,
            next_episode=position.next_episode,
            next_episode_tick=position.next_episode_tick,
        )
        history = TrainingHistory.of(
            position, vehicles=self._vehicles, evaluations=self._metrics.evaluations, training=self._metrics.training
        )
        folder, keep = self._config.run_dir / "checkpoints", Keeping.of(self._config.trainer)
        written = save_checkpoint(
            folder,
            self._learner,
            counters,
            self._config.config_sha256,
            keep,
            history,
            stop_requested=self._stop_requested,
        )
        self._config.commits.record(FUSION, {0: position.committed()}, self._stop_requested)
        self._saved_updates = self._learner.updates
        if position.committed_tick >= 0:
            self._channel.committed(position.committed_tick)
        self._learner.past.tidy()
        log.info("checkpoint %s, learned up to tick %d", written.name, position.committed_tick)

    def _write_part(self) -> None:
        """The trainer's part of the run's report."""
        ledger = self._stream.ledger
        entries = {
            "env_steps": self._samples.env_steps,
            "policy_std": 0.0,
            "updates": self._learner.updates,
            "vehicles": self._vehicles,
            "received_ticks": ledger.received,
            "lost_ticks": ledger.lost,
            "duplicated_ticks": ledger.duplicated,
            "untrained_env_steps": self._samples.env_steps - self._trained_steps,
            "seeds_m": self._seeds_m,
        }
        phases, headline = self._metrics.evaluations, self._headline.name
        write_part(self._config.run_dir, entries, phases, headline, self._stop_requested)
