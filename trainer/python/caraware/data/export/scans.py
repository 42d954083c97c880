"""What the formats with points and images share: poses as matrices, boxes, the camera's frame."""

from __future__ import annotations

import numpy as np

from caraware.data.names import Kind
from caraware.data.recording import Array, Recording, RecordingError
from caraware.ipc.arrays import Float64Array
from caraware.ipc.pointcloud import rotation

OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""KITTI's camera frame from ours (x along the optical axis, y left, z up)."""


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


def box_middle(state: np.void) -> Float64Array:
    """f64 [4]: the middle of the lower face of a road user's box (`upright_pose`); of a person its place."""
    ahead_m = 0.0
    if state["kind"] != Kind.PERSON:
        ahead_m = float(state["length_m"]) / 2 - float(state["rear_overhang_m"])
    return np.array([ahead_m, 0.0, 0.0, 1.0])


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


def distortion(head: np.void) -> list[float]:
    """The lens of an image: k1, k2, p1, p2, k3 of Brown's model, which ROS and Foxglove call "plumb_bob"."""
    return [float(part) for part in head["distortion"]]


def undistorted_projection(head: np.void) -> Float64Array:
    """As `projection`, for formats of images without distortion. Raises `RecordingError` of a camera with a lens."""
    if any(distortion(head)):
        raise RecordingError(
            "this format holds images without lens distortion, but a recorded camera has a lens: record it with "
            "camera.distortion = [0.0, 0.0, 0.0, 0.0, 0.0], or export to ros2 or foxglove, which name the lens"
        )
    return projection(head)


def projection(head: np.void) -> Float64Array:
    """f64 [3, 4]: the pinhole of an image (docs/camera.md), without its lens."""
    focal, width, height = float(head["focal_px"]), int(head["width"]), int(head["height"])
    return np.array([[focal, 0, (width - 1) / 2, 0], [0, focal, (height - 1) / 2, 0], [0, 0, 1, 0]])
