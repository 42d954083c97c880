"""Stable-Baselines3's `VecEnv`: every slot is a sub-environment, without a wrapper between."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from caraware.envs.rendering import RENDER_MODES, RgbImage, checked_render_mode
from caraware.envs.rewards import Reward
from caraware.envs.slots import Policy, Slots, Source
from caraware.envs.transition import Transition
from caraware.ipc.arrays import Float32Array, FloatArray
from caraware.ipc.stream import Channel


class CarAwareVecEnv(VecEnv):
    """Slots as sub-environments that reset themselves.

    `infos[i]["mask"]` is False where slot i holds no vehicle: its observation is zero, its action not used, its reward
    0. Stable-Baselines3 has no way to leave such rows out; they make up the beginning of a trajectory. Every `infos[i]`
    has `TimeLimit.truncated`, which is true where a trajectory was cut. At its end it also has `terminal_observation`
    and the `episode` that `Monitor` would give: `r`, the sum of rewards, `l`, the steps with a vehicle, and `t`, the
    seconds since this environment was made.

    `evaluation_policy` answers the evaluation episodes of a run that `caraware` started.
    """

    def __init__(
        self,
        source: Source | Channel,
        num_envs: int | None = None,
        reward: Reward | None = None,
        evaluation_policy: Policy | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Raises `ValueError` for a `render_mode` other than "rgb_array"."""
        self.render_mode = checked_render_mode(render_mode)
        self.slots = Slots(source, num_envs, reward, evaluation_policy)
        settings = self.slots.settings
        self._made_s = time.monotonic()
        self._returns = np.zeros(self.slots.count)
        self._lengths = np.zeros(self.slots.count, np.int64)
        super().__init__(self.slots.count, settings.observation_space(), settings.action_space())
        self.metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": settings.ticks_per_s}

    def reset(self) -> Float32Array:
        """First observation `[N, d]`; the seed is the first of those that `seed()` set."""
        tick = self.slots.reset(self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0.0, 0
        self.reset_infos = [{"mask": bool(held)} for held in tick.mask]
        return tick.rows.observation.copy()

    def step_async(self, actions: FloatArray) -> None:
        """Remembers the actions; in the driving task the world waits for them in `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One tick: observations `[N, d]`, rewards and done `[N]`, infos."""
        transition, reward = self.slots.step(self._actions)
        self._returns += reward
        self._lengths += transition.mask
        infos: list[dict[str, Any]] = [
            {"mask": held, "TimeLimit.truncated": False} for held in self.slots.now.mask.tolist()
        ]
        done = transition.terminated | transition.truncated
        for slot in np.flatnonzero(done):
            infos[slot] |= self._last_words(transition, int(slot))
        self._returns[done], self._lengths[done] = 0.0, 0
        return self.slots.now.rows.observation.copy(), reward.astype(np.float32), done, infos

    def get_images(self) -> Sequence[RgbImage | None]:
        """One image for all sub-environments, which share a world: `render()` shows it as u8 `[H, W, 3]`."""
        return [self.slots.render()]

    def close(self) -> None:
        """Ends the simulation, or the part in it."""
        self.slots.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The attribute of this environment, once for each index: sub-environments have none of their own."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets the attribute of this environment."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Refused: sub-environments have no methods of their own."""
        raise NotImplementedError(f"{method_name}: slots share one simulation and have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Nothing is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def _last_words(self, transition: Transition, slot: int) -> dict[str, Any]:
        return {
            "terminal_observation": transition.observation[slot].copy(),
            "TimeLimit.truncated": bool(transition.truncated[slot]),
            "episode": {
                "r": round(float(self._returns[slot]), 6),
                "l": int(self._lengths[slot]),
                "t": round(time.monotonic() - self._made_s, 6),
            },
            **transition.end_info(slot),
        }
