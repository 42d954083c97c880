"""Images and radar scans have the committed layout, and planes are taken apart as they were put together."""

import json
from pathlib import Path

import numpy as np
import pytest
from caraware.data.export.scans import distortion, projection, undistorted_projection
from caraware.data.recording import RecordingError
from caraware.ipc.image import EVENT, IMAGE, SEEN, split_planes
from caraware.ipc.layout import IMAGE_PLANES
from caraware.ipc.radar import DETECTION, RADAR_SCAN

LAYOUT = Path(__file__).parents[2] / "ipc-schema" / "layout.json"


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("ImageHead", IMAGE),
        ("SeenObject", SEEN),
        ("BrightnessEvent", EVENT),
        ("RadarScan", RADAR_SCAN),
        ("RadarDetection", DETECTION),
    ],
)
def test_types_repeat_the_committed_table(name: str, dtype: np.dtype) -> None:
    table = {row["name"]: row for row in json.loads(LAYOUT.read_text())["types"]}
    assert dtype.itemsize == table[name]["size"]
    assert dtype.fields is not None and dtype.names is not None
    assert [[field, dtype.fields[field][1]] for field in dtype.names] == [field[:2] for field in table[name]["fields"]]


@pytest.mark.parametrize("wanted", [0b0000000, 0b0000101, 0b1011010, 0b0110001, 0b1111111])
def test_planes_follow_one_another(wanted: int) -> None:
    generator = np.random.default_rng(wanted)
    head = np.zeros(1, IMAGE)
    head["height"], head["width"], head["planes"] = 3, 5, wanted
    planes = {
        name: generator.integers(0, 255, (3, 5, *shape)).astype(scalar)
        for name, bit, scalar, shape in IMAGE_PLANES
        if wanted & bit
    }
    found = split_planes(head[0], b"".join(plane.tobytes() for plane in planes.values()))
    assert set(found) == {name for name, *_ in IMAGE_PLANES}
    for name, plane in found.items():
        if name in planes:
            assert plane is not None
            np.testing.assert_array_equal(plane, planes[name])
        else:
            assert plane is None


def test_planes_that_are_too_short_are_refused() -> None:
    head = np.zeros(1, IMAGE)
    head["height"], head["width"], head["planes"] = 3, 5, 1
    with pytest.raises(ValueError, match="buffer"):
        split_planes(head[0], bytes(59))


def test_formats_without_lenses_refuse_a_camera_that_has_one() -> None:
    head = np.zeros(1, IMAGE)
    head["width"], head["height"], head["focal_px"] = 8, 6, 4.0
    np.testing.assert_array_equal(undistorted_projection(head[0]), projection(head[0]))
    head["distortion"] = [-0.25, 0.125, 0.0, 0.5, 0.0]
    assert distortion(head[0]) == [-0.25, 0.125, 0.0, 0.5, 0.0]
    with pytest.raises(RecordingError, match="export to ros2 or foxglove"):
        undistorted_projection(head[0])
