"""The update for a GPU is the update: on the CPU, step by step, it gives what the plain one gives."""

import pytest
import torch
from caraware.learn.graphed import GraphedUpdate
from caraware.learn.ppo import NonFiniteLoss, Ppo
from caraware.learn.rollout import Rollout
from synthetic import FIELDS, street_ticks
from test_ppo import TOY, fresh, parameters

SAMPLES_OVER = 40
"""The horizon is overshot by some samples, so minibatches differ in length and are filled up."""


def learner(*, graphed: bool, **extra: object) -> Ppo:
    ppo = fresh(**TOY, matmul_precision="float32", threads=1, **extra)
    ppo._graphed = GraphedUpdate(ppo) if graphed else None
    return ppo


def learn(ppo: Ppo, updates: int) -> list:
    rollout, stats = Rollout(ppo.config.horizon + SAMPLES_OVER, FIELDS, bootstrap=False), []
    for obs in street_ticks(10_000, 51, 15.0, seed=5):
        rollout.add(obs)
        if rollout.full():
            stats.append(ppo.learn(rollout.take()))
        if len(stats) == updates:
            return stats
    raise AssertionError("not enough ticks")


def test_both_ways_move_the_parameters_alike() -> None:
    plain, graphed = learner(graphed=False), learner(graphed=True)
    for a, b in zip(learn(plain, 3), learn(graphed, 3), strict=True):
        for name, value in vars(a).items():
            assert getattr(b, name) == pytest.approx(value, rel=2e-3, abs=2e-5), name
    moved = (parameters(plain) - parameters(fresh(**TOY))).norm()
    assert (parameters(plain) - parameters(graphed)).norm() < 1e-3 * moved
    assert int(plain.policy_optimiser.steps) == int(graphed.policy_optimiser.steps) == 3 * 4 * 8
    torch.testing.assert_close(plain.value_optimiser.mean, graphed.value_optimiser.mean, rtol=1e-2, atol=1e-5)


@pytest.mark.parametrize(
    "extra",
    [
        {"value_clip": 0.05},
        {"target_kl": 1e-3},
        {"actions_per_observation": 4, "value_clip": 0.05},
        {"learning_rate_final": 0.0, "clip_epsilon_final": 0.05, "entropy_scale_final": 0.5},
    ],
)
def test_both_ways_take_the_extras_alike(extra: dict) -> None:
    learners = [learner(graphed=way, **extra) for way in (False, True)]
    for ppo in learners:
        ppo.progress = 0.4
    plain, graphed = (learn(ppo, 3) for ppo in learners)
    for a, b in zip(plain, graphed, strict=True):
        assert (a.policy_epochs, a.learning_rate, a.clip_epsilon) == (b.policy_epochs, b.learning_rate, b.clip_epsilon)
        assert b.value_loss == pytest.approx(a.value_loss, rel=2e-3)
        assert b.approximate_kl == pytest.approx(a.approximate_kl, rel=2e-2, abs=1e-6)
    assert int(learners[0].policy_optimiser.steps) == int(learners[1].policy_optimiser.steps)


def test_an_update_with_a_loss_that_is_no_number_changes_nothing() -> None:
    ppo = learner(graphed=True)
    learn(ppo, 1)
    before, moments = parameters(ppo).clone(), ppo.policy_optimiser.mean.clone()
    ppo.config.__dict__["reward_scale_m"] = float("nan")
    with pytest.raises(NonFiniteLoss, match="in update 2"):
        learn(ppo, 1)
    assert torch.equal(parameters(ppo), before)
    assert torch.equal(ppo.policy_optimiser.mean, moments)
    assert int(ppo.policy_optimiser.steps) == 4 * 8


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_learns_as_the_cpu_does() -> None:
    gpu = fresh(**TOY, matmul_precision="float32", device="auto")
    assert gpu.device.type == "cuda"
    cpu = learner(graphed=False)
    for a, b in zip(learn(cpu, 3), learn(gpu, 3), strict=True):
        assert b.policy_loss == pytest.approx(a.policy_loss, rel=5e-3, abs=1e-4)
        assert b.value_loss == pytest.approx(a.value_loss, rel=5e-3)
    moved = (parameters(cpu) - parameters(fresh(**TOY))).norm()
    assert (parameters(cpu) - parameters(gpu).cpu()).norm() < 1e-2 * moved
