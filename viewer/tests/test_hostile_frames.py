"""Every decoder, with frames that hold anything: an answer or a `FrameError`, nothing else.

`CARAWARE_FUZZ_FRAMES` sets the number of frames for each; `make model` looks at a million.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import frames
import numpy as np

from caraware_viewer import wire

FRAMES = int(os.environ.get("CARAWARE_FUZZ_FRAMES", "6000"))
SEED = int(os.environ.get("CARAWARE_FUZZ_SEED", "1"))
ODD_NUMBERS = (0, 1, 2, 3, 7, 40, 2**16, 2**31 - 1, 2**31, 2**32 - 1)
"""Sizes that a decoder may trip over."""

TRUTH = np.arange(14, dtype=np.float32).reshape(7, 2)
DECODERS: list[tuple[Callable[[bytes], object], bytes]] = [
    (wire.decode_world, frames.world(4, count=5)),
    (wire.decode_observation, frames.observation(1, TRUTH, TRUTH)),
    (wire.decode_prediction, frames.prediction(0, TRUTH, TRUTH)),
    (wire.decode_neighbours, frames.neighbours(3, {0: [([1.0] * 11, (5, 6, 1))], 1: []})),
    (wire.decode_cloud, frames.pointcloud(3, {"position_m": np.zeros((3, 3)), "tag": [0, 4, 6]})),
    (wire.decode_image, frames.image(3, {"rgb": np.zeros((4, 5, 3)), "depth_m": np.ones((4, 5))}, [{"object": 3}])),
    (wire.decode_detections, frames.radar(3, {"distance_m": [1.0, 2.0]})),
    (lambda frame: wire.decode_table(frame, wire.VEHICLE_META), frames.vehicles(3, {5: "a", 6: "b"})),
    (lambda frame: wire.decode_table(frame, wire.SIGNAL_META), frames.signals(3, {9: "rGy"})),
    (lambda frame: wire.decode_table(frame, wire.COLLISION), frames.event(3, np.zeros((2, 3)))),
]


def mutated(frame: bytes, noise: random.Random) -> bytes:
    """A frame whose header lies about its payload, with bytes changed, or cut."""
    bytes_ = bytearray(frame)
    if noise.random() < 0.6:
        shape = wire.HEADER.fields["shape"]  # type: ignore[index]
        count = shape[0].shape[0]
        sizes = np.frombuffer(bytes_, "<u4", count, shape[1]).copy()
        for _ in range(noise.randrange(1, 4)):
            sizes[noise.randrange(count)] = noise.choice(ODD_NUMBERS)
        bytes_[shape[1] : shape[1] + sizes.nbytes] = sizes.tobytes()
    for _ in range(noise.randrange(3)):
        bytes_[noise.randrange(len(bytes_))] = noise.randrange(256)
    if noise.random() < 0.2:
        del bytes_[noise.randrange(len(bytes_)) :]
    return bytes(bytes_)


def test_a_decoder_answers_or_refuses_whatever_comes() -> None:
    noise = random.Random(SEED)
    decoded = refused = 0
    for number in range(FRAMES * len(DECODERS)):
        decode, frame = DECODERS[number % len(DECODERS)]
        try:
            decode(mutated(frame, noise))
            decoded += 1
        except wire.FrameError:
            refused += 1
    assert min(decoded, refused) > FRAMES // 50, (decoded, refused)
