"""Paint on the roads: markings and crossings. On a large map the 3-D view has those near the followed vehicle alone."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer.canvas import Canvas
from caraware_viewer.documents import Lane

SPACE_CROSSINGS = "space/world/crossings"
SPACE_MARKINGS = "space/world/markings"
ROAD_KINDS = ("car", "bus", "bicycle", "rail")
CROSSING_COLOR, MARKING_COLOR = [150, 150, 146], [196, 198, 200]
MARKING_M, STRIPE_M = 0.12, 0.5
"""Widths of a line and of a stripe."""
NEAR_M = 200.0
"""Radius of the paint around the followed vehicle on a large map."""
_MOVED_M = 60.0
"""The paint is drawn again once the vehicle has moved so far."""
_DASH_M, _GAP_M = 3.0, 6.0

Lines = list[tuple[Lane, list[NDArray[np.float64]]]]
"""Lanes with the painted lines `[n, 2]` of each."""


def markings(lanes: Sequence[Lane], most: int) -> Lines:
    """Markings of the lanes outside junctions: of more than `most` the solid ones, and of more of these none."""
    marked = _marked(lanes)
    solid, dashes = _line_counts(marked)
    if solid + dashes <= most:
        return [(lane, markings_m(lane)) for lane in marked]
    return [(lane, markings_m(lane, ("solid",))) for lane in marked] if solid <= most else []


def crossings(lanes: Sequence[Lane], most: int) -> Lines:
    """Stripes of the crossings, if they are no more than `most`."""
    crossed = [lane for lane in lanes if lane["kind"] == "crossing"]
    return [(lane, stripes_m(lane)) for lane in crossed] if _stripe_count(crossed) <= most else []


def _marked(lanes: Sequence[Lane]) -> list[Lane]:
    return [lane for lane in lanes if lane["kind"] in ROAD_KINDS and not lane["inside"]]


def _line_counts(marked: Sequence[Lane]) -> tuple[int, int]:
    """Solid lines and dashes."""
    solid = dashes = 0
    for lane in marked:
        sides = (lane["left"], lane["right"])
        solid += sides.count("solid")
        dashes += sides.count("dashed") * int(np.ceil(_length_m(lane) / (_DASH_M + _GAP_M)))
    return solid, dashes


def _stripe_count(crossed: Sequence[Lane]) -> int:
    return sum(int(np.ceil(_length_m(lane) / (2 * STRIPE_M))) for lane in crossed)


def every_line(lanes: Sequence[Lane]) -> tuple[Lines, Lines]:
    """All markings and all crossings of lanes."""
    return markings(lanes, sys.maxsize), crossings(lanes, sys.maxsize)


def _length_m(lane: Lane) -> float:
    return float(np.linalg.norm(np.diff(np.asarray(lane["points_m"], np.float64)[:, :2], axis=0), axis=1).sum())


class RoadPaint:
    """The paint of the 3-D view."""

    def __init__(self, canvas: Canvas, lanes: Sequence[Lane], most: int) -> None:
        """Draws all of it if it is no more than `most` lines of a kind; else `follow` draws what is near a vehicle."""
        self._canvas, self._lanes = canvas, list(lanes)
        boxes = [np.asarray(lane["points_m"], np.float64)[:, :2] for lane in self._lanes]
        self._low_m = np.array([box.min(axis=0) for box in boxes]).reshape(-1, 2)
        self._high_m = np.array([box.max(axis=0) for box in boxes]).reshape(-1, 2)
        self._drawn_at_m: NDArray[np.float64] | None = None
        crossed = [lane for lane in lanes if lane["kind"] == "crossing"]
        self._is_whole = sum(_line_counts(_marked(lanes))) <= most and _stripe_count(crossed) <= most
        if self._is_whole:
            self._draw(*every_line(lanes), static=True)

    def follow(self, at_m: NDArray[np.float64]) -> None:
        """Draws what is near a vehicle at `at_m [2]`, if not all is drawn."""
        if self._is_whole or (self._drawn_at_m is not None and np.hypot(*(at_m - self._drawn_at_m)) < _MOVED_M):
            return
        self._drawn_at_m = at_m
        outside_m = np.maximum(np.maximum(self._low_m - at_m, at_m - self._high_m), 0.0)
        near = [self._lanes[index] for index in np.flatnonzero(np.hypot(*outside_m.T) < NEAR_M)]
        marked, crossed = ([(lane, _near(pieces, at_m)) for lane, pieces in lines] for lines in every_line(near))
        self._draw(marked, crossed, static=False)

    def _draw(self, marked: Lines, crossed: Lines, *, static: bool) -> None:
        for path, lines, color, width_m in (
            (SPACE_MARKINGS, marked, MARKING_COLOR, MARKING_M),
            (SPACE_CROSSINGS, crossed, CROSSING_COLOR, STRIPE_M),
        ):
            strips = [_lifted(line, lane) for lane, pieces in lines for line in pieces]
            if strips or not static:
                self._canvas.log(path, rr.LineStrips3D(strips, colors=color, radii=width_m / 2), static=static)


def _near(pieces: list[NDArray[np.float64]], at_m: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The pieces that have a part near `at_m [2]`, by their boxes."""
    outside_m = [np.maximum(np.maximum(line.min(axis=0) - at_m, at_m - line.max(axis=0)), 0.0) for line in pieces]
    return [line for line, outside in zip(pieces, outside_m, strict=True) if np.hypot(*outside) < NEAR_M]


