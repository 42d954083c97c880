"""Teaches a policy, where it drives itself, what a teacher would have done: imitation by dataset aggregation (DAgger).

Runs as `trainer.module` of a run that begins from a policy (`task.begin_from`). The pupil drives the heroes, and now
and then the teacher does for a few seconds. The teacher is the policy of the beginning, corrected by
`caraware.driving.right_of_way`, or by SUMO's own driver (`caraware.driving.advice`) if the observation has
`advised_accel`. The pupil learns from what heroes have seen so far, a batch in each tick. It writes
`taught.safetensors` into the run's directory, for `task.begin_from` (docs/driving.md). The method is that of Ross,
Gordon and Bagnell, arXiv 1011.0686.

Heroes drive in all worlds of the run (`--envs`), and their few rows are answered on the CPU. With
`trainer.device = "auto"` the pupil learns on a GPU if there is one, from larger batches.
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
from caraware.ipc.run_file import ConfigError, config_table, setting
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
BATCH, GPU_BATCH, FIRST_ROWS = 4096, 16_384, 20_000
SHOWN_EVERY = 20
"""Lessons on a GPU after which the driver gets the pupil's parameters."""
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
        """Rows are kept, and drawn, on the device of `generator`."""
        self._capacity, self._generator = capacity, generator
        self._seen: Tensor | None = None
        self.offered = 0

    @property
    def device(self) -> torch.device:
        """Where they are."""
        return self._generator.device

    def __len__(self) -> int:
        return min(self.offered, self._capacity)

    def add(self, seen: Tensor) -> None:
        """Keep rows `[n, d]`: all while there is room, then each with the probability that keeps the sample fair."""
        if self._seen is None:
            self._seen = torch.empty(self._capacity, seen.shape[1], dtype=torch.float16, device=self.device)
        places = torch.arange(self.offered, self.offered + len(seen), device=self.device)
        drawn = (torch.rand(len(seen), generator=self._generator, device=self.device) * (places + 1)).long()
        places = torch.where(places < self._capacity, places, drawn)
        kept = places < self._capacity
        self._seen[places[kept]] = seen.to(self.device)[kept].half()
        self.offered += len(seen)

    def drawn(self, count: int) -> Tensor:
        """Rows f32 `[count, d]` at random."""
        assert self._seen is not None
        places = torch.randint(len(self), (count,), generator=self._generator, device=self.device)
        return self._seen[places].float()


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
        return torch.ones(len(seen), device=seen.device)


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

    def noise(count: int, columns: int) -> Tensor:
        """Rows with as much noise each as a number of 0 … 1 says."""
        size = torch.rand(count, 1, generator=generator, device=rows.device)
        return size * torch.randn(count, columns, generator=generator, device=rows.device)

    seen[first:second, :FIELDS] += 2 * varied_by * noise(second - first, FIELDS)
    seen[second:third, :EGO] = rows.drawn(third - second)[:, :EGO] + VARIED_BY * noise(third - second, EGO)
    at = EGO
    for group in GROUPS:
        after = at + group.members * group.columns
        seen[third:, at:after] = rows.drawn(count - third)[:, at:after]
        at = after
    seen[second:, FIELDS:] = torch.nan
    return torch.cat([seen[:, :FIELDS].clamp(-1, 1), seen[:, FIELDS:]], 1)


class Pupil:
    """The policy that learns, by regression, on the device of the rows."""

    def __init__(self, network: nn.Module, teacher: Teacher, generator: torch.Generator) -> None:
        self._teacher, self._generator, self._batch = teacher, generator, BATCH
        self.network, self._learns, self._lessons = network, network, 0
        if generator.device.type != "cpu":
            self._learns, self._batch = copy.deepcopy(network).to(generator.device), GPU_BATCH
        self._optimiser = ModuleAdam(self._learns.parameters())
        self._unit = torch.tensor(UNIT, device=generator.device)

    def learn(self, rows: SeenRows, learning_rate: float) -> None:
        """One step on rows drawn at random and varied: Huber's loss of the error in units."""
        seen = varied(rows, self._batch, self._teacher.varied_by, self._generator)
        actions, corrected = self._teacher.actions(seen)
        error = (self._learns(seen[:, :FIELDS]) - actions) / self._unit
        loss = nn.functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")
        loss = loss[:, 0] + torch.where(error[:, 1] > 0, self._teacher.caution(seen), 1.0) * loss[:, 1]
        weights = torch.where(corrected, CORRECTED_WEIGHT, 1.0)
        self._optimiser.zero_grad()
        ((loss * weights).sum() / weights.sum()).backward()
        self._optimiser.step(learning_rate)
        self._lessons += 1
        if self._lessons % SHOWN_EVERY == 0:
            self.show()

    def show(self) -> None:
        """Give the driver, `network`, what is learnt so far; it is on the CPU."""
        if self._learns is not self.network:
            self.network.load_state_dict(self._learns.state_dict())

    def errors(self, rows: SeenRows) -> dict[str, list[float]]:
        """Mean absolute errors of steering and acceleration over rows as seen: of corrected ones, and of all others."""
        with torch.no_grad():
            seen = rows.drawn(20_000)
            actions, corrected = self._teacher.actions(seen)
            error = (self._learns(seen[:, :FIELDS]).clamp(-1, 1) - actions).abs()
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


