"""Frames made by hand, as a fan-out would send them."""

from __future__ import annotations

import numpy as np

from caraware_viewer import wire


def header(tick: int, count: int, columns: int, **fields: int) -> bytes:
    row = np.zeros(1, wire.HEADER)
    values = {
        "schema_version": wire.SCHEMA_VERSION,
        "run_id": 7,
        "tick": tick,
        "sim_time_ns": (tick + 1) * 100_000_000,
        "count": count,
        "columns": columns,
    }
    for name, value in (values | fields).items():
        row[name] = value
    return row.tobytes()


def world(tick: int, count: int = 3) -> bytes:
    states = np.zeros(count, wire.VEHICLE_STATE)
    states["x_m"] = 10.0 * np.arange(count) + tick
    states["y_m"] = 50.0
    states["length_m"], states["width_m"], states["rear_overhang_m"] = 4.5, 1.8, 1.0
    states["kind"] = np.arange(count) % 3
    states["vehicle"] = np.arange(count)
    return header(tick, count, 0) + states.tobytes()


def observation(tick: int, truth_xy: np.ndarray, gnss_m: np.ndarray, valid: np.ndarray | None = None) -> bytes:
    n, d = len(truth_xy), 2
    truth = np.zeros((n, 4), np.float32)
    truth[:, :2] = truth_xy
    flags = np.ones(n, np.uint32) if valid is None else valid.astype(np.uint32)
    arrays = {"truth": truth, "gnss_m": np.pad(gnss_m, ((0, 0), (0, 1))), "vehicle": np.arange(n), "flags": flags}
    payload = b""
    for name, element, shape in wire.observation_sections(n, d, 0):
        payload += np.asarray(arrays.get(name, np.zeros(shape)), element).reshape(shape).tobytes()
        payload += bytes(-len(payload) % wire.ALIGNMENT)
    return header(tick, n, d) + payload


def prediction(tick: int, position_m: np.ndarray) -> bytes:
    return header(tick, len(position_m), 2) + np.asarray(position_m, "<f4").tobytes()
