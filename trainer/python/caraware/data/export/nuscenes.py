"""nuScenes: a scene for each carrier of a LIDAR in each episode, with sweeps, images, radar, poses and boxes.

A part is a directory of one episode with its files and its rows of the tables; the data set is made of all parts: the
tables of nuScenes' devkit in `v1.0-caraware/`, whose file names are those of the parts. Frames are nuScenes': the ego
frame is ours; the LIDAR's has x right and y forward; the camera's has x right, y down and z forward.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from caraware.data.export.detections import nuscenes_points
from caraware.data.export.frames import (
    CameraImage,
    DeliveredSensors,
    Frame,
    LidarScan,
    RadarSample,
    SensorKey,
    SensorMessage,
    delivered_sensors,
    frames,
)
from caraware.data.export.scans import (
    box_middle,
    inverse,
    quaternion,
    require_channels,
    rotated,
    undistorted_projection,
    upright_pose,
    vehicle_pose,
)
from caraware.data.export.sensors import Omission, SensorLabels, carrier_name, lack_colours, left_out
from caraware.data.names import BODY_SHIFT, Kind, vehicle_class
from caraware.data.recording import Episode, Recording, RecordingError
from caraware.ipc.arrays import Float64Array

VERSION = "v1.0-caraware"
"""Directory of the tables, and `version` of the devkit's `NuScenes`."""

KEY_FRAME_S = 0.5
"""Least time between two key frames, as in nuScenes; the scans between are sweeps."""

MOVING_MPS = 0.2
"""Speed from which a road user has the attribute that says so."""

LIDAR_AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Ours (x forward, y left) from the frame of `LIDAR_TOP` (x right, y forward)."""

CATEGORIES = {
    "human.pedestrian.adult": ("pedestrian",),
    "human.pedestrian.wheelchair": ("wheelchair",),
    "vehicle.bicycle": ("bicycle",),
    "vehicle.bus.bendy": ("tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car"),
    "vehicle.bus.rigid": ("bus", "coach"),
    "vehicle.car": (),
    "vehicle.emergency.ambulance": ("emergency",),
    "vehicle.emergency.police": ("authority",),
    "vehicle.motorcycle": ("motorcycle", "moped", "scooter"),
    "vehicle.trailer": (),
    "vehicle.truck": ("truck", "trailer"),
}
"""nuScenes' categories by SUMO's classes; the classes that are missing are cars. Trams have no category there.
As there, each body of an articulated bus or tram has a box, and so have tractor and trailer."""

ATTRIBUTES = {
    "vehicle": ("vehicle.moving", "vehicle.stopped"),
    "cycle": ("cycle.with_rider", "cycle.with_rider"),
    "pedestrian": ("pedestrian.moving", "pedestrian.standing"),
}
"""Attributes of road users that move and that do not, by group."""

VISIBILITIES = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
"""Levels of visibility by their tokens."""

LIDAR_CHANNEL, CAMERA_CHANNEL, RADAR_CHANNEL = "LIDAR_TOP", "CAM_FRONT", "RADAR_FRONT"
"""Channels of the main LIDAR, and of the camera and the radar of a section."""

MODALITIES = {"LIDAR": "lidar", "CAM": "camera", "RADAR": "radar"}
"""Modality of a channel by the begin of its name."""


def sensor_channel(kind: str, name: str) -> str:
    """The channel of a sensor: its name in capitals, with the begin that nuScenes' channels of its kind have."""
    if name == kind:
        return {"camera": CAMERA_CHANNEL, "radar": RADAR_CHANNEL}.get(kind, "LIDAR")
    begin = next(begin for begin, modality in MODALITIES.items() if modality == kind)
    channel = re.sub(r"[^A-Z0-9_]", "_", name.upper())
    return channel if channel.startswith(f"{begin}_") else f"{begin}_{channel}"


TABLES = (
    *("category", "attribute", "visibility", "instance", "sensor", "calibrated_sensor", "ego_pose"),
    *("log", "scene", "sample", "sample_data", "sample_annotation", "map"),
)
"""The tables of the devkit."""

