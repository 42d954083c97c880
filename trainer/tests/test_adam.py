"""Adam against numbers worked by hand."""

import math

import pytest
import torch
from caraware.learn.adam import EPSILON, Adam
from caraware.learn.flat import FlatParameters


def test_algorithm_1_two_steps_by_hand() -> None:
    parameters = FlatParameters({"w": (2,)}, torch.device("cpu"))
    adam = Adam(parameters)
    parameters.gradient.copy_(torch.tensor([4.0, -0.5]))
    adam.step(0.1)
    # Step 1: both moments are unbiased by their own weight, so the step is g / (|g| + ε).
    first = [-0.1 * 4 / (4 + EPSILON), 0.1 * 0.5 / (0.5 + EPSILON)]
    assert parameters.values.tolist() == pytest.approx(first, rel=1e-6)
    parameters.gradient.copy_(torch.tensor([0.0, -0.5]))
    adam.step(0.1)
    # Step 2 of the first: mean 0.9·0.4 / 0.19, square 0.999·0.016 / 0.001999.
    mean, square = 0.36 / 0.19, 0.015984 / 0.001999
    second = [first[0] - 0.1 * mean / (math.sqrt(square) + EPSILON), 2 * first[1]]
    assert parameters.values.tolist() == pytest.approx(second, rel=1e-4)
    assert int(adam.steps) == 2


def test_a_parabola_is_descended() -> None:
    parameters = FlatParameters({"w": (3,)}, torch.device("cpu"))
    parameters.values.copy_(torch.tensor([3.0, -2.0, 1.0]))
    adam = Adam(parameters)
    for _ in range(500):
        parameters.gradient.copy_(2 * parameters.values)
        adam.step(0.05)
    assert parameters.values.abs().max() < 1e-2
