"""Radar detections: as a Parquet table, as nuScenes' point clouds, and their velocities over ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from caraware.data.export.card import source
from caraware.data.export.frames import DeliveredSensors, Frame, RadarSample, delivered_sensors, frames
from caraware.data.export.scans import require_channels
from caraware.data.export.sensors import Omission, carrier_name, left_out
from caraware.data.names import RoadUsers
from caraware.data.recording import Array, Episode, Recording, RecordingError
from caraware.ipc.arrays import Float64Array

MEANING = "One row for each radar detection, with the radar, its carrier, and the place in the world."
"""What a row is, for the data card."""

STATIONARY_MPS = 0.5
"""Radial speed over ground up to which a detection is stationary in nuScenes' `dyn_prop`."""

LINEAR_RMS = (
    *(0.005, 0.006, 0.008, 0.011, 0.014, 0.018, 0.023, 0.029, 0.038, 0.049, 0.063, 0.081, 0.105, 0.135, 0.174, 0.224),
    *(0.288, 0.371, 0.478, 0.616, 0.794, 1.023, 1.317, 1.697, 2.187, 2.817, 3.630, 4.676, 6.025, 7.762, 10.0),
)
"""Upper bounds (m or m/s) of the codes 0 … 30 of standard deviations of Continental's ARS 408, which nuScenes has."""

FALSE_ALARM = (0.25, 0.5, 0.75, 0.9, 0.99, 0.999)
"""Upper bounds of the probabilities of nuScenes' `pdh0` 1 … 6; above them it is 7."""

NUSCENES = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z")),
        *(("dyn_prop", "<i1"), ("id", "<i2")),
        *((name, "<f4") for name in ("rcs", "vx", "vy", "vx_comp", "vy_comp")),
        *((name, "<i1") for name in ("is_quality_valid", "ambig_state", "x_rms", "y_rms", "invalid_state", "pdh0")),
        *((name, "<i1") for name in ("vx_rms", "vy_rms")),
    ]
)
"""A detection in nuScenes' files, 43 bytes."""

USERS_BELOW = 1 << 30
"""`object_id` of road users is below; above are buildings, props and noise."""


def over_ground_mps(radar: RadarSample, own: np.void) -> Float64Array:
    """f64 [count]: radial velocities over ground, positive away from the radar.

    The motion of the radar is taken off: that of its carrier (`VehicleState`), and the carrier's turn about its axle.
    """
    sin, cos = np.sin(own["yaw_rad"]), np.cos(own["yaw_rad"])
    along, left = (float(value) for value in own["velocity_body_mps"][:2])
    east_m, north_m = (float(radar.head["position_m"][i]) - float(own[name]) for i, name in enumerate(("x_m", "y_m")))
    turn = float(own["angular_rate_body_radps"][2])
    radar_mps = np.array([along * cos - left * sin - turn * north_m, along * sin + left * cos + turn * east_m])
    place_m = radar.position_m
    away = place_m / np.linalg.norm(place_m, axis=1, keepdims=True) @ radar.world_from_sensor[:3, :3].T
    velocity: Float64Array = away[:, :2] @ radar_mps - radar.detections["radial_velocity_mps"]
    return velocity


def nuscenes_points(radar: RadarSample, own: np.void) -> bytes:
    """A `.pcd` file as nuScenes' devkit reads it; a scan without a detection has one that is not a number."""
    detections, place_m = radar.detections, radar.position_m
    rows = np.zeros(max(len(detections), 1), NUSCENES)
    if len(detections) == 0:
        rows["x"] = np.nan
    else:
        for place, name in enumerate("xyz"):
            rows[name] = place_m[:, place]
        ground_mps = over_ground_mps(radar, own)
        ahead = place_m[:, :2] / np.linalg.norm(place_m, axis=1, keepdims=True)
        for name, radial_mps in (("", -detections["radial_velocity_mps"].astype(np.float64)), ("_comp", ground_mps)):
            rows[f"vx{name}"], rows[f"vy{name}"] = (radial_mps[:, None] * ahead).T
        # 0 moving (away), 1 stationary, 2 oncoming.
        moving = np.where(ground_mps > 0, 0, 2)
        rows["dyn_prop"] = np.where(np.abs(ground_mps) <= STATIONARY_MPS, 1, moving)
        rows["id"] = np.arange(len(detections))
        rows["rcs"] = detections["rcs_dbsm"]
        rows["is_quality_valid"] = 1
        # Unambiguous; no detection is marked as invalid.
        rows["ambig_state"] = 3
        range_rmse, azimuth_rmse, _ = detections["position_rmse"].astype(np.float64).T
        across_m = azimuth_rmse * detections["distance_m"]
        for name, forward, sideways in (
            ("x_rms", *np.abs(ahead.T)),
            ("y_rms", *np.abs(ahead.T)[::-1]),
        ):
            rows[name] = _rms_code(np.hypot(range_rmse * forward, across_m * sideways))
        for name, share in zip(("vx_rms", "vy_rms"), np.abs(ahead.T), strict=True):
            rows[name] = _rms_code(detections["radial_velocity_rmse_mps"] * share)
        rows["pdh0"] = 1 + np.searchsorted(FALSE_ALARM, 1 - detections["existence_probability"].astype(np.float64))
    formats = [NUSCENES[name] for name in NUSCENES.names or ()]
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(NUSCENES.names or ())}\n"
        f"SIZE {' '.join(str(one.itemsize) for one in formats)}\n"
        f"TYPE {' '.join(one.kind.upper() for one in formats)}\n"
        f"COUNT {' '.join('1' for _ in formats)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    # The devkit asks for a byte behind the last point.
    return head.encode() + rows.tobytes() + b"\n"