Row = dict[str, Any]


def token(*words: object) -> str:
    """The token of a row: 32 hexadecimal digits, the same for the same words."""
    return blake2b("/".join(str(word) for word in words).encode(), digest_size=16).hexdigest()


def category(state: np.void) -> str:
    """nuScenes' category of a road user, from SUMO's class."""
    of_sumo = vehicle_class(state)
    if state["kind"] == Kind.PERSON and of_sumo != "wheelchair":
        return "human.pedestrian.adult"
    if of_sumo in CATEGORIES["vehicle.bus.rigid"] and (state["trailing"] or state["kind"] == Kind.TRAILING):
        return "vehicle.bus.bendy"
    if of_sumo in CATEGORIES["vehicle.truck"] and state["kind"] == Kind.TRAILING:
        return "vehicle.trailer"
    return next((name for name, classes in CATEGORIES.items() if of_sumo in classes), "vehicle.car")


def attribute(state: np.void, category_name: str) -> str:
    """nuScenes' attribute of a road user."""
    group = "cycle" if category_name in ("vehicle.bicycle", "vehicle.motorcycle") else category_name.split(".")[0]
    moving, still = ATTRIBUTES["pedestrian" if group == "human" else group]
    return moving if float(np.hypot(*state["velocity_body_mps"][:2])) >= MOVING_MPS else still


def _visibility(frame: Frame, vehicle: int) -> str:
    """The token of the largest share of a road user's box that an image shows; empty for a carrier without a camera."""
    if not frame.images:
        return ""
    shares = [0.0]
    for image in frame.images:
        if (seen := image.seen.get(vehicle)) is not None:
            edges = [image.head["width"], image.head["height"]] * 2
            left, top, right, bottom = np.clip(seen["full_box_px"], 0, edges)
            shares.append(float(seen["visible_px"]) / max(float((right - left) * (bottom - top)), 1.0))
    return str(1 + sum(max(shares) >= least for least in (0.4, 0.6, 0.8)))


