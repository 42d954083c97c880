"""Playing a checkpoint: ticks in, predictions out, and the task's metric of policy, EKF and references by vehicle."""

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from caraware.baselines import Ekf
from caraware.baselines.samples import read_samples
from caraware.ipc.arrays import BoolArray, Float32Array, FloatArray, UInt32Array, UInt64Array
from caraware.ipc.names import Names
from caraware.ipc.report_part import write_entries
from caraware.ipc.run_file import RunFile
from caraware.ipc.storage import when_there_is_space
from caraware.ipc.stream import Channel, Observation
from caraware.learn.prediction import Predictor
from caraware.report.statistics import mean_interval
from caraware.run.config import RunConfig
from caraware.run.followed import FollowedTicks
from caraware.run.loop import RECEIVE_TIMEOUT_S
from caraware.run.trips import has_trips
from caraware.tasks.contract import Sampling
from caraware.tasks.ends import name_of
from caraware.tasks.localisation import Localisation
from caraware.tasks.metrics import interval_key, mean_key, reference_names

LIVE = "live.json"
"""File in the run's directory with the newest table."""
SHOW_EVERY_S = 0.5


@dataclass
class MetricSums:
    """Samples, and the sum of the metric over them by estimator."""

    samples: int = 0
    sums: dict[str, float] = field(default_factory=dict)

    def add(self, values: Mapping[str, FloatArray]) -> None:
        """Add the values `[v]` of some rows, by estimator."""
        self.samples += len(values["ppo"])
        for name, of_rows in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + float(of_rows.sum(dtype=np.float64))

    def mean(self, estimator: str) -> float | None:
        """Mean of an estimator; None without samples."""
        return self.sums[estimator] / self.samples if self.samples else None


@dataclass
class PlayTally:
    """Everything counted so far, up to and including `tick`; a successor continues from it."""

    tick: int = -1
    episode: int = 0
    sums: MetricSums = field(default_factory=MetricSums)
    running: MetricSums = field(default_factory=MetricSums)
    """Of the episode at work."""
    episodes: list[dict[str, float]] = field(default_factory=list)
    """Means of each whole episode by estimator: each had a seed of its own."""
    vehicles: int = 0
    """Most at a time."""
    ends: dict[str, int] = field(default_factory=dict)
    """How the trips of heroes ended, by the name of the end."""

    @classmethod
    def read(cls, file: Path) -> "PlayTally":
        """Of a predecessor; a new one if there is none."""
        try:
            raw = json.loads(file.read_text())["tally"]
        except (OSError, ValueError, KeyError):
            return cls()
        return cls(**raw | {"sums": MetricSums(**raw["sums"]), "running": MetricSums(**raw["running"])})

    def begin_episode(self, episode: int) -> None:
        """The ticks that follow belong to this episode."""
        self.running, self.episode = MetricSums(), episode

    def end_episode(self) -> None:
        """The episode at work is over."""
        samples = self.running.samples
        if samples:
            self.episodes.append({name: value / samples for name, value in self.running.sums.items()})


