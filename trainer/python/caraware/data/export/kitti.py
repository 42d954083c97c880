"""KITTI: points, calibration, labels and images of each carrier of a LIDAR, in the layout of the object benchmark.

A part is a directory of one episode with a directory for each carrier, in which `training/` is as KITTI's. A carrier
has the points of its main LIDAR and at most four cameras; the format has no place for more, nor for radars. Frames are
numbered by ticks. The camera's frame is KITTI's: x right, y down, z forward; without a camera it is at the LIDAR.
Places of sensors are those of their mounts.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from caraware.data.export.frames import (
    CameraImage,
    DeliveredSensors,
    Frame,
    LidarScan,
    SensorKey,
    delivered_sensors,
    frames,
)
from caraware.data.export.oxts import Geodesy, packet
from caraware.data.export.scans import (
    OPTICAL,
    box_middle,
    inverse,
    require_channels,
    rotated,
    undistorted_projection,
    upright_pose,
    vehicle_pose,
)
from caraware.data.export.sensors import Omission, carrier_name, lack_colours, left_out, left_out_without
from caraware.data.names import Kind, vehicle_class
from caraware.data.recording import Episode, Recording, RecordingError
from caraware.ipc.arrays import Float64Array

CLASSES = {
    "Van": ("delivery",),
    "Truck": ("truck", "trailer"),
    "Tram": ("tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car"),
    "Cyclist": ("bicycle",),
    "Pedestrian": ("pedestrian", "wheelchair"),
    "Misc": ("bus", "coach", "motorcycle", "moped", "scooter", "ship", "container", "aircraft", "drone"),
}
"""KITTI's classes by SUMO's; the classes that are missing are cars. Trailers are `Misc`, as there."""

LARGELY_HIDDEN, PARTLY_HIDDEN = 0.25, 0.6
"""Share of the pixels of a road user's box that show it, below which KITTI's `occluded` is 2 and 1."""


CAMERA_NUMBERS = (2, 3, 0, 1)
"""Numbers of a carrier's cameras, the main one first, unless they are named `image_0` to `image_3` as KITTI's are."""


def camera_numbers(names: Sequence[str]) -> dict[int, int]:
    """KITTI's numbers of cameras with these names, the main one first: at most four, with their places in `names`."""
    named = {int(name[-1]): place for place, name in enumerate(names) if re.fullmatch("image_[0-3]", name)}
    return named if len(named) == len(names) else dict(zip(CAMERA_NUMBERS, range(len(names)), strict=False))


def numbered(images: Sequence[CameraImage]) -> dict[int, CameraImage]:
    """The images of a frame by KITTI's numbers of cameras."""
    places = camera_numbers([image.mounted.sensor for image in images])
    return {number: images[place] for number, place in places.items()}


def _exported_cameras(delivered: DeliveredSensors, carrier: int) -> list[SensorKey]:
    """The cameras of a carrier for which KITTI has a place, the main one first."""
    cameras = delivered.cameras(carrier)
    places = camera_numbers([delivered.of[carrier][key].mounted.sensor for key in cameras]).values()
    return [key for place, key in enumerate(cameras) if place in places]


def lacks(delivered: DeliveredSensors, carrier: int) -> list[Omission]:
    """KITTI has a place for one LIDAR and four cameras of a carrier, and for the colours of images."""
    main, cameras = delivered.main_lidar(carrier), _exported_cameras(delivered, carrier)
    if main is None:
        return left_out(delivered, carrier, delivered.of[carrier], "its carrier has no LIDAR, which a frame needs")
    others = {kind: [key for key in delivered.of[carrier] if key[0] == kind] for kind in ("lidar", "camera", "radar")}
    lidars, more = ([key for key in others[kind] if key not in (main, *cameras)] for kind in ("lidar", "camera"))
    return [
        *(one for one in lack_colours(delivered, carrier) if one.sensor in cameras),
        *left_out(delivered, carrier, lidars, "KITTI has a place for one LIDAR, which is the main one of its carrier"),
        *left_out(delivered, carrier, more, "KITTI has a place for four cameras"),
        *left_out(delivered, carrier, others["radar"], "KITTI has no place for radars"),
        *left_out_without(
            delivered, carrier, [main, *cameras], [main, *cameras], "a frame needs a scan and all images of its tick"
        ),
    ]


