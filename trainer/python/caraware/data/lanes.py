"""Lane, edge and route position of recorded vehicles in SUMO's terms, beside the observations."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from caraware.data.recording import Recording
from caraware.ipc.arrays import BoolArray, Int64Array
from caraware.ipc.lane_positions import LANE_IDS, NO_INDEX, LaneIds

CHANNEL = "lane-position"
"""The channel, which a run has with `traffic.lane_positions`."""

Columns = dict[str, Any]


def has_lanes(recording: Recording) -> bool:
    """True if the recording says where vehicles are in SUMO's terms."""
    return CHANNEL in recording.channels and len(recording.headers(CHANNEL)) > 0


def lane_columns(recording: Recording, ticks: Int64Array, vehicles: Int64Array) -> Columns:
    """SUMO's time, lane, edge and place on the route for vehicle `vehicles[i]` at tick `ticks[i]`: columns [n].

    They belong to the mirrored vehicle of the same tick. Empty (None, not-a-number or -1) where SUMO has none.
    A tick within a step of SUMO has those of the step's end; `sumo_time_s` (s) is the time of the step.
    """
    headers = recording.headers(CHANNEL)
    sent = headers["tick"].astype(np.int64)
    message = np.minimum(np.searchsorted(sent, ticks), len(sent) - 1)
    rows, found = _rows(recording, message, vehicles)
    found &= sent[message] >= ticks
    lane, edge = rows["lane"], rows["edge"]
    lane_ids, edge_ids = _ids(recording, headers["map"][message], lane, edge, found)
    return {
        "sumo_time_s": np.where(found, recording.rows(CHANNEL, "sumo_time_s")[message], np.nan),
        "sumo_lane": lane_ids,
        "sumo_edge": edge_ids,
        "sumo_lane_index": _index(lane, found),
        "sumo_edge_index": _index(edge, found),
        "sumo_lane_position_m": np.where(found, rows["lane_position_m"], np.nan),
        "sumo_route_edge": _index(rows["route_edge"], found),
        "sumo_odometer_m": np.where(found, rows["odometer_m"], np.nan),
    }


def _rows(recording: Recording, message: Int64Array, vehicles: Int64Array) -> tuple[Any, BoolArray]:
    """The record of each vehicle in its message, and whether there is one."""
    positions, offsets = recording.rows(CHANNEL, "positions"), recording.offsets(CHANNEL, "positions")
    if len(positions) == 0:
        return np.zeros(len(vehicles), positions.dtype), np.zeros(len(vehicles), bool)
    # Messages are in order, and within each of them vehicles are.
    of_message = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    keys = of_message << 32 | positions["vehicle"].astype(np.int64)
    wanted = message << 32 | vehicles.astype(np.int64)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return positions[place], keys[place] == wanted


def _index(values: Any, found: BoolArray) -> Int64Array:
    """Indices, with -1 for none."""
    indices: Int64Array = np.where(found & (values != NO_INDEX), values, -1).astype(np.int64)
    return indices


def _ids(recording: Recording, maps: Any, lane: Any, edge: Any, found: BoolArray) -> tuple[list[Any], list[Any]]:
    """Ids of lanes and edges; None where there is none, or where the recording is without its run's directory."""
    lanes: list[Any] = [None] * len(lane)
    edges: list[Any] = [None] * len(edge)
    try:
        names = list(json.loads((recording.path.parent / LANE_IDS).read_text(encoding="utf-8")))
    except OSError:
        return lanes, edges
    tables = {name: LaneIds.read(recording.path.parent, name) for name in names}
    of_run = [str(row["name"]) for row in recording.run.get("maps", [])]
    for row in np.flatnonzero(found):
        table = tables[of_run[int(maps[row])] if len(names) > 1 else names[0]]
        lanes[row], edges[row] = table.lane(int(lane[row])), table.edge(int(edge[row]))
    return lanes, edges
