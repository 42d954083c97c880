"""The detector in the loop of a simulation, and how far what it says is from the truth."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from caraware.envs import make
from caraware.examples.detector.exported import OnnxDetector, without_rivals
from caraware.examples.detector.images import CAMERA, Objects, light_of, objects_of
from caraware.examples.detector.metric import MISS, NOT_COUNTED, Detections, match
from caraware.examples.detector.objects import OBJECTS, DetectedObjects, Mounting
from caraware.examples.detector.traffic import MAPS, write_mixed_traffic
from caraware.ipc.arrays import Float64Array
from caraware.ipc.channel import Observation
from caraware.ipc.image import Image
from caraware.tasks.fields import Fields

WITHIN_M = 40.0
"""Objects that are farther away count neither as found nor as missed."""
CARRIERS = 16
FIELDS = ["speed", "steering", *(f"object_{k}_{axis}" for k in range(1, OBJECTS + 1) for axis in "xy")]


@dataclass
class Accuracy:
    """What the detector said of objects within `WITHIN_M` of the rear axle, compared with the truth."""

    errors_m: list[Float64Array] = field(default_factory=list)
    """Distances on the ground between found and true nearest points, of the objects that are found."""
    hits: int = 0
    missed: int = 0
    false: int = 0

    def add(self, found: Detections, truth: Objects, mounting: Mounting) -> None:
        """One image. A found box hits an object, whatever its class, from an IoU of 0.5 on."""
        kept = without_rivals(found.boxes_px)
        boxes = found.boxes_px[kept]
        found_at = mounting.body_m(found.places[kept], boxes[:, [1, 3]].mean(1))[:, :2]
        true_at = mounting.body_m(truth.places, truth.boxes_px[:, [1, 3]].mean(1))[:, :2]
        counts = ~truth.ignored & (np.hypot(*true_at.T) <= WITHIN_M)
        # An object beyond the range is as good as an ignored one.
        of_found = match(boxes, truth.boxes_px, ~counts)
        is_hit = of_found >= 0
        self.errors_m.append(np.hypot(*(found_at[is_hit] - true_at[of_found[is_hit]]).T))
        self.hits += int(is_hit.sum())
        self.missed += int(counts.sum() - is_hit.sum())
        self.false += int(((of_found == MISS) & (np.hypot(*found_at.T) <= WITHIN_M)).sum())
        assert NOT_COUNTED < MISS < 0

    def table(self) -> dict[str, float]:
        """Median and 90 % quantile of the error (m), recall, precision, number of objects."""
        errors_m = np.concatenate(self.errors_m)
        median, tenth = np.quantile(errors_m, [0.5, 0.9]) if len(errors_m) else (np.nan, np.nan)
        return {
            "error_median_m": float(median),
            "error_p90_m": float(tenth),
            "recall": self.hits / max(self.hits + self.missed, 1),
            "precision": self.hits / max(self.hits + self.false, 1),
            "objects": float(self.hits + self.missed),
        }


def run(detector: OnnxDetector, scenario: str, seed: int, duration_s: float, **settings: Any) -> dict[str, float]:
    """Drives mixed traffic on a map of `MAPS`, or a `.sumocfg`, with the detector in the loop.

    Every tick's images go through the detector, and the observation that a policy would get has its `object_*` fields.
    The result is `Accuracy.table` with the time for each image and tick, and with `nearest_median_m`: how far
    `object_1_*` is from the LIDAR's, where both are ahead, in the camera's view, within `WITHIN_M`.
    """
    accuracy, waiting, spent_s, images, ticks = Accuracy(), list[Image](), 0.0, 0, 0
    apart_m: list[float] = []
    with tempfile.TemporaryDirectory(prefix="caraware-detector-") as folder:
        config = write_mixed_traffic(scenario, Path(folder), seed, duration_s) if scenario in MAPS else Path(scenario)
        observed = {
            "camera.vehicles": CARRIERS,
            "camera.observed": "rgb",
            "lidar.vehicles": CARRIERS,
            "observation.fields": FIELDS,
            "run.window_ticks": 2,
            "episode.ticks": round(duration_s / 0.1),
        }
        with make(config, CAMERA | light_of(seed) | observed | settings, seed) as simulation:
            channel, objects = simulation.channel, DetectedObjects(detector, simulation.run)
            fields = Fields.from_run(simulation.run)
            half_view = np.radians(float(simulation.run["config"]["camera"]["horizontal_fov_deg"]) / 2)
            channel.images()  # the first call subscribes
            while (obs := simulation.receive()) is not None and obs.episode == 0:
                assert isinstance(obs, Observation)
                # What a learner does.
                began = time.perf_counter()
                found = objects.found(obs.images)
                filled = objects.filled_with(obs.observation, found)
                spent_s += time.perf_counter() - began
                ticks, images = ticks + 1, images + len(found)
                # What only an examiner does.
                waiting = [image for image in [*waiting, *channel.images()] if image.tick >= obs.tick]
                slot_of = {int(vehicle): slot for slot, vehicle in enumerate(obs.vehicle[: len(found)])}
                for image in waiting:
                    if image.tick == obs.tick and image.vehicle in slot_of:
                        accuracy.add(found[slot_of[image.vehicle]], objects_of(image), objects.mounting)
                pair = [
                    np.stack([fields.si(rows.numpy()[: len(found)], f"object_1_{axis}") for axis in "xy"], axis=1)
                    for rows in (filled, obs.observation)
                ]
                seen = np.logical_and.reduce(
                    [(np.hypot(*at.T) < WITHIN_M) & (np.abs(np.arctan2(at[:, 1], at[:, 0])) < half_view) for at in pair]
                )
                apart_m += np.hypot(*(pair[0] - pair[1])[seen].T).tolist()
                channel.consumed(obs.tick)
    return accuracy.table() | {
        "nearest_median_m": float(np.median(apart_m)) if apart_m else float("nan"),
        "ticks": float(ticks),
        "images": float(images),
        "ms_per_image": 1e3 * spent_s / max(images, 1),
        "ms_per_tick": 1e3 * spent_s / max(ticks, 1),
    }
