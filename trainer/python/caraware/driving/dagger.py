"""Teaches a policy, where it drives itself, what a teacher would have done: imitation by dataset aggregation (DAgger).

Runs as `trainer.module` of a run that begins from a policy (`task.begin_from`). The pupil drives the heroes, and now
and then the teacher does for a few seconds. The teacher is the policy of the beginning, corrected by
`caraware.driving.right_of_way`, or by SUMO's own driver (`caraware.driving.advice`) if the observation has
`advised_accel`. The pupil learns from what heroes have seen so far, a batch in each tick. It writes
`taught.safetensors` into the run's directory, for `task.begin_from` (docs/driving.md). The method is that of Ross,
Gordon and Bagnell, arXiv 1011.0686.
"""

import copy
import logging
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from caraware.driving.advice import SumoAdvice
from caraware.driving.right_of_way import RightOfWay
from caraware.ipc.arrays import BoolArray, UInt32Array
from caraware.ipc.channel import Channel, Observation
from caraware.ipc.report_part import write_entries
from caraware.ipc.run_file import ConfigError, config_table
from caraware.learn.adam import ModuleAdam
from caraware.learn.build import build_ppo, configure_torch
from caraware.learn.config import TrainerConfig, TrainerDevice
from caraware.learn.encoders import EGO, FIELDS, GROUPS
from caraware.learn.ppo import PlainUpdate
from caraware.run.learner import begin_from
from caraware.run.process import HandoverRole, StopSignal, read_run, run_process
from caraware.tasks.driving import Driving
from caraware.tasks.table import task_of_run

log = logging.getLogger(__name__)

TAUGHT = "taught.safetensors"
CAPACITY = 4_000_000
"""Rows that are kept, in half precision: 1.1 GB of the preset "driver". Later ones replace some at random."""
BATCH, FIRST_ROWS = 4096, 20_000
LEARNING_RATE = 7e-4
SHARES, VARIED_BY = (0.35, 0.55, 0.75), 0.05
"""Of a batch: rows as they are up to the first, with noise up to the second, with another hero's own fields up to the
third; the rest have each group from another row. And the noise, of −1 … 1."""
TEACHER_DRIVES, CHANGES = 0.2, 0.02
"""Share of the heroes that the teacher drives, and that are drawn anew in each tick."""
NOISE, NOISE_KEEPS = (0.03, 0.15), 0.9
"""Standard deviation of what is added to steering and acceleration, and how much of it stays from tick to tick."""
UNIT = (0.02, 0.15)
"""Errors of steering and acceleration that count alike."""
CORRECTED_WEIGHT, CORRECTED_FROM = 3.0, 0.02
"""Rows in which the teacher changed the action by more than this count so many times."""
ADVISED_CAUTION, ADVISED_VARIED_BY = 3.0, 0.01
"""SUMO's driver knows more than a hero sees: where the hero only brakes as it would, to accelerate more counts so many
times what braking more does. And its advice is kept for rows with as little noise as this."""


class SeenRows:
    """What heroes saw: a fair sample of all rows that were offered."""

    def __init__(self, capacity: int, generator: torch.Generator) -> None:
        self._capacity, self._generator = capacity, generator
        self._seen: Tensor | None = None
        self.offered = 0

    def __len__(self) -> int:
        return min(self.offered, self._capacity)

    def add(self, seen: Tensor) -> None:
        """Keep rows `[n, d]`: all while there is room, then each with the probability that keeps the sample fair."""
        if self._seen is None:
            self._seen = torch.empty(self._capacity, seen.shape[1], dtype=torch.float16)
        places = torch.arange(self.offered, self.offered + len(seen))
        drawn = (torch.rand(len(seen), generator=self._generator) * (places + 1)).long()
        places = torch.where(places < self._capacity, places, drawn)
        kept = places < self._capacity
        self._seen[places[kept]] = seen[kept].half()
        self.offered += len(seen)

    def drawn(self, count: int) -> Tensor:
        """Rows f32 `[count, d]` at random."""
        assert self._seen is not None
        return self._seen[torch.randint(len(self), (count,), generator=self._generator)].float()


