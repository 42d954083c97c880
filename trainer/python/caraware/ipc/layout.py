"""Records in shared memory as numpy types, and the sensors' bits, from the tables of the native extension."""

import json
from typing import Any

import numpy as np

from caraware import _native

_LAYOUT: dict[str, Any] = json.loads(_native.LAYOUT_JSON)

SENSOR_BITS: dict[str, int] = {row["name"]: row["bit"] for row in _LAYOUT["sensors"]}
"""Bit of each sensor in an observation's `sensors`, by its name in commands and keys."""

IMAGE_PLANES: tuple[tuple[str, int, str, tuple[int, ...]], ...] = tuple(
    (row["name"], row["bit"], row["scalar"], tuple(row["shape"])) for row in _LAYOUT["image_planes"]
)
"""Name, bit in `ImageHead.planes`, scalar and shape of a pixel of each plane, in the order in which a message has
them."""

VEHICLE_CLASSES: list[str] = _LAYOUT["vehicle_classes"]
"""SUMO's vehicle classes, by their numbers in `VehicleState.class`."""


def record(name: str) -> np.dtype[np.void]:
    """The record `name` of `ipc-schema/layout.json`: fields, offsets and size."""
    table = next(row for row in _LAYOUT["types"] if row["name"] == name)
    return np.dtype(
        {
            "names": [field for field, *_ in table["fields"]],
            "formats": [(scalar, tuple(shape)) for _, _, scalar, shape in table["fields"]],
            "offsets": [offset for _, offset, *_ in table["fields"]],
            "itemsize": table["size"],
        }
    )
