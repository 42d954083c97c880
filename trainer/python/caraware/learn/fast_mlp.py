"""The paper's network with its backward pass written out, in memory that is reserved once.

The backward pass of an MLP is six lines of matrix products; written out it works in preallocated memory and leaves the
gradient in one flat vector, so that Adam, the norm and a checkpoint see one tensor. A test holds it against autograd.
"""

from collections.abc import Iterable, Iterator
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from caraware.learn.flat import FlatParameters
from caraware.learn.networks import Activation, Mlp

CHUNK_ROWS = 1024
"""Rows in a forward pass without gradient: its activations stay in the second-level cache."""
NARROW = 12
"""Inputs of a layer below which its weights' gradient is made transposed: 4 × as fast with 9 inputs, 1 × with 16."""
TANH_BY_SIGMOID = torch.backends.cpu.get_cpu_capability() != "AVX512"
"""As 2 / (1 + exp(-2 z)) - 1: with AVX2 0.4 × the time of torch's tanh, which keeps all digits of the smallest values;
with AVX-512 torch's takes 0.4 × the time of this."""


class Network(Protocol):
    """What `FastUpdate` needs of a network: a `FastMlp` takes rows, a network with memory takes sequences."""

    parameters: FlatParameters

    def infer(self, *blocks: Tensor) -> Tensor:
        """Outputs `[b, outputs]` for rows in some blocks, without gradient."""
        ...

    def forward(self, inputs: Any) -> Tensor:
        """Outputs `[b, outputs]`; keeps what `backward` needs."""
        ...

    def backward(self, inputs: Any, output_gradient: Tensor) -> None:
        """Overwrite the gradient of all weights, for the inputs of the last `forward` and dLoss/dOutput."""
        ...


class FastMlp:
    """An `Mlp` over `[b, inputs]` rows, in preallocated memory. Not thread-safe: one workspace, one user at a time."""

    def __init__(self, network: Mlp, extra: dict[str, nn.Parameter] | None = None) -> None:
        """Moves the parameters of `network`, and `extra` behind them, into one vector; both sides see every change."""
        self.parameters = FlatParameters.around(dict(network.named_parameters()) | (extra or {}))
        self.layers = network.layers
        self._device = self.parameters.values.device
        self._activated: list[Tensor] = []
        self._gradients: list[Tensor] = []
        self._rows = 0

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
        return activate_(self.layers[i].activation, output)

    def backward(self, x: Tensor, output_gradient: Tensor) -> None:
        """Overwrite the gradient of all layers, for the rows `x` of the last `forward` and dLoss/dOutput."""
        rows = x.shape[0]
        value, grad = self.parameters.value, self.parameters.grad
        upstream = self._gradients[-1][:rows].copy_(output_gradient)
        for i in range(len(self.layers) - 1, -1, -1):
            below = self._activated[i - 1][:rows] if i else x
            _activation_backward_(self.layers[i].activation, upstream, self._activated[i][:rows])
            _weight_gradient(upstream, below, grad[f"layer{i}.weight"])
            torch.sum(upstream, 0, out=grad[f"layer{i}.bias"])
            if i:
                upstream = torch.mm(upstream, value[f"layer{i}.weight"], out=self._gradients[i - 1][:rows])

    def infer(self, *blocks: Tensor) -> Tensor:
        """Fresh outputs `[b, outputs]` for any number of rows in any number of blocks, without gradient."""
        if len(blocks) == 1 and len(blocks[0]) <= CHUNK_ROWS:
            # To divide a tick into pieces would take a tenth as long as its pass.
            return self.forward(blocks[0]).clone()
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


def activate_(activation: Activation, z: Tensor) -> Tensor:
    """Activate `z` in place."""
    if activation is Activation.RELU:
        return z.clamp_min_(0)
    return _tanh_(z) if activation is Activation.TANH else z


def _activation_backward_(activation: Activation, gradient: Tensor, activated: Tensor) -> Tensor:
    """Turn the gradient of the loss with respect to `activated` into that of its input, in place."""
    if activation is Activation.RELU:
        torch.ops.aten.threshold_backward.grad_input(gradient, activated, 0, grad_input=gradient)
    if activation is Activation.TANH:
        torch.ops.aten.tanh_backward.grad_input(gradient, activated, grad_input=gradient)
    return gradient


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
