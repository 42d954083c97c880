"""Images of a simulation with the boxes and places of the road users in them."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from caraware.envs import make
from caraware.examples.detector.traffic import MAPS, write_mixed_traffic
from caraware.ipc.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from caraware.ipc.image import Image, Label

CAMERA: dict[str, Any] = {
    "camera.vehicles": 24,
    "camera.width": 192,
    "camera.height": 96,
    "camera.horizontal_fov_deg": 70.0,
    "camera.depth": True,
    "camera.instance": True,
    "camera.semantic": False,
    "camera.rgb": True,
}
"""Settings of the cameras that the detector is trained for. Depth and instance are for its labels only."""


class Class(IntEnum):
    """What the detector tells apart. Classes are those of the simulator's cameras (docs/camera.md)."""

    PERSON = 0
    TWO_WHEELER = 1
    CAR = 2
    TRUCK = 3
    """Vans, trucks, buses and trams."""


CLASS_OF = {
    Label.PERSON: Class.PERSON,
    Label.BICYCLE: Class.TWO_WHEELER,
    Label.MOTORCYCLE: Class.TWO_WHEELER,
    Label.CAR: Class.CAR,
    Label.TRUCK: Class.TRUCK,
    Label.BUS: Class.TRUCK,
    Label.TRAIN: Class.TRUCK,
}

MIN_HEIGHT_PX, MIN_VISIBLE_PX, MIN_VISIBLE_SHARE, MAX_TRUNCATED = 6, 20, 0.3, 0.5
"""An object below the first three or above the last is ignored. The rules are KITTI's (A. Geiger, P. Lenz, R. Urtasun,
*Are we ready for Autonomous Driving?*, CVPR 2012), whose least height is 25 of 375 rows; ours is 6 of 96. The visible
share is that of the visible box in the part of the full box within the image."""


@dataclass(frozen=True)
class Objects:
    """The k road users in an image."""

    boxes_px: Float32Array
    """f32 [k, 4]: left, top, right and bottom edge of what is visible, from the upper left corner of the image."""
    classes: Int64Array
    """i64 [k]: `Class`."""
    places: Float32Array
    """f32 [k, 2]: column (pixels) and depth (metres, along the optical axis) of the nearest visible point."""
    ignored: BoolArray
    """bool [k]: too small, too hidden or too far beyond the image to count as a hit or a miss."""


@dataclass(frozen=True)
class LabelledImages:
    """N images of one size."""

    rgb: np.ndarray[Any, np.dtype[np.uint8]]
    """u8 [N, 3, height, width]."""
    objects: list[Objects]

    def __len__(self) -> int:
        return len(self.rgb)

    @classmethod
    def joined(cls, parts: Sequence[LabelledImages]) -> LabelledImages:
        """All images of all parts, in order."""
        return cls(np.concatenate([part.rgb for part in parts]), [one for part in parts for one in part.objects])

    def count(self) -> dict[str, tuple[int, int]]:
        """For each class the number of boxes that count, and of those that are ignored."""
        classes = np.concatenate([one.classes for one in self.objects])
        ignored = np.concatenate([one.ignored for one in self.objects])
        return {
            kind.name.lower(): (int((~ignored[classes == kind]).sum()), int(ignored[classes == kind].sum()))
            for kind in Class
        }


def focal_px(width: int, horizontal_fov_deg: float) -> float:
    """Distance of the pinhole from the image, pixels (docs/camera.md)."""
    return width / (2 * math.tan(math.radians(horizontal_fov_deg) / 2))


def objects_of(image: Image) -> Objects:
    """The labels of an image. Raises ValueError for one without the planes depth and instance."""
    if image.depth_m is None or image.instance is None:
        raise ValueError("labels need the planes depth and instance: set `camera.depth` and `camera.instance`")
    seen = image.objects[np.isin(image.objects["label"], list(CLASS_OF))]
    edges = seen["visible_box_px"].astype(np.float32) + np.array([0, 0, 1, 1], np.float32)
    height, width = image.depth_m.shape
    full = seen["full_box_px"].clip(0, [width, height, width, height])
    visible_share = _area(edges) / np.maximum(_area(full), 1e-6)
    ignored = (
        (edges[:, 3] - edges[:, 1] < MIN_HEIGHT_PX)
        | (seen["visible_px"] < MIN_VISIBLE_PX)
        | (visible_share < MIN_VISIBLE_SHARE)
        | (seen["truncated"] > MAX_TRUNCATED)
    )
    slope = (np.arange(width) + 0.5 - width / 2) / float(image.head["focal_px"])
    places = np.zeros((len(seen), 2), np.float32)
    for row, (left, top, right, bottom) in enumerate(edges.astype(int)):
        part = np.s_[top:bottom, left:right]
        distance = np.hypot(1.0, slope[left:right]) * image.depth_m[part]
        distance[image.instance[part] != seen["object"][row]] = np.inf
        v, u = np.unravel_index(np.argmin(distance), distance.shape)
        places[row] = left + u + 0.5, image.depth_m[top + v, left + u]
    classes = np.array([CLASS_OF[Label(label)] for label in seen["label"]], np.int64)
    return Objects(edges, classes, places, ignored.astype(np.bool_))


def _area(boxes: Float32Array) -> Float64Array:
    area: Float64Array = (boxes[:, 2] - boxes[:, 0]).astype(np.float64) * (boxes[:, 3] - boxes[:, 1])
    return area


def light_of(seed: int) -> dict[str, float]:
    """Sun and haze of a seed: settings of `[weather]`."""
    rng = np.random.default_rng([seed, 1])
    return {
        "weather.sun_elevation_deg": float(rng.uniform(10.0, 70.0)),
        "weather.sun_azimuth_deg": float(rng.uniform(0.0, 360.0)),
        "weather.sunlight": float(rng.uniform(0.0, 1.0)),
        "weather.visibility_m": float(np.exp(rng.uniform(np.log(150.0), np.log(5000.0)))),
    }


def collect(scenario: str, seed: int, duration_s: float, every_s: float = 2.0, **settings: Any) -> LabelledImages:
    """Images of `duration_s` of a simulation, one for each camera and `every_s`, with their labels.

    `scenario` is a map of `MAPS`, on which mixed traffic drives, or a `.sumocfg`, which drives as it is. The seed draws
    traffic and light. Images without a road user are left out. Raises `SimulationError` where the simulation cannot
    run, and ValueError where no image is left.
    """
    rgb, objects = [], []
    with tempfile.TemporaryDirectory(prefix="caraware-detector-") as folder:
        config = write_mixed_traffic(scenario, Path(folder), seed, duration_s) if scenario in MAPS else Path(scenario)
        every = CAMERA | light_of(seed) | {"camera.period_s": every_s, "run.window_ticks": 2} | settings
        for image in _images_of(config, every, seed, duration_s):
            assert image.rgb is not None
            if len(image.objects):
                rgb.append(image.rgb.transpose(2, 0, 1).copy())
                objects.append(objects_of(image))
    if not rgb:
        raise ValueError(f"no image of {scenario} shows a road user in {duration_s} s")
    return LabelledImages(np.stack(rgb), objects)


def _images_of(config: Path, settings: dict[str, Any], seed: int, duration_s: float) -> Iterator[Image]:
    """All images of an episode."""
    with make(config, settings | {"episode.ticks": round(duration_s / 0.1)}, seed) as simulation:
        channel = simulation.channel
        channel.images()  # the first call subscribes
        while (obs := simulation.receive()) is not None and obs.episode == 0:
            yield from channel.images()
            channel.consumed(obs.tick)
