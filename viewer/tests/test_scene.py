"""Geometry of what is drawn."""

from __future__ import annotations

import numpy as np

from caraware_viewer import wire
from caraware_viewer.scene import on_screen, outlines_m


def states(**fields: float) -> np.ndarray:
    row = np.zeros(1, wire.VEHICLE_STATE)
    values = {"x_m": 10, "y_m": 20, "length_m": 5, "width_m": 2, "rear_overhang_m": 1}
    for name, value in (values | fields).items():
        row[name] = value
    return row


def test_a_vehicle_reaches_from_its_rear_overhang_to_its_front() -> None:
    outline = outlines_m(states())[0]
    np.testing.assert_allclose(outline, [[9, 21], [14, 21], [14, 19], [9, 19], [9, 21]], atol=1e-5)


def test_heading_turns_it_counter_clockwise() -> None:
    outline = outlines_m(states(yaw_rad=np.pi / 2))[0]
    np.testing.assert_allclose(outline, [[9, 19], [9, 24], [11, 24], [11, 19], [9, 19]], atol=1e-5)


def test_a_pedestrian_stands_in_its_centre() -> None:
    outline = outlines_m(states(kind=wire.PERSON, length_m=0.5, width_m=0.5, rear_overhang_m=0))[0]
    np.testing.assert_allclose(outline.mean(axis=0)[0], 10, atol=0.1)
    np.testing.assert_allclose([outline.min(axis=0), outline.max(axis=0)], [[9.75, 19.75], [10.25, 20.25]], atol=1e-5)


def test_up_on_the_screen_is_north() -> None:
    np.testing.assert_array_equal(on_screen(np.array([[1.0, 2.0]])), [[1, -2]])
