"""The learner of a training run: PPO, the baseline beside it, and how far both have come."""

import logging
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from caraware.learn.build import build_ppo
from caraware.learn.config import ConfigError
from caraware.learn.ppo import Ppo
from caraware.learn.ranks import Ranks
from caraware.learn.regression import Regression
from caraware.learn.stored import PARAMETERS, SUPERVISED, LearnerShape, StoredTensors
from caraware.learn.supervised import Supervised
from caraware.run.checkpoint import TrainingHistory, load_checkpoint, load_history
from caraware.run.config import RunConfig
from caraware.run.continuation import Continuation
from caraware.run.manifest import CheckpointError, Counters
from caraware.run.stream_position import StreamPosition
from caraware.tasks.lane import LanePosition
from caraware.tasks.localisation import Localisation

log = logging.getLogger(__name__)


@dataclass
class Learner:
    """Policy, value network and how far they have come: new, or continued from a checkpoint."""

    ppo: Ppo
    supervised: Supervised | Regression | None
    """The baseline by regression, taught from the same batches."""
    counters: Counters
    history: TrainingHistory
    follows_another: bool = False
    """Whether other parameters drew the actions of the ticks that it begins with: another learner's, or older ones."""

    @classmethod
    def begin(cls, config: RunConfig, observation_size: int, ranks: Ranks | None = None) -> "Learner":
        """A learner for observations of this size, continued from `config.resume_from`. Raises `CheckpointError`."""
        trainer = config.trainer
        ppo = build_ppo(trainer, observation_size, config.task, config.environments, ranks)
        beside: Supervised | Regression | None = None
        if trainer.supervised and isinstance(config.task, Localisation):
            beside = Supervised(trainer, observation_size, config.task, ppo.device, ranks)
        elif trainer.supervised and isinstance(config.task, LanePosition):
            if ranks is not None and ranks.size > 1:
                raise ConfigError(
                    f"`trainer.supervised` with `task.kind` = {config.task.name!r} and several ranks",
                    "set trainer.supervised = false: the regression of this task learns from one rank's samples",
                )
            beside = Regression(trainer, observation_size, config.task, ppo.device)
        learner = cls(ppo, beside, Counters(0, 0, 0, -1), TrainingHistory())
        if config.resume_from is not None:
            learner.load(config.resume_from)
        elif config.begin_from is not None:
            lacks_values = not begin_from(ppo.updater.parameters(), config.begin_from)
            if lacks_values and trainer.value_updates == 0:
                log.warning(
                    "%s has no value network, and a policy that follows an untrained one unlearns: "
                    "set trainer.value_updates = 8, so that eight updates teach the values alone",
                    config.begin_from,
                )
        return learner

    def warm_up(self) -> None:
        """Make a first prediction now, so that the next one does not wait for what it initialises."""
        self.ppo.predict_m([torch.zeros(1, self.ppo.observation_size)])

    def load(self, checkpoint: Path) -> None:
        """Continue from a checkpoint. Raises `CheckpointError`."""
        self.counters, self.history = load_checkpoint(checkpoint, self), load_history(checkpoint)

    def follow(self, continuation: Continuation) -> None:
        """Continue where other learners have come since the checkpoint."""
        counters, history = continuation.follow(self.counters, self.history)
        if (counters, history) == (self.counters, self.history):
            return
        self.counters, self.history, self.ppo.updates = counters, history, counters.updates
        self.follows_another = True
        # What the networks remember is of the ticks before those that others have learnt.
        self.ppo.restore_memory({})

    def take_parameters(self, checkpoint: Path) -> None:
        """Parameters, moments and generators of any checkpoint; the count of updates and ticks stays this run's."""
        updates = self.ppo.updates
        load_checkpoint(checkpoint, self)
        self.ppo.updates = updates
        self.follows_another = True
        # What another network remembers of other ticks says nothing about this run's.
        self.ppo.restore_memory({})

    def positions(self) -> list[StreamPosition]:
        """How far each environment has come; one that the checkpoint does not know is at its beginning."""
        return [self.history.first_position(self.counters), *self.history.others]

    def first_tick(self, environment: int = 0) -> int:
        """The first tick of an environment that is not in the checkpoint."""
        positions = self.positions()
        return positions[environment].committed_tick + 1 if environment < len(positions) else 0

    def for_play(self) -> Ppo:
        """The policy without its memory of the vehicles of the run that trained it."""
        self.ppo.restore_memory({})
        return self.ppo

    def shape(self) -> LearnerShape:
        """See `StoredLearner.shape`."""
        return self.ppo.shape()

    def schedules(self) -> dict[str, float]:
        """See `StoredLearner.schedules`."""
        return self.ppo.schedules()

    def tensors(self) -> StoredTensors:
        """See `StoredLearner.tensors`."""
        return self.ppo.tensors() | ({SUPERVISED: self.supervised.tensors()} if self.supervised else {})

    def restore(self, stored: StoredTensors, updates: int) -> None:
        """See `StoredLearner.restore`."""
        self.ppo.restore(stored, updates)
        if self.supervised is not None and SUPERVISED in stored:
            self.supervised.restore(stored[SUPERVISED])


def begin_from(own: dict[str, Tensor], place: Path) -> bool:
    """Fill the parameters of a new policy from a checkpoint or a file. Raises `CheckpointError`.

    Parameters that the file lacks stay as drawn: a clone of a driver has no values. False if it has none.
    """
    file = place / PARAMETERS if place.is_dir() else place
    try:
        stored = load_file(file)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(file, f"cannot be read: {error}") from error
    known = {name: tensor for name, tensor in stored.items() if name in own}
    if not known or any(own[name].shape != tensor.shape for name, tensor in known.items()):
        raise CheckpointError(file, "does not hold parameters of this run's networks")
    for name, tensor in known.items():
        own[name].copy_(tensor)
    return any(name.startswith("value.") for name in known)
