"""The map that an estimator carries: the lanes of the net, and from anywhere the way to the next of them.

A map is what navigation systems have; it says nothing of where a vehicle is. Lanes are cut into straight pieces, and a
raster over place and heading remembers which piece is nearest, so that a look-up costs the same in any town.
"""

import gzip
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from caraware.ipc.arrays import Float32Array

HEADING_BINS = 24
"""Of 15 degrees each."""
CELL_M = 1.0
REACH_M = 15.0
"""Lanes further away are not found."""
MOST_CELLS = 4_000_000
"""Of one heading; larger maps get larger cells."""
OTHER_HEADING_RAD = math.radians(75.0)
"""A lane that leads this far away from a vehicle's heading is not the one it drives on."""
NOWHERE = -1
GIVES_WAY = ("m", "=", "s", "w")
"""SUMO's states of a way that must give way: minor, right before left, stop, all-way stop."""


@dataclass(frozen=True)
class Pieces:
    """Straight pieces of lanes; f32 `[s]` each, headings in rad counter-clockwise from east."""

    x_m: Tensor
    """Start, in world metres."""
    y_m: Tensor
    heading_rad: Tensor
    length_m: Tensor
    left_m: Tensor
    """From the piece's start to the end of its lane; a junction's lanes end where the junction does."""
    speed_limit_mps: Tensor
    begun_m: Tensor
    """From the start of its lane to the piece's start."""
    slowest_way_mps: Tensor
    """Speed limit of the slowest way on from the lane's end across the junction; within a junction, the lane's own."""
    fastest_way_mps: Tensor
    inside: Tensor
    """1 for a lane within a junction."""
    signals: Tensor
    """1 where signals stand at the lane's end."""
    gives_way: Tensor
    """Share of the ways on that must give way to others."""
    waits: Tensor
    """1 for a lane within a junction at whose end vehicles wait for others, halfway across."""

    def __len__(self) -> int:
        return len(self.x_m)

    @classmethod
    def none(cls) -> "Pieces":
        """No lanes."""
        return cls(*torch.zeros(len(fields(cls)), 0))


def read_pieces(net_file: Path, world_origin_m: Sequence[float] = (0.0, 0.0)) -> Pieces:
    """All lanes that cars may use, in the world frame, whose (0, 0) lies at `world_origin_m` of the net.

    Raises `OSError` or `xml.etree.ElementTree.ParseError` for a file that is no net.
    """
    lanes: dict[str, list[tuple[float, ...]]] = {}
    ways: dict[str, list[dict[str, str]]] = {}
    with gzip.open(net_file) if net_file.suffix == ".gz" else net_file.open("rb") as stream:
        for _, element in ElementTree.iterparse(stream):
            if element.tag == "lane" and _for_cars(element):
                lanes[element.get("id", f"lane {len(lanes)}")] = _cut(element)
            elif element.tag == "connection":
                ways.setdefault(f"{element.get('from')}_{element.get('fromLane')}", []).append(dict(element.attrib))
            elif element.tag == "edge":
                element.clear()
    limits_mps = {lane: pieces[0][LIMIT] for lane, pieces in lanes.items() if pieces}
    rows = [(*piece, *_end(lane, ways.get(lane, []), limits_mps)) for lane, cut in lanes.items() for piece in cut]
    columns = torch.tensor(rows, dtype=torch.float64).reshape(-1, len(fields(Pieces))).T
    columns[0] -= world_origin_m[0]
    columns[1] -= world_origin_m[1]
    columns = columns.to(torch.float32)
    return Pieces(*columns.contiguous())


def _for_cars(lane: ElementTree.Element) -> bool:
    allowed, denied = lane.get("allow"), (lane.get("disallow") or "").split()
    return "passenger" in allowed.split() if allowed else "passenger" not in denied and "all" not in denied


LIMIT = 5
"""Index of the speed limit in what `_cut` returns."""


