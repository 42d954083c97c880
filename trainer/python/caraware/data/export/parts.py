"""Parts of an export, one for each episode: the table of formats, and what worker processes call.

A spawned process does not import `__main__`, so what it calls lies here.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from caraware.data.export import detections, fcd, foxglove, kitti, minari, nuscenes, opv2v, ros2, streams, tables
from caraware.data.export.sensors import Lacks, all_lack
from caraware.data.recording import Episode, Recording, open_recording


@dataclass(frozen=True)
class ExportFormat:
    """A format: its name for people, what it holds, the ending of its parts, and what writes the part of an episode."""

    title: str
    meaning: str
    ending: str
    write: Callable[[Recording, Episode, Path], None]
    lacks: Lacks
    """What it has no place for."""
    join: Callable[[Recording, Path, list[str]], None] | None = None
    """Makes one data set of all parts in a directory, for formats that need it."""
    has_observations: bool = False
    """True if its rows or steps have observations."""


ROWS_ALONE = all_lack("a row is a vehicle-tick, without points, images and detections (`--to radar` has these)")

FORMATS = {
    "parquet": ExportFormat(
        "Parquet", tables.MEANING, "parquet", tables.write_parquet, ROWS_ALONE, has_observations=True
    ),
    "csv": ExportFormat("CSV", tables.MEANING, "csv", tables.write_csv, ROWS_ALONE, has_observations=True),
    "radar": ExportFormat(
        "radar detections (Parquet)",
        detections.MEANING,
        "radar.parquet",
        detections.write_radar,
        detections.lacks,
    ),
    "fcd": ExportFormat(
        "SUMO floating car data",
        "Every road user at every tick, in SUMO's conventions: front bumper, degrees clockwise from north.",
        "fcd.xml",
        fcd.write_fcd,
        all_lack("floating car data has no sensors"),
    ),
    "foxglove": ExportFormat(
        "Foxglove MCAP",
        "Messages in Foxglove's schemas: transforms, boxes, true motion, GNSS, points, images and radar detections.",
        "foxglove.mcap",
        foxglove.write_foxglove,
        streams.lacks,
    ),
    "kitti": ExportFormat(
        "KITTI",
        "Objects: a directory for each carrier of a LIDAR, with points, calibration, labels and images.",
        "kitti",
        kitti.write_kitti,
        kitti.lacks,
    ),
    "minari": ExportFormat(
        "Minari",
        "Offline reinforcement learning: a trajectory of observations, actions and rewards for each vehicle.",
        "minari",
        minari.write_minari,
        all_lack("a step has the observation, the action and the reward"),
        minari.join_parts,
        has_observations=True,
    ),
    "nuscenes": ExportFormat(
        "nuScenes",
        "Perception: a scene for each carrier of a LIDAR and episode, with sweeps, images, radar, poses and boxes.",
        "nuscenes",
        nuscenes.write_nuscenes,
        nuscenes.lacks,
        nuscenes.join_parts,
    ),
    "opv2v": ExportFormat(
        "OPV2V",
        "Cooperative perception: a directory for each agent with its points, poses and labels, in CARLA's frame.",
        "opv2v",
        opv2v.write_opv2v,
        opv2v.lacks,
    ),
    "ros2": ExportFormat(
        "ROS 2 bag",
        "A bag in MCAP with common messages: transforms, markers, odometry, GNSS, IMU, points, images and detections.",
        "ros2",
        ros2.write_ros2,
        streams.lacks,
    ),
}
"""Every format of `--to`."""


def part_name(episode: int, ending: str) -> str:
    """Name of the part of an episode."""
    return f"episode-{episode:05}.{ending}"


def write_part(recording_path: Path, format_name: str, number: int, directory: Path) -> str:
    """Write the part of one episode under another name, and rename it when it is whole; return its name.

    What an interrupted export left of it is removed first. Raises `RecordingError` and `OSError`.
    """
    recording, chosen = open_recording(recording_path), FORMATS[format_name]
    episode = next(episode for episode in recording.episodes() if episode.number == number)
    name = part_name(number, chosen.ending)
    partial = directory / f".{name}.partial"
    _remove(partial)
    chosen.write(recording, episode, partial)
    os.replace(partial, directory / name)
    return name


def _remove(path: Path) -> None:
    """Remove a file or a directory, if there is one."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
