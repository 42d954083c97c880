"""The ground of the 3-D view follows the roads of a map with slopes, and lies below them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caraware_viewer import ground
from caraware_viewer.documents import Lane

COLOR = [40, 40, 40]
BOUNDS_M = (0.0, 0.0, 200.0, 120.0)


def lane(*points_m: tuple[float, float, float]) -> Lane:
    return {"kind": "road", "width_m": 3.2, "points_m": [list(point) for point in points_m], "inside": False}  # type: ignore[typeddict-item]


def height_at(corners_m: NDArray[np.float32], x: float, y: float) -> float:
    """Height of the triangles `[t, 3, 3]` above a place, by barycentric coordinates."""
    a, b, c = corners_m[:, 0], corners_m[:, 1], corners_m[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    u = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / area
    v = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / area
    inside = int(np.flatnonzero((u >= -1e-4) & (v >= -1e-4) & (u + v <= 1 + 1e-4))[0])
    first, second, third = a[inside, 2], b[inside, 2], c[inside, 2]
    return float(first + u[inside] * (second - first) + v[inside] * (third - first))


def test_a_flat_map_lies_on_a_plane() -> None:
    surface = ground.ground(BOUNDS_M, [lane((0, 0, 3.0), (200, 0, 3.2))], COLOR)
    assert surface.corners_m.shape == (2, 3, 3)
    assert np.unique(surface.corners_m[..., 2]).tolist() == [np.float32(2.9)]


def test_the_ground_follows_roads_on_a_slope_and_stays_below_them() -> None:
    def at(x: float, y: float) -> tuple[float, float, float]:
        return x, y, 20.0 + 0.08 * x - 0.05 * y

    roads = [lane(at(0, y), at(200, y)) for y in (10, 60, 110)] + [lane(at(x, 10), at(x, 110)) for x in (20, 150)]
    surface = ground.ground(BOUNDS_M, roads, COLOR)
    assert (surface.corners_m[..., 0].min(), surface.corners_m[..., 0].max()) == (-60.0, 260.0)
    for x, y in ((5, 10), (20, 33), (77.3, 60), (150, 61), (150, 99), (190, 110)):
        below_m = at(x, y)[2] - height_at(surface.corners_m, x, y)
        assert 0.0 < below_m < 0.45, (x, y, below_m)
    # It leans everywhere, so it is not of one colour everywhere either.
    assert len(np.unique(surface.colors, axis=0)) > 1


def test_a_bridge_does_not_lift_the_ground() -> None:
    road, bridge = lane((0, 60, 0), (200, 60, 0)), lane((100, 0, 0), (100, 40, 7), (100, 80, 7), (100, 120, 0))
    surface = ground.ground(BOUNDS_M, [road, bridge], COLOR)
    assert height_at(surface.corners_m, 100, 60) < 0.0
    # Its ramps do where no road is below them.
    assert 3.0 < height_at(surface.corners_m, 100, 25) < 7.0 * 25 / 40


def test_a_corner_has_the_nearest_place_or_one_hardly_further() -> None:
    random = np.random.default_rng(1)
    low, cell_m, counts = np.array([-10.0, 4.0]), 5.0, (41, 23)
    places = low + random.uniform(0, 1, (60, 2)) * cell_m * (np.array(counts) - 1)
    x, y = (low[axis] + cell_m * np.arange(counts[axis]) for axis in (0, 1))
    corners = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    found = ground._nearest(places, corners, low, cell_m)
    distances = np.linalg.norm(corners[:, :, None] - places, axis=-1)
    taken = np.take_along_axis(distances, found[..., None], axis=-1)[..., 0]
    assert (taken <= distances.min(axis=-1) + cell_m).all()
    assert np.isclose(taken, distances.min(axis=-1)).mean() > 0.97


def test_a_large_map_has_no_more_triangles_than_cells_allow() -> None:
    far = 40_000.0
    roads = [lane((0, 0, 0), (far, far, 300.0))]
    surface = ground.ground((0, 0, far, far), roads, COLOR)
    assert len(surface.corners_m) <= 2.1 * ground.MAX_CELLS
