"""OPV2V: cooperative perception with any number of agents, as OpenCOOD loads it.

A part is a directory of one episode (a *scenario* there), with a directory for each vehicle that carries a LIDAR and,
in it, a `.yaml`, a `.pcd` and a mask of what it sees for each tick. Coordinates are CARLA's: left-handed, y to the
south, degrees.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from caraware.data.export.scans import box_middle, forward_m, require_channels
from caraware.data.recording import Array, Episode, Message, Recording, RecordingError
from caraware.ipc.arrays import Float64Array, FloatArray

LABELLED_WITHIN_M = 150.0
"""Distance from the LIDAR up to which road users are labelled."""

MASK_SIZE, MASK_MIDDLE, MASK_PIXEL_M = 256, 127, 0.39
"""Pixels of a side of `_bev_visibility.png`, the pixel of the LIDAR in both directions, and the length of one (m)."""


def pose(position_m: Any, attitude_rad: Any) -> list[float]:
    """OPV2V's pose (x, y, z in m; roll, yaw, pitch in degrees) of a pose in the world frame."""
    (x, y, z), (roll, pitch, yaw) = position_m, attitude_rad
    return [float(x), -float(y), float(z), *(float(np.rad2deg(angle)) for angle in (roll, -yaw, pitch))]


def world_from_pose(values: list[float]) -> Float64Array:
    """f64 [4, 4]: the transform that OpenCOOD makes of a pose (`x_to_world`), in CARLA's left-handed frame."""
    x, y, z = values[:3]
    (sr, cr), (sy, cy), (sp, cp) = ((np.sin(a), np.cos(a)) for a in np.deg2rad(values[3:]))
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


def _points(scan: np.void, points: Array) -> Array:
    """f32 [count, 3]: points in the sensor's left-handed frame, x forward, y right, z up."""
    left_handed: Array = forward_m(scan, points) * np.array([1, -1, 1], np.float32)
    return left_handed


def write_pcd(path: Path, position_m: Array, intensity: Array) -> None:
    """Write points as binary PCD; the intensity (0 … 1) is in the red of `rgb`, where OpenCOOD reads it."""
    rows = np.zeros(len(position_m), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    for place, name in enumerate("xyz"):
        rows[name] = position_m[:, place]
    rows["rgb"] = np.round(np.clip(intensity, 0, 1) * 255).astype(np.uint32) << 16
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\n"
        f"COUNT 1 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + rows.tobytes())


def _box(state: np.void) -> dict[str, Any]:
    """OPV2V's label of a road user: its box stands on the ground at `location`."""
    ahead_m = float(box_middle(state)[0])
    x = float(state["x_m"]) + ahead_m * float(np.cos(state["yaw_rad"]))
    y = float(state["y_m"]) + ahead_m * float(np.sin(state["yaw_rad"]))
    angles = pose((x, y, state["z_m"]), (state["roll_rad"], state["pitch_rad"], state["yaw_rad"]))
    half = [float(state[name]) / 2 for name in ("length_m", "width_m", "height_m")]
    return {
        "angle": angles[3:],
        "center": [0.0, 0.0, half[2]],
        "extent": half,
        "location": angles[:3],
        "speed": float(np.hypot(*state["velocity_body_mps"][:2])) * 3.6,
    }


def mask_pixel(lidar_m: FloatArray) -> FloatArray:
    """f64 [count, 2]: column and row of points [count, 2 or 3] in the LIDAR's left-handed frame: ahead is up."""
    return MASK_MIDDLE + np.stack((lidar_m[:, 1], -lidar_m[:, 0]), 1) / MASK_PIXEL_M


def _mask(scan: np.void, points: Array, states: Array) -> Image.Image:
    """What the agent sees from above: 255 where a road user stands that its LIDAR has hit, else 0."""
    world_from_lidar = world_from_pose(pose(scan["position_m"], scan["attitude_rad"]))
    image = Image.new("L", (MASK_SIZE, MASK_SIZE))
    draw = ImageDraw.Draw(image)
    for state in states[np.isin(states["vehicle"], points["object"])]:
        box = _box(state)
        length_m, width_m, _ = box["extent"]
        corners = np.array([[x, y, 0, 1] for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))], np.float64)
        corners[:, :2] *= length_m, width_m
        in_world = corners @ world_from_pose([*box["location"], *box["angle"]]).T
        in_lidar = np.linalg.solve(world_from_lidar, in_world.T).T
        draw.polygon([(float(column), float(row)) for column, row in mask_pixel(in_lidar)], fill=255)
    return image


def _yaml(scan: np.void, points: Array, states: Array) -> str:
    """The `.yaml` of one agent and tick: poses, and every road user near it with the points that hit it."""
    own = states[states["vehicle"] == scan["vehicle"]][0]
    ego = _box(own)
    hit, counts = np.unique(points["object"], return_counts=True)
    points_on = dict(zip(hit.tolist(), counts.tolist(), strict=True))
    lines = [
        "camera0: {}",
        f"lidar_pose: {pose(scan['position_m'], scan['attitude_rad'])}",
        f"true_ego_pos: {[*ego['location'], *ego['angle']]}",
        f"predicted_ego_pos: {[*ego['location'], *ego['angle']]}",
        f"ego_speed: {ego['speed']}",
        "plan_trajectory: []",
        "vehicles:" if len(states) > 1 else "vehicles: {}",
    ]
    for state in states:
        away_m = np.hypot(state["x_m"] - scan["position_m"][0], state["y_m"] - scan["position_m"][1])
        vehicle = int(state["vehicle"])
        if vehicle == int(scan["vehicle"]) or away_m > LABELLED_WITHIN_M:
            continue
        lines.append(f"  {vehicle}:")
        lines += [f"    {key}: {value}" for key, value in _box(state).items()]
        # Not in OPV2V: how many points of this agent are on it, so that labels can be masked by what it sees.
        lines.append(f"    points: {points_on.get(vehicle, 0)}")
    return "\n".join(lines) + "\n"


def write_opv2v(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode. Raises `RecordingError` if the recording has no `world` or no `pointcloud`."""
    require_channels(recording, "world", "pointcloud")
    path.mkdir(parents=True)
    world: dict[int, Array] = {}
    scans: list[Message] = []
    for message in recording.messages("world", "pointcloud"):
        if int(message.header["episode"]) != episode.number:
            continue
        if message.channel == "world":
            world[message.tick] = message.section("states")
            continue
        scans.append(message)
        while scans and scans[0].tick in world:
            _write_scan(path, scans.pop(0), world)
        for tick in [tick for tick in world if tick < message.tick - 256]:
            del world[tick]
    for message in scans:
        if message.tick in world:
            _write_scan(path, message, world)
    if not any(path.iterdir()):
        raise RecordingError(f"{recording.path}: no vehicle carries a LIDAR: set lidar.vehicles")


def _write_scan(path: Path, message: Message, world: dict[int, Array]) -> None:
    scan, points = message.section("scan")[0], message.section("points")
    agent = path / str(int(scan["vehicle"]))
    agent.mkdir(exist_ok=True)
    name = f"{message.tick:06}"
    (agent / f"{name}.yaml").write_text(_yaml(scan, points, world[message.tick]), encoding="utf-8")
    _mask(scan, points, world[message.tick]).save(agent / f"{name}_bev_visibility.png")
    write_pcd(agent / f"{name}.pcd", _points(scan, points), points["intensity"])