@dataclass(frozen=True)
class _KittiFrame:
    """A frame that has the sensors for which KITTI has a place, and no others."""

    frame: Frame
    scan: LidarScan

    @property
    def images(self) -> tuple[CameraImage, ...]:
        return self.frame.images


def _kitti_frames(recording: Recording, episode: Episode) -> Iterator[_KittiFrame]:
    """Scans of main LIDARs. Of a carrier with cameras only those with all images of their tick: some are missed."""
    delivered = delivered_sensors(recording, episode)
    for frame in frames(recording, episode, delivered):
        cameras = _exported_cameras(delivered, frame.carrier)
        images = tuple(image for image in frame.images if image.key in cameras)
        if frame.main is not None and len(images) == len(cameras):
            yield _KittiFrame(replace(frame, other_scans=(), images=images, radars=()), frame.main)


@dataclass(frozen=True)
class Calibration:
    """The sensors of one frame. The camera's frame is that of camera 0, or of the main one without a camera 0."""

    projections: tuple[Float64Array, ...]
    """Four of f64 [3, 4]: pixels of homogeneous points in the camera's frame; pixel centres have whole numbers."""
    camera_from_world: Float64Array
    """f64 [3, 4]."""
    camera_from_lidar: Float64Array
    """f64 [3, 4]."""
    lidar_from_vehicle: Float64Array
    """f64 [3, 4], from the carrier's frame: x forward of the rear axle's centre on the ground, y left, z up."""

    @classmethod
    def of(cls, kitti: _KittiFrame) -> Calibration:
        """From the poses that the messages hold: those of the mounted sensors at the tick."""
        lidar, cameras = kitti.scan.world_from_sensor, numbered(kitti.images)
        main = kitti.images[0] if kitti.images else None
        reference = cameras.get(0, main)
        world_from_camera = lidar if reference is None else reference.world_from_sensor
        camera_from_world = rotated(OPTICAL) @ inverse(world_from_camera)
        world_from_reference = inverse(camera_from_world)

        def projected(image: CameraImage | None) -> Float64Array:
            if image is None:
                return np.eye(3, 4)
            if image is reference:
                return undistorted_projection(image.head)
            own_from_reference = rotated(OPTICAL) @ inverse(image.world_from_sensor) @ world_from_reference
            matrix: Float64Array = undistorted_projection(image.head) @ own_from_reference
            return matrix

        return cls(
            tuple(projected(cameras.get(number, main)) for number in range(4)),
            camera_from_world[:3],
            (camera_from_world @ lidar)[:3],
            (inverse(lidar) @ vehicle_pose(kitti.frame.own))[:3],
        )

    def text(self) -> str:
        """The file of `calib/`: a camera that the carrier lacks has the projection of the main one."""
        matrices = [(f"P{number}", matrix) for number, matrix in enumerate(self.projections)]
        matrices += [
            ("R0_rect", np.eye(3)),
            ("Tr_velo_to_cam", self.camera_from_lidar),
            ("Tr_imu_to_velo", self.lidar_from_vehicle),
        ]
        return "".join(f"{name}: {' '.join(f'{value:.12e}' for value in rows.ravel())}\n" for name, rows in matrices)


def kitti_class(state: np.void) -> str:
    """KITTI's class of a road user, from SUMO's."""
    if state["kind"] == Kind.PERSON:
        return "Pedestrian"
    of_sumo = vehicle_class(state)
    if of_sumo in CLASSES["Truck"] and state["kind"] == Kind.TRAILING:
        return "Misc"
    return next((name for name, classes in CLASSES.items() if of_sumo in classes), "Car")


def _place(state: np.void, camera_from_world: Float64Array) -> tuple[Float64Array, float]:
    """Middle of a box's lower face (m) and `rotation_y` (rad), both in the camera's frame."""
    in_camera = camera_from_world @ upright_pose(state)
    heading = in_camera[:, 0]
    return in_camera @ box_middle(state), float(np.arctan2(-heading[2], heading[0]))


