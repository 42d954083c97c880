"""The samples of one horizon, scored: what an update learns from."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor


@dataclass(frozen=True)
class Batch:
    """The samples of one horizon, `[s]` rows in order of tick, then slot."""

    observation: Tensor
    """f32 `[s, d]`."""
    action: Tensor
    """f32 `[s, 2]`, as sampled, not clipped; `[s, k, 2]` with k > 1 actions per observation."""
    log_probability: Tensor
    """f32 `[s]` or `[s, k]` of the action under the policy that sampled it."""
    reward: Tensor
    """f32 `[s]`, mean over the actions of an observation."""
    advantage: Tensor
    """f32 `[s]` or `[s, k]`, before normalisation."""
    value_target: Tensor
    """f32 `[s]`."""
    truth: Tensor
    """f32 `[s, 4]`."""
    metrics: dict[str, Tensor]
    """Each metric of the task by name: f32 `[s]`, of the policy's mean, which was not sampled."""
    vehicle: Tensor
    """i64 `[s]`."""
    tick: Tensor
    """i64 `[s]`."""

    @staticmethod
    def joined(batches: Sequence["Batch"]) -> "Batch":
        """The rows of all, one batch after the other."""
        first, *others = batches
        return first.followed_by(others) if others else first

    def followed_by(self, others: Sequence["Batch"]) -> "Batch":
        """The rows of this one, then those of the others."""
        batches = [self, *others]
        columns = (f.name for f in fields(Batch) if f.name != "metrics")
        return Batch(
            **{name: torch.cat([getattr(batch, name) for batch in batches]) for name in columns},
            metrics={name: torch.cat([batch.metrics[name] for batch in batches]) for name in self.metrics},
        )

    def to(self, device: torch.device) -> "Batch":
        """The same samples on a device."""
        columns = {name: column.to(device) for name, column in vars(self).items() if name != "metrics"}
        return Batch(**columns, metrics={name: values.to(device) for name, values in self.metrics.items()})

    def value_advantage(self) -> Tensor:
        """f32 `[s]`: the value target minus the value before the update."""
        return self.advantage if self.advantage.ndim == 1 else self.advantage.mean(1)


def save_batch(batch: Batch, parameters: dict[str, Tensor], file: Path) -> None:
    """Write a batch and the parameters that met it, to find out later why its loss is not a number."""
    file.parent.mkdir(parents=True, exist_ok=True)
    columns = {name: column for name, column in vars(batch).items() if name != "metrics"}
    tensors = columns | batch.metrics | parameters
    save_file({name: tensor.clone().cpu() for name, tensor in tensors.items()}, file)
