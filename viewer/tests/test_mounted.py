"""Images, boxes and radar detections: how they are decoded and drawn, and which sensors are shown."""

from __future__ import annotations

from typing import Any

import frames
import numpy as np
import pytest
import test_scene
from test_scene import MAP, Drawn

from caraware_viewer import detections, image, legend, mounted, sights, space, views, wire
from caraware_viewer.layout import IMAGE_PLANES
from caraware_viewer.link import LinkError
from caraware_viewer.mounted import CAMERA, LIDAR, RADAR
from caraware_viewer.wire import FrameError

drawn = test_scene.drawn

UNITS = [
    {"kind": "camera", "suite": "", "name": "camera"},
    {"kind": "camera", "suite": "kitti", "name": "image_2"},
    {"kind": "camera", "suite": "kitti", "name": "image_3"},
    {"kind": "camera", "suite": "mast", "name": "down"},
    {"kind": "radar", "suite": "kitti", "name": "front"},
]
CARRIED: Any = MAP | {
    "sensor_units": UNITS,
    "roadsides": [{"name": "crossing north", "suite": "mast"}],
    "rates_hz": {"image": 10.0, "radar": 10.0},
}
NAMES = ("vehicles", frames.vehicles(0, {100: "a", 101: "b/c", 102: "d"}))
WORLD = ("world", frames.world(0))
SEMANTIC = np.array([[7, 26, 26], [23, 24, 200]], np.uint8)
CAR = {
    "object": 1,
    "label": 26,
    "visible_box_px": [1, 0, 2, 0],
    "full_box_px": [0.5, -2.0, 9.0, 4.0],
    "depth_m": [12.4, 16.0],
}


def pixels(entity: Any) -> np.ndarray:
    """The newest image of an entity, `[h, w, 3]`."""
    shape = entity.newest("Image:format")[0]
    return np.array(entity.newest("Image:buffer")[0], np.uint8).reshape(shape["height"], shape["width"], 3)


def test_every_plane_comes_back_whatever_others_there_are() -> None:
    random = np.random.default_rng(3)
    every = {
        name: random.integers(0, 256, (3, 4, *shape)).astype(np.dtype(scalar))
        for name, _, scalar, shape in IMAGE_PLANES
    }
    for names in ([*every], ["depth_m", "rgb"], ["instance"], ["semantic", "binary"]):
        chosen: dict[str, Any] = {name: every[name] for name in names}
        seen = wire.decode_image(frames.image(7, chosen, [CAR], id_hash=101))
        assert list(seen.planes) == names
        for name, plane in chosen.items():
            np.testing.assert_array_equal(seen.planes[name], plane)
        assert (seen.header.tick, int(seen.head["id_hash"]), int(seen.objects[0]["label"])) == (7, 101, 26)


def test_an_image_whose_sizes_lie_is_refused() -> None:
    planes = {"rgb": np.zeros((4, 5, 3))}
    whole = frames.image(0, planes)
    assert wire.decode_image(whole).planes["rgb"].shape == (4, 5, 3)
    lies: list[dict[str, Any]] = [{"width": 6}, {"height": 2**32 - 1, "width": 2**32 - 1}, {"planes": 0b01001}]
    for lie in lies:
        with pytest.raises(FrameError, match="planes of an image"):
            wire.decode_image(frames.image(0, planes, **lie))
    with pytest.raises(FrameError, match="does not hold"):
        wire.decode_image(whole[:-64])
    two_heads = frames.header(0, 0, 2, 60) + bytes(4096)
    with pytest.raises(FrameError, match="one head"):
        wire.decode_image(two_heads)
    with pytest.raises(FrameError, match="one scan"):
        wire.decode_detections(frames.header(0, 0, 0) + bytes(4096))


def test_the_most_telling_plane_is_drawn() -> None:
    rgb = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    depth_m = np.array([[0.0, 25.0, 100.0], [400.0, np.nan, 1.0]], np.float32)
    binary = np.array([[0, 255, 0], [255, 255, 0]], np.uint8)
    planes: dict[str, Any] = {"rgb": rgb, "semantic": SEMANTIC, "depth_m": depth_m, "binary": binary}

    def shown(*names: str) -> np.ndarray:
        return image.colors(wire.decode_image(frames.image(0, {name: planes[name] for name in names})))

    np.testing.assert_array_equal(shown("depth_m", "semantic", "rgb", "binary"), rgb)
    by_label = shown("depth_m", "semantic", "binary")
    # The colours of the CityScapes data set: road, car, sky, person; a label without a colour is black.
    assert by_label[0].tolist() == [[128, 64, 128], [0, 0, 142], [0, 0, 142]]
    assert by_label[1].tolist() == [[70, 130, 180], [220, 20, 60], [0, 0, 0]]
    by_depth = shown("depth_m", "binary")
    assert by_depth[0, :, 0].tolist() == [255, 127, 0] and by_depth[1, :2, 2].tolist() == [0, 0]
    np.testing.assert_array_equal(shown("binary")[..., 1], binary)
    with pytest.raises(FrameError, match="no plane"):
        image.colors(wire.decode_image(frames.image(0, {"rgb": np.zeros((0, 4, 3))})))


