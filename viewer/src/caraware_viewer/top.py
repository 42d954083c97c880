"""The top view: road users, and their positions by sensors and estimators. World metres, north up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import geometry, wire
from caraware_viewer.canvas import Canvas, on_screen
from caraware_viewer.detail import Detail

OUTLINES = "top/vehicles"
BODIES = "top/vehicles/bodies"
MARKS = "top/vehicles/marks"
BLINKERS = "top/vehicles/blinkers"
BRAKES = "top/vehicles/brakes"
NAMES = "top/vehicles/names"
FOLLOWED = "top/followed"
GNSS = "top/gnss"
PREDICTIONS = "top/predictions"
ESTIMATES = "top/ekf"
SIGNALS = "top/signals"
ROUTES = "top/routes"
ROUTE_SIGNALS = "top/routes/signals"
CONTACTS = "top/contacts"
CLOUD = "top/lidar"
RING = "top/lidar/range"

KIND_COLORS = np.array([0x3FA7FFFF, 0xB8BDC7FF, 0xF2C14EFF, 0xFF4FD8FF], dtype=np.uint32)
"""RGBA by `VehicleState.kind`: connected vehicle, other vehicle, pedestrian, hero."""
BODY_ALPHA = 0x80
ROUTE_COLOR = [255, 79, 216]
OTHER_ROUTE_ALPHA = 90
GNSS_COLOR, PREDICTION_COLOR, ESTIMATE_COLOR = [235, 94, 85], [94, 214, 125], [196, 132, 255]
LINK_ALPHA = 120
BLINKER_COLOR, BRAKE_COLOR, RING_COLOR, CONTACT_COLOR = [255, 170, 0], [255, 30, 30], [120, 200, 255], [255, 0, 90]
SIGNAL_COLORS = {"r": 0xF03C32FF, "u": 0xF0783CFF, "y": 0xF5D23CFF, "g": 0x32C85AFF, "G": 0x32C85AFF, "o": 0xF5A03CFF}
"""RGBA by SUMO's letter; the lights of all other letters are off."""
SIGNAL_OFF = 0x707070FF

MAX_NAMED = 12
"""Most connected vehicles with names beside them. Of more, only the followed ones are named: names hide the map."""


def draw_road_users(
    canvas: Canvas, states: NDArray[np.void], detail: Detail, names: dict[int, str], followed: Sequence[int] = ()
) -> None:
    """Draws boxes with an arrow that points forward, blinkers, brake lights, names, and in a crowd dots."""
    marked = states[detail.marked]
    mark_colors = KIND_COLORS[geometry.kinds(marked)]
    canvas.points(MARKS, np.column_stack([marked["x_m"], marked["y_m"]]), mark_colors, detail.mark_px, 19.0)
    states = states[detail.shaped]
    colors = KIND_COLORS[geometry.kinds(states)]
    outlines = on_screen(geometry.outlines_m(states))
    canvas.log(OUTLINES, rr.LineStrips2D(outlines, colors=colors, radii=rr.Radius.ui_points(0.8), draw_order=21.0))
    bodies, filled = on_screen(geometry.bodies_m(states)), colors & 0xFFFFFF00 | BODY_ALPHA
    radii = geometry.body_radii_m(states)
    canvas.log(BODIES, rr.LineStrips2D(bodies, colors=filled, radii=radii, draw_order=20.0))
    canvas.points(BLINKERS, geometry.blinkers_m(states), BLINKER_COLOR, 2.0, 23.0)
    canvas.points(BRAKES, geometry.brake_lights_m(states), BRAKE_COLOR, 1.6, 22.0)
    connected = states[(states["kind"] == wire.CAV) | (states["kind"] == wire.HERO)]
    if len(connected) > MAX_NAMED:
        connected = states[np.isin(states["id_hash"], np.array(followed, np.uint64))]
    _draw_names(canvas, connected, names)


def _draw_names(canvas: Canvas, states: NDArray[np.void], names: dict[int, str]) -> None:
    states = states[[int(id_hash) in names for id_hash in states["id_hash"]]]
    known = [names[int(id_hash)] for id_hash in states["id_hash"]]
    positions = on_screen(geometry.centres_m(states)[:, :2])
    radii = rr.Radius.ui_points(0.0)
    labels = rr.Points2D(
        positions, labels=known, show_labels=True, radii=radii, colors=[210, 214, 220], draw_order=24.0
    )
    canvas.log(NAMES, labels)


def draw_followed(canvas: Canvas, states: Sequence[np.void]) -> None:
    """Draws a ring around each followed vehicle."""
    rings = [on_screen(geometry.ring_m([row["x_m"], row["y_m"]], 0.9 * float(row["length_m"]))) for row in states]
    color = [255, 255, 255]
    canvas.log(FOLLOWED, rr.LineStrips2D(rings, colors=color, radii=rr.Radius.ui_points(1.0), draw_order=24.0))


