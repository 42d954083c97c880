"""SUMO's own driver as a teacher: its observations and actions as a data set, and a policy cloned from them.

Runs as `trainer.module` of a run whose heroes SUMO drives (`task.driver = "sumo"`), at full speed: no tick waits. It
writes `teacher.safetensors` (observation f32 `[n, d]`, action f32 `[n, 2]`) and `clone.safetensors` into the run's
directory; `task.begin_from` names the latter for a policy that begins as the clone (docs/driving.md).
"""

import json
import logging
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from caraware.ipc.channel import Channel, Observation
from caraware.ipc.run_file import ConfigError, RunFile, config_table, setting
from caraware.learn.build import build_ppo, configure_torch
from caraware.learn.config import TrainerConfig
from caraware.learn.ppo import PlainUpdate
from caraware.run.process import HandoverRole, StopSignal, read_run, run_process
from caraware.tasks.table import task_of_run

log = logging.getLogger(__name__)

DATA, CLONE = "teacher.safetensors", "clone.safetensors"
WHEELBASE_M = 2.7
"""Of a passenger car: the steering follows from speed and yaw rate by the single-track model without slip."""
STEERING_FROM_MPS = 1.0
"""Below it a yaw rate does not show the steering: such a pair teaches 0."""
EPOCHS, BATCH, HELD_OUT = 8, 256, 0.1


@dataclass(frozen=True)
class Limits:
    """What an action of 1 stands for."""

    accel_mps2: float
    decel_mps2: float
    angle_rad: float
    tick_s: float

    @classmethod
    def from_run(cls, run: RunFile) -> "Limits":
        """Of the run's vehicles."""
        vehicle = config_table(run, "vehicle")
        angle = float(vehicle["max_road_wheel_angle_rad"])
        limits = float(vehicle["max_accel_mps2"]), float(vehicle["max_decel_mps2"]), angle
        return cls(*limits, setting(run, "run.tick_s", float))

    def action(self, before: Tensor, after: Tensor) -> Tensor:
        """The actions f32 `[n, 2]` that lead from truth `[n, 4]` to that of the tick after, within their range."""
        speed_mps = after[:, 3]
        accel_mps2 = (speed_mps - before[:, 3]) / self.tick_s
        turned_rad = after[:, 2] - before[:, 2]
        yaw_rate = torch.atan2(turned_rad.sin(), turned_rad.cos()) / self.tick_s
        angle_rad = torch.atan(WHEELBASE_M * yaw_rate / speed_mps.clamp_min(STEERING_FROM_MPS))
        steering = torch.where(speed_mps > STEERING_FROM_MPS, angle_rad / self.angle_rad, 0.0)
        demand = accel_mps2 / torch.where(accel_mps2 > 0, self.accel_mps2, self.decel_mps2)
        return torch.stack((steering, demand), 1).clamp(-1, 1)


class Teacher:
    """Collects pairs: a tick's observation, and the action that the next tick shows."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._before: tuple[int, int, np.ndarray, np.ndarray, Tensor, Tensor] | None = None
        self._observations: list[Tensor] = []
        self._actions: list[Tensor] = []
        self.pairs = 0

    def add(self, obs: Observation) -> None:
        """Take a tick; pairs are those of heroes that held their slots from the tick before."""
        before = self._before
        self._before = (
            obs.tick,
            obs.episode,
            obs.vehicle.copy(),
            obs.valid.copy(),
            obs.observation.clone(),
            obs.truth.clone(),
        )
        if before is None or before[:2] != (obs.tick - 1, obs.episode):
            return
        _, _, vehicle, valid, observation, truth = before
        wide = min(len(vehicle), len(obs.vehicle))
        stays = valid[:wide] & obs.valid[:wide] & (vehicle[:wide] == obs.vehicle[:wide])
        at = torch.from_numpy(np.flatnonzero(stays))
        self._observations.append(observation[at])
        self._actions.append(self._limits.action(truth[at], obs.truth[at]))
        self.pairs += len(at)

    def tensors(self) -> dict[str, Tensor]:
        """The data set."""
        return {"observation": torch.cat(self._observations), "action": torch.cat(self._actions)}


@dataclass(frozen=True)
class CloneFigures:
    """How well the clone does on pairs that it was not taught, the last tenth of them."""

    pairs: int
    error: list[float]
    """Mean absolute error of steering and acceleration, in actions."""
    error_of_zero: list[float]
    """The same of a driver that always answers (0, 0)."""


def clone(data: dict[str, Tensor], updater: PlainUpdate, generator: torch.Generator) -> CloneFigures:
    """Teach the policy of `updater` the actions of the data set by regression."""
    count = len(data["action"])
    taught = max(1, int(count * (1 - HELD_OUT)))
    policy = updater.policy
    optimiser = torch.optim.Adam(policy.network.parameters(), 1e-3)
    for epoch in range(EPOCHS):
        for group in optimiser.param_groups:
            group["lr"] = 1e-3 * (1 - epoch / EPOCHS)
        for rows in torch.randperm(taught, generator=generator).split(BATCH):
            loss = (policy(data["observation"][rows]) - data["action"][rows]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    with torch.no_grad():
        held = data["action"][taught:]
        error = (policy(data["observation"][taught:]) - held).abs().mean(0)
    return CloneFigures(count, error.tolist(), held.abs().mean(0).tolist())


def imitate(run_file: Path, stop: StopSignal, _role: HandoverRole) -> None:
    """Watch until the run ends, then clone."""
    run = read_run(run_file)
    if setting(run, "task.driver", str) != "sumo":
        raise ConfigError(
            '`task.driver` is not "sumo": nothing drives that could be imitated', 'set task.driver = "sumo"'
        )
    channel, teacher, ended = Channel(str(run_file)), Teacher(Limits.from_run(run)), False
    while not ended and not stop.requested:
        for obs in channel.receive(0.2):
            if not obs.evaluation:
                teacher.add(obs)
            channel.publish_predictions(obs, torch.zeros(len(obs.vehicle), 2), 0)
            channel.consumed(obs.tick)
            ended = obs.last
    config, folder = TrainerConfig.from_run(run), Path(run["run_dir"])
    data = teacher.tensors()
    save_file(data, folder / DATA)
    configure_torch(config)
    ppo = build_ppo(config, data["observation"].shape[1], task_of_run(run))
    if not isinstance(ppo.updater, PlainUpdate):
        raise ConfigError(
            f"`trainer.network` is '{config.network}'", "a clone needs a network of a class, which learns by autograd"
        )
    figures = clone(data, ppo.updater, torch.Generator().manual_seed(config.seed))
    save_file({n: t.clone() for n, t in ppo.updater.parameters().items() if n.startswith("policy.")}, folder / CLONE)
    log.info(
        "%d pairs; errors of the clone %s, of doing nothing %s", figures.pairs, figures.error, figures.error_of_zero
    )
    part = {"env_steps": teacher.pairs, "clone_error": figures.error, "zero_error": figures.error_of_zero}
    (folder / "parts" / "trainer.json").write_text(json.dumps(part, indent=2) + "\n")
    if ended:
        channel.done()


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], imitate))