def test_heat_motion_and_events_are_drawn() -> None:
    heat = np.array([[28_000, 29_000], [30_000, 28_500]], np.uint16)
    flow = np.array([[[0, 0], [2, 0]], [[-2, 0], [np.nan, np.nan]]], np.float32)

    def shown(plane: str, pixels: Any, **more: Any) -> np.ndarray:
        return image.colors(wire.decode_image(frames.image(0, {plane: pixels}, **more)))

    assert shown("infrared", heat)[..., 1].tolist() == [[0, 127], [255, 63]]
    # At rest white; to the right red, to the left its complement; unknown black.
    assert shown("flow_px", flow).tolist() == [[[255] * 3, [255, 0, 0]], [[0, 255, 255], [0] * 3]]
    events = [(10, 1, 0, 1), (20, 1, 0, -1), (30, 0, 1, 1), (40, 7, 9, 1)]
    with_events = shown("infrared", heat, events=events)
    assert with_events.tolist() == [[[0] * 3, [60, 90, 255]], [[255, 40, 40], [31] * 3]]
    assert wire.decode_image(frames.image(0, {"infrared": heat}, events=events)).events["time_us"].tolist() == [
        10,
        20,
        30,
        40,
    ]


def test_a_chosen_camera_is_drawn_with_boxes_beside_the_3d_view(drawn: Drawn) -> None:
    seen = frames.image(1, {"semantic": SEMANTIC}, [CAR, CAR | {"label": 99, "depth_m": [-3.0, 1.0]}], id_hash=101)
    other = frames.image(1, {"semantic": SEMANTIC}, id_hash=102)
    scene, found = drawn(
        NAMES,
        WORLD,
        ("image/b%2Fc%40image_2", seen),
        ("image/d", other),
        run_map=CARRIED,
        cameras=["b/c@image_2", "crossing north@down"],
        radars=["off"],
    )
    np.testing.assert_array_equal(pixels(found["cameras/0/image"]), image.PALETTE[SEMANTIC])
    boxes = found["cameras/0/boxes"]
    assert boxes.newest("Boxes2D:labels") == ["car 12 m", "other 0 m"]
    # From the left edge of pixel 1 to the right edge of pixel 2, the whole of row 0.
    assert boxes.newest("Boxes2D:centers")[0] == [2.0, 0.5] and boxes.newest("Boxes2D:half_sizes")[0] == [1.0, 0.5]
    assert not [path for path in found if path.startswith("cameras/") and not path.startswith("cameras/0/")]
    assert scene.camera_titles == {"cameras/0": "b/c@image_2"}
    topics = {topic for topic in scene.sensor_topics() if not LIDAR.has(topic)}
    assert topics == {"image/b%2Fc%40image_2", "image/crossing%20north%40down"}
    # The layout has a view of it, and changes when it comes.
    assert views.layout_of("train", [], scene.camera_titles) != views.layout_of("train", [])
    views.blueprint([0, 0, 9, 9], cameras={f"cameras/{place}": str(place) for place in range(5)})


def test_the_camera_and_radar_of_the_followed_vehicle_are_shown(drawn: Drawn) -> None:
    own = frames.image(1, {"semantic": SEMANTIC}, [CAR], id_hash=101)
    others = frames.image(1, {"semantic": SEMANTIC[:1]}, [CAR], id_hash=100)
    scan = frames.radar(1, {"distance_m": [5.0]}, id_hash=100)
    samples = [NAMES, WORLD, ("image/b%2Fc", own), ("image/a", others), ("radar/a%40front", scan)]
    scene, found = drawn(*samples, run_map=CARRIED, wanted=["b/c"])
    assert pixels(found[f"{sights.OF_FOLLOWED}/image"]).shape == (2, 3, 3)
    assert space.RADAR not in found, "the radar of another vehicle"
    assert list(scene.camera_titles) == [sights.OF_FOLLOWED]
    # Its suite is not known: the main camera of each that it may carry.
    cameras = {"image/b%2Fc", "image/b%2Fc%40image_2", "image/b%2Fc%40down"}
    assert scene.sensor_topics() == cameras | {"radar/b%2Fc%40front"}
    scene, found = drawn(*samples, run_map=CARRIED, wanted=["b/c"], cameras=["off"], radars=["off"])
    assert scene.sensor_topics() == set() and f"{sights.OF_FOLLOWED}/image" not in found


def test_a_vehicle_with_a_camera_is_followed_if_none_has_a_lidar(drawn: Drawn) -> None:
    places = np.zeros((3, 2), np.float32)
    bits = [wire.sensor_bit("radar"), wire.sensor_bit("camera"), wire.sensor_bit("lidar")]
    for sensors, expected in (([7, bits[0], bits[1]], 102), ([7, bits[1], bits[2]], 102), ([7, bits[0], 7], 101)):
        seen = ("observation", frames.observation(0, places, places, sensors=np.array(sensors)))
        assert drawn(seen, WORLD)[0].followed == [expected]


