"""Average precision of boxes, as PASCAL VOC computes it since 2010.

M. Everingham et al., *The PASCAL Visual Object Classes Challenge: A Retrospective*, IJCV 2015. Precision is made
monotone and integrated over every recall that occurs ("all points"), not over eleven. Ignored objects are KITTI's idea:
they count neither as hit nor as miss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caraware.examples.detector.images import MIN_HEIGHT_PX, Class, Objects
from caraware.ipc.arrays import Float32Array, Float64Array, Int64Array


@dataclass(frozen=True)
class Detections:
    """k objects found in an image, the most certain first."""

    boxes_px: Float32Array
    """f32 [k, 4]: left, top, right and bottom edge."""
    classes: Int64Array
    """i64 [k]: `Class`."""
    scores: Float32Array
    """f32 [k], 0 ... 1."""
    places: Float32Array
    """f32 [k, 2]: column (pixels) and depth (metres) of the nearest visible point."""


def iou(a: Float32Array, b: Float32Array) -> Float32Array:
    """Intersection over union, f32 [m, n], of boxes [m, 4] and [n, 4]."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    overlap = np.clip(high - low, 0, None).prod(2)
    area_a, area_b = (a[:, 2:] - a[:, :2]).prod(1), (b[:, 2:] - b[:, :2]).prod(1)
    ratio: Float32Array = overlap / np.maximum(area_a[:, None] + area_b[None] - overlap, 1e-9)
    return ratio


NOT_COUNTED, MISS = -2, -1


def match(found: Float32Array, objects: Float32Array, ignored: np.ndarray, at_least: float = 0.5) -> Int64Array:
    """i64 [k]: the object that each found box hits, `MISS`, or `NOT_COUNTED`.

    `found` f32 [k, 4] is sorted by falling score. Each takes the object with the largest IoU that no box before it
    took. One without such an object is not counted if it fits an ignored object or is lower than the least height.
    """
    overlaps = iou(found, objects)
    of_found = np.full(len(found), MISS, np.int64)
    taken = ignored.copy()
    for row, ratios in enumerate(overlaps):
        open_ratios = np.where(taken, -1.0, ratios)
        if len(objects) and open_ratios.max() >= at_least:
            of_found[row] = open_ratios.argmax()
            taken[of_found[row]] = True
        elif (ratios[ignored] >= at_least).any() or found[row, 3] - found[row, 1] < MIN_HEIGHT_PX:
            of_found[row] = NOT_COUNTED
    return of_found


def average_precision(hit: Sequence[bool] | np.ndarray, scores: Float32Array | Sequence[float], objects: int) -> float:
    """Area under precision over recall of detections that hit one of `objects` or none; NaN without objects."""
    if objects == 0:
        return float("nan")
    order = np.argsort(-np.asarray(scores), kind="stable")
    hits = np.cumsum(np.asarray(hit, bool)[order])
    precision: Float64Array = hits / np.arange(1, len(hits) + 1)
    recall = np.concatenate([[0.0], hits / objects])
    falling = np.maximum.accumulate(precision[::-1])[::-1]
    return float((np.diff(recall) * falling).sum())


def class_precisions(
    found: Sequence[Detections], objects: Sequence[Objects], at_least: float = 0.5
) -> dict[str, float]:
    """AP of each class over N images, by its name, and "mean" over the classes that the images have."""
    result = {}
    for kind in Class:
        hit, scores, number = [], [], 0
        for of_image, truth in zip(found, objects, strict=True):
            mine, theirs = of_image.classes == kind, truth.classes == kind
            matched = match(of_image.boxes_px[mine], truth.boxes_px[theirs], truth.ignored[theirs], at_least)
            counted = matched != NOT_COUNTED
            hit.append(matched[counted] >= 0)
            scores.append(of_image.scores[mine][counted])
            number += int((~truth.ignored[theirs]).sum())
        result[kind.name.lower()] = average_precision(np.concatenate(hit), np.concatenate(scores), number)
    return result | {"mean": float(np.nanmean(list(result.values())))}
