"""The `object_*` fields of an observation, filled by the detector instead of by a LIDAR."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caraware.examples.detector.exported import OnnxDetector, without_rivals
from caraware.examples.detector.images import focal_px
from caraware.examples.detector.metric import Detections
from caraware.ipc.arrays import Float32Array, Float64Array
from caraware.ipc.image import ImageShape
from caraware.ipc.run_file import ConfigError, ConfigTable, RunFile
from caraware.tasks.fields import Fields

OBJECTS = 4
"""`object_1_x` to `object_4_y`."""


class Mounting:
    """A pinhole camera on a vehicle: from places in an image to the vehicle's frame."""

    def __init__(self, camera: ConfigTable) -> None:
        """`camera` is the section `[camera]` of a configuration."""
        self._width, self._height = int(camera["width"]), int(camera["height"])
        self._focal_px = focal_px(self._width, float(camera["horizontal_fov_deg"]))
        *position, roll, pitch, yaw = (float(part) for part in camera["mount"])
        self._position = np.array(position)
        self._body_from_camera = _rotation(roll, pitch, yaw)

    def body_m(self, places: Float32Array, rows_px: Float32Array) -> Float64Array:
        """f64 [k, 3]: ahead and left of the centre of the rear axle, and above the ground, metres.

        `places` [k, 2] are columns (pixels) and depths (metres along the optical axis); `rows_px` [k] are rows.
        """
        depth = places[:, 1].astype(np.float64)
        left = (self._width / 2 - places[:, 0]) / self._focal_px * depth
        up = (self._height / 2 - rows_px) / self._focal_px * depth
        moved: Float64Array = np.stack([depth, left, up], axis=1) @ self._body_from_camera.T + self._position
        return moved


def _rotation(roll: float, pitch: float, yaw: float) -> Float64Array:
    """Columns are the camera's x, y and z in the body's frame; roll about x first, then pitch (nose up), then yaw."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(angle), np.sin(angle)) for angle in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    nose_up = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    turned: Float64Array = about_z @ nose_up @ about_x
    return turned


class DetectedObjects:
    """Replaces the `object_*` fields of observations by what the detector finds in their images."""

    def __init__(self, detector: OnnxDetector, run: RunFile) -> None:
        """For the observations of one run. Raises `ConfigError` where they lack images or the fields."""
        config = run["config"]
        shape = ImageShape.from_run(run)
        if shape is None or shape.plane != "rgb":
            raise ConfigError("the observation has no images in colour", 'set camera.observed = "rgb"')
        if (shape.height, shape.width) != (detector.height, detector.width):
            raise ConfigError(
                f"images of {shape.width} × {shape.height} pixels are not what the detector is for",
                f"set camera.width = {detector.width} and camera.height = {detector.height}",
            )
        self._fields = Fields.from_run(run)
        self._names = [(f"object_{k}_x", f"object_{k}_y") for k in range(1, OBJECTS + 1)]
        if not any(self._fields.has(name) for pair in self._names for name in pair):
            raise ConfigError("the observation has no `object_*` field", "name some in observation.fields")
        self._range_m = float(config["lidar"]["range_m"])
        self.mounting = Mounting(config["camera"])
        self._detector = detector

    def found(self, images: Tensor) -> list[Detections]:
        """The objects in each of the images u8 [m, 3, height, width]; of two on one place the more certain."""
        return self._detector.detect(images.numpy())

    def nearest_m(self, detections: Detections) -> Float32Array:
        """f32 [4, 2]: the nearest objects, nearest first, ahead and left of the rear axle, metres.

        The place is that of the nearest visible point, as for a LIDAR. [range, range] stands for no object, and what is
        beyond `lidar.range_m` is none.
        """
        nearest = np.full((OBJECTS, 2), self._range_m, np.float32)
        # An object that looks like a car and like a truck is one object.
        kept = without_rivals(detections.boxes_px)
        boxes, places = detections.boxes_px[kept], detections.places[kept]
        at = self.mounting.body_m(places, (boxes[:, 1] + boxes[:, 3]) / 2)[:, :2]
        distance = np.hypot(*at.T)
        order = np.argsort(distance, kind="stable")
        order = order[distance[order] <= self._range_m][:OBJECTS]
        nearest[: len(order)] = at[order]
        return nearest

    def fill(self, observation: Tensor, images: Tensor) -> Tensor:
        """A copy of `observation` f32 [n, d] whose fields `object_*` are the detector's; all others are as they were.

        `images` u8 [m, 3, height, width], m ≤ n, are those of the first m rows (`Observation.images`). A row without a
        camera sees no object. Numbers are normalised and clipped as the simulator does it (docs/sensor-models.md). With
        `observation.history` only the newest tick is filled.
        """
        return self.filled_with(observation, self.found(images))

    def filled_with(self, observation: Tensor, found: list[Detections]) -> Tensor:
        """The same with what `found` says of the first m rows."""
        metres = np.full((len(observation), OBJECTS, 2), self._range_m, np.float32)
        for row, detections in enumerate(found):
            metres[row] = self.nearest_m(detections)
        return self.put(observation.clone(), torch.from_numpy(metres))

    def put(self, observation: Tensor, metres: Tensor) -> Tensor:
        """Writes places f32 [n, 4, 2] (metres) into the fields of `observation` [n, d], and returns it."""
        newest = (self._fields.history - 1) * len(self._fields.names)
        for k, pair in enumerate(self._names):
            for axis, name in enumerate(pair):
                if self._fields.has(name):
                    low, high = self._fields.range(name)
                    unit = ((metres[:, k, axis] - low) / (high - low)).clamp(0.0, 1.0)
                    column = newest + self._fields.names.index(name)
                    observation[:, column] = self._fields.low + (1.0 - self._fields.low) * unit
        return observation