def test_what_a_departed_carrier_saw_goes_with_it(drawn: Drawn) -> None:
    seen = frames.image(1, {"rgb": np.full((2, 3, 3), 200)}, [CAR], id_hash=102)
    fixed = frames.image(1, {"rgb": np.full((2, 3, 3), 200)}, [CAR], id_hash=9, vehicle=(1 << 30))
    scan = frames.radar(1, {"distance_m": [5.0]}, id_hash=102)
    _, found = drawn(
        NAMES,
        WORLD,
        ("image/d", seen),
        ("image/crossing%20north%40down", fixed),
        ("radar/d%40front", scan),
        ("world", frames.world(2, 2)),
        run_map=CARRIED,
        cameras=["d", "crossing north@down"],
        radars=["d@front"],
    )
    assert pixels(found["cameras/0/image"]).max() == 0 and not found["cameras/0/boxes"].newest("Boxes2D:labels")
    assert pixels(found["cameras/1/image"]).min() == 200
    assert [len(row["Points3D:positions"]) for _, row in found[space.RADAR].rows] == [1, 0]


def test_detections_are_points_in_the_world_coloured_by_radial_velocity(drawn: Drawn) -> None:
    columns = {
        "distance_m": [10.0, 10.0, 10.0],
        "azimuth_rad": [0.0, np.pi / 2, 0.0],
        "elevation_rad": [0.0, 0.0, np.pi / 2],
        "radial_velocity_mps": [25.0, 0.0, -5.0],
    }
    # Heading north, at x 1, y 2, z 3.
    scan = frames.radar(4, columns, id_hash=100, position_m=[1.0, 2.0, 3.0], attitude_rad=[0.0, 0.0, np.pi / 2])
    second = frames.radar(4, {"distance_m": [1.0]}, id_hash=101, attitude_rad=[0.0, 0.5, 0.0])
    _, found = drawn(
        ("radar/a%40front", scan),
        ("radar/b%2Fc%40front", second),
        run_map=CARRIED,
        radars=["a@front", "b/c@front"],
        cameras=["off"],
    )
    expected = [[1, 12, 3], [-9, 2, 3], [1, 2, 13], [np.cos(0.5), 0, np.sin(0.5)]]
    np.testing.assert_allclose(found[space.RADAR].newest("Points3D:positions"), expected, atol=1e-5)
    blue, white, pale, still = found[space.RADAR].newest("Points3D:colors")
    assert (blue, white, still) == (0x4696FFFF, 0xEBEBEBFF, 0xEBEBEBFF)
    red, green, _ = (pale >> shift & 0xFF for shift in (24, 16, 8))
    assert red > green + 50
    assert any("closer" in label for label in found[legend.SIGNS].newest("Points2D:labels"))
    assert len(detections.colors(np.array([np.nan, np.inf], np.float32))) == 2


def test_a_choice_that_the_run_does_not_have_is_an_error_that_says_what_there_is() -> None:
    mounted.check_choices(CAMERA, [], CARRIED)
    mounted.check_choices(CAMERA, ["a", "a@image_3", "crossing north@down"], CARRIED)
    for kind, name, run_map, message in [
        (CAMERA, "a@rear", CARRIED, "no such camera; names behind the id: no @, @image_2, @image_3, @down"),
        (CAMERA, "crossing north@image_2", CARRIED, "names behind the id: @down$"),
        (RADAR, "a", CARRIED, "no such radar; names behind the id: @front$"),
        (RADAR, "crossing north@front", CARRIED, "none there"),
        (RADAR, "a", CARRIED | {"sensor_units": UNITS[:1]}, "nothing in the run carries a radar.*radar.vehicles=2"),
        (CAMERA, "a", CARRIED | {"rates_hz": {"image": 0.0}}, "publishes no `image`: its `fanout.image_hz` is 0"),
    ]:
        with pytest.raises(LinkError, match=message):
            mounted.check_choices(kind, [name], run_map)
    assert mounted.carriers(["a@image_2", "crossing north@down", "a"], CARRIED) == ["a"]


def test_a_chosen_sensor_that_stays_silent_is_explained_once(drawn: Drawn) -> None:
    places = np.zeros((3, 2), np.float32)
    camera = 7 | wire.sensor_bit("camera")
    seen = frames.observation(0, places, places, sensors=np.array([7, camera, camera]))
    scene, _ = drawn(
        NAMES, WORLD, *[("observation", seen)] * 50, run_map=CARRIED, cameras=["a", "b/c", "gone"], radars=["off"]
    )
    assert scene.take_notes() == [
        "--camera a: a carries no camera that delivers; vehicles that do: b/c, d",
        "--camera b/c: no message of this camera comes",
        "--camera gone: gone is not on the road",
    ]
    assert scene.take_notes() == []