class Teacher(Protocol):
    """Says what should have been done."""

    varied_by: float
    """Noise, of −1 … 1, up to which its answer for a row is kept."""

    def actions(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Actions f32 `[n, 2]` for rows `[n, d]`, and bool `[n]`: here it differs from the policy of the beginning."""

    def caution(self, seen: Tensor) -> Tensor:
        """f32 `[n]`: how many times as much it counts to accelerate more than the teacher as to accelerate less."""


class CorrectedPolicy:
    """The policy of the beginning, corrected by the rule. It has an answer for any row, also for one never seen."""

    varied_by = VARIED_BY

    def __init__(self, network: nn.Module, rule: RightOfWay) -> None:
        self._network, self._rule = network, rule

    def actions(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """See the protocol."""
        with torch.no_grad():
            own = self._network(seen).clamp(-1, 1)
            wanted = self._rule.corrected(seen, own)
        return wanted, (wanted - own).abs().amax(1) > CORRECTED_FROM

    def caution(self, seen: Tensor) -> Tensor:
        """See the protocol."""
        return torch.ones(len(seen))


class AdvisedPolicy:
    """The policy of the beginning, corrected by SUMO's driver where it was asked: rows `[n, FIELDS + 1]`.

    The last column is the advice on the tick of the row, m/s²; a row without advice (NaN) teaches what the policy does.
    """

    varied_by = ADVISED_VARIED_BY

    def __init__(self, network: nn.Module, advice: SumoAdvice) -> None:
        self._network, self._advice = network, advice

    def actions(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """See the protocol."""
        with torch.no_grad():
            own = self._network(seen[:, :FIELDS]).clamp(-1, 1)
            wanted = self._advice.corrected(seen, own, seen[:, FIELDS])
        wanted = torch.where(seen[:, FIELDS:].isnan(), own, wanted)
        return wanted, (wanted - own).abs().amax(1) > CORRECTED_FROM

    def caution(self, seen: Tensor) -> Tensor:
        """See the protocol."""
        return torch.where(self._advice.does(seen) & ~seen[:, FIELDS].isnan(), 1.0, ADVISED_CAUTION)


@dataclass
class AdvisedRows:
    """Pairs what heroes saw in a tick with the advice on it, which comes with the next."""

    advice: SumoAdvice
    _before: tuple[int, UInt32Array, BoolArray, Tensor] | None = None

    def add(self, obs: Observation, seen: Tensor) -> Tensor:
        """Take a tick whose rows are `[n, FIELDS + 1]`; return the rows of the tick before with their advice."""
        before, there = self._before, obs.valid & ~(obs.terminated | obs.truncated)
        self._before = (obs.tick, obs.vehicle.copy(), there, seen)
        if before is None or before[0] + 1 != obs.tick or len(before[1]) != len(obs.vehicle):
            return seen[:0]
        _, vehicle, was_there, rows = before
        at = torch.from_numpy(was_there & there & (vehicle == obs.vehicle))
        return torch.cat([rows[at, :FIELDS], self.advice.of(seen[at]).unsqueeze(1)], 1)


def varied(rows: SeenRows, count: int, varied_by: float, generator: torch.Generator) -> Tensor:
    """Rows f32 `[count, d]`: as they were seen, with noise, with another hero's own fields, and of mixed groups.

    A pupil that is taught the rows alone forgets on other maps what it could: there it drove against the traffic.
    Advice behind the fields is lost with the fields of another hero.
    """
    seen = rows.drawn(count)
    first, second, third = (int(count * share) for share in SHARES)
    noise = torch.randn(second - first, FIELDS, generator=generator)
    seen[first:second, :FIELDS] += 2 * varied_by * noise * torch.rand(second - first, 1, generator=generator)
    others = rows.drawn(third - second)[:, :EGO]
    noise = torch.randn(others.shape, generator=generator) * torch.rand(len(others), 1, generator=generator)
    seen[second:third, :EGO] = others + VARIED_BY * noise
    at = EGO
    for group in GROUPS:
        after = at + group.members * group.columns
        seen[third:, at:after] = rows.drawn(count - third)[:, at:after]
        at = after
    seen[second:, FIELDS:] = torch.nan
    return torch.cat([seen[:, :FIELDS].clamp(-1, 1), seen[:, FIELDS:]], 1)


class Pupil:
    """The policy that learns, by regression."""

    def __init__(self, network: nn.Module, teacher: Teacher, generator: torch.Generator) -> None:
        self.network, self._teacher, self._generator = network, teacher, generator
        self._optimiser = ModuleAdam(network.parameters())
        self._unit = torch.tensor(UNIT)

    def learn(self, rows: SeenRows, learning_rate: float) -> None:
        """One step on rows drawn at random and varied: Huber's loss of the error in units."""
        seen = varied(rows, BATCH, self._teacher.varied_by, self._generator)
        actions, corrected = self._teacher.actions(seen)
        error = (self.network(seen[:, :FIELDS]) - actions) / self._unit
        loss = nn.functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")
        loss = loss[:, 0] + torch.where(error[:, 1] > 0, self._teacher.caution(seen), 1.0) * loss[:, 1]
        weights = torch.where(corrected, CORRECTED_WEIGHT, 1.0)
        self._optimiser.zero_grad()
        ((loss * weights).sum() / weights.sum()).backward()
        self._optimiser.step(learning_rate)

    def errors(self, rows: SeenRows) -> dict[str, list[float]]:
        """Mean absolute errors of steering and acceleration over rows as seen: of corrected ones, and of all others."""
        with torch.no_grad():
            seen = rows.drawn(20_000)
            actions, corrected = self._teacher.actions(seen)
            error = (self.network(seen[:, :FIELDS]).clamp(-1, 1) - actions).abs()
        parts = {"corrected_error": error[corrected], "other_error": error[~corrected]}
        return {name: part.mean(0).tolist() for name, part in parts.items() if len(part)}


class MixedDrivers:
    """The teacher drives some heroes, the pupil the others, all with noise: so the pupil sees how to get back."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._by_teacher = np.zeros(0, bool)
        self._noise = np.zeros((0, 2), np.float32)

    def actions(self, pupil: Tensor, teacher: Tensor) -> Tensor:
        """Actions of a tick, from those of both."""
        count, draw = len(pupil), self._random
        if len(self._by_teacher) != count:
            self._by_teacher, self._noise = draw.random(count) < TEACHER_DRIVES, np.zeros((count, 2), np.float32)
        changes = draw.random(count) < CHANGES
        self._by_teacher = np.where(changes, draw.random(count) < TEACHER_DRIVES, self._by_teacher)
        fresh = draw.normal(size=(count, 2)) * NOISE * (1 - NOISE_KEEPS**2) ** 0.5
        self._noise = (NOISE_KEEPS * self._noise + fresh).astype(np.float32)
        chosen = torch.where(torch.from_numpy(self._by_teacher).unsqueeze(1), teacher, pupil)
        return (chosen + torch.from_numpy(self._noise)).clamp(-1, 1)


def teach(run_file: Path, stop: StopSignal, _role: HandoverRole) -> None:
    """Drive and learn until the run ends or stops; write the pupil and the report's part."""
    run = read_run(run_file)
    # The heroes' few rows and the batches are on the CPU.
    task, config = task_of_run(run), replace(TrainerConfig.from_run(run), device=TrainerDevice.CPU)
    begin = str(config_table(run, "task").get("begin_from", ""))
    if not isinstance(task, Driving) or not begin:
        raise ConfigError("there is no policy to correct", 'set task.kind = "driving" and task.begin_from')
    configure_torch(config)
    advice = SumoAdvice.from_run(run)
    is_advised = advice.is_there()
    if task.fields.width != FIELDS + is_advised:
        raise ConfigError(
            "the teacher needs the preset's fields",
            'set observation.fields = "driver", or "advised-driver", without a history',
        )
    ppo = build_ppo(config, FIELDS, task)
    if not isinstance(ppo.updater, PlainUpdate):
        raise ConfigError(
            f"`trainer.network` is '{config.network}'", "a pupil needs a network of a class, which learns by autograd"
        )
    begin_from(ppo.updater.parameters(), Path(begin))
    generator = torch.Generator().manual_seed(config.seed)
    network, rows = ppo.updater.policy.network, SeenRows(CAPACITY, generator)
    begins = copy.deepcopy(network)
    teacher: Teacher = (
        AdvisedPolicy(begins, advice) if is_advised else CorrectedPolicy(begins, RightOfWay.from_run(run))
    )
    paired = AdvisedRows(advice)
    pupil, drivers = Pupil(network, teacher, generator), MixedDrivers(config.seed)
    channel, ended, lessons = Channel(str(run_file)), False, 0

    def answer(obs: Observation) -> Tensor:
        nonlocal lessons
        seen = torch.nan_to_num(obs.observation)
        with torch.no_grad():
            own: Tensor = pupil.network(seen[:, :FIELDS]).clamp(-1, 1)
        if obs.evaluation:
            return own
        there = torch.from_numpy(obs.valid & ~(obs.terminated | obs.truncated))
        rows.add(paired.add(obs, seen) if is_advised else seen[there])
        if len(rows) >= FIRST_ROWS:
            pupil.learn(rows, LEARNING_RATE)
            lessons += 1
        # Where the teacher drives, it has the advice on the tick before.
        shown = torch.cat([seen[:, :FIELDS], advice.of(seen).unsqueeze(1)], 1) if is_advised else seen
        return drivers.actions(own, teacher.actions(shown)[0])

    while not (ended or stop.requested):
        for obs in channel.receive(0.2):
            valid = torch.from_numpy(obs.valid).unsqueeze(1)
            channel.publish_actions(obs, torch.where(valid, answer(obs), 0.0).numpy())
            channel.consumed(obs.tick)
            ended = obs.last
    # Half as many lessons again, with a falling learning rate, unless the run was asked to stop.
    for lesson in range(0 if stop.requested else lessons // 2):
        pupil.learn(rows, LEARNING_RATE * (1 - 2 * lesson / lessons))
    # Without the standard deviation, which no teacher shows: `trainer.initial_std` holds for the learner, too.
    taught = {n: t.clone() for n, t in ppo.updater.parameters().items() if n.startswith("policy.")}
    folder = Path(run["run_dir"])
    save_file({n: t for n, t in taught.items() if n != "policy.log_std"}, folder / TAUGHT)
    errors = pupil.errors(rows) if len(rows) else {}
    log.info("%d rows, %d lessons; errors of steering and acceleration: %s", rows.offered, lessons, errors)
    write_entries(folder, {"env_steps": rows.offered, "lessons": lessons, **errors}, lambda: stop.requested)
    if ended:
        channel.done()


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], teach))