def _rms_code(deviation: Float64Array) -> Array:
    codes: Array = np.minimum(np.searchsorted(LINEAR_RMS, deviation), len(LINEAR_RMS) - 1)
    return codes


def _table(frame: Frame, radar: RadarSample, users: RoadUsers) -> pa.Table:
    detections, mounted, count = radar.detections, radar.mounted, len(radar.detections)
    in_world = np.c_[radar.position_m, np.ones(count)] @ radar.world_from_sensor.T
    ids = {int(state["vehicle"]): users.of(state["id_hash"]).id for state in frame.states}
    object_id = detections["object_id"].astype(np.int64)
    columns = {
        "tick": pa.array(np.full(count, frame.tick, np.int64)),
        "time_s": pa.array(np.full(count, float(radar.message.header["sim_time_ns"]) * 1e-9)),
        **{
            name: pa.array([text] * count, pa.string())
            for name, text in (
                ("carrier", carrier_name(frame.carrier)),
                ("carrier_id", mounted.carrier),
                ("suite", mounted.suite),
                ("radar", mounted.sensor),
            )
        },
        **{
            name: pa.array(np.ascontiguousarray(detections[name]))
            for name in (
                *("distance_m", "azimuth_rad", "elevation_rad", "radial_velocity_mps", "radial_velocity_rmse_mps"),
                *("rcs_dbsm", "snr_db", "existence_probability"),
            )
        },
        **{
            name: pa.array(np.ascontiguousarray(detections["position_rmse"][:, place]))
            for place, name in enumerate(("distance_rmse_m", "azimuth_rmse_rad", "elevation_rmse_rad"))
        },
        "radial_velocity_over_ground_mps": pa.array(-over_ground_mps(radar, frame.own)),
        **{f"{name}_m": pa.array(in_world[:, place]) for place, name in enumerate("xyz")},
        "is_road_user": pa.array(object_id < USERS_BELOW),
        "object_id": pa.array(object_id),
        "object": pa.array([ids.get(int(number)) for number in object_id], pa.string()),
    }
    return pa.table(columns)


def write_radar(recording: Recording, episode: Episode, path: Path) -> None:
    """Write the radar detections of one episode as Parquet, compressed by zstd, a row group for each 64 scans.

    Raises `RecordingError` if the recording has no `world`, no `radar`, or no scan.
    """
    require_channels(recording, "world", "radar")
    users, writer = RoadUsers(recording), None
    waiting: list[pa.Table] = []
    for frame in frames(recording, episode, delivered_sensors(recording, episode)):
        waiting += [_table(frame, radar, users) for radar in frame.radars]
        if waiting and writer is None:
            schema = waiting[0].schema.with_metadata(source(recording, episode))
            writer = pyarrow.parquet.ParquetWriter(path, schema, compression="zstd")
        if writer is not None and len(waiting) >= 64:
            writer.write_table(pa.concat_tables(waiting).replace_schema_metadata(schema.metadata))
            waiting.clear()
    if writer is None:
        raise RecordingError(f"{recording.path}: no carrier has a radar: set radar.vehicles or suite")
    if waiting:
        writer.write_table(pa.concat_tables(waiting).replace_schema_metadata(schema.metadata))
    writer.close()


def lacks(delivered: DeliveredSensors, carrier: int) -> list[Omission]:
    """The table has radars alone."""
    others = [key for key in delivered.of[carrier] if key[0] != "radar"]
    return left_out(delivered, carrier, others, "this table has radar detections alone")
