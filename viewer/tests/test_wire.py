"""The wire layout is the committed one, and frames mean what they say."""

from __future__ import annotations

import json
from pathlib import Path

import frames
import numpy as np
import pytest

from caraware_viewer import wire

LAYOUT = Path(__file__).parents[2] / "ipc-schema" / "layout.json"


@pytest.mark.parametrize(("name", "dtype"), [("MessageHeader", wire.HEADER), ("VehicleState", wire.VEHICLE_STATE)])
def test_types_repeat_the_committed_table(name: str, dtype: np.dtype) -> None:
    table = {row["name"]: row for row in json.loads(LAYOUT.read_text())}
    assert dtype.itemsize == table[name]["size"]
    assert [[field, dtype.fields[field][1]] for field in dtype.names] == table[name]["fields"]


def test_world_comes_back() -> None:
    world = wire.decode_world(frames.world(4, count=5))
    assert (world.header.tick, world.header.count, world.header.run_id) == (4, 5, 7)
    np.testing.assert_array_equal(world.states["x_m"], [4, 14, 24, 34, 44])
    assert not world.states.flags.writeable


def test_observation_sections_are_aligned_and_in_order() -> None:
    truth = np.arange(14, dtype=np.float32).reshape(7, 2)
    observation = wire.decode_observation(frames.observation(1, truth, truth + 100, np.arange(7) % 2))
    np.testing.assert_array_equal(observation.truth[:, :2], truth)
    np.testing.assert_array_equal(observation.gnss_m[:, :2], truth + 100)
    np.testing.assert_array_equal(observation.vehicle, np.arange(7))
    np.testing.assert_array_equal(observation.valid, np.arange(7) % 2 == 1)
    assert observation.age_s.shape == (7, 4)


def test_an_empty_slot_is_not_valid() -> None:
    frame = bytearray(frames.observation(0, np.zeros((1, 2)), np.zeros((1, 2))))
    observation = wire.decode_observation(bytes(frame))
    assert observation.valid.tolist() == [True]
    at = len(frame) - 5 * wire.ALIGNMENT  # vehicle, flags, sensors, episode_step, age_s: one aligned section each
    frame[at : at + 4] = b"\xff" * 4
    assert wire.decode_observation(bytes(frame)).valid.tolist() == [False]


@pytest.mark.parametrize("decode", [wire.decode_world, wire.decode_observation, wire.decode_prediction])
def test_garbage_is_refused(decode) -> None:
    whole = frames.header(0, 4, 2)
    for frame in (b"", whole[:71], whole, whole + bytes(8), frames.header(0, 2**32 - 1, 2) + bytes(1000)):
        with pytest.raises(wire.FrameError):
            decode(frame)
    with pytest.raises(wire.FrameError, match="version 99"):
        decode(frames.header(0, 0, 2, schema_version=99))
    random = np.random.default_rng(1)
    for _ in range(200):
        with pytest.raises(wire.FrameError):
            decode(random.bytes(int(random.integers(0, 400))))
