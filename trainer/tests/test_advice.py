"""SUMO's driver as a teacher: what its advice changes, and which rows it belongs to."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np
import pytest
import torch
from caraware.driving.advice import SumoAdvice
from caraware.driving.dagger import BATCH, AdvisedPolicy, AdvisedRows, Pupil, SeenRows, varied
from caraware.driving.lessons import Limits
from caraware.ipc.channel import Observation
from caraware.learn.encoders import FIELDS, GroupedNetwork
from caraware.tasks.fields import Fields, UnknownFieldError
from torch import Tensor

LIMITS = Limits(accel_mps2=5.0, decel_mps2=9.0, angle_rad=0.6, tick_s=0.1)
NAMED = {"speed": (0.0, 30.0), "light_1_gap": (0.0, 100.0), "light_1_green": (0.0, 1.0)}
NAMED |= {f"person_{n}_ahead": (0.0, 50.0) for n in (1, 2)} | {f"person_{n}_left": (-10.0, 10.0) for n in (1, 2)}
NOTHING = {"light_1_gap": 100.0, "light_1_green": 1.0}
NOTHING |= {"person_1_ahead": 50.0, "person_1_left": 10.0, "person_2_ahead": 50.0, "person_2_left": 10.0}


def fields() -> Fields:
    """As many as "advised-driver" has; those that the advice reads have its names."""
    ranges = NAMED | {f"rest_{number}": (-1.0, 1.0) for number in range(FIELDS - len(NAMED))}
    ranges |= {"advised_accel": (-9.0, 9.0)}
    return Fields(tuple(ranges), 1, -1.0, ranges)


def row(speed: float, advised: float = 0.0, **seen: float) -> Tensor:
    """What a hero sees; nothing is near."""
    known, values = fields(), {"speed": speed, "advised_accel": advised, **NOTHING, **seen}
    unit = []
    for name in known.names:
        low, high = known.range(name)
        unit.append(2 * (values.get(name, (low + high) / 2) - low) / (high - low) - 1)
    return torch.tensor([unit])


RED = {"light_1_gap": 5.0, "light_1_green": 0.0}
PERSON = {"person_2_ahead": 8.0, "person_2_left": -3.0}


@pytest.mark.parametrize(
    ("what", "seen", "wants", "advised", "expected"),
    [
        ("it brakes as advised", row(8), 0.5, -4.5, -0.5),
        ("a policy that brakes harder is left alone", row(8), -0.8, -4.5, -0.8),
        ("it may accelerate as it wants", row(8), 0.9, 1.5, 0.9),
        ("a little: as much of the action", row(8), 0.9, 0.4, 0.4),
        ("a slow one starts, though the policy would stand", row(1), -0.4, 2.0, 0.4),
        ("by half of the action at most", row(1), -0.4, 4.0, 0.5),
        ("not at a red light", row(1, **RED), -0.4, 2.0, -0.4),
        ("at a green one it does", row(1, light_1_gap=5.0), -0.4, 2.0, 0.4),
        ("not with a person near", row(1, **PERSON), -0.4, 2.0, -0.4),
        ("a person far aside is not", row(1, person_1_ahead=8.0, person_1_left=9.0), -0.4, 2.0, 0.4),
        ("one that stands holds", row(0.1), 0.5, -1.0, -1.5 / 9),
    ],
)
def test_advice_changes_the_acceleration(
    what: str, seen: Tensor, wants: float, advised: float, expected: float
) -> None:
    got = SumoAdvice(fields(), LIMITS).corrected(seen, torch.tensor([[0.3, wants]]), torch.tensor([advised]))
    assert got[0].tolist() == pytest.approx([0.3, expected], abs=1e-3), what


def test_other_observations_are_refused_by_name() -> None:
    known = fields()
    less = Fields(known.names[:4], 1, -1.0, {name: known.range(name) for name in known.names[:4]})
    advice = SumoAdvice(less, LIMITS)
    assert SumoAdvice(known, LIMITS).is_there() and not advice.is_there()
    with pytest.raises(UnknownFieldError, match="advised-driver"):
        advice.corrected(row(8)[:, :4], torch.zeros(1, 2), torch.zeros(1))


@dataclass
class _Tick:
    """The part of an observation that is paired."""

    tick: int
    vehicle: np.ndarray
    valid: np.ndarray
    terminated: np.ndarray = field(default_factory=lambda: np.zeros(3, bool))
    truncated: np.ndarray = field(default_factory=lambda: np.zeros(3, bool))


def tick(number: int, vehicles: tuple[int, ...], gone: tuple[bool, ...] = (False, False, False)) -> Observation:
    """All slots have a hero."""
    there = np.ones(3, bool)
    return cast(Observation, _Tick(number, np.array(vehicles, np.uint32), there, terminated=np.array(gone)))


def test_advice_belongs_to_the_tick_before_and_to_the_same_hero() -> None:
    paired = AdvisedRows(SumoAdvice(fields(), LIMITS))
    first, then = (4, 5, 6), (4, 9, 6)
    rows = [torch.cat([row(speed, accel) for speed, accel in zip((1, 2, 3), accels, strict=True)]) for accels in
            ((0, 0, 0), (-1, -2, -3), (-4, -5, -6))]  # fmt: skip
    assert len(paired.add(tick(7, first), rows[0])) == 0
    second = paired.add(tick(8, then), rows[1])
    assert torch.equal(second[:, :FIELDS], rows[0][[0, 2], :FIELDS])
    assert second[:, FIELDS].tolist() == pytest.approx([-1, -3], abs=1e-5)
    gone = tick(9, then, gone=(True, False, False))
    assert paired.add(gone, rows[2])[:, FIELDS].tolist() == pytest.approx([-5, -6], abs=1e-5)
    assert len(paired.add(tick(11, first), rows[0])) == 0, "a tick is missing"


def test_rows_that_are_mixed_have_no_advice_and_teach_what_the_policy_does() -> None:
    torch.manual_seed(1)
    generator = torch.Generator().manual_seed(2)
    rows, network = SeenRows(100, generator), GroupedNetwork(FIELDS, 2, (16,))
    rows.add(torch.cat([torch.cat([row(8.0 + n)[:, :FIELDS], torch.tensor([[-4.5]])], 1) for n in range(10)]))
    seen = varied(rows, BATCH, 0.01, generator)
    is_advised = ~seen[:, FIELDS].isnan()
    assert 0.5 < float(is_advised.float().mean()) < 0.6 and float(seen[:, :FIELDS].abs().max()) <= 1
    actions, corrected = AdvisedPolicy(network, SumoAdvice(fields(), LIMITS)).actions(seen)
    assert torch.equal(corrected, is_advised)
    own = network(seen[:, :FIELDS]).detach().clamp(-1, 1)
    assert torch.equal(actions[~is_advised], own[~is_advised])
    assert torch.allclose(actions[is_advised, 1], torch.tensor(-0.5), atol=1e-3)


def test_it_counts_alike_where_a_slow_hero_does_what_is_advised() -> None:
    teacher = AdvisedPolicy(GroupedNetwork(FIELDS, 2, (16,)), SumoAdvice(fields(), LIMITS))
    seen = torch.cat([row(8), row(1), row(1, **RED), row(1, **PERSON), row(1)])
    seen[:, FIELDS] = 2.0
    seen[4, FIELDS] = torch.nan
    assert teacher.caution(seen).tolist() == [3, 1, 3, 3, 3]


@pytest.mark.parametrize("caution", [1.0, 5.0])
def test_a_cautious_pupil_brakes_where_the_advice_is_divided(caution: float) -> None:
    """Of rows that look alike a third is advised to brake: what is learnt is nearer to braking with caution."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(3)
    network, generator = GroupedNetwork(FIELDS, 2, (16,)), torch.Generator().manual_seed(4)

    class Divided(AdvisedPolicy):
        """As cautious as the test wants."""

        def caution(self, seen: Tensor) -> Tensor:
            assert torch.equal(super().caution(seen), torch.full((len(seen),), 3.0)), "fast heroes only brake"
            return torch.full((len(seen),), caution)

    teacher = Divided(GroupedNetwork(FIELDS, 2, (16,)), SumoAdvice(fields(), LIMITS))
    rows, pupil = SeenRows(1000, generator), Pupil(network, teacher, generator)
    rows.add(torch.cat([torch.cat([row(8)[:, :FIELDS], torch.tensor([[a]])], 1) for a in (-9.0, 2.0, 2.0)] * 50))
    for _ in range(80):
        pupil.learn(rows, 3e-3)
    braking = float(network(row(8)[:, :FIELDS])[0, 1].detach())
    torch.set_num_threads(threads)
    assert braking < -0.75 if caution > 1 else braking > -0.75
