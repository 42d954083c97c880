"""Rewards of whole steps, one number for each slot. Any function of a `Transition` and actions can take their place."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from caraware.envs.task import Task
from caraware.envs.transition import Transition
from caraware.ipc.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from caraware.learn import rewards

Reward = Callable[[Transition, Float32Array], FloatArray]
"""`(obs, action [N, 2]) -> reward [N]`. What it says of rows without a vehicle does not count."""

ARRIVED_WITHIN_M = 5.0
"""A hero whose episode ends this near to the end of its route has arrived (docs/driving.md)."""
FAR_M = 999.0
"""Beyond it `route_left` is at the end of its range and does not tell progress."""


def default(task: Task) -> Reward:
    """The reward of a task: `trainer.reward` of the configuration, or `driving`."""
    return driving if task.drives else localisation(task.reward, task.reward_scale_m)


def localisation(name: str, scale_m: float) -> Reward:
    """The reward called `name` in `caraware.learn.rewards`, of the distance between prediction and truth."""
    function = rewards.by_name(name)

    def reward(obs: Transition, action: Float32Array) -> FloatArray:
        earned: Float64Array = function(torch.from_numpy(error_m(obs, action)), scale_m).numpy()
        return earned

    return reward


def error_m(obs: Transition, action: Float32Array) -> Float64Array:
    """f64 `[N]`: distance of the positions that actions mean to the truth, metres."""
    away = obs.to_world_m(action) - obs.truth[:, :2]
    return np.hypot(away[:, 0], away[:, 1])


def arrived(obs: Transition) -> BoolArray:
    """bool `[N]`: the hero's episode ended at the end of its route, and not by a collision or beside the road."""
    # Within 10 cm: `route_left` is one of 2²⁴ steps of 1000 m.
    at_the_end: BoolArray = obs.terminated & (obs.si("route_left") <= ARRIVED_WITHIN_M + 0.1)
    return at_the_end


def driving(obs: Transition, action: Float32Array) -> Float64Array:
    """Metres along the route, in tens; less for what is beside it; ±10 for the end.

    A tick of 10 m/s earns 0.1, one 5 m beside the line costs as much. Arrival earns 10, a collision or leaving the road
    costs 10. A time limit is neither: the trajectory is truncated.
    """
    before, after = obs.si("route_left"), obs.next.si("route_left")
    far = (before > FAR_M) | (after > FAR_M)
    progress_m = np.where(far, obs.next.truth[:, 3] * obs.tick_s, before - after)
    on_the_way: Float64Array = progress_m / 10 - 0.02 * np.abs(obs.next.si("route_offset"))
    ended = obs.terminated | obs.truncated
    if not ended.any():
        return on_the_way
    end = np.where(arrived(obs), 10.0, np.where(obs.terminated, -10.0, 0.0))
    return np.where(ended, end, on_the_way)
