"""What the formats with LIDAR points share: frames of a carrier, poses as matrices, the camera's frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caraware.data.names import Kind
from caraware.data.recording import Array, Episode, Message, Recording, RecordingError
from caraware.ipc.arrays import Float64Array
from caraware.ipc.image import split_planes
from caraware.ipc.mounts import ROADSIDE, SensorNames, sensor_number
from caraware.ipc.pointcloud import rotation

OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""KITTI's camera frame from ours (x along the optical axis, y left, z up)."""

MOST_TICKS_APART = 256
"""A message that waits for another one of its tick is dropped after so many ticks."""


def require_channels(recording: Recording, *channels: str) -> None:
    """Raise `RecordingError` if the recording lacks one of these channels."""
    for channel in channels:
        if channel not in recording.channels:
            raise RecordingError(f"{recording.path} has no channel {channel!r}: record it with record.channels")


def forward_m(scan: np.void, points: Array) -> Array:
    """f32 [count, 3]: points (m) in the sensor's frame with x forward, y left and z up, whatever `lidar.axes` is."""
    position_m: Array = points["position_m"]
    if scan["axes"] == 1:  # the paper's: y backward, x left, z down
        position_m = np.stack((-position_m[:, 1], position_m[:, 0], -position_m[:, 2]), 1)
    return position_m


@dataclass(frozen=True)
class CameraImage:
    """An image of a frame."""

    camera: str
    """Name of the camera."""
    message: Message

    @property
    def head(self) -> np.void:
        """The camera (`ImageHead`)."""
        head: np.void = self.message.section("head")[0]
        return head

    @property
    def rgb(self) -> Array | None:
        """u8 [height, width, 3]; None if colours are not recorded."""
        return split_planes(self.head, self.message.section("planes").tobytes())["rgb"]

    @property
    def world_from_camera(self) -> Float64Array:
        """f64 [4, 4]: from x along the optical axis, y left, z up."""
        return pose(self.head["position_m"], self.head["attitude_rad"])

    @property
    def seen(self) -> dict[int, np.void]:
        """`SeenObject` by number: the road users of which the image shows a pixel."""
        return {int(user["object"]): user for user in self.message.section("objects")}


@dataclass(frozen=True)
class Frame:
    """What belongs to one frame of one carrier."""

    scan: Message
    """Of its first LIDAR."""
    states: Array
    """All road users (`VehicleState`)."""
    images: tuple[CameraImage, ...]
    """One of each of its cameras, in the order of their numbers; the first is the main one. Empty without a camera."""

    @property
    def carrier(self) -> int:
        """Number of the carrier within the episode."""
        return int(self.head["vehicle"])

    @property
    def head(self) -> np.void:
        """The LIDAR (`Scan`)."""
        head: np.void = self.scan.section("scan")[0]
        return head

    @property
    def points(self) -> Array:
        """`LidarPoint [count]`."""
        return self.scan.section("points")

    @property
    def own(self) -> np.void:
        """The state of the carrier."""
        own: np.void = self.states[self.states["vehicle"] == self.head["vehicle"]][0]
        return own

    @property
    def world_from_lidar(self) -> Float64Array:
        """f64 [4, 4]: from x forward, y left, z up."""
        return pose(self.head["position_m"], self.head["attitude_rad"])

    @property
    def seen(self) -> dict[int, np.void]:
        """`SeenObject` by number: the road users of which the main image shows a pixel."""
        return self.images[0].seen if self.images else {}

    def labelled(self) -> list[np.void]:
        """The states of all other road users with a point of the LIDAR, or with a pixel of an image."""
        shown = set(np.unique(self.points["object"]).tolist()).union(*(image.seen for image in self.images))
        return [s for s in self.states if s["vehicle"] != self.head["vehicle"] and int(s["vehicle"]) in shown]


def box_middle(state: np.void) -> Float64Array:
    """f64 [4]: the middle of the lower face of a road user's box (`upright_pose`); of a person its place."""
    ahead_m = 0.0
    if state["kind"] != Kind.PERSON:
        ahead_m = float(state["length_m"]) / 2 - float(state["rear_overhang_m"])
    return np.array([ahead_m, 0.0, 0.0, 1.0])


def class_by_size(state: np.void) -> str:
    """SUMO's class of a vehicle whose class is not recorded, by the sizes that cameras go by."""
    if state["width_m"] < 1.1:
        return "bicycle" if state["length_m"] < 1.9 else "motorcycle"
    if state["length_m"] >= 10 and state["height_m"] < 3.7:
        return "bus"
    return "truck" if state["length_m"] > 6 or state["height_m"] > 2.1 else "passenger"


def pose(position_m: Array, attitude_rad: Array) -> Float64Array:
    """f64 [4, 4]: world from a frame at this position (m) with this roll, pitch and heading (rad)."""
    transform = rotated(rotation(*(float(angle) for angle in attitude_rad)))
    transform[:3, 3] = position_m
    return transform


def vehicle_pose(state: np.void) -> Float64Array:
    """f64 [4, 4]: world from the frame of a road user."""
    position_m = np.array([state["x_m"], state["y_m"], state["z_m"]])
    return pose(position_m, np.array([state["roll_rad"], state["pitch_rad"], state["yaw_rad"]]))


