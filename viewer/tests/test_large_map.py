"""What a large map leaves out: a browser draws all of it again for every frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import recordings
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import paint, static_map
from caraware_viewer.canvas import Canvas
from caraware_viewer.documents import Area, Lane


def lane(
    x_m: float = 0.0, length_m: float = 90.0, kind: str = "car", left: str = "dashed", *, inside: bool = False
) -> Lane:
    """A lane to the north with a line on either side."""
    points_m = [[x_m, 0.0, 1.0], [x_m, length_m, 1.0]]
    return Lane(id="a", kind=kind, inside=inside, width_m=3.0, left=left, right="solid", points_m=points_m)


def lines(found: paint.Lines) -> int:
    return sum(len(pieces) for _, pieces in found)


def test_lanes_inside_junctions_are_left_out_where_their_areas_are_drawn() -> None:
    many = [lane(), *[lane(inside=True)] * static_map.MAX_LINES]
    junction = Area(kind="junction", points_m=[])
    assert static_map.shown_lanes(many, [junction]) == [lane()]
    assert static_map.shown_lanes(many, []) == many
    assert static_map.shown_lanes(many[:5], [junction]) == many[:5]


def test_dashes_are_left_out_first_and_then_all_paint() -> None:
    road = [lane()] * 3
    assert lines(paint.markings(road, 33)) == 3 * (10 + 1)
    assert lines(paint.markings(road, 32)) == 3
    assert lines(paint.markings(road, 2)) == 0
    crossing = [lane(kind="crossing", length_m=6.0)]
    assert lines(paint.crossings(crossing, 6)) == 6
    assert lines(paint.crossings(crossing, 5)) == 0


@pytest.mark.parametrize("count", [1, 3000])
def test_few_segments_fill_many_polygons(count: int) -> None:
    outline = np.array([[0, 0], [10, 0], [10, 40], [6, 40], [6, 20], [4, 20], [4, 40], [0, 40]], np.float64)
    filling, radii_m = static_map.filling_m([outline] * count)
    assert len(filling) <= 2.5 * max(static_map.MAX_LINES, 20)
    points = np.stack(np.meshgrid(np.arange(0.25, 10, 0.5), np.arange(0.25, 40, 0.5)), axis=-1).reshape(-1, 2)
    own, own_m = filling[: len(filling) // count], radii_m[: len(filling) // count]
    covered = np.any(
        [distance_m(points, segment) <= radius for segment, radius in zip(own, own_m, strict=True)], axis=0
    )
    notch = (np.abs(points[:, 0] - 5) < 1) & (points[:, 1] > 20)
    assert covered[~notch].mean() > 0.93
    # A wide segment reaches a little beyond the outline, and never across the notch.
    assert covered[notch].mean() < 0.75
    if count == 1:
        assert covered[notch].mean() < 0.2


def distance_m(points: NDArray[np.float64], segment: NDArray[np.float32]) -> NDArray[np.float64]:
    """Distances `[n]` of points to a segment `[2, 2]`."""
    begin, along = segment[0].astype(float), (segment[1] - segment[0]).astype(float)
    share = np.clip((points - begin) @ along / max(float(along @ along), 1e-9), 0, 1)
    distances: NDArray[np.float64] = np.linalg.norm(points - begin - share[:, None] * along, axis=1)
    return distances


@pytest.fixture
def canvas(tmp_path: Path) -> Iterator[tuple[Canvas, Callable[[], recordings.Entity]]]:
    """A canvas, and a function that ends it and returns the markings that were drawn on it."""
    recording, path = rr.RecordingStream("test", recording_id="test"), tmp_path / "run.rrd"
    recording.save(path)

    def markings() -> recordings.Entity:
        recording.flush()
        recording.disconnect()
        return recordings.read(path)[paint.SPACE_MARKINGS]

    yield Canvas(recording, 0.1), markings


Painted = tuple[Canvas, Callable[[], recordings.Entity]]


def test_on_a_large_map_the_paint_follows_the_vehicle(canvas: Painted) -> None:
    on, markings = canvas
    painted = paint.RoadPaint(on, [lane(x_m=float(x_m)) for x_m in range(0, 4000, 20)], most=100)
    for tick, x_m in enumerate((1000.0, 1010.0, 2000.0)):
        on.set_tick(tick)
        painted.follow(np.array([x_m, 0.0]))
    rows = markings().rows
    assert [at_s for at_s, _ in rows] == pytest.approx([0.1, 0.3])
    for (_, row), x_m in zip(rows, (1000.0, 2000.0), strict=True):
        corners = np.array([point for strip in row["LineStrips3D:strips"] for point in strip])
        assert 150 < np.abs(corners[:, 0] - x_m).max() < paint.NEAR_M + 5
        np.testing.assert_allclose(corners[:, 2], 1.05)


def test_on_a_small_map_all_paint_is_there_at_once(canvas: Painted) -> None:
    on, markings = canvas
    paint.RoadPaint(on, [lane()], most=100).follow(np.zeros(2))
    rows = markings().rows
    assert [at_s for at_s, _ in rows] == [recordings.ALWAYS]
    assert len(rows[0][1]["LineStrips3D:strips"]) == 11
