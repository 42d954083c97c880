"""`python -m caraware.fusion.train RUN_FILE`: the trainer process of the preset `fusion`.

The estimator runs on every tick as it comes, in training as in evaluations, and learns at the end of every training
episode. There nothing is carried on: all vehicles begin anew. So a checkpoint needs no state of filters, and whoever
continues from it gives the same bytes. The handover between processes: `caraware.run.process`.
"""

import json
import logging
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from caraware.fusion.carrier import COLUMNS, Carried, Carrier
from caraware.fusion.learner import Episode, FusionConfig, FusionLearner, FusionStats
from caraware.fusion.store import Progress, load_fusion, newest_sound, save_fusion
from caraware.ipc.run_file import RunFile
from caraware.ipc.stream import Channel, Observation
from caraware.learn import rewards
from caraware.learn.config import ConfigError
from caraware.learn.ppo import NonFiniteLoss
from caraware.report.evaluation import NO_HEADLINE, Evaluation, Mean, errors_m
from caraware.report.metrics import Metrics, TrainingPoint
from caraware.report.plots import plot_error
from caraware.run.config import RunConfig
from caraware.run.environment import TickLedger
from caraware.run.process import HandoverRole, StopSignal, read_run, run_process

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT_S = 0.2


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
        """All of it, slots that came later empty before."""
        slots = max(len(valid) for valid in self.valid)

        def stacked(rows: list[Tensor]) -> Tensor:
            return torch.stack([torch.cat((r, r.new_zeros(slots - len(r), *r.shape[1:]))) for r in rows])

        return Episode(stacked(self.tables), stacked(self.truths_m), stacked(self.valid))


class Estimating:
    """The estimator on a stream: causal, tick by tick."""

    def __init__(self, learner: FusionLearner, carrier: Carrier) -> None:
        self._learner, self._carrier = learner, carrier
        self._episode: int | None = None

    @torch.no_grad()
    def step(self, obs: Observation) -> tuple[Tensor, Tensor]:
        """Estimates `[n, 2]` (m, world), and the carrier's rows `[n, COLUMNS]`; of slots with no filter, the fix."""
        estimator = self._learner.estimator
        if obs.episode != self._episode:
            self._carrier.reset()
            self._state, self._episode = estimator.begin(0), obs.episode
        table = self._carrier.step(obs)
        missing = len(table) - len(self._state.hidden)
        if missing > 0:
            fresh = estimator.begin(missing)
            self._state = replace(
                self._state,
                offset_m=torch.cat((self._state.offset_m, fresh.offset_m)),
                hidden=torch.cat((self._state.hidden, fresh.hidden)),
            )
        carried = Carried.of(table)
        self._state = estimator.step(estimator.prepare(carried), self._state)
        estimate_m = carried.filter_m + self._state.offset_m + estimator.centre_m
        fix_m = torch.from_numpy(np.nan_to_num(np.asarray(obs.gnss_m)[:, :2].astype(np.float32)))
        return torch.where(carried.running > 0, estimate_m, fix_m), table


