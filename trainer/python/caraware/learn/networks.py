"""The paper's networks: a policy and a value MLP, separate, 500 x 300, with their backward pass written out.

The two share nothing, so they can learn on two cores without ever waiting for each other. The backward pass of
an MLP is six lines of matrix products; written out it works in preallocated memory and leaves the parameters and
their gradient in one flat vector each, so that Adam, the norm and a checkpoint see one tensor. A test holds it
against autograd.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Any, Protocol

import torch
from torch import Tensor

CHUNK_ROWS = 1024
"""Rows in a forward pass without gradient: its activations stay in the second-level cache."""
NARROW = 12
"""Inputs of a layer below which its weights' gradient is made transposed: 4 × as fast with 9 inputs, 1 × with 16."""
TANH_BY_SIGMOID = torch.backends.cpu.get_cpu_capability() != "AVX512"
"""As 2 / (1 + exp(-2 z)) - 1: with AVX2 0.4 × the time of torch's tanh, which keeps all digits of the smallest values;
with AVX-512 torch's takes 0.4 × the time of this."""
MEAN_HEAD_SCALE = 0.1
"""Variance scaling of the last policy layer (CarAware): predictions start near the middle of the map."""
HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class Activation(Enum):
    """What follows a linear layer."""

    RELU = "relu"
    TANH = "tanh"
    LINEAR = "linear"

    def apply_(self, z: Tensor) -> Tensor:
        """Activate `z` in place."""
        if self is Activation.RELU:
            return z.clamp_min_(0)
        return _tanh_(z) if self is Activation.TANH else z

    def backward_(self, gradient: Tensor, activated: Tensor) -> Tensor:
        """Turn the gradient of the loss with respect to `activated` into that of its input, in place."""
        if self is Activation.RELU:
            return torch.ops.aten.threshold_backward.grad_input(gradient, activated, 0, grad_input=gradient)
        if self is Activation.TANH:
            return torch.ops.aten.tanh_backward.grad_input(gradient, activated, grad_input=gradient)
        return gradient


@dataclass(frozen=True)
class Layer:
    """One linear layer and its activation; weights start uniform in ± `bound`, biases at 0."""

    inputs: int
    outputs: int
    activation: Activation
    bound: float


class FlatParameters:
    """Named tensors laid out in one flat vector, with a gradient of the same layout."""

    def __init__(self, shapes: dict[str, tuple[int, ...]], device: torch.device) -> None:
        sizes = [math.prod(shape) for shape in shapes.values()]
        self.values = torch.zeros(sum(sizes), device=device)
        self.gradient = torch.zeros_like(self.values)
        self.value = self._views(self.values, shapes, sizes)
        self.grad = self._views(self.gradient, shapes, sizes)
        self._shapes, self._sizes = shapes, sizes

    def named(self, flat: Tensor) -> dict[str, Tensor]:
        """Views of `flat`, a vector of this layout (an Adam moment, say), by name."""
        return self._views(flat, self._shapes, self._sizes)

    @staticmethod
    def _views(flat: Tensor, shapes: dict[str, tuple[int, ...]], sizes: list[int]) -> dict[str, Tensor]:
        parts = flat.split(sizes)
        return {name: part.view(shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)}


class Mlp:
    """A multilayer perceptron over `[b, inputs]` rows. Not thread-safe: one workspace, one user at a time."""

    def __init__(self, layers: Sequence[Layer], extra: dict[str, tuple[int, ...]], device: torch.device) -> None:
        shapes: dict[str, tuple[int, ...]] = {}
        for i, layer in enumerate(layers):
            shapes[f"layer{i}.weight"] = (layer.outputs, layer.inputs)
            shapes[f"layer{i}.bias"] = (layer.outputs,)
        self.parameters = FlatParameters(shapes | extra, device)
        self.layers = tuple(layers)
        self._device = device
        self._activated: list[Tensor] = []
        self._gradients: list[Tensor] = []
        self._rows = 0

    def initialise(self, generator: torch.Generator) -> None:
        """Draw the weights; `generator` lives on the CPU, so every device starts alike."""
        for i, layer in enumerate(self.layers):
            uniform = torch.rand(layer.outputs, layer.inputs, generator=generator)
            self.parameters.value[f"layer{i}.weight"].copy_((2 * uniform - 1) * layer.bound)

    def forward(self, *blocks: Tensor) -> Tensor:
        """Outputs `[b, outputs]` in the workspace, valid until the next call; keeps what `backward` needs.

        The rows may come in several blocks `[_, inputs]`: only the first layer reads them, each where it lies.
        """
        rows = sum(len(block) for block in blocks)
        self.reserve(rows)
        start = 0
        for block in blocks:
            self._layer(0, block, self._activated[0][start : start + len(block)])
            start += len(block)
        output = self._activated[0][:rows]
        for i in range(1, len(self.layers)):
            output = self._layer(i, output, self._activated[i][:rows])
        return output

    def _layer(self, i: int, x: Tensor, output: Tensor) -> Tensor:
        value = self.parameters.value
        torch.addmm(value[f"layer{i}.bias"], x, value[f"layer{i}.weight"].t(), out=output)
        return self.layers[i].activation.apply_(output)

    def backward(self, x: Tensor, output_gradient: Tensor) -> None:
        """Overwrite the gradient of all layers, for the rows `x` of the last `forward` and dLoss/dOutput."""
        rows = x.shape[0]
        value, grad = self.parameters.value, self.parameters.grad
        upstream = self._gradients[-1][:rows].copy_(output_gradient)
        for i in range(len(self.layers) - 1, -1, -1):
            below = self._activated[i - 1][:rows] if i else x
            self.layers[i].activation.backward_(upstream, self._activated[i][:rows])
            _weight_gradient(upstream, below, grad[f"layer{i}.weight"])
            torch.sum(upstream, 0, out=grad[f"layer{i}.bias"])
            if i:
                upstream = torch.mm(upstream, value[f"layer{i}.weight"], out=self._gradients[i - 1][:rows])

    def infer(self, *blocks: Tensor) -> Tensor:
        """Fresh outputs `[b, outputs]` for any number of rows in any number of blocks, without gradient."""
        output = torch.empty(sum(len(block) for block in blocks), self.layers[-1].outputs, device=self._device)
        start = 0
        for group in _groups(piece for block in blocks for piece in block.split(CHUNK_ROWS)):
            rows = sum(len(piece) for piece in group)
            output[start : start + rows].copy_(self.forward(*group))
            start += rows
        return output

    def reserve(self, rows: int) -> None:
        """Make room for `rows` rows, also for none; the workspace stays where it is until more are asked for."""
        if rows > self._rows or not self._activated:
            self._activated = [torch.empty(rows, layer.outputs, device=self._device) for layer in self.layers]
            self._gradients = [torch.empty(rows, layer.outputs, device=self._device) for layer in self.layers]
            self._rows = rows


