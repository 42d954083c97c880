"""How the estimator learns: from all episodes so far, along the gradient of its mean error through time.

PPO must guess the gradient of a reward from random actions, since it does not know how actions lead to rewards. Here
that is known: an estimate is a sum of corrections, and the error a function of it. So the gradient is taken through
the sum and the network's memory (truncated backpropagation through time; R. Williams and J. Peng, 1990). The truth
appears in the loss alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from torch import Tensor

from caraware.baselines.lanes import Pieces, read_pieces
from caraware.baselines.map_ekf import lane_map, world_origin_of_run
from caraware.baselines.noise import SensorNoise
from caraware.fusion.carrier import Carried, Carrier
from caraware.fusion.estimator import FusionEstimator, FusionNetwork, distance_loss
from caraware.fusion.past import Episode, Past
from caraware.ipc.run_file import RunFile, config_table
from caraware.learn.adam import Adam
from caraware.learn.config import ConfigError, MapBounds, TrainerConfig
from caraware.learn.flat import FlatParameters
from caraware.learn.ppo import NonFiniteLoss
from caraware.learn.stored import FUSION, OPTIMISER, PARAMETERS, RANDOM, LearnerShape, StoredTensors

WARM_UP_UPDATES = 3
"""Updates over which the learning rate rises: Adam's first steps are as long as the rate, whatever the gradient."""


@dataclass(frozen=True)
class FusionConfig:
    """Table `fusion` of the configuration."""

    map: bool
    """Whether the estimator has the lanes of the net."""
    segment_ticks: int
    """The estimator learns from episodes in pieces of so many ticks, side by side."""
    truncation_ticks: int
    """Ticks between two gradient steps; the gradient reaches no further back."""

    @classmethod
    def from_run(cls, run: RunFile) -> "FusionConfig":
        """Read `run["config"]["fusion"]`. Raises `ConfigError`."""
        section = config_table(run, "fusion")
        if missing := sorted({f.name for f in fields(cls)} - set(section)):
            help = "it is of another version of `caraware`"
            raise ConfigError(f"the run file lacks the key `fusion.{missing[0]}`", help)
        config = cls(**{f.name: section[f.name] for f in fields(cls)})
        if config.segment_ticks % config.truncation_ticks != 0:
            raise ConfigError(
                f"`fusion.segment_ticks` = {config.segment_ticks} is no multiple of"
                f" `fusion.truncation_ticks` = {config.truncation_ticks}",
                "every gradient step takes as many ticks: give a multiple",
            )
        return config

    def pieces(self, run: RunFile) -> Pieces:
        """The lanes of the run's net; none without a map. Raises `OSError`."""
        if not self.map:
            return Pieces.none()
        return read_pieces(Path(run["scene_files"]["net_file"]), world_origin_of_run(run))


@dataclass(frozen=True)
class FusionStats:
    """What one episode taught."""

    loss_m: float
    """Mean error in the first pass over drawn pieces, each starting from the filter's estimate."""
    last_loss_m: float
    """In the last pass."""
    gradient_norm: float
    learning_rate: float
    steps: int
    """Gradient steps."""


