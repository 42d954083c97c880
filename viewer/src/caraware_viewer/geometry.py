"""Shapes of road users and the scene, as arrays in the world frame: metres, x east, y north."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from caraware_viewer import wire

Points = NDArray[np.floating]

_OUTLINE = np.array([[0, 1], [0, -1], [1, -1], [0.6, 0], [1, 1], [1, -1], [1, 1], [0, 1]], dtype=np.float64)
"""Box with an arrow at its front: 0 … 1 from rear to front, ±1 from right to left."""

BLINKER_RIGHT, BLINKER_LEFT, BLINKER_BOTH, BRAKE = 1, 2, 4, 8
"""SUMO's signal bits."""

_RING_POINTS = 97


def outlines_m(states: NDArray[np.void]) -> NDArray[np.float32]:
    """Closed outlines `[n, 8, 2]` of road users seen from above; an arrow inside points forward."""
    return _in_world(states, _OUTLINE)


def bodies_m(states: NDArray[np.void]) -> NDArray[np.float32]:
    """Centre lines `[n, 2, 2]` of road users; drawn with the radii of `body_radii_m`, they fill the outlines."""
    radius_m = body_radii_m(states)
    ends = np.stack([radius_m, states["length_m"] - radius_m], axis=1)
    along_m = ends - _rear_m(states)[:, None]
    return _turned(states, along_m, np.zeros_like(along_m))


def body_radii_m(states: NDArray[np.void]) -> NDArray[np.float32]:
    """Radius `[n]` of the lines of `bodies_m`: 0.45 of the width."""
    radius_m: NDArray[np.float32] = 0.45 * np.minimum(states["width_m"], states["length_m"])
    return radius_m.astype(np.float32)


def kinds(states: NDArray[np.void]) -> NDArray[np.uint32]:
    """Kinds `[n]` by which bodies are coloured: a trailing body has that of its vehicle, if that is among them."""
    kinds: NDArray[np.uint32] = states["kind"].copy()
    trailing = np.flatnonzero(kinds == wire.TRAILING)
    if len(trailing):
        leading = {int(state["vehicle"]): int(state["kind"]) for state in states[states["trailing"] > 0]}
        owners = states["vehicle"][trailing] & ((1 << wire.BODY_SHIFT) - 1)
        kinds[trailing] = [leading.get(int(owner), wire.OTHER) for owner in owners]
    # A frame may have kinds of a later program.
    known: NDArray[np.uint32] = np.minimum(kinds, wire.HERO)
    return known


def blinkers_m(states: NDArray[np.void]) -> NDArray[np.float32]:
    """Positions of the blinkers that are on, `[m, 2]`: the front and rear corners of that side."""
    left = states[states["signals"] & (BLINKER_LEFT | BLINKER_BOTH) != 0]
    right = states[states["signals"] & (BLINKER_RIGHT | BLINKER_BOTH) != 0]
    corners = [_in_world(left, np.array([[0, 1], [1, 1]])), _in_world(right, np.array([[0, -1], [1, -1]]))]
    return np.concatenate(corners).reshape(-1, 2)


def brake_lights_m(states: NDArray[np.void]) -> NDArray[np.float32]:
    """Positions of the brake lights that are on, `[m, 2]`: two at the rear of each last body."""
    braking = states[(states["signals"] & BRAKE != 0) & (states["kind"] != wire.PERSON) & (states["trailing"] == 0)]
    return _in_world(braking, np.array([[0, 0.7], [0, -0.7]])).reshape(-1, 2)


def centres_m(states: NDArray[np.void]) -> NDArray[np.float32]:
    """Centres `[n, 3]` of the boxes around road users."""
    along_m = (states["length_m"] / 2 - _rear_m(states))[:, None]
    flat = _turned(states, along_m, np.zeros_like(along_m))[:, 0]
    return np.column_stack([flat, states["z_m"] + states["height_m"] / 2]).astype(np.float32)


def quaternions(yaw_rad: Points) -> NDArray[np.float32]:
    """Rotations about the vertical as quaternions `[n, 4]` (x, y, z, w)."""
    zero = np.zeros_like(yaw_rad)
    return np.stack([zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)], axis=-1).astype(np.float32)


def ring_m(centre_m: Sequence[float] | Points, radius_m: float) -> NDArray[np.float32]:
    """A closed circle `[97, 2]`."""
    angle = np.linspace(0, 2 * np.pi, _RING_POINTS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)]) * radius_m
    return (np.asarray(centre_m)[:2] + circle).astype(np.float32)


def links_m(points_m: Points, vehicles_m: Points) -> NDArray[np.float32]:
    """Segments `[n, 2, 2]` from points to vehicles."""
    return np.stack([points_m, vehicles_m], axis=1).astype(np.float32)


def boxes_m(centres_m: Points, yaw_rad: Points, sizes_m: Points) -> NDArray[np.float32]:
    """Closed outlines `[n, 8, 2]` of boxes by centre `[n, 2]`, yaw `[n]`, length and width `[n, 2]`, with an arrow."""
    along_m = (_OUTLINE[:, 0] - 0.5) * np.asarray(sizes_m)[:, :1]
    across_m = _OUTLINE[:, 1] / 2 * np.asarray(sizes_m)[:, 1:2]
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    offsets_m = np.stack([cos * along_m - sin * across_m, sin * along_m + cos * across_m], axis=-1)
    return (np.asarray(centres_m)[:, None, :] + offsets_m).astype(np.float32)


def hatching_m(outline_m: Points, spacing_m: float) -> list[NDArray[np.float32]]:
    """Horizontal segments `[2, 2]` inside a polygon `[n, 2]` (even-odd), `spacing_m` apart.

    Drawn with half the spacing as radius, the segments fill the polygon; rerun's 2-D views have no filled polygons.
    """
    start, end = np.asarray(outline_m, np.float64), np.roll(outline_m, -1, axis=0).astype(np.float64)
    rows = np.arange(start[:, 1].min() + spacing_m / 2, start[:, 1].max(), spacing_m)
    segments = []
    for y in rows:
        crossed = (start[:, 1] <= y) != (end[:, 1] <= y)
        a, b = start[crossed], end[crossed]
        xs = np.sort(a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]))
        segments += [
            np.array([[left, y], [right, y]], np.float32) for left, right in zip(xs[::2], xs[1::2], strict=True)
        ]
    return segments


def _rear_m(states: NDArray[np.void]) -> NDArray[np.float32]:
    """Distance `[n]` from the rear end to the origin; the origin of a person is its centre."""
    return np.where(states["kind"] == wire.PERSON, states["length_m"] / 2, states["rear_overhang_m"])


def _in_world(states: NDArray[np.void], shape: NDArray[np.floating]) -> NDArray[np.float32]:
    """World positions `[n, k, 2]` of a shape `[k, 2]` that is scaled to each road user."""
    along_m = shape[:, 0] * states["length_m"][:, None] - _rear_m(states)[:, None]
    across_m = shape[:, 1] * states["width_m"][:, None] / 2
    return _turned(states, along_m, across_m)


def _turned(states: NDArray[np.void], along_m: Points, across_m: Points) -> NDArray[np.float32]:
    """World positions `[n, k, 2]` of points in the frames of road users, x forward, y left."""
    cos, sin = np.cos(states["yaw_rad"])[:, None], np.sin(states["yaw_rad"])[:, None]
    x_m = states["x_m"][:, None] + cos * along_m - sin * across_m
    y_m = states["y_m"][:, None] + sin * along_m + cos * across_m
    return np.stack([x_m, y_m], axis=-1).astype(np.float32)
