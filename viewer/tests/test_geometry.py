"""Geometry of road users, map and point clouds."""

from __future__ import annotations

import numpy as np
import pytest

from caraware_viewer import cloud, geometry, paint, solid, static_map, wire
from caraware_viewer.canvas import on_screen
from caraware_viewer.documents import Lane


def states(**fields: float) -> np.ndarray:
    row = np.zeros(1, wire.VEHICLE_STATE)
    values = {"x_m": 10, "y_m": 20, "length_m": 5, "width_m": 2, "height_m": 1.5, "rear_overhang_m": 1}
    for name, value in (values | fields).items():
        row[name] = value
    return row


def test_a_vehicle_reaches_from_its_rear_overhang_to_its_front() -> None:
    outline = geometry.outlines_m(states())[0]
    corners, apex = outline[[0, 1, 2, 4]], outline[3]
    np.testing.assert_allclose(corners, [[9, 21], [9, 19], [14, 19], [14, 21]], atol=1e-5)
    np.testing.assert_allclose(outline[0], outline[-1])
    np.testing.assert_allclose(apex, [12, 20], atol=1e-5)


def test_heading_turns_it_counter_clockwise() -> None:
    outline = geometry.outlines_m(states(yaw_rad=np.pi / 2))[0]
    np.testing.assert_allclose(outline[[0, 1, 2, 4]], [[9, 19], [11, 19], [11, 24], [9, 24]], atol=1e-5)


def test_a_pedestrian_stands_in_its_centre() -> None:
    person = states(kind=wire.PERSON, length_m=0.5, width_m=0.5, rear_overhang_m=0)
    outline = geometry.outlines_m(person)[0]
    np.testing.assert_allclose([outline.min(axis=0), outline.max(axis=0)], [[9.75, 19.75], [10.25, 20.25]], atol=1e-5)
    np.testing.assert_allclose(geometry.centres_m(person)[0], [10, 20, 0.75], atol=1e-5)


def test_a_body_stays_inside_its_outline() -> None:
    car = states(yaw_rad=0.7)
    body, radius = geometry.bodies_m(car)[0], float(geometry.body_radii_m(car)[0])
    assert np.linalg.norm(body[1] - body[0]) + 2 * radius == pytest.approx(5.0, abs=1e-5)
    assert radius < 1.0


@pytest.mark.parametrize(
    ("signals", "expected"),
    [
        (0, []),
        (geometry.BLINKER_LEFT, [[9, 21], [14, 21]]),
        (geometry.BLINKER_RIGHT, [[9, 19], [14, 19]]),
        (geometry.BLINKER_BOTH, [[9, 21], [14, 21], [9, 19], [14, 19]]),
    ],
)
def test_blinkers_are_at_the_corners_of_their_side(signals: int, expected: list[list[float]]) -> None:
    found = geometry.blinkers_m(states(signals=signals))
    np.testing.assert_allclose(found, np.array(expected).reshape(-1, 2), atol=1e-5)


def test_brake_lights_are_at_the_rear() -> None:
    found = geometry.brake_lights_m(states(signals=geometry.BRAKE | geometry.BLINKER_LEFT))
    np.testing.assert_allclose(found, [[9, 20.7], [9, 19.3]], atol=1e-5)
    assert geometry.brake_lights_m(states(signals=geometry.BRAKE, kind=wire.PERSON)).shape == (0, 2)


def test_a_trailing_body_has_its_vehicles_colour_and_the_last_one_the_brake_lights() -> None:
    hero = states(kind=wire.HERO, vehicle=5, trailing=2, signals=geometry.BRAKE)
    behind = [
        states(kind=wire.TRAILING, vehicle=5 | place << wire.BODY_SHIFT, trailing=2 - place, x_m=-10.0 * place)
        for place in (1, 2)
    ]
    for body in behind:
        body["signals"] = geometry.BRAKE
    train = np.concatenate([hero, *behind])
    assert geometry.kinds(train).tolist() == [wire.HERO] * 3
    # A sample may have left out the vehicle.
    assert geometry.kinds(train[1:]).tolist() == [wire.OTHER] * 2
    lights = geometry.brake_lights_m(train)
    assert len(lights) == 2 and (lights[:, 0] < -20).all()


def test_hatching_fills_a_polygon_with_a_notch() -> None:
    outline = np.array([[0, 0], [10, 0], [10, 10], [6, 10], [6, 4], [4, 4], [4, 10], [0, 10]])
    segments = geometry.hatching_m(outline, 0.1)
    area = sum(0.1 * float(segment[1, 0] - segment[0, 0]) for segment in segments)
    assert area == pytest.approx(10 * 10 - 2 * 6, rel=0.01)
    assert not any(y > 4 and left < 5 < right for (left, y), (right, _) in segments)


def test_a_dashed_line_is_in_pieces_along_its_bends() -> None:
    pieces = paint.pieces_m(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]), 3.0, 6.0)
    np.testing.assert_allclose(pieces, [[[0, 0], [3, 0]], [[9, 0], [10, 2]], [[10, 8], [10, 10]]])


def lane(points_m: list[list[float]]) -> Lane:
    """A lane of 4 m."""
    return Lane(id="", kind="car", inside=False, width_m=4.0, right="none", left="none", points_m=points_m)