class FusionLoop:
    """One run of this trainer over one channel."""

    def __init__(
        self,
        channel: Channel,
        config: RunConfig,
        learner: FusionLearner,
        progress: Progress,
        stop_requested: Callable[[], bool],
        leave_requested: Callable[[], bool] = lambda: False,
    ) -> None:
        """Go on where `progress` stands. A request to leave is met where an episode ends, or in an evaluation."""
        assert config.sensors is not None
        self._channel, self._config, self._learner = channel, config, learner
        self._stop_requested, self._leave_requested = stop_requested, leave_requested
        centre_x_m, centre_y_m = learner.estimator.centre_m.tolist()
        self._estimating = Estimating(learner, Carrier(config.sensors, (centre_x_m, centre_y_m)))
        self._progress = progress
        self._env_steps = progress.env_steps
        self._ledger = TickLedger(progress.committed_tick if progress.committed_tick >= 0 else None)
        self._metrics = Metrics(config.run_dir / "tensorboard")
        if progress.updates > 0:
            self._metrics.resume(progress.training, progress.evaluations, progress.env_steps)
        self._saved_updates = progress.updates
        self._recording = Recording()
        self._error_m, self._raw_gnss_error_m = Mean(), Mean()
        self._evaluation: Evaluation | None = None
        self._evaluation_tick = -1
        self._seeds_m: list[dict[str, float]] = []
        self._vehicles = progress.vehicles
        self._reward = rewards.by_name(config.trainer.reward)
        self._left = self._ended = False
        self._clock = (time.monotonic(), self._env_steps)

    def run(self) -> bool:
        """Until the last tick or a request to stop. False if it left to a successor instead, after a commit."""
        while not (self._ended or self._left or self._stop_requested()):
            for obs in self._channel.receive(RECEIVE_TIMEOUT_S):
                if self._ledger.first_sight(obs.tick):
                    self._take(obs)
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
        plot_error(self._config.run_dir / "plots" / "error.png", self._metrics.training, self._metrics.evaluations)
        self._write_part()
        if self._ended:
            self._channel.done()
        log.info("%s after %d updates", "run complete" if self._ended else "stopped", self._learner.updates)
        return True

    def _take(self, obs: Observation) -> None:
        """Everything that one tick causes. The truth comes in after the estimate has gone out."""
        estimate_m, table = self._estimating.step(obs)
        self._channel.publish_predictions(obs, estimate_m, self._learner.updates)
        policy_m, raw_m = errors_m(obs, estimate_m)
        self._vehicles = max(self._vehicles, len(policy_m))
        if obs.evaluation:
            # A predecessor may have evaluated ticks that it had not learnt up to.
            if obs.tick > self._progress.evaluated_tick:
                self._evaluation = self._evaluation or Evaluation(self._config.sensors)
                self._evaluation.add(obs, policy_m, raw_m)
                self._evaluation_tick = obs.tick
            self._left = self._leave_requested()
            return
        self._finish_evaluation()
        self._error_m.add(policy_m)
        self._raw_gnss_error_m.add(raw_m)
        self._env_steps += len(policy_m)
        truth_m = torch.from_numpy(np.asarray(obs.truth)[:, :2].astype(np.float32)) - self._learner.estimator.centre_m
        counts = torch.from_numpy(np.array(obs.valid)).float() * (Carried.of(table).running[:, 0] > 0)
        self._recording.add(table, truth_m, counts)
        if obs.episode_last:
            self._learn(obs)
            self._left = self._leave_requested()

    def _learn(self, obs: Observation) -> None:
        """From the episode that ends here."""
        episode, self._recording = self._recording.episode(), Recording()
        try:
            stats = self._learner.learn(episode, self._config.progress(obs.episode))
        except NonFiniteLoss as error:
            error.batch_file = self._config.run_dir / "logs" / f"nonfinite-update-{error.update:06d}.safetensors"
            error.batch_file.parent.mkdir(parents=True, exist_ok=True)
            save_file(vars(episode), error.batch_file)
            raise
        self._progress = replace(
            self._progress,
            updates=self._learner.updates,
            env_steps=self._env_steps,
            episode=obs.episode,
            committed_tick=obs.tick,
            vehicles=self._vehicles,
        )
        self._record(stats, obs.episode)
        if self._learner.updates % self._config.trainer.checkpoint_interval_updates == 0:
            self.commit()

    def _record(self, stats: FusionStats, episode: int) -> None:
        error_m, raw_m = self._error_m.value(), self._raw_gnss_error_m.value()
        self._error_m, self._raw_gnss_error_m = Mean(), Mean()
        now, (since, steps) = time.monotonic(), self._clock
        self._clock = (now, self._env_steps)
        rate = (self._env_steps - steps) / max(now - since, 1e-9)
        reward = float(self._reward(torch.tensor(error_m), self._config.trainer.reward_scale_m))
        self._metrics.updated(TrainingPoint(self._env_steps, 0.0, reward, error_m, raw_m, rate), stats)
        self._channel.report(
            episode=episode,
            env_steps=self._env_steps,
            env_steps_per_s=rate,
            policy_std=0.0,
            reward=reward,
            metrics={"error_m": error_m, "raw_gnss_error_m": raw_m},
            updates=self._learner.updates,
        )

    def _finish_evaluation(self) -> None:
        """Close the evaluation phase, if one is open."""
        evaluation, self._evaluation = self._evaluation, None
        result = evaluation.result(self._env_steps, self._learner.updates) if evaluation else None
        if evaluation is not None and result is not None:
            self._progress = replace(self._progress, evaluated_tick=self._evaluation_tick)
            self._metrics.evaluated(result)
            self._seeds_m = evaluation.seeds_m()
            log.info("evaluation at %d env steps: %s", result.env_steps, result)

    def commit(self) -> None:
        """Write a checkpoint of everything learnt so far."""
        told = replace(
            self._progress,
            updates=self._learner.updates,
            training=self._metrics.training,
            evaluations=self._metrics.evaluations,
        )
        folder = self._config.run_dir / "checkpoints"
        written = save_fusion(folder, self._learner, told, self._config.trainer.checkpoints_kept)
        self._saved_updates = self._learner.updates
        if told.committed_tick >= 0:
            self._channel.committed(told.committed_tick)
        log.info("checkpoint %s, learnt up to tick %d", written.name, told.committed_tick)

    def _write_part(self) -> None:
        """The trainer's part of the run's report. The headline errors are the last evaluation's."""
        final = self._metrics.evaluations[-1] if self._metrics.evaluations else None
        part = {
            "env_steps": self._env_steps,
            **(final.headline() if final else NO_HEADLINE),
            "rts_note": "the smoother sees the future: a bound, not an estimator",
            "policy_std": 0.0,
            "updates": self._learner.updates,
            "vehicles": self._vehicles,
            "received_ticks": self._ledger.received,
            "lost_ticks": self._ledger.lost,
            "duplicated_ticks": self._ledger.duplicated,
            "untrained_env_steps": self._env_steps - self._progress.env_steps,
            "seeds_m": self._seeds_m,
            "evaluations": [asdict(result) for result in self._metrics.evaluations],
        }
        file = self._config.run_dir / "parts" / "trainer.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(part, indent=2) + "\n")


