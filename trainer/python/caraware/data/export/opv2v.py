"""OPV2V: cooperative perception with any number of agents, as OpenCOOD loads it.

A part is a directory of one episode (a *scenario* there), with a directory for each carrier of a LIDAR and, in it, a
`.yaml`, a `.pcd`, a mask of what it sees and up to four images for each tick. A carrier beside the road has a negative
number, as in V2XSet. The points of all LIDARs of a carrier are in one file, in the frame of the main one. Coordinates
are CARLA's: left-handed, y to the south, degrees.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from caraware.data.export.frames import (
    CameraImage,
    DeliveredSensors,
    Frame,
    LidarScan,
    delivered_sensors,
    frames,
)
from caraware.data.export.scans import box_middle, require_channels, undistorted_projection
from caraware.data.export.sensors import Omission, lack_colours, left_out, left_out_without
from caraware.data.recording import Array, Episode, Recording, RecordingError
from caraware.ipc.arrays import Float64Array, FloatArray
from caraware.ipc.mounts import ROADSIDE

LABELLED_WITHIN_M = 150.0
"""Distance from the LIDAR up to which road users are labelled."""

MASK_SIZE, MASK_MIDDLE, MASK_PIXEL_M = 256, 127, 0.39
"""Pixels of a side of `_bev_visibility.png`, the pixel of the LIDAR in both directions, and the length of one (m)."""


MOST_CAMERAS = 4
"""Cameras of an agent for which the format has a place."""


def agent_number(carrier: int) -> int:
    """Number of an agent: that of the vehicle, or −1, −2, … of the carriers beside the road."""
    return -1 - (carrier & ~ROADSIDE) if carrier & ROADSIDE else carrier


def lacks(delivered: DeliveredSensors, carrier: int) -> list[Omission]:
    """OPV2V has a place for points and for the colours of four cameras, at ticks with a scan of the main LIDAR."""
    main = delivered.main_lidar(carrier)
    if main is None:
        return left_out(delivered, carrier, delivered.of[carrier], "its carrier has no LIDAR, which an agent needs")
    cameras = delivered.cameras(carrier)
    kept = [*cameras[:MOST_CAMERAS], *(key for key in delivered.of[carrier] if key[0] == "lidar")]
    radars = [key for key in delivered.of[carrier] if key[0] == "radar"]
    return [
        *(one for one in lack_colours(delivered, carrier) if one.sensor in kept),
        *left_out(delivered, carrier, cameras[MOST_CAMERAS:], "OPV2V has a place for four cameras"),
        *left_out(delivered, carrier, radars, "OPV2V has no place for radars"),
        *left_out_without(delivered, carrier, kept, [main], "a tick needs a scan of the main LIDAR"),
    ]


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


def _sensor_pose(sensor: LidarScan | CameraImage) -> list[float]:
    """OPV2V's pose of a sensor."""
    return pose(sensor.head["position_m"], sensor.head["attitude_rad"])


def merged_points(main: LidarScan, others: tuple[LidarScan, ...]) -> tuple[Array, Array, Array]:
    """The points of several LIDARs in the left-handed frame of the main one, x forward, y right, z up.

    f32 [count, 3] (m), f32 [count] intensities, u32 [count] objects.
    """
    right_handed_m: list[Array] = [main.forward_m]
    for scan in others:
        main_from_scan = np.linalg.inv(main.world_from_sensor) @ scan.world_from_sensor
        moved_m = scan.forward_m.astype(np.float64) @ main_from_scan[:3, :3].T + main_from_scan[:3, 3]
        right_handed_m.append(moved_m.astype(np.float32))
    scans = (main, *others)
    return (
        np.concatenate(right_handed_m) * np.array([1, -1, 1], np.float32),
        np.concatenate([scan.points["intensity"] for scan in scans]),
        np.concatenate([scan.points["object"] for scan in scans]),
    )


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


def _mask(main: LidarScan, hit: Array, states: Array) -> Image.Image:
    """What the agent sees from above: 255 where a road user stands that one of its LIDARs has hit, else 0."""
    world_from_lidar = world_from_pose(_sensor_pose(main))
    image = Image.new("L", (MASK_SIZE, MASK_SIZE))
    draw = ImageDraw.Draw(image)
    for state in states[np.isin(states["vehicle"], hit)]:
        box = _box(state)
        length_m, width_m, _ = box["extent"]
        corners = np.array([[x, y, 0, 1] for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))], np.float64)
        corners[:, :2] *= length_m, width_m
        in_world = corners @ world_from_pose([*box["location"], *box["angle"]]).T
        in_lidar = np.linalg.solve(world_from_lidar, in_world.T).T
        draw.polygon([(float(column), float(row)) for column, row in mask_pixel(in_lidar)], fill=255)
    return image


