"""Draws the static map once: roads with their markings, sidewalks, crossings, buildings, obstacles, scale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import solid
from caraware_viewer.canvas import Canvas, on_screen
from caraware_viewer.documents import Area, Building, Lane, Obstacle, RunMap, SceneDocument
from caraware_viewer.geometry import hatching_m, quaternions
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
SPACE_CROSSINGS = "space/world/crossings"
SPACE_MARKINGS = "space/world/markings"
SPACE_BUILDINGS = "space/world/buildings"
SPACE_OBSTACLES = "space/world/obstacles"

ROAD_COLOR, WALK_COLOR, CROSSING_COLOR = [52, 56, 64], [84, 82, 78], [150, 150, 146]
MARKING_COLOR, BUILDING_COLOR, WALL_COLOR = [196, 198, 200], [104, 88, 74], [150, 128, 108]
OBSTACLE_COLOR, BOUNDS_COLOR, SCALE_COLOR = [255, 127, 80], [70, 74, 84], [210, 214, 220]
GROUND_COLOR, ROOF_COLOR = [38, 42, 44], [142, 120, 100]

_ROAD_KINDS = ("car", "bus", "bicycle", "rail")
_MARKING_M = 0.12
_DASH_M, _GAP_M = 3.0, 6.0
_STRIPE_M = 0.5
_MAX_HATCHES = 60_000
"""Most segments that fill polygons; a larger map has its rows farther apart."""
_MIN_SPACING_M = 0.5
SCALE_BELOW = 0.035
"""Distance of the scale bar from the map, as a share of its height."""


def draw_map(canvas: Canvas, run_map: RunMap) -> None:
    """Draws the static map; of a map without a scene, only the bounds."""
    try:
        _draw_bounds(canvas, run_map["map"]["bounds_m"])
        scene = run_map.get("scene") or SceneDocument()
        lanes, areas = scene.get("lanes", []), scene.get("areas", [])
        _draw_lanes(canvas, lanes)
        _draw_polygons(canvas, JUNCTIONS, [a for a in areas if a["kind"] == "junction"], ROAD_COLOR, 2.0)
        _draw_polygons(canvas, WALKS + "/areas", [a for a in areas if a["kind"] == "walking_area"], WALK_COLOR, 2.5)
        _draw_buildings(canvas, scene.get("buildings", []))
        _draw_obstacles(canvas, scene.get("obstacles", []))
        _draw_scale(canvas, run_map["map"]["bounds_m"])
        _draw_surfaces(canvas, run_map["map"]["bounds_m"], scene)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise FrameError(f"the map cannot be read: {error!r}") from error


def _draw_bounds(canvas: Canvas, bounds_m: list[float]) -> None:
    x_min, y_min, x_max, y_max = bounds_m
    corners = np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max], [x_min, y_min]])
    canvas.log(BOUNDS, rr.LineStrips2D([on_screen(corners)], colors=BOUNDS_COLOR, draw_order=0.0), static=True)


def _draw_lanes(canvas: Canvas, lanes: list[Lane]) -> None:
    """Draws each lane as a strip of its width; lanes inside a junction have no markings."""
    roads = [lane for lane in lanes if lane["kind"] in _ROAD_KINDS]
    _strips(canvas, ROADS, roads, ROAD_COLOR, 1.0)
    _strips(canvas, WALKS, [lane for lane in lanes if lane["kind"] == "sidewalk"], WALK_COLOR, 1.5)
    stripes = [stripe for lane in lanes if lane["kind"] == "crossing" for stripe in stripes_m(lane)]
    _segments(canvas, CROSSINGS, stripes, CROSSING_COLOR, _STRIPE_M / 2, 4.0)
    markings = [piece for lane in roads if not lane["inside"] for piece in markings_m(lane)]
    _segments(canvas, MARKINGS, markings, MARKING_COLOR, _MARKING_M / 2, 5.0)


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


def _draw_surfaces(canvas: Canvas, bounds_m: list[float], scene: SceneDocument) -> None:
    """Draws the surfaces of the 3-D view, each a little above the one below, so that the nearer one is seen."""
    lanes, polygons, buildings = scene.get("lanes", []), scene.get("areas", []), scene.get("buildings", [])
    roads = [lane for lane in lanes if lane["kind"] in _ROAD_KINDS]
    heights_m = [point[2] for lane in lanes for point in lane["points_m"]]
    surfaces = {
        SPACE_GROUND: solid.ground(bounds_m, min(heights_m, default=0.0) - 0.1, GROUND_COLOR),
        SPACE_ROADS: solid.strips(roads, ROAD_COLOR, 0.0),
        SPACE_JUNCTIONS: solid.areas([a for a in polygons if a["kind"] == "junction"], ROAD_COLOR, 0.01),
        SPACE_WALKS: solid.strips([lane for lane in lanes if lane["kind"] == "sidewalk"], WALK_COLOR, 0.02),
        SPACE_WALKS + "/areas": solid.areas([a for a in polygons if a["kind"] == "walking_area"], WALK_COLOR, 0.03),
        SPACE_BUILDINGS: solid.buildings(buildings, ROOF_COLOR),
    }
    for path, surface in surfaces.items():
        if len(surface.corners_m):
            canvas.log(path, surface.mesh(), static=True)
    painted = {
        SPACE_MARKINGS: ([(lane, markings_m(lane)) for lane in roads if not lane["inside"]], MARKING_COLOR, _MARKING_M),
        SPACE_CROSSINGS: (
            [(lane, stripes_m(lane)) for lane in lanes if lane["kind"] == "crossing"],
            CROSSING_COLOR,
            _STRIPE_M,
        ),
    }
    for path, (lines, color, width_m) in painted.items():
        strips = [_lifted(line, lane) for lane, pieces in lines for line in pieces]
        if strips:
            canvas.log(path, rr.LineStrips3D(strips, colors=color, radii=width_m / 2), static=True)


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


def markings_m(lane: Lane) -> list[NDArray[np.float64]]:
    """Painted lines of a lane's edges; a dashed line is a list of pieces."""
    pieces = []
    for side, marking in ((1, lane["left"]), (-1, lane["right"])):
        if marking == "solid":
            pieces.append(edge_m(lane, side))
        elif marking == "dashed":
            pieces += pieces_m(edge_m(lane, side), _DASH_M, _GAP_M)
    return pieces


