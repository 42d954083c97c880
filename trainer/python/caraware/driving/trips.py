"""Drives a list of trips and counts how they end: the trainer of a run of `caraware bench driving`.

The list is fixed: in each evaluation episode of the run, whose seeds no training sees, the heroes that are there from
the beginning. Where they start, where they go, and what traffic is there at first follows from the seed alone. Heroes
that replace them drive on, and are not counted. `CARAWARE_DRIVER` names the driver: `policy` (the parameters that
`task.begin_from` names), `scripted`, `random`, or `sumo` (with `task.driver = "sumo"`).

It may take a live run over from a learner, and leaves it to another at any tick. It learns nothing: what it has driven
is committed when it leaves, because no learner can learn from actions that it did not draw.
"""

import math
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caraware.driving.manoeuvres import BETWEEN, Manoeuvres
from caraware.examples import pure_pursuit
from caraware.ipc.channel import Channel, Observation
from caraware.ipc.names import Names
from caraware.ipc.report_part import write_entries
from caraware.ipc.run_file import ConfigError, RunFile, config_table, setting
from caraware.learn.build import build_ppo
from caraware.learn.config import TrainerConfig
from caraware.run.learner import begin_from
from caraware.run.process import HandoverRole, StopSignal, SuccessorClaims, read_run, run_process
from caraware.tasks.driving import Driving
from caraware.tasks.ends import name_of
from caraware.tasks.table import task_of_run

DRIVER = "CARAWARE_DRIVER"
Driver = Callable[[Observation], Tensor]
"""Actions f32 `[n, 2]` of a tick."""


@dataclass
class Trip:
    """One trip of the list."""

    episode: int
    hero: str
    length_m: float
    """Of the route, from the first tick; at most 1 000."""
    end: str
    time_s: float
    way_m: float
    """Driven."""
    harshest_mps2: float
    """Largest change of speed in a tick."""
    jerk_mps3: float
    """Along the hero: root of the mean square, over its ticks, of the speed's second difference."""
    manoeuvre: str
    """At the end: see `caraware.driving.manoeuvres`."""
    passed: dict[str, int]
    """Stop lines passed, by manoeuvre."""


class Motion:
    """The speed of a hero from tick to tick."""

    def __init__(self, speed_mps: float) -> None:
        self._speed_mps, self._accel_mps2 = speed_mps, math.nan
        self._sum, self._ticks = 0.0, 0

    def advance(self, speed_mps: float, tick_s: float) -> float:
        """Take the next tick's speed; its acceleration, m/s²."""
        accel_mps2 = (speed_mps - self._speed_mps) / tick_s
        if not math.isnan(self._accel_mps2):
            self._sum += ((accel_mps2 - self._accel_mps2) / tick_s) ** 2
            self._ticks += 1
        self._speed_mps, self._accel_mps2 = speed_mps, accel_mps2
        return accel_mps2

    def jerk_mps3(self) -> float:
        """Root of the mean square so far; 0 before the third tick."""
        return math.sqrt(self._sum / self._ticks) if self._ticks else 0.0


class TripLog:
    """Follows the heroes of the list through the ticks of a run."""

    def __init__(self, run: RunFile, task: Driving) -> None:
        self._names, self._task = Names(run), task
        self._heroes = {f"hero.{number}" for number in range(setting(run, "traffic.heroes", int))}
        self._open: dict[int, Trip] = {}
        self._motion: dict[int, Motion] = {}
        self._manoeuvres: dict[int, Manoeuvres] = {}
        self._episode = -1
        self.trips: list[Trip] = []

    def add(self, obs: Observation) -> None:
        """Take one tick of an evaluation."""
        if obs.episode != self._episode:
            self._close_all(obs)
            self._episode = obs.episode
        tick_s = self._task.tick_s
        for ended in np.flatnonzero(obs.terminated | obs.truncated):
            if (trip := self._open.pop(int(ended), None)) is not None:
                trip.end = name_of(int(obs.ended_by[ended]))
                self._close(int(ended), trip)
        for slot in map(int, np.flatnonzero(obs.valid)):
            speed = float(obs.truth[slot, 3])
            if slot in self._open:
                trip = self._open[slot]
                trip.harshest_mps2 = max(trip.harshest_mps2, abs(self._motion[slot].advance(speed, tick_s)))
                trip.time_s += tick_s
                trip.way_m += speed * tick_s
            elif (hero := self._names.of(obs.id_hash[slot])) in self._heroes and not self._has_driven(hero):
                left_m = float(self._task.fields.si_tensor(obs.observation[slot : slot + 1], "route_left")[0])
                self._open[slot] = Trip(obs.episode, hero, left_m, "", 0.0, 0.0, 0.0, 0.0, BETWEEN, {})
                self._manoeuvres[slot], self._motion[slot] = Manoeuvres(), Motion(speed)
            if slot in self._open:
                self._manoeuvres[slot].add(self._task.fields, obs.observation[slot], speed * tick_s)

    def _close(self, slot: int, trip: Trip) -> None:
        manoeuvres = self._manoeuvres.pop(slot)
        trip.manoeuvre, trip.passed = manoeuvres.now, manoeuvres.passed
        trip.jerk_mps3 = self._motion.pop(slot).jerk_mps3()
        self.trips.append(trip)

    def _has_driven(self, hero: str) -> bool:
        return any(trip.hero == hero and trip.episode == self._episode for trip in self.trips)

    def _close_all(self, obs: Observation) -> None:
        """Trips that the end of the episode cut."""
        for slot, trip in sorted(self._open.items()):
            ended = slot < len(obs.ended_by) and (obs.terminated[slot] or obs.truncated[slot])
            trip.end = name_of(int(obs.ended_by[slot])) if ended else name_of(0)
            self._close(slot, trip)
        self._open.clear()


