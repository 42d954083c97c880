"""Learning: the toy task, determinism, and a loss that is not a number."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from caraware.learn.batch import Batch, save_batch
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.learn.fast import FastUpdate
from caraware.learn.objective import clipped_error
from caraware.learn.ppo import NonFiniteLoss, Ppo, ScheduledValues, UpdateStats
from caraware.learn.rewards import distance_m
from caraware.learn.rollout import Horizon, Rollout
from safetensors.torch import load_file
from synthetic import FIELDS, SIZE_M, locating_ppo, run_file, street_ticks
from torch import Tensor

NOISE_M = 15.0
TOY: dict[str, object] = {
    "hidden": [64, 48],
    "horizon": 2048,
    "batch_size": 256,
    "learning_rate": 4e-3,
    "learning_rate_decay": 0.97,
    "initial_std": 0.6,
    "reward": "exponential",
    "reward_scale_m": 20.0,
}


def fresh(**trainer: object) -> Ppo:
    config = TrainerConfig.from_run(run_file("x", **trainer))
    return locating_ppo(config, FIELDS, MapBounds(0.0, 0.0, SIZE_M, SIZE_M))


def train(ppo: Ppo, updates: int) -> list[UpdateStats]:
    """Some updates on the street map."""
    rollout = Rollout(ppo.config.horizon, FIELDS, bootstrap=ppo.config.discount > 0)
    stats: list[UpdateStats] = []
    for obs in street_ticks(1_000_000, 64, NOISE_M, seed=5):
        rollout.add(obs)
        if rollout.full():
            stats.append(ppo.learn(rollout.take()))
        if len(stats) == updates:
            break
    return stats


def parameters(ppo: Ppo) -> Tensor:
    return torch.cat([each.flatten() for each in ppo.updater.parameters().values()])


def errors_m(ppo: Ppo) -> tuple[float, float]:
    """Mean error of the policy and of raw GNSS on unseen places."""
    ticks = list(street_ticks(200, 64, NOISE_M, seed=99))
    truth = torch.cat([obs.truth for obs in ticks])
    predicted_m = torch.cat(ppo.predict_m([obs.observation for obs in ticks]))
    raw_m = torch.cat([obs.gnss_m for obs in ticks])
    return distance_m(predicted_m, truth).mean().item(), distance_m(raw_m, truth).mean().item()


def test_schedules_run_from_the_first_value_to_the_last() -> None:
    config = TrainerConfig.from_run(
        run_file(
            "x",
            learning_rate=1e-3,
            learning_rate_decay=0.5,
            learning_rate_final=1e-4,
            clip_epsilon=0.2,
            clip_epsilon_final=0.1,
            entropy_scale=0.01,
        )
    )
    half = ScheduledValues.at(config, updates=3, progress=0.5)
    assert half.learning_rate == pytest.approx(5.5e-4)
    assert half.clip_epsilon == pytest.approx(0.15)
    assert half.entropy_scale == 0.01
    assert ScheduledValues.at(config, 0, 7.0).learning_rate == pytest.approx(1e-4)
    decayed = TrainerConfig.from_run(run_file("x", learning_rate=1e-3, learning_rate_decay=0.5))
    assert ScheduledValues.at(decayed, updates=3, progress=0.5).learning_rate == pytest.approx(1.25e-4)


def test_an_update_of_the_policy_ends_at_the_largest_divergence() -> None:
    free, held = fresh(**TOY), fresh(**TOY, target_kl=1e-9)
    assert [train(ppo, 1)[0].policy_epochs for ppo in (free, held)] == [4, 1]
    assert [int(ppo.updater.moments()["policy.steps"]) for ppo in (free, held)] == [32, 8]
    assert [int(ppo.updater.moments()["value.steps"]) for ppo in (free, held)] == [32, 32]


def test_the_value_network_can_learn_alone_first() -> None:
    free, held = fresh(**TOY), fresh(**TOY, value_updates=2)
    drawn = {name: tensor.clone() for name, tensor in held.updater.parameters().items()}
    train(free, 2)
    train(held, 2)
    after, of_free = held.updater.parameters(), free.updater.parameters()
    for name, tensor in drawn.items():
        is_of_policy = name.startswith("policy.")
        assert torch.equal(after[name], tensor) == is_of_policy, name
    # Both saw the same first samples, and others since: those of the free one follow its policy.
    assert any(not torch.equal(after[name], of_free[name]) for name in after if name.startswith("value."))
    moments = held.updater.moments()
    assert int(moments["policy.steps"]) == 0 and int(moments["value.steps"]) == 64
    assert not moments["policy.mean"].any() and moments["value.mean"].any()
    train(held, 1)
    assert not any(torch.equal(after[name], drawn[name]) for name in drawn if name.startswith("policy."))


def test_clipped_values_by_hand() -> None:
    value, target = torch.tensor([1.0, 3.0, -1.0, 1.4]), torch.tensor([2.0, 2.0, 2.0, 2.0])
    before = torch.tensor([1.0, 1.0, 1.0, 1.0])
    error = clipped_error(value, target, target - before, 0.5)
    # Held at 1 ± 0.5: (1, 1.5, 0.5, 1.4). The larger error counts; it pulls where the value itself has it or is free.
    assert error.loss.tolist() == pytest.approx([1.0, 1.0, 9.0, 0.36])
    assert error.pull.tolist() == pytest.approx([-1.0, 1.0, -3.0, -0.6])
    past = clipped_error(torch.tensor([1.9]), torch.tensor([2.0]), torch.tensor([1.0]), 0.5)
    assert past.loss.tolist() == pytest.approx([0.25]) and past.pull.tolist() == [0.0]


def test_the_toy_task_is_learnt() -> None:
    ppo = fresh(**TOY)
    before_m, raw_m = errors_m(ppo)
    stats = train(ppo, 80)
    after_m, _ = errors_m(ppo)
    assert raw_m == pytest.approx(NOISE_M * (torch.pi / 2) ** 0.5, rel=0.02)
    assert after_m < 0.25 * before_m
    assert after_m < 0.9 * raw_m
    assert stats[-1].reward_mean > 2 * stats[0].reward_mean
    assert stats[-1].sigma < 0.5 * stats[0].sigma


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_gives_the_same_parameters(threads: int) -> None:
    first, second, other = (fresh(seed=seed, threads=threads) for seed in (1, 1, 2))
    for ppo in (first, second, other):
        train(ppo, 5)
    assert torch.equal(parameters(first), parameters(second))
    assert not torch.equal(parameters(first), parameters(other))


def test_a_second_thread_changes_nothing() -> None:
    one, two = fresh(threads=1), fresh(threads=2)
    assert train(one, 3) == train(two, 3)
    assert torch.equal(parameters(one), parameters(two))


def test_with_a_discount_it_learns_from_every_sample_too() -> None:
    stats = train(fresh(discount=0.9, epochs=2), 5)
    assert [s.samples for s in stats] == [256] * 5
    assert stats[0].value_loss > stats[-1].value_loss > 0


def test_the_statistics_of_an_update_are_those_of_its_samples() -> None:
    ppo = fresh(epochs=1, batch_size=256, learning_rate_decay=0.5, learning_rate=1e-3)
    first, second = train(ppo, 2)
    assert first.ratio_mean == pytest.approx(1.0, abs=1e-5)
    assert first.clip_fraction == 0.0
    assert first.approximate_kl == pytest.approx(0.0, abs=1e-5)
    assert (first.learning_rate, second.learning_rate) == (1e-3, 5e-4)
    assert second.sigma == ppo.sigma()
    assert first.explained_variance <= 1


def horizon_of_the_toy() -> Horizon:
    rollout = Rollout(2048, FIELDS, bootstrap=False)
    for obs in street_ticks(32, 64, NOISE_M, seed=5):
        rollout.add(obs)
    return rollout.take()


def mean_gradient(ppo: Ppo, batch: Batch) -> Tensor:
    """The surrogate's gradient before the first step: every ratio is one."""
    gradient = (batch.action - ppo.updater.mean(batch.observation).unsqueeze(1)) * batch.advantage.unsqueeze(2)
    return gradient.mean(1)


