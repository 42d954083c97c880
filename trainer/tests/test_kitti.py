"""KITTI exports, read by the rules of the object benchmark's devkit and compared with the recorded world.

The reader below is written from the devkit's `readme.txt` (columns, frames) and `computeBox3D.m` (corners), and shares
nothing with the export.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from caraware.data import RecordingError, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.oxts import Geodesy
from caraware.data.names import RoadUsers, vehicle_class
from caraware.data.recording import Array
from caraware.ipc.arrays import Float64Array
from caraware.ipc.image import split_planes
from caraware.ipc.pointcloud import rotation
from PIL import Image
from pykitti.utils import load_oxts_packets_and_poses
from recorded_run import ASKEW, RecordedFrame, assert_has_card, in_world_m, recorded_run, unseen

TILT_M = 0.15
"""How far a corner of a box is off since KITTI's boxes only turn about the camera's y axis: braking cars nod by 1°."""


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
class Compared(RecordedFrame):
    """The messages of a frame beside its files."""

    sample: Sample

    @property
    def camera(self) -> np.void:
        """The pose of the camera; without one the LIDAR's."""
        pose: np.void = self.scan if self.image is None else self.image.section("head")[0]
        return pose

    def world_of(self, in_camera_m: Float64Array) -> Float64Array:
        """f64 [count, 3]: points of KITTI's camera frame in the world."""
        along = np.stack((in_camera_m[:, 2], -in_camera_m[:, 0], -in_camera_m[:, 1]), 1)
        return in_world_m(self.camera, along)


