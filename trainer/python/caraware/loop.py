"""The training loop: ticks in, predictions out, an update whenever a horizon is full."""

import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np
import torch
from torch import Tensor

from caraware.checkpoint import Counters, load_checkpoint, save_checkpoint
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
        self._newest = committed_tick

    def first_sight(self, tick: int) -> bool:
        """Count `tick`; False if it came before."""
        if self._newest is not None:
            if tick <= self._newest:
                self.duplicated += 1
                return False
            self.lost += tick - self._newest - 1
        self.received += 1
        self._newest = tick
        return True


class TrainingLoop:
    """One run of the trainer over one channel."""

    def __init__(self, channel: Channel, config: RunConfig, stop_requested: Callable[[], bool]) -> None:
        self._channel, self._config, self._stop_requested = channel, config, stop_requested
        self._metrics = Metrics(config.run_dir / "tensorboard")
        self._ppo: Ppo | None = None
        self._env_steps = self._episode = self._vehicles = 0
        self._committed_tick = self._saved_updates = -1
        self._meter = ErrorMeter()
        self._evaluation: Evaluation | None = None

    def run(self) -> None:
        """Train until the last tick or a request to stop; then commit, plot and write `parts/trainer.json`."""
        ended = False
        while not ended and not self._stop_requested():
            ticks = self._channel.receive(RECEIVE_TIMEOUT_S)
            if ticks:
                self._ensure_started(ticks[0])
                self._consume(ticks)
                ended = ticks[-1].last
        self._finish_evaluation()
        if self._ppo is not None and self._ppo.updates != self._saved_updates:
            self._commit()
        self._metrics.close()
        self._draw()
        self._write_part()
        if ended:
            self._channel.done()
        log.info("%s after %d updates", "run complete" if ended else "stopped", self._updates())

    def _ensure_started(self, first: Observation) -> None:
        """The first tick tells the size of the observation, which the networks need."""
        if self._ppo is not None:
            return
        trainer = self._config.trainer
        size = first.observation.shape[1]
        self._ppo = Ppo(trainer, size, self._config.bounds)
        if self._config.resume_from is not None:
            counters = load_checkpoint(self._config.resume_from, self._ppo)
            self._env_steps, self._episode = counters.env_steps, counters.episode
            self._committed_tick, self._saved_updates = counters.committed_tick, counters.updates
        self._ledger = TickLedger(self._committed_tick if self._committed_tick >= 0 else None)
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
            self._evaluation = self._evaluation or Evaluation(self._config.sensors)
            self._evaluation.add(obs, policy_m, raw_m)
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
            self._commit()

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
            self._metrics.evaluated(result)
            log.info("evaluation at %d env steps: %s", result.env_steps, result)

    def _commit(self) -> None:
        """Write a checkpoint of everything learnt so far."""
        assert self._ppo is not None
        folder = self._config.run_dir / "checkpoints"
        counters = Counters(self._updates(), self._trained_steps(), self._episode, self._committed_tick)
        kept = self._config.trainer.checkpoints_kept
        written = save_checkpoint(folder, self._ppo, counters, self._config.config_sha256, kept)
        self._saved_updates = counters.updates
        self._channel.committed(counters.committed_tick)
        log.info("checkpoint %s, learnt up to tick %d", written.name, counters.committed_tick)

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