def upright_pose(state: np.void) -> Float64Array:
    """f64 [4, 4]: world from the box of a road user, which LIDARs and cameras see upright whatever its tilt is."""
    return pose(np.array([state["x_m"], state["y_m"], state["z_m"]]), np.array([0.0, 0.0, state["yaw_rad"]]))


def rotated(matrix: Float64Array) -> Float64Array:
    """f64 [4, 4]: a rotation as a transform."""
    transform = np.eye(4)
    transform[:3, :3] = matrix
    return transform


def inverse(transform: Float64Array) -> Float64Array:
    """The inverse of a rigid transform [4, 4]."""
    inverse = rotated(transform[:3, :3].T)
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


def quaternion(rotation: Float64Array) -> list[float]:
    """w, x, y, z of a rotation [3, 3], with w ≥ 0."""
    # The eigenvector of the largest eigenvalue (Bar-Itzhack 2000): no case distinction, exact for rotations.
    m = rotation
    symmetric = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    vector = np.linalg.eigh(symmetric)[1][:, -1]
    return [float(value) for value in (vector if vector[0] >= 0 else -vector)]


def projection(head: np.void) -> Float64Array:
    """f64 [3, 4]: the pinhole of an image (docs/camera.md)."""
    focal, width, height = float(head["focal_px"]), int(head["width"]), int(head["height"])
    return np.array([[focal, 0, (width - 1) / 2, 0], [0, focal, (height - 1) / 2, 0], [0, 0, 1, 0]])


MAIN_CAMERAS = ("image_2", "CAM_FRONT")
"""Names of cameras of ready-made suites that are the main ones of their carriers; of other suites it is the first."""


@dataclass(frozen=True)
class FrameMessage:
    """A scan or an image, and what it belongs to."""

    vehicle: int
    tick: int
    sensor: int


def sender(message: Message) -> FrameMessage:
    """Carrier, tick and number of the LIDAR or camera of a message."""
    head = message.section("scan" if message.channel == "pointcloud" else "head")[0]
    return FrameMessage(int(head["vehicle"]), message.tick, sensor_number(head))


def filmed(recording: Recording, episode: Episode) -> dict[tuple[int, int], set[int]]:
    """Numbers of the cameras with recorded images of an episode, by vehicle and tick; without those beside the road."""
    cameras: dict[tuple[int, int], set[int]] = {}
    for message in recording.messages("image") if "image" in recording.channels else ():
        image = sender(message)
        if int(message.header["episode"]) == episode.number and not image.vehicle & ROADSIDE:
            cameras.setdefault((image.vehicle, image.tick), set()).add(image.sensor)
    return cameras


def _images(messages: dict[int, Message], names: SensorNames) -> tuple[CameraImage, ...]:
    """The images of a carrier at a tick, by number: the main one first."""
    in_order = [messages[number] for number in sorted(messages)]
    images = [CameraImage(names.of("camera", m.section("head")[0]).sensor, m) for m in in_order]
    return tuple(sorted(images, key=lambda image: image.camera not in MAIN_CAMERAS))


def frames(recording: Recording, episode: Episode, *, every_scan: bool = False) -> Iterator[Frame]:
    """The frames of one episode, each as soon as its messages are there; of one carrier in the order of ticks.

    A frame has the scan of the carrier's first LIDAR and an image of each of its cameras. Of a carrier with cameras
    only scans with all images of the same tick are frames, unless `every_scan` is asked for: a recorder misses images,
    and a camera may be slower. Carriers beside the road have none. Raises `RecordingError` without `world` or
    `pointcloud`.
    """
    require_channels(recording, "world", "pointcloud")
    channels = ["world", "pointcloud", *(["image"] if "image" in recording.channels else [])]
    with_image, names = filmed(recording, episode), SensorNames(recording.run)
    cameras: dict[int, set[int]] = {}
    for (vehicle, _), numbers in with_image.items():
        cameras.setdefault(vehicle, set()).update(numbers)
    states: dict[int, Array] = {}
    scans: dict[tuple[int, int], Message] = {}
    first_lidar: dict[int, int] = {}
    images: dict[tuple[int, int], dict[int, Message]] = {}
    for message in recording.messages(*channels):
        if int(message.header["episode"]) != episode.number:
            continue
        # Put it beside what waits for it.
        if message.channel == "world":
            states[message.tick] = message.section("states")
            due = [key for key in scans if key[1] == message.tick]
        else:
            by = sender(message)
            key = (by.vehicle, by.tick)
            if by.vehicle & ROADSIDE:
                continue
            if message.channel == "pointcloud":
                # The first LIDAR of a carrier sends before its others.
                is_first = first_lidar.setdefault(by.vehicle, by.sensor) == by.sensor
                is_whole = every_scan or cameras.get(by.vehicle, set()) == with_image.get(key, set())
                if not is_first or not is_whole:
                    continue
                scans[key] = message
            else:
                images.setdefault(key, {})[by.sensor] = message
            due = [key]
        # Give the frames that are complete now.
        for key in due:
            if key in scans and key[1] in states and set(images.get(key, {})) == with_image.get(key, set()):
                yield Frame(scans.pop(key), states[key[1]], _images(images.pop(key, {}), names))
        for old in [tick for tick in states if tick < message.tick - MOST_TICKS_APART]:
            del states[old]
        for waiting in (scans, images):
            for key in [key for key in waiting if key[1] < message.tick - MOST_TICKS_APART]:
                del waiting[key]
