"""The wire layout equals the committed one, and frames are decoded or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import frames
import numpy as np
import pytest

from caraware_viewer import layout, wire

LAYOUT = Path(__file__).parents[2] / "ipc-schema" / "layout.json"


def test_the_tables_are_the_committed_ones() -> None:
    copy = Path(layout.__file__).parent / "layout.json"
    assert copy.read_text(encoding="utf-8") == LAYOUT.read_text(encoding="utf-8")


def test_records_have_the_fields_of_the_table() -> None:
    for row in json.loads(LAYOUT.read_text(encoding="utf-8"))["types"]:
        record = layout.RECORDS[row["name"]]
        assert record.fields is not None
        found = [[name, at[1], at[0].base.str, list(at[0].shape)] for name, at in record.fields.items()]
        assert (record.itemsize, found) == (row["size"], row["fields"]), row["name"]


def test_world_comes_back() -> None:
    world = wire.decode_world(frames.world(4, count=5))
    assert (world.header.tick, world.header.rows, world.header.run_id) == (4, 5, 7)
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
    at = len(frame) - 5 * layout.ALIGNMENT  # vehicle, flags, sensors, episode_step, age_s: one aligned section each
    frame[at : at + 4] = b"\xff" * 4
    assert wire.decode_observation(bytes(frame)).valid.tolist() == [False]


def test_estimates_follow_predictions_where_the_header_says_so() -> None:
    position_m = np.arange(10, dtype=np.float32).reshape(5, 2)
    alone = wire.decode_prediction(frames.prediction(0, position_m))
    np.testing.assert_array_equal(alone.answer, position_m)
    assert alone.estimate_m is None
    both = wire.decode_prediction(frames.prediction(0, position_m, position_m + 50))
    np.testing.assert_array_equal(both.answer, position_m)
    np.testing.assert_array_equal(both.estimate_m, position_m + 50)


def test_an_answer_has_the_numbers_of_its_task() -> None:
    choices = np.arange(15, dtype=np.float32).reshape(5, 3)
    np.testing.assert_array_equal(wire.decode_prediction(frames.prediction(0, choices)).answer, choices)


def test_rows_come_back() -> None:
    names = {5: "flow#1/a b", 6: "ü €", 7: ""}
    rows = wire.decode_table(frames.vehicles(3, names), wire.VEHICLE_META).rows
    assert {int(row["id_hash"]): wire.decode_text(row["id"], int(row["id_len"])) for row in rows} == names
    lights = wire.decode_table(frames.signals(3, {9: "rGy"}), wire.SIGNAL_META).rows
    assert [wire.decode_text(row["state"], int(row["links"])) for row in lights] == ["rGy"]
    contacts = wire.decode_table(frames.event(3, np.array([[1, 2, 3], [4, 5, 6]])), wire.COLLISION).rows
    np.testing.assert_array_equal(contacts["position_m"], [[1, 2, 3], [4, 5, 6]])


def test_a_cloud_comes_back() -> None:
    points = {"position_m": np.arange(9).reshape(3, 3), "tag": [0, 4, 6]}
    seen = wire.decode_cloud(frames.pointcloud(3, points, range_m=80.0, id_hash=11))
    assert (float(seen.scan["range_m"]), int(seen.scan["id_hash"])) == (80.0, 11)
    np.testing.assert_array_equal(seen.points["position_m"], points["position_m"])
    assert seen.points["tag"].tolist() == [0, 4, 6]


def test_a_name_that_is_cut_within_a_character_is_still_text() -> None:
    assert wire.decode_text(np.void("aü".encode()[:2]), 2) == "a\ufffd"


@pytest.mark.parametrize(
    "decode",
    [
        wire.decode_world,
        wire.decode_observation,
        wire.decode_prediction,
        wire.decode_cloud,
        lambda frame: wire.decode_table(frame, wire.VEHICLE_META),
        lambda frame: wire.decode_table(frame, wire.SIGNAL_META),
    ],
)
def test_garbage_is_refused(decode: Callable[[bytes], object]) -> None:
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