def begin(run: RunFile, resume_from: Path | None) -> tuple[RunConfig, FusionLearner, Progress]:
    """The learner of a run file, new or continued. Raises `ConfigError` and `CheckpointError`."""
    config, fusion = RunConfig.from_run(run), FusionConfig.from_run(run)
    if len(config.environments) > 1:
        raise ConfigError(
            f"`caraware.fusion.train` learns from one environment, the run has {len(config.environments)}",
            "start it without --envs",
        )
    if config.sensors is None:
        raise ConfigError("the run file has no sensor tables", "start the trainer through `caraware train fusion`")
    learner = FusionLearner(config.trainer, fusion, fusion.pieces(run), config.bounds)
    checkpoint = resume_from or config.resume_from
    return config, learner, load_fusion(checkpoint, learner) if checkpoint else Progress()


def work(run_file: Path, stop: StopSignal, role: HandoverRole) -> None:
    """Train the estimator of one run file."""
    run = read_run(run_file)
    from caraware.ipc.channel import Channel as SharedChannel

    folder = Path(run["run_dir"]) / "checkpoints"
    if role.gets_ready:
        # Whatever could be wrong with the settings or the checkpoint shows here, while the predecessor is at work.
        begin(run, role.checkpoint or newest_sound(folder))
        if not role.wait_for_turn():
            return
    config, learner, progress = begin(run, newest_sound(folder) if role.replaces else None)
    if role.checkpoint is not None:
        updates = learner.updates
        load_fusion(role.checkpoint, learner)
        learner.updates = updates
    log.info("%d columns, %s, %s", COLUMNS, config.trainer, learner.fusion)
    channel = SharedChannel(str(run_file), progress.committed_tick + 1)
    loop = FusionLoop(channel, config, learner, progress, lambda: stop.requested, lambda: stop.leave_requested)
    if role.checkpoint is not None:
        loop.commit()
    if not loop.run():
        logging.shutdown()
        os._exit(0)


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], work))
