"""The learner's hyper-parameters and the map's box, read from the run file, checked once, then frozen."""

import os
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any

from caraware.ipc.image import ImageShape
from caraware.ipc.run_file import ConfigError as ConfigError
from caraware.ipc.run_file import ConfigTable, RunFile, config_table, setting, typed
from caraware.tasks.bounds import MapBounds as MapBounds
from caraware.tasks.rewards import RewardName

_KEY_OF_FIELD = {"checkpoint_interval_updates": "checkpoint_interval"}
"""Fields whose name in the configuration file differs (there, the unit stands in the table of keys)."""


class BuiltInNetwork(StrEnum):
    """Networks that `trainer.network` knows by name."""

    MLP = "mlp"
    GRU = "gru"
    """Remembers the ticks before."""
    CNN = "cnn"
    """Sees images of the newest ticks."""


@dataclass(frozen=True)
class PythonClass:
    """A network of the user's, which `trainer.network` writes as `package.module:Class`."""

    module: str
    name: str

    def __str__(self) -> str:
        """As the configuration writes it."""
        return f"{self.module}:{self.name}"


class HiddenActivation(StrEnum):
    """Values of `trainer.activation`."""

    RELU = "relu"
    TANH = "tanh"


class MatmulPrecision(StrEnum):
    """Precision of the inputs of matrix products."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"
    AUTO = "auto"
    """bfloat16 where the CPU has AMX tiles."""


class TrainerDevice(StrEnum):
    """What the trainer computes on."""

    CPU = "cpu"
    AUTO = "auto"
    """A GPU if there is one."""


class EstimateTimes(StrEnum):
    """When the Kalman filter runs beside the policy for viewers."""

    PACED = "paced"
    """In runs that keep to the wall clock."""
    ALWAYS = "always"
    NEVER = "never"


@dataclass(frozen=True)
class TrainerConfig:
    """Hyper-parameters in the paper's words (section IV); the supervisor has their defaults and checks their ranges."""

    learning_rate: float
    """Adam's step size at the first update, for the policy and the value network."""
    learning_rate_decay: float
    """Factor on the learning rate after every update."""
    learning_rate_final: float | None
    """Learning rate at the end of training, reached linearly with the training episodes; None: the decay alone."""
    discount: float
    """γ. Predictions do not influence the world, so 0 (a bandit) loses nothing and has the least variance."""
    gae_lambda: float
    clip_epsilon: float
    """ε: probability ratios beyond 1 ± ε earn nothing more."""
    clip_epsilon_final: float | None
    """ε at the end of training; None: constant."""
    initial_std: float
    """Standard deviation of the policy at the start, in actions: 1 is half the map's width."""
    entropy_scale: float
    entropy_scale_final: float | None
    """Entropy scale at the end of training; None: constant."""
    value_scale: float
    value_clip: float | None
    """How far a value may move from the value before the update; None: any way."""
    target_kl: float | None
    """The policy's update ends with the epoch whose mean KL divergence is larger; None: after all epochs."""
    value_updates: int
    """Updates at the beginning in which the policy keeps its parameters, and the value network alone learns."""
    max_grad_norm: float
    """Largest gradient norm, of the policy and of the value network each."""
    actions_per_observation: int
    """Actions tried on every observation: a prediction does not influence the world, so each one's reward is known.
    More of them make the gradient's noise smaller for the same samples."""
    horizon: int
    """Samples (one vehicle at one tick) collected before every update."""
    batch_size: int
    """Samples in a gradient step."""
    epochs: int
    network: BuiltInNetwork | PythonClass
    hidden: tuple[int, ...]
    activation: HiddenActivation
    """Of the hidden layers. The policy's last hidden layer is tanh in any case, as CarAware's."""
    truncation_ticks: int
    """Ticks that a gradient reaches back in a network with memory."""
    frames: int
    """Images in a stack that a network sees: the newest one and those of the ticks before."""
    supervised: bool
    """Teach a network of the policy's size by regression to the truth beside it (`caraware.learn.supervised`,
    `caraware.learn.regression`)."""
    reward: RewardName
    reward_scale_m: float
    matmul_precision: MatmulPrecision
    ranks: int
    """Trainers that learn together by torch.distributed, each with a run of its own; horizon and batch are of each."""
    threads: int
    """CPU threads; 0 is one per core this process may use."""
    device: TrainerDevice
    seed: int
    checkpoint_interval_updates: int
    checkpoints_kept: int
    checkpoint_keep_every: int
    """Checkpoints after a multiple of so many updates stay for good; 0: only the newest and the best."""
    estimates: EstimateTimes
    plots: bool
    """Draw the plots of a run at its end."""
    images: ImageShape | None
    """Those in the observations; None where they hold none."""

    @classmethod
    def from_run(cls, run: RunFile) -> "TrainerConfig":
        """Read `run["config"]["trainer"]`, and the seed in `run["config"]["run"]`. Raises `ConfigError`."""
        section = config_table(run, "trainer") | {"seed": setting(run, "run.seed", int)}
        # These say which trainer there is, and what it may read.
        for key in ("module", "road_users"):
            section.pop(key, None)
        section["images"] = ImageShape.from_run(run)
        keys = {_key(f.name) for f in fields(cls)}
        if wrong := sorted(keys ^ set(section)):
            what = "lacks the key" if wrong[0] in keys else "has the unknown key"
            raise ConfigError(f"the run file {what} `trainer.{wrong[0]}`", "it is of another version of `caraware`")
        config = cls(**{f.name: _typed(f.name, f.type, section) for f in fields(cls)})
        if config.actions_per_observation > 1 and config.discount > 0.0:
            raise ConfigError(
                f"`trainer.actions_per_observation` = {config.actions_per_observation} with `trainer.discount`"
                f" = {config.discount}",
                "several actions on one observation have one future: set trainer.discount = 0",
            )
        return config

    def thread_count(self) -> int:
        """Threads to use, with 0 resolved to the cores this process may run on."""
        return self.threads or len(os.sched_getaffinity(0))


def _key(field_name: str) -> str:
    return _KEY_OF_FIELD.get(field_name, field_name)


def _typed(name: str, kind: Any, section: ConfigTable) -> Any:
    """The value of a field. Raises `ConfigError`."""
    key, value = f"trainer.{_key(name)}", section[_key(name)]
    if kind == BuiltInNetwork | PythonClass:
        return _network(key, value)
    if kind == tuple[int, ...]:
        if not isinstance(value, list):
            raise ConfigError(f"`{key}` is {value!r}", "give a list of integers")
        return tuple(typed(key, each, int) for each in value)
    if kind == float | None:
        return None if value is None else typed(key, value, float)
    if kind == ImageShape | None:
        return value
    return typed(key, value, kind)


def _network(key: str, value: object) -> BuiltInNetwork | PythonClass:
    text: str = typed(key, value, str)
    module, colon, name = text.partition(":")
    if colon and module and name:
        return PythonClass(module, name)
    if text not in list(BuiltInNetwork):
        raise ConfigError(f"`{key}` is {text!r}", "give one of: mlp, gru, cnn, package.module:Class")
    return BuiltInNetwork(text)