def _lifted(line_m: NDArray[np.float64], lane: Lane) -> NDArray[np.float32]:
    """A painted line `[n, 3]`, just above its lane at the nearest point of the centre line."""
    centre_m = np.asarray(lane["points_m"], np.float64)
    distance_m = np.linalg.norm(line_m[:, None] - centre_m[None, :, :2], axis=-1)
    return np.column_stack([line_m, centre_m[distance_m.argmin(axis=1), 2] + 0.05]).astype(np.float32)


def edge_m(lane: Lane, side: int) -> NDArray[np.float64]:
    """Edge `[n, 2]` of a lane: to the left of its direction for `side` 1, to the right for -1."""
    line = np.asarray(lane["points_m"], np.float64)[:, :2]
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    edge: NDArray[np.float64] = line + side * lane["width_m"] / 2 * np.column_stack([-along[:, 1], along[:, 0]])
    return edge


def markings_m(lane: Lane, kinds: Sequence[str] = ("solid", "dashed")) -> list[NDArray[np.float64]]:
    """Painted lines of a lane's edges, of the given kinds; a dashed line is a list of pieces."""
    pieces = []
    for side, marking in ((1, lane["left"]), (-1, lane["right"])):
        if marking not in kinds:
            continue
        if marking == "solid":
            pieces.append(edge_m(lane, side))
        else:
            pieces += pieces_m(edge_m(lane, side), _DASH_M, _GAP_M)
    return pieces


def stripes_m(lane: Lane) -> list[NDArray[np.float64]]:
    """Stripes of a crossing, in the direction of the traffic that it crosses."""
    line = np.asarray(lane["points_m"], np.float64)[:, :2]
    stripes = []
    for piece in pieces_m(line, STRIPE_M, STRIPE_M):
        along = piece[-1] - piece[0]
        across = (
            np.array([-along[1], along[0]]) / max(np.linalg.norm(along), 1e-9) * (lane["width_m"] / 2 - STRIPE_M / 2)
        )
        stripes.append(piece.mean(axis=0) + np.array([across, -across]))
    return stripes


def pieces_m(line_m: NDArray[np.float64], piece_m: float, gap_m: float) -> list[NDArray[np.float64]]:
    """Pieces `[2, 2]` of a line, with gaps between them; the last piece may be shorter."""
    steps_m = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    at_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    begins = np.arange(0.0, at_m[-1], piece_m + gap_m)
    ends = np.minimum(begins + piece_m, at_m[-1])
    both = np.stack([begins, ends], axis=1)
    return list(np.stack([np.interp(both, at_m, line_m[:, axis]) for axis in range(2)], axis=-1))
