"""The training loop: ticks in, predictions out, an update whenever a horizon is full."""

import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caraware.checkpoint import Counters, Course, load_checkpoint, load_course, save_checkpoint
from caraware.config import RunConfig
from caraware.evaluation import NO_HEADLINE, ErrorMeter, Evaluation, EvaluationResult, errors_m
from caraware.metrics import Metrics, TrainingPoint
from caraware.plots import plot_error, plot_sigma
from caraware.ppo import NonFiniteLoss, Ppo, UpdateStats, save_batch
from caraware.rollout import Rollout
from caraware.stream import Channel, Observation

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT_S = 0.2
"""How long a request to stop may wait for the next tick."""


class TickLedger:
    """Counts the ticks that came, those that did not, and those that came twice."""

    def __init__(self, committed_tick: int | None) -> None:
        """`committed_tick` is the newest that a resumed run has learnt from; without, the first tick is any."""
        self.received = self.lost = self.duplicated = 0
        self.newest = committed_tick

    def first_sight(self, tick: int) -> bool:
        """Count `tick`; False if it came before."""
        if self.newest is not None:
            if tick <= self.newest:
                self.duplicated += 1
                return False
            self.lost += tick - self.newest - 1
        self.received += 1
        self.newest = tick
        return True


@dataclass
class Learner:
    """Policy, value network and how far they have come: new, or continued from a checkpoint."""

    ppo: Ppo
    counters: Counters
    course: Course

    @classmethod
    def begin(cls, config: RunConfig, observation_size: int) -> "Learner":
        """A learner for observations of this size, continued from `config.resume_from`. Raises `CheckpointError`."""
        ppo = Ppo(config.trainer, observation_size, config.bounds)
        learner = cls(ppo, Counters(0, 0, 0, -1), Course())
        if config.resume_from is not None:
            learner.load(config.resume_from)
        return learner

    def load(self, checkpoint: Path) -> None:
        """Continue from a checkpoint. Raises `CheckpointError`."""
        self.counters, self.course = load_checkpoint(checkpoint, self.ppo), load_course(checkpoint)

    def take_parameters(self, checkpoint: Path) -> None:
        """Parameters, moments and generators of any checkpoint; the count of updates and ticks stays this run's."""
        updates = self.ppo.updates
        load_checkpoint(checkpoint, self.ppo)
        self.ppo.updates = updates

    def first_tick(self) -> int:
        """The first tick that is not in the checkpoint."""
        return self.counters.committed_tick + 1