def _camera(image: CameraImage, main: LidarScan) -> str:
    """A camera in the `.yaml`: its pose, its pinhole, and the way from the LIDAR's frame to its own, both x forward."""
    world_from_camera, world_from_lidar = (world_from_pose(_sensor_pose(sensor)) for sensor in (image, main))
    parts = {
        "cords": _sensor_pose(image),
        "intrinsic": undistorted_projection(image.head)[:, :3].tolist(),
        "extrinsic": (np.linalg.inv(world_from_camera) @ world_from_lidar).tolist(),
    }
    return "".join(f"\n  {name}: {value}" for name, value in parts.items())


def _yaml(frame: Frame, main: LidarScan, images: dict[int, CameraImage], hit_by: Array) -> str:
    """The `.yaml` of one agent and tick: poses, and every road user near it with the points that hit it."""
    states, scan = frame.states, main.head
    ego = _box(frame.own)
    hit, counts = np.unique(hit_by, return_counts=True)
    points_on = dict(zip(hit.tolist(), counts.tolist(), strict=True))
    others = [state for state in states if _is_labelled(state, scan)]
    lines = [
        *(f"camera{number}:{_camera(image, main)}" for number, image in sorted(images.items())),
        *(["camera0: {}"] if 0 not in images else []),
        f"lidar_pose: {_sensor_pose(main)}",
        f"true_ego_pos: {[*ego['location'], *ego['angle']]}",
        f"predicted_ego_pos: {[*ego['location'], *ego['angle']]}",
        f"ego_speed: {ego['speed']}",
        f"RSU: {str(frame.is_roadside).lower()}",
        "plan_trajectory: []",
        "vehicles:" if others else "vehicles: {}",
    ]
    for state in others:
        lines.append(f"  {int(state['vehicle'])}:")
        lines += [f"    {key}: {value}" for key, value in _box(state).items()]
        # Not in OPV2V: how many points of this agent are on it, so that labels can be masked by what it sees.
        lines.append(f"    points: {points_on.get(int(state['vehicle']), 0)}")
    return "\n".join(lines) + "\n"


def _is_labelled(state: np.void, scan: np.void) -> bool:
    """True for a road user near the LIDAR that is not its carrier."""
    away_m = np.hypot(state["x_m"] - scan["position_m"][0], state["y_m"] - scan["position_m"][1])
    return int(state["vehicle"]) != int(scan["vehicle"]) and bool(away_m <= LABELLED_WITHIN_M)


def write_opv2v(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode. Raises `RecordingError` if the recording has no `world` or no `pointcloud`."""
    require_channels(recording, "world", "pointcloud")
    path.mkdir(parents=True)
    delivered = delivered_sensors(recording, episode)
    for frame in frames(recording, episode, delivered):
        if frame.main is not None:
            cameras = delivered.cameras(frame.carrier)[:MOST_CAMERAS]
            images = {cameras.index(image.key): image for image in frame.images if image.key in cameras}
            _write_frame(path / str(agent_number(frame.carrier)), frame, frame.main, images)
    if not any(path.iterdir()):
        raise RecordingError(f"{recording.path}: no vehicle carries a LIDAR: set lidar.vehicles or suite")


def _write_frame(agent: Path, frame: Frame, main: LidarScan, images: dict[int, CameraImage]) -> None:
    agent.mkdir(exist_ok=True)
    name = f"{frame.tick:06}"
    coloured = {number: (image, rgb) for number, image in images.items() if (rgb := image.rgb) is not None}
    position_m, intensity, hit = merged_points(main, frame.other_scans)
    described = {number: image for number, (image, _) in coloured.items()}
    (agent / f"{name}.yaml").write_text(_yaml(frame, main, described, hit), encoding="utf-8")
    _mask(main, hit, frame.states).save(agent / f"{name}_bev_visibility.png")
    write_pcd(agent / f"{name}.pcd", position_m, intensity)
    for number, (_, rgb) in coloured.items():
        Image.fromarray(rgb).save(agent / f"{name}_camera{number}.png")
