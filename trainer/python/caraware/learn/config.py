"""The learner's hyper-parameters and the map's box, read from the run file, checked once, then frozen."""

import os
from dataclasses import dataclass, fields
from typing import Any

from caraware.ipc.run_file import ConfigError as ConfigError
from caraware.ipc.run_file import ConfigTable, RunFile
from caraware.tasks.bounds import MapBounds as MapBounds

_KEY_OF_FIELD = {"checkpoint_interval_updates": "checkpoint_interval"}
"""Fields whose name in the configuration file differs (there, the unit stands in the table of keys)."""


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
    network: str
    """`mlp`; `gru`, which remembers the ticks before; or `package.module:Class` (`caraware.learn.build`)."""
    hidden: tuple[int, ...]
    activation: str
    """Of the hidden layers: `relu` or `tanh`. The policy's last hidden layer is tanh in any case, as CarAware's."""
    truncation_ticks: int
    """Ticks that a gradient reaches back in a network with memory."""
    supervised: bool
    """Teach a network of the policy's size by regression to the truth beside it (`caraware.learn.supervised`)."""
    reward: str
    reward_scale_m: float
    matmul_precision: str
    """`float32`, `bfloat16` (inputs of matrix products only), or `auto`: bfloat16 where the CPU has AMX tiles."""
    ranks: int
    """Trainers that learn together by torch.distributed, each with a run of its own; horizon and batch are of each."""
    threads: int
    """CPU threads; 0 is one per core this process may use."""
    device: str
    """`cpu`, or `auto`: a GPU if there is one."""
    seed: int
    checkpoint_interval_updates: int
    checkpoints_kept: int
    checkpoint_keep_every: int
    """Checkpoints after a multiple of so many updates stay for good; 0: only the newest and the best."""
    estimates: str
    """When the Kalman filter runs beside the policy for viewers: `paced`, `always`, `never`."""

    @classmethod
    def from_run(cls, run: RunFile) -> "TrainerConfig":
        """Read `run["config"]["trainer"]`; the seed may stand in `run["config"]["run"]`. Raises `ConfigError`."""
        section = dict(_table(run, "trainer"))
        section.pop("module", None)
        seed_of_run = run.get("config", {}).get("run", {}).get("seed")
        if seed_of_run is not None:
            section.setdefault("seed", seed_of_run)
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


def _table(run: RunFile, name: str) -> ConfigTable:
    table = run.get("config", {}).get(name)
    if not isinstance(table, dict):
        raise ConfigError(f"the run file has no table `config.{name}`", "start the trainer through `caraware train`")
    return table


def _typed(name: str, kind: object, section: ConfigTable) -> Any:
    """The value of a field, where an integer may stand for a float but nothing else is converted."""
    value = section[_key(name)]
    if kind == tuple[int, ...] and isinstance(value, list) and all(type(v) is int for v in value):
        return tuple(value)
    if kind == float | None and value is None:
        return None
    if kind in (float, float | None) and type(value) in (int, float):
        return float(value)
    if kind in (int, str, bool) and type(value) is kind:
        return value
    wanted = "list of integers" if kind == tuple[int, ...] else getattr(kind, "__name__", str(kind))
    raise ConfigError(f"`trainer.{_key(name)}` is {value!r}", f"give a value of type {wanted}")
