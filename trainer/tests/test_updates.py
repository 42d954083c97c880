"""Plain, fast and graphed updates with the same samples and minibatches give the same parameters, up to rounding.

The graphed one runs step by step on the CPU here; on a GPU its steps are captured.
"""

from dataclasses import replace
from typing import Any

import pytest
import torch
from caraware.learn.build import fast_update, paper_networks
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.learn.fast import FastUpdate
from caraware.learn.fast_mlp import FastMlp
from caraware.learn.graphed import GraphedUpdate
from caraware.learn.networks import Mlp
from caraware.learn.ppo import NonFiniteLoss, PlainUpdate, PolicyUpdate, Ppo, UpdateStats
from caraware.learn.rollout import Rollout
from caraware.tasks.localisation import Localisation
from synthetic import FIELDS, SIZE_M, locating_ppo, run_file, street_ticks
from test_ppo import TOY, parameters

SAMPLES_OVER = 40
"""The horizon is overshot by some samples, so minibatches differ in length and are filled up."""
BOUNDS = MapBounds(0.0, 0.0, SIZE_M, SIZE_M)
CPU = torch.device("cpu")
EXACT = {"matmul_precision": "float32", "threads": 1, "learning_rate": 1e-3}
"""With the toy's own rate, steps are so large that a ratio on the edge of the clip separates two runs for good."""
EXTRAS = [
    {},
    {"value_clip": 0.05},
    {"target_kl": 1e-3},
    {"value_updates": 1},
    {"actions_per_observation": 4, "value_clip": 0.05},
    {"discount": 0.9},
    {"learning_rate_final": 0.0, "clip_epsilon_final": 0.05, "entropy_scale_final": 0.5},
]


def settings(**extra: object) -> TrainerConfig:
    return TrainerConfig.from_run(run_file("x", **TOY | EXACT | extra))


def learner(kind: str, **extra: object) -> Ppo:
    """A learner with this kind of update; its initial networks are the same for all kinds."""
    config = settings(**extra)
    fresh = locating_ppo(config, FIELDS, BOUNDS)
    sampling = torch.Generator().manual_seed(config.seed)
    policy, value = paper_networks(config, FIELDS, 2, sampling)
    updater: PolicyUpdate
    if kind == "plain":
        updater = PlainUpdate(config, policy, value, CPU)
    elif kind == "graphed":
        assert isinstance(policy.network, Mlp)
        networks = FastMlp(policy.network, {"log_std": policy.log_std}), FastMlp(value)
        updater = GraphedUpdate(config, *networks, CPU)
    else:
        updater = fast_update(config, policy, value, CPU)
    ppo = Ppo(config, Localisation(BOUNDS, config.reward, config.reward_scale_m), FIELDS, updater, sampling)
    assert torch.equal(parameters(ppo), parameters(fresh))
    return ppo


def learn(ppo: Ppo, updates: int) -> list[UpdateStats]:
    discounted = ppo.config.discount > 0
    rollout, stats = Rollout(ppo.config.horizon + SAMPLES_OVER, FIELDS, bootstrap=discounted), []
    for obs in street_ticks(10_000, 51, 15.0, seed=5):
        rollout.add(obs)
        if rollout.full():
            stats.append(ppo.learn(rollout.take()))
        if len(stats) == updates:
            return stats
    raise AssertionError("not enough ticks")


@pytest.mark.parametrize("kind", ["plain", "graphed"])
@pytest.mark.parametrize("extra", EXTRAS, ids=lambda extra: "+".join(extra) or "default")
def test_it_moves_the_parameters_as_the_fast_update_does(kind: str, extra: dict[str, Any]) -> None:
    fast, other = learner("fast", **extra), learner(kind, **extra)
    begin = parameters(fast).clone()
    for ppo in (fast, other):
        ppo.progress = 0.4
    for number, (a, b) in enumerate(zip(learn(fast, 3), learn(other, 3), strict=True)):
        assert (a.policy_epochs, a.learning_rate, a.clip_epsilon) == (b.policy_epochs, b.learning_rate, b.clip_epsilon)
        assert b.value_loss == pytest.approx(a.value_loss, rel=2e-3)
        assert b.approximate_kl == pytest.approx(a.approximate_kl, rel=2e-2, abs=1e-6)
        for name, value in vars(a).items() if number == 0 else ():
            assert getattr(b, name) == pytest.approx(value, rel=2e-3, abs=1e-4), name
    moved = (parameters(fast) - begin).norm()
    # Measured: 2e-6. A single ratio that rounds to the other side of the clip makes it 5e-3.
    assert (parameters(fast) - parameters(other)).norm() < (1e-2 if extra else 1e-4) * moved
    one, two = fast.updater.moments(), other.updater.moments()
    assert [int(one[f"{name}.steps"]) for name in ("policy", "value")] == [
        int(two[f"{name}.steps"]) for name in ("policy", "value")
    ]
    for name in ("policy.mean", "policy.square", "value.mean", "value.square"):
        torch.testing.assert_close(two[name], one[name], rtol=2e-2, atol=2e-4)


def test_one_step_of_the_plain_update_is_one_of_the_fast_to_the_last_digits() -> None:
    whole = {"epochs": 1, "batch_size": 2048, "horizon": 2048}
    fast, plain = learner("fast", **whole), learner("plain", **whole)
    learn(fast, 1)
    learn(plain, 1)
    torch.testing.assert_close(parameters(plain), parameters(fast), rtol=1e-5, atol=2e-6)


def test_the_presets_take_the_fast_update() -> None:
    assert type(locating_ppo(settings(), FIELDS, BOUNDS).updater) is FastUpdate


def test_the_state_of_the_plain_update_continues_in_the_fast_one() -> None:
    one, two = learner("plain"), learner("fast")
    learn(one, 1)
    for name, tensor in two.updater.parameters().items():
        tensor.copy_(one.updater.parameters()[name])
    two.updater.restore_moments(one.updater.moments())
    back = learner("plain")
    back.updater.restore_moments(two.updater.moments())
    for name, tensor in one.updater.moments().items():
        assert torch.equal(tensor, two.updater.moments()[name]), name
        assert torch.equal(tensor, back.updater.moments()[name]), name


@pytest.mark.parametrize("kind", ["plain", "fast", "graphed"])
def test_an_update_with_a_loss_that_is_no_number_stops_before_the_step(kind: str) -> None:
    ppo = learner(kind)
    learn(ppo, 1)
    before, moments = parameters(ppo).clone(), {n: t.clone() for n, t in ppo.updater.moments().items()}
    assert isinstance(ppo.task, Localisation)
    ppo.task = replace(ppo.task, reward_scale_m=float("nan"))
    with pytest.raises(NonFiniteLoss, match="in update 2"):
        learn(ppo, 1)
    assert torch.equal(parameters(ppo), before)
    for name, tensor in ppo.updater.moments().items():
        assert torch.equal(tensor, moments[name]), name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_learns_as_the_cpu_does() -> None:
    gpu = locating_ppo(settings(device="auto"), FIELDS, BOUNDS)
    assert gpu.device.type == "cuda" and isinstance(gpu.updater, GraphedUpdate)
    cpu = learner("fast")
    begin = parameters(cpu).clone()
    for a, b in zip(learn(cpu, 3), learn(gpu, 3), strict=True):
        assert b.policy_loss == pytest.approx(a.policy_loss, rel=5e-3, abs=1e-4)
        assert b.value_loss == pytest.approx(a.value_loss, rel=5e-3)
    moved = (parameters(cpu) - begin).norm()
    assert (parameters(cpu) - parameters(gpu).cpu()).norm() < 1e-2 * moved
