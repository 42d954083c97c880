"""Contacts that are foreseen: against boxes that are moved step by step, and by hand."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from caraware.tasks import driving
from caraware.tasks.driving import DrivenStep, careful_reward, gap_reward, progress_reward, yielding_reward
from caraware.tasks.fields import Fields
from caraware.tasks.foresight import HERO_M, HERO_MIDDLE_M, HERO_WIDTH_M, HORIZON_S, PERSONS, TIMES, USERS, Around
from numpy.typing import NDArray
from test_drawing import driven

RANGES = {
    "x": (-50.0, 50.0),
    "y": (-50.0, 50.0),
    "cos": (-1.0, 1.0),
    "sin": (-1.0, 1.0),
    "forward": (-30.0, 30.0),
    "left": (-30.0, 30.0),
    "length": (0.0, 20.0),
    "width": (0.0, 3.0),
}
PERSON = {"ahead": (0.0, 50.0), "left": (-10.0, 10.0), "speed": (-5.0, 5.0)}
NOBODY = (50.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
FAR = (50.0, 10.0, 0.0)


def around(
    users: tuple[tuple[float, ...], ...] = (),
    persons: tuple[tuple[float, ...], ...] = (),
    speed: float = 0.0,
    rate: float = 0.0,
) -> Around:
    """A hero at `speed` (m/s) that turns by `rate` (rad/s), with what is around it in the order of the fields."""
    ranges = {f"user_{n}_{name}": span for n in range(1, USERS + 1) for name, span in RANGES.items()}
    ranges |= {f"person_{n}_{name}": span for n in range(1, PERSONS + 1) for name, span in PERSON.items()}
    rows = [*users, *[NOBODY] * (USERS - len(users)), *persons, *[FAR] * (PERSONS - len(persons))]
    values = [value for row in rows for value in row]
    unit = [(value - low) / (high - low) for value, (low, high) in zip(values, ranges.values(), strict=True)]
    fields = Fields(tuple(ranges), 1, 0.0, ranges)
    hero = torch.tensor([speed], dtype=torch.float64), torch.tensor([rate], dtype=torch.float64)
    return Around(fields, torch.tensor([unit], dtype=torch.float32), *hero)


def corners(x: float, y: float, yaw: float, length: float, width: float) -> NDArray[np.float64]:
    ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    return np.array([[x, y] + a * ahead * length / 2 + b * left * width / 2 for a, b in signs])


def boxes_touch(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """By the theorem of separating axes."""
    for box in (a, b):
        for p, q in pairwise(box[:3]):
            axis = q - p
            if (a @ axis).max() < (b @ axis).min() or (b @ axis).max() < (a @ axis).min():
                return False
    return True


def first_contact(user: tuple[float, ...], speed: float, rate: float, wider_m: float) -> float:
    """The first of the times that are looked at when the boxes, made wider, touch; the hero moves in steps of 1 ms."""
    x, y, cos, sin, forward, left, length, width = user
    hero_x = hero_y = yaw = 0.0
    for step in range(1, round(HORIZON_S * 1000) + 1):
        yaw += 0.0005 * rate
        hero_x, hero_y = hero_x + 0.001 * speed * math.cos(yaw), hero_y + 0.001 * speed * math.sin(yaw)
        yaw += 0.0005 * rate
        if step % round(HORIZON_S * 1000 / TIMES):
            continue
        middle = hero_x + HERO_MIDDLE_M * math.cos(yaw), hero_y + HERO_MIDDLE_M * math.sin(yaw)
        t = 0.001 * step
        own = corners(*middle, yaw, HERO_M + wider_m, HERO_WIDTH_M + wider_m)
        other = corners(x + t * forward, y + t * left, math.atan2(sin, cos), length + wider_m, width + wider_m)
        if boxes_touch(own, other):
            return t
    return math.inf


def test_contacts_lie_between_those_of_the_boxes_and_of_boxes_within_the_circles() -> None:
    generator = np.random.default_rng(4)
    met = apart = 0
    for _ in range(400):
        yaw, pace = generator.uniform(-math.pi, math.pi), generator.uniform(0, 15)
        place = generator.uniform((-5, -10), (25, 10))
        user = (*place, math.cos(yaw), math.sin(yaw), pace * math.cos(yaw), pace * math.sin(yaw), 4.6, 1.85)
        speed, rate = generator.uniform(0, 15), generator.choice([0.0, -0.4, 0.5])
        found = around((user,), speed=speed, rate=rate).contact_s().item()
        # Circles of 1.85 m hold a box that is 0.55 m shorter and narrower; 1 cm is for rounding.
        outer, inner = first_contact(user, speed, rate, 0.01), first_contact(user, speed, rate, -0.56)
        assert outer - 1e-6 <= found <= inner + 1e-6, (user, speed, rate)
        met, apart = met + math.isfinite(inner), apart + math.isinf(outer)
    assert met > 50 and apart > 50, "both kinds are among them"


@pytest.mark.parametrize("number", [1, USERS])
def test_a_leader_is_met_when_the_gap_is_closed_and_nobody_is_nobody(number: int) -> None:
    leader = (HERO_MIDDLE_M + 4.6 + 10, 0.0, 1.0, 0.0, 0.0, 0.0, 4.6, 1.85)
    users = (*[NOBODY] * (number - 1), leader)
    # 10 m at 10 m/s: the first time after a second.
    assert around(users, speed=10.0).contact_s().item() == pytest.approx(1.0, abs=0.26)
    assert around(users, speed=0.0).contact_s().item() == math.inf
    assert around((), speed=30.0).contact_s().item() == math.inf
    away = (*leader[:4], 10.0, 0.0, *leader[6:])
    assert around((away,), speed=10.0).contact_s().item() == math.inf


def test_a_person_is_met_where_both_are_at_the_same_time() -> None:
    walks = (10.0, -1.5, 1.5)
    # It is on the hero's way after a second, and past it after two and more.
    assert around((), (walks,), speed=10.0).contact_s().item() == pytest.approx(1.0)
    assert around((), (walks,), speed=10.0 / 2.4).contact_s().item() == math.inf
    assert around((), (walks,), speed=0.0).contact_s().item() == math.inf


def test_a_foreseen_contact_costs_what_moves_and_a_failure_costs_more_than_it_earns() -> None:
    leader = (HERO_MIDDLE_M + 4.6 + 5, 0.0, 1.0, 0.0, 0.0, 0.0, 4.6, 1.85)
    free, near = driven(), replace(driven(), around=around((leader,), speed=10.0))
    assert careful_reward(free).item() == progress_reward(free).item()
    assert careful_reward(near).item() < progress_reward(near).item() - 0.2
    yes = torch.ones(1, dtype=torch.bool)
    ended = replace(near, ended=yes, failed=yes)
    assert careful_reward(ended).item() == -driving.CAREFUL_END_COST
    assert careful_reward(replace(near, ended=yes, arrived=yes)).item() == driving.END_REWARD


JUNCTION = {
    "junction_1_gap": (0.0, 100.0),
    "junction_1_priority": (0.0, 1.0),
    "light_1_gap": (0.0, 100.0),
    "light_1_green": (0.0, 1.0),
}


def meets(speed: float, gap: float, priority: float, light: tuple[float, float] = (100.0, 1.0)) -> DrivenStep:
    """A hero at `speed` that will touch what stands 5 m before it, at a junction and before a traffic light."""
    leader = (HERO_MIDDLE_M + 4.6 + 5, 0.0, 1.0, 0.0, 0.0, 0.0, 4.6, 1.85)
    seen = around((leader,), speed=speed)
    values = (gap / 100, priority, light[0] / 100, light[1])
    fields = Fields((*seen.fields.names, *JUNCTION), 1, 0.0, seen.fields._ranges | JUNCTION)
    rows = torch.cat((seen.observation, torch.tensor([values])), 1)
    return replace(
        driven(),
        speed_mps=torch.tensor([speed], dtype=torch.float64),
        around=replace(seen, fields=fields, observation=rows),
    )


def test_a_hero_that_has_to_wait_pays_more_for_a_foreseen_contact_and_creeping_into_it_costs() -> None:
    def cost(speed: float, gap: float, priority: float) -> float:
        step = meets(speed, gap, priority)
        return (progress_reward(step) - yielding_reward(step)).item()

    assert cost(8.0, 5.0, 1.0) == pytest.approx(driving.PRIORITY_SHARE * cost(8.0, 5.0, 0.0))
    assert cost(8.0, 50.0, 1.0) == cost(8.0, 50.0, 0.0), "a junction that is far off decides nothing"
    near = (1 - 0.625 / HORIZON_S) ** 2
    assert cost(10.0, 5.0, 0.0) == pytest.approx(driving.YIELDING_COST * near, rel=0.3)
    creeps = meets(3.0, 5.0, 0.0)
    assert cost(3.0, 5.0, 0.0) > 1.5 * (progress_reward(creeps) - careful_reward(creeps)).item() > 0
    assert cost(0.0, 5.0, 0.0) == pytest.approx(driving.WAITING_COST)
    yes = torch.ones(1, dtype=torch.bool)
    ended = replace(meets(8.0, 5.0, 0.0), ended=yes, failed=yes)
    assert yielding_reward(ended).item() == -driving.YIELDING_END_COST
    assert yielding_reward(replace(ended, failed=~yes, arrived=yes)).item() == driving.END_REWARD


def test_late_braking_for_red_costs_and_for_no_other_light() -> None:
    def cost(speed: float, gap: float, green: float) -> float:
        step, free = (meets(speed, 50.0, 0.0, light) for light in ((gap, green), (100.0, 1.0)))
        return (yielding_reward(free) - yielding_reward(step)).item()

    # From 10 m/s: 16.7 m at 3 m/s², 7.1 m at 7 m/s², and half a metre.
    assert cost(10.0, 20.0, 0.0) == 0.0
    assert cost(10.0, 10.5, 0.0) == pytest.approx(driving.RED_COST / 2, rel=1e-3)
    assert cost(10.0, 5.0, 0.0) == pytest.approx(driving.RED_COST)
    assert cost(10.0, 5.0, 0.05) == cost(10.0, 5.0, 1.0) == 0.0


def test_without_junctions_and_lights_in_the_row_nothing_is_known_of_them() -> None:
    step = replace(driven(), around=around(speed=10.0))
    assert step.seen("light_1_gap", 7.0).tolist() == [7.0]
    assert replace(step, around=None).seen("user_1_x", 7.0).tolist() == [7.0]
    assert yielding_reward(step).item() == progress_reward(step).item()


ENCOUNTER = {"reaches": (0.0, 10.0), "enters": (0.0, 10.0), "leaves": (0.0, 10.0), "way": (0.0, 50.0)}
NO_ENCOUNTER = (10.0, 10.0, 10.0, 50.0)


def crossing(
    *encounters: tuple[float, float, float, float],
    speed: float,
    other: float = 10.0,
    gap: float = 5.0,
    right: float = 0.0,
) -> DrivenStep:
    """A hero at `speed`, `gap` before a junction, with vehicles at `other` whose ways cross its own."""
    met = [*encounters, *[NO_ENCOUNTER] * (USERS - len(encounters))]
    columns = {**RANGES, **ENCOUNTER}
    user = (50.0, 50.0, 0.0, 0.0, 0.0, other, 0.0, 0.0)
    ranges = {f"user_{n}_{name}": span for n in range(1, USERS + 1) for name, span in columns.items()}
    ranges |= {name: JUNCTION[name] for name in ("junction_1_gap", "junction_1_priority")}
    values = [value for encounter in met for value in (*user, *encounter)] + [gap, right]
    unit = [(value - low) / (high - low) for value, (low, high) in zip(values, ranges.values(), strict=True)]
    pace = torch.tensor([speed], dtype=torch.float64)
    seen = Around(Fields(tuple(ranges), 1, 0.0, ranges), torch.tensor([unit]), pace, torch.zeros_like(pace))
    return replace(driven(), speed_mps=pace, around=seen)


@pytest.mark.parametrize(
    ("encounter", "speed", "other", "short"),
    [
        # There after 2 s, and 6.5 m further 0.8125 s later. The other comes 0.1875 s after that.
        ((2.0, 3.0, 4.0, 16.0), 8.0, 10.0, (1 - 0.1875 / 1.2) * 0.5),
        # The other has left it a second before.
        ((2.0, 0.5, 1.0, 16.0), 8.0, 10.0, (1 - 1 / 1.2) * 0.5),
        ((2.0, 2.0, 4.0, 16.0), 8.0, 10.0, 0.5),
        ((2.0, 4.1, 5.0, 16.0), 8.0, 10.0, 0.0),
        ((2.0, 0.3, 0.7, 16.0), 8.0, 10.0, 0.0),
        ((4.0, 4.0, 5.0, 32.0), 8.0, 10.0, 0.0),
        # The hero that stands would be there after 2 s, and the slow one, 9 m away, after 2.86 s.
        ((10.0, 9.0, 10.0, 4.0), 0.0, 1.0, 0.5),
        ((10.0, 9.0, 10.0, 4.0), 0.0, 0.2, 0.0),
        # It stands on the hero's way already, and there is none.
        ((2.0, 0.1, 9.0, 16.0), 8.0, 10.0, 0.0),
        (NO_ENCOUNTER, 8.0, 10.0, 0.0),
    ],
)
def test_a_gap_is_short_by_hand(
    encounter: tuple[float, float, float, float], speed: float, other: float, short: float
) -> None:
    for before in range(0, USERS, 3):
        step = crossing(*[NO_ENCOUNTER] * before, encounter, speed=speed, other=other)
        assert step.short_gap.item() == pytest.approx(short, abs=2e-6)


def test_a_hero_without_right_of_way_pays_for_a_short_gap_as_it_moves() -> None:
    def cost(speed: float, gap: float = 5.0, right: float = 0.0) -> float:
        step = crossing((2.0, 3.0, 4.0, 16.0), speed=speed, gap=gap, right=right)
        return (yielding_reward(step) - gap_reward(step)).item()

    assert cost(8.0) == pytest.approx(driving.GAP_COST * (1 - 0.1875 / 1.2) * 0.5, rel=1e-4)
    assert cost(0.0) == cost(8.0, right=1.0) == cost(8.0, gap=30.0) == 0.0
    yes = torch.ones(1, dtype=torch.bool)
    ended = replace(crossing((2.0, 3.0, 4.0, 16.0), speed=8.0), ended=yes, failed=yes)
    assert gap_reward(ended).item() == -driving.YIELDING_END_COST
    blind = replace(driven(), around=around(speed=10.0))
    assert blind.short_gap.item() == replace(driven(), around=None).short_gap.item() == 0.0
    assert gap_reward(blind).item() == yielding_reward(blind).item()
