"""OPV2V exports by the rules of OpenCOOD's loader: what it computes from them lies on the recorded world."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from caraware.data.export.__main__ import export
from caraware.data.export.opv2v import mask_pixel, pose, world_from_pose
from caraware.ipc.arrays import Float64Array
from caraware.ipc.pointcloud import rotation
from PIL import Image
from recorded_run import assert_has_card, of_carriers, recorded_run, unseen

SETTINGS = {
    "traffic.cavs": 6,
    "traffic.others": 4,
    "traffic.pedestrians": 3,
    "episode.ticks": 60,
    "episode.training_episodes": 1,
    "fanout.enabled": "false",
    "lidar.vehicles": 3,
    "lidar.channels": 16,
    "lidar.points_per_second": 115200,
    # Boxes and points then belong to the same moment.
    "lidar.rolling_shutter": "false",
    "lidar.range_noise_std_m": 0.0,
}
MIRROR = np.diag([1.0, -1.0, 1.0])
"""CARLA's left-handed frame from ours."""


@pytest.fixture(scope="module")
def run_dir() -> Iterator[Path]:
    with recorded_run("simulate", SETTINGS) as run_dir:
        yield run_dir


def _read_pcd(path: Path) -> tuple[Float64Array, Float64Array]:
    """Points and intensities, as open3d gives them to OpenCOOD: the intensity is the red of the colours."""
    head, _, data = path.read_bytes().partition(b"DATA binary\n")
    fields = {line.split()[0]: line.split()[1:] for line in head.decode().splitlines() if not line.startswith("#")}
    assert fields["FIELDS"] == ["x", "y", "z", "rgb"] and fields["SIZE"] == ["4"] * 4
    rows = np.frombuffer(data, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    assert len(rows) == int(fields["POINTS"][0])
    points = np.stack([rows[name] for name in "xyz"], 1).astype(np.float64)
    return points, (rows["rgb"] >> 16 & 0xFF) / 255


def _scenario(path: Path) -> dict[int, dict[str, Any]]:
    """Agents of a scenario by number, each with its frames by timestamp: OpenCOOD's `BaseDataset`."""
    agents = sorted(directory.name for directory in path.iterdir() if directory.is_dir())
    stamps = {agent: sorted(file.stem for file in (path / agent).glob("*.yaml")) for agent in agents}
    return {
        int(agent): {
            stamp: (
                yaml.load((path / agent / f"{stamp}.yaml").read_text(), Loader=yaml.CSafeLoader),
                *_read_pcd(path / agent / f"{stamp}.pcd"),
            )
            for stamp in stamps[agent]
        }
        for agent in agents
    }


def _check_mask(stem: Path, labels: dict[str, Any]) -> tuple[int, int]:
    """Whether the mask of a frame has those road users that its agent sees; how many it has, and how many it lacks."""
    mask = np.asarray(Image.open(f"{stem}_bev_visibility.png"))
    assert mask.shape == (256, 256) and set(np.unique(mask)) <= {0, 255}
    boxes = list(labels["vehicles"].values())
    places = np.array([[*box["location"][:2], box["location"][2], 1.0] for box in boxes])
    in_lidar = np.linalg.solve(world_from_pose(labels["lidar_pose"]), places.T).T
    seen_m = in_lidar[[box["points"] > 0 for box in boxes], :2]
    counts = [0, 0]
    for box, place, (column, row) in zip(boxes, in_lidar, np.rint(mask_pixel(in_lidar)).astype(int), strict=True):
        if np.abs(place[:2]).max() > 48:
            continue
        if box["points"] > 0:
            # A pedestrian is about a pixel wide.
            assert mask[row - 1 : row + 2, column - 1 : column + 2].any(), (stem, box)
            counts[0] += 1
        elif len(seen_m) == 0 or np.linalg.norm(seen_m - place[:2], axis=1).min() > 12:
            assert mask[row, column] == 0, (stem, box)
            counts[1] += 1
    return counts[0], counts[1]


def test_a_pose_is_the_same_transform_in_both_frames() -> None:
    # No symmetry hides a sign here.
    position_m, attitude_rad = np.array([12.0, -7.0, 1.5]), (0.05, -0.11, 2.2)
    transform = world_from_pose(pose(position_m, attitude_rad))
    assert transform[:3, :3] == pytest.approx(MIRROR @ rotation(*attitude_rad) @ MIRROR)
    assert transform[:3, 3] == pytest.approx(MIRROR @ position_m)


def test_points_and_boxes_of_every_agent_meet_in_the_world(run_dir: Path, tmp_path: Path) -> None:
    assert export(run_dir, "opv2v", tmp_path, 1, unseen) == 1
    assert_has_card(tmp_path, run_dir)
    agents = _scenario(tmp_path / "episode-00000.opv2v")
    assert len(agents) >= 3
    scans = of_carriers(run_dir)
    assert sum(len(frames) for frames in agents.values()) == len(scans)
    on_boxes = masked = unmasked = 0
    for agent, frames in agents.items():
        for stamp, (labels, points, intensity) in list(frames.items())[::3]:
            frame = scans[agent, int(stamp)]
            scan, recorded = frame.scan, frame.points
            in_world = points @ world_from_pose(labels["lidar_pose"])[:3, :3].T + labels["lidar_pose"][:3]
            ours = recorded["position_m"] @ rotation(*scan["attitude_rad"]).T + scan["position_m"]
            np.testing.assert_allclose(in_world, ours @ MIRROR, rtol=0, atol=1e-3)
            np.testing.assert_allclose(intensity, recorded["intensity"], rtol=0, atol=1 / 255)
            states = {int(state["vehicle"]): state for state in frame.states}
            for vehicle, box in labels["vehicles"].items():
                assert vehicle != agent and box["speed"] >= 0
                assert box["extent"][0] == pytest.approx(float(states[vehicle]["length_m"]) / 2)
                on_it = in_world[recorded["object"] == vehicle]
                assert len(on_it) == box["points"]
                # The points that hit a road user lie in its box.
                centre = np.array(box["location"]) + box["center"]
                in_box = (on_it - centre) @ world_from_pose([0, 0, 0, *box["angle"]])[:3, :3]
                assert np.all(np.abs(in_box[:, :2]) < np.array(box["extent"])[:2] + 0.1), (stamp, vehicle)
                on_boxes += len(on_it)
            seen, unseen_by_it = _check_mask(tmp_path / "episode-00000.opv2v" / str(agent) / stamp, labels)
            masked, unmasked = masked + seen, unmasked + unseen_by_it
            own = states[agent]
            heading_deg = labels["true_ego_pos"][4]
            assert heading_deg == pytest.approx(-math.degrees(own["yaw_rad"]))
    assert on_boxes > 100 and masked > 15 and unmasked > 8
