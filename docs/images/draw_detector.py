"""Draws detector.png: what the example detector finds in images of the avenue.

python -m caraware.examples.detector train
python docs/images/draw_detector.py runs/detector.onnx
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from caraware.examples.detector.exported import OnnxDetector
from caraware.examples.detector.images import Class, collect
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

SEED, EVERY_S, RANKS = 1004, 10.0, (0, 1, 3, 6, 10, 15)
"""The images drawn are those with these ranks by the number of objects that count."""
COLOURS = {
    Class.PERSON: "tab:red",
    Class.TWO_WHEELER: "yellow",
    Class.CAR: "deepskyblue",
    Class.TRUCK: "orange",
}


def outline(axes: Axes, box: np.ndarray, colour: str, width: float, style: str = "-") -> None:
    """A box: left, top, right and bottom edge, pixels."""
    left, top, right, bottom = (float(edge) for edge in box)
    axes.add_patch(
        Rectangle(
            (left, top),
            right - left,
            bottom - top,
            fill=False,
            ec=colour,
            lw=width,
            ls=style,
        )
    )


def main(file: str) -> None:
    """Simulates the avenue and writes the picture beside this file."""
    images = collect("avenue", SEED, 150.0, EVERY_S)
    found = OnnxDetector(file).detect(images.rgb)
    counted = np.array([int((~one.ignored).sum()) for one in images.objects])
    shown = np.argsort(-counted, kind="stable")[list(RANKS)]
    height, width = images.rgb.shape[2:]
    figure, all_axes = plt.subplots(3, 2, figsize=(10, 7.6))
    for axes, row in zip(all_axes.flat, shown, strict=True):
        axes.imshow(
            images.rgb[row].transpose(1, 2, 0),
            extent=(0, width, height, 0),
            interpolation="nearest",
        )
        axes.axis("off")
        for box, ignored in zip(images.objects[row].boxes_px, images.objects[row].ignored, strict=True):
            outline(axes, box, "0.75" if ignored else "white", 1.0, ":" if ignored else "-")
        one = found[row]
        for box, kind, place in zip(one.boxes_px, one.classes, one.places, strict=True):
            colour = COLOURS[Class(kind)]
            outline(axes, box, colour, 1.6)
            axes.text(
                box[0],
                box[1] - 1.5,
                f"{Class(kind).name.lower()} {place[1]:.0f} m",
                color=colour,
                fontsize=7,
            )
        axes.set_xlim(0, width)
        axes.set_ylim(height, 0)
    figure.subplots_adjust(0, 0, 1, 1, 0.01, 0.01)
    figure.savefig(Path(__file__).with_name("detector.png"), dpi=80)


if __name__ == "__main__":
    main(sys.argv[1])
