"""Playing a checkpoint: ticks in, predictions out, and the errors of policy, EKF and raw fix for each vehicle."""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from caraware.baselines import Ekf
from caraware.baselines.samples import read_samples
from caraware.ipc.arrays import Float32Array, FloatArray
from caraware.ipc.names import Names
from caraware.ipc.run_file import RunFile
from caraware.ipc.stream import Channel, Observation
from caraware.learn.prediction import Predictor
from caraware.report.evaluation import errors_m
from caraware.report.statistics import mean_interval
from caraware.run.config import RunConfig
from caraware.run.loop import RECEIVE_TIMEOUT_S

LIVE = "live.json"
"""File in the run's directory with the newest table."""
SHOW_EVERY_S = 0.5
ESTIMATORS = ("ppo", "ekf", "raw_gnss")


@dataclass
class ErrorSums:
    """Samples, and the sum of each estimator's position error over them, in metres."""

    samples: int = 0
    error_m: dict[str, float] = field(default_factory=lambda: dict.fromkeys(ESTIMATORS, 0.0))

    def add(self, error_m: dict[str, FloatArray]) -> None:
        """Add the errors `[v]` of some rows."""
        self.samples += len(error_m["ppo"])
        for name, values in error_m.items():
            self.error_m[name] += float(values.sum(dtype=np.float64))

    def mean_m(self, name: str) -> float | None:
        """Mean error of an estimator; None without samples."""
        return self.error_m[name] / self.samples if self.samples else None


@dataclass
class PlayTally:
    """Everything counted so far, up to and including `tick`; a successor continues from it."""

    tick: int = -1
    episode: int = 0
    sums: ErrorSums = field(default_factory=ErrorSums)
    running: ErrorSums = field(default_factory=ErrorSums)
    """Of the episode at work."""
    episodes: list[dict[str, float]] = field(default_factory=list)
    """Mean errors of each whole episode: each had a seed of its own."""
    vehicles: int = 0
    """Most at a time."""

    @classmethod
    def read(cls, file: Path) -> "PlayTally":
        """Of a predecessor; a new one if there is none."""
        try:
            raw = json.loads(file.read_text())["tally"]
        except (OSError, ValueError, KeyError):
            return cls()
        return cls(**raw | {"sums": ErrorSums(**raw["sums"]), "running": ErrorSums(**raw["running"])})

    def begin_episode(self, episode: int) -> None:
        """The ticks that follow belong to this episode."""
        self.running, self.episode = ErrorSums(), episode

    def end_episode(self) -> None:
        """The episode at work is over."""
        if self.running.samples:
            self.episodes.append({name: self.running.error_m[name] / self.running.samples for name in ESTIMATORS})


class Scoreboard:
    """Position errors of policy, EKF and raw fix, of each vehicle at this tick and over its time on the road."""

    def __init__(self, run: RunFile, config: RunConfig, tally: PlayTally) -> None:
        assert config.sensors is not None
        self.tally = tally
        self._noise = config.sensors
        self._names = Names(run)
        self._ekf = Ekf(self._noise)
        self._of_vehicle: dict[int, tuple[str, ErrorSums]] = {}
        self._now: dict[int, dict[str, float]] = {}
        self._sim_time_s = 0.0

    def add(self, obs: Observation, predicted_m: Tensor) -> None:
        """Count one tick."""
        if obs.episode != self.tally.episode or self.tally.tick < 0:
            self.tally.begin_episode(obs.episode)
            self._ekf, self._of_vehicle = Ekf(self._noise), {}
        self._ekf.step(read_samples(obs, self._noise.convention))
        policy_m, raw_m = errors_m(obs, predicted_m)
        rows = np.flatnonzero(obs.valid)
        offset_m = self._ekf.position_m[rows] - np.asarray(obs.truth)[rows, :2]
        error_m: dict[str, FloatArray] = {"ppo": policy_m, "ekf": np.hypot(*offset_m.T), "raw_gnss": raw_m}
        self.tally.sums.add(error_m)
        self.tally.running.add(error_m)
        self.tally.tick, self._sim_time_s = obs.tick, obs.sim_time_ns * 1e-9
        self.tally.vehicles = max(self.tally.vehicles, len(rows))
        self._now = {}
        for place, row in enumerate(rows):
            vehicle = int(obs.vehicle[row])
            if vehicle not in self._of_vehicle:
                self._of_vehicle[vehicle] = (self._names.of(obs.id_hash[row]), ErrorSums())
            self._of_vehicle[vehicle][1].add({name: values[place : place + 1] for name, values in error_m.items()})
            self._now[vehicle] = {name: float(values[place]) for name, values in error_m.items()}
        if obs.episode_last:
            self.tally.end_episode()

    def estimates_m(self, obs: Observation) -> Float32Array:
        """f32 `[n, 2]`: the filter's positions at the tick added last; not-a-number where a row is not valid."""
        position_m = np.asarray(self._ekf.position_m, dtype=np.float32)
        return np.where(np.asarray(obs.valid)[:, None], position_m, np.float32(np.nan))

    def table(self) -> dict[str, Any]:
        """What is shown: means over the run, and a row for each vehicle on the road."""
        tally = self.tally
        rows = [
            {
                "vehicle": self._of_vehicle[vehicle][0],
                "now_m": now,
                "mean_m": {name: self._of_vehicle[vehicle][1].mean_m(name) for name in ESTIMATORS},
            }
            for vehicle, now in self._now.items()
        ]
        return {
            "episode": tally.episode,
            "sim_time_s": self._sim_time_s,
            "samples": tally.sums.samples,
            "mean_m": {name: tally.sums.mean_m(name) for name in ESTIMATORS},
            "vehicles": rows,
        }

    def write(self, file: Path) -> None:
        """Replace the file, from one moment to the next."""
        partial = file.with_name(f".{file.name}.partial")
        partial.write_text(json.dumps({"table": self.table(), "tally": asdict(self.tally)}))
        partial.rename(file)


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
        self._board = Scoreboard(channel.run, config, PlayTally.read(self._live))
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
            self._channel.publish_predictions(obs, predicted_m, updates, self._board.estimates_m(obs))
            self._channel.consumed(obs.tick)

    def _show(self) -> None:
        """Write the file; the ticks in it need not be delivered again."""
        self._shown_at = time.monotonic()
        tally = self._board.tally
        if tally.tick < 0:
            return
        self._board.write(self._live)
        self._channel.committed(tally.tick)
        mean = tally.sums.mean_m
        self._channel.report(
            episode=tally.episode,
            env_steps=tally.sums.samples,
            updates=self._policy.updates,
            policy_std=self._policy.sigma(),
            metrics={"error_m": mean("ppo") or math.nan, "raw_gnss_error_m": mean("raw_gnss") or math.nan},
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
        for name in ESTIMATORS:
            part[f"{name}_mean_error_m"] = tally.sums.mean_m(name)
            seeds = [episode[name] for episode in tally.episodes]
            part[f"{name}_ci95_m"] = mean_interval(seeds).half_width if len(seeds) > 1 else None
        file = self._config.run_dir / "parts" / "trainer.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(part, indent=2) + "\n")
