"""`gymnasium.vector.VectorEnv`: every slot is a sub-environment, all of them in one world."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from caraware.envs.rendering import RENDER_MODES, RgbImage, checked_render_mode
from caraware.envs.rewards import Reward, measured
from caraware.envs.slots import Policy, Slots, Source, Tick
from caraware.envs.transition import Transition
from caraware.ipc.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from caraware.ipc.stream import Channel


class CarAwareVectorEnv(VectorEnv):
    """Slots as sub-environments with SAME_STEP autoreset.

    `infos["mask"]` (bool `[N]`) marks slots with a vehicle. A row without one is zero, earns 0 and its action is
    not used; it is the time before the next trajectory of that slot. Where a trajectory ended, `infos["final_obs"]` has
    its last observation and `infos["final_info"]` what else is known of it. Further keys: `vehicle`, `id_hash`, `truth`
    of the rows returned, and each metric of the task by name, such as `error_m`, of the actions taken.

    A `num_envs` other than `traffic.cavs` or the number of heroes takes the first slots only. `evaluation_policy`
    answers the evaluation episodes of a run that `caraware` started; those are neither stepped nor learned from.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012, as Gymnasium wants it
        "render_modes": RENDER_MODES,
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    autoreset_mode = AutoresetMode.SAME_STEP
    """The same beside `metadata`: TorchRL reads it where Gymnasium's own vector environments have it."""

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
        self.num_envs = self.slots.count
        self.metadata = self.metadata | {"render_fps": self.slots.settings.ticks_per_s}
        self.spec = None
        self.single_observation_space = self.slots.settings.observation_space()
        self.single_action_space = self.slots.settings.action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._all = np.ones(self.num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """First observation `[N, d]` of a run with `seed`; without, of the simulation's next episode.

        All slots share a world, so there is one seed: of a list the first counts.
        """
        if options and "reset_mask" in options:
            raise ValueError(
                "slots share a world and cannot be reset one by one; SAME_STEP autoreset needs no reset_mask"
            )
        if isinstance(seed, list | tuple):
            seed = seed[0]
        super().reset(seed=seed)
        tick = self.slots.reset(seed)
        return tick.rows.observation.copy(), self._info(tick)

    def step(self, actions: FloatArray) -> tuple[Float32Array, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Observations `[N, d]`, rewards, terminated, truncated `[N]`, infos."""
        transition, reward = self.slots.step(actions)
        tick = self.slots.now
        infos = self._info(tick)
        for name, value in measured(transition, np.asarray(actions, np.float32)).items():
            infos[name], infos[f"_{name}"] = np.where(transition.mask, value, 0.0), transition.mask
        ended = transition.terminated | transition.truncated
        if ended.any():
            infos |= _final(transition, ended)
        return tick.rows.observation.copy(), reward, transition.terminated, transition.truncated, infos

    def render(self) -> tuple[RgbImage, ...] | None:
        """For each slot the map from above with its vehicle in another colour: N times u8 `[H, W, 3]`.

        None without a `render_mode`.
        """
        return None if self.render_mode is None else tuple(self.slots.render(slot) for slot in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the simulation, or the part in it."""
        self.slots.close()

    def _info(self, tick: Tick) -> dict[str, Any]:
        infos: dict[str, Any] = {"mask": tick.mask, "_mask": self._all}
        for key, value in _named(tick, tick.rows.truth).items():
            infos[key], infos[f"_{key}"] = value, tick.mask
        return infos


def _named(rows: Tick | Transition, truth: Float32Array) -> dict[str, NDArray[Any]]:
    """Which vehicles the rows are of, in types that torch can index: i64 `[N]` and `[N]`, f32 `[N, 4]`.

    `id_hash` has the 64 bits of the hash.
    """
    return {"vehicle": rows.vehicle.astype(np.int64), "id_hash": rows.id_hash.view(np.int64), "truth": truth.copy()}


def _final(transition: Transition, ended: BoolArray) -> dict[str, Any]:
    """Gymnasium's keys for trajectories that ended in this step."""
    final_obs = np.full(len(ended), None, dtype=object)
    for slot in np.flatnonzero(ended):
        final_obs[slot] = transition.observation[slot].copy()
    info: dict[str, Any] = {}
    for key, value in _named(transition, transition.truth).items():
        info[key], info[f"_{key}"] = value, ended
    words = {int(number): transition.end_info(int(number)) for number in np.flatnonzero(ended)}
    for key, value in next(iter(words.values())).items():
        column: NDArray[Any] = np.full(len(ended), type(value)(), dtype=bool if isinstance(value, bool) else object)
        for number, of_slot in words.items():
            column[number] = of_slot[key]
        info[key], info[f"_{key}"] = column, ended
    return {"final_obs": final_obs, "_final_obs": ended, "final_info": info, "_final_info": ended}
