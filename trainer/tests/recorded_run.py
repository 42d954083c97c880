"""Recorded runs for the tests of exports, and the messages that they compare exports with."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from caraware.data import open_recording
from caraware.data.recording import Array, Message
from caraware.ipc.arrays import Float64Array
from caraware.ipc.pointcloud import rotation

CARAWARE = Path(__file__).parents[2] / "target" / "release" / "caraware"
ASKEW = {
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
"""Three carriers of a LIDAR, two of them with a camera; both are off-centre and turned, so no symmetry hides a sign."""

TRAINED = {
    "traffic.cavs": 5,
    "traffic.others": 3,
    "traffic.pedestrians": 2,
    "episode.ticks": 150,
    "episode.training_episodes": 2,
    "episode.evaluation_interval": 0,
    "episode.final_evaluations": 2,
    "episode.evaluation_ticks": 60,
    "trainer.horizon": 500,
    "trainer.plots": "false",
    "trainer.batch_size": 250,
    "fanout.enabled": "false",
    "record.chunk_mib": 1,
    "record.channels": '["observation", "prediction", "world", "traffic-meta", "traffic"]',
}
"""A short run of two training episodes and two evaluations, with SUMO's own states beside the mirrors'."""
TRAINED_TICKS = 420


@contextmanager
def recorded_run(
    command: str, settings: Mapping[str, Any], *, preset: str = "town", name: str = "data"
) -> Iterator[Path]:
    """The directory of a run that `caraware simulate` or `caraware train` (`command`) has recorded without loss."""
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        line: list[str | Path] = [CARAWARE, command, preset, "--name", name, "--record", "--quiet", *words]
        environment = os.environ | {"CARAWARE_RUNTIME_DIR": f"{short}/r", "CARAWARE_PYTHON": sys.executable}
        ran = subprocess.run(line, cwd=short, env=environment, capture_output=True, text=True, timeout=600)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        yield Path(short, "runs", name)


def assert_has_card(directory: Path, run_dir: Path) -> None:
    """An export says what it is: run, seed, hashes, versions, sensors and licence."""
    card, recording = (directory / "README.md").read_text(), open_recording(run_dir)
    assert recording.end is not None
    start = recording.start
    words = (
        start["config_hash"],
        recording.end["observation_hash"],
        start["program_version"],
        f"schema {start['schema_version']}",
    )
    for word in (
        *words,
        f"| seed | {start['seed']} |",
        "noise_std_deg",
        "### lidar",
        "### radar",
        "## Licence",
        "## Parts",
    ):
        assert word in card, word


def unseen(done: int, total: int) -> None:
    """A progress bar that shows nothing."""


@dataclass(frozen=True)
class RecordedFrame:
    """The messages of a carrier at a tick."""

    vehicle: int
    scan: np.void
    points: Array
    states: Array
    image: Message | None

    @property
    def own(self) -> np.void:
        """The state of the carrier."""
        own: np.void = self.states[self.states["vehicle"] == self.vehicle][0]
        return own

    @property
    def forward_m(self) -> Float64Array:
        """f64 [count, 3]: points in the LIDAR's frame, x forward, y left, z up; recorded in the paper's axes."""
        assert self.scan["axes"] == 1
        recorded = self.points["position_m"].astype(np.float64)
        return np.stack((-recorded[:, 1], recorded[:, 0], -recorded[:, 2]), 1)

    @property
    def world_m(self) -> Float64Array:
        """f64 [count, 3]: points in the world."""
        return in_world_m(self.scan, self.forward_m)

    def labelled(self) -> list[np.void]:
        """The states of the other road users that the LIDAR or the camera shows."""
        shown = set(np.unique(self.points["object"]).tolist())
        if self.image is not None:
            shown |= set(self.image.section("objects")["object"].tolist())
        return [state for state in self.states if state["vehicle"] != self.vehicle and int(state["vehicle"]) in shown]


def in_world_m(pose: np.void, points_m: Float64Array) -> Float64Array:
    """f64 [count, 3]: points of a sensor's frame (x forward, y left, z up) in the world."""
    world: Float64Array = points_m @ rotation(*pose["attitude_rad"]).T + pose["position_m"]
    return world


def of_carriers(run_dir: Path) -> dict[tuple[int, int], RecordedFrame]:
    """The frames of a run with LIDARs by vehicle and tick."""
    recording = open_recording(run_dir)
    worlds = {message.tick: message.section("states") for message in recording.messages("world")}
    images: dict[tuple[int, int], Message] = {}
    if "image" in recording.channels:
        images = {(int(m.section("head")[0]["vehicle"]), m.tick): m for m in recording.messages("image")}
    frames = {}
    for message in recording.messages("pointcloud"):
        scan = message.section("scan")[0]
        key = (int(scan["vehicle"]), message.tick)
        points = message.section("points")
        frames[key] = RecordedFrame(key[0], scan, points, worlds[message.tick], images.get(key))
    return frames