def scripted(run: RunFile) -> Driver:
    """The script of `caraware.examples.pure_pursuit`."""
    config, names = run["config"], list(run["config"]["observation"]["fields"])
    ranges = {field["name"]: field["range"] for field in run["observation_fields"]}
    integrals: dict[int, float] = {}

    def drive(obs: Observation) -> Tensor:
        actions = torch.zeros(len(obs.vehicle), 2)
        for slot in np.flatnonzero(obs.valid):
            vehicle = int(obs.vehicle[slot])
            seen = pure_pursuit.si_units(obs.observation[slot], names, ranges)
            *demands, integrals[vehicle] = pure_pursuit.drive(seen, integrals.get(vehicle, 0.0), config)
            actions[slot] = torch.tensor(demands)
        return actions

    return drive


def uniform(run: RunFile) -> Driver:
    """Actions at random in their range."""
    generator = torch.Generator().manual_seed(setting(run, "run.seed", int))
    return lambda obs: torch.rand(len(obs.vehicle), 2, generator=generator) * 2 - 1


def policy(run: RunFile) -> Driver:
    """The mean of the policy that `task.begin_from` names."""
    place = str(config_table(run, "task")["begin_from"])
    if not place:
        raise ConfigError("`task.begin_from` names no policy", "set it to a checkpoint")
    task, config = task_of_run(run), TrainerConfig.from_run(run)
    assert isinstance(task, Driving)
    ppo = build_ppo(config, task.fields.width, task)
    begin_from(ppo.updater.parameters(), Path(place))
    # The same trips end alike on every machine: "auto" rounds to bfloat16 where a processor has units for it.
    torch.set_float32_matmul_precision("highest")
    return lambda obs: ppo.updater.mean(torch.nan_to_num(obs.observation))


def watched(run: RunFile) -> Driver:
    """SUMO drives; what is answered moves nothing."""
    if setting(run, "task.driver", str) != "sumo":
        raise ConfigError('`task.driver` is not "sumo"', f'set task.driver = "sumo" with {DRIVER}=sumo')
    return lambda obs: torch.zeros(len(obs.vehicle), 2)


DRIVERS: dict[str, Callable[[RunFile], Driver]] = {
    "policy": policy,
    "scripted": scripted,
    "random": uniform,
    "sumo": watched,
}


def drive_trips(run_file: Path, stop: StopSignal, role: HandoverRole) -> None:
    """Drive until the run ends or a successor waits; write the trips into the report's part."""
    run = read_run(run_file)
    name = os.environ.get(DRIVER, "policy")
    if name not in DRIVERS:
        raise ConfigError(f"{DRIVER}={name} is no driver", f"one of: {', '.join(DRIVERS)}")
    task = task_of_run(run)
    if not isinstance(task, Driving):
        raise ConfigError(f"`task.kind` is {task.name!r}", 'set task.kind = "driving"')
    driver, trips, ended = DRIVERS[name](run), TripLog(run, task), False
    # After the policy, which sets a thread for each core: for a few rows they only spin.
    torch.set_num_threads(1)
    if role.gets_ready and not role.wait_for_turn(SuccessorClaims(task=task.name, environments=1)):
        return
    channel, steps, answered = Channel(str(run_file)), 0, -1
    while not (ended or stop.requested or stop.leave_requested):
        for obs in channel.receive(0.2):
            if obs.evaluation:
                trips.add(obs)
            valid = torch.from_numpy(obs.valid).unsqueeze(1)
            channel.publish_actions(obs, torch.where(valid, driver(obs).clamp(-1, 1), 0.0).detach().numpy())
            channel.consumed(obs.tick)
            ended, steps, answered = obs.last, steps + int(obs.valid.sum()), obs.tick
    if stop.leave_requested and answered >= 0:
        channel.commit(answered, lambda: stop.requested)
    part = {"env_steps": steps, "driver": name, "trips": [asdict(trip) for trip in trips.trips]}
    write_entries(Path(run["run_dir"]), part, lambda: stop.requested)
    if ended:
        channel.done()


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], drive_trips))
