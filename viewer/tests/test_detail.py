"""Level of detail: by number, by region of interest, and by id."""

from __future__ import annotations

import frames
import numpy as np
import pytest

from caraware_viewer import detail, wire

TOWN_M, CITY_M = 220.0, 5000.0


def crowd(count: int) -> np.ndarray:
    random = np.random.default_rng(1)
    ids = random.integers(0, 2**63, count).astype(np.uint64)
    return frames.states(count, kind=0, id_hash=ids, x_m=random.uniform(0, CITY_M, count))


def test_few_road_users_of_a_town_are_boxes_alone() -> None:
    chosen = detail.choose(crowd(50), None, TOWN_M)
    assert chosen.shaped.all()
    assert not chosen.marked.any()
    assert not chosen.thinned


def test_few_road_users_of_a_city_have_dots_as_well() -> None:
    chosen = detail.choose(crowd(10), None, CITY_M)
    assert chosen.shaped.all()
    assert chosen.marked.all()
    assert chosen.mark_px == pytest.approx(3.5)


def test_a_crowd_is_drawn_in_full_near_the_followed_vehicle() -> None:
    states = crowd(10_000)
    centre = states[3]
    chosen = detail.choose(states, centre, CITY_M)
    assert (chosen.shaped.sum(), chosen.marked.sum()) == (detail.MAX_SHAPES, 10_000)
    distance_m = np.hypot(states["x_m"] - centre["x_m"], states["y_m"] - centre["y_m"])
    assert distance_m[chosen.shaped].max() <= distance_m[~chosen.shaped].min()
    assert chosen.mark_px < detail.mark_px(10)
    # The fixes are of vehicles in the region of interest, which has more than there is room for.
    assert chosen.thinned
    assert len(chosen.positioned) == detail.MAX_POSITIONS
    assert np.isin(chosen.positioned, states["id_hash"][distance_m < detail.INTEREST_M]).all()


def test_a_choice_is_by_id_and_not_by_row() -> None:
    states = crowd(3000)
    before = set(detail.choose(states, None, CITY_M).positioned.tolist())
    gone = states[::-1][:-30]
    after = set(detail.choose(gone, None, CITY_M).positioned.tolist())
    assert before & set(gone["id_hash"].tolist()) <= after


def test_heroes_come_first() -> None:
    states = crowd(3000)
    states["kind"][77] = wire.HERO
    assert states["id_hash"][77] in detail.choose(states, None, CITY_M).positioned


def test_a_region_shows_what_is_inside_in_full() -> None:
    states = crowd(10_000)
    chosen = detail.choose(states, None, CITY_M, (1000.0, 0.0, 1150.0, 100.0))
    inside = (states["x_m"] >= 1000) & (states["x_m"] <= 1150)
    assert 200 < inside.sum() < detail.MAX_SHAPES
    np.testing.assert_array_equal(chosen.shaped, inside)
    np.testing.assert_array_equal(chosen.marked, inside)
    assert set(chosen.positioned.tolist()) <= set(states["id_hash"][inside].tolist())


def test_nothing_is_there_to_draw() -> None:
    chosen = detail.choose(crowd(0), None, TOWN_M)
    assert (len(chosen.shaped), len(chosen.positioned)) == (0, 0)
