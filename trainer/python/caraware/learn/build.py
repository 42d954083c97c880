"""A learner as the configuration says: its networks, and the update that is the fastest for them.

`"mlp"`, `"gru"` and `"cnn"` are the paper's networks, the one with memory and the one that sees.
`"package.module:Class"` names any other: it is constructed as `Class(inputs, outputs, hidden)`, with the widths of
`trainer.hidden`, and maps rows `[b, inputs]` to `[b, outputs]`. PPO makes two of it: the policy's mean, which is
bounded to the map by a tanh behind it, and the values.
"""

import math
from collections.abc import Callable, Sequence
from importlib import import_module

import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

from caraware.learn.cnn import mean_network
from caraware.learn.config import (
    BuiltInNetwork,
    ConfigError,
    MatmulPrecision,
    PythonClass,
    TrainerConfig,
    TrainerDevice,
)
from caraware.learn.fast import FastUpdate, threads_per_network
from caraware.learn.fast_mlp import FastMlp
from caraware.learn.gpu import has_usable_gpu
from caraware.learn.graphed import GraphedUpdate
from caraware.learn.gru import recurrent_policy, recurrent_value
from caraware.learn.networks import Activation, GaussianPolicy, Mlp, policy_mlp, value_mlp
from caraware.learn.ppo import PlainUpdate, Ppo
from caraware.learn.ranked import RankedUpdate
from caraware.learn.ranks import Ranks
from caraware.learn.recurrent import RecurrentPpo, SequenceUpdate
from caraware.learn.seeing import SeeingPpo, SeeingUpdate
from caraware.tasks.contract import Sampling, Task

NetworkClass = Callable[[int, int, tuple[int, ...]], nn.Module]


def build_ppo(
    config: TrainerConfig,
    observation_size: int,
    task: Task,
    environments: Sequence[int] = (0,),
    ranks: Ranks | None = None,
) -> Ppo:
    """A new learner of `task` for these environments, counted among those of all `ranks`. Raises `ConfigError`."""
    if task.sampling is Sampling.EACH_TICK and config.network is BuiltInNetwork.GRU:
        raise ConfigError(
            f"`trainer.network` = 'gru' with `task.kind` = {task.name!r}",
            'actions that are drawn tick by tick need a network that sees one moment: "mlp" or a class',
        )
    actions = task.actions.size
    device = configure_torch(config)
    # The weights are drawn first; the actions of environment 0 continue with the same generator.
    sampling = torch.Generator().manual_seed(config.seed)
    if config.network is BuiltInNetwork.GRU:
        sequences = _sequence_update(config, observation_size, actions, device, sampling, ranks)
        return RecurrentPpo(config, task, observation_size, sequences, sampling, environments)
    if config.network is BuiltInNetwork.CNN:
        return _seeing_ppo(config, observation_size, task, device, sampling, environments, ranks)
    if config.network is BuiltInNetwork.MLP:
        policy, value = paper_networks(config, observation_size, actions, sampling)
        _spread(policy, task)
        fast = fast_update(config, policy, value, device, ranks)
        return Ppo(config, task, observation_size, fast, sampling, environments)
    own_policy, own_value = _own_networks(config.network, config, observation_size, actions, sampling)
    _spread(own_policy, task)
    plain = PlainUpdate(config, own_policy, own_value, device)
    if ranks is not None and ranks.size > 1:
        _refuse_batch_statistics(config, own_policy, own_value)
        plain = RankedUpdate(config, own_policy, own_value, device, ranks)
    return Ppo(config, task, observation_size, plain, sampling, environments)


def _seeing_ppo(
    config: TrainerConfig,
    observation_size: int,
    task: Task,
    device: torch.device,
    sampling: torch.Generator,
    environments: Sequence[int],
    ranks: Ranks | None,
) -> SeeingPpo:
    """A policy that sees, and a value network that does not. Raises `ConfigError`."""
    if task.sampling is Sampling.EACH_TICK:
        raise ConfigError(
            f"`trainer.network` = 'cnn' with `task.kind` = {task.name!r}",
            'actions that are drawn tick by tick need a network of fields alone: "mlp" or a class',
        )
    if ranks is not None and ranks.size > 1:
        raise ConfigError(
            f"`trainer.network` = 'cnn' with `trainer.ranks` = {config.ranks}",
            'trainers that learn together exchange no images: set trainer.ranks = 1, or trainer.network = "mlp"',
        )
    seed = int(torch.randint(2**62, (), generator=sampling))
    mean = mean_network(config, observation_size, task.actions.size, seed)
    value = value_mlp(observation_size, config.hidden, Activation(config.activation))
    value.initialise(sampling)
    policy = GaussianPolicy(mean, task.actions.size, config.initial_std)
    _spread(policy, task)
    update = SeeingUpdate(config, policy, value, device)
    return SeeingPpo(config, task, observation_size, update, sampling, environments)