class TrainingLoop:
    """One run of the trainer over one channel."""

    def __init__(
        self,
        channel: Channel,
        config: RunConfig,
        stop_requested: Callable[[], bool],
        *,
        leave_requested: Callable[[], bool] = lambda: False,
        learner: Learner | None = None,
    ) -> None:
        """Without a `learner`, one begins at the first tick. A request to leave is met where a successor can go on."""
        self._channel, self._config, self._stop_requested = channel, config, stop_requested
        self._leave_requested, self._left = leave_requested, False
        self._metrics = Metrics(config.run_dir / "tensorboard")
        self._ppo: Ppo | None = None
        self._env_steps = self._episode = self._vehicles = 0
        self._committed_tick = self._saved_updates = -1
        self._meter = ErrorMeter()
        self._evaluation: Evaluation | None = None
        self._evaluation_tick = self._evaluated_tick = -1
        """Newest tick of the open evaluation phase, and of those that are finished."""
        if learner is not None:
            self._start(learner)

    def run(self) -> bool:
        """Train until the last tick or a request to stop; then commit, plot and write `parts/trainer.json`.

        False if it left to a successor instead, after a commit.
        """
        ended = False
        while not ended and not self._left and not self._stop_requested():
            ticks = self._channel.receive(RECEIVE_TIMEOUT_S)
            if ticks:
                self._ensure_started(ticks[0])
                self._consume(ticks)
                ended = ticks[-1].last and not self._left
        if self._left:
            self._leave()
            return False
        self._finish_evaluation()
        if self._ppo is not None and self._ppo.updates != self._saved_updates:
            self.commit()
        self._metrics.close()
        self._draw()
        self._write_part()
        if ended:
            self._channel.done()
        log.info("%s after %d updates", "run complete" if ended else "stopped", self._updates())
        return True

    def _ensure_started(self, first: Observation) -> None:
        """The first tick tells the size of the observation, which the networks need."""
        if self._ppo is None:
            self._start(Learner.begin(self._config, first.observation.shape[1]))

    def _start(self, learner: Learner) -> None:
        """Go on where `learner` stands."""
        trainer, counters, course = self._config.trainer, learner.counters, learner.course
        self._ppo = learner.ppo
        size = self._ppo.observation_size
        self._env_steps, self._episode = counters.env_steps, counters.episode
        self._committed_tick = counters.committed_tick
        self._vehicles, self._evaluated_tick = course.vehicles, course.evaluated_tick
        self._ledger = TickLedger(self._committed_tick if self._committed_tick >= 0 else None)
        self._ledger.received, self._ledger.lost = course.received_ticks, course.lost_ticks
        self._ledger.duplicated = course.duplicated_ticks
        if counters.updates > 0:
            self._saved_updates = counters.updates
            self._metrics.resume(course.training, course.evaluations, counters.env_steps)
        self._rollout = Rollout(
            trainer.horizon, size, bootstrap=trainer.discount > 0, dark_is_nan=self._config.dark_is_nan
        )
        self._sample_clock = (time.monotonic(), self._env_steps)
        log.info("observations of %d fields, %s", size, self._config.trainer)

    def _consume(self, ticks: Sequence[Observation]) -> None:
        """Predict for all waiting ticks at once; anew for what is left whenever an update changed the policy."""
        assert self._ppo is not None
        fresh = [obs for obs in ticks if self._ledger.first_sight(obs.tick)]
        if not fresh:
            self._channel.consumed(ticks[-1].tick)
        while fresh:
            predictions_m = self._ppo.predict_m([self._visible(obs) for obs in fresh])
            version, used = self._updates(), 0
            while used < len(fresh) and self._updates() == version:
                self._take(fresh[used], predictions_m[used])
                used += 1
                # What comes after an update, or in an evaluation, a successor can take up as well.
                if (self._updates() > version or fresh[used - 1].evaluation) and self._leave_requested():
                    self._left = True
                    return
            fresh = fresh[used:]

    def _visible(self, obs: Observation) -> Tensor:
        """The observation as the networks take it: in place, unless fields of dark sensors must become numbers."""
        return torch.nan_to_num(obs.observation) if self._config.dark_is_nan else obs.observation

    def _take(self, obs: Observation, predicted_m: Tensor) -> None:
        """Everything that one tick causes."""
        self._channel.publish_predictions(obs, predicted_m, self._updates())
        policy_m, raw_m = errors_m(obs, predicted_m)
        self._episode = obs.episode
        self._vehicles = max(self._vehicles, int(np.count_nonzero(obs.valid)))
        if obs.evaluation:
            self._rollout.ended(obs)
            # A predecessor may have evaluated ticks that it had not learnt up to.
            if obs.tick > self._evaluated_tick:
                self._evaluation = self._evaluation or Evaluation(self._config.sensors)
                self._evaluation.add(obs, policy_m, raw_m)
                self._evaluation_tick = obs.tick
            self._channel.consumed(obs.tick)
            return
        self._finish_evaluation()
        self._meter.add(policy_m, raw_m)
        self._env_steps += len(policy_m)
        self._rollout.add(obs)
        self._channel.consumed(obs.tick)
        if self._rollout.full():
            self._learn()

    def _learn(self) -> None:
        """One update, while the simulation already makes the next ticks."""
        assert self._ppo is not None
        horizon = self._rollout.take()
        batch = self._ppo.score(horizon)
        self._ppo.progress = self._config.progress(self._episode)
        try:
            stats = self._ppo.update(batch)
        except NonFiniteLoss as error:
            error.batch_file = self._config.run_dir / "logs" / f"nonfinite-update-{error.update:06d}.safetensors"
            save_batch(batch, self._ppo.policy.mlp.parameters, error.batch_file)
            raise
        self._committed_tick = horizon.last_tick()
        self._record(stats)
        if self._ppo.updates % self._config.trainer.checkpoint_interval_updates == 0:
            self.commit()

    def _record(self, stats: UpdateStats) -> None:
        error_m, raw_gnss_error_m = self._meter.means_m()
        self._meter = ErrorMeter()
        now, (since, steps) = time.monotonic(), self._sample_clock
        self._sample_clock = (now, self._env_steps)
        rate = (self._env_steps - steps) / max(now - since, 1e-9)
        point = TrainingPoint(self._env_steps, stats.sigma, stats.reward_mean, error_m, raw_gnss_error_m, rate)
        self._metrics.updated(point, stats)
        self._channel.report(
            episode=self._episode,
            env_steps=self._env_steps,
            env_steps_per_s=rate,
            policy_std=stats.sigma,
            reward=stats.reward_mean,
            error_m=error_m,
            raw_gnss_error_m=raw_gnss_error_m,
            updates=self._updates(),
        )

    def _finish_evaluation(self) -> None:
        """Close the evaluation phase, if one is open."""
        result = self._evaluation.result(self._env_steps, self._updates()) if self._evaluation else None
        self._evaluation = None
        if result is not None:
            self._evaluated_tick = self._evaluation_tick
            self._metrics.evaluated(result)
            log.info("evaluation at %d env steps: %s", result.env_steps, result)

    def commit(self) -> None:
        """Write a checkpoint of everything learnt so far."""
        assert self._ppo is not None
        folder = self._config.run_dir / "checkpoints"
        counters = Counters(self._updates(), self._trained_steps(), self._episode, self._committed_tick)
        kept = self._config.trainer.checkpoints_kept
        written = save_checkpoint(folder, self._ppo, counters, self._config.config_sha256, kept, self._course())
        self._saved_updates = counters.updates
        if counters.committed_tick >= 0:
            self._channel.committed(counters.committed_tick)
        log.info("checkpoint %s, learnt up to tick %d", written.name, counters.committed_tick)

    def _course(self) -> Course:
        """How training went; ticks after the committed one do not count, they will be delivered again."""
        newest = self._ledger.newest
        beyond = 0 if newest is None else newest - self._committed_tick
        return Course(
            received_ticks=self._ledger.received - beyond,
            lost_ticks=self._ledger.lost,
            duplicated_ticks=self._ledger.duplicated,
            vehicles=self._vehicles,
            evaluated_tick=self._evaluated_tick,
            evaluations=self._metrics.evaluations,
            training=self._metrics.training,
        )

    def _leave(self) -> None:
        """Commit what is learnt and make room for a successor; it gets every tick since again."""
        if self._updates() > max(self._saved_updates, 0):
            self.commit()
        self._metrics.close()
        log.info("left to a successor after %d updates", self._updates())

    def _draw(self) -> None:
        folder = self._config.run_dir / "plots"
        plot_error(folder / "error.png", self._metrics.training, self._metrics.evaluations)
        plot_sigma(folder / "sigma.png", self._metrics.training)

    def _write_part(self) -> None:
        """The trainer's part of the run's report. The headline errors are the last evaluation's."""
        final: EvaluationResult | None = self._metrics.evaluations[-1] if self._metrics.evaluations else None
        part = {
            "env_steps": self._env_steps,
            **(final.headline() if final else NO_HEADLINE),
            "rts_note": "the smoother sees the future: a bound, not an estimator",
            "policy_std": self._ppo.sigma() if self._ppo else None,
            "updates": self._updates(),
            "vehicles": self._vehicles,
            "received_ticks": self._ledger.received if self._ppo else 0,
            "lost_ticks": self._ledger.lost if self._ppo else 0,
            "duplicated_ticks": self._ledger.duplicated if self._ppo else 0,
            "untrained_env_steps": self._env_steps - self._trained_steps(),
            "evaluations": [asdict(result) for result in self._metrics.evaluations],
        }
        file = self._config.run_dir / "parts" / "trainer.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(part, indent=2) + "\n")

    def _trained_steps(self) -> int:
        """Samples that an update has learnt from; the rest waits in the rollout."""
        return self._env_steps - self._rollout.pending_samples() if self._ppo else 0

    def _updates(self) -> int:
        return self._ppo.updates if self._ppo else 0
