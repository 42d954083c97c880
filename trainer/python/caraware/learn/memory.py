"""What networks with memory keep for each slot of an environment, from one tick to the next."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from caraware.ipc.stream import EMPTY_SLOT


@dataclass(frozen=True)
class Memory:
    """The states after one tick, on the CPU."""

    tick: Tensor
    """i64 `[]`; -1 before the first."""
    vehicle: Tensor
    """i64 `[N]`: the vehicle of the state, `EMPTY_SLOT` where the trajectory does not continue."""
    state: Tensor
    """f32 `[N, h]`, 0 where it does not; the states of several networks lie side by side."""

    @classmethod
    def nothing(cls, width: int) -> "Memory":
        """Before the first tick."""
        return cls(torch.tensor(-1), torch.zeros(0, dtype=torch.int64), torch.zeros(0, width))

    @classmethod
    def after(cls, tick: int, vehicle: Tensor, goes_on: Tensor, state: Tensor) -> "Memory":
        """After a tick: of the slots that `goes_on`, bool `[N]`, names."""
        kept = torch.where(goes_on, vehicle, EMPTY_SLOT)
        return cls(torch.tensor(tick), kept, torch.where(goes_on.unsqueeze(1), state, 0.0))

    def before(self, tick: int, vehicle: Tensor, cut: Tensor) -> Tensor:
        """The states f32 `[n, h]` that the slots of `tick` begin with: zero where a trajectory begins.

        It does with another `vehicle` `[n]` than before, where the flags say so (`cut`, bool `[n]`), and where a tick
        is missing: the rules by which `caraware.learn.rollout` ends trajectories.
        """
        state = torch.zeros(len(vehicle), self.state.shape[1])
        if tick == int(self.tick) + 1:
            known = min(len(vehicle), len(self.vehicle))
            same = (self.vehicle[:known] == vehicle[:known]) & ~cut[:known]
            state[:known] = torch.where(same.unsqueeze(1), self.state[:known], 0.0)
        return state

    def part(self, begin: int, end: int) -> "Memory":
        """Of these columns of the state alone."""
        return Memory(self.tick, self.vehicle, self.state[:, begin:end])

    def tensors(self, suffix: str) -> dict[str, Tensor]:
        """For a checkpoint: fields by name."""
        return {f"{f.name}{suffix}": getattr(self, f.name).contiguous() for f in fields(self)}

    @classmethod
    def restored(cls, tensors: dict[str, Tensor], suffix: str) -> "Memory | None":
        """Restore the memory from the result of `tensors`; None if it holds none."""
        names = [f.name for f in fields(cls)]
        if any(f"{name}{suffix}" not in tensors for name in names):
            return None
        return cls(**{name: tensors[f"{name}{suffix}"] for name in names})