@dataclass
class _Scene:
    """The rows of one carrier in an episode, in the order in which they are written."""

    name: str
    run: str
    part: Path
    """Directory of the files."""
    log_token: str
    """Of the episode."""
    tick_s: float
    cameras: frozenset[SensorKey]
    """Cameras with colours, whose images its key frames have."""
    labels: SensorLabels
    rows: dict[str, list[Row]] = field(default_factory=lambda: {table: [] for table in TABLES})
    key_tick: int | None = None
    """Of the newest key frame."""
    waiting: list[Row] = field(default_factory=list)
    """Files since the newest key frame: they belong to the next."""
    newest: dict[str, Row] = field(default_factory=dict)
    """The newest row of each chain."""
    samples: dict[str, tuple[Row, SensorMessage]] = field(default_factory=dict)
    """The newest file of each channel since the newest key frame, and its message."""
    calibrations: set[str] = field(default_factory=set)
    """Tokens of the mountings."""
    instances: dict[str, Row] = field(default_factory=dict)
    """Road users with a box, by their tokens."""

    def token(self, *words: object) -> str:
        """A token of this scene."""
        return token(self.run, self.name, *words)

    def add(self, frame: Frame) -> None:
        """Add a frame: a key frame if it is time for one, and the main LIDAR and every camera have delivered.

        A key frame has the newest scan of each other LIDAR and radar since the key frame before.
        """
        for scan in frame.scans:
            points = np.zeros((len(scan.points), 5), "<f4")
            points[:, :3] = scan.forward_m @ LIDAR_AXES
            points[:, 3], points[:, 4] = scan.points["intensity"] * 255, scan.points["channel"]
            self._file(frame, scan, "pcd.bin").write_bytes(points.tobytes())
        for image in frame.images:
            if (rgb := image.rgb) is not None:
                Image.fromarray(rgb).save(self._file(frame, image, "png"))
        for radar in frame.radars:
            self._file(frame, radar, "pcd").write_bytes(nuscenes_points(radar, frame.own))
        is_due = self.key_tick is None or (frame.tick - self.key_tick) * self.tick_s >= KEY_FRAME_S - 1e-9
        if is_due and frame.main is not None and self.cameras <= {image.key for image in frame.images}:
            self.key_tick = frame.tick
            for row, _ in self.samples.values():
                self._make_sample(row)
            self._sample(frame)
            self.samples.clear()

    def _make_sample(self, row: Row) -> None:
        """Make a file one of the key frame."""
        sweep = Path(row["filename"])
        sample = Path("samples", *sweep.parts[1:])
        (self.part / sample).parent.mkdir(parents=True, exist_ok=True)
        (self.part / sweep).rename(self.part / sample)
        row |= {"filename": str(sample), "is_key_frame": True}

    def finish(self) -> None:
        """Give the last sweeps to the last key frame, and write what is known only now."""
        samples = self.rows["sample"]
        if not samples:
            # No frame had all sensors: the scene has no key frame, and the devkit has no place for it.
            for table in self.rows.values():
                table.clear()
            return
        for row in self.waiting:
            row["sample_token"] = samples[-1]["token"]
        self.rows["instance"] = list(self.instances.values())
        self.rows["scene"].append(
            {
                "token": self.token(),
                "log_token": self.log_token,
                "nbr_samples": len(samples),
                "first_sample_token": samples[0]["token"],
                "last_sample_token": samples[-1]["token"],
                "name": self.name,
                "description": f"{self.run}, {self.name}",
            }
        )

    def _link(self, table: str, chain: str, row: Row) -> None:
        """Append a row to a table and to a chain of rows, which `prev` and `next` link."""
        before = self.newest.get(chain)
        row |= {"prev": "" if before is None else before["token"], "next": ""}
        if before is not None:
            before["next"] = row["token"]
        self.newest[chain] = row
        self.rows[table].append(row)

    def _file(self, frame: Frame, sensor: SensorMessage, ending: str) -> Path:
        """Add the row of a file of a sensor, with the pose of the carrier and of the sensor on it; return its path."""
        channel = LIDAR_CHANNEL if sensor is frame.main else self.labels.of(sensor.key)
        camera = sensor.head if isinstance(sensor, CameraImage) else None
        name = Path("sweeps") / channel / f"{self.name}__{channel}__{frame.tick:06}.{ending}"
        path = self.part / name
        path.parent.mkdir(parents=True, exist_ok=True)
        timestamp = round(frame.tick * self.tick_s * 1e6)
        ego = self.token("ego_pose", channel, frame.tick)
        world_from_ego = vehicle_pose(frame.own)
        self.rows["ego_pose"].append({"token": ego, "timestamp": timestamp, **_placed(world_from_ego)})
        ego_from_sensor = inverse(world_from_ego) @ _world_from(sensor)
        row = {
            "token": self.token(channel, frame.tick),
            "sample_token": "",
            "ego_pose_token": ego,
            "calibrated_sensor_token": self._calibration(channel, ego_from_sensor, camera),
            "timestamp": timestamp,
            "fileformat": ending.split(".")[0],
            "is_key_frame": False,
            "height": 0 if camera is None else int(camera["height"]),
            "width": 0 if camera is None else int(camera["width"]),
            "filename": str(name),
        }
        self._link("sample_data", channel, row)
        self.waiting.append(row)
        self.samples[channel] = row, sensor
        return path

    def _calibration(self, channel: str, ego_from_sensor: Float64Array, camera: np.void | None) -> str:
        """The token of a sensor's mounting; one that has not changed by more than the rounding of poses is the same."""
        intrinsic = [] if camera is None else undistorted_projection(camera)[:, :3].tolist()
        known = self.token(channel, np.round(ego_from_sensor, 4).tolist(), intrinsic)
        if known not in self.calibrations:
            self.calibrations.add(known)
            row = {"token": known, "sensor_token": token(channel), **_placed(ego_from_sensor)}
            self.rows["calibrated_sensor"].append(row | {"camera_intrinsic": intrinsic})
        return known

    def _sample(self, frame: Frame) -> None:
        """Add a key frame with its boxes, to which the files since the one before belong."""
        sample = self.token("sample", frame.tick)
        for row in self.waiting:
            row["sample_token"] = sample
        self.waiting.clear()
        timestamp = round(frame.tick * self.tick_s * 1e6)
        self._link("sample", "sample", {"token": sample, "timestamp": timestamp, "scene_token": self.token()})
        points_on, echoes_of = Counter[int](), Counter[int]()
        for _, sensor in self.samples.values():
            if isinstance(sensor, LidarScan):
                points_on.update(sensor.points["object"].tolist())
            elif isinstance(sensor, RadarSample):
                echoes_of.update(sensor.detections["object_id"].tolist())
        shown = {int(state["vehicle"]) for state in frame.labelled()}
        for state in frame.states:
            vehicle = int(state["vehicle"])
            if vehicle != frame.carrier and (vehicle in shown or points_on[vehicle] or echoes_of[vehicle]):
                self._annotate(frame, state, sample, points_on[vehicle], echoes_of[vehicle])

    def _annotate(self, frame: Frame, state: np.void, sample: str, points: int, echoes: int) -> None:
        """Add the box of a road user in a key frame, and count it for its instance."""
        vehicle = int(state["vehicle"])
        name = category(state)
        # Numbers of vehicles are used again, ids are not.
        body = (state["id_hash"], *([place] if (place := vehicle >> BODY_SHIFT) else []))
        instance, row = self.token("instance", *body), self.token("box", sample, *body)
        world_from_box = upright_pose(state)
        centre = world_from_box @ (box_middle(state) + np.array([0, 0, float(state["height_m"]) / 2, 0]))
        self._link(
            "sample_annotation",
            f"instance {instance}",
            {
                "token": row,
                "sample_token": sample,
                "instance_token": instance,
                "visibility_token": _visibility(frame, vehicle),
                "attribute_tokens": [token(attribute(state, name))],
                "translation": [float(value) for value in centre[:3]],
                "size": [float(state[key]) for key in ("width_m", "length_m", "height_m")],
                "rotation": quaternion(world_from_box[:3, :3]),
                "num_lidar_pts": points,
                "num_radar_pts": echoes,
            },
        )
        of_instance = self.instances.setdefault(
            instance,
            {"token": instance, "category_token": token(name), "nbr_annotations": 0, "first_annotation_token": row},
        )
        of_instance |= {"nbr_annotations": of_instance["nbr_annotations"] + 1, "last_annotation_token": row}