class Scoreboard:
    """The task's headline metric of policy, EKF and references, by vehicle: at this tick and over its time."""

    def __init__(self, run: RunFile, config: RunConfig, tally: PlayTally) -> None:
        assert config.sensors is not None
        self.tally = tally
        self._task, self.metric = config.task, config.task.metrics[0]
        self._references = reference_names(self.metric)
        # The filter estimates positions: it is compared where the metric is a position's error.
        self._filters = isinstance(self._task, Localisation)
        self.estimators = ("ppo", *(("ekf",) if self._filters else ()), *self._references)
        self._noise = config.sensors
        self._names = Names(run)
        self._ekf = Ekf(self._noise)
        self._of_vehicle: dict[int, tuple[str, MetricSums]] = {}
        self._now: dict[int, dict[str, float]] = {}
        self._sim_time_s = 0.0

    def add(self, obs: Observation, predicted_m: Tensor) -> None:
        """Count one tick."""
        if obs.episode != self.tally.episode or self.tally.tick < 0:
            self.tally.begin_episode(obs.episode)
            self._ekf, self._of_vehicle = Ekf(self._noise), {}
        if self._filters:
            self._ekf.step(read_samples(obs, self._noise.convention))
        values, rows = self._measured(obs, predicted_m), np.flatnonzero(obs.valid)
        self.tally.tick, self._sim_time_s = obs.tick, obs.sim_time_ns * 1e-9
        self.tally.vehicles = max(self.tally.vehicles, len(rows))
        self._count(values, obs.vehicle, obs.id_hash, obs.valid)
        if obs.episode_last:
            self.tally.end_episode()

    def _count(
        self, values: Mapping[str, FloatArray], vehicles: UInt32Array, id_hashes: UInt64Array, valid: BoolArray
    ) -> None:
        """Add the values `[v]` on the valid rows of a tick."""
        self.tally.sums.add(values)
        self.tally.running.add(values)
        self._now = {}
        for place, row in enumerate(np.flatnonzero(valid)):
            vehicle = int(vehicles[row])
            if vehicle not in self._of_vehicle:
                self._of_vehicle[vehicle] = (self._names.of(id_hashes[row]), MetricSums())
            self._of_vehicle[vehicle][1].add({name: of_rows[place : place + 1] for name, of_rows in values.items()})
            self._now[vehicle] = {name: float(of_rows[place]) for name, of_rows in values.items()}

    def _measured(self, obs: Observation, predicted_m: Tensor) -> dict[str, FloatArray]:
        """The metric on the valid rows of a tick, by estimator."""
        references = self._task.measure_references([obs])
        answers = {"ppo": predicted_m}
        if self._filters:
            answers["ekf"] = torch.from_numpy(self._ekf.position_m)
        measured = {name: self._task.measure_answers(obs, of)[self.metric.name] for name, of in answers.items()}
        return measured | {estimator: references[name][0] for estimator, name in self._references.items()}

    def metrics(self) -> dict[str, float]:
        """Means over the run by the metrics' names: of the policy and of the references."""
        mean, names = self.tally.sums.mean, {"ppo": self.metric.name} | self._references
        return {name: mean(estimator) or math.nan for estimator, name in names.items()}

    def estimates_m(self, obs: Observation) -> Float32Array | None:
        """f32 `[n, 2]`: the filter's positions at the tick added last, not-a-number where a row is not valid.

        None without a filter.
        """
        if not self._filters:
            return None
        position_m = np.asarray(self._ekf.position_m, dtype=np.float32)
        return np.where(np.asarray(obs.valid)[:, None], position_m, np.float32(np.nan))

    def table(self) -> dict[str, Any]:
        """What is shown: means over the run, and a row for each vehicle on the road."""
        tally = self.tally
        rows = [
            {
                "vehicle": self._of_vehicle[vehicle][0],
                "now": now,
                "mean": {name: self._of_vehicle[vehicle][1].mean(name) for name in self.estimators},
            }
            for vehicle, now in self._now.items()
        ]
        return {
            "metric": self.metric.name,
            "episode": tally.episode,
            "sim_time_s": self._sim_time_s,
            "samples": tally.sums.samples,
            "mean": {name: tally.sums.mean(name) for name in self.estimators},
            "vehicles": rows,
        }

    def write(self, file: Path) -> None:
        """Replace the file, from one moment to the next, without flushing it to disk. Raises `OSError`."""
        partial = file.with_name(f".{file.name}.partial")
        try:
            partial.write_text(json.dumps({"table": self.table(), "tally": asdict(self.tally)}))
            partial.rename(file)
        except OSError:
            partial.unlink(missing_ok=True)
            raise


class FollowedScoreboard(Scoreboard):
    """The headline metric of a policy whose world waits for it, measured a tick later; no filter runs beside it."""

    def __init__(self, run: RunFile, config: RunConfig, tally: PlayTally) -> None:
        super().__init__(run, config, tally)
        self.estimators = ("ppo",)
        self._followed = FollowedTicks(config.task)

    def add(self, obs: Observation, predicted_m: Tensor) -> None:
        """Count what the tick before led to."""
        if obs.episode != self.tally.episode or self.tally.tick < 0:
            self.tally.begin_episode(obs.episode)
            self._of_vehicle, self._now = {}, {}
        self.tally.tick, self._sim_time_s = obs.tick, obs.sim_time_ns * 1e-9
        self.tally.vehicles = max(self.tally.vehicles, int(np.count_nonzero(obs.valid)))
        for slot in np.flatnonzero(obs.terminated | obs.truncated):
            end = name_of(int(obs.ended_by[slot]))
            self.tally.ends[end] = self.tally.ends.get(end, 0) + 1
        if (past := self._followed.add(obs)) is not None:
            self._count({"ppo": past.metrics[self.metric.name]}, past.vehicle, past.id_hash, past.valid)
        if obs.episode_last:
            self.tally.end_episode()

    def estimates_m(self, obs: Observation) -> Float32Array | None:
        """None: there is no position to estimate."""
        return None


