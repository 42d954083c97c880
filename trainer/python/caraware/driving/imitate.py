"""SUMO's own driver as a teacher: its observations and actions as a data set, and a policy cloned from them.

Runs as `trainer.module` of a run whose heroes SUMO drives (`task.driver = "sumo"`), at full speed: no tick waits. It
writes `teacher.safetensors` (observation f32 `[n, d]`, action f32 `[n, 2]`) and `clone.safetensors` into the run's
directory; `task.begin_from` names the latter for a policy that begins as the clone (docs/driving.md).
"""

import logging
import sys
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from caraware.driving.lessons import Lessons, Limits
from caraware.ipc.arrays import BoolArray, UInt32Array
from caraware.ipc.channel import Channel, Observation
from caraware.ipc.report_part import write_entries
from caraware.ipc.run_file import ConfigError, setting
from caraware.learn.adam import ModuleAdam
from caraware.learn.build import build_ppo, configure_torch
from caraware.learn.config import TrainerConfig
from caraware.learn.ppo import PlainUpdate
from caraware.run.process import HandoverRole, StopSignal, read_run, run_process
from caraware.tasks.fields import Fields
from caraware.tasks.table import task_of_run

log = logging.getLogger(__name__)

DATA, CLONE = "teacher.safetensors", "clone.safetensors"
EPOCHS, BATCH, HELD_OUT = 12, 1024, 0.1


@dataclass(frozen=True)
class _Moment:
    """What is kept of a tick."""

    tick: int
    episode: int
    vehicle: UInt32Array
    valid: BoolArray
    observation: Tensor
    truth: Tensor


class Teacher:
    """Collects pairs: a tick's observation, and the action that the ticks after it show."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._moments: deque[_Moment] = deque(maxlen=limits.ahead_ticks + 1)
        self._observations: list[Tensor] = []
        self._actions: list[Tensor] = []
        self.pairs = 0

    def add(self, obs: Observation) -> None:
        """Take a tick; pairs are those of heroes that held their slots since `AHEAD_S` before."""
        if self._moments and (obs.tick, obs.episode) != (self._moments[-1].tick + 1, self._moments[-1].episode):
            self._moments.clear()
        rows = obs.vehicle.copy(), obs.valid.copy(), obs.observation.clone(), obs.truth.clone()
        self._moments.append(_Moment(obs.tick, obs.episode, *rows))
        if len(self._moments) <= self._limits.ahead_ticks:
            return
        first, second, last = self._moments[0], self._moments[1], self._moments[-1]
        wide = len(first.vehicle)
        stays = first.valid & last.valid[:wide] & (first.vehicle == last.vehicle[:wide])
        at = torch.from_numpy(np.flatnonzero(stays))
        self._observations.append(first.observation[at])
        self._actions.append(self._limits.action(first.truth[at], second.truth[at], last.truth[at]))
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


def clone(data: dict[str, Tensor], updater: PlainUpdate, generator: torch.Generator, lessons: Lessons) -> CloneFigures:
    """Teach the policy of `updater` by regression what the teacher does, and how to get back to where it drives.

    The figures are of the teacher's own places, and of its own actions.
    """
    count = len(data["action"])
    taught = max(1, int(count * (1 - HELD_OUT)))
    policy = updater.policy
    optimiser = ModuleAdam(policy.network.parameters())
    for epoch in range(EPOCHS):
        learning_rate = 1e-3 * (1 - epoch / EPOCHS)
        for rows in torch.randperm(taught, generator=generator).split(BATCH):
            observation, action = lessons.displaced(data["observation"][rows], data["action"][rows], generator)
            loss = (policy(observation) - action).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step(learning_rate)
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
    limits = Limits.from_run(run)
    channel, teacher, ended = Channel(str(run_file)), Teacher(limits), False
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
    lessons = Lessons(Fields.from_run(run), limits)
    figures = clone(data, ppo.updater, torch.Generator().manual_seed(config.seed), lessons)
    # Without the standard deviation, which no teacher shows: `trainer.initial_std` holds for the learner, too.
    taught = {n: t.clone() for n, t in ppo.updater.parameters().items() if n.startswith("policy.")}
    save_file({n: t for n, t in taught.items() if n != "policy.log_std"}, folder / CLONE)
    log.info(
        "%d pairs; errors of the clone %s, of doing nothing %s", figures.pairs, figures.error, figures.error_of_zero
    )
    part = {"env_steps": teacher.pairs, "clone_error": figures.error, "zero_error": figures.error_of_zero}
    write_entries(folder, part, lambda: stop.requested)
    if ended:
        channel.done()


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], imitate))
