"""The roads of a run's map from above, with the vehicles that hold a slot: what `render()` of every face draws."""

from __future__ import annotations

from itertools import count, takewhile
from typing import Any

import numpy as np
import sumolib
from PIL import Image, ImageDraw

from caraware.envs.rendering import RgbImage
from caraware.envs.transition import Rows
from caraware.ipc.arrays import BoolArray, Float64Array
from caraware.ipc.run_file import RunFile

LONG_SIDE_PX = 512
"""Longer side of the image."""
OVERSAMPLING = 2
"""The image is drawn this many times larger and then reduced, so that edges are smooth."""
CAR_M = (4.6, 1.8)
"""Length and width of a drawn vehicle: an observation does not hold the outlines of the vehicles that sense."""
REAR_OVERHANG_M = 0.9
"""From the rear bumper to the rear axle, where the truth's position lies."""
SHORTEST_M = 0.1
"""A place of the observation without a vehicle has length 0, give or take the steps of a normalised f32."""
SMALLEST_PX = 9.0
"""A vehicle is drawn at least this long, however large the map is."""
SEEN_FIELDS = ("x", "y", "cos", "sin", "length", "width")
"""What an observation must hold of a vehicle that is to be drawn: `user_1_x` and so on, as docs/driving.md has them."""
GROUND, ROAD, PATH = "#e3e6d8", "#5c6066", "#c9c5bd"
VEHICLE, CHOSEN, SEEN = "#2f6fd6", "#d62f2f", "#f2f2ee"
"""Colours: of vehicles with a slot, of the one whose image it is, and of the vehicles that they see."""


class MapPicture:
    """The map of one run, drawn once, and the vehicles of a tick, drawn over a copy of it."""

    def __init__(self, run: RunFile) -> None:
        """Reads the SUMO net of the run; that of a large town takes seconds. Raises `OSError` if the file is gone."""
        x_min, y_min, x_max, y_max = run["map"]["bounds_m"]
        self._px_per_m = OVERSAMPLING * LONG_SIDE_PX / max(x_max - x_min, y_max - y_min)
        self._north_west_m = np.array([x_min, y_max])
        size = [
            OVERSAMPLING * max(1, round(side * self._px_per_m / OVERSAMPLING))
            for side in (x_max - x_min, y_max - y_min)
        ]
        self._roads = Image.new("RGB", (size[0], size[1]), GROUND)
        self._draw_net(sumolib.net.readNet(run["scene_files"]["net_file"], withInternal=True), run["map"])

    def draw(self, rows: Rows, mask: BoolArray, slot: int | None = None) -> RgbImage:
        """The vehicles of rows `[N]` with true `mask` `[N]`, that in `slot` in another colour: u8 `[H, W, 3]`.

        Vehicles that they observe (`user_1`, … in `observation.fields`) are drawn too.
        """
        image = self._roads.copy()
        draw = ImageDraw.Draw(image)
        for middle_m, heading_rad, size_m in _seen(rows, mask):
            self._draw_vehicle(draw, middle_m, heading_rad, size_m, SEEN)
        ahead_m = CAR_M[0] / 2 - REAR_OVERHANG_M
        for held in sorted(np.flatnonzero(mask).tolist(), key=lambda held: held == slot):
            x_m, y_m, yaw_rad = rows.truth[held, :3].astype(np.float64)
            middle_m = np.array([x_m + ahead_m * np.cos(yaw_rad), y_m + ahead_m * np.sin(yaw_rad)])
            self._draw_vehicle(draw, middle_m, yaw_rad, CAR_M, CHOSEN if held == slot else VEHICLE)
        return np.asarray(image.reduce(OVERSAMPLING)).copy()

    def _draw_net(self, net: Any, place: dict[str, Any]) -> None:
        """Paths first, so that roads and junctions cover them."""
        draw, origin_m = ImageDraw.Draw(self._roads), np.array(place.get("world_origin_m", (0.0, 0.0)))
        lanes = [lane for edge in net.getEdges() for lane in edge.getLanes()]
        for lane in sorted(lanes, key=lambda lane: bool(lane.allows("passenger"))):
            width_px = max(OVERSAMPLING, round(lane.getWidth() * self._px_per_m))
            colour = ROAD if lane.allows("passenger") else PATH
            draw.line(self._pixels(np.array(lane.getShape())[:, :2] - origin_m), colour, width_px, joint="curve")
        for node in net.getNodes():
            outline_m = np.array([corner[:2] for corner in node.getShape()])
            if len(outline_m) > 2:
                draw.polygon(self._pixels(outline_m - origin_m), ROAD)

    def _draw_vehicle(
        self,
        draw: ImageDraw.ImageDraw,
        middle_m: Float64Array,
        yaw_rad: float,
        size_m: tuple[float, float],
        colour: str,
    ) -> None:
        enlarged = max(1.0, OVERSAMPLING * SMALLEST_PX / (size_m[0] * self._px_per_m))
        half_m = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * np.array(size_m) * enlarged / 2
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        draw.polygon(self._pixels(middle_m + half_m @ np.array([[cos, sin], [-sin, cos]])), colour, "black")

    def _pixels(self, points_m: Float64Array) -> list[tuple[float, float]]:
        """World metres `[n, 2]` as pixels of the enlarged image, whose rows run south."""
        return [(x, y) for x, y in ((points_m - self._north_west_m) * (self._px_per_m, -self._px_per_m)).tolist()]


def _seen(rows: Rows, mask: BoolArray) -> list[tuple[Float64Array, float, tuple[float, float]]]:
    """Middle (m, world), heading (rad) and size (m) of the vehicles that the rows observe around them."""
    held = np.flatnonzero(mask)
    seen: list[tuple[Float64Array, float, tuple[float, float]]] = []
    x_m, y_m, yaw_rad = rows.truth[held, :3].astype(np.float64).T
    has = rows.settings.fields.has
    for number in takewhile(lambda number: all(has(f"user_{number}_{name}") for name in SEEN_FIELDS), count(1)):
        ahead, left, cos, sin, length, width = (rows.si(f"user_{number}_{name}")[held] for name in SEEN_FIELDS)
        east_m = x_m + ahead * np.cos(yaw_rad) - left * np.sin(yaw_rad)
        north_m = y_m + ahead * np.sin(yaw_rad) + left * np.cos(yaw_rad)
        heading_rad = yaw_rad + np.arctan2(sin, cos)
        for i in np.flatnonzero(length > SHORTEST_M):
            seen.append((np.array([east_m[i], north_m[i]]), float(heading_rad[i]), (float(length[i]), float(width[i]))))
    return seen
    return seen
