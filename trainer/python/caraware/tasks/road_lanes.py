"""The lanes of a net, and where on them a place lies: offset from the middle, lane from the right."""

import gzip
import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import torch
from torch import Tensor

OTHER_WAY_RAD = math.radians(60.0)
"""A lane that leads this far away from a heading is not driven on with that heading."""
METRES_PER_RAD = 3.0
"""What a difference in heading counts, where lanes overlap (junctions)."""
FAR_M = 1e6
PLACES_AT_ONCE = 4096


@dataclass(frozen=True)
class LanePlaces:
    """Places on the lanes of a net, `[n]` each."""

    lateral_m: Tensor
    """f32: offset from the middle of the lane, positive to the left of its direction."""
    index: Tensor
    """f32: lanes of the same road to the right of it that cars may use."""


class RoadLanes:
    """The lanes that cars may use, junctions included, cut into straight pieces."""

    def __init__(self, pieces: Tensor, lanes: int) -> None:
        """`pieces`: f64 `[s, 5]`: start x, y (m, world), heading (rad), length (m), index. `lanes`: most of a road."""
        self.lanes = lanes
        self._x, self._y, heading, self._length, index = pieces.T
        self._heading, self._index = heading, index.float()
        self._cos, self._sin = heading.cos(), heading.sin()

    def locate(self, x_m: Tensor, y_m: Tensor, heading_rad: Tensor) -> LanePlaces:
        """The places of `[n]` positions (m, world) with headings (rad): on the nearest lane that leads there."""
        parts = zip(*(column.double().cpu().split(PLACES_AT_ONCE) for column in (x_m, y_m, heading_rad)), strict=True)
        lateral_m, index = zip(*(self._locate(*part) for part in parts), strict=True)
        return LanePlaces(torch.cat(lateral_m).to(x_m.device), torch.cat(index).to(x_m.device))

    def _locate(self, x_m: Tensor, y_m: Tensor, heading_rad: Tensor) -> tuple[Tensor, Tensor]:
        east, north = x_m[:, None] - self._x, y_m[:, None] - self._y
        along = east * self._cos + north * self._sin
        left = north * self._cos - east * self._sin
        beyond = along - along.clamp(min=0.0).minimum(self._length)
        turned = ((self._heading - heading_rad[:, None] + math.pi).remainder(2 * math.pi) - math.pi).abs()
        cost = torch.hypot(left, beyond) + METRES_PER_RAD * turned
        piece = torch.where(turned < OTHER_WAY_RAD, cost, FAR_M + cost).argmin(1)
        return left.gather(1, piece[:, None]).squeeze(1).float(), self._index[piece]


@lru_cache(maxsize=1)
def road_lanes(net_file: Path, world_origin_m: tuple[float, float] = (0.0, 0.0)) -> RoadLanes:
    """The lanes of a net in the world frame, whose (0, 0) lies at `world_origin_m` of the net.

    Raises `OSError` or `xml.etree.ElementTree.ParseError` for a file that is no net, `ValueError` without a lane.
    """
    rows: list[tuple[float, ...]] = []
    most = 0
    with gzip.open(net_file) if net_file.suffix == ".gz" else net_file.open("rb") as stream:
        for _, element in ElementTree.iterparse(stream):
            if element.tag != "edge":
                continue
            lanes = [lane for lane in element.iter("lane") if _for_cars(lane)]
            lanes.sort(key=lambda lane: int(lane.get("index", "0")))
            most = max(most, len(lanes))
            for number, lane in enumerate(lanes):
                rows += [(*piece, float(number)) for piece in _cut(lane)]
            element.clear()
    if not rows:
        raise ValueError(f"{net_file} has no lane for cars")
    pieces = torch.tensor(rows, dtype=torch.float64)
    pieces[:, :2] -= torch.tensor(world_origin_m, dtype=torch.float64)
    return RoadLanes(pieces, most)


def _for_cars(lane: ElementTree.Element) -> bool:
    allowed, denied = lane.get("allow"), (lane.get("disallow") or "").split()
    return "passenger" in allowed.split() if allowed else "passenger" not in denied and "all" not in denied


def _cut(lane: ElementTree.Element) -> list[tuple[float, float, float, float]]:
    points = [tuple(float(v) for v in point.split(",")[:2]) for point in lane.get("shape", "").split()]
    pieces = []
    for (x, y), (next_x, next_y) in pairwise(points):
        length = math.hypot(next_x - x, next_y - y)
        if length > 0.0:
            pieces.append((x, y, math.atan2(next_y - y, next_x - x), length))
    return pieces
