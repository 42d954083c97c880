"""`gymnasium.Env`: one vehicle at a time, the one in a slot."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from caraware.envs.rendering import RENDER_MODES, RgbImage, checked_render_mode
from caraware.envs.rewards import Reward
from caraware.envs.slots import Slots, Source, Tick
from caraware.ipc.arrays import Float32Array, FloatArray
from caraware.ipc.names import Names
from caraware.ipc.stream import Channel


class CarAwareEnv(gymnasium.Env):
    """The vehicle in one slot; its episode lasts as long as it holds the slot.

    After an end, `reset()` runs on to the next vehicle in the slot. In the middle of an episode it runs on to the
    simulation's next episode. Other slots get action 0: a simulation for this face has one vehicle, `traffic.cavs = 1`
    or one hero. `info` has `id`, `vehicle` and `truth` of the observation returned; at the end of
    a hero's episode also `end`, its reason, `is_success`, and a flag for each reason.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 10}  # noqa: RUF012, as Gymnasium wants it

    def __init__(
        self,
        source: Source | Channel,
        slot: int = 0,
        reward: Reward | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Raises `ValueError` for a `render_mode` other than "rgb_array"."""
        self.render_mode = checked_render_mode(render_mode)
        self.slots = Slots(source, None if slot == 0 else slot + 1, reward, of_scenario=1)
        self.metadata = self.metadata | {"render_fps": self.slots.settings.ticks_per_s}
        self.observation_space = self.slots.settings.observation_space()
        self.action_space = self.slots.settings.action_space()
        self._slot, self._names = slot, Names(self.slots.source.channel.run)
        self._actions = np.zeros((self.slots.count, self.slots.task.actions.size), np.float32)
        self._ended = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """First observation `[d]` of a vehicle: the first of a run with `seed`, without the next."""
        super().reset(seed=seed)
        if seed is not None or not self._ended:
            self.slots.reset(seed)
        tick = self.slots.seek(self._slot)
        self._ended = False
        return tick.rows.observation[self._slot].copy(), self._info(tick)

    def step(self, action: FloatArray) -> tuple[Float32Array, float, bool, bool, dict[str, Any]]:
        """One tick. At the end of an episode the observation is the vehicle's last once more."""
        if self._ended:
            raise RuntimeError("the episode has ended: call reset() before step()")
        before, slot = self.slots.now, self._slot
        self._actions[slot] = action
        transition, reward = self.slots.step(self._actions)
        terminated, truncated = bool(transition.terminated[slot]), bool(transition.truncated[slot])
        self._ended = terminated or truncated
        info = self._info(before if self._ended else self.slots.now)
        if self._ended:
            info |= transition.end_info(slot)
        return transition.next.observation[slot].copy(), float(reward[slot]), terminated, truncated, info

    def render(self) -> RgbImage | None:
        """The map from above with this vehicle in another colour: u8 `[H, W, 3]`; None without a `render_mode`."""
        return None if self.render_mode is None else self.slots.render(self._slot)

    def close(self) -> None:
        """Ends the simulation, or the part in it."""
        self.slots.close()

    def _info(self, tick: Tick) -> dict[str, Any]:
        slot = self._slot
        return {
            "id": self._names.of(tick.id_hash[slot]),
            "vehicle": int(tick.vehicle[slot]),
            "truth": tick.rows.truth[slot].copy(),
        }
