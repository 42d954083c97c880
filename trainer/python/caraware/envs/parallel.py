"""`pettingzoo.ParallelEnv`: vehicles as agents, under the names of their slots or under their SUMO ids."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from caraware.envs.rendering import RENDER_MODES, RgbImage, checked_render_mode
from caraware.envs.rewards import Reward
from caraware.envs.slots import Policy, Slots, Source, Tick
from caraware.envs.transition import Transition
from caraware.ipc.arrays import BoolArray, Float32Array, FloatArray
from caraware.ipc.names import Names
from caraware.ipc.stream import EMPTY_SLOT, Channel

BRAKE = (0.0, -1.0)
"""The action of a hero whose agent has ended: wheels straight, full deceleration."""


class Agents(StrEnum):
    """What an agent is, and what it is called."""

    SLOTS = "slots"
    """`slot_0` … `slot_N-1`, known beforehand. An agent has one trajectory in an episode."""
    IDS = "ids"
    """Vehicles under their SUMO ids, such as `cav.12`: every vehicle of the episode is an agent."""


class Infos(StrEnum):
    """What `infos` hold."""

    WORDS = "words"
    """Ids and the reasons of ends as text too; at an end more keys than before."""
    NUMBERS = "numbers"
    """The same numeric keys for every agent at every step, as TorchRL's `PettingZooWrapper` needs."""


