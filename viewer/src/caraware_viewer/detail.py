"""What is drawn of how many road users: level of detail by their number, and by a region of interest.

A choice depends on ids, never on rows: a vehicle that is drawn in one frame is drawn in the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caraware_viewer import wire

MAX_SHAPES = 400
"""Most road users that are drawn as boxes with lights; of more, those nearest to the centre of interest."""
MAX_POSITIONS = 200
"""Most vehicles whose fixes, predictions and estimates are drawn: more of them hide the map and the vehicles."""
INTEREST_M = 150.0
"""Radius of the region of interest around the followed vehicle."""

_ORDER = np.uint64(0x9E37_79B9_7F4A_7C15)
_LARGE_MAP_M = 500.0
"""On a larger map a car is a few pixels, so that each road user also has a dot."""

Region = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max, world, metres."""


def sampling_order(id_hash: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Order `[n]` in which road users are shown when not all are; the fan-out uses the same (`docs/fanout.md`)."""
    order: NDArray[np.uint64] = id_hash.astype(np.uint64) * _ORDER
    return order


@dataclass(frozen=True)
class Detail:
    """What is drawn of the road users of one frame."""

    shaped: NDArray[np.bool_]
    """`[n]`: drawn as a box with an arrow and lights."""
    marked: NDArray[np.bool_]
    """`[n]`: drawn as a dot, which has the same size at every zoom."""
    mark_px: float
    """Radius of the dots, pixels."""
    positioned: NDArray[np.uint64]
    """Hashes of the ids of the road users whose fixes and estimates are drawn."""
    thinned: bool
    """True if some road users have fixes and estimates that are not drawn."""


def choose(states: NDArray[np.void], centre: np.void | None, extent_m: float, region: Region | None = None) -> Detail:
    """The level of detail for `states [n]` on a map `extent_m` wide.

    The region of interest is `region`, else `INTEREST_M` around `centre`. Outside of a `region` nothing is drawn.
    """
    n = len(states)
    shown = np.ones(n, np.bool_) if region is None else _inside(states, region)
    rank = np.lexsort((sampling_order(states["id_hash"]), ~_of_interest(states, centre, shown), ~shown))
    shaped = np.zeros(n, np.bool_)
    if shown.sum() <= MAX_SHAPES:
        shaped[:] = shown
    else:
        shaped[_nearest(states, centre, rank, MAX_SHAPES)] = True
        shaped &= shown
    crowded = bool(shown.sum() > MAX_SHAPES) or extent_m > _LARGE_MAP_M
    sensing = np.flatnonzero((states["kind"][rank] == wire.CAV) | (states["kind"][rank] == wire.HERO))
    positioned = rank[sensing[:MAX_POSITIONS]]
    positioned = positioned[shown[positioned]]
    return Detail(
        shaped=shaped,
        marked=shown if crowded else np.zeros(n, np.bool_),
        mark_px=mark_px(int(shown.sum())),
        positioned=states["id_hash"][positioned].astype(np.uint64),
        thinned=len(positioned) < len(sensing),
    )


def mark_px(count: int) -> float:
    """Radius of the dots of `count` road users, pixels: 3.5 for ten, 1.4 for ten thousand."""
    return float(np.clip(4.2 - 0.7 * np.log10(max(count, 1)), 1.4, 3.5))


def _inside(states: NDArray[np.void], region: Region) -> NDArray[np.bool_]:
    x_min, y_min, x_max, y_max = region
    x_m, y_m = states["x_m"], states["y_m"]
    inside: NDArray[np.bool_] = (x_m >= x_min) & (x_m <= x_max) & (y_m >= y_min) & (y_m <= y_max)
    return inside


def _of_interest(states: NDArray[np.void], centre: np.void | None, shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Heroes, and what is near the followed vehicle."""
    heroes: NDArray[np.bool_] = states["kind"] == wire.HERO
    if centre is None:
        return heroes & shown
    near: NDArray[np.bool_] = _distance_m(states, centre) < INTEREST_M
    return (heroes | near) & shown


def _nearest(states: NDArray[np.void], centre: np.void | None, rank: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Rows of the `count` road users nearest to the centre; without one, the first by `rank`."""
    if centre is None:
        return rank[:count]
    return np.argpartition(_distance_m(states, centre), count)[:count]


def _distance_m(states: NDArray[np.void], centre: np.void) -> NDArray[np.float64]:
    distance_m: NDArray[np.float64] = np.hypot(states["x_m"] - centre["x_m"], states["y_m"] - centre["y_m"])
    return distance_m
