"""SMARTS's HiWayEnv, headless, on a SUMO net: `make peers-smarts` (Python 3.10)."""

import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from importlib.metadata import version
from pathlib import Path

from smarts.core.agent_interface import AgentInterface, AgentType
from smarts.core.controllers import ActionSpaceType
from smarts.env.gymnasium.hiway_env_v1 import HiWayEnvV1
from smarts.sstudio import gen_scenario
from smarts.sstudio.sstypes import EndlessMission, Scenario

from caraware_bench.agent_steps import measure
from caraware_bench.cost import LoopCost

VERSION = version("smarts")
AGENTS = [f"agent-{number}" for number in range(8)]
"""Eight agents, because SMARTS enumerates all orders of its missions before it begins."""


KEEP_LANE = 0


def streets(net: Path) -> list[str]:
    """Ids of the first streets of a net, one for each agent."""
    edges = ElementTree.parse(net).iterfind("edge")
    return [edge.attrib["id"] for edge in edges if edge.get("function") != "internal"][: len(AGENTS)]


class HighWay:
    """Eight agents that keep to their lane wherever it leads, and no other traffic, 0.1 s a step."""

    def __init__(self, scenario: Path, interface: AgentInterface) -> None:
        interfaces = dict.fromkeys(AGENTS, interface)
        self._env = HiWayEnvV1(scenarios=[str(scenario)], agent_interfaces=interfaces, headless=True, seed=1)
        self._driving: set[str] = set()

    def ready(self) -> None:
        """Reset once all agents have ended."""
        if not self._driving:
            observation, _ = self._env.reset()
            self._driving = set(observation)

    def step(self) -> int:
        """Make one step of all agents that still drive."""
        actions = dict.fromkeys(self._driving, KEEP_LANE)
        observation, _, terminated, truncated, _ = self._env.step(actions)
        self._driving = {agent for agent in observation if not (terminated[agent] or truncated[agent])}
        return len(observation)

    def close(self) -> None:
        """End the environment, and SUMO with it."""
        self._env.close()


def costs(net: Path, seconds: float) -> dict[str, LoopCost]:
    """The cost of agent-steps with way points, as in SMARTS's examples, and with the agent's own state only."""
    cases = {
        "SMARTS, 8 agents, way points": AgentInterface.from_type(AgentType.Laner),
        "SMARTS, 8 agents, own state only": AgentInterface(action=ActionSpaceType.Lane),
    }
    with tempfile.TemporaryDirectory() as directory:
        scenario = Path(directory)
        shutil.copy(net, scenario / "map.net.xml")
        missions = [EndlessMission(begin=(street, 0, 50.0)) for street in streets(net)]
        gen_scenario(Scenario(ego_missions=missions), output_dir=scenario)
        return {name: measure(HighWay(scenario, interface), seconds) for name, interface in cases.items()}