def _placed(transform: Float64Array) -> Row:
    """A transform [4, 4] as the tables have it."""
    return {"translation": [float(value) for value in transform[:3, 3]], "rotation": quaternion(transform[:3, :3])}


def _world_from(sensor: SensorMessage) -> Float64Array:
    """f64 [4, 4]: from the frame that a sensor of this kind has in nuScenes."""
    if isinstance(sensor, CameraImage):
        return sensor.world_from_optical
    if isinstance(sensor, LidarScan):
        return sensor.world_from_sensor @ rotated(LIDAR_AXES)
    return sensor.world_from_sensor


def _coloured(delivered: DeliveredSensors, carrier: int) -> frozenset[SensorKey]:
    """The cameras of a carrier whose images have colours."""
    return frozenset(key for key in delivered.cameras(carrier) if "rgb" in delivered.of[carrier][key].planes)


def lacks(delivered: DeliveredSensors, carrier: int) -> list[Omission]:
    """A scene needs a LIDAR and a key frame; images have colours alone."""
    main, sensors = delivered.main_lidar(carrier), delivered.of[carrier]
    if main is None:
        return left_out(delivered, carrier, sensors, "its carrier has no LIDAR, which a scene needs")
    if delivered.ticks_with(carrier, {main} | _coloured(delivered, carrier)) == 0:
        reason = "its carrier has no tick with a scan of the main LIDAR and all images, which a key frame needs"
        return left_out(delivered, carrier, sensors, reason)
    return lack_colours(delivered, carrier)


