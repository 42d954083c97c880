"""Draws the static map once: roads with their markings, sidewalks, crossings, buildings, obstacles, scale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import paint, solid
from caraware_viewer.canvas import Canvas, on_screen
from caraware_viewer.documents import Area, Building, Lane, Obstacle, RunMap, SceneDocument
from caraware_viewer.geometry import hatching_m, quaternions
from caraware_viewer.ground import ground
from caraware_viewer.paint import CROSSING_COLOR, MARKING_COLOR, MARKING_M, ROAD_KINDS, STRIPE_M, RoadPaint
from caraware_viewer.wire import FrameError

BOUNDS = "top/map/bounds"
ROADS = "top/map/roads"
JUNCTIONS = "top/map/junctions"
WALKS = "top/map/walks"
CROSSINGS = "top/map/crossings"
MARKINGS = "top/map/markings"
BUILDINGS = "top/map/buildings"
OBSTACLES = "top/map/obstacles"
SCALE = "top/scale"
SPACE_GROUND = "space/world/ground"
SPACE_ROADS = "space/world/roads"
SPACE_JUNCTIONS = "space/world/junctions"
SPACE_WALKS = "space/world/walks"
SPACE_BUILDINGS = "space/world/buildings"
SPACE_OBSTACLES = "space/world/obstacles"

ROAD_COLOR, WALK_COLOR = [52, 56, 64], [84, 82, 78]
BUILDING_COLOR, WALL_COLOR = [104, 88, 74], [150, 128, 108]
OBSTACLE_COLOR, BOUNDS_COLOR, SCALE_COLOR = [255, 127, 80], [70, 74, 84], [210, 214, 220]
GROUND_COLOR, ROOF_COLOR = [38, 42, 44], [142, 120, 100]

MAX_LINES = 8_000
"""Most lanes, lines of paint, and segments that fill polygons. A larger map shows less of each: it is drawn again for
every frame, and a browser without a graphics card takes a microsecond for a corner of a line."""
_MIN_SPACING_M = 0.5
SCALE_BELOW = 0.035
"""Distance of the scale bar from the map, as a share of its height."""


def draw_map(canvas: Canvas, run_map: RunMap) -> RoadPaint:
    """Draws the static map; of a map without a scene, only the bounds. Returns the paint, which follows a vehicle."""
    try:
        _draw_bounds(canvas, run_map["map"]["bounds_m"])
        scene = run_map.get("scene") or SceneDocument()
        lanes, areas = scene.get("lanes", []), scene.get("areas", [])
        lanes = shown_lanes(lanes, areas)
        _draw_lanes(canvas, lanes)
        _draw_polygons(canvas, JUNCTIONS, [a for a in areas if a["kind"] == "junction"], ROAD_COLOR, 2.0)
        _draw_polygons(canvas, WALKS + "/areas", [a for a in areas if a["kind"] == "walking_area"], WALK_COLOR, 2.5)
        _draw_buildings(canvas, scene.get("buildings", []))
        _draw_obstacles(canvas, scene.get("obstacles", []))
        _draw_scale(canvas, run_map["map"]["bounds_m"])
        _draw_surfaces(canvas, run_map["map"]["bounds_m"], lanes, scene)
        return RoadPaint(canvas, lanes, MAX_LINES)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise FrameError(f"the map cannot be read: {error!r}") from error


def _draw_bounds(canvas: Canvas, bounds_m: list[float]) -> None:
    x_min, y_min, x_max, y_max = bounds_m
    corners = np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max], [x_min, y_min]])
    canvas.log(BOUNDS, rr.LineStrips2D([on_screen(corners)], colors=BOUNDS_COLOR, draw_order=0.0), static=True)


def shown_lanes(lanes: list[Lane], areas: list[Area]) -> list[Lane]:
    """The lanes that are drawn: of very many those outside junctions, whose areas are drawn."""
    if len(lanes) <= MAX_LINES or not any(area["kind"] == "junction" for area in areas):
        return lanes
    return [lane for lane in lanes if not lane["inside"]]


def _draw_lanes(canvas: Canvas, lanes: list[Lane]) -> None:
    """Draws each lane as a strip of its width, with as much of its paint as there is room for."""
    roads = [lane for lane in lanes if lane["kind"] in ROAD_KINDS]
    _strips(canvas, ROADS, roads, ROAD_COLOR, 1.0)
    _strips(canvas, WALKS, [lane for lane in lanes if lane["kind"] == "sidewalk"], WALK_COLOR, 1.5)
    for path, lines, color, width_m, order in (
        (CROSSINGS, paint.crossings(lanes, MAX_LINES), CROSSING_COLOR, STRIPE_M, 4.0),
        (MARKINGS, paint.markings(lanes, MAX_LINES), MARKING_COLOR, MARKING_M, 5.0),
    ):
        _segments(canvas, path, [line for _, pieces in lines for line in pieces], color, width_m / 2, order)


def _draw_scale(canvas: Canvas, bounds_m: list[float]) -> None:
    """Draws a bar of a round length below the map, with its length beside it."""
    x_min, y_min, x_max, y_max = bounds_m
    length_m = scale_m(x_max - x_min)
    y_m = y_min - SCALE_BELOW * (y_max - y_min)
    tick_m = 0.008 * (y_max - y_min)
    corner = np.array([x_min, y_m])
    bar = corner + np.array([[0, tick_m], [0, 0], [length_m, 0], [length_m, tick_m]])
    label = f"{length_m:g} m" if length_m < 1000 else f"{length_m / 1000:g} km"
    radii = rr.Radius.ui_points(1.2)
    canvas.log(SCALE, rr.LineStrips2D([on_screen(bar)], colors=SCALE_COLOR, radii=radii, draw_order=40.0), static=True)
    end = on_screen(np.array([[x_min + length_m / 2, y_m]]))
    text = rr.Points2D(
        end, labels=[label], show_labels=True, radii=rr.Radius.ui_points(0.0), colors=SCALE_COLOR, draw_order=40.0
    )
    canvas.log(SCALE + "/length", text, static=True)


def scale_m(width_m: float) -> float:
    """The longest of 1, 2, 5, 10, … m that is at most a quarter of `width_m`."""
    longest = max(width_m / 4, 1.0)
    power = 10.0 ** np.floor(np.log10(longest))
    return float(power * max(step for step in (1, 2, 5) if step * power <= longest))


def _draw_surfaces(canvas: Canvas, bounds_m: list[float], lanes: list[Lane], scene: SceneDocument) -> None:
    """Draws the surfaces of the 3-D view, each a little above the one below, so that the nearer one is seen."""
    polygons, buildings = scene.get("areas", []), scene.get("buildings", [])
    roads = [lane for lane in lanes if lane["kind"] in ROAD_KINDS]
    surfaces = {
        SPACE_GROUND: ground(bounds_m, lanes, GROUND_COLOR),
        SPACE_ROADS: solid.strips(roads, ROAD_COLOR, 0.0),
        SPACE_JUNCTIONS: solid.areas([a for a in polygons if a["kind"] == "junction"], ROAD_COLOR, 0.01),
        SPACE_WALKS: solid.strips([lane for lane in lanes if lane["kind"] == "sidewalk"], WALK_COLOR, 0.02),
        SPACE_WALKS + "/areas": solid.areas([a for a in polygons if a["kind"] == "walking_area"], WALK_COLOR, 0.03),
        SPACE_BUILDINGS: solid.buildings(buildings, ROOF_COLOR),
    }
    for path, surface in surfaces.items():
        if len(surface.corners_m):
            canvas.log(path, surface.mesh(), static=True)


def _strips(canvas: Canvas, path: str, lanes: list[Lane], color: list[int], order: float) -> None:
    if not lanes:
        return
    strips = [on_screen(np.asarray(lane["points_m"], np.float64)[:, :2]) for lane in lanes]
    radii = [lane["width_m"] / 2 for lane in lanes]
    canvas.log(path, rr.LineStrips2D(strips, colors=color, radii=radii, draw_order=order), static=True)


def _segments(
    canvas: Canvas,
    path: str,
    lines: Sequence[NDArray[np.floating]],
    color: list[int],
    radius_m: float | Sequence[float],
    order: float,
) -> None:
    if lines:
        strips = [on_screen(line) for line in lines]
        canvas.log(path, rr.LineStrips2D(strips, colors=color, radii=radius_m, draw_order=order), static=True)


def _draw_polygons(
    canvas: Canvas, path: str, polygons: Sequence[Area | Building], color: list[int], order: float
) -> None:
    outlines = [np.asarray(polygon["points_m"], np.float64)[:, :2] for polygon in polygons]
    outlines = [outline for outline in outlines if len(outline) > 2]
    if not outlines:
        return
    filling, radii_m = filling_m(outlines)
    _segments(canvas, path, filling, color, radii_m, order)


def filling_m(outlines: Sequence[NDArray[np.float64]]) -> tuple[list[NDArray[np.float32]], list[float]]:
    """Segments `[2, 2]` that fill polygons `[n, 2]`, and their radii: the larger the map, the wider they are.

    They run along the longer side. A segment ends in a half circle, so a wide one is shorter at both ends.
    """
    shorter_m = [float(np.ptp(outline, axis=0).min()) for outline in outlines]
    spacing_m = max(_MIN_SPACING_M, sum(shorter_m) / MAX_LINES)
    filling: list[NDArray[np.float32]] = []
    radii_m: list[float] = []
    for outline, width_m in zip(outlines, shorter_m, strict=True):
        own_m = max(width_m, 0.01) / np.ceil(max(width_m, 0.01) / spacing_m)
        is_tall = np.ptp(outline[:, 1]) > np.ptp(outline[:, 0])
        # Where a segment is less than a pixel, its smooth edges would let the ground through.
        radius_m = (0.55 if own_m <= _MIN_SPACING_M else 0.7) * own_m
        inset_m = np.array([max(0.0, radius_m - 0.55 * _MIN_SPACING_M), 0.0], np.float32)
        for segment in hatching_m(outline[:, ::-1] if is_tall else outline, float(own_m)):
            half = np.minimum(inset_m, (segment[1] - segment[0]) * 0.49)
            inside = segment + np.array([half, -half])
            filling.append(inside[:, ::-1] if is_tall else inside)
            radii_m.append(radius_m)
    return filling, radii_m


def _draw_buildings(canvas: Canvas, buildings: list[Building]) -> None:
    _draw_polygons(canvas, BUILDINGS, buildings, BUILDING_COLOR, 6.0)
    outlines = [np.asarray(building["points_m"], np.float64)[:, :2] for building in buildings]
    _segments(canvas, BUILDINGS + "/walls", [np.vstack([o, o[:1]]) for o in outlines], WALL_COLOR, 0.25, 6.5)


def _draw_obstacles(canvas: Canvas, obstacles: list[Obstacle]) -> None:
    if not obstacles:
        return
    centres_m = np.array([obstacle["center_m"] for obstacle in obstacles], np.float64)
    sizes_m = np.array([obstacle["size_m"] for obstacle in obstacles], np.float64)
    yaw_rad = np.array([obstacle["yaw_rad"] for obstacle in obstacles], np.float64)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2 * sizes_m[:, None, :2]
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    turned = np.stack(
        [cos * corners[..., 0] - sin * corners[..., 1], sin * corners[..., 0] + cos * corners[..., 1]], axis=-1
    )
    outlines = on_screen(turned + centres_m[:, None, :2])
    strips = rr.LineStrips2D(outlines, colors=OBSTACLE_COLOR, radii=rr.Radius.ui_points(1.5), draw_order=7.0)
    canvas.log(OBSTACLES, strips, static=True)
    boxes = rr.Boxes3D(
        centers=centres_m + [0, 0, 0.5] * sizes_m[:, 2:],
        half_sizes=sizes_m / 2,
        quaternions=quaternions(yaw_rad),
        colors=OBSTACLE_COLOR,
        fill_mode="solid",
    )
    canvas.log(SPACE_OBSTACLES, boxes, static=True)
