"""Suites in recordings: exports have every sensor that their format has a place for, at its mount, and name the others.

Each export is opened by the format's own reader, and its values are compared with the recorded messages.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import yaml
from caraware.data import Recording, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.nuscenes import sensor_channel
from caraware.data.export.opv2v import world_from_pose
from caraware.data.export.sensors import SensorLabels
from caraware.data.recording import Array
from caraware.ipc.arrays import Float64Array
from caraware.ipc.image import IMAGE, split_planes
from caraware.ipc.mounts import ROADSIDE, SensorNames
from caraware.ipc.pointcloud import rotation
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud, RadarPointCloud
from PIL import Image
from pyquaternion import Quaternion
from recorded_run import in_world_m, recorded_run, unseen
from rerun.chunk import McapReader
from stream_readers import ReadStream, by_rosbags, read_foxglove, read_ros

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
kind = "lidar"
name = "side"
mount = [0.3, 0.9, 1.2, 0.0, 0.05, 1.3]
channels = 8
points_per_second = 14400
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
period_ticks = 2

[[suite.sensor]]
kind = "radar"
name = "RADAR_FRONT"
mount = [3.4, 0.3, 0.5, 0.0, 0.0, 0.2]

[[suite.sensor]]
kind = "radar"
name = "back left"
mount = [-0.5, 0.6, 0.6, 0.0, 0.0, 2.7]

[[roadside]]
name = "mast"
suite = "pair"
x_m = 120.0
y_m = 140.0
yaw_deg = 35.0
"""
"""Two LIDARs, two cameras and two radars, none in the middle or straight ahead but the first: no symmetry hides a sign.

A mast, which is turned, carries the same.
"""

MOUNTS = {
    "top": (1.0, 0.0, 2.0, 0.0, 0.0, 0.0),
    "side": (0.3, 0.9, 1.2, 0.0, 0.05, 1.3),
    "image_2": (1.5, 0.25, 1.6, 0.0, 0.0, 0.0),
    "image_3": (1.4, -0.35, 1.5, 0.0, 0.1, -0.3),
    "RADAR_FRONT": (3.4, 0.3, 0.5, 0.0, 0.0, 0.2),
    "back left": (-0.5, 0.6, 0.6, 0.0, 0.0, 2.7),
}
MAST = (120.0, 140.0, math.radians(35))
"""x, y (m) and heading (rad)."""

SETTINGS = {
    # With this seed the carrier drives and turns all the time.
    "run.seed": 3,
    "traffic.cavs": 4,
    "traffic.others": 20,
    "episode.ticks": 60,
    "episode.training_episodes": 1,
    "fanout.enabled": "false",
    "run.real_time_factor": 4,
    "record.channels": '["world", "observation", "pointcloud", "image", "radar", "traffic-meta"]',
}


@dataclass(frozen=True)
class RecordedSample:
    """A message of a sensor, and what it says in the world."""

    head: np.void
    rows: Array
    """Points, detections or nothing."""
    own_m: Float64Array
    """f64 [count, 3]: points or detections in the sensor's frame, x forward."""
    planes: dict[str, Any]
    """Of an image."""
    time_s: float
    """Simulated, since the start of the episode, at the end of the tick."""

    @property
    def world_m(self) -> Float64Array:
        """f64 [count, 3]."""
        return in_world_m(self.head, self.own_m)


Samples = dict[tuple[int, str, int], RecordedSample]
"""By carrier, name of the sensor and tick."""


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    config = tmp_path_factory.mktemp("config") / "pair.toml"
    config.write_text(SENSORS)
    with recorded_run("simulate", SETTINGS, preset=str(config)) as found:
        yield found


@pytest.fixture(scope="module")
def recording(run_dir: Path) -> Recording:
    return open_recording(run_dir)


