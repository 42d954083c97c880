"""The ground of the 3-D view: a plane, or on a map with slopes a grid of triangles, as the LIDARs' ground is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from caraware_viewer.documents import Lane
from caraware_viewer.solid import Surface, plain

FLAT_M = 0.5
"""Where all lanes are within this height the ground is a plane."""
CELL_M = 5.0
MAX_CELLS = 40_000
BRIDGE_M = 3.0
"""A road this far above another does not carry the ground, which has one height at each place."""
_BELOW_M = 0.15
_AROUND = 0.3
"""Ground around a map with slopes, as a share of its size."""
_SUN = np.array([-0.37, -0.6, 1.0])
"""Direction to the light: nothing casts a shadow, so colours show where the ground leans."""


def ground(bounds_m: Sequence[float], lanes: Iterable[Lane], color: Sequence[int]) -> Surface:
    """The surface under a map within `bounds_m` (x_min, y_min, x_max, y_max), a little below its lanes."""
    lines = [np.asarray(lane["points_m"], np.float64) for lane in lanes]
    heights_m = np.concatenate([line[:, 2] for line in lines]) if lines else np.zeros(1)
    low_m = float(heights_m.min())
    if heights_m.max() - low_m < FLAT_M:
        return _plane(bounds_m, low_m - 0.1, color)
    return _hills(bounds_m, lines, color)


def _plane(bounds_m: Sequence[float], height_m: float, color: Sequence[int]) -> Surface:
    """A plane under the whole map, and as far around it again."""
    x_min, y_min, x_max, y_max = bounds_m
    wide, high = x_max - x_min, y_max - y_min
    corners = np.array(
        [
            [x_min - wide, y_min - high, height_m],
            [x_max + wide, y_min - high, height_m],
            [x_max + wide, y_max + high, height_m],
            [x_min - wide, y_max + high, height_m],
        ]
    )
    return plain(corners[[[0, 1, 2], [0, 2, 3]]], color)


def _hills(bounds_m: Sequence[float], lines: list[NDArray[np.float64]], color: Sequence[int]) -> Surface:
    """A grid whose corners are as high as the nearest place on a road."""
    low, high = np.array(bounds_m[:2], np.float64), np.array(bounds_m[2:], np.float64)
    margin = _AROUND * (high - low)
    low, high = low - margin, high + margin
    cell_m = max(CELL_M, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
    counts = np.ceil((high - low) / cell_m).astype(int) + 1
    places = np.concatenate([_sampled(line, cell_m / 5) for line in lines])
    places = _lowest(places, low, cell_m, counts)
    x = low[0] + cell_m * np.arange(counts[0])
    y = low[1] + cell_m * np.arange(counts[1])
    nearest = _nearest(places[:, :2], np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1), low, cell_m)
    corners = np.empty((*counts, 3))
    corners[..., 0], corners[..., 1] = x[:, None], y
    corners[..., 2] = places[nearest, 2] - _BELOW_M
    a, b, c, d = corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)
    return Surface(triangles.astype(np.float32), _lit(triangles, color))


def _sampled(line: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """Places `[n, 3]` along a line, at most `spacing_m` apart."""
    at_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    sampled = np.linspace(0.0, at_m[-1], int(np.ceil(at_m[-1] / spacing_m)) + 1)
    return np.column_stack([np.interp(sampled, at_m, line[:, axis]) for axis in range(3)])


def _lowest(
    places: NDArray[np.float64], low: NDArray[np.float64], cell_m: float, counts: NDArray[np.int_]
) -> NDArray[np.float64]:
    """The places without those of bridges: with a lower road in the cells around them."""
    cells = _cells(places[:, :2], low, cell_m, counts)
    least = np.full(counts + 2, np.inf)
    np.minimum.at(least, (cells[:, 0] + 1, cells[:, 1] + 1), places[:, 2])
    around = np.min(
        [least[i : i + counts[0], j : j + counts[1]] for i in range(3) for j in range(3)],
        axis=0,
    )
    lowest: NDArray[np.float64] = places[places[:, 2] < around[cells[:, 0], cells[:, 1]] + BRIDGE_M]
    return lowest


def _cells(
    places: NDArray[np.float64], low: NDArray[np.float64], cell_m: float, counts: NDArray[np.int_]
) -> NDArray[np.int_]:
    """The corner of the grid that is nearest to each place."""
    nearest: NDArray[np.int_] = np.clip(np.rint((places - low) / cell_m).astype(int), 0, counts - 1)
    return nearest


def _nearest(
    places: NDArray[np.float64], corners: NDArray[np.float64], low: NDArray[np.float64], cell_m: float
) -> NDArray[np.int_]:
    """Index of the place that is nearest to each corner `[nx, ny, 2]`.

    Jump flooding (Rong, Tan 2006): a corner takes over the place of a corner 2ⁿ, …, 4, 2, 1 cells away if that is
    nearer. A few corners get one that is hardly further than the nearest.
    """
    counts = np.array(corners.shape[:2])
    cells = _cells(places, low, cell_m, counts)
    # Of several places at one corner, the nearest is entered last.
    order = np.argsort(-np.linalg.norm(places - low - cell_m * cells, axis=1), kind="stable")
    found = np.full(counts, -1)
    found[cells[order, 0], cells[order, 1]] = order
    distance = np.where(found < 0, np.inf, np.linalg.norm(corners - places[found], axis=-1))
    jump = 1 << int(counts.max() - 1).bit_length()
    while jump := jump // 2:
        for step in ((i, j) for i in (-jump, 0, jump) for j in (-jump, 0, jump) if (i, j) != (0, 0)):
            to = tuple(slice(max(0, -s), max(0, n - max(0, s))) for s, n in zip(step, counts, strict=True))
            source = tuple(slice(max(0, s), max(0, n - max(0, -s))) for s, n in zip(step, counts, strict=True))
            other = found[source]
            away = np.where(other < 0, np.inf, np.linalg.norm(corners[to] - places[other], axis=-1))
            nearer = away < distance[to]
            found[to] = np.where(nearer, other, found[to])
            distance[to] = np.where(nearer, away, distance[to])
    return found


def _lit(triangles: NDArray[np.float64], color: Sequence[int]) -> NDArray[np.uint8]:
    """Colours `[t, 3]`, lighter where a triangle leans towards the light."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    flat = _SUN[2] / np.linalg.norm(_SUN)
    light = np.clip(1.0 + 3.0 * (normal @ (_SUN / np.linalg.norm(_SUN)) - flat), 0.6, 1.6)
    colors: NDArray[np.uint8] = np.clip(light[:, None] * np.asarray(color), 0, 255).astype(np.uint8)
    return colors