def _cut(lane: ElementTree.Element) -> list[tuple[float, ...]]:
    """What is known of each piece from its lane alone: the first seven columns of `Pieces`."""
    points = np.array([[float(v) for v in point.split(",")[:2]] for point in lane.get("shape", "").split()])
    ways = np.diff(points, axis=0) if len(points) > 1 else np.zeros((0, 2))
    lengths = np.hypot(*ways.T)
    lefts = np.cumsum(lengths[::-1])[::-1]
    limit = float(lane.get("speed", "13.9"))
    return [
        (*start, math.atan2(way[1], way[0]), length, left, limit, lefts[0] - left)
        for start, way, length, left in zip(points[:-1].tolist(), ways.tolist(), lengths, lefts, strict=True)
        if length > 0
    ]


def _end(lane: str, ways: Sequence[dict[str, str]], limits_mps: dict[str, float]) -> tuple[float, ...]:
    """What is known of the end of a lane: the other columns of `Pieces`.

    SUMO's ids of lanes within a junction begin with a colon. `via` is the lane on which a way crosses the junction.
    """
    inside = lane.startswith(":")
    crossing = [limits_mps[way["via"]] for way in ways if way.get("via") in limits_mps]
    speeds_mps = crossing or [limits_mps.get(lane, 0.0)]
    # Cars that may go on; a way within a junction states its right of way at the junction's edge.
    ends = [way for way in ways if way.get("via") in limits_mps] if not inside else []
    giving = [way for way in ends if way.get("state") in GIVES_WAY]
    return (
        min(speeds_mps),
        max(speeds_mps),
        float(inside),
        float(any("tl" in way for way in ends)),
        len(giving) / max(len(ends), 1),
        float(inside and bool(crossing)),
    )


ENDS = 6
"""Columns that describe the end of a lane."""


@dataclass(frozen=True)
class Match:
    """The nearest place on a lane, seen from some places with headings; f32 `[questions, n]` each."""

    ahead_m: Tensor
    """The way there, along the heading asked for."""
    left_m: Tensor
    """The way there, across it."""
    turned_rad: Tensor
    """The lane's heading less the one asked for."""
    to_end_m: Tensor
    """Left of the lane."""
    from_start_m: Tensor
    """Since the lane's start."""
    speed_limit_mps: Tensor
    end: Tensor
    """Of the lane's end, `[questions, n, ENDS]`: the columns of `Pieces` from `slowest_way_mps` on."""
    found: Tensor
    """1, or 0 where no lane is near; then all others are 0."""