class PlayedPolicy(Protocol):
    """A trained policy: `Ppo`, or the learned estimator."""

    @property
    def updates(self) -> int:
        """Updates that it has learned from."""
        ...

    def sigma(self) -> float:
        """Standard deviation of the policy, mean over the actions; 1 is half the map."""
        ...

    def predictor(self, dark_is_nan: bool, evaluations_alone: bool = True) -> Predictor:
        """A predictor for the ticks of a stream as they come."""
        ...


class PlayLoop:
    """Ticks in, predictions out."""

    def __init__(
        self, channel: Channel, config: RunConfig, policy: PlayedPolicy, stop_requested: Callable[[], bool]
    ) -> None:
        self._channel, self._config, self._policy, self._stop_requested = channel, config, policy, stop_requested
        self._live = config.run_dir / LIVE
        self._waits = config.task.sampling is Sampling.EACH_TICK
        scoreboard = FollowedScoreboard if self._waits else Scoreboard
        self._board = scoreboard(channel.run, config, PlayTally.read(self._live))
        self._shown_at = -math.inf
        self._predictor = policy.predictor(config.dark_is_nan, evaluations_alone=False)

    def run(self) -> None:
        """Predict until the last tick or a request to stop; then write `parts/trainer.json`."""
        ended = False
        while not ended and not self._stop_requested():
            ticks = self._channel.receive(RECEIVE_TIMEOUT_S)
            if ticks:
                self._process(ticks)
                ended = ticks[-1].last
            if time.monotonic() - self._shown_at >= SHOW_EVERY_S:
                self._show()
        self._show()
        self._write_part()
        if ended:
            self._channel.done()

    def _process(self, ticks: Sequence[Observation]) -> None:
        """Predict, compare and publish; return the credit."""
        updates = self._policy.updates
        for obs, predicted_m in zip(ticks, self._predictor.predict_m({0: ticks})[0], strict=True):
            self._board.add(obs, predicted_m)
            if self._waits:
                # Sent again while no tick comes: a simulator that died may have lost them.
                self._channel.publish_actions(obs, predicted_m.detach().numpy(), updates)
                self._channel.consumed(obs.tick)
                continue
            self._channel.publish_predictions(obs, predicted_m, updates, self._board.estimates_m(obs))
            self._channel.consumed(obs.tick)

    def _show(self) -> None:
        """Write the file, once there is space on disk; the ticks in it need not be delivered again."""
        self._shown_at = time.monotonic()
        tally = self._board.tally
        if tally.tick < 0:
            return
        when_there_is_space(self._live, lambda: self._board.write(self._live), self._stop_requested)
        self._channel.committed(tally.tick)
        self._channel.report(
            episode=tally.episode,
            env_steps=tally.sums.samples,
            updates=self._policy.updates,
            policy_std=self._policy.sigma(),
            metrics=self._board.metrics(),
        )

    def _write_part(self) -> None:
        """The report's part: means over everything, with 95 % intervals over the episodes."""
        tally = self._board.tally
        part = {
            "env_steps": tally.sums.samples,
            "checkpoint": str(self._config.resume_from),
            "policy_std": self._policy.sigma(),
            "updates": self._policy.updates,
            "vehicles": tally.vehicles,
            "evaluation_seeds": len(tally.episodes),
            "episodes": tally.episodes,
        }
        if has_trips(self._config.task):
            part["trips"] = tally.ends
        metric = self._board.metric.name
        for name in self._board.estimators:
            part[mean_key(name, metric)] = tally.sums.mean(name)
            seeds = [episode[name] for episode in tally.episodes]
            part[interval_key(name, metric)] = mean_interval(seeds).half_width if len(seeds) > 1 else None
        write_entries(self._config.run_dir, part, self._stop_requested)
