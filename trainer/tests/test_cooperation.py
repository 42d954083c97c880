"""Estimators with others' help: the joint filter beside least squares over everything, and rows of `neighbours`."""

import math

import numpy as np
import pytest
from caraware.cooperation.implicit import ImplicitPositioning, View
from caraware.cooperation.joint import JointFilter, JointNoise
from caraware.cooperation.views import CPM, OWN, SlotRows

NOISE = JointNoise(fix_std_m=2.0, slow_std_m=3.0, slow_time_s=5.0, view_std_m=0.5)
TICKS, VEHICLES = 6, 3


def least_squares(
    moves: np.ndarray, fixes: np.ndarray, views: list[tuple[int, int, int, np.ndarray]], dt_s: float
) -> np.ndarray:
    """Positions `[t, n, 2]` by least squares over all ticks at once: the same model without a filter."""
    ticks, vehicles = int(fixes.shape[0]), int(fixes.shape[1])
    rows, targets = [], []

    def column(t: int, n: int, part: int) -> int:
        return 2 * (t * vehicles + n) + part

    def add(entries: list[tuple[int, float]], target: np.ndarray, std: float) -> None:
        row = np.zeros(2 * ticks * vehicles)
        for place, value in entries:
            row[place] += value / std
        rows.append(row)
        targets.append(target / std)

    kept = math.exp(-dt_s / NOISE.slow_time_s)
    for n in range(vehicles):
        add([(column(0, n, 1), 1.0)], np.zeros(2), NOISE.slow_std_m)
        for t in range(ticks):
            add([(column(t, n, 0), 1.0), (column(t, n, 1), 1.0)], fixes[t, n], NOISE.fix_std_m)
            if t:
                add([(column(t, n, 0), 1.0), (column(t - 1, n, 0), -1.0)], moves[t, n], NOISE.moved_std_m)
                slow_std_m = NOISE.slow_std_m * math.sqrt(1.0 - kept**2)
                add([(column(t, n, 1), 1.0), (column(t - 1, n, 1), -kept)], np.zeros(2), slow_std_m)
    for t, observer, seen, offset in views:
        add([(column(t, seen, 0), 1.0), (column(t, observer, 0), -1.0)], offset, NOISE.view_std_m)
    solved = np.linalg.lstsq(np.array(rows), np.array(targets), rcond=None)[0]
    positions: np.ndarray = solved.reshape(ticks, vehicles, 2, 2)[:, :, 0]
    return positions


def test_filter_and_smoother_are_least_squares_over_what_they_see() -> None:
    draw = np.random.default_rng(1)
    moves, fixes = draw.normal(size=(TICKS, VEHICLES, 2)), draw.normal(0, 5, (TICKS, VEHICLES, 2))
    views = [(t, n, (n + 1) % VEHICLES, draw.normal(0, 9, 2)) for t in range(TICKS) for n in range(2)]
    joint, keys = JointFilter(NOISE, remembers=True), [7, 3, 5]
    for t in range(TICKS):
        if t:
            joint.predict({key: moves[t, n] for n, key in enumerate(keys)}, 0.5, set(keys))
        for n, key in enumerate(keys):
            if t:
                joint.fix(key, fixes[t, n], NOISE.fix_std_m**2)
            else:
                joint.add_at_fix(key, fixes[t, n])
        for _, observer, seen, offset in (view for view in views if view[0] == t):
            joint.see(keys[observer], keys[seen], offset, NOISE.view_std_m**2)
        joint.remember()
        so_far = least_squares(moves[: t + 1], fixes[: t + 1], [view for view in views if view[0] <= t], 0.5)
        for n, key in enumerate(keys):
            np.testing.assert_allclose(joint.position_m(key), so_far[t, n], atol=1e-6)
    whole = least_squares(moves, fixes, views, 0.5)
    for t, smoothed in enumerate(joint.smoothed_m()):
        np.testing.assert_allclose([smoothed[key] for key in keys], whole[t], atol=1e-6)