@pytest.fixture(scope="module")
def samples(recording: Recording) -> Samples:
    names, found = SensorNames(recording.run), Samples()
    for message in recording.messages("pointcloud", "image", "radar"):
        kind = {"pointcloud": "lidar", "image": "camera", "radar": "radar"}[message.channel]
        head = message.section("head" if kind == "camera" else "scan")[0]
        rows: Array = np.empty(0)
        own_m, planes = np.empty((0, 3)), dict[str, Any]()
        if kind == "lidar":
            rows = message.section("points")
            assert head["axes"] == 0
            own_m = rows["position_m"].astype(np.float64)
        elif kind == "radar":
            rows = message.section("detections")
            azimuth, elevation = rows["azimuth_rad"].astype(np.float64), rows["elevation_rad"].astype(np.float64)
            ray = (np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation))
            own_m = np.stack(ray, 1) * rows["distance_m"].astype(np.float64)[:, None]
        else:
            planes = split_planes(head, message.section("planes").tobytes())
        key = int(head["vehicle"]), names.of(kind, head).sensor, message.tick
        found[key] = RecordedSample(head, rows, own_m, planes, float(message.header["sim_time_ns"]) * 1e-9)
    # Each sensor of both carriers has delivered.
    carriers = {carrier for carrier, _, _ in found}
    assert ROADSIDE in carriers and len(carriers) >= 2
    assert {(carrier, name) for carrier, name, _ in found} == {(c, name) for c in carriers for name in MOUNTS}
    return found


@pytest.fixture(scope="module")
def worlds(recording: Recording) -> dict[int, Array]:
    """`VehicleState [count]` by tick."""
    return {message.tick: message.section("states") for message in recording.messages("world")}


def mount(name: str) -> Float64Array:
    """f64 [4, 4]: carrier from sensor, by the configuration."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation(*MOUNTS[name][3:]), MOUNTS[name][:3]
    return transform


def exported(run_dir: Path, name: str, directory: Path) -> tuple[str, list[str]]:
    """Export the run: the data card, and the sentences about what is left out, which the card has too."""
    lines: list[str] = []
    assert export(run_dir, name, directory, 1, unseen, lines.append) == 1
    card = (directory / "README.md").read_text()
    left_out = [line.removeprefix("left out: ") for line in lines]
    assert all(f"- {line}\n" in card for line in left_out)
    for words in ("| radar | pair | back left | -0.5, 0.6, 0.6 | 0, 0, 2.7 | 1 |", "| `roadside_0` | mast | pair |"):
        assert words in card, words
    return card, left_out


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


def test_kitti_has_both_cameras_with_their_mounts_and_the_mast(run_dir: Path, samples: Samples, tmp_path: Path) -> None:
    _, left_out = exported(run_dir, "kitti", tmp_path)
    assert [line.split(": ")[0] for line in left_out if "no place" in line or "place for one" in line] == [
        "LIDAR `side` of suite `pair`",
        "radar `RADAR_FRONT` of suite `pair`",
        "radar `back left` of suite `pair`",
    ]
    assert all("mast" in line and "cav." in line for line in left_out)
    carriers = sorted((tmp_path / "episode-00000.kitti").iterdir())
    assert carriers[-1].name == "roadside_0" and all(carrier.name.isdigit() for carrier in carriers[:-1])
    left, right = (camera_from_vehicle(list(MOUNTS[name])) for name in ("image_2", "image_3"))
    for carrier in carriers:
        training = carrier / "training"
        files = {
            folder: sorted(file.stem for file in (training / folder).iterdir())
            for folder in ("image_2", "image_3", "calib", "oxts")
        }
        assert len(files["calib"]) > 10
        assert files["image_2"] == files["image_3"] == files["calib"] == files["oxts"]
        number = ROADSIDE if carrier.name == "roadside_0" else int(carrier.name)
        for name in files["calib"][:5]:
            lines = (line.split(": ") for line in (training / "calib" / f"{name}.txt").read_text().splitlines())
            rows = {key: np.array([float(value) for value in values.split()]) for key, values in lines}
            # Camera 2 is the reference, for there is no camera 0.
            np.testing.assert_allclose(rows["P2"].reshape(3, 4), np.c_[intrinsic(160, 80), np.zeros(3)], atol=1e-4)
            expected = intrinsic(120, 60) @ (right @ np.linalg.inv(left))[:3]
            np.testing.assert_allclose(rows["P3"].reshape(3, 4), expected, atol=1e-4)
            np.testing.assert_allclose(rows["Tr_imu_to_velo"].reshape(3, 4)[:, 3], [-1, 0, -2], atol=1e-6)
            points = np.fromfile(training / "velodyne" / f"{name}.bin", "<f4").reshape(-1, 4)
            sample = samples[number, "top", int(name)]
            assert np.array_equal(points[:, :3], sample.own_m.astype("<f4"))
            image = np.asarray(Image.open(training / "image_3" / f"{name}.png"))
            assert np.array_equal(image, samples[number, "image_3", int(name)].planes["rgb"])
    # A scan without all images of its tick is no frame, and is counted.
    written = sum(len(list((carrier / "training" / "calib").iterdir())) for carrier in carriers)
    missing = sum(name == "top" for _, name, _ in samples) - written
    (line,) = (line for line in left_out if line.startswith("LIDAR `top`"))
    assert missing >= 30 and f": a frame needs a scan and all images of its tick ({missing} messages of" in line
    # The unit of the mast stands still, and looks where the mast does: counter-clockwise from east.
    packets = {file.read_text() for file in (carriers[-1] / "training" / "oxts").iterdir()}
    (packet,) = packets
    numbers = [float(word) for word in packet.split()]
    assert numbers[5] == pytest.approx(MAST[2]) and numbers[6:11] == [0] * 5


def _chain(devkit: Any, scene: dict[str, Any], channel: str) -> list[dict[str, Any]]:
    """The files of a sensor in a scene. A recorder that watches may have missed its first."""
    sample = devkit.get("sample", scene["first_sample_token"])
    while channel not in sample["data"]:
        sample = devkit.get("sample", sample["next"])
    row = devkit.get("sample_data", sample["data"][channel])
    while row["prev"]:
        row = devkit.get("sample_data", row["prev"])
    rows = [row]
    while rows[-1]["next"]:
        rows.append(devkit.get("sample_data", rows[-1]["next"]))
    return rows


def _placed(row: dict[str, Any]) -> Float64Array:
    transform: Float64Array = Quaternion(row["rotation"]).transformation_matrix
    transform[:3, 3] = row["translation"]
    return transform


CHANNELS = {
    "LIDAR_TOP": "top",
    "LIDAR_SIDE": "side",
    "CAM_IMAGE_2": "image_2",
    "CAM_IMAGE_3": "image_3",
    "RADAR_FRONT": "RADAR_FRONT",
    "RADAR_BACK_LEFT": "back left",
}
FRAMES = {
    # x right, y forward; and x right, y down, z forward.
    "LIDAR": np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "CAM": np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    "RADAR": np.eye(3),
}
"""Ours (x forward, y left) from the frames of nuScenes' sensors."""