def test_the_left_edge_lies_to_the_left() -> None:
    along_x = lane([[0, 0, 1], [10, 0, 1]])
    np.testing.assert_allclose(paint.edge_m(along_x, 1), np.array([[0.0, 2.0], [10.0, 2.0]]))
    np.testing.assert_allclose(paint.edge_m(along_x, -1), np.array([[0.0, -2.0], [10.0, -2.0]]))


def test_stripes_of_a_crossing_lie_across_the_way_of_pedestrians() -> None:
    stripes = np.array(paint.stripes_m(lane([[0, 0, 0], [3, 0, 0]])))
    assert len(stripes) == 3
    np.testing.assert_allclose(stripes[0], [[0.25, 1.75], [0.25, -1.75]])


def scan(**fields: object) -> np.void:
    head = np.zeros(1, wire.SCAN)
    for name, value in fields.items():
        head[name] = value
    row: np.void = head[0]
    return row


def point(position_m: list[float], age_us: int = 0) -> np.ndarray:
    row = np.zeros(1, wire.LIDAR_POINT)
    row["position_m"], row["age_us"] = position_m, age_us
    return row


STILL = np.zeros(3)


def test_points_are_placed_by_the_pose_of_their_sensor() -> None:
    placed = cloud.in_world_m(scan(position_m=[10, 20, 2], attitude_rad=[0, 0, np.pi / 2]), point([5, 1, 0]), STILL, 0)
    np.testing.assert_allclose(placed, [[9, 25, 2]], atol=1e-5)
    nose_up = cloud.in_world_m(scan(attitude_rad=[0, 0.1, 0]), point([10, 0, 0]), STILL, 0)
    np.testing.assert_allclose(nose_up, [[10 * np.cos(0.1), 0, 10 * np.sin(0.1)]], atol=1e-5)
    right_down = cloud.in_world_m(scan(attitude_rad=[0.1, 0, 0]), point([0, 10, 0]), STILL, 0)
    np.testing.assert_allclose(right_down, [[0, 10 * np.cos(0.1), 10 * np.sin(0.1)]], atol=1e-5)


def test_the_papers_axes_are_turned() -> None:
    placed = cloud.in_world_m(scan(axes=cloud.PAPER_AXES), point([1, -5, 2]), STILL, 0)
    np.testing.assert_allclose(placed, [[5, 1, -2]], atol=1e-6)


def test_points_fired_earlier_were_fired_from_farther_back() -> None:
    placed = cloud.in_world_m(scan(), point([5, 0, 0], 100_000), np.array([10.0, 0, 0]), np.pi)
    angle = -0.1 * np.pi
    np.testing.assert_allclose(placed, [[5 * np.cos(angle) - 1, 5 * np.sin(angle), 0]], atol=1e-5)


def test_points_of_interest_are_on_road_users_and_lost_loads() -> None:
    points = np.zeros(14, wire.LIDAR_POINT)
    points["tag"] = np.arange(14)
    assert cloud.points_of_interest(points)["tag"].tolist() == [4, 5, 6, 12]
    points["tag"] += 1000
    assert (cloud.colors(points) == cloud.TAG_COLORS[-1]).all()


def test_up_on_the_screen_is_north() -> None:
    np.testing.assert_array_equal(on_screen(np.array([[1.0, 2.0]])), [[1, -2]])


def area_m2(triangles: np.ndarray) -> float:
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    return float(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2)


def test_triangles_fill_a_concave_polygon_and_nothing_else() -> None:
    horseshoe = np.array([[0, 0], [6, 0], [6, 5], [4, 5], [4, 2], [2, 2], [2, 4], [0, 4]])
    found = solid.triangles_m(horseshoe)
    assert area_m2(found) == pytest.approx(6 * 2 + 2 * 3 + 2 * 2)
    centres = found.mean(axis=1)
    assert not ((centres[:, 0] > 2) & (centres[:, 0] < 4) & (centres[:, 1] > 2)).any()
    angles, radii = np.arange(10) * np.pi / 5, np.array([2, 1] * 5)
    star = np.column_stack([np.cos(angles) * radii, np.sin(angles) * radii])
    assert area_m2(solid.triangles_m(star)) == pytest.approx(5 * 2 * np.sin(np.pi / 5))
    assert len(solid.triangles_m(np.array([[0, 0], [1, 0], [2, 0]]))) == 0


def test_a_building_has_a_roof_and_a_wall_for_each_side() -> None:
    square = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]]
    surface = solid.buildings([{"points_m": square, "base_m": 2.0, "height_m": 8.0}], [200, 100, 50])
    assert len(surface.corners_m) == 2 + 4 * 2
    roof, walls = surface.corners_m[:2], surface.corners_m[2:]
    assert (roof[..., 2] == 10).all()
    assert (walls[..., 2].min(), walls[..., 2].max()) == (2, 10)
    # The side that faces north-east is lighter than the one that faces south-west.
    brightness = surface.colors[2::2].sum(axis=1)
    assert brightness[2] > brightness[0]
    assert (surface.colors[:2] == [200, 100, 50]).all()


@pytest.mark.parametrize(("width_m", "expected_m"), [(220, 50), (4100, 1000), (900, 200), (3, 1), (81, 20)])
def test_the_scale_is_a_round_length(width_m: float, expected_m: float) -> None:
    assert static_map.scale_m(width_m) == expected_m
