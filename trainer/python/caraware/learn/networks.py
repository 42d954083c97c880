"""The paper's networks on `torch.nn`: a policy and a value MLP, separate, 500 x 300.

The two share nothing, so they can learn on two cores without ever waiting for each other.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from caraware.learn.frames import Seen

MEAN_HEAD_SCALE = 0.1
"""Variance scaling of the last policy layer (CarAware): predictions start near the middle of the map."""
HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class Activation(Enum):
    """The function after a linear layer."""

    RELU = "relu"
    TANH = "tanh"
    LINEAR = "linear"

    def __call__(self, z: Tensor) -> Tensor:
        """`z`, activated."""
        if self is Activation.RELU:
            return z.relu()
        return z.tanh() if self is Activation.TANH else z


@dataclass(frozen=True)
class Layer:
    """One linear layer and its activation; weights start uniform in ± `bound`, biases at 0."""

    inputs: int
    outputs: int
    activation: Activation
    bound: float


class Mlp(nn.Module):
    """A multilayer perceptron: rows `[b, inputs]` to `[b, outputs]`."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        super().__init__()
        self.layers = tuple(layers)
        # torch's own draws are replaced and must not move its generator. `skip_init` draws none, but imports sympy.
        with torch.random.fork_rng(devices=[]):
            for i, layer in enumerate(layers):
                self.add_module(f"layer{i}", nn.Linear(layer.inputs, layer.outputs))

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draw the weights; `generator` lives on the CPU, so every device starts alike."""
        for layer, linear in zip(self.layers, self._linear(), strict=True):
            uniform = torch.rand(layer.outputs, layer.inputs, generator=generator)
            linear.weight.copy_((2 * uniform - 1) * layer.bound)
            linear.bias.zero_()

    def _linear(self) -> Iterator[nn.Linear]:
        """The linear part of each layer."""
        return (child for child in self.children() if isinstance(child, nn.Linear))

    def forward(self, rows: Tensor) -> Tensor:
        """Outputs `[b, outputs]`."""
        for layer, linear in zip(self.layers, self._linear(), strict=True):
            rows = layer.activation(linear(rows))
        return rows


class GaussianPolicy(nn.Module):
    """Actions are normal around the network's mean, with one standard deviation per action for all observations.

    A sample is never clipped: its log-probability must be that of the action that was sampled. CarAware clips first
    and takes the density of the clipped action, which biases the ratio wherever a prediction nears the edge of the map.
    """

    def __init__(self, network: nn.Module, actions: int, initial_std: float) -> None:
        super().__init__()
        self.network = network
        self.log_std = nn.Parameter(torch.full((actions,), math.log(initial_std)))

    def forward(self, observation: "Tensor | Seen") -> Tensor:
        """Mean actions `[b, a]` of observations `[b, d]`, with stacks of images for a network that sees."""
        mean: Tensor = self.network(observation)
        return mean


def policy_mlp(observations: int, actions: int, hidden: Sequence[int], activation: Activation) -> Mlp:
    """The policy's network: `activation` layers, tanh in the last hidden one, tanh mean in [-1, 1] (the map)."""
    widths = (observations, *hidden)
    layers = [hidden_layer(a, b, activation) for a, b in pairwise(widths[:-1])]
    layers.append(hidden_layer(widths[-2], widths[-1], Activation.TANH))
    return Mlp([*layers, mean_layer(widths[-1], actions)])


def value_mlp(observations: int, hidden: Sequence[int], activation: Activation) -> Mlp:
    """The value network, the expected reward of an observation: `activation` layers and one linear output."""
    widths = (observations, *hidden)
    layers = [hidden_layer(a, b, activation) for a, b in pairwise(widths)]
    return Mlp([*layers, value_layer(widths[-1])])


def log_probability(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log-density `[b]` of actions `[b, a]` under independent normals, `log_std` `[a]`."""
    deviation = (action - mean) * torch.exp(-log_std)
    return -(0.5 * deviation.square() + log_std + HALF_LOG_TWO_PI).sum(-1)


def entropy(log_std: Tensor) -> Tensor:
    """Differential entropy (nats) of those normals; the same for every observation."""
    return (log_std + 0.5 + HALF_LOG_TWO_PI).sum()


def hidden_layer(inputs: int, outputs: int, activation: Activation) -> Layer:
    """A hidden layer: He et al. (2015) uniform before ReLU, Glorot & Bengio (2010) uniform before tanh."""
    relu = activation is Activation.RELU
    return Layer(inputs, outputs, activation, math.sqrt(6 / inputs if relu else 6 / (inputs + outputs)))


def mean_layer(inputs: int, actions: int) -> Layer:
    """The policy's last layer."""
    return Layer(inputs, actions, Activation.TANH, _fan_in_bound(inputs, MEAN_HEAD_SCALE))


def value_layer(inputs: int) -> Layer:
    """The value network's last layer."""
    return Layer(inputs, 1, Activation.LINEAR, _fan_in_bound(inputs, 1.0))


def _fan_in_bound(inputs: int, scale: float) -> float:
    """Bound of the uniform distribution with variance `scale / inputs`."""
    return math.sqrt(3 * scale / inputs)