class FusionLearner:
    """Estimator, optimiser and random numbers: everything that a checkpoint must hold."""

    def __init__(
        self,
        trainer: TrainerConfig,
        fusion: FusionConfig,
        pieces: Pieces,
        bounds: MapBounds,
        observation_size: int,
        past: Past | None = None,
    ) -> None:
        """It reads the raw samples; `observation_size` is that of the run, which a checkpoint must agree with.

        Without a `past` there is none yet, and it is in memory alone.
        """
        self.past = past or Past()
        self.config, self.fusion, self.observation_size = trainer, fusion, observation_size
        self._pieces = pieces
        self.updates = 0
        self.progress = 0.0
        """Share of all training episodes that is done, as of the newest update."""
        torch.set_num_threads(1)  # matrices this small are not worth a second thread
        self.random = torch.Generator().manual_seed(trainer.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(trainer.seed)
            network = FusionNetwork(trainer.hidden[0])
        self.parameters = _flattened(network)
        self.optimiser = Adam(self.parameters)
        centre_m = ((bounds.x_min_m + bounds.x_max_m) / 2, (bounds.y_min_m + bounds.y_max_m) / 2)
        self.estimator = FusionEstimator(network, pieces, centre_m)

    def carrier(self, noise: SensorNoise) -> Carrier:
        """The filters that the estimator starts as: with the map that it has."""
        centre_x_m, centre_y_m = self.estimator.centre_m.tolist()
        return Carrier(noise, (centre_x_m, centre_y_m), lane_map(self._pieces) if len(self._pieces) else None)

    def learn(
        self, episode: Episode, progress: float, stop_requested: Callable[[], bool] = lambda: False
    ) -> FusionStats:
        """Some passes over pieces drawn from this episode and all before; `progress` is the share of training done.

        Raises `NonFiniteLoss`, and `OSError` where the episode cannot be kept.
        """
        self.progress, learning_rate = progress, self._learning_rate(progress, self.updates + 1)
        self.past.add(self.updates + 1, episode.pieces(self.fusion.segment_ticks), stop_requested)
        log = [self._pass(learning_rate) for _ in range(self.config.epochs)]
        self.updates += 1
        steps = sum(len(losses) for losses, _ in log)
        return FusionStats(
            loss_m=sum(log[0][0]) / len(log[0][0]),
            last_loss_m=sum(log[-1][0]) / len(log[-1][0]),
            gradient_norm=sum(sum(norms) for _, norms in log) / steps,
            learning_rate=learning_rate,
            steps=steps,
        )

    def _pass(self, learning_rate: float) -> tuple[list[float], list[float]]:
        """Once through as many pieces as a batch has, drawn anew, side by side: losses and gradient norms."""
        pieces = self.past.draw(self.config.batch_size, self.random)
        state, losses, norms = self.estimator.begin(pieces.table.shape[1]), [], []
        for start in range(0, len(pieces.table), self.fusion.truncation_ticks):
            ticks = slice(start, start + self.fusion.truncation_ticks)
            if not pieces.valid[ticks].any():
                continue  # what fills up short episodes
            table = pieces.table[ticks]
            offset_m, state = self.estimator.unroll(table, state.detached())
            loss = distance_loss(Carried.of(table).filter_m + offset_m - pieces.truth_m[ticks], pieces.valid[ticks])
            self.parameters.gradient.zero_()
            loss.backward()
            losses.append(self._finite("the loss", loss.detach()))
            norms.append(self._finite("the gradient", torch.linalg.vector_norm(self.parameters.gradient)))
            if norms[-1] > self.config.max_grad_norm:
                self.parameters.gradient.mul_(self.config.max_grad_norm / norms[-1])
            with torch.no_grad():
                self.optimiser.step(learning_rate)
        return losses, norms

    def _finite(self, what: str, value: Tensor) -> float:
        if not torch.isfinite(value):
            raise NonFiniteLoss(what, self.updates + 1)
        return value.item()

    def _learning_rate(self, progress: float, update: int) -> float:
        first, final = self.config.learning_rate, self.config.learning_rate_final
        rate = first if final is None else first + (final - first) * progress
        return rate * min(1.0, update / WARM_UP_UPDATES)

    def shape(self) -> LearnerShape:
        """See `StoredLearner.shape`."""
        config = self.config
        return LearnerShape(FUSION, self.observation_size, str(config.network), config.hidden, config.activation)

    def schedules(self) -> dict[str, float]:
        """See `StoredLearner.schedules`."""
        return {"progress": self.progress, "learning_rate": self._learning_rate(self.progress, self.updates)}

    def tensors(self) -> StoredTensors:
        """See `StoredLearner.tensors`."""
        random = {"shuffling": self.random.get_state()}
        return {PARAMETERS: dict(self.parameters.value), OPTIMISER: self.optimiser.state(), RANDOM: random}

    def restore(self, stored: StoredTensors, updates: int) -> None:
        """See `StoredLearner.restore`."""
        for name in (PARAMETERS, OPTIMISER):
            for key, tensor in self.tensors()[name].items():
                tensor.copy_(stored[name][key])
        self.random.set_state(stored[RANDOM]["shuffling"])
        self.updates = updates


def _flattened(network: FusionNetwork) -> FlatParameters:
    """Let the network's parameters and gradients be views of one vector each."""
    shapes = {name: tuple(parameter.shape) for name, parameter in network.named_parameters()}
    flat = FlatParameters(shapes, torch.device("cpu"))
    for name, parameter in network.named_parameters():
        flat.value[name].copy_(parameter.data)
        parameter.data = flat.value[name]
        parameter.grad = flat.grad[name]
    return flat
