"""Adam (Kingma & Ba, arXiv 1412.6980, algorithm 1) over one flat vector of parameters.

Five operations on one tensor cost about 1 % of a gradient step. torch's own optimiser is no faster here, and
importing it pulls in torch's compiler: seconds before the first tick.
"""

import math

import torch

from caraware.networks import FlatParameters

BETA_MEAN, BETA_SQUARE = 0.9, 0.999
EPSILON = 1e-5
"""Larger than the paper's 1e-8: gradients of 1e-5 and below are noise here."""


class Adam:
    """Optimiser state of one network. `mean` and `square` are the running moments of the gradient, `steps` counts."""

    def __init__(self, parameters: FlatParameters) -> None:
        self.mean = torch.zeros_like(parameters.values)
        self.square = torch.zeros_like(parameters.values)
        self.steps = torch.zeros((), dtype=torch.int64)
        self._parameters = parameters
        self._scratch = torch.empty_like(parameters.values)

    def step(self, learning_rate: float) -> None:
        """Move the parameters against their gradient."""
        gradient = self._parameters.gradient
        self.steps += 1
        step = int(self.steps)
        self.mean.lerp_(gradient, 1 - BETA_MEAN)
        self.square.mul_(BETA_SQUARE).addcmul_(gradient, gradient, value=1 - BETA_SQUARE)
        scale = torch.sqrt(self.square, out=self._scratch)
        scale.div_(math.sqrt(1 - BETA_SQUARE**step)).add_(EPSILON)
        self._parameters.values.addcdiv_(self.mean, scale, value=-learning_rate / (1 - BETA_MEAN**step))