def draw_positions(
    canvas: Canvas,
    path: str,
    points_m: NDArray[np.floating],
    truth_m: NDArray[np.floating],
    color: list[int],
    order: float,
) -> None:
    """Draws measured or estimated positions, each with a line to its vehicle."""
    canvas.filled(path, len(points_m))
    canvas.points(path, points_m, color, 2.5, order)
    links = on_screen(geometry.links_m(points_m, truth_m))
    line = rr.LineStrips2D(links, colors=[*color, LINK_ALPHA], radii=rr.Radius.ui_points(0.6), draw_order=order - 0.5)
    canvas.log(path + "/links", line)


def draw_observation(canvas: Canvas, observation: wire.Observation, shown: NDArray[np.bool_]) -> None:
    """Draws the raw GNSS fixes of the slots `shown [n]`."""
    valid = observation.valid & shown
    draw_positions(canvas, GNSS, observation.gnss_m[valid, :2], observation.truth[valid, :2], GNSS_COLOR, 26.0)


def draw_estimates(
    canvas: Canvas,
    path: str,
    observation: wire.Observation,
    points_m: NDArray[np.float32],
    shown: NDArray[np.bool_],
) -> None:
    """Draws the positions of a policy or filter in the slots `shown [n]`, where it gives any."""
    n = min(len(points_m), observation.header.rows)
    chosen = (observation.valid & shown)[:n] & np.isfinite(points_m[:n]).all(axis=1)
    color, order = {PREDICTIONS: (PREDICTION_COLOR, 28.0), ESTIMATES: (ESTIMATE_COLOR, 30.0)}[path]
    draw_positions(canvas, path, points_m[:n][chosen], observation.truth[:n, :2][chosen], color, order)


def draw_signals(canvas: Canvas, lights: Sequence[tuple[Sequence[float], str]]) -> None:
    """Draws a dot at the stop line of each link, in the colour of its letter."""
    points = on_screen(np.array([position[:2] for position, _ in lights], np.float64).reshape(-1, 2))
    canvas.log(
        SIGNALS, rr.Points2D(points, colors=light_colors(lights), radii=rr.Radius.ui_points(3.0), draw_order=15.0)
    )


def draw_routes(
    canvas: Canvas, routes_m: Sequence[NDArray[np.float64]], lights: Sequence[tuple[Sequence[float], str]]
) -> None:
    """Draws the routes of heroes, that of the followed one first and wider, and larger dots at their traffic lights."""
    strips = [on_screen(route) for route in routes_m]
    colors, widths = route_colors(len(strips)), [2.2, *[0.8] * len(strips)][: len(strips)]
    radii = rr.Radius.ui_points(widths)
    canvas.log(ROUTES, rr.LineStrips2D(strips, colors=colors, radii=radii, draw_order=14.0))
    points = np.array([position[:2] for position, _ in lights], np.float64).reshape(-1, 2)
    canvas.points(ROUTE_SIGNALS, points, light_colors(lights), 5.5, 14.5)


def rgba(color: Sequence[int]) -> int:
    """An RGB colour as one number, opaque."""
    red, green, blue = color
    return red << 24 | green << 16 | blue << 8 | 0xFF


def route_colors(count: int) -> NDArray[np.uint8]:
    """RGBA `[count, 4]` of routes: the first one is bright."""
    alpha = [OTHER_ROUTE_ALPHA] * count
    alpha[:1] = [0xFF] * min(count, 1)
    return np.array([[*ROUTE_COLOR, value] for value in alpha], np.uint8).reshape(-1, 4)


def light_colors(lights: Sequence[tuple[Sequence[float], str]]) -> NDArray[np.uint32]:
    """RGBA of traffic lights, positions with SUMO's letters."""
    return np.array([SIGNAL_COLORS.get(letter, SIGNAL_OFF) for _, letter in lights], np.uint32)


def draw_contacts(canvas: Canvas, positions_m: NDArray[np.floating]) -> None:
    """Draws the recent contacts."""
    canvas.points(CONTACTS, positions_m, CONTACT_COLOR, 6.0, 31.0)


def draw_clouds(
    canvas: Canvas, points_m: NDArray[np.floating], colors: NDArray[np.uint32], rings_m: list[NDArray[np.float32]]
) -> None:
    """Draws LIDAR points from above, and rings of the ranges."""
    cloud = rr.Points2D(on_screen(points_m[:, :2]), colors=colors, radii=rr.Radius.ui_points(0.8), draw_order=18.0)
    canvas.log(CLOUD, cloud)
    rings = [on_screen(ring) for ring in rings_m]
    canvas.log(RING, rr.LineStrips2D(rings, colors=RING_COLOR, radii=rr.Radius.ui_points(0.7), draw_order=17.0))
