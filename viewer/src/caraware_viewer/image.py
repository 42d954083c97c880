"""Images of cameras as they are drawn: the plane that says most, in colours, and the boxes of the road users in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import wire
from caraware_viewer.canvas import Canvas
from caraware_viewer.cloud import TAG_COLORS
from caraware_viewer.wire import FrameError

_VEHICLE, _TWO_WHEELER, _PERSON = 4, 5, 6
"""Tags of `cloud.TAG_COLORS`: a road user has one colour in points and in images."""
ROAD_USERS: dict[int, tuple[str, int]] = {
    24: ("person", int(TAG_COLORS[_PERSON])),
    26: ("car", int(TAG_COLORS[_VEHICLE])),
    27: ("truck", int(TAG_COLORS[_VEHICLE])),
    28: ("bus", int(TAG_COLORS[_VEHICLE])),
    31: ("train", int(TAG_COLORS[_VEHICLE])),
    32: ("motorcycle", int(TAG_COLORS[_TWO_WHEELER])),
    33: ("bicycle", int(TAG_COLORS[_TWO_WHEELER])),
}
"""Name and colour (RGBA) of the classes of road users, by CityScapes' label."""
_OTHER = ("other", 0xFFFFFFFF)

_LABEL_COLORS: dict[int, tuple[int, int, int]] = {
    4: (0, 0, 0),  # static
    5: (111, 74, 0),  # dynamic
    7: (128, 64, 128),  # road
    8: (244, 35, 232),  # sidewalk
    10: (230, 150, 140),  # rail track
    11: (70, 70, 70),  # building
    12: (102, 102, 156),  # wall
    14: (180, 165, 180),  # guard rail
    15: (150, 100, 100),  # bridge
    17: (153, 153, 153),  # pole
    21: (107, 142, 35),  # vegetation
    22: (152, 251, 152),  # terrain
    23: (70, 130, 180),  # sky
    24: (220, 20, 60),  # person
    26: (0, 0, 142),  # car
    27: (0, 0, 70),  # truck
    28: (0, 60, 100),  # bus
    31: (0, 80, 100),  # train
    32: (0, 0, 230),  # motorcycle
    33: (119, 11, 32),  # bicycle
    # Classes that CityScapes counts as road, in colours of ours.
    40: (255, 255, 255),  # lane marking
    41: (255, 220, 120),  # stop line
    42: (200, 200, 200),  # crossing
}


def _palette() -> NDArray[np.uint8]:
    colors = np.zeros((256, 3), np.uint8)
    for label, color in _LABEL_COLORS.items():
        colors[label] = color
    return colors


PALETTE = _palette()
"""RGB `[256, 3]` by label: the colours of the CityScapes data set."""


def _by_label(labels: NDArray[np.uint8], _: wire.CameraImage) -> NDArray[np.uint8]:
    return PALETTE[labels]


def _as_it_is(colors: NDArray[np.uint8], _: wire.CameraImage) -> NDArray[np.uint8]:
    return colors


def _by_depth(depths_m: NDArray[np.float32], image: wire.CameraImage) -> NDArray[np.uint8]:
    """Grey: white at the camera, black at the range and beyond."""
    share = np.nan_to_num(depths_m / max(float(image.head["range_m"]), 1e-3), nan=1.0)
    return _grey((255.0 * (1.0 - np.sqrt(np.clip(share, 0.0, 1.0)))).astype(np.uint8), image)


def _grey(values: NDArray[np.uint8], _: wire.CameraImage) -> NDArray[np.uint8]:
    return np.repeat(values[..., None], 3, axis=-1)


def _by_heat(kelvins: NDArray[np.uint16], image: wire.CameraImage) -> NDArray[np.uint8]:
    """Grey from the coldest to the warmest pixel of the image, as with automatic gain: white is warm."""
    low, high = int(kelvins.min()), int(kelvins.max())
    return _grey((255.0 * (kelvins.astype(np.float32) - low) / max(high - low, 1)).astype(np.uint8), image)


