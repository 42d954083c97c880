"""Draws camera_planes.png: what the planes of a camera, its lens and its events show of one moment in the town.

python docs/images/draw_planes.py
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from caraware.envs import make
from caraware.ipc.image import Image
from caraware_viewer import image as painted
from caraware_viewer import wire

SETTINGS = {
    "camera.vehicles": 8,
    "camera.width": 320,
    "camera.height": 160,
    "camera.horizontal_fov_deg": 80.0,
    "camera.rgb": True,
    "camera.infrared": True,
    "camera.flow": True,
    "camera.events": True,
    "weather.sunlight": 1.0,
    "weather.visibility_m": 2000.0,
}
LENS = [-0.14, 0.012, 0.0, 0.0, 0.0]
TICKS = 120


def seen(distortion: list[float]) -> dict[tuple[int, int], Image]:
    """The images of a run, by tick and vehicle."""
    found: dict[tuple[int, int], Image] = {}
    with make("town", {**SETTINGS, "camera.distortion": distortion}, seed=3) as simulation:
        channel = simulation.channel
        channel.images()
        while not found or max(found)[0] < TICKS:
            for observation in channel.receive(1.0):
                channel.consumed(observation.tick)
            found.update({(image.tick, image.vehicle): image for image in channel.images()})
    return found


def coloured(image: Image, plane: str) -> np.ndarray:
    """A plane as the viewer draws it, u8 [height, width, 3]."""
    pixels = {"rgb": image.rgb, "infrared": image.infrared, "flow_px": image.flow_px}[plane]
    assert pixels is not None
    frame = wire.CameraImage(None, image.head, {plane: pixels}, image.objects, image.events[:0])  # type: ignore[arg-type]
    return painted.colors(frame)


def main() -> None:
    """Simulates twice, with a pinhole and with a lens, and writes the picture beside this file."""
    pinhole, lens = seen([0.0] * 5), seen(LENS)
    both = sorted(pinhole.keys() & lens.keys())
    key = max(both, key=lambda key: (int(pinhole[key].objects["visible_px"].clip(max=4000).sum()), key))
    image = pinhole[key]
    events = np.full((160, 320, 3), 90, np.uint8)
    at = image.events["y"], image.events["x"]
    events[at] = np.where(image.events["polarity"][:, None] > 0, (255, 60, 60), (80, 120, 255))
    panels = {
        "rgb": coloured(image, "rgb"),
        "infrared: white is warm": coloured(image, "infrared"),
        "flow: the hue says where to": coloured(image, "flow_px"),
        f"{len(image.events)} events of 0.1 s": events,
        f"rgb through a lens of k1 = {LENS[0]}": coloured(lens[key], "rgb"),
        "infrared through the lens": coloured(lens[key], "infrared"),
    }
    figure, axes = plt.subplots(3, 2, figsize=(9.2, 7.4), layout="constrained")
    for (title, pixels), axis in zip(panels.items(), axes.flat, strict=True):
        axis.imshow(pixels, interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    figure.savefig(Path(__file__).with_name("camera_planes.png"), dpi=90)


if __name__ == "__main__":
    main()
