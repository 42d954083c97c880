"""Measures the rate of a driving environment with many agents."""

import time
from typing import Protocol

from caraware_bench.cost import LoopCost, cpu_s

WARM_UP_STEPS = 10


class World(Protocol):
    """A driving environment that can be stepped."""

    def ready(self) -> None:
        """Reset the environment if no agent is left."""

    def step(self) -> int:
        """Make one step with an action for every agent; return the number of agents that got an observation."""

    def close(self) -> None:
        """End the environment."""


def measure(world: World, seconds: float) -> LoopCost:
    """The cost of at least `seconds` of stepping, without resets and the first steps."""
    try:
        for _ in range(WARM_UP_STEPS):
            world.ready()
            world.step()
        wall_s, used_s, agent_steps = 0.0, 0.0, 0
        while wall_s < seconds:
            world.ready()
            cpu_before_s, begin = cpu_s(), time.perf_counter()
            agent_steps += world.step()
            wall_s += time.perf_counter() - begin
            used_s += cpu_s() - cpu_before_s
        return LoopCost(agent_steps, wall_s, used_s)
    finally:
        world.close()
