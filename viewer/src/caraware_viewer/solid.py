"""Surfaces of the 3-D view: walls and roofs of buildings, roads and walks, as triangles."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer.documents import Area, Building, Lane

_SUN = np.array([0.5, 0.8])
"""Direction from which walls are lit: they have no lamps, and would be one dark shape."""
_DARKEST = 0.55


@dataclass(frozen=True)
class Surface:
    """Triangles that share no corners."""

    corners_m: NDArray[np.float32]
    """`[t, 3, 3]`, world."""
    colors: NDArray[np.uint8]
    """`[t, 3]`, RGB."""

    def mesh(self) -> rr.Mesh3D:
        """The surface as rerun draws it."""
        corners = self.corners_m.reshape(-1, 3)
        return rr.Mesh3D(
            vertex_positions=corners,
            triangle_indices=np.arange(len(corners), dtype=np.uint32).reshape(-1, 3),
            vertex_colors=np.repeat(self.colors, 3, axis=0),
        )


def triangles_m(outline_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """Triangles `[t, 3, 2]` that fill a simple polygon `[n, 2]`, which may be concave.

    Between the heights of two neighbouring corners no sides cross, so that the polygon is a row of trapezoids there.
    """
    start = np.asarray(outline_m, np.float64)
    end = np.roll(start, -1, axis=0)
    levels = np.unique(start[:, 1])
    found: list[NDArray[np.float64]] = []
    for low, high in itertools.pairwise(levels):
        across = (np.minimum(start[:, 1], end[:, 1]) <= low) & (np.maximum(start[:, 1], end[:, 1]) >= high)
        a, b = start[across], end[across]
        slope = (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
        x_low, x_high = a[:, 0] + (low - a[:, 1]) * slope, a[:, 0] + (high - a[:, 1]) * slope
        order = np.argsort(x_low + x_high)
        for left, right in zip(order[::2], order[1::2], strict=False):
            corners = [(x_low[left], low), (x_low[right], low), (x_high[right], high), (x_high[left], high)]
            found += [np.array(corners[:3]), np.array([corners[0], *corners[2:]])]
    return np.array(found).reshape(-1, 3, 2)


def buildings(solids: Iterable[Building], roof: Sequence[int]) -> Surface:
    """Walls and roofs; `roof` is the colour of roofs, and walls are darker the more they face away from the light."""
    corners, colors = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    base = np.asarray(roof, np.float64)
    for solid in solids:
        outline = np.asarray(solid["points_m"], np.float64)[:, :2]
        if len(outline) < 3:
            continue
        low, high = float(solid["base_m"]), float(solid["base_m"]) + float(solid["height_m"])
        top = triangles_m(outline)
        corners.append(_at_height(top, high))
        colors.append(np.tile(base, (len(top), 1)))
        walls, outward = _walls(outline, low, high)
        light = _DARKEST + (1 - _DARKEST) * (1 + outward @ (_SUN / np.linalg.norm(_SUN))) / 2 * 0.8
        corners.append(walls)
        colors.append(np.repeat(light[:, None] * base, 2, axis=0))
    return Surface(np.concatenate(corners).astype(np.float32), np.concatenate(colors).astype(np.uint8))


def _walls(outline: NDArray[np.float64], low: float, high: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two triangles for each side `[2 n, 3, 3]`, and the direction `[n, 2]` in which each side faces."""
    a, b = outline, np.roll(outline, -1, axis=0)
    lift = np.full((len(a), 1), 0.0)
    a_low, b_low = np.hstack([a, lift + low]), np.hstack([b, lift + low])
    a_high, b_high = np.hstack([a, lift + high]), np.hstack([b, lift + high])
    pairs = np.stack([np.stack([a_low, b_low, b_high], 1), np.stack([a_low, b_high, a_high], 1)], 1)
    along = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-9)
    return pairs.reshape(-1, 3, 3), np.column_stack([along[:, 1], -along[:, 0]])


def strips(lanes: Iterable[Lane], color: Sequence[int], raised_m: float) -> Surface:
    """Lanes as bands of their widths, `raised_m` above their centre lines."""
    found = [np.zeros((0, 3, 3))]
    for lane in lanes:
        line = np.asarray(lane["points_m"], np.float64)
        along = np.gradient(line[:, :2], axis=0)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        aside = np.column_stack([-along[:, 1], along[:, 0]]) * lane["width_m"] / 2
        height = line[:, 2:3] + raised_m
        left, right = np.hstack([line[:, :2] + aside, height]), np.hstack([line[:, :2] - aside, height])
        found.append(np.stack([right[:-1], right[1:], left[1:]], axis=1))
        found.append(np.stack([right[:-1], left[1:], left[:-1]], axis=1))
    return plain(np.concatenate(found), color)


def areas(polygons: Iterable[Area], color: Sequence[int], raised_m: float) -> Surface:
    """Areas, each `raised_m` above the mean height of its outline."""
    found = [np.zeros((0, 3, 3))]
    for polygon in polygons:
        outline = np.asarray(polygon["points_m"], np.float64)
        if len(outline) > 2:
            height_m = outline[:, 2].mean() if outline.shape[1] > 2 else 0.0
            found.append(_at_height(triangles_m(outline[:, :2]), height_m + raised_m))
    return plain(np.concatenate(found), color)


def _at_height(flat_m: NDArray[np.float64], height_m: float) -> NDArray[np.float64]:
    return np.concatenate([flat_m, np.full((*flat_m.shape[:-1], 1), height_m)], axis=-1)


def plain(corners_m: NDArray[np.float64], color: Sequence[int]) -> Surface:
    """Triangles `[t, 3, 3]` of one colour."""
    return Surface(corners_m.astype(np.float32), np.tile(np.array(color, np.uint8), (len(corners_m), 1)))
