"""Measures agent-steps per second of many heroes, driven through `CarAwareVectorEnv` by a policy on the CPU.

`python -m caraware_bench.heroes --heroes 256 --policy learnt --json FILE`
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from caraware.driving import trips
from caraware.envs import CarAwareVectorEnv, Simulation, make
from caraware_bench.cost import thread_time_s

LEARNT = Path(__file__).parents[3] / "maps" / "town" / "driver.safetensors"
LAYERS = (128, 128)
"""Widths of the untrained policy, which are those of the learnt one behind its encoders."""
WORKING = ("traffic-bridge", "sim-core", "sensor-daemon")
"""The processes of a tick beside this one."""

Rows = NDArray[np.float32]
Policy = Callable[[Rows], Rows]


@dataclass(frozen=True)
class HeroCost:
    """What some ticks took."""

    heroes: int
    ticks: int
    agent_steps: int
    """Actions of heroes that were there; a slot whose next hero has not departed has none."""
    ends: int
    """Trips that ended."""
    wall_s: float
    policy_s: float
    """Wall time of the policy."""
    step_s: float
    """Wall time of `step`: the face, and the simulation that it waits for."""
    cpu_s: dict[str, float]
    """Processor time by process; `learner` is this one, with the policy and the face."""

    @property
    def agent_steps_per_s(self) -> float:
        """Per wall second."""
        return self.agent_steps / self.wall_s

    @property
    def waiting_us(self) -> float:
        """Wall time of a tick beside the work of the longer of its two loops, microseconds.

        The learner's: `sim-core`, `sensor-daemon`, learner. SUMO's: `traffic-bridge`, which waits for poses.
        """
        cpu_s = self.cpu_s
        work_s = max(cpu_s["traffic-bridge"], cpu_s["sim-core"] + cpu_s["sensor-daemon"] + cpu_s["learner"])
        return 1e6 * (self.wall_s - work_s) / self.ticks


def measure(heroes: int, policy: str, ticks: int, warm_up_ticks: int) -> HeroCost:
    """Drives `heroes` heroes through the town of the preset `driving`; the seed is the same in every call."""
    settings: dict[str, Any] = {
        "traffic.heroes": heroes,
        "traffic.max_road_users": heroes + 128,
        "task.begin_from": str(LEARNT),
        "episode.ticks": 1_000_000,
    }
    with make("driving", settings) as simulation:
        env, act = CarAwareVectorEnv(simulation), POLICIES[policy](simulation)
        observation, _ = env.reset(seed=1)
        observation = _drive(env, act, observation, warm_up_ticks, _Sums())
        sums, before = _Sums(), _cpu_s(simulation.pid)
        begin = time.perf_counter()
        _drive(env, act, observation, ticks, sums)
        wall_s = time.perf_counter() - begin
        after = _cpu_s(simulation.pid)
    cpu_s = {name: after[name] - before[name] for name in before}
    return HeroCost(heroes=heroes, wall_s=wall_s, cpu_s=cpu_s, **vars(sums))


def learnt(simulation: Simulation) -> Policy:
    """The policy that the repository has: encoders of groups, then two layers of 128."""
    mean = trips.policy(simulation.run)
    return lambda rows: mean(SimpleNamespace(observation=torch.from_numpy(rows))).clamp(-1, 1).numpy()  # type: ignore[arg-type]


def untrained(simulation: Simulation) -> Policy:
    """Two layers of 128 with torch's own initial weights: most heroes leave the road within seconds."""
    torch.manual_seed(1)
    width = len(simulation.run["config"]["observation"]["fields"])
    layers: list[nn.Module] = []
    for outputs in LAYERS:
        layers += [nn.Linear(width, outputs), nn.Tanh()]
        width = outputs
    network = nn.Sequential(*layers, nn.Linear(width, 2), nn.Tanh())

    @torch.inference_mode()
    def act(rows: Rows) -> Rows:
        actions: Rows = network(torch.from_numpy(rows)).numpy()
        return actions

    return act


POLICIES: dict[str, Callable[[Simulation], Policy]] = {"learnt": learnt, "untrained": untrained}


class _Sums:
    """What is counted tick by tick."""

    def __init__(self) -> None:
        self.ticks = self.agent_steps = self.ends = 0
        self.policy_s = self.step_s = 0.0


def _drive(env: CarAwareVectorEnv, act: Policy, observation: Rows, ticks: int, sums: _Sums) -> Rows:
    """Drive for some ticks; returns the newest observation."""
    mask = env.slots.now.mask
    for _ in range(ticks):
        begin = time.perf_counter()
        actions = act(observation)
        acted = time.perf_counter()
        observation, _, terminated, truncated, infos = env.step(actions)
        sums.policy_s += acted - begin
        sums.step_s += time.perf_counter() - acted
        sums.ticks += 1
        sums.agent_steps += int(np.count_nonzero(mask))
        sums.ends += int(np.count_nonzero(terminated | truncated))
        mask = infos["mask"]
    return observation


def _cpu_s(supervisor: int) -> dict[str, float]:
    """Processor time so far of each process of the run and of this one, seconds."""
    children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split()
    named = {Path(f"/proc/{child}/comm").read_text().strip(): thread_time_s(int(child)) for child in children}
    return {name: named[name] for name in WORKING} | {"learner": time.process_time()}


def main() -> None:
    """Measure one case and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--heroes", type=int, required=True)
    parser.add_argument("--policy", choices=POLICIES, default="learnt")
    parser.add_argument("--ticks", type=int, default=600)
    parser.add_argument("--warm-up-ticks", type=int, default=100)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    # Idle threads of torch would spin on the cores that the simulation needs.
    torch.set_num_threads(1)
    cost = measure(given.heroes, given.policy, given.ticks, given.warm_up_ticks)
    figures = asdict(cost) | {"agent_steps_per_s": cost.agent_steps_per_s, "waiting_us": cost.waiting_us}
    text = json.dumps(figures)
    print(text)
    if given.json is not None:
        given.json.write_text(text)


if __name__ == "__main__":
    main()
