"""Point clouds have the committed layout, and their points are transformed into the world correctly."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from caraware.ipc.mounts import MountedSensor
from caraware.ipc.pointcloud import POINT, SCAN, PointCloud, rotation

LAYOUT = Path(__file__).parents[2] / "ipc-schema" / "layout.json"


@pytest.mark.parametrize(("name", "dtype"), [("LidarPoint", POINT), ("Scan", SCAN)])
def test_types_repeat_the_committed_table(name: str, dtype: np.dtype) -> None:
    table = {row["name"]: row for row in json.loads(LAYOUT.read_text())["types"]}
    assert dtype.itemsize == table[name]["size"]
    assert dtype.fields is not None and dtype.names is not None
    assert [[field, dtype.fields[field][1]] for field in dtype.names] == [field[:2] for field in table[name]["fields"]]


def cloud(points_m: list[list[float]], attitude: list[float], axes: int = 0) -> PointCloud:
    points = np.zeros(len(points_m), POINT)
    points["position_m"] = points_m
    scan = np.zeros(1, SCAN)
    scan["position_m"], scan["attitude_rad"], scan["axes"] = [100.0, 50.0, 2.0], attitude, axes
    return PointCloud(0, 0, 0, MountedSensor("cav.0", "", "lidar", (), is_roadside=False), scan[0], points)


def test_a_point_ahead_of_a_car_that_heads_north_lies_north() -> None:
    seen = cloud([[10, 0, 0], [0, 1, 0]], [0, 0, math.pi / 2])
    np.testing.assert_allclose(seen.world_m, [[100, 60, 2], [99, 50, 2]], atol=1e-9)


def test_nose_up_looks_up_and_roll_to_the_right_lifts_the_left() -> None:
    np.testing.assert_allclose(cloud([[10, 0, 0]], [0, math.pi / 6, 0]).world_m[0], [108.660254, 50, 7], atol=1e-6)
    np.testing.assert_allclose(cloud([[0, 10, 0]], [math.pi / 6, 0, 0]).world_m[0], [100, 58.660254, 7], atol=1e-6)
    turn = rotation(0.1, -0.2, 0.3)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)


def test_the_papers_axes_are_backward_left_and_down() -> None:
    np.testing.assert_allclose(cloud([[3, -10, -1]], [0, 0, 0], axes=1).world_m, [[110, 53, 3]], atol=1e-9)
