"""Measures the rate of a driving environment with many agents."""

import time
from typing import Protocol

WARM_UP_STEPS = 10


class World(Protocol):
    """A driving environment that can be stepped."""

    def ready(self) -> None:
        """Reset the environment if no agent is left."""

    def step(self) -> int:
        """Make one step with an action for every agent; return the number of agents that got an observation."""

    def close(self) -> None:
        """End the environment."""


def agent_steps_per_s(world: World, seconds: float) -> float:
    """Agent-steps per wall second over at least `seconds` of stepping, without resets and the first steps."""
    try:
        for _ in range(WARM_UP_STEPS):
            world.ready()
            world.step()
        taken_s, agent_steps = 0.0, 0
        while taken_s < seconds:
            world.ready()
            begin = time.perf_counter()
            agent_steps += world.step()
            taken_s += time.perf_counter() - begin
        return agent_steps / taken_s
    finally:
        world.close()