class Network(Protocol):
    """What PPO needs of a network: an `Mlp`, whose inputs are rows, or one with memory, whose inputs are sequences."""

    parameters: FlatParameters

    def initialise(self, generator: torch.Generator) -> None:
        """Draw the weights."""

    def forward(self, inputs: Any) -> Tensor:
        """Outputs `[b, outputs]`; keeps what `backward` needs."""

    def backward(self, inputs: Any, output_gradient: Tensor) -> None:
        """Overwrite the gradient of all weights, for the inputs of the last `forward` and dLoss/dOutput."""


class GaussianPolicy:
    """Actions are normal around the MLP's mean, with one standard deviation per action for all observations.

    ReLU layers (or `activation`), tanh in the last hidden one, tanh mean in [-1, 1] (the map). A sample is never
    clipped: its log-probability must be that of what was sampled. CarAware clips first and takes the density of the
    clipped action, which biases the ratio wherever a prediction nears the edge of the map.
    """

    def __init__(
        self,
        observations: int,
        actions: int,
        hidden: Sequence[int],
        device: torch.device,
        activation: Activation = Activation.RELU,
    ) -> None:
        widths = (observations, *hidden)
        layers = [hidden_layer(a, b, activation) for a, b in pairwise(widths[:-1])]
        layers.append(hidden_layer(widths[-2], widths[-1], Activation.TANH))
        layers.append(mean_layer(widths[-1], actions))
        self._take(Mlp(layers, {"log_std": (actions,)}, device))

    def _take(self, network: Network) -> None:
        """The network of the mean, with room for the logarithm of the standard deviation among its parameters."""
        self.network = network
        self.log_std = network.parameters.value["log_std"]
        self.log_std_gradient = network.parameters.grad["log_std"]

    def initialise(self, generator: torch.Generator, initial_std: float) -> None:
        """Draw the weights and set the standard deviation."""
        self.network.initialise(generator)
        self.log_std.fill_(math.log(initial_std))


class ValueNetwork:
    """The expected reward of an observation: ReLU layers (or `activation`) and one linear output."""

    def __init__(
        self,
        observations: int,
        hidden: Sequence[int],
        device: torch.device,
        activation: Activation = Activation.RELU,
    ) -> None:
        widths = (observations, *hidden)
        layers = [hidden_layer(a, b, activation) for a, b in pairwise(widths)]
        self.network = Mlp([*layers, value_layer(widths[-1])], {}, device)

    def initialise(self, generator: torch.Generator) -> None:
        """Draw the weights."""
        self.network.initialise(generator)


def log_probability(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log-density `[b]` of actions `[b, a]` under independent normals, `log_std` `[a]`."""
    deviation = (action - mean) * torch.exp(-log_std)
    return -(0.5 * deviation.square() + log_std + HALF_LOG_TWO_PI).sum(-1)


def entropy(log_std: Tensor) -> Tensor:
    """Differential entropy (nats) of those normals; the same for every observation."""
    return (log_std + 0.5 + HALF_LOG_TWO_PI).sum()


def _tanh_(z: Tensor) -> Tensor:
    """Hyperbolic tangent in place, to 1e-7 of its range."""
    # Where autograd has no part in it, which knows the gradient of torch's own functions.
    is_plain = z.device.type == "cpu" and not z.requires_grad
    return z.mul_(2).sigmoid_().mul_(2).sub_(1) if TANH_BY_SIGMOID and is_plain else z.tanh_()


def _weight_gradient(upstream: Tensor, below: Tensor, gradient: Tensor) -> None:
    """Upstream `[b, outputs]` times `below` `[b, inputs]`, summed over the rows, into `[outputs, inputs]`."""
    if below.shape[1] < NARROW and below.device.type == "cpu":
        gradient.copy_(torch.mm(below.t(), upstream).t())
    else:
        torch.mm(upstream.t(), below, out=gradient)


def _groups(pieces: Iterable[Tensor]) -> Iterator[list[Tensor]]:
    """Neighbouring pieces put together while they hold at most `CHUNK_ROWS` rows."""
    group: list[Tensor] = []
    for piece in pieces:
        if group and sum(len(p) for p in group) + len(piece) > CHUNK_ROWS:
            yield group
            group = []
        group.append(piece)
    if group:
        yield group


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
