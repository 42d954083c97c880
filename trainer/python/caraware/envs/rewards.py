"""Rewards of whole steps, one number for each slot. Any function of a `Transition` and actions can take their place."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from caraware.envs.transition import Transition
from caraware.ipc.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from caraware.tasks.contract import Task
from caraware.tasks.driving import ARRIVED_WITHIN_M

Reward = Callable[[Transition, Float32Array], FloatArray]
"""`(obs, action [N, a]) -> reward [N]`. What it says of rows without a vehicle does not count."""


def of_task(task: Task) -> Reward:
    """The reward that the task itself gives."""

    def reward(obs: Transition, action: Float32Array) -> FloatArray:
        earned: Float64Array = task.reward(obs.task_step, torch.from_numpy(action.astype(np.float64))).numpy()
        return earned

    return reward


def measured(obs: Transition, action: Float32Array) -> dict[str, Float64Array]:
    """f64 `[N]`: each metric of the task by name."""
    values = obs.settings.task.measure(obs.task_step, torch.from_numpy(action.astype(np.float64)))
    return {name: value.numpy() for name, value in values.items()}


def arrived(obs: Transition) -> BoolArray:
    """bool `[N]`: the hero's episode ended at the end of its route, and not by a collision or beside the road."""
    # Within 10 cm: `route_left` is one of 2²⁴ steps of 1000 m.
    at_the_end: BoolArray = obs.terminated & (obs.si("route_left") <= ARRIVED_WITHIN_M + 0.1)
    return at_the_end
