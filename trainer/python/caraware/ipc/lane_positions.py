"""Where SUMO has each road user in its own terms, and SUMO's absolute time."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from caraware import _native
from caraware.ipc.layout import record

LANE_POSITION = record("LanePosition")
"""`LanePosition`: position on the lane (m), metres since departure, indices of lane and edge, number of the edge in
the route, and of a person the vehicle in which it rides."""

NO_INDEX = 0xFFFF_FFFF
"""`lane`, `edge`, `route_edge` or `carrier` where there is none."""

LANE_IDS = "lanes.json"
"""File in the directory of a run or environment: ids of lanes and edges by their indices, for each map."""


@dataclass(frozen=True)
class LanePositions:
    """All road users at a tick in SUMO's terms; a copy, valid for ever.

    The positions are those that the mirrored road users of the same tick follow: `vehicle.preview_s` behind SUMO.
    """

    tick: int
    sim_time_ns: int
    sumo_time_s: float
    """SUMO's absolute time of these positions (s), as `traci.simulation.getTime()` gives it after the step."""
    positions: NDArray[np.void]
    """`LANE_POSITION [count]`, read-only, by ascending `vehicle`. `id_hash` is that of the observation."""

    @classmethod
    def of(cls, native: _native.SightMessage) -> LanePositions:
        """From a message."""
        time_bytes, position_bytes = native.sections
        return cls(
            tick=native.tick,
            sim_time_ns=native.sim_time_ns,
            sumo_time_s=float(np.frombuffer(time_bytes, "<f8")[0]),
            positions=np.frombuffer(position_bytes, LANE_POSITION),
        )


@dataclass(frozen=True)
class LaneIds:
    """SUMO's ids of the lanes and edges of a map, by their indices. The same net has the same indices in every run."""

    lanes: list[str]
    edges: list[str]
    edge_of_lane: list[int]
    """Of each lane: the index of its edge."""

    @classmethod
    def read(cls, directory: Path, map_name: str | None = None) -> LaneIds:
        """From the directory of a run or environment; `map_name` chooses among the maps of a curriculum.

        Raises `OSError` if there is no such file, and `KeyError` if it has no such map.
        """
        maps = json.loads((directory / LANE_IDS).read_text(encoding="utf-8"))
        ids = maps[map_name] if map_name is not None else next(iter(maps.values()))
        return cls(ids["lanes"], ids["edges"], ids["edge_of_lane"])

    def lane(self, index: int) -> str | None:
        """Id of a lane; None for `NO_INDEX`."""
        return None if index == NO_INDEX else self.lanes[index]

    def edge(self, index: int) -> str | None:
        """Id of an edge; None for `NO_INDEX`."""
        return None if index == NO_INDEX else self.edges[index]