def write_nuscenes(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode. Raises `RecordingError` if the recording has no `world`, no `pointcloud`, or no scan."""
    require_channels(recording, "world", "pointcloud")
    path.mkdir(parents=True)
    run = str(recording.start["run"])
    labels = SensorLabels(recording.run, sensor_channel, [LIDAR_CHANNEL])
    log = token(run, "log", episode.number)
    delivered = delivered_sensors(recording, episode)
    scenes: dict[int, _Scene] = {}
    for frame in frames(recording, episode, delivered):
        carrier = frame.carrier
        if delivered.main_lidar(carrier) is None:
            continue
        if carrier not in scenes:
            name = f"scene-{episode.number:05}-{carrier_name(carrier).removeprefix('vehicle_')}"
            cameras = _coloured(delivered, carrier)
            scenes[carrier] = _Scene(name, run, path, log, recording.tick_s, cameras, labels)
        scenes[carrier].add(frame)
    if not scenes:
        raise RecordingError(f"{recording.path}: no vehicle carries a LIDAR: set lidar.vehicles or suite")
    rows: dict[str, list[Row]] = {table: [] for table in TABLES}
    for scene in scenes.values():
        scene.finish()
        for table, added in scene.rows.items():
            rows[table] += added
    rows["log"].append(
        {"token": log, "logfile": run, "vehicle": "caraware", "date_captured": "", "location": run}
        | {"is_evaluation": episode.is_evaluation, "seed": episode.seed}
    )
    (path / "tables.json").write_text(json.dumps(rows), encoding="utf-8")


def join_parts(recording: Recording, directory: Path, parts: Sequence[str]) -> None:
    """Make the tables of the devkit of all parts, with the scenes of training and of evaluation as its splits."""
    tables: dict[str, list[Row]] = {table: [] for table in TABLES}
    splits: dict[str, list[str]] = {"training": [], "evaluation": []}
    for part in parts:
        rows: dict[str, list[Row]] = json.loads((directory / part / "tables.json").read_text(encoding="utf-8"))
        for row in rows["sample_data"]:
            row["filename"] = f"{part}/{row['filename']}"
        for table, added in rows.items():
            tables[table] += added
        is_evaluation = rows["log"][0]["is_evaluation"]
        splits["evaluation" if is_evaluation else "training"] += [scene["name"] for scene in rows["scene"]]
    attributes = sorted({name for names in ATTRIBUTES.values() for name in names})
    tables["category"] = [{"token": token(name), "name": name, "description": ""} for name in CATEGORIES]
    tables["attribute"] = [{"token": token(name), "name": name, "description": ""} for name in attributes]
    tables["visibility"] = [
        {"token": level, "level": name, "description": f"visibility {name[1:]} %"}
        for level, name in VISIBILITIES.items()
    ]
    channels = {LIDAR_CHANNEL, CAMERA_CHANNEL} | {Path(row["filename"]).parent.name for row in tables["sample_data"]}
    tables["sensor"] = [
        {"token": token(name), "channel": name, "modality": MODALITIES[name.split("_")[0]]}
        for name in sorted(channels, reverse=True)
    ]
    # The devkit wants a raster map; a recording has none, so it is one pixel of background.
    mask = f"{VERSION}/map.png"
    logs = [row["token"] for row in tables["log"]]
    tables["map"] = [
        {"token": token("map"), "log_tokens": logs, "category": "semantic_prior", "filename": mask},
    ]
    partial = directory / f".{VERSION}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    for table, whole in tables.items():
        (partial / f"{table}.json").write_text(json.dumps(whole), encoding="utf-8")
    (partial / "splits.json").write_text(json.dumps(splits), encoding="utf-8")
    Image.new("L", (1, 1)).save(partial / "map.png")
    shutil.rmtree(directory / VERSION, ignore_errors=True)
    os.replace(partial, directory / VERSION)
