"""MetaDrive's multi-agent roundabout, headless: `make peers-metadrive`."""

import logging
from pathlib import Path

import metadrive
from metadrive.constants import VERSION as VERSION
from metadrive.envs.marl_envs import MultiAgentRoundaboutEnv

from caraware_bench.agent_steps import measure
from caraware_bench.cost import LoopCost

AGENTS = 40
ACTION = [0.0, 0.1]
"""Steering, throttle (−1 to 1): every agent rolls on; one that crashes or leaves is respawned."""
BLIND = {
    "lidar": {"num_lasers": 0, "num_others": 0, "distance": 0},
    "side_detector": {"num_lasers": 0},
    "lane_line_detector": {"num_lasers": 0},
}


class Roundabout:
    """40 agents, 0.1 s a step: five sub-steps of Bullet's physics."""

    def __init__(self, vehicle: dict[str, object]) -> None:
        config = {"num_agents": AGENTS, "use_render": False, "log_level": logging.ERROR, "vehicle_config": vehicle}
        self._env = MultiAgentRoundaboutEnv(config)
        self._env.reset(seed=0)
        self._over = False

    def ready(self) -> None:
        """Reset at the end of the episode."""
        if self._over:
            self._env.reset(seed=0)

    def step(self) -> int:
        """Make one step of all agents on the road."""
        _, reward, terminated, truncated, _ = self._env.step({agent: ACTION for agent in self._env.agents})
        self._over = terminated["__all__"] or truncated["__all__"]
        return len(reward)

    def close(self) -> None:
        """Free the engine, of which a process can have one."""
        self._env.close()


def costs(seconds: float) -> dict[str, LoopCost]:
    """The cost of agent-steps with the default observation, and without its rays."""
    if not (Path(metadrive.__file__).parent / "assets" / "version.txt").exists():
        # MetaDrive would try to download them.
        raise ImportError("MetaDrive's assets are not installed")
    cases: dict[str, dict[str, object]] = {
        "MetaDrive, roundabout, 40 agents, LIDAR of 72 rays": {},
        "MetaDrive, roundabout, 40 agents, own state only": dict(BLIND),
    }
    return {name: measure(Roundabout(vehicle), seconds) for name, vehicle in cases.items()}
