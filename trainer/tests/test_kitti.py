"""KITTI exports, read by the rules of the object benchmark's devkit and compared with the recorded world.

The reader below is written from the devkit's `readme.txt` (columns, frames) and `computeBox3D.m` (corners), and shares
nothing with the export. Both sensors are mounted off-centre and turned, so that no symmetry hides a sign.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from caraware.data import Recording, RecordingError, open_recording
from caraware.data.export.__main__ import export
from caraware.data.names import RoadUsers
from caraware.data.recording import Array, Message
from caraware.ipc.arrays import Float64Array
from caraware.ipc.image import split_planes
from caraware.ipc.pointcloud import rotation
from PIL import Image

CARAWARE = Path(__file__).parents[2] / "target" / "release" / "caraware"
SETTINGS = {
    "traffic.cavs": 12,
    "traffic.others": 20,
    "traffic.pedestrians": 10,
    "episode.ticks": 160,
    "episode.training_episodes": 1,
    "fanout.enabled": "false",
    # At full speed the recorder misses most images.
    "run.real_time_factor": 4,
    "lidar.vehicles": 3,
    "lidar.channels": 32,
    "lidar.points_per_second": 230400,
    "lidar.mount": "[0.8, 0.3, 1.9, 0.0, 0.05, 0.4]",
    "lidar.axes": "paper",
    # Boxes and points then belong to the same moment.
    "lidar.rolling_shutter": "false",
    "lidar.range_noise_std_m": 0.0,
    "camera.vehicles": 2,
    "camera.rgb": "true",
    "camera.width": 320,
    "camera.height": 120,
    "camera.mount": "[1.4, -0.2, 1.5, 0.0, 0.0, -0.15]",
    "record.channels": '["world", "observation", "pointcloud", "image", "traffic-meta"]',
}

TILT_M = 0.15
"""How far a corner of a box is off since KITTI's boxes only turn about the camera's y axis: braking cars nod by 1°."""


@pytest.fixture(scope="module")
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        settings = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
        command: list[str | Path] = [CARAWARE, "simulate", "town", "--name", "data", "--record", "--quiet", *settings]
        environment = os.environ | {"CARAWARE_RUNTIME_DIR": f"{short}/r", "CARAWARE_PYTHON": sys.executable}
        ran = subprocess.run(command, cwd=short, env=environment, capture_output=True, text=True, timeout=600)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        yield Path(short, "runs", "data")


@dataclass(frozen=True)
class Label:
    """A line of `label_2`."""

    type: str
    truncated: float
    occluded: int
    alpha: float
    box: Float64Array
    """Left, top, right, bottom (px)."""
    size_m: Float64Array
    """Height, width, length."""
    location_m: Float64Array
    """Middle of the lower face in the camera's frame: x right, y down, z forward."""
    rotation_y: float

    @classmethod
    def read(cls, line: str) -> Label:
        """Parse the 15 columns."""
        words = line.split()
        assert len(words) == 15
        numbers = np.array(words[1:], np.float64)
        return cls(
            words[0],
            numbers[0],
            int(words[2]),
            numbers[2],
            numbers[3:7],
            numbers[7:10],
            numbers[10:13],
            float(numbers[13]),
        )

    @property
    def turn(self) -> Float64Array:
        """f64 [3, 3]: camera from box, about the camera's y axis, as `computeBox3D.m` has it."""
        cos, sin = np.cos(self.rotation_y), np.sin(self.rotation_y)
        return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])

    def corners_m(self) -> Float64Array:
        """f64 [8, 3]: corners in the camera's frame."""
        height, width, length = self.size_m
        x = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * length / 2
        y = np.array([0, 0, 0, 0, -1, -1, -1, -1]) * height
        z = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * width / 2
        return np.stack((x, y, z), 1) @ self.turn.T + self.location_m


