"""`gae` against numbers worked by hand."""

import pytest
import torch
from caraware.learn.gae import generalised_advantage
from torch import Tensor

DISCOUNT, LAMBDA = 0.5, 0.5


def columns(*rows: float) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64).unsqueeze(1)


def flags(*ticks: int, length: int = 3) -> Tensor:
    result = torch.zeros(length, 1, dtype=torch.bool)
    result[list(ticks)] = True
    return result


def advantages(
    terminated: Tensor | None = None,
    truncated: Tensor | None = None,
    valid: Tensor | None = None,
    discount: float = DISCOUNT,
) -> tuple[list[float], list[float]]:
    """Rewards 1, 2, 3; values 4, 2, 6; 8 follows the last tick. Next values as they stand."""
    advantage, target = generalised_advantage(
        reward=columns(1, 2, 3),
        value=columns(4, 2, 6),
        next_value=columns(2, 6, 8),
        terminated=flags() if terminated is None else terminated,
        truncated=flags() if truncated is None else truncated,
        valid=~flags() if valid is None else valid,
        discount=discount,
        gae_lambda=LAMBDA,
    )
    return advantage.flatten().tolist(), target.flatten().tolist()


def test_an_unbroken_trajectory() -> None:
    # δ2 = 3 + 4 - 6 = 1; δ1 = 2 + 3 - 2 = 3; δ0 = 1 + 1 - 4 = -2
    # A2 = 1; A1 = 3 + 0.25·1 = 3.25; A0 = -2 + 0.25·3.25 = -1.1875
    assert advantages() == ([-1.1875, 3.25, 1.0], [2.8125, 5.25, 7.0])


def test_after_termination_nothing_is_worth_anything() -> None:
    # δ1 = 2 - 2 = 0, A1 = 0: neither the next value nor A2. A0 = -2
    assert advantages(terminated=flags(1))[0] == [-2.0, 0.0, 1.0]


def test_after_truncation_the_next_value_counts_but_no_later_advantage() -> None:
    # δ1 = 3 as if unbroken, A1 = 3: A2 belongs to another vehicle. A0 = -2 + 0.25·3
    assert advantages(truncated=flags(1))[0] == [-1.25, 3.0, 1.0]


def test_terminated_and_truncated_differ() -> None:
    assert advantages(terminated=flags(1)) != advantages(truncated=flags(1))


def test_an_empty_slot_gets_zeros_and_passes_nothing_on() -> None:
    advantage, target = advantages(valid=~flags(1), truncated=flags(0))
    assert advantage == [-2.0, 0.0, 1.0]
    assert target[1] == 0.0


def test_without_discount_the_advantage_is_reward_minus_value() -> None:
    assert advantages(discount=0.0) == ([-3.0, 0.0, -3.0], [1.0, 2.0, 3.0])


def test_slots_do_not_mix() -> None:
    generator = torch.Generator().manual_seed(0)
    reward, value, following = (torch.randn(5, 3, generator=generator) for _ in range(3))
    none = torch.zeros(5, 3, dtype=torch.bool)
    whole, _ = generalised_advantage(reward, value, following, none, none, ~none, 0.9, 0.8)
    for slot in range(3):
        one = (slice(None), slice(slot, slot + 1))
        alone, _ = generalised_advantage(
            reward[one], value[one], following[one], none[one], none[one], ~none[one], 0.9, 0.8
        )
        torch.testing.assert_close(whole[one], alone)


@pytest.mark.parametrize("gae_lambda", [0.0, 1.0])
def test_lambda_spans_one_step_and_monte_carlo(gae_lambda: float) -> None:
    none = flags()
    advantage, _ = generalised_advantage(
        columns(1, 2, 3), columns(4, 2, 6), columns(2, 6, 8), none, none, ~none, DISCOUNT, gae_lambda
    )
    # λ = 1: 1 + 2/2 + 3/4 + 8/8 - 4
    assert advantage[0].item() == (-2.0 if gae_lambda == 0 else -0.25)
