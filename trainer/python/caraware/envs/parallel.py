"""`pettingzoo.ParallelEnv`: vehicles as agents, under their SUMO ids."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from caraware.envs.rewards import Reward
from caraware.envs.slots import Slots, Source, Tick
from caraware.ipc.arrays import Float32Array, FloatArray
from caraware.ipc.names import Names
from caraware.ipc.stream import Channel


class CarAwareParallelEnv(ParallelEnv):  # type: ignore[misc]  # pettingzoo has no types
    """Agents are vehicles, such as `cav.12`, that come and go. In an episode, the simulation's, no id is used twice.

    Which vehicles will come is not known before: `possible_agents` holds the ids seen so far and grows. Spaces of
    observations and actions are the same for all. An agent's last step has its last observation; a vehicle that comes
    in a step is in its dictionaries with reward 0 and acts from the next on. An agent without an action gets (0, 0).
    """

    metadata = {"name": "caraware_v0", "render_modes": []}  # noqa: RUF012, as PettingZoo wants it

    def __init__(self, source: Source | Channel, num_slots: int | None = None, reward: Reward | None = None) -> None:
        self.slots = Slots(source, num_slots, reward)
        self.render_mode = None
        self.agents: list[str] = []
        self.possible_agents: list[str] = []
        self._names = Names(self.slots.source.channel.run)
        self._observation_space = self.slots.settings.observation_space()
        self._action_space = self.slots.settings.action_space()
        self._slot_of: dict[str, int] = {}
        self._between = False

    def observation_space(self, agent: str) -> Box:
        """The same for all."""
        return self._observation_space

    def action_space(self, agent: str) -> Box:
        """The same for all."""
        return self._action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Float32Array], dict[str, dict[str, Any]]]:
        """The first tick of a run with `seed`; without, of the simulation's next episode."""
        if seed is not None or not self._between or self.slots.over:
            self.slots.reset(seed)
        self._between = False
        self._take_over(self.slots.now)
        now = self.slots.now
        rows = self._slot_of.items()
        return {agent: now.rows.observation[slot] for agent, slot in rows}, {a: _info(now, slot) for a, slot in rows}

    def step(
        self, actions: dict[str, FloatArray]
    ) -> tuple[dict[str, Float32Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One tick for all agents."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        before, acting = self.slots.now, self._slot_of
        table = np.zeros((self.slots.count, self.slots.task.actions.size), np.float32)
        for agent, action in actions.items():
            table[acting[agent]] = action
        transition, reward = self.slots.step(table)
        now = self.slots.now
        self._between = now.episode != before.episode
        terminated = {agent: bool(transition.terminated[slot]) for agent, slot in acting.items()}
        truncated = {agent: bool(transition.truncated[slot]) for agent, slot in acting.items()}
        observations = {agent: transition.next.observation[slot] for agent, slot in acting.items()}
        rewards = {agent: float(reward[slot]) for agent, slot in acting.items()}
        ended = transition.terminated | transition.truncated
        infos = {agent: _info(before if ended[slot] else now, slot) for agent, slot in acting.items()}
        for agent, slot in acting.items():
            if ended[slot]:
                infos[agent] |= transition.end_info(slot)
        self._take_over(now)
        for agent in self.agents:
            if agent not in acting:
                slot = self._slot_of[agent]
                observations[agent], rewards[agent] = now.rows.observation[slot], 0.0
                terminated[agent], truncated[agent], infos[agent] = False, False, _info(now, slot)
        return observations, rewards, terminated, truncated, infos

    def close(self) -> None:
        """Ends the simulation, or the part in it."""
        self.slots.close()

    def _take_over(self, now: Tick) -> None:
        """The vehicle in a slot is an agent; between two episodes there is none."""
        slots = [] if self._between else np.flatnonzero(now.mask).tolist()
        self._slot_of = {self._names.of(now.id_hash[slot]): slot for slot in slots}
        self.agents = list(self._slot_of)
        known = set(self.possible_agents)
        self.possible_agents += [agent for agent in self.agents if agent not in known]


def _info(tick: Tick, slot: int) -> dict[str, Any]:
    return {"vehicle": int(tick.vehicle[slot]), "truth": tick.rows.truth[slot]}