class LaneMap:
    """Finds the lane piece for places with headings, by distance and some metres for a difference in heading.

    `metres_per_rad` has one such weight for each question (first dimension of what `match` is asked).
    """

    def __init__(
        self, pieces: Pieces, metres_per_rad: Sequence[float], other_heading_rad: float = OTHER_HEADING_RAD
    ) -> None:
        """`other_heading_rad`: a lane that leads this far away from the heading is not found."""
        self._other_heading_rad = other_heading_rad
        self._pieces = pieces if len(pieces) else Pieces(*torch.zeros(len(fields(Pieces)), 1))
        self._table = torch.stack(list(vars(self._pieces).values()), -1)
        low, high = _corners(self._pieces)
        width, height = (high - low).tolist()
        self._cell_m = max(CELL_M, math.sqrt(width * height / MOST_CELLS))
        self._origin = (float(low[0]), float(low[1]))
        self._shape = (math.ceil(height / self._cell_m) + 1, math.ceil(width / self._cell_m) + 1)
        rasters = {weight: self._raster(weight, len(pieces)) for weight in metres_per_rad}
        self._nearest = torch.cat(list(rasters.values()))
        starts = [list(rasters).index(weight) * HEADING_BINS for weight in metres_per_rad]
        self._first_row = torch.tensor(starts)[:, None]

    def _raster(self, metres_per_rad: float, count: int) -> Tensor:
        """i64 `[headings * rows * columns]`: the piece with the least cost at the middle of each cell."""
        cost = np.full((HEADING_BINS, *self._shape), np.inf, np.float32)
        nearest = np.full(cost.shape, NOWHERE, np.int32)
        headings = (np.arange(HEADING_BINS) + 0.5) * (2 * math.pi / HEADING_BINS)
        p = self._pieces
        table = torch.stack((p.x_m, p.y_m, p.heading_rad, p.length_m)).T.double().numpy()
        for piece, (x, y, heading, length) in enumerate(table[:count]):
            window, square = self._squares(x, y, heading, length)
            turned = np.abs((heading - headings + math.pi) % (2 * math.pi) - math.pi)
            for i in np.flatnonzero(turned < self._other_heading_rad):
                here = square + np.float32((metres_per_rad * turned[i]) ** 2)
                better = (square < REACH_M**2) & (here < cost[i][window])
                np.copyto(cost[i][window], here, where=better)
                np.copyto(nearest[i][window], piece, where=better)
        return torch.from_numpy(nearest.reshape(-1)).long()

    def _squares(self, x: float, y: float, heading: float, length: float) -> tuple[tuple[slice, slice], Float32Array]:
        """Rows and columns within reach of a piece, and their squared distances to it (m²)."""
        cos, sin = math.cos(heading), math.sin(heading)

        def span(ends: tuple[float, float], origin: float, size: int) -> slice:
            first = int((min(ends) - REACH_M - origin) // self._cell_m)
            return slice(max(first, 0), min(int((max(ends) + REACH_M - origin) // self._cell_m) + 1, size))

        rows = span((y, y + length * sin), self._origin[1], self._shape[0])
        columns = span((x, x + length * cos), self._origin[0], self._shape[1])
        across = self._origin[0] + (np.arange(columns.start, columns.stop) + 0.5) * self._cell_m - x
        up = (self._origin[1] + (np.arange(rows.start, rows.stop) + 0.5) * self._cell_m - y)[:, None]
        along = np.clip(across * cos + up * sin, 0.0, length)
        square = (across - along * cos) ** 2 + (up - along * sin) ** 2
        return (rows, columns), square.astype(np.float32)

    def match(self, x_m: Tensor, y_m: Tensor, heading_rad: Tensor) -> Match:
        """The nearest lane from each place; f32 `[questions, n]` each, in world metres and rad."""
        rows, columns = self._shape
        row = ((y_m - self._origin[1]) / self._cell_m).floor().long()
        column = ((x_m - self._origin[0]) / self._cell_m).floor().long()
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        heading_bin = (heading_rad.remainder(2 * math.pi) * (HEADING_BINS / (2 * math.pi))).long()
        heading_bin = heading_bin.clamp_(0, HEADING_BINS - 1) + self._first_row
        cell = (heading_bin * rows + row.clamp_(0, rows - 1)) * columns + column.clamp_(0, columns - 1)
        piece = torch.where(inside, self._nearest[cell], NOWHERE)
        found = (piece >= 0).to(x_m.dtype)
        piece.clamp_min_(0)
        x0_m, y0_m, lane_rad, length_m, left_m, limit_mps, begun_m, *_ = (row := self._table[piece]).unbind(-1)
        cos, sin = lane_rad.cos(), lane_rad.sin()
        dx, dy = x_m - x0_m, y_m - y0_m
        along = torch.minimum((dx * cos + dy * sin).clamp_min_(0), length_m)
        dx, dy = along * cos - dx, along * sin - dy
        cos, sin = heading_rad.cos(), heading_rad.sin()
        turned = (lane_rad - heading_rad + math.pi).remainder(2 * math.pi) - math.pi
        return Match(
            found * (dx * cos + dy * sin),
            found * (dy * cos - dx * sin),
            found * turned,
            found * (left_m - along),
            found * (begun_m + along),
            found * limit_mps,
            found[..., None] * row[..., -ENDS:],
            found,
        )


def _corners(p: Pieces) -> tuple[Tensor, Tensor]:
    """The box of all lanes and what is within reach of them: low and high x, y."""
    starts = torch.stack((p.x_m, p.y_m))
    ends = starts + p.length_m * torch.stack((p.heading_rad.cos(), p.heading_rad.sin()))
    both = torch.cat((starts, ends), 1)
    return both.amin(1) - REACH_M, both.amax(1) + REACH_M