def _by_motion(flow_px: NDArray[np.float32], _: wire.CameraImage) -> NDArray[np.uint8]:
    """The hue says where to, the saturation how far, up to the farthest of the image; unknown motion is black."""
    known = np.isfinite(flow_px[..., :1]) & np.isfinite(flow_px[..., 1:])
    right, down = np.where(known, flow_px, 0.0).transpose(2, 0, 1)
    length = np.hypot(right, down)
    share = length / max(float(length.max()), 1.0)
    # A sixth of the hue circle from one of these to the next, as in any conversion from HSV.
    sixth = (np.arctan2(down, right) / (2 * np.pi) % 1.0)[..., None] * 6.0
    pure = np.clip(np.abs((sixth + np.array([0.0, 4.0, 2.0])) % 6.0 - 3.0) - 1.0, 0.0, 1.0)
    shown: NDArray[np.float64] = 255.0 * (1.0 - share[..., None] * (1.0 - pure)) * known
    return shown.astype(np.uint8)


def _with_events(shown: NDArray[np.uint8], events: NDArray[np.void]) -> NDArray[np.uint8]:
    """The image, darker, with the newest event of each pixel: red became brighter, blue darker."""
    height, width, _ = shown.shape
    within = events[(events["x"] < width) & (events["y"] < height)]
    shown = shown // 2
    shown[within["y"], within["x"]] = np.where(within["polarity"][:, None] > 0, (255, 40, 40), (60, 90, 255))
    return shown


def _by_number(numbers: NDArray[np.uint32], _: wire.CameraImage) -> NDArray[np.uint8]:
    """A colour for each number, the same in every image."""
    mixed = numbers * np.uint32(0x9E37_79B1)
    return np.stack([mixed >> shift & 0xFF for shift in (24, 16, 8)], axis=-1).astype(np.uint8)


PAINTERS: dict[str, Callable[[NDArray[Any], wire.CameraImage], NDArray[np.uint8]]] = {
    "rgb": _as_it_is,
    "semantic": _by_label,
    "infrared": _by_heat,
    "depth_m": _by_depth,
    "binary": _grey,
    "flow_px": _by_motion,
    "instance": _by_number,
}
"""How a plane becomes colours `[h, w, 3]`, by its name: the first that an image has is drawn."""


def colors(image: wire.CameraImage) -> NDArray[np.uint8]:
    """RGB `[h, w, 3]` of an image. Raises `wire.FrameError` if it has no plane that can be drawn, or no pixel."""
    for name, paint in PAINTERS.items():
        if name in image.planes and image.planes[name].size:
            shown = paint(image.planes[name], image)
            return _with_events(shown, image.events) if len(image.events) else shown
    raise FrameError(f"an image has no plane that this viewer draws; it has {', '.join(image.planes) or 'none'}")


def draw_image(canvas: Canvas, path: str, image: wire.CameraImage) -> None:
    """Draws an image with a box around what it shows of each road user, with its class and its least distance."""
    shown = colors(image)
    known = [ROAD_USERS.get(int(label), _OTHER) for label in image.objects["label"]]
    # The last pixel that shows a road user is within its box.
    corners = image.objects["visible_box_px"].astype(np.float32) + np.array([0, 0, 1, 1], np.float32)
    distances_m = np.maximum(image.objects["depth_m"][:, 0], 0.0)
    labels = [f"{name} {distance:.0f} m" for (name, _), distance in zip(known, distances_m, strict=True)]
    _log(canvas, path, shown, corners, labels, [color for _, color in known])
    canvas.filled(path, 1)


def draw_nothing(canvas: Canvas, path: str, size: tuple[int, int]) -> None:
    """Draws a black image of this height and width: its carrier has left."""
    _log(canvas, path, np.zeros((*size, 3), np.uint8), np.empty((0, 4), np.float32), [], [])


def _log(
    canvas: Canvas,
    path: str,
    shown: NDArray[np.uint8],
    corners: NDArray[np.float32],
    labels: list[str],
    box_colors: list[int],
) -> None:
    canvas.log(f"{path}/image", rr.Image(shown))
    boxes = rr.Boxes2D(
        array=corners,
        array_format=rr.Box2DFormat.XYXY,
        labels=labels,
        colors=np.array(box_colors, np.uint32),
        radii=rr.Radius.ui_points(1.0),
    )
    canvas.log(f"{path}/boxes", boxes)