def _image_part(seen: np.void, head: np.void) -> tuple[str, str]:
    """`truncated` and `occluded`, and the box (pixels) of a road user in an image; the box ends with the image."""
    last = np.array([head["width"], head["height"], head["width"], head["height"]], np.float64) - 1
    # Recorded from the upper left corner of the image; KITTI counts from the middle of the first pixel.
    left, top, right, bottom = np.clip(seen["full_box_px"].astype(np.float64) - 0.5, 0, last)
    share = float(seen["visible_px"]) / ((right - left + 1) * (bottom - top + 1))
    occluded = 0 if share >= PARTLY_HIDDEN else 1 if share >= LARGELY_HIDDEN else 2
    truncated = min(max(float(seen["truncated"]), 0.0), 1.0)
    return f"{truncated:.2f} {occluded}", f"{left:.2f} {top:.2f} {right:.2f} {bottom:.2f}"


def _labels(kitti: _KittiFrame, calibration: Calibration) -> str:
    """The file of `label_2/`: each road user with a point of the LIDAR or a pixel of an image; boxes of `image_2`."""
    boxes = numbered(kitti.images).get(2)
    seen, head = ({}, None) if boxes is None else (boxes.seen, boxes.head)
    lines = []
    for state in kitti.frame.labelled():
        vehicle = int(state["vehicle"])
        (x, y, z), rotation_y = _place(state, calibration.camera_from_world)
        alpha = float(np.mod(rotation_y - np.arctan2(x, z) + np.pi, 2 * np.pi) - np.pi)
        name = kitti_class(state)
        hidden, box = "-1 3", "-1 -1 -1 -1"
        if head is not None and vehicle in seen:
            hidden, box = _image_part(seen[vehicle], head)
        size = " ".join(f"{float(state[key]):.4f}" for key in ("height_m", "width_m", "length_m"))
        lines.append(f"{name} {hidden} {alpha:.4f} {box} {size} {x:.4f} {y:.4f} {z:.4f} {rotation_y:.4f}\n")
    return "".join(lines)


def write_kitti(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode. Raises `RecordingError` if the recording has no `world`, no `pointcloud`, or no scan."""
    require_channels(recording, "world", "pointcloud")
    path.mkdir(parents=True)
    geodesy = Geodesy(recording)
    for kitti in _kitti_frames(recording, episode):
        carrier = path / carrier_name(kitti.frame.carrier).removeprefix("vehicle_")
        _write_frame(carrier, kitti)
        line = packet(kitti.frame.own, geodesy)
        (carrier / "training" / "oxts" / f"{kitti.frame.tick:06}.txt").write_text(line, encoding="utf-8")
    if not any(path.iterdir()):
        raise RecordingError(f"{recording.path}: no vehicle carries a LIDAR: set lidar.vehicles or suite")
    for carrier in path.iterdir():
        names = sorted(file.stem for file in (carrier / "training" / "velodyne").iterdir())
        sets = carrier / "ImageSets"
        sets.mkdir()
        (sets / "train.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
        # As KITTI's odometry benchmark has it: seconds, a line for each frame.
        times = "".join(f"{int(name) * recording.tick_s:e}\n" for name in names)
        (carrier / "training" / "times.txt").write_text(times, encoding="utf-8")


def _write_frame(carrier: Path, kitti: _KittiFrame) -> None:
    training, name = carrier / "training", f"{kitti.frame.tick:06}"
    images = numbered(kitti.images)
    for folder in ("velodyne", "calib", "label_2", "oxts", *(f"image_{number}" for number in images)):
        (training / folder).mkdir(parents=True, exist_ok=True)
    rows = np.concatenate((kitti.scan.forward_m, kitti.scan.points["intensity"][:, None]), 1).astype("<f4")
    (training / "velodyne" / f"{name}.bin").write_bytes(rows.tobytes())
    calibration = Calibration.of(kitti)
    (training / "calib" / f"{name}.txt").write_text(calibration.text(), encoding="utf-8")
    (training / "label_2" / f"{name}.txt").write_text(_labels(kitti, calibration), encoding="utf-8")
    for number, image in images.items():
        if (rgb := image.rgb) is not None:
            Image.fromarray(rgb).save(training / f"image_{number}" / f"{name}.png")
