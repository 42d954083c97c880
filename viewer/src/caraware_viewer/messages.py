"""What road users know from messages: the map of the followed vehicle, its links, and which stations have just sent."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import geometry, wire
from caraware_viewer.canvas import Canvas, on_screen

KNOWN = "top/messages/known"
DEVIATIONS = "top/messages/deviations"
LINKS = "top/messages/links"
SENDERS = "top/messages/senders"
KNOWN_IN_SPACE = "space/world/known"

SOURCES = ("none", "CAM", "CPM", "VAM", "BSM", "own sensors")
"""Names of the messages that an object is known from, by `NeighbourSource`."""
SOURCE_COLORS = np.array([0, 0x35D0BAFF, 0xF28C28FF, 0xF7E463FF, 0x9BE564FF, 0xE0E4EAFF], np.uint32)
"""RGBA by `NeighbourSource`."""
LINK_COLOR = 0x8FD3FF00
"""RGB of a link; its opacity says how fresh what came over it is."""
SENDER_COLOR = [143, 211, 255]

_FRESH_S = 1.0
"""Age at which a link is as faint as it gets."""
_LEAST_SIZE_M = 0.5
"""Size of an object whose message has none."""
_HEIGHT_M = 1.5
_DEVIATIONS_95 = 2.45
"""Standard deviations on each axis within which 95 % of positions in the plane lie."""
_EMPTY = np.empty((0, 2), np.float32)


def station_of(id_hash: NDArray[np.uint64]) -> NDArray[np.uint32]:
    """Station id `[n]` of road users with these hashes of their ids, as `v2x` gives it."""
    station: NDArray[np.uint32] = np.maximum(id_hash.astype(np.uint64) & np.uint64(0xFFFF_FFFF), 1).astype(np.uint32)
    return station


def draw_messages(
    canvas: Canvas, neighbours: wire.Neighbours, states: NDArray[np.void], followed: np.void | None
) -> None:
    """Draws the map of the followed vehicle, its links, and the senders among the road users `states [n]`."""
    slot = None if followed is None else neighbours.slot_of(int(followed["vehicle"]))
    objects, ids = neighbours.known_in(slot)
    _draw_known(canvas, objects, ids, 0.0 if followed is None else float(followed["z_m"]))
    _draw_links(canvas, objects, ids, states, followed)
    senders = neighbours.vehicle[neighbours.sent > 0]
    sending = states[np.isin(states["vehicle"], senders)]
    rings = [on_screen(geometry.ring_m(at, 4.0)) for at in geometry.centres_m(sending)[:, :2]]
    line = rr.LineStrips2D(rings, colors=SENDER_COLOR, radii=rr.Radius.ui_points(1.2), draw_order=25.0)
    canvas.log(SENDERS, line)


def _draw_known(canvas: Canvas, objects: NDArray[np.float32], ids: NDArray[np.uint32], height_m: float) -> None:
    """Draws boxes where the known objects are by now, and the circles that hold 95 % of what their errors allow."""
    colors = SOURCE_COLORS[np.minimum(ids[:, 2], len(SOURCES) - 1)]
    centres_m = now_m(objects)
    sizes_m = np.maximum(objects[:, 5:7], _LEAST_SIZE_M)
    outlines = on_screen(geometry.boxes_m(centres_m, objects[:, 4], sizes_m))
    canvas.log(KNOWN, rr.LineStrips2D(outlines, colors=colors, radii=rr.Radius.ui_points(1.4), draw_order=25.5))
    circles = [
        on_screen(geometry.ring_m(at, _DEVIATIONS_95 * float(deviation_m)))
        for at, deviation_m in zip(centres_m, objects[:, 8], strict=True)
    ]
    faint = colors & 0xFFFFFF00 | 0x60
    canvas.log(DEVIATIONS, rr.LineStrips2D(circles, colors=faint, radii=rr.Radius.ui_points(0.6), draw_order=24.5))
    boxes = rr.Boxes3D(
        centers=np.column_stack([centres_m, np.full(len(objects), height_m + _HEIGHT_M / 2)]),
        half_sizes=np.column_stack([sizes_m, np.full(len(objects), _HEIGHT_M)]) / 2,
        quaternions=geometry.quaternions(objects[:, 4]),
        colors=colors,
        radii=rr.Radius.ui_points(1.4),
    )
    canvas.log(KNOWN_IN_SPACE, boxes)


def now_m(objects: NDArray[np.float32]) -> NDArray[np.float32]:
    """Positions `[n, 2]` of objects `[n, 11]` at the tick: moved on by their velocities since they were measured."""
    positions: NDArray[np.float32] = objects[:, :2] + objects[:, 2:4] * objects[:, 7:8]
    return positions


def _draw_links(
    canvas: Canvas,
    objects: NDArray[np.float32],
    ids: NDArray[np.uint32],
    states: NDArray[np.void],
    followed: np.void | None,
) -> None:
    """Draws a line to each station that the vehicle knows something from: the fresher, the brighter."""
    start = np.array([] if followed is None else [followed], states.dtype)
    own, heard_from, ages_s = station_of(start["id_hash"]), ids[:, 1], objects[:, 7]
    states = states[states["kind"] != wire.TRAILING]
    places_m = dict(zip(station_of(states["id_hash"]).tolist(), geometry.centres_m(states)[:, :2], strict=True))
    # A station that is no road user, such as a roadside unit, is where it says that it is.
    itself = ids[:, 0] == heard_from
    said_m = now_m(objects[itself])
    places_m = dict(zip(heard_from[itself].tolist(), said_m, strict=True)) | places_m
    ends, colors = [], []
    for station in np.unique(heard_from):
        if station not in own and int(station) in places_m:
            age_s = float(ages_s[heard_from == station].min())
            ends.append(places_m[int(station)])
            colors.append(LINK_COLOR | int(0xFF - 0xC0 * min(max(age_s, 0.0) / _FRESH_S, 1.0)))
    points = np.array(ends, np.float32) if ends else _EMPTY
    here = np.broadcast_to(geometry.centres_m(start)[:, :2], points.shape) if ends else _EMPTY
    links = on_screen(geometry.links_m(points, here))
    line = rr.LineStrips2D(links, colors=np.array(colors, np.uint32), radii=rr.Radius.ui_points(0.9), draw_order=19.5)
    canvas.log(LINKS, line)
