"""The tables of `layout.json` as numpy types: records, sections of payloads, sensors.

`layout.json` beside this file is a copy of the committed tables in `ipc-schema`; a test compares the two.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, TypedDict

import numpy as np


class _RecordRow(TypedDict):
    name: str
    size: int
    fields: list[tuple[str, int, str, list[int]]]
    """Name, offset, scalar and shape of each field."""


class _SectionRow(TypedDict):
    name: str
    scalar: str
    """A scalar as numpy writes it, or the name of a record."""
    dimensions: list[str]
    shape: list[int]


class _PayloadRow(TypedDict):
    name: str
    dimensions: list[str]
    sections: list[_SectionRow]


class _SensorRow(TypedDict):
    name: str
    label: str
    bit: int


class _PlaneRow(TypedDict):
    name: str
    bit: int
    scalar: str
    shape: list[int]


class _Tables(TypedDict):
    schema_version: int
    alignment: int
    types: list[_RecordRow]
    payloads: list[_PayloadRow]
    sensors: list[_SensorRow]
    image_planes: list[_PlaneRow]


_TABLES: _Tables = json.loads(resources.files("caraware_viewer").joinpath("layout.json").read_text(encoding="utf-8"))

SCHEMA_VERSION = _TABLES["schema_version"]

ALIGNMENT = _TABLES["alignment"]
"""Sections of a payload start on multiples of this, bytes from the payload's start."""


def _record(row: _RecordRow) -> np.dtype[np.void]:
    names, offsets, scalars, shapes = zip(*row["fields"], strict=True)
    formats = [(scalar, tuple(shape)) for scalar, shape in zip(scalars, shapes, strict=True)]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": row["size"]})


RECORDS = {row["name"]: _record(row) for row in _TABLES["types"]}
"""Type of every record, by name."""


@dataclass(frozen=True)
class Section:
    """A section of a payload."""

    name: str
    element: np.dtype[Any]
    """A scalar or a record."""
    dimensions: tuple[str, ...]
    """Names of the leading dimensions, whose sizes a header gives."""
    shape: tuple[int, ...]
    """The dimensions behind them, which never change."""

    def sized(self, sizes: dict[str, int]) -> tuple[int, ...]:
        """Shape of the section for these sizes of its leading dimensions."""
        return (*(sizes[dimension] for dimension in self.dimensions), *self.shape)


def _sections(rows: Iterable[_SectionRow]) -> Sequence[Section]:
    return [
        Section(
            row["name"],
            RECORDS.get(row["scalar"]) or np.dtype(row["scalar"]),
            tuple(row["dimensions"]),
            tuple(row["shape"]),
        )
        for row in rows
    ]


SECTIONS = {row["name"]: _sections(row["sections"]) for row in _TABLES["payloads"]}
"""Sections of every payload, by the name of its channel."""

DIMENSIONS = {row["name"]: tuple(row["dimensions"]) for row in _TABLES["payloads"]}
"""Names of the dimensions of a payload's sections, in the order of a header's `shape`, by the name of its channel."""


@dataclass(frozen=True)
class Sensor:
    """A kind of sensor."""

    name: str
    """Name in commands and JSON."""
    label: str
    """Name in the HUD."""
    bit: int
    """Bit of an observation's `sensors`: the sensor delivers."""


IMAGE_PLANES: tuple[tuple[str, int, str, tuple[int, ...]], ...] = tuple(
    (row["name"], row["bit"], row["scalar"], tuple(row["shape"])) for row in _TABLES["image_planes"]
)
"""Name, bit in `ImageHead.planes`, scalar and shape of a pixel of each plane, in the order in which a message has
them."""

SENSORS = [Sensor(row["name"], row["label"], row["bit"]) for row in _TABLES["sensors"]]
"""Every sensor, in the order of an observation's ages."""
