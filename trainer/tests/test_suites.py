"""Suites in recordings: exports place every camera by its mount, and messages name carrier and sensor."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from caraware.data import open_recording
from caraware.data.export.kitti import write_kitti
from caraware.data.export.nuscenes import join_parts, write_nuscenes
from caraware.ipc.arrays import Float64Array
from caraware.ipc.image import IMAGE
from caraware.ipc.mounts import ROADSIDE, SensorNames
from recorded_run import recorded_run

SENSORS = """
[[suite]]
name = "pair"
ids = ["cav.*"]
first = 1

[[suite.sensor]]
kind = "lidar"
name = "top"
mount = [1.0, 0.0, 2.0, 0.0, 0.0, 0.0]
channels = 16
points_per_second = 57600
rolling_shutter = false

[[suite.sensor]]
kind = "camera"
name = "image_2"
mount = [1.5, 0.25, 1.6, 0.0, 0.0, 0.0]
width = 160
height = 80
rgb = true

[[suite.sensor]]
kind = "camera"
name = "image_3"
mount = [1.4, -0.35, 1.5, 0.0, 0.1, -0.3]
width = 120
height = 60
rgb = true

[[roadside]]
name = "mast"
suite = "pair"
x_m = 120.0
y_m = 120.0
"""
"""A pair of cameras of which one looks to the right and up, so no symmetry hides a sign; and a mast with the same."""

SETTINGS = {
    "traffic.cavs": 4,
    "traffic.others": 20,
    "episode.ticks": 60,
    "episode.training_episodes": 1,
    "fanout.enabled": "false",
    "run.real_time_factor": 4,
    "record.channels": '["world", "observation", "pointcloud", "image", "traffic-meta"]',
}


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    config = tmp_path_factory.mktemp("config") / "pair.toml"
    config.write_text(SENSORS)
    with recorded_run("simulate", SETTINGS, preset=str(config)) as found:
        yield found


def test_messages_name_their_carrier_and_their_sensor(run_dir: Path) -> None:
    recording = open_recording(run_dir)
    names = SensorNames(recording.run)
    seen = set()
    for message in recording.messages("image"):
        head = message.section("head")[0]
        mounted = names.of("camera", head)
        assert mounted.is_roadside == bool(int(head["vehicle"]) & ROADSIDE) == (mounted.carrier == "mast")
        assert int(head["width"]) == {"image_2": 160, "image_3": 120}[mounted.sensor]
        seen.add((mounted.carrier, mounted.suite, mounted.sensor))
    assert {("mast", "pair", "image_2"), ("mast", "pair", "image_3")} < seen
    carriers = {carrier for carrier, _, _ in seen} - {"mast"}
    assert carriers and all(carrier.startswith("cav.") for carrier in carriers)
    unnamed = names.of("camera", np.zeros(1, IMAGE)[0])
    assert (unnamed.suite, unnamed.sensor) == ("", "camera")


def camera_from_vehicle(mount: list[float]) -> Float64Array:
    """f64 [4, 4]: KITTI's frame of a camera from that of its vehicle, from the mount by hand."""
    x, y, z, roll, pitch, yaw = mount
    assert roll == 0
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    left = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    rows = np.stack((-left, -np.cross(ahead, left), ahead))
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rows, -rows @ np.array([x, y, z])
    return transform


def intrinsic(width: int, height: int) -> Float64Array:
    """f64 [3, 3]: the pinhole of a camera with a field of view of 90°."""
    return np.array([[width / 2, 0, (width - 1) / 2], [0, width / 2, (height - 1) / 2], [0, 0, 1]])


def test_kitti_has_both_cameras_with_their_mounts(run_dir: Path, tmp_path: Path) -> None:
    recording = open_recording(run_dir)
    write_kitti(recording, next(iter(recording.episodes())), tmp_path / "part")
    (carrier,) = (tmp_path / "part").iterdir()
    training = carrier / "training"
    files = {
        folder: sorted(file.stem for file in (training / folder).iterdir())
        for folder in ("image_2", "image_3", "calib")
    }
    assert len(files["calib"]) > 10 and files["image_2"] == files["image_3"] == files["calib"]
    left, right = (camera_from_vehicle(mount) for mount in ([1.5, 0.25, 1.6, 0, 0, 0], [1.4, -0.35, 1.5, 0, 0.1, -0.3]))
    for name in files["calib"][:5]:
        lines = (line.split(": ") for line in (training / "calib" / f"{name}.txt").read_text().splitlines())
        rows = {key: np.array([float(value) for value in values.split()]) for key, values in lines}
        # Camera 2 is the reference, for there is no camera 0.
        np.testing.assert_allclose(rows["P2"].reshape(3, 4), np.c_[intrinsic(160, 80), np.zeros(3)], atol=1e-4)
        expected = intrinsic(120, 60) @ (right @ np.linalg.inv(left))[:3]
        np.testing.assert_allclose(rows["P3"].reshape(3, 4), expected, atol=1e-4)
        np.testing.assert_allclose(rows["Tr_imu_to_velo"].reshape(3, 4)[:, 3], [-1, 0, -2], atol=1e-6)


def test_nuscenes_has_a_channel_for_each_camera(run_dir: Path, tmp_path: Path) -> None:
    recording = open_recording(run_dir)
    write_nuscenes(recording, next(iter(recording.episodes())), tmp_path / "part")
    join_parts(recording, tmp_path, ["part"])
    tables = {
        table: json.loads((tmp_path / "v1.0-caraware" / f"{table}.json").read_text())
        for table in ("sensor", "calibrated_sensor", "sample", "sample_data")
    }
    channels = {row["token"]: row["channel"] for row in tables["sensor"]}
    assert {"LIDAR_TOP", "CAM_IMAGE_2", "CAM_IMAGE_3"} <= set(channels.values())
    places = {channels[row["sensor_token"]]: row["translation"] for row in tables["calibrated_sensor"]}
    for channel, place in (
        ("CAM_IMAGE_2", [1.5, 0.25, 1.6]),
        ("CAM_IMAGE_3", [1.4, -0.35, 1.5]),
        ("LIDAR_TOP", [1, 0, 2]),
    ):
        np.testing.assert_allclose(places[channel], place, atol=1e-3)
    keys = [row for row in tables["sample_data"] if row["is_key_frame"]]
    assert tables["sample"] and len(keys) == 3 * len(tables["sample"])