def test_nuscenes_has_a_channel_for_each_sensor_of_both_carriers(
    run_dir: Path, recording: Recording, samples: Samples, worlds: dict[int, Array], tmp_path: Path
) -> None:
    _, left_out = exported(run_dir, "nuscenes", tmp_path)
    # Of images it has the colours.
    assert [line.split(": ")[0] for line in left_out] == [f"camera `image_{n}` of suite `pair`" for n in (2, 3)]
    devkit = NuScenes(version="v1.0-caraware", dataroot=str(tmp_path), verbose=False)
    assert {channel for channel in CHANNELS} <= {row["channel"] for row in devkit.sensor}
    assert {row["modality"] for row in devkit.sensor if row["channel"].startswith("RADAR")} == {"radar"}
    scenes = {str(scene["name"]).rsplit("-", 1)[1]: scene for scene in devkit.scene}
    assert "roadside_0" in scenes and len(scenes) >= 2
    rates = [states["angular_rate_body_radps"][states["vehicle"] == 0, 2] for states in worlds.values()]
    assert np.abs(np.concatenate(rates)).max() > 0.3
    still_mps, users_mps, echoes = [], [], 0
    for name, scene in scenes.items():
        carrier = ROADSIDE if name == "roadside_0" else int(name)
        key_frames = [row for row in devkit.sample if row["scene_token"] == scene["token"]]
        for channel, sensor in CHANNELS.items():
            rows = _chain(devkit, scene, channel)
            assert {round(row["timestamp"] * 1e-6 / recording.tick_s) for row in rows} == {
                tick for number, of, tick in samples if (number, of) == (carrier, sensor)
            }
            for row in rows[::4]:
                tick = round(row["timestamp"] * 1e-6 / recording.tick_s)
                sample = samples[carrier, sensor, tick]
                mounted = _placed(devkit.get("calibrated_sensor", row["calibrated_sensor_token"]))
                ego = _placed(devkit.get("ego_pose", row["ego_pose_token"]))
                turn = FRAMES[channel.split("_")[0]]
                np.testing.assert_allclose(mounted[:3, 3], MOUNTS[sensor][:3], atol=2e-3)
                np.testing.assert_allclose(mounted[:3, :3], mount(sensor)[:3, :3] @ turn, atol=2e-3)
                if carrier == ROADSIDE:
                    np.testing.assert_allclose(ego[:2, 3], MAST[:2], atol=1e-9)
                    np.testing.assert_allclose(ego[:3, :3], rotation(0, 0, MAST[2]), atol=1e-9)
                path = devkit.get_sample_data_path(row["token"])
                if channel.startswith("CAM"):
                    assert np.array_equal(np.asarray(Image.open(path)), sample.planes["rgb"])
                    continue
                reader = RadarPointCloud if channel.startswith("RADAR") else LidarPointCloud
                points = reader.from_file(path).points.astype(np.float64)
                world_from_sensor = ego @ mounted
                world_m = points[:3].T @ world_from_sensor[:3, :3].T + world_from_sensor[:3, 3]
                np.testing.assert_allclose(world_m, sample.world_m, rtol=0, atol=1e-3)
                if channel.startswith("RADAR"):
                    assert np.array_equal(points[5], sample.rows["rcs_dbsm"])
                    moved = _radial_mps(points, worlds[tick], sample, world_from_sensor)
                    still_mps += moved[0]
                    users_mps += moved[1]
        for key_frame in key_frames:
            for token in key_frame["anns"]:
                row = devkit.get("sample_annotation", token)
                assert row["num_lidar_pts"] >= 0
                echoes += row["num_radar_pts"]
    # Over ground, buildings stand still though the radar moves and turns, and road users move as the world says.
    assert len(still_mps) > 100 and np.quantile(np.abs(still_mps), 0.9) < 0.1
    errors_mps = np.array(users_mps)
    assert len(errors_mps) > 20 and np.quantile(np.abs(np.diff(errors_mps)), 0.9) < 0.1
    assert np.abs(errors_mps[:, 1]).max() > 2 and echoes > 10


