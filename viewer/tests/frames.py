"""Builds frames as the fan-out sends them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from caraware_viewer import layout, wire
from caraware_viewer.layout import IMAGE_PLANES

RUN_ID = 7


def header(tick: int, *shape: int, **fields: int) -> bytes:
    row = np.zeros(1, wire.HEADER)
    values = {
        "schema_version": layout.SCHEMA_VERSION,
        "run_id": RUN_ID,
        "tick": tick,
        "sim_time_ns": (tick + 1) * 100_000_000,
        "shape": shape + (0,) * (4 - len(shape)),
    }
    for name, value in (values | fields).items():
        row[name] = value
    return row.tobytes()


def states(count: int = 3, tick: int = 0, **fields: Any) -> np.ndarray:
    """Road users in a row, 10 m apart, heading east; every third one is a pedestrian."""
    rows = np.zeros(count, wire.VEHICLE_STATE)
    rows["x_m"] = 10.0 * np.arange(count) + tick
    rows["y_m"] = 50.0
    rows["length_m"], rows["width_m"], rows["height_m"], rows["rear_overhang_m"] = 4.5, 1.8, 1.5, 1.0
    rows["kind"] = np.arange(count) % 3
    rows["vehicle"] = np.arange(count)
    rows["id_hash"] = 100 + np.arange(count)
    for name, value in fields.items():
        rows[name] = value
    return rows


def world(tick: int, count: int = 3, **fields: Any) -> bytes:
    return header(tick, count, 0, 0, count) + states(count, tick, **fields).tobytes()


def observation(
    tick: int, truth_xy: np.ndarray, gnss_m: np.ndarray, valid: np.ndarray | None = None, **fields: np.ndarray
) -> bytes:
    n, d, k = len(truth_xy), 2, 1
    truth = np.zeros((n, 4), np.float32)
    truth[:, :2] = truth_xy
    flags = np.ones(n, np.uint32) if valid is None else valid.astype(np.uint32)
    arrays = {"truth": truth, "gnss_m": np.pad(gnss_m, ((0, 0), (0, 1))), "vehicle": np.arange(n), "flags": flags}
    arrays |= {"id_hash": 100 + np.arange(n), "sensors": np.full(n, 7)} | fields
    payload = b""
    for section in layout.SECTIONS["observation"]:
        shape = section.sized({"slots": n, "fields": d, "imu_samples": k, "image_bytes": 0})
        payload += np.asarray(arrays.get(section.name, np.zeros(shape)), section.element).reshape(shape).tobytes()
        payload += bytes(-len(payload) % layout.ALIGNMENT)
    return header(tick, n, d, k) + payload


def prediction(tick: int, position_m: np.ndarray, estimate_m: np.ndarray | None = None) -> bytes:
    first, columns = np.asarray(position_m, "<f4").tobytes(), np.shape(position_m)[1]
    if estimate_m is None:
        return header(tick, len(position_m), columns) + first
    second = bytes(-len(first) % layout.ALIGNMENT) + np.asarray(estimate_m, "<f4").tobytes()
    return header(tick, len(position_m), columns, len(estimate_m)) + first + second


def neighbours(tick: int, known: dict[int, list[tuple[list[float], tuple[int, int, int]]]], **fields: Any) -> bytes:
    """What vehicles know, by slot: the numbers and the identity of each object. Vehicle = slot, each has a radio."""
    n, k = len(known), max([len(objects) for objects in known.values()] + [1])
    objects, ids = np.zeros((n, k, 11), np.float32), np.zeros((n, k, 3), np.uint32)
    for slot, rows in known.items():
        for place, (numbers, identity) in enumerate(rows):
            objects[slot, place], ids[slot, place] = numbers, identity
    radio = np.tile(np.array([1, 0, 0, 0, 0]), (n, 1))
    arrays = {"objects": objects, "ids": ids, "radio": radio, "vehicle": np.arange(n)} | fields
    payload = b""
    for section in layout.SECTIONS["neighbours"]:
        shape = section.sized({"slots": n, "nearest": k, "speakers": 0, "inputs": 0})
        payload += np.asarray(arrays.get(section.name, np.zeros(shape)), section.element).reshape(shape).tobytes()
        payload += bytes(-len(payload) % layout.ALIGNMENT)
    return header(tick, n, k) + payload


def vehicles(tick: int, names: dict[int, str], **fields: int) -> bytes:
    rows = np.zeros(len(names), wire.VEHICLE_META)
    for row, (id_hash, name) in zip(rows, names.items(), strict=True):
        text = name.encode()
        row["id_hash"], row["id_len"], row["id"] = id_hash, len(text), np.void(text.ljust(128, b"\0"))
    return header(tick, len(names), **fields) + rows.tobytes()


def routes(tick: int, points: dict[int, list[tuple[float, float, int, int]]], **fields: int) -> bytes:
    """Routes by the index of the hero: x, y, traffic light, link."""
    rows = np.zeros(sum(map(len, points.values())), wire.ROUTE_POINT)
    every = ((vehicle, index, *point) for vehicle, route in points.items() for index, point in enumerate(route))
    for row, values in zip(rows, every, strict=True):
        for name, value in zip(("vehicle", "index", "x_m", "y_m", "signal", "link"), values, strict=True):
            row[name] = value
    return header(tick, len(rows), **fields) + rows.tobytes()


def signals(tick: int, letters: dict[int, str], indices: Sequence[int] = ()) -> bytes:
    rows = np.zeros(len(letters), wire.SIGNAL_META)
    rows["signal"] = indices or np.arange(len(letters))
    for row, (id_hash, state) in zip(rows, letters.items(), strict=True):
        row["id_hash"], row["links"], row["state"] = id_hash, len(state), np.void(state.encode().ljust(128, b"\0"))
    return header(tick, len(letters)) + rows.tobytes()


def event(tick: int, positions_m: np.ndarray) -> bytes:
    rows = np.zeros(len(positions_m), wire.COLLISION)
    rows["position_m"] = positions_m
    return header(tick, len(rows)) + rows.tobytes()


def pointcloud(tick: int, points: dict[str, Any], **scan: Any) -> bytes:
    head = np.zeros(1, wire.SCAN)
    for name, value in ({"range_m": 50.0} | scan).items():
        head[name] = value
    rows = np.zeros(len(points["position_m"]), wire.LIDAR_POINT)
    for name, value in points.items():
        rows[name] = value
    payload = head.tobytes() + bytes(-wire.SCAN.itemsize % layout.ALIGNMENT) + rows.tobytes()
    return header(tick, len(rows), 1) + payload


def image(
    tick: int,
    pixels: dict[str, np.ndarray],
    objects: Sequence[dict[str, Any]] = (),
    events: Sequence[tuple[int, int, int, int]] = (),
    **head: Any,
) -> bytes:
    """An image with these planes, the road users in it, and events (µs, column, row, polarity)."""
    height, width = next(iter(pixels.values())).shape[:2]
    row = np.zeros(1, wire.IMAGE_HEAD)
    row["height"], row["width"], row["range_m"] = height, width, 100.0
    row["planes"] = sum(bit for name, bit, *_ in IMAGE_PLANES if name in pixels)
    for name, value in head.items():
        row[name] = value
    content = b"".join(
        np.asarray(pixels[name], scalar).tobytes() for name, _, scalar, _ in IMAGE_PLANES if name in pixels
    )
    rows = np.zeros(len(objects), wire.SEEN_OBJECT)
    for seen, values in zip(rows, objects, strict=True):
        for name, value in values.items():
            seen[name] = value
    listed = np.array(list(events), wire.BRIGHTNESS_EVENT)
    sections = [padded(section) for section in (row.tobytes(), content, rows.tobytes())]
    return header(tick, len(objects), 1, len(content), len(events)) + b"".join(sections) + listed.tobytes()


def radar(tick: int, detections: dict[str, Any], **scan: Any) -> bytes:
    """A scan with these columns of detections."""
    head = np.zeros(1, wire.RADAR_SCAN)
    for name, value in scan.items():
        head[name] = value
    rows = np.zeros(len(next(iter(detections.values()))), wire.RADAR_DETECTION)
    for name, value in detections.items():
        rows[name] = value
    return header(tick, len(rows), 1) + padded(head.tobytes()) + rows.tobytes()


def padded(section: bytes) -> bytes:
    """A section up to where the next one begins."""
    return section + bytes(-len(section) % layout.ALIGNMENT)
