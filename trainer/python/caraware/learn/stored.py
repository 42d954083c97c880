"""The contract between a learner and its checkpoints: tensors by file and name, and a shape that must agree."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

PARAMETERS = "parameters.safetensors"
OPTIMISER = "optimiser.safetensors"
RANDOM = "random.safetensors"
"""States of the random number generators; in a checkpoint of several ranks those of all."""
MEMORY = "memory.safetensors"
"""What networks remember of trajectories at the committed tick; networks that see one moment have none."""
SUPERVISED = "supervised.safetensors"
"""The baseline beside PPO. A checkpoint of a run without it has none; then the baseline starts from the beginning."""

PPO, FUSION = "ppo", "fusion"
"""The learners of this project: what their checkpoints and commits are named by."""

StoredTensors = dict[str, dict[str, Tensor]]
"""Tensors by file, then by name."""


@dataclass(frozen=True)
class LearnerShape:
    """What a checkpoint and the learner that continues from it must agree on."""

    learner: str
    """`PPO` or `FUSION`."""
    observation_size: int
    network: str
    hidden: tuple[int, ...]
    activation: str


class StoredLearner(Protocol):
    """A learner as a checkpoint sees it."""

    def shape(self) -> LearnerShape:
        """What a checkpoint must agree with."""
        ...

    def schedules(self) -> dict[str, float]:
        """The scheduled values of the newest update, by name."""
        ...

    def tensors(self) -> StoredTensors:
        """Everything that a checkpoint holds."""
        ...

    def restore(self, stored: StoredTensors, updates: int) -> None:
        """Continue from the tensors of a checkpoint, which have the names and shapes of `tensors`."""
        ...
