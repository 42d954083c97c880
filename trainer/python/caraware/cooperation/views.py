"""What vehicles perceive of each other and hear from each other, from the block `neighbours` of a tick.

It reads rows of `v2x.listing = "separate"`. What a block lists at an age of one tick was measured at the tick before;
older rows were read before. Positions are those of centres, in the world.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caraware.ipc.arrays import Float32Array, Float64Array, UInt32Array

CAM, CPM, OWN = 1, 2, 5
"""Sources of rows that this module reads (`ipc_schema::neighbours::NeighbourSource`)."""

POSITION, VELOCITY, HEADING, LENGTH, AGE = slice(0, 2), slice(2, 4), 4, 5, 7
"""Columns of an object."""

STATION, HEARD_FROM, SOURCE = 0, 1, 2
"""Columns of its identity."""


@dataclass(frozen=True)
class HeardFix:
    """A station's own word: its centre by its newest fix."""

    station: int
    position_m: Float64Array
    velocity_mps: Float64Array
    length_m: float


@dataclass(frozen=True)
class OffsetView:
    """What a station perceives, from the middle of its front to the object's centre."""

    station: int
    heading_rad: float
    """Of the station, by its compass."""
    offset_m: Float64Array
    velocity_mps: Float64Array
    """Of the object."""


@dataclass(frozen=True)
class SlotRows:
    """The rows of one slot."""

    objects: Float32Array
    """f32 `[k, 11]`."""
    ids: UInt32Array
    """u32 `[k, 3]`."""
    tick_s: float

    def _new(self, source: int) -> Iterator[int]:
        is_new = (self.ids[:, SOURCE] == source) & (self.objects[:, AGE] < 1.5 * self.tick_s)
        return iter(np.flatnonzero(is_new).tolist())

    def reference(self, source: int) -> dict[int, tuple[Float64Array, float]]:
        """By station: the point that its objects are measured from (m), and its heading (rad)."""
        rows = np.flatnonzero((self.ids[:, SOURCE] == source) & (self.ids[:, STATION] != 0))
        return {
            int(self.ids[row, STATION]): (self.objects[row, POSITION].astype(float), float(self.objects[row, HEADING]))
            for row in rows.tolist()
        }

    def fixes(self) -> Iterator[HeardFix]:
        """What other stations said of themselves at the tick before."""
        for row in self._new(CAM):
            numbers = self.objects[row].astype(float)
            yield HeardFix(int(self.ids[row, STATION]), numbers[POSITION], numbers[VELOCITY], float(numbers[LENGTH]))

    def views(self, source: int) -> Iterator[OffsetView]:
        """What stations perceived at the tick before: `CPM`, others as they said; `OWN`, this slot's own sensors."""
        references = self.reference(source)
        for row in self._new(source):
            station = int(self.ids[row, HEARD_FROM])
            if self.ids[row, STATION] != 0 or station not in references:
                continue
            origin_m, heading_rad = references[station]
            numbers = self.objects[row].astype(float)
            yield OffsetView(station, heading_rad, numbers[POSITION] - origin_m, numbers[VELOCITY])
