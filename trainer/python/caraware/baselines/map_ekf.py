"""The Kalman filter with a map: drivers keep their lanes, so the way to the lane is a measurement of 0.

Beside every fix, wheel speed and compass the filter gets a pseudo-measurement (J. Bar-Shalom and others, section 7;
D. Simon and T. L. Chia, Kalman filtering with state equality constraints, IEEE Transactions on Aerospace and
Electronic Systems 38(1), 2002): the nose of the vehicle lies on the middle of the nearest lane that leads its way. It
is causal, sees no truth, and is tuned as the filter is: by the configuration of the sensors, and by what is known of
drivers (`LaneKeeping`). Equations and figures: docs/baselines.md.
"""

import logging
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch

from caraware.baselines.ekf import Belief, Ekf
from caraware.baselines.lanes import LaneMap, Pieces, read_pieces
from caraware.baselines.motion import YAW, MotionModel, X, Y
from caraware.baselines.noise import SensorNoise
from caraware.ipc.arrays import BoolArray, Float64Array
from caraware.ipc.run_file import RunFile

log = logging.getLogger(__name__)

MOST_PIECES = 20_000
"""Straight pieces of lanes of a map. The raster of a larger net would take longer than an evaluation."""


@dataclass(frozen=True)
class LaneKeeping:
    """What is known of drivers and lanes, chosen on training episodes; evaluations report (docs/baselines.md)."""

    nose_m: float = 3.7
    """From the rear axle to the point that drivers keep on the lane: a car's front."""
    std_m: float = 1.0
    """Of the nose about the middle of the lane."""
    same_way_rad: float = math.radians(34.0)
    """A lane that leads further away from the heading is not the one that the vehicle drives on."""
    gate: float = 6.0
    """Standard deviations of the innovation beyond which the vehicle drives on no lane of the map."""
    metres_per_rad: float = 4.0
    """How much a difference in heading counts against distance in the search for the nearest lane."""


class MapEkf(Ekf):
    """The filters of all slots, as `Ekf`, corrected by the lanes as well."""

    def __init__(
        self,
        noise: SensorNoise,
        lanes: LaneMap,
        keeping: LaneKeeping | None = None,
        model: MotionModel | None = None,
    ) -> None:
        """`lanes` has one question: `lane_map` makes it."""
        super().__init__(noise, model)
        self._lanes, self._keeping = lanes, keeping or LaneKeeping()
        self.before_map = self.belief
        """The belief at this tick before the lanes corrected it."""

    def _correct_by_map(self, use: BoolArray) -> None:
        """`0 = nᵀ (p + l (cos ψ, sin ψ) − q) + n`: `q` is on the nearest lane, `n` the normal of the lane there."""
        mean, keeping = self.belief.mean, self._keeping
        self.before_map = Belief(mean.copy(), self.belief.covariance.copy())
        if not use.any():
            return
        east, north = np.cos(mean[YAW]), np.sin(mean[YAW])
        nose = np.stack((mean[X] + keeping.nose_m * east, mean[Y] + keeping.nose_m * north, mean[YAW]))
        match = self._lanes.match(*(torch.from_numpy(row.astype(np.float32))[None] for row in nose))
        ahead_m, left_m, turned_rad, found = (
            column[0].double().numpy() for column in (match.ahead_m, match.left_m, match.turned_rad, match.found)
        )
        lane_rad = mean[YAW] + turned_rad
        # The normal of the lane, and how far along it the lane lies from the nose.
        normal_east, normal_north = -np.sin(lane_rad), np.cos(lane_rad)
        way_east, way_north = ahead_m * east - left_m * north, ahead_m * north + left_m * east
        innovation_m: Float64Array = way_east * normal_east + way_north * normal_north
        swing = keeping.nose_m * np.cos(turned_rad)
        row = [(X, normal_east), (Y, normal_north), (YAW, swing)]
        spread = self._spread(row, row) + keeping.std_m**2
        near = innovation_m**2 < keeping.gate**2 * spread
        self.belief.correct(row, innovation_m, keeping.std_m**2, use & near & (found > 0))


def lane_map(pieces: Pieces, keeping: LaneKeeping | None = None) -> LaneMap:
    """The lanes as `MapEkf` looks them up."""
    keeping = keeping or LaneKeeping()
    return LaneMap(pieces, (keeping.metres_per_rad,), keeping.same_way_rad)


@lru_cache(maxsize=1)
def lanes_of_net(net_file: Path, world_origin_m: tuple[float, float] = (0.0, 0.0)) -> LaneMap | None:
    """The lanes of a net as `MapEkf` looks them up; None if it cannot be read, has none, or is too large.

    The world frame's (0, 0) lies at `world_origin_m` of the net.
    """
    try:
        pieces = read_pieces(net_file, world_origin_m)
    except (OSError, ElementTree.ParseError) as error:
        log.warning("no filter with a map: %s cannot be read (%s)", net_file, error)
        return None
    if not 0 < len(pieces) <= MOST_PIECES:
        log.info("no filter with a map: the net has %d pieces of lanes, at most %d", len(pieces), MOST_PIECES)
        return None
    return lane_map(pieces)


def net_of_run(run: RunFile) -> Path | None:
    """The net that all episodes of a run drive on; None where episodes have several."""
    files = run.get("scene_files") or {}
    several = run["config"].get("curriculum", {}).get("maps")
    return Path(files["net_file"]) if files.get("net_file") and not several else None


def world_origin_of_run(run: RunFile) -> tuple[float, float]:
    """Where the world frame's (0, 0) lies in the net, metres; (0, 0) where the run file does not say."""
    x_m, y_m = (run.get("map") or {}).get("world_origin_m", (0.0, 0.0))
    return float(x_m), float(y_m)
