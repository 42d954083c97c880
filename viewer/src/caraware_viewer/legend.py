"""The legend: a strip below the top view, with a sign and a name for each thing that it shows."""

from __future__ import annotations

import numpy as np
import rerun as rr

from caraware_viewer import detections, top
from caraware_viewer import messages as of_messages
from caraware_viewer.canvas import Canvas

SIGNS = "legend/signs"

Rows = tuple[tuple[tuple[str, int], ...], ...]
"""Name and colour (RGBA) of each sign, row by row."""

_ROWS: Rows = (
    (
        ("connected", int(top.KIND_COLORS[0])),
        ("other vehicle", int(top.KIND_COLORS[1])),
        ("pedestrian", int(top.KIND_COLORS[2])),
        ("hero, route", int(top.KIND_COLORS[3])),
    ),
    (
        ("GNSS fix", top.rgba(top.GNSS_COLOR)),
        ("policy", top.rgba(top.PREDICTION_COLOR)),
        ("EKF", top.rgba(top.ESTIMATE_COLOR)),
        ("contact", top.rgba(top.CONTACT_COLOR)),
    ),
)
_MESSAGE_ROW: tuple[tuple[str, int], ...] = (
    *(
        (f"known by {name}", int(color))
        for name, color in zip(of_messages.SOURCES[1:4], of_messages.SOURCE_COLORS[1:4], strict=True)
    ),
    ("link, sender", top.rgba(of_messages.SENDER_COLOR)),
)
"""What `--messages` adds."""
_RADAR_ROW: tuple[tuple[str, int], ...] = (
    (f"radar: {detections.FULL_COLOR_MPS:.0f} m/s closer", top.rgba(detections.APPROACHING)),
    ("at rest", top.rgba(detections.STILL)),
    (f"{detections.FULL_COLOR_MPS:.0f} m/s away", top.rgba(detections.RECEDING)),
)
"""What radars add: the colours of radial velocities."""


WIDTH, ROW_HEIGHT = 100.0, 6.5
"""Extent of a row in the legend's own units."""


def rows_of(*, messages: bool = False, radars: bool = False) -> Rows:
    """The signs; `messages` adds a row for what is known from them, `radars` one for velocities."""
    return (*_ROWS, *([_MESSAGE_ROW] if messages else []), *([_RADAR_ROW] if radars else []))


def draw_legend(canvas: Canvas, rows: Rows) -> None:
    """Draws the legend once."""
    places, names, colors = [], [], []
    for row, signs in enumerate(rows):
        for column, (name, color) in enumerate(signs):
            places.append((WIDTH * (column + 0.5) / len(signs), ROW_HEIGHT * (row + 0.25)))
            names.append(name)
            colors.append(color)
    points = rr.Points2D(
        np.array(places, np.float32),
        colors=np.array(colors, np.uint32),
        labels=names,
        show_labels=True,
        radii=rr.Radius.ui_points(4.0),
    )
    canvas.log(SIGNS, points, static=True)
