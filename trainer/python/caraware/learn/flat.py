"""Parameters laid out in one flat vector, so that Adam, the norm and a sum over ranks are one operation each."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor


class FlatParameters:
    """Named tensors laid out in one flat vector, with a gradient of the same layout."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], device: torch.device) -> None:
        sizes = [math.prod(shape) for shape in shapes.values()]
        self.values = torch.zeros(sum(sizes), device=device)
        self.gradient = torch.zeros_like(self.values)
        self.value = self._views(self.values, shapes, sizes)
        self.grad = self._views(self.gradient, shapes, sizes)
        self._shapes, self._sizes = shapes, sizes

    @classmethod
    def around(cls, parameters: Mapping[str, torch.nn.Parameter]) -> "FlatParameters":
        """Move the memory of these parameters into one vector; the parameters themselves stay usable."""
        device = next(iter(parameters.values())).device
        flat = cls({name: tuple(parameter.shape) for name, parameter in parameters.items()}, device)
        for name, parameter in parameters.items():
            flat.value[name].copy_(parameter.data)
            parameter.data = flat.value[name]
        return flat

    def named(self, flat: Tensor) -> dict[str, Tensor]:
        """Views of `flat`, a vector of this layout (an Adam moment, say), by name."""
        return self._views(flat, self._shapes, self._sizes)

    @staticmethod
    def _views(flat: Tensor, shapes: Mapping[str, tuple[int, ...]], sizes: list[int]) -> dict[str, Tensor]:
        parts = flat.split(sizes)
        return {name: part.view(shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)}