class World:
    """One environment of the run: its ticks, what drives its heroes, and its rows of the tick before."""

    def __init__(self, channel: Channel, seed: int, advice: SumoAdvice | None) -> None:
        """Rows are paired with their advice where there is some."""
        self.channel, self.ended = channel, False
        self._drivers, self._paired = MixedDrivers(seed), AdvisedRows(advice) if advice else None

    def rows(self, obs: Observation, seen: Tensor) -> Tensor:
        """Rows to learn from that a tick adds, whose rows are `[n, d]`."""
        if self._paired is not None:
            return self._paired.add(obs, seen)
        return seen[torch.from_numpy(obs.valid & ~(obs.terminated | obs.truncated))]

    def answer(self, obs: Observation, pupil: Tensor, teacher: Tensor) -> None:
        """Let one of both drive each hero; in an evaluation the pupil."""
        actions = pupil if obs.evaluation else self._drivers.actions(pupil, teacher)
        self.channel.publish_actions(obs, torch.where(torch.from_numpy(obs.valid).unsqueeze(1), actions, 0.0).numpy())
        self.channel.consumed(obs.tick)
        self.ended = obs.last


def waiting(worlds: list[World]) -> list[tuple[World, Observation]]:
    """The ticks that wait in the worlds, each after those before it; none after 0.2 s without any."""
    alone = len(worlds) == 1
    open_worlds = [world for world in worlds if not world.ended]
    ticks = [(world, obs) for world in open_worlds for obs in world.channel.receive(0.2 if alone else 0.0)]
    if not ticks and not alone:
        worlds[0].channel.wait_for_any(0.2)
    return ticks


def teach(run_file: Path, stop: StopSignal, _role: HandoverRole) -> None:
    """Drive and learn until the run ends or stops; write the pupil and the report's part."""
    run = read_run(run_file)
    task, config = task_of_run(run), TrainerConfig.from_run(run)
    begin = str(config_table(run, "task").get("begin_from", ""))
    if not isinstance(task, Driving) or not begin:
        raise ConfigError("there is no policy to correct", 'set task.kind = "driving" and task.begin_from')
    advice = SumoAdvice.from_run(run)
    is_advised = advice.is_there()
    if task.fields.width != FIELDS + is_advised:
        raise ConfigError(
            "the teacher needs the preset's fields",
            'set observation.fields = "driver", or "advised-driver", without a history',
        )
    # The heroes' few rows are on the CPU.
    ppo = build_ppo(replace(config, device=TrainerDevice.CPU), FIELDS, task)
    if not isinstance(ppo.updater, PlainUpdate):
        raise ConfigError(
            f"`trainer.network` is '{config.network}'", "a pupil needs a network of a class, which learns by autograd"
        )
    begin_from(ppo.updater.parameters(), Path(begin))
    generator = torch.Generator(configure_torch(config)).manual_seed(config.seed)
    network, rows = ppo.updater.policy.network, SeenRows(CAPACITY, generator)

    def teacher_on(device: torch.device) -> Teacher:
        begins = copy.deepcopy(network).to(device)
        return AdvisedPolicy(begins, advice) if is_advised else CorrectedPolicy(begins, RightOfWay.from_run(run))

    pupil, teacher, lessons = Pupil(network, teacher_on(rows.device), generator), teacher_on(torch.device("cpu")), 0
    first = Channel(str(run_file))
    channels = [first, *(first.in_environment(index) for index in range(1, setting(run, "run.envs", int)))]
    # Each world's noise has a stream of its own.
    seeds = np.random.SeedSequence(config.seed).generate_state(len(channels))
    worlds = [
        World(each, int(seed), advice if is_advised else None) for each, seed in zip(channels, seeds, strict=True)
    ]

    def answer(ticks: list[tuple[World, Observation]]) -> None:
        nonlocal lessons
        parts = [torch.nan_to_num(obs.observation) for _, obs in ticks]
        seen = torch.cat(parts)
        learnt = [world.rows(obs, part) for (world, obs), part in zip(ticks, parts, strict=True) if not obs.evaluation]
        if learnt:
            rows.add(torch.cat(learnt))
        if learnt and len(rows) >= FIRST_ROWS:
            pupil.learn(rows, LEARNING_RATE)
            lessons += 1
        # Where the teacher drives, it has the advice on the tick before.
        shown = torch.cat([seen[:, :FIELDS], advice.of(seen).unsqueeze(1)], 1) if is_advised else seen
        with torch.no_grad():
            own: Tensor = pupil.network(seen[:, :FIELDS]).clamp(-1, 1)
        sizes = [len(part) for part in parts]
        answers = zip(ticks, own.split(sizes), teacher.actions(shown)[0].split(sizes), strict=True)
        for (world, obs), by_pupil, by_teacher in answers:
            world.answer(obs, by_pupil, by_teacher)

    while not (all(world.ended for world in worlds) or stop.requested):
        if ticks := waiting(worlds):
            answer(ticks)
    # Half as many lessons again, with a falling learning rate, unless the run was asked to stop.
    for lesson in range(0 if stop.requested else lessons // 2):
        pupil.learn(rows, LEARNING_RATE * (1 - 2 * lesson / lessons))
    pupil.show()
    # Without the standard deviation, which no teacher shows: `trainer.initial_std` holds for the learner, too.
    taught = {n: t.clone() for n, t in ppo.updater.parameters().items() if n.startswith("policy.")}
    folder = Path(run["run_dir"])
    save_file({n: t for n, t in taught.items() if n != "policy.log_std"}, folder / TAUGHT)
    errors = pupil.errors(rows) if len(rows) else {}
    log.info("%d rows, %d lessons; errors of steering and acceleration: %s", rows.offered, lessons, errors)
    write_entries(folder, {"env_steps": rows.offered, "lessons": lessons, **errors}, lambda: stop.requested)
    for world in worlds:
        if world.ended:
            world.channel.done()


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], teach))
