"""What the formats with LIDAR points share."""

from __future__ import annotations

import numpy as np

from caraware.data.recording import Array, Recording, RecordingError


def require_channels(recording: Recording, *channels: str) -> None:
    """Raise `RecordingError` if the recording lacks one of these channels."""
    for channel in channels:
        if channel not in recording.channels:
            raise RecordingError(f"{recording.path} has no channel {channel!r}: record it with record.channels")


def forward_m(scan: np.void, points: Array) -> Array:
    """f32 [count, 3]: points (m) in the sensor's frame with x forward, y left and z up, whatever `lidar.axes` is."""
    position_m: Array = points["position_m"]
    if scan["axes"] == 1:  # the paper's: y backward, x left, z down
        position_m = np.stack((-position_m[:, 1], position_m[:, 0], -position_m[:, 2]), 1)
    return position_m