def stripes_m(lane: Lane) -> list[NDArray[np.float64]]:
    """Stripes of a crossing, in the direction of the traffic that it crosses."""
    line = np.asarray(lane["points_m"], np.float64)[:, :2]
    stripes = []
    for piece in pieces_m(line, _STRIPE_M, _STRIPE_M):
        along = piece[-1] - piece[0]
        across = (
            np.array([-along[1], along[0]]) / max(np.linalg.norm(along), 1e-9) * (lane["width_m"] / 2 - _STRIPE_M / 2)
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


def _strips(canvas: Canvas, path: str, lanes: list[Lane], color: list[int], order: float) -> None:
    if not lanes:
        return
    strips = [on_screen(np.asarray(lane["points_m"], np.float64)[:, :2]) for lane in lanes]
    radii = [lane["width_m"] / 2 for lane in lanes]
    canvas.log(path, rr.LineStrips2D(strips, colors=color, radii=radii, draw_order=order), static=True)


def _segments(
    canvas: Canvas, path: str, lines: Sequence[NDArray[np.floating]], color: list[int], radius_m: float, order: float
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
    rows_m = sum(float(np.ptp(outline[:, 1])) for outline in outlines)
    spacing_m = max(_MIN_SPACING_M, rows_m / _MAX_HATCHES)
    filling = [segment for outline in outlines for segment in hatching_m(outline, spacing_m)]
    _segments(canvas, path, filling, color, 0.55 * spacing_m, order)


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
