"""The detector as an ONNX file, and the class that runs it with ONNX Runtime."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from caraware.examples.detector.metric import Detections, iou
from caraware.examples.detector.network import STRIDE, Network

OPSET = 18
"""Version of ONNX's operators in the file."""
NAMES = ("scores", "boxes_px", "places")
TOLERANCE = 1e-3
"""Largest difference between torch and ONNX Runtime: of a score, and of boxes and places relative to their size."""


class Exported(nn.Module):
    """The network with scores in place of logits: what the file holds."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """u8 [B, 3, height, width] to scores [B, 4, h, w], boxes [B, 4, h, w], places [B, 2, h, w], as in `Cells`."""
        cells = self.network(images)
        return cells.heat.sigmoid(), cells.boxes_px, cells.places


class ExportError(RuntimeError):
    """ONNX Runtime computes something else than torch."""


def export(network: Network, file: Path, height: int, width: int) -> None:
    """Writes the network for any number of images of `height` x `width` pixels, and compares the file with torch.

    Raises `ExportError` where they differ by more than `TOLERANCE`.
    """
    exported = Exported(network).eval()
    generator = torch.Generator().manual_seed(1)
    images = torch.randint(0, 256, (3, 3, height, width), dtype=torch.uint8, generator=generator)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            exported,
            (images,),
            file,
            input_names=["images"],
            output_names=list(NAMES),
            opset_version=OPSET,
            dynamo=True,
            dynamic_shapes=({0: torch.export.Dim("batch", min=1, max=1024)},),
            external_data=False,
            verbose=False,
        )
    difference = difference_from_torch(network, file, images)
    if difference > TOLERANCE:
        raise ExportError(f"{file} differs from torch by {difference:.1e}")


def difference_from_torch(network: Network, file: Path, images: Tensor) -> float:
    """Largest difference over all outputs; of boxes and places relative to the size of the number, at least 1."""
    with torch.no_grad():
        wanted = [output.numpy() for output in Exported(network).eval()(images)]
    found = OnnxDetector(file).cells(images.numpy())
    return max(
        float((np.abs(one - two) / np.maximum(np.abs(two), 1.0)).max()) for one, two in zip(found, wanted, strict=True)
    )


class OnnxDetector:
    """Finds road users in images, with one thread of ONNX Runtime."""

    def __init__(self, file: str | Path, least_score: float = 0.3, threads: int = 1) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        self._session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        self._least_score = least_score
        _, _, self.height, self.width = self._session.get_inputs()[0].shape

    def cells(self, images: np.ndarray) -> list[np.ndarray]:
        """The file's outputs for images u8 [B, 3, height, width]: scores, boxes and places of each cell."""
        outputs: list[np.ndarray] = self._session.run(list(NAMES), {"images": images})
        return outputs

    def detect(self, images: np.ndarray) -> list[Detections]:
        """The objects in each of the images u8 [B, 3, height, width] with at least the least score."""
        scores, boxes_px, places = self.cells(images)
        return decode(scores, boxes_px, places, self._least_score)


def decode(
    scores: np.ndarray, boxes_px: np.ndarray, places: np.ndarray, least_score: float, most: int = 100
) -> list[Detections]:
    """Detections of B images from scores, boxes and places of their cells, at most `most` of each.

    A cell is an object of a class where no neighbour's score exceeds its own. Of two boxes of a class that overlap by
    more than half the more certain one stays.
    """
    found = []
    for score, boxes, place in zip(scores, boxes_px, places, strict=True):
        kind, row, column = np.nonzero((score >= least_score) & (score == _largest_around(score)))
        order = np.argsort(-score[kind, row, column], kind="stable")[:most]
        kind, row, column = kind[order], row[order], column[order]
        height, width = STRIDE * score.shape[1], STRIDE * score.shape[2]
        box = boxes[:, row, column].T.clip(0, [width, height, width, height])
        one = Detections(box, kind.astype(np.int64), score[kind, row, column], place[:, row, column].T)
        found.append(_kept(one, without_rivals(box, np.where(kind[:, None] == kind, 1.0, 0.0))))
    return found


def _largest_around(score: np.ndarray) -> np.ndarray:
    """The largest score of each cell and its eight neighbours, [4, h, w]."""
    padded = np.pad(score, ((0, 0), (1, 1), (1, 1)))
    largest: np.ndarray = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2)).max((3, 4))
    return largest


def without_rivals(boxes: np.ndarray, rivals: np.ndarray | None = None, most: float = 0.5) -> np.ndarray:
    """Non-maximum suppression: places i64 of the boxes [k, 4], sorted by score, that no kept one before them hides.

    `rivals` [k, k] is 0 for pairs that do not hide each other.
    """
    overlap = iou(boxes, boxes) * (1.0 if rivals is None else rivals)
    kept: list[int] = []
    for place in range(len(boxes)):
        if not (overlap[place, kept] > most).any():
            kept.append(place)
    return np.array(kept, np.int64)


def _kept(one: Detections, rows: np.ndarray) -> Detections:
    return Detections(one.boxes_px[rows], one.classes[rows], one.scores[rows], one.places[rows])