class CarAwareParallelEnv(ParallelEnv):  # type: ignore[misc]  # pettingzoo has no types
    """All vehicles with a slot as agents. Spaces of observations and actions are the same for all.

    With `agents="slots"` every slot is an agent at the begin of an episode. One without a vehicle has observation 0 and
    reward 0 until its vehicle comes. An agent ends with its vehicle's trajectory and is not revived: PettingZoo does
    not allow that within an episode. The episode ends with its last agent or with the simulation's episode, and
    `reset()` continues with the vehicles that then hold the slots. Meanwhile `waiting_policy` (f32 `[N, d]` →
    `[N, a]`) drives the vehicles in slots whose agent has ended; without it, heroes brake.

    With `agents="ids"` agents are vehicles that come and go, and the episode is the simulation's, in which no id is
    used twice. Which vehicles will come is not known before: `possible_agents` holds the ids seen so far and grows. A
    vehicle that comes in a step is in its dictionaries with reward 0 and acts from the next on.

    An agent's last step has its last observation. An agent without an action gets (0, 0). `infos[agent]` has `id`
    (SUMO's, "" without a vehicle), `vehicle` (dense index, −1 without), `truth` and `mask` (False without a vehicle);
    at the end of a hero's trajectory also `end`, `is_success` and a flag for each reason. With `infos="numbers"` it has
    `vehicle`, `truth`, `mask` and `ended_by` (bits of `caraware.tasks.ends`).
    """

    metadata = {"name": "caraware_v0", "render_modes": RENDER_MODES, "render_fps": 10}  # noqa: RUF012, as PettingZoo wants it

    def __init__(
        self,
        source: Source | Channel,
        num_slots: int | None = None,
        reward: Reward | None = None,
        *,
        agents: str = Agents.SLOTS,
        infos: str = Infos.WORDS,
        waiting_policy: Policy | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Raises `ValueError` for another `agents`, `infos` or `render_mode` than the named ones."""
        self._agents_are, self._infos_hold = Agents(agents), Infos(infos)
        self.render_mode = checked_render_mode(render_mode)
        self.slots = Slots(source, num_slots, reward)
        self.metadata = self.metadata | {"render_fps": self.slots.settings.ticks_per_s}
        self.agents: list[str] = []
        self.possible_agents: list[str] = []
        if self._agents_are is Agents.SLOTS:
            self.possible_agents = [f"slot_{slot}" for slot in range(self.slots.count)]
        self._waiting_policy = waiting_policy
        self._names = Names(self.slots.source.channel.run)
        self._observation_space = self.slots.settings.observation_space()
        self._action_space = self.slots.settings.action_space()
        self._slot_of: dict[str, int] = {}
        self._between = False
        """The present tick is the first of an episode that `reset()` has not begun."""

    def observation_space(self, agent: str) -> Box:
        """The same for all: f32 `[d]`."""
        return self._observation_space

    def action_space(self, agent: str) -> Box:
        """The same for all: f32 `[a]`."""
        return self._action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Float32Array], dict[str, dict[str, Any]]]:
        """The first observations, f32 `[d]` each, of a run with `seed`; without, of the next episode."""
        if seed is not None or not self._between or self.slots.over:
            self.slots.reset(seed)
        self._between = False
        now = self.slots.now
        if self._agents_are is Agents.SLOTS:
            self._slot_of = {agent: slot for slot, agent in enumerate(self.possible_agents)}
        else:
            self._slot_of = self._vehicles(now)
        self.agents = list(self._slot_of)
        rows = self._slot_of.items()
        observations = {agent: now.rows.observation[slot].copy() for agent, slot in rows}
        return observations, {agent: self._info(now, slot) for agent, slot in rows}

    def step(
        self, actions: dict[str, FloatArray]
    ) -> tuple[dict[str, Float32Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One tick for all agents. Actions of agents that have ended are ignored; `KeyError` for an unknown agent."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        before, acting = self.slots.now, self._slot_of
        transition, reward = self.slots.step(self._action_table(actions))
        now = self.slots.now
        over = now.episode != before.episode
        terminated = transition.terminated
        # An agent that has waited for its vehicle until the end of the episode ends with it.
        truncated = transition.truncated | (~terminated if over else False)
        ended = terminated | truncated
        observations: dict[str, Float32Array] = {}
        infos: dict[str, dict[str, Any]] = {}
        for agent, slot in acting.items():
            observations[agent] = (transition if ended[slot] else now.rows).observation[slot].copy()
            infos[agent] = self._last_info(before, transition, slot) if ended[slot] else self._info(now, slot)
        rewards = {agent: float(reward[slot]) for agent, slot in acting.items()}
        terminations = {agent: bool(terminated[slot]) for agent, slot in acting.items()}
        truncations = {agent: bool(truncated[slot]) for agent, slot in acting.items()}
        for agent, slot in self._continue(now, ended, over).items():
            observations[agent], rewards[agent] = now.rows.observation[slot].copy(), 0.0
            terminations[agent], truncations[agent], infos[agent] = False, False, self._info(now, slot)
        return observations, rewards, terminations, truncations, infos

    def render(self) -> RgbImage | None:
        """The map from above with all vehicles that have a slot: u8 `[H, W, 3]`; None without a `render_mode`."""
        return None if self.render_mode is None else self.slots.render()

    def close(self) -> None:
        """Ends the simulation, or the part in it."""
        self.slots.close()

    def _action_table(self, actions: dict[str, FloatArray]) -> Float32Array:
        """f32 `[N, a]`: the agents' actions, and those of vehicles whose agent has ended."""
        table = np.zeros((self.slots.count, self.slots.task.actions.size), np.float32)
        without_agent = np.ones(self.slots.count, bool)
        without_agent[list(self._slot_of.values())] = False
        if without_agent.any():
            if self._waiting_policy is not None:
                table[without_agent] = self._waiting_policy(self.slots.now.rows.observation)[without_agent]
            elif self.slots.world_waits:
                table[without_agent] = BRAKE
        for agent, action in actions.items():
            if agent in self._slot_of:
                table[self._slot_of[agent]] = action
            elif agent not in self.possible_agents:
                raise KeyError(agent)
        return table

    def _continue(self, now: Tick, ended: BoolArray, over: bool) -> dict[str, int]:
        """Takes over the agents of the next step; returns those that come in this one, with their slots."""
        before = self._slot_of
        if over:
            self._slot_of = {}
        elif self._agents_are is Agents.SLOTS:
            self._slot_of = {agent: slot for agent, slot in before.items() if not ended[slot]}
        else:
            self._slot_of = self._vehicles(now)
        self.agents, self._between = list(self._slot_of), not self._slot_of
        return {agent: slot for agent, slot in self._slot_of.items() if agent not in before}

    def _vehicles(self, now: Tick) -> dict[str, int]:
        """The slots of all vehicles by their ids."""
        slot_of = {self._names.of(now.id_hash[slot]): slot for slot in np.flatnonzero(now.mask).tolist()}
        known = set(self.possible_agents)
        self.possible_agents += [agent for agent in slot_of if agent not in known]
        return slot_of

    def _info(self, tick: Tick, slot: int, ended_by: int = 0) -> dict[str, Any]:
        held = bool(tick.mask[slot])
        vehicle = int(tick.vehicle[slot])
        info = {
            "vehicle": vehicle if vehicle != EMPTY_SLOT else -1,
            "truth": tick.rows.truth[slot].copy(),
            "mask": held,
        }
        if self._infos_hold is Infos.NUMBERS:
            return info | {"ended_by": ended_by}
        return {"id": self._names.of(tick.id_hash[slot]) if held else ""} | info

    def _last_info(self, before: Tick, transition: Transition, slot: int) -> dict[str, Any]:
        ended_by = 0 if transition.ended_by is None else int(transition.ended_by[slot])
        info = self._info(before, slot, ended_by)
        if self._infos_hold is Infos.WORDS and before.mask[slot]:
            info |= transition.end_info(slot)
        return info
