"""Adam against numbers worked by hand and against torch's own."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from caraware.learn.adam import EPSILON, Adam, ModuleAdam
from caraware.learn.flat import FlatParameters
from torch import nn


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


def layers() -> nn.Sequential:
    torch.manual_seed(3)
    return nn.Sequential(nn.Linear(5, 7), nn.Tanh(), nn.Linear(7, 2))


def give_gradients(network: nn.Module, step: int) -> None:
    """The same to each network: none for the last bias in every third step, and for the first weight in step 0."""
    generator = torch.Generator().manual_seed(step)
    for name, parameter in network.named_parameters():
        gradient = torch.randn(parameter.shape, generator=generator) * 10.0 ** (step % 5 - 3)
        has_none = (name == "2.bias" and step % 3 == 2) or (name == "0.weight" and step == 0)
        parameter.grad = None if has_none else gradient


def test_modules_end_in_the_bits_of_torchs_own() -> None:
    ours, torchs = layers(), layers()
    adam = ModuleAdam(ours.parameters(), EPSILON)
    oracle = torch.optim.Adam(torchs.parameters(), eps=EPSILON)
    for step in range(40):
        rate = oracle.param_groups[0]["lr"] = 1e-2 / (1 + step)
        give_gradients(ours, step)
        give_gradients(torchs, step)
        adam.step(rate)
        oracle.step()
        for one, other in zip(ours.parameters(), torchs.parameters(), strict=True):
            assert torch.equal(one, other), step
    states = [oracle.state[parameter] for parameter in torchs.parameters()]
    assert all(torch.equal(mean, state["exp_avg"]) for mean, state in zip(adam.means, states, strict=True))
    assert all(torch.equal(square, state["exp_avg_sq"]) for square, state in zip(adam.squares, states, strict=True))
    assert [int(steps) for steps in adam.steps] == [39, 40, 40, 27] == [int(state["step"]) for state in states]
    adam.zero_grad()
    assert all(parameter.grad is None for parameter in ours.parameters())


def test_modules_continue_with_restored_moments() -> None:
    whole, resumed = layers(), layers()
    adam = ModuleAdam(whole.parameters())
    for step in range(3, 9):
        if step == 6:
            resumed.load_state_dict(whole.state_dict())
            again = ModuleAdam(resumed.parameters())
            again.restore([mean.flatten().clone() for mean in adam.means], adam.squares, 3)
        for network in (whole, resumed):
            generator = torch.Generator().manual_seed(step)
            for parameter in network.parameters():
                parameter.grad = torch.randn(parameter.shape, generator=generator)
        adam.step(1e-3)
        if step >= 6:
            again.step(1e-3)
    assert all(torch.equal(one, other) for one, other in zip(whole.parameters(), resumed.parameters(), strict=True))


def test_no_learner_of_ours_imports_torchs_compiler() -> None:
    """Nor sympy: they take 1.5 s of each start, and of each replacement of a killed learner."""
    code = """
import sys
from test_supervised import beside, train_both
from test_updates import learner
for kind in ("plain", "fast"):
    ppo = learner(kind)
    train_both(ppo, beside(ppo), 2)
    assert int(ppo.updater.moments()["policy.steps"]) > 0
assert not {"torch._dynamo", "sympy"} & sys.modules.keys()
import sympy, torch._dynamo
"""
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True)
