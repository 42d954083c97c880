"""Which carrier and which of its sensors a message of a LIDAR, a camera or a radar is from (docs/suites.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caraware.ipc.names import Names
from caraware.ipc.run_file import RunFile

ROADSIDE = 1 << 30
"""Bit of `vehicle` of a carrier beside the road; the rest is its place among `[[roadside]]`."""

OWN_SENSOR = 0
"""`sensor` of the one that a section of the configuration describes (`camera.vehicles`); others belong to suites."""


@dataclass(frozen=True)
class MountedSensor:
    """A sensor on its carrier."""

    carrier: str
    """SUMO's id of the vehicle, or the name of the carrier beside the road."""
    suite: str
    """Name of the suite; "" for the sensor of a section."""
    sensor: str
    """Its name in the suite; that of the kind ("lidar", "camera", "radar") for the sensor of a section."""
    mount: tuple[float, ...]
    """x, y, z from the centre of the rear axle on the ground (m), then roll, pitch (nose up), yaw (rad)."""
    is_roadside: bool


def sensor_number(head: np.void) -> int:
    """Number of a sensor among those of its kind; recordings from before suites have none, and their sensors are 0."""
    names = head.dtype.names or ()
    return int(head["sensor"]) if "sensor" in names else OWN_SENSOR


class SensorNames:
    """Finds carriers and sensors by the numbers that messages carry, in the tables of a run file."""

    def __init__(self, run: RunFile) -> None:
        self._ids = Names(run)
        self._roadsides = [str(roadside["name"]) for roadside in run["config"].get("roadside", [])]
        units: list[dict[str, Any]] = run.get("sensor_units", [])
        self._units = {(str(unit["kind"]), int(unit["sensor"])): unit for unit in units}

    def of(self, kind: str, head: np.void) -> MountedSensor:
        """The sensor of this kind ("lidar", "camera", "radar") with this head: `Scan`, `ImageHead` or `RadarScan`."""
        vehicle, sensor = int(head["vehicle"]), sensor_number(head)
        place = vehicle & ~ROADSIDE
        is_roadside = bool(vehicle & ROADSIDE) and place < len(self._roadsides)
        unit = self._units.get((kind, sensor), {})
        return MountedSensor(
            carrier=self._roadsides[place] if is_roadside else self._ids.of(int(head["id_hash"])),
            suite=str(unit.get("suite", "")),
            sensor=str(unit.get("name", kind)),
            mount=tuple(float(part) for part in unit.get("mount", ())),
            is_roadside=is_roadside,
        )