def test_an_even_number_of_actions_comes_in_pairs_on_both_sides_of_the_mean() -> None:
    ppo, alone = (fresh(actions_per_observation=tries, discount=0.0, initial_std=0.6) for tries in (8, 7))
    horizon = horizon_of_the_toy()
    batch = ppo.score(horizon)
    deviation = batch.action - ppo.updater.mean(batch.observation).unsqueeze(1)
    assert torch.allclose(deviation[:, :4], -deviation[:, 4:], atol=1e-6)
    # Each is a sample of the policy, and none is like another but for the sign.
    assert deviation.std().item() == pytest.approx(0.6, rel=0.01)
    assert deviation.mean().abs().item() < 1e-6
    assert (deviation[:, :4].flatten().unique(return_counts=True)[1] == 1).float().mean() > 0.99
    lone = alone.score(horizon)
    assert lone.action.shape[1] == 7
    assert lone.action.std().item() == pytest.approx(batch.action.std().item(), rel=0.05)

    # The same mean gradient with a fraction of its variance: what makes them worth having.
    def of_many(tries: int) -> Tensor:
        ppo = fresh(actions_per_observation=tries, discount=0.0, initial_std=0.6)
        return torch.stack([mean_gradient(ppo, ppo.score(horizon)) for _ in range(40)])

    paired, single = of_many(8), of_many(7)
    noise = [each.var(0).mean().item() for each in (paired, single)]
    assert noise[0] < 0.3 * noise[1], noise
    apart = (paired.mean(0) - single.mean(0)).square().mean().item()
    assert apart < 1.5 * (noise[0] + noise[1]) / 40, (apart, noise)


def test_a_gradient_is_clipped_to_the_largest_norm() -> None:
    ppo = fresh(max_grad_norm=1e-3, epochs=1, batch_size=256)
    (stats,) = train(ppo, 1)
    assert stats.policy_gradient_norm > 1e-3
    assert isinstance(ppo.updater, FastUpdate)
    assert ppo.updater.policy_network.parameters.gradient.norm().item() == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_loss_that_is_no_number_stops_before_the_step(threads: int, tmp_path: Path) -> None:
    ppo = fresh(threads=threads)
    rollout = Rollout(ppo.config.horizon, FIELDS, bootstrap=False)
    for obs in street_ticks(4, 64, NOISE_M, seed=5):
        rollout.add(obs)
    batch = ppo.score(rollout.take())
    advantage = batch.advantage.clone()
    advantage[7] = torch.nan
    broken = replace(batch, advantage=advantage)
    with pytest.raises(NonFiniteLoss, match="update 1"):
        for _ in range(4):
            ppo.update(broken)
    assert ppo.updates == 0
    assert torch.isfinite(parameters(ppo)).all()
    file = tmp_path / "logs" / "batch.safetensors"
    save_batch(broken, ppo.updater.parameters(), file)
    saved = load_file(file)
    assert torch.isnan(saved["advantage"]).sum() == 1
    assert torch.equal(saved["policy.log_std"], ppo.updater.log_std)