def _spread(policy: GaussianPolicy, task: Task) -> None:
    """Give each number of an action the share of `trainer.initial_std` that the task says."""
    if task.actions.spread:
        policy.log_std.data += torch.tensor(task.actions.spread).log()


def paper_networks(
    config: TrainerConfig, observation_size: int, actions: int, generator: torch.Generator
) -> tuple[GaussianPolicy, Mlp]:
    """The paper's policy and value network, drawn from `generator`."""
    activation = Activation(config.activation)
    mean = policy_mlp(observation_size, actions, config.hidden, activation)
    value = value_mlp(observation_size, config.hidden, activation)
    mean.initialise(generator)
    value.initialise(generator)
    return GaussianPolicy(mean, actions, config.initial_std), value


def fast_update(
    config: TrainerConfig, policy: GaussianPolicy, value: Mlp, device: torch.device, ranks: Ranks | None = None
) -> FastUpdate:
    """The paper's networks with their backward pass written out; on a GPU, alone, with captured steps."""
    policy.to(device)
    assert isinstance(policy.network, Mlp)
    networks = FastMlp(policy.network, {"log_std": policy.log_std}), FastMlp(value.to(device))
    if device.type == "cuda" and (ranks is None or ranks.size == 1):
        return GraphedUpdate(config, *networks, device)
    return FastUpdate(config, *networks, device, ranks)


def _sequence_update(
    config: TrainerConfig,
    observation_size: int,
    actions: int,
    device: torch.device,
    generator: torch.Generator,
    ranks: Ranks | None,
) -> SequenceUpdate:
    """Networks with memory, drawn from `generator`. No two of their minibatches have one shape: no captured steps."""
    activation = Activation(config.activation)
    policy = recurrent_policy(observation_size, actions, config.hidden, activation, device)
    value = recurrent_value(observation_size, config.hidden, activation, device)
    policy.initialise(generator)
    policy.parameters.value["log_std"].fill_(math.log(config.initial_std))
    value.initialise(generator)
    return SequenceUpdate(config, policy, value, device, ranks)


def _own_networks(
    network: PythonClass, config: TrainerConfig, observation_size: int, actions: int, generator: torch.Generator
) -> tuple[GaussianPolicy, nn.Module]:
    """Two networks of the class `network`; their first weights follow from the run's seed."""
    network_class = _class_of(network)
    seed = int(torch.randint(2**62, (), generator=generator))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        mean = network_class(observation_size, actions, config.hidden)
        value = network_class(observation_size, 1, config.hidden)
    return GaussianPolicy(nn.Sequential(mean, nn.Tanh()), actions, config.initial_std), value


def _refuse_batch_statistics(config: TrainerConfig, *networks: nn.Module) -> None:
    """Raises `ConfigError` where a row's output depends on the rows beside it, which are others on every rank."""
    for module in (module for network in networks for module in network.modules()):
        if isinstance(module, _BatchNorm):
            raise ConfigError(
                f"`trainer.network` is '{config.network}' with `trainer.ranks` = {config.ranks}: its "
                f"{type(module).__name__} takes the statistics of a minibatch, of which each rank sees a part",
                "normalise each row by itself, as torch.nn.LayerNorm does, or set trainer.ranks = 1",
            )


def _class_of(network: PythonClass) -> NetworkClass:
    """The class itself. Raises `ConfigError`."""
    help = "write `mlp`, `gru`, `cnn` or `package.module:Class`; the module must be in PYTHONPATH"
    try:
        network_class: NetworkClass = getattr(import_module(network.module), network.name)
        return network_class
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"`trainer.network` is '{network}': {error}", help) from error


def configure_torch(config: TrainerConfig) -> torch.device:
    """Set what torch keeps per process: threads within an operation, and the precision of matrix products."""
    torch.set_num_threads(threads_per_network(config))
    amx = hasattr(torch.cpu, "get_capabilities") and torch.cpu.get_capabilities().get("amx_bf16", False)
    gpu = config.device is TrainerDevice.AUTO and has_usable_gpu()
    is_auto = config.matmul_precision is MatmulPrecision.AUTO
    reduced = config.matmul_precision is MatmulPrecision.BFLOAT16 or (is_auto and amx and not gpu)
    # On a GPU "auto" is TensorFloat-32: 10 bits of mantissa, float32's range.
    full = "high" if gpu and is_auto else "highest"
    torch.set_float32_matmul_precision("medium" if reduced else full)
    return torch.device("cuda" if gpu else "cpu")