def _radial_mps(
    points: Float64Array, states: Array, sample: RecordedSample, world_from_radar: Float64Array
) -> tuple[list[float], list[tuple[float, float]]]:
    """Radial velocities over ground, away from the radar: of what stands; and of road users beside the true ones."""
    still, users = [], []
    by_number = {int(state["vehicle"]): state for state in states}
    for point, row in zip(points.T, sample.rows, strict=True):
        ray = point[:3] / np.linalg.norm(point[:3])
        along = float(point[8:10] @ ray[:2]) / float(ray[:2] @ ray[:2])
        if 1 << 31 <= int(row["object_id"]) < 0xFFFF_FFF0:
            still.append(along)
        elif int(row["object_id"]) in by_number:
            state = by_number[int(row["object_id"])]
            velocity = rotation(0, 0, state["yaw_rad"])[:, :2] @ state["velocity_body_mps"][:2]
            users.append((along, float(velocity @ world_from_radar[:3, :3] @ ray)))
    return still, users


@pytest.fixture(scope="module", params=["foxglove", "ros2"])
def stream_export(request: pytest.FixtureRequest, run_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp(request.param)
    _, left_out = exported(run_dir, request.param, directory)
    assert [line.split(": ")[0] for line in left_out] == [f"camera `image_{n}` of suite `pair`" for n in (2, 3)]
    return directory


@pytest.fixture(scope="module")
def stream(stream_export: Path) -> ReadStream:
    is_foxglove = (stream_export / "episode-00000.foxglove.mcap").exists()
    return read_foxglove(stream_export) if is_foxglove else read_ros(by_rosbags(stream_export))


def test_reruns_importer_draws_what_the_mast_measures(stream_export: Path, samples: Samples) -> None:
    (path,) = stream_export.rglob("*.mcap")
    clouds: dict[str, int] = {}
    for chunk in McapReader(path, include_topic_regex=["^/roadside_0/"]).stream():
        batch = chunk.to_record_batch()
        if "Points3D:positions" in batch.schema.names:
            clouds[chunk.entity_path] = clouds.get(chunk.entity_path, 0) + batch.num_rows
    topics = {"top": "top/points", "side": "side/points"}
    topics |= {"RADAR_FRONT": "RADAR_FRONT/detections", "back left": "back_left/detections"}
    assert clouds == {
        f"/roadside_0/{topic}": sum((carrier, name) == (ROADSIDE, sensor) for carrier, name, _ in samples)
        for sensor, topic in topics.items()
    }


def test_streams_have_a_topic_and_a_frame_for_each_sensor_and_the_mast_stands(
    stream: ReadStream, recording: Recording, samples: Samples
) -> None:
    def world_from(frame: str, now: int) -> Float64Array:
        """Through the frames, of which static ones hold from their time on."""
        transform = np.eye(4)
        while frame != "map":
            known = (frame, now)
            if known not in stream.placed:
                times = [time for child, time in stream.placed if child == frame and time <= now]
                assert frame.startswith("roadside_0/"), frame
                known = (frame, max(times))
            parent, moved = stream.placed[known]
            frame, transform = parent, moved @ transform
        return transform

    frames = {"top": "top", "side": "side", "RADAR_FRONT": "RADAR_FRONT", "back left": "back_left"}
    frames |= {f"image_{n}": f"image_{n}_optical" for n in (2, 3)}
    expected = set()
    for (carrier, sensor, tick), sample in samples.items():
        of = "roadside_0" if carrier == ROADSIDE else f"vehicle_{carrier}"
        frame, now = f"{of}/{frames[sensor]}", round(tick * recording.tick_s * 1e9)
        expected.add((frame, now))
        if tick % 4:
            continue
        transform = world_from(frame, now)
        if sensor.startswith("image"):
            assert np.array_equal(stream.images[frame, now], sample.planes["rgb"])
            assert (frame, now) in stream.cameras
            ahead = rotation(*sample.head["attitude_rad"])[:, 0]
            np.testing.assert_allclose(transform[:3, 2], ahead, atol=1e-6)
            np.testing.assert_allclose(transform[:3, 3], sample.head["position_m"], atol=1e-6)
            continue
        points = stream.points[frame, now]
        in_sensor = np.stack([points[name].astype(np.float64) for name in "xyz"], 1)
        world_m = in_sensor @ transform[:3, :3].T + transform[:3, 3]
        np.testing.assert_allclose(world_m, sample.world_m, rtol=0, atol=1e-4)
        is_lidar = sensor in ("top", "side")
        names = ("intensity", "object") if is_lidar else ("radial_velocity_mps", "snr_db", "object_id")
        for name in names:
            assert np.array_equal(points[name], sample.rows[name])
    assert set(stream.points) | set(stream.images) == expected
    # The mast and its sensors are as configured, and their frames come once or a few times, not with each scan.
    standing = {child: moved for (child, _), (_, moved) in stream.placed.items() if child.startswith("roadside_0/")}
    assert sum(child.startswith("roadside_0/") for child, _ in stream.placed) < 30
    np.testing.assert_allclose(standing["roadside_0/base_link"][:2, 3], MAST[:2], atol=1e-9)
    np.testing.assert_allclose(standing["roadside_0/base_link"][:3, :3], rotation(0, 0, MAST[2]), atol=1e-9)
    for sensor in ("top", "side", "RADAR_FRONT", "back left"):
        np.testing.assert_allclose(standing[f"roadside_0/{frames[sensor]}"], mount(sensor), atol=1e-6)


def test_opv2v_has_the_mast_as_a_negative_agent_and_all_lidars_in_one_cloud(
    run_dir: Path, samples: Samples, tmp_path: Path
) -> None:
    _, left_out = exported(run_dir, "opv2v", tmp_path)
    assert [line.split(": ")[0] for line in left_out if "no place" in line] == [
        "radar `RADAR_FRONT` of suite `pair`",
        "radar `back left` of suite `pair`",
    ]
    scenario = tmp_path / "episode-00000.opv2v"
    # OpenCOOD puts an agent with a negative number last, so that a vehicle is the ego.
    agents = sorted(path.name for path in scenario.iterdir() if path.is_dir())
    assert agents[0] == "-1" and int(agents[1]) >= 0
    mirror, compared = np.diag([1.0, -1.0, 1.0]), 0
    for agent in agents:
        carrier = ROADSIDE if agent == "-1" else int(agent)
        stamps = sorted(path.stem for path in (scenario / agent).glob("*.yaml"))
        assert [int(stamp) for stamp in stamps] == sorted(t for c, n, t in samples if (c, n) == (carrier, "top"))
        for stamp in stamps[::6]:
            labels = yaml.load((scenario / agent / f"{stamp}.yaml").read_text(), Loader=yaml.CSafeLoader)
            data = (scenario / agent / f"{stamp}.pcd").read_bytes().partition(b"DATA binary\n")[2]
            rows = np.frombuffer(data, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
            points = np.stack([rows[name] for name in "xyz"], 1).astype(np.float64)
            world_from_lidar = world_from_pose(labels["lidar_pose"])
            in_world = points @ world_from_lidar[:3, :3].T + world_from_lidar[:3, 3]
            scans = [samples[carrier, name, int(stamp)] for name in ("top", "side")]
            expected = np.concatenate([scan.world_m for scan in scans]) @ mirror
            np.testing.assert_allclose(in_world, expected, rtol=0, atol=1e-3)
            objects = np.concatenate([scan.rows["object"] for scan in scans])
            assert all(box["points"] == (objects == number).sum() for number, box in labels["vehicles"].items())
            assert labels["RSU"] == (carrier == ROADSIDE)
            if carrier == ROADSIDE:
                x, y, heading = MAST
                assert labels["true_ego_pos"][:2] == pytest.approx([x, -y])
                assert labels["true_ego_pos"][4] == pytest.approx(-math.degrees(heading)) and labels["ego_speed"] == 0
            for number, sensor in enumerate(("image_2", "image_3")):
                image = samples.get((carrier, sensor, int(stamp)))
                path = scenario / agent / f"{stamp}_camera{number}.png"
                assert path.exists() == (image is not None)
                if image is None:
                    continue
                assert np.array_equal(np.asarray(Image.open(path)), image.planes["rgb"])
                camera = labels[f"camera{number}"]
                np.testing.assert_allclose(camera["intrinsic"], intrinsic(*[(160, 80), (120, 60)][number]), atol=1e-4)
                # From the LIDAR's frame to the camera's, both left-handed with x forward, as OpenCDA has it.
                in_camera = (np.c_[points, np.ones(len(points))] @ np.array(camera["extrinsic"]).T)[:, :3]
                turn = rotation(*image.head["attitude_rad"])
                ours = (expected @ mirror - image.head["position_m"]) @ turn @ mirror
                np.testing.assert_allclose(in_camera, ours, rtol=0, atol=1e-3)
                compared += 1
    assert compared > 8


def test_pyarrow_reads_a_row_for_each_radar_detection(run_dir: Path, samples: Samples, tmp_path: Path) -> None:
    _, left_out = exported(run_dir, "radar", tmp_path)
    assert len(left_out) == 4 and all("radar detections alone" in line for line in left_out)
    path = tmp_path / "episode-00000.radar.parquet"
    table = pyarrow.parquet.read_table(path).to_pydict()
    assert pyarrow.parquet.read_schema(path).metadata[b"caraware.run"] == b"data"
    radars = {key: sample for key, sample in samples.items() if key[1] in ("RADAR_FRONT", "back left")}
    assert len(table["tick"]) == sum(len(sample.rows) for sample in radars.values()) > 200
    assert set(table["carrier_id"]) > {"mast"}
    columns = {name: np.array(table[name]) for name in table}
    for (carrier, sensor, tick), sample in list(radars.items())[::7]:
        of = "roadside_0" if carrier == ROADSIDE else f"vehicle_{carrier}"
        rows = (columns["tick"] == tick) & (columns["carrier"] == of) & (columns["radar"] == sensor)
        world_m = np.stack([columns[name][rows] for name in ("x_m", "y_m", "z_m")], 1)
        np.testing.assert_allclose(world_m, sample.world_m, rtol=0, atol=1e-6)
        np.testing.assert_allclose(columns["time_s"][rows], sample.time_s, rtol=0, atol=1e-9)
        for name in ("distance_m", "azimuth_rad", "radial_velocity_mps", "rcs_dbsm", "snr_db", "object_id"):
            assert np.array_equal(columns[name][rows], sample.rows[name]), name
        assert np.array_equal(columns["is_road_user"][rows], sample.rows["object_id"] < 1 << 30)


def test_the_suite_of_nuscenes_has_its_channels() -> None:
    with (Path(__file__).parents[2] / "configs" / "suites" / "nuscenes.toml").open("rb") as file:
        sensors = tomllib.load(file)["suite"][0]["sensor"]
    assert len(sensors) == 12
    assert [sensor_channel(sensor["kind"], sensor["name"]) for sensor in sensors] == [one["name"] for one in sensors]


def test_sensors_of_one_carrier_have_different_labels() -> None:
    units = [("camera", 0, "", "camera"), ("camera", 1, "a", "Camera"), ("camera", 2, "a", "camera")]
    units += [("radar", 1, "a", "front"), ("camera", 3, "a", "front"), ("camera", 4, "b", "front")]
    keys = ("kind", "sensor", "suite", "name")
    run: Any = {"sensor_units": [dict(zip(keys, unit, strict=True)) for unit in units]}
    labels = SensorLabels(run, lambda kind, name: name.lower(), ["front"])
    found = [labels.of((kind, number)) for kind, number, *_ in units]
    assert found == ["camera", "camera_2", "camera_3", "front_2", "front_3", "front_2"]