@dataclass(frozen=True)
class Sample:
    """The files of a frame."""

    points: Float64Array
    """f64 [count, 4]: x forward, y left, z up (m), reflectance."""
    labels: list[Label]
    calibration: dict[str, Float64Array]
    image: Path

    @classmethod
    def read(cls, training: Path, name: str) -> Sample:
        """Read a frame of `training/`."""
        calibration = {}
        for line in (training / "calib" / f"{name}.txt").read_text().splitlines():
            key, _, numbers = line.partition(": ")
            calibration[key] = np.array(numbers.split(), np.float64).reshape(3, -1)
        assert list(calibration) == ["P0", "P1", "P2", "P3", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
        points = np.fromfile(training / "velodyne" / f"{name}.bin", "<f4").reshape(-1, 4).astype(np.float64)
        labels = [Label.read(line) for line in (training / "label_2" / f"{name}.txt").read_text().splitlines()]
        return cls(points, labels, calibration, training / "image_2" / f"{name}.png")

    def in_camera_m(self, points: Float64Array) -> Float64Array:
        """R0_rect · Tr_velo_to_cam · x."""
        transform = self.calibration["Tr_velo_to_cam"]
        in_camera: Float64Array = (points[:, :3] @ transform[:, :3].T + transform[:, 3]) @ self.calibration["R0_rect"].T
        return in_camera

    def project(self, in_camera_m: Float64Array) -> Float64Array:
        """P2 · x: f64 [count, 2], pixels."""
        projection = self.calibration["P2"]
        homogeneous = in_camera_m @ projection[:, :3].T + projection[:, 3]
        pixels: Float64Array = homogeneous[:, :2] / homogeneous[:, 2:]
        return pixels


@dataclass(frozen=True)
class Recorded:
    """The messages of a frame."""

    sample: Sample
    scan: np.void
    points: Array
    states: Array
    image: Message | None


@pytest.fixture(scope="module")
def frames(run_dir: Path) -> Iterator[list[Recorded]]:
    """Every frame of every carrier beside its messages."""
    recording: Recording = open_recording(run_dir)
    worlds = {message.tick: message.section("states") for message in recording.messages("world")}
    scans = {(int(m.section("scan")[0]["vehicle"]), m.tick): m for m in recording.messages("pointcloud")}
    images = {(int(m.section("head")[0]["vehicle"]), m.tick): m for m in recording.messages("image")}
    with tempfile.TemporaryDirectory() as directory:
        assert export(run_dir, "kitti", Path(directory), 1, lambda done, total: None) == 1
        part = Path(directory) / "episode-00000.kitti"
        read = []
        for carrier in sorted(part.iterdir()):
            names = (carrier / "ImageSets" / "train.txt").read_text().split()
            vehicle, ticks = int(carrier.name), {int(name) for name in names}
            # A carrier with a camera has the frames with an image, another one has all its scans.
            filmed = {tick for number, tick in images if number == vehicle}
            scanned = {tick for number, tick in scans if number == vehicle}
            assert ticks == (scanned & filmed if filmed else scanned) and len(ticks) > 20
            for name in names:
                scan, image = scans[vehicle, int(name)], images.get((vehicle, int(name)))
                sample = Sample.read(carrier / "training", name)
                read.append(Recorded(sample, scan.section("scan")[0], scan.section("points"), worlds[int(name)], image))
        yield read


def _world_of(pose: np.void, in_camera_m: Float64Array) -> Float64Array:
    """f64 [count, 3]: points of KITTI's camera frame in the world; `pose` is of a camera with x along its axis."""
    along = np.stack((in_camera_m[:, 2], -in_camera_m[:, 0], -in_camera_m[:, 1]), 1)
    world: Float64Array = along @ rotation(*pose["attitude_rad"]).T + pose["position_m"]
    return world


def _camera(frame: Recorded) -> np.void:
    """The pose of the camera; without one the LIDAR's."""
    pose: np.void = frame.scan if frame.image is None else frame.image.section("head")[0]
    return pose


def test_points_lie_where_they_were_recorded(frames: list[Recorded]) -> None:
    assert {frame.image is None for frame in frames} == {True, False}
    for frame in frames[::5]:
        recorded = frame.points["position_m"]
        assert frame.scan["axes"] == 1
        forward = np.stack((-recorded[:, 1], recorded[:, 0], -recorded[:, 2]), 1)
        assert np.array_equal(frame.sample.points[:, :3], forward)
        assert np.array_equal(frame.sample.points[:, 3], frame.points["intensity"])
        in_world = forward @ rotation(*frame.scan["attitude_rad"]).T + frame.scan["position_m"]
        in_camera = frame.sample.in_camera_m(frame.sample.points)
        assert np.allclose(_world_of(_camera(frame), in_camera), in_world, rtol=0, atol=1e-4)
        # The origin of "imu" is the carrier's: the rear axle on the ground.
        own = frame.states[frame.states["vehicle"] == frame.scan["vehicle"]][0]
        origin = frame.sample.calibration["Tr_imu_to_velo"][:, 3]
        origin_m = rotation(*frame.scan["attitude_rad"]) @ origin + frame.scan["position_m"]
        assert origin_m == pytest.approx([own["x_m"], own["y_m"], own["z_m"]], abs=1e-4)


def test_labels_are_the_boxes_of_the_world_and_hold_its_points(frames: list[Recorded], run_dir: Path) -> None:
    users = RoadUsers(open_recording(run_dir))
    on_boxes, classes, turned = 0, set(), set()
    for frame in frames:
        hit = set(np.unique(frame.points["object"]).tolist())
        seen = set() if frame.image is None else set(frame.image.section("objects")["object"].tolist())
        states = [s for s in frame.states if s["vehicle"] != frame.scan["vehicle"] and int(s["vehicle"]) in hit | seen]
        assert len(states) == len(frame.sample.labels)
        in_camera = frame.sample.in_camera_m(frame.sample.points)
        for state, label in zip(states, frame.sample.labels, strict=True):
            assert label.size_m == pytest.approx([state["height_m"], state["width_m"], state["length_m"]], abs=1e-3)
            # The heading of the box is that of the road user, in the world.
            ahead = np.array([[np.cos(label.rotation_y), 0, -np.sin(label.rotation_y)], [0, 0, 0]])
            ahead_m = -np.diff(_world_of(_camera(frame), ahead), axis=0)[0]
            heading = [np.cos(state["yaw_rad"]), np.sin(state["yaw_rad"])]
            assert ahead_m[:2] == pytest.approx(heading, abs=0.02)
            viewed_from = np.arctan2(label.location_m[0], label.location_m[2])
            assert np.sin(label.alpha - label.rotation_y + viewed_from) == pytest.approx(0, abs=2e-3)
            assert np.cos(label.alpha - label.rotation_y + viewed_from) == pytest.approx(1) and abs(label.alpha) <= 3.15
            # Its points are in the box, but for the tilt that KITTI leaves out.
            on_it = in_camera[frame.points["object"] == state["vehicle"]]
            in_box = (on_it - label.location_m) @ label.turn
            height, width, length = label.size_m
            assert np.all(np.abs(in_box[:, [0, 2]]) < np.array([length, width]) / 2 + TILT_M)
            assert np.all((-height - 0.25 < in_box[:, 1]) & (in_box[:, 1] < 0.25))
            on_boxes += len(on_it)
            classes.add((label.type, users.of(state["id_hash"]).vehicle_class))
            turned.add(int(label.rotation_y // (np.pi / 2)))
            if int(state["vehicle"]) not in seen:
                assert (label.truncated, label.occluded) == (-1, 3) and label.box.tolist() == [-1] * 4
    assert on_boxes > 1000 and len(turned) == 4
    assert classes == {("Car", "passenger"), ("Van", "delivery"), ("Pedestrian", "pedestrian")}


def test_the_image_shows_what_labels_and_points_project_to(frames: list[Recorded]) -> None:
    boxes, hidden = 0, set()
    on_object: dict[bool, list[Array]] = {False: [], True: []}
    for frame in frames:
        if frame.image is None:
            assert not frame.sample.image.exists()
            continue
        head, objects = frame.image.section("head")[0], frame.image.section("objects")
        planes = split_planes(head, frame.image.section("planes").tobytes())
        instance, rgb = planes["instance"], planes["rgb"]
        assert instance is not None and rgb is not None
        assert np.array_equal(np.asarray(Image.open(frame.sample.image)), rgb)
        # The corners of a label project to the recorded box, counted from the middle of the first pixel.
        hit = set(np.unique(frame.points["object"]).tolist())
        seen = {int(user["object"]): user for user in objects}
        labelled = [int(s["vehicle"]) for s in frame.states if s["vehicle"] != frame.scan["vehicle"]]
        labelled = [vehicle for vehicle in labelled if vehicle in hit or vehicle in seen]
        for vehicle, label in zip(labelled, frame.sample.labels, strict=True):
            if vehicle not in seen:
                continue
            user, corners = seen[vehicle], label.corners_m()
            assert label.truncated == pytest.approx(float(user["truncated"]), abs=0.01)
            left, top, right, bottom = label.box
            assert 0 <= left <= right <= head["width"] - 1 and 0 <= top <= bottom <= head["height"] - 1
            # What shows a pixel of it lies in the box.
            rows, columns = np.nonzero(instance == vehicle)
            assert left - 1.5 <= columns.min() and columns.max() <= right + 1.5
            assert top - 1.5 <= rows.min() and rows.max() <= bottom + 1.5
            hidden.add(label.occluded)
            if (nearest_m := corners[:, 2].min()) > 5:
                pixels = frame.sample.project(corners)
                last = np.array([head["width"], head["height"]]) - 1
                ends = np.concatenate((pixels.min(0).clip(0, last), pixels.max(0).clip(0, last)))
                assert label.box == pytest.approx(ends, abs=0.5 + TILT_M * head["focal_px"] / nearest_m)
                boxes += 1
        # Most points on a road user project onto a pixel of it, unless the image is mirrored. The camera sees cars with
        # a bonnet and a cabin, and some points are hidden from it.
        in_camera = frame.sample.in_camera_m(frame.sample.points)
        is_ahead = (in_camera[:, 2] > 1) & (frame.points["object"] < 1 << 31)
        for is_mirrored, shown in on_object.items():
            mirrored = in_camera[is_ahead] * [-1 if is_mirrored else 1, 1, 1]
            pixels = np.round(frame.sample.project(mirrored)).astype(int)
            is_inside = np.all((pixels >= 0) & (pixels < [head["width"], head["height"]]), 1)
            columns, rows = pixels[is_inside].T
            shown.append(instance[rows, columns] == frame.points["object"][is_ahead][is_inside])
    straight, mirrored = (np.concatenate(on_object[is_mirrored]) for is_mirrored in (False, True))
    assert boxes > 30 and 0 in hidden and len(hidden) > 1
    assert len(straight) > 300 and straight.mean() > 0.75 and mirrored.mean() < 0.4


def test_a_recording_without_points_is_refused(run_dir: Path, tmp_path: Path) -> None:
    settings = [
        word for pair in {**SETTINGS, "lidar.vehicles": 0}.items() for word in ("--set", f"{pair[0]}={pair[1]}")
    ]
    environment = os.environ | {"CARAWARE_RUNTIME_DIR": f"{run_dir.parents[1]}/r2", "CARAWARE_PYTHON": sys.executable}
    command: list[str | Path] = [CARAWARE, "simulate", "town", "--name", "dark", "--record", "--quiet", *settings]
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    with pytest.raises(RecordingError, match=r"lidar\.vehicles"):
        export(tmp_path / "runs" / "dark", "kitti", tmp_path / "out", 1, lambda done, total: None)