def test_vehicles_come_and_go_between_ticks() -> None:
    joint = JointFilter(NOISE, remembers=True)
    joint.add_at_fix(1, np.array([0.0, 0.0]))
    joint.add_at_fix(2, np.array([10.0, 0.0]))
    joint.see(1, 2, np.array([12.0, 0.0]), 1e-6)
    # Both are as uncertain, so each moves by half of the contradiction.
    np.testing.assert_allclose((joint.position_m(1)[0], joint.position_m(2)[0]), (-1.0, 11.0), atol=1e-5)
    alone_m2 = joint.variance_m2(1)
    joint.remember()
    joint.keep({2})
    joint.predict({}, 0.1, {2})
    # One that is only seen has no fix of its own.
    joint.add(9, np.array([0.0, 5.0]), 1e4, has_fix=False)
    joint.see(2, 9, np.array([3.0, 4.0]), 0.25)
    assert 1 not in joint
    assert joint.variance_m2(9) == pytest.approx(alone_m2 + 0.25 + NOISE.moved_std_m**2, rel=1e-2)
    joint.remember()
    first, last = joint.smoothed_m()
    assert set(first) == {1, 2}
    assert set(last) == {2, 9}


def test_a_common_feature_ties_two_vehicles_together() -> None:
    """Hand-worked: each hears of the feature what the other makes of it, with the variance of both."""
    positioning = ImplicitPositioning(JointNoise(fix_std_m=1.0, slow_std_m=1e-9, slow_time_s=1.0, view_std_m=0.5))
    for key, x_m in ((1, 0.0), (2, 20.0)):
        each = positioning.filters[key] = JointFilter(positioning.noise)
        each.add_at_fix(key, np.array([x_m, 0.0]))
    still = np.zeros(2)
    views = [View(1, 8, np.array([9.0, 0.0]), still), View(2, 8, np.array([-10.0, 0.0]), still)]
    positioning.agree(views)
    # By the other the feature is at 10 with 1 + 0.25; seen from here the own place is 1 with 1.25 + 0.25.
    expected_m = (0.0 / 1.0 + 1.0 / 1.5) / (1.0 / 1.0 + 1.0 / 1.5)
    assert positioning.filters[1].position_m(1)[0] == pytest.approx(expected_m, abs=1e-6)
    assert positioning.filters[2].position_m(2)[0] == pytest.approx(20.0 - expected_m, abs=1e-6)
    assert positioning.filters[1].variance_m2(1) == pytest.approx(1.0 / (1.0 / 1.0 + 1.0 / 1.5), abs=1e-6)


def test_one_vehicle_alone_learns_nothing_from_a_feature() -> None:
    positioning = ImplicitPositioning(NOISE)
    each = positioning.filters[1] = JointFilter(NOISE)
    each.add_at_fix(1, np.array([4.0, 2.0]))
    variance_m2 = each.variance_m2(1)
    positioning.agree([View(1, 8, np.array([9.0, 0.0]), np.zeros(2))])
    np.testing.assert_allclose(each.position_m(1), [4.0, 2.0])
    assert each.variance_m2(1) == variance_m2


def test_rows_are_read_as_fixes_and_offsets_and_old_ones_are_not_new() -> None:
    def row(x_m: float, y_m: float, age_s: float, heading_rad: float = 0.5) -> list[float]:
        return [x_m, y_m, 3.0, 0.0, heading_rad, 4.5, 1.8, age_s, 1.0, 0.1, 0.1]

    objects = np.array(
        [row(10, 5, 0.1), row(12, 5, 0.1), row(40, 8, 0.1), row(1, 2, 0.1), row(31, 4, 0.1), row(9, 9, 0.2)],
        np.float32,
    )
    # A CAM of station 6; its point of reference and an object; the own point and an object; and an old object.
    ids = np.array([[6, 6, 1], [6, 6, 2], [0, 6, 2], [3, 3, 5], [0, 3, 5], [0, 6, 2]], np.uint32)
    rows = SlotRows(objects, ids, 0.1)
    (fix,) = rows.fixes()
    assert (fix.station, fix.position_m.tolist(), fix.velocity_mps.tolist()) == (6, [10.0, 5.0], [3.0, 0.0])
    (heard,), (own,) = rows.views(CPM), rows.views(OWN)
    assert (heard.station, heard.offset_m.tolist()) == (6, [28.0, 3.0])
    assert (own.station, own.offset_m.tolist(), own.heading_rad) == (3, [30.0, 2.0], 0.5)
