"""What one step of all slots was: the material of rewards."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from caraware.envs.settings import FaceSettings
from caraware.ipc.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt32Array, UInt64Array
from caraware.tasks import ends
from caraware.tasks.contract import Sampling, TaskOutcome, TaskRows, TaskStep


@dataclass(frozen=True)
class Rows:
    """What all slots are at one tick. Row `i` is slot `i`; rows without a vehicle are zero."""

    settings: FaceSettings
    observation: Float32Array
    """f32 `[N, d]`, normalised."""
    truth: Float32Array
    """f32 `[N, 4]`: x and y of the rear axle (m, world), yaw (rad), speed (m/s). No policy may see it."""
    gnss_m: Float32Array
    """f32 `[N, 2]`: newest raw GNSS fix (m, world)."""

    def si(self, field: str) -> Float64Array:
        """f64 `[N]`: a field of the observation in SI units, such as `si("leader_gap")`; clipped at its range."""
        return self.settings.fields.si(self.observation, field)


@dataclass(frozen=True)
class Transition(Rows):
    """One tick that has been answered, and what came of it."""

    mask: BoolArray
    """bool `[N]`: the slot holds a vehicle. Other rows earn nothing, whatever a reward says of them."""
    vehicle: UInt32Array
    """u32 `[N]`: dense index within the simulation's episode."""
    id_hash: UInt64Array
    """u64 `[N]`: hash of the vehicle's SUMO id."""
    terminated: BoolArray
    """bool `[N]`: the trajectory ended with this tick."""
    truncated: BoolArray
    """bool `[N]`: it was cut after this tick."""
    next: Rows
    """A tick later; for trajectories that ended, this tick again: they have no other."""
    ended_by: Int64Array | None = None
    """i64 `[N]`: bits of `caraware.tasks.ends`: why a hero's trajectory ended or was cut, 0 for all others; None where
    it is not known."""

    @property
    def tick_s(self) -> float:
        """Time between the two, seconds."""
        return self.settings.tick_s

    def to_world_m(self, action: Float32Array) -> Float64Array:
        """Actions `[N, 2]` of the localisation task as positions in world metres."""
        actions, observation = torch.from_numpy(action.astype(np.float64)), torch.from_numpy(self.observation)
        position_m: Float64Array = self.settings.task.answer(actions, observation).numpy()
        return position_m

    @cached_property
    def task_step(self) -> TaskStep:
        """The same as a task takes it: tensors over the same memory."""
        return TaskStep(
            observation=torch.from_numpy(self.observation),
            truth=torch.from_numpy(self.truth),
            outcome=TaskOutcome(
                next=TaskRows(torch.from_numpy(self.next.observation), torch.from_numpy(self.next.truth)),
                terminated=torch.from_numpy(self.terminated),
                truncated=torch.from_numpy(self.truncated),
                ended_by=None if self.ended_by is None else torch.from_numpy(self.ended_by),
            ),
        )

    def end_info(self, slot: int) -> dict[str, Any]:
        """Why the hero's trajectory in a slot ended, for `infos`: `end` by name, and a flag for each reason.

        Empty where heroes do not drive. `is_success` is the key that Stable-Baselines3 counts.
        """
        if self.settings.task.sampling is not Sampling.EACH_TICK or self.ended_by is None:
            return {}
        end = ends.name_of(int(self.ended_by[slot]))
        flags = {name.replace(" ", "_").replace("-", "_"): name == end for name in ends.END_NAMES.values()}
        return {"end": end, "is_success": end == ends.END_NAMES[ends.ARRIVAL], **flags}
