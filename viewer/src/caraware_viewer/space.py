"""The 3-D view: a transform puts the followed vehicle at the origin, so that the camera stays with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import geometry
from caraware_viewer.canvas import Canvas
from caraware_viewer.top import CONTACT_COLOR, KIND_COLORS, light_colors, route_colors

WORLD = "space/world"
VEHICLES = "space/world/vehicles"
CLOUD = "space/world/lidar"
RADAR = "space/world/radar"
SIGNALS = "space/world/signals"
ROUTES = "space/world/routes"
CONTACTS = "space/world/contacts"

_SIGNAL_M = 2.5
"""Height of the dots of traffic lights above their stop lines."""
VIEW_RADIUS_M = 120.0
"""Road users farther from the vehicle than this are left out."""


def draw_space(canvas: Canvas, states: NDArray[np.void], centre: np.void | None) -> None:
    """Draws boxes of the road users near `centre`, which stands at the origin and faces along x."""
    if centre is None:
        canvas.log(VEHICLES, rr.Boxes3D(centers=[], half_sizes=[]))
        return
    origin_m = np.array([centre["x_m"], centre["y_m"], centre["z_m"]])
    yaw_rad = float(centre["yaw_rad"])
    canvas.log(WORLD, vehicle_from_world(origin_m, yaw_rad))
    canvas.filled(VEHICLES, 1)
    near = np.hypot(states["x_m"] - origin_m[0], states["y_m"] - origin_m[1]) < VIEW_RADIUS_M
    shown = states[near]
    boxes = rr.Boxes3D(
        centers=geometry.centres_m(shown),
        half_sizes=np.column_stack([shown["length_m"], shown["width_m"], shown["height_m"]]) / 2,
        quaternions=geometry.quaternions(shown["yaw_rad"]),
        colors=KIND_COLORS[geometry.kinds(shown)],
        fill_mode="solid",
    )
    canvas.log(VEHICLES, boxes)


def vehicle_from_world(origin_m: NDArray[np.float64], yaw_rad: float) -> rr.Transform3D:
    """The transform that moves `origin_m` to zero and turns the heading `yaw_rad` to x."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    return rr.Transform3D(translation=-turn @ origin_m, mat3x3=turn)


def draw_cloud(canvas: Canvas, points_m: NDArray[np.floating], colors: NDArray[np.uint32]) -> None:
    """Draws the points of the vehicle's LIDAR."""
    canvas.log(CLOUD, rr.Points3D(points_m, colors=colors, radii=rr.Radius.ui_points(1.2)))


def draw_detections(canvas: Canvas, points_m: NDArray[np.floating], colors: NDArray[np.uint32]) -> None:
    """Draws the detections of radars."""
    canvas.log(RADAR, rr.Points3D(points_m, colors=colors, radii=rr.Radius.ui_points(3.5)))


def draw_signals(canvas: Canvas, lights: Sequence[tuple[Sequence[float], str]]) -> None:
    """Draws a dot above the stop line of each link of the traffic lights."""
    points = np.array([_lifted(position, _SIGNAL_M) for position, _ in lights], np.float64).reshape(-1, 3)
    canvas.log(SIGNALS, rr.Points3D(points, colors=light_colors(lights), radii=rr.Radius.ui_points(4.0)))


def draw_routes(canvas: Canvas, routes_m: Sequence[NDArray[np.float64]], height_m: float) -> None:
    """Draws the routes `[n, 2]` of heroes at the height of the followed vehicle, whose route comes first."""
    strips = [np.column_stack([route, np.full(len(route), height_m + 0.15)]) for route in routes_m]
    canvas.log(ROUTES, rr.LineStrips3D(strips, colors=route_colors(len(strips)), radii=0.15))


def draw_contacts(canvas: Canvas, positions_m: NDArray[np.floating]) -> None:
    """Draws the recent contacts `[n, 3]`."""
    canvas.log(CONTACTS, rr.Points3D(positions_m, colors=CONTACT_COLOR, radii=rr.Radius.ui_points(7.0)))


def _lifted(position_m: Sequence[float], height_m: float) -> list[float]:
    x_m, y_m, *z_m = (float(value) for value in position_m)
    return [x_m, y_m, (z_m[0] if z_m else 0.0) + height_m]
