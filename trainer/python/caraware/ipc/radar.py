"""Radar scans: detections with the fields of ASAM OSI 3.7."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caraware import _native
from caraware.ipc.layout import record
from caraware.ipc.mounts import MountedSensor, SensorNames

DETECTION = record("RadarDetection")
"""`RadarDetection`: range (m), azimuth and elevation (rad, sensor's frame), radial velocity (m/s, positive towards the
sensor), standard deviations, cross section (dB m²), signal to noise ratio (dB), existence probability, object."""

RADAR_SCAN = record("RadarScan")
"""`RadarScan`: the radar at the end of the tick in the world (m; roll, pitch, heading in rad), and its resolutions."""

NO_OBJECT = 0xFFFF_FFFE
"""`object_id` of a detection that is noise."""


@dataclass(frozen=True)
class RadarDetections:
    """What one radar has detected at a tick; a copy, valid for ever."""

    tick: int
    sim_time_ns: int
    vehicle: int
    """Dense index of the vehicle within its episode, as in `Observation.vehicle`; beside the road `mounts.ROADSIDE` and
    a number."""
    mounted: MountedSensor
    """The carrier and the sensor, by name."""
    scan: np.void
    """`RADAR_SCAN`."""
    detections: NDArray[np.void]
    """`DETECTION [count]`, read-only, nearest first."""

    @classmethod
    def of(cls, native: _native.SightMessage, names: SensorNames) -> "RadarDetections":
        """From a message."""
        scan_bytes, detection_bytes = native.sections
        scan = np.frombuffer(scan_bytes, RADAR_SCAN)[0]
        return cls(
            tick=native.tick,
            sim_time_ns=native.sim_time_ns,
            vehicle=int(scan["vehicle"]),
            mounted=names.of("radar", scan),
            scan=scan,
            detections=np.frombuffer(detection_bytes, DETECTION),
        )