@pytest.fixture(scope="module")
def kitti(askew_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The exported episode."""
    directory = tmp_path_factory.mktemp("kitti")
    assert export(askew_run, "kitti", directory, 1, unseen) == 1
    assert_has_card(directory, askew_run)
    return directory / "episode-00000.kitti"


@pytest.fixture(scope="module")
def frames(kitti: Path, askew_frames: dict[tuple[int, int], RecordedFrame]) -> list[Compared]:
    """Every frame of every carrier beside its messages."""
    read = []
    for carrier in sorted(kitti.iterdir()):
        names = (carrier / "ImageSets" / "train.txt").read_text().split()
        vehicle, ticks = int(carrier.name), {int(name) for name in names}
        # A carrier with a camera has the frames with an image, another one has all its scans.
        own = {tick: frame for (number, tick), frame in askew_frames.items() if number == vehicle}
        filmed = {tick for tick, frame in own.items() if frame.image is not None}
        assert ticks == (filmed or set(own)) and len(ticks) > 20
        for name in names:
            sample = Sample.read(carrier / "training", name)
            read.append(Compared(**vars(own[int(name)]), sample=sample))
    return read


def test_points_lie_where_they_were_recorded(frames: list[Compared]) -> None:
    assert {frame.image is None for frame in frames} == {True, False}
    for frame in frames[::5]:
        assert np.array_equal(frame.sample.points[:, :3], frame.forward_m)
        assert np.array_equal(frame.sample.points[:, 3], frame.points["intensity"])
        in_camera = frame.sample.in_camera_m(frame.sample.points)
        assert np.allclose(frame.world_of(in_camera), frame.world_m, rtol=0, atol=1e-4)
        # The origin of "imu" is the carrier's: the rear axle on the ground.
        own = frame.own
        origin_m = in_world_m(frame.scan, frame.sample.calibration["Tr_imu_to_velo"][:, 3])
        assert origin_m == pytest.approx([own["x_m"], own["y_m"], own["z_m"]], abs=1e-4)


def test_labels_are_the_boxes_of_the_world_and_hold_its_points(frames: list[Compared], askew_run: Path) -> None:
    users = RoadUsers(open_recording(askew_run))
    on_boxes, classes, turned = 0, set(), set()
    for frame in frames:
        seen = set() if frame.image is None else set(frame.image.section("objects")["object"].tolist())
        states = frame.labelled()
        assert len(states) == len(frame.sample.labels)
        in_camera = frame.sample.in_camera_m(frame.sample.points)
        for state, label in zip(states, frame.sample.labels, strict=True):
            assert label.size_m == pytest.approx([state["height_m"], state["width_m"], state["length_m"]], abs=1e-3)
            # The heading of the box is that of the road user, in the world.
            ahead = np.array([[np.cos(label.rotation_y), 0, -np.sin(label.rotation_y)], [0, 0, 0]])
            ahead_m = -np.diff(frame.world_of(ahead), axis=0)[0]
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
            assert vehicle_class(state) == users.of(state["id_hash"]).vehicle_class
            turned.add(int(label.rotation_y // (np.pi / 2)))
            if int(state["vehicle"]) not in seen:
                assert (label.truncated, label.occluded) == (-1, 3) and label.box.tolist() == [-1] * 4
    assert on_boxes > 1000 and len(turned) == 4
    assert classes == {("Car", "passenger"), ("Van", "delivery"), ("Pedestrian", "pedestrian")}


def test_the_image_shows_what_labels_and_points_project_to(frames: list[Compared]) -> None:
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
        seen = {int(user["object"]): user for user in objects}
        for state, label in zip(frame.labelled(), frame.sample.labels, strict=True):
            if (vehicle := int(state["vehicle"])) not in seen:
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


def test_pykitti_reads_the_true_motion_of_the_carrier(
    kitti: Path, askew_run: Path, askew_frames: dict[tuple[int, int], RecordedFrame]
) -> None:
    recording = open_recording(askew_run)
    for carrier in sorted(kitti.iterdir()):
        files = sorted((carrier / "training" / "oxts").iterdir())
        own = [askew_frames[int(carrier.name), int(file.stem)].own for file in files]
        times_s = np.loadtxt(carrier / "training" / "times.txt")
        assert times_s == pytest.approx([int(file.stem) * recording.tick_s for file in files])
        read = load_oxts_packets_and_poses([str(file) for file in files])
        first_m = np.array([own[0]["x_m"], own[0]["y_m"], own[0]["z_m"]])
        for (packet, pose), state in zip(read, own, strict=True):
            # pykitti's Mercator projection is the world's, but for the origin and for its sphere: 0.5 % of the way.
            moved_m = np.array([state["x_m"], state["y_m"], state["z_m"]]) - first_m
            tolerance_m = 1e-3 + 0.005 * float(np.linalg.norm(moved_m))
            assert pose[:3, 3] == pytest.approx(moved_m, abs=tolerance_m)
            attitude = rotation(state["roll_rad"], state["pitch_rad"], state["yaw_rad"])
            assert np.allclose(pose[:3, :3], attitude, atol=1e-6)
            # Velocities of the level frame and of the map are the same motion.
            moved = np.array([packet.ve, packet.vn, packet.vu])
            assert np.allclose(attitude @ state["velocity_body_mps"], moved, atol=1e-6)
            ahead = [np.cos(packet.yaw), np.sin(packet.yaw)]
            assert np.dot(ahead, moved[:2]) == pytest.approx(packet.vf, abs=1e-6)
            assert np.dot([-ahead[1], ahead[0]], moved[:2]) == pytest.approx(packet.vl, abs=1e-6)
            measured = np.array([packet.ax, packet.ay, packet.az]) - state["accel_body_mps2"]
            assert np.allclose(attitude @ measured, [0, 0, 9.80665], atol=1e-5)
            rate = np.array([packet.wx, packet.wy, packet.wz])
            assert np.allclose(rate, state["angular_rate_body_radps"], atol=1e-6)
        assert np.linalg.norm(read[-1].T_w_imu[:3, 3]) > 20


def test_latitudes_are_those_of_the_gnss_receivers(askew_run: Path) -> None:
    """A recorded fix has its place in the world and on the ellipsoid, which another program computed."""
    recording = open_recording(askew_run)
    geodesy, compared = Geodesy(recording), 0
    for message in list(recording.messages("observation"))[::20]:
        for place, geodetic in zip(message.section("gnss_m"), message.section("gnss_geodetic"), strict=True):
            if np.isfinite(geodetic).all():
                assert geodesy.of(*place[:2].tolist()) == pytest.approx(geodetic[:2], abs=2e-9 + 1e-3 / 111e3)
                compared += 1
    assert compared > 50


def test_a_recording_without_points_is_refused(tmp_path: Path) -> None:
    with (
        recorded_run("simulate", ASKEW | {"lidar.vehicles": 0}) as run_dir,
        pytest.raises(RecordingError, match=r"lidar\.vehicles"),
    ):
        export(run_dir, "kitti", tmp_path / "out", 1, unseen)
