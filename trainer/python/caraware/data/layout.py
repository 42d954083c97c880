"""Payloads of recorded messages: their sections as numpy types and places, from the tables of the extension."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from caraware import _native
from caraware.ipc.layout import record

_LAYOUT: dict[str, Any] = json.loads(_native.LAYOUT_JSON)
_RECORDS = {row["name"] for row in _LAYOUT["types"]}

HEADER = record("MessageHeader")
"""Header of every message: tick, episode, simulated time, and the sizes of the payload's dimensions."""


@dataclass(frozen=True)
class SectionPlace:
    """A section of one payload: its bytes, its scalar or record, and its shape."""

    offset: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Bytes."""
        return self.dtype.itemsize * int(np.prod(self.shape, dtype=np.int64))


@cache
def scalar_type(name: str) -> np.dtype[Any]:
    """The type of a scalar as numpy writes it, or of a record."""
    return record(name) if name in _RECORDS else np.dtype(name)


def _payload(channel: str) -> Any:
    return next(row for row in _LAYOUT["payloads"] if row["name"] == channel)


@cache
def sections(channel: str) -> tuple[str, ...]:
    """Names of the sections of a channel's payload. Raises `StopIteration` for an unknown channel."""
    return tuple(section["name"] for section in _payload(channel)["sections"])


@cache
def places(channel: str, sizes: tuple[int, ...]) -> Mapping[str, SectionPlace]:
    """Place of every section in a payload whose dimensions have these sizes, in the order of the header's shape."""
    payload = _payload(channel)
    by_name = dict(zip(payload["dimensions"], sizes, strict=False))
    found: dict[str, SectionPlace] = {}
    offset, alignment = 0, int(_LAYOUT["alignment"])
    for section in payload["sections"]:
        shape = (*(by_name[name] for name in section["dimensions"]), *section["shape"])
        place = SectionPlace(offset, scalar_type(section["scalar"]), shape)
        found[section["name"]] = place
        offset = -(-(offset + place.size) // alignment) * alignment
    return found


def section(channel: str, header: np.void, payload: bytes, name: str) -> np.ndarray[Any, np.dtype[Any]]:
    """Section `name` of a payload as a read-only array over its bytes."""
    place = places(channel, tuple(int(size) for size in header["shape"]))[name]
    count = int(np.prod(place.shape, dtype=np.int64))
    if count == 0:
        return np.empty(place.shape, place.dtype)
    return np.frombuffer(payload, place.dtype, count, place.offset).reshape(place.shape)
