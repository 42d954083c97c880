"""The example detector: its metric, its network, its file, the fields that it fills, and a short training."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.envs import Simulation, make
from caraware.examples.detector import exported, loop
from caraware.examples.detector.exported import ExportError, OnnxDetector, decode, difference_from_torch, export
from caraware.examples.detector.images import CAMERA, Class, LabelledImages, Objects, collect, focal_px, objects_of
from caraware.examples.detector.loop import FIELDS, WITHIN_M, Accuracy, run
from caraware.examples.detector.metric import (
    MISS,
    NOT_COUNTED,
    Detections,
    average_precision,
    class_precisions,
    match,
)
from caraware.examples.detector.network import STRIDE, Cells, Labels, Losses, Network, encode, generalised_iou, losses
from caraware.examples.detector.objects import DetectedObjects, Mounting
from caraware.examples.detector.traffic import write_mixed_traffic
from caraware.examples.detector.training import Settings, augmented, stacked, train
from caraware.ipc.image import EVENT, IMAGE, SEEN, Image, Label
from caraware.ipc.mounts import MountedSensor
from caraware.ipc.run_file import ConfigError
from caraware.tasks.fields import Fields

HEIGHT, WIDTH = 96, 192
RANGE_M = 80.0


# The metric.


def test_average_precision_is_the_area_under_the_monotone_curve() -> None:
    # By hand: hits at ranks 1, 3 and 4 of four objects. Recall 1/4, 2/4, 3/4 at precisions 1, 3/4 (of rank 4, which is
    # better than the 2/3 of rank 3) and 3/4.
    hit, scores = [True, False, True, True, False], [0.9, 0.8, 0.7, 0.6, 0.5]
    assert average_precision(hit, scores, 4) == pytest.approx((1 + 3 / 4 + 3 / 4) / 4)
    # The order in which detections are given is no matter, their scores are.
    shuffled = [3, 0, 4, 2, 1]
    again = average_precision([hit[k] for k in shuffled], [scores[k] for k in shuffled], 4)
    assert again == average_precision(hit, scores, 4)
    assert average_precision([True] * 3, [0.9, 0.8, 0.7], 3) == 1.0
    assert average_precision([False] * 3, [0.9, 0.8, 0.7], 3) == 0.0
    assert average_precision([], [], 3) == 0.0
    assert math.isnan(average_precision([False], [0.9], 0))


def boxes(*rows: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, 4)


def test_an_object_is_hit_once_and_ignored_objects_do_not_count() -> None:
    truth = boxes((0, 0, 10, 10), (50, 0, 60, 10), (80, 0, 84, 10))
    ignored = np.array([False, False, True])
    found = boxes(
        (1, 0, 11, 10),  # IoU 9/11 with the first
        (0, 0, 10, 10),  # exact, but the first is taken
        (56, 0, 66, 10),  # IoU 4/16 with the second
        (80, 0, 84, 9),  # the ignored one
        (100, 0, 110, 5),  # lower than anything that counts
    )
    assert match(found, truth, ignored).tolist() == [0, MISS, MISS, NOT_COUNTED, NOT_COUNTED]
    assert match(found, boxes(), np.zeros(0, bool)).tolist() == [MISS, MISS, MISS, MISS, NOT_COUNTED]


def random_scenes(count: int) -> list[Objects]:
    """Four objects in each image, far enough from each other that half a width hits no other."""
    rng, scenes = np.random.default_rng(3), []
    for _ in range(count):
        left, top = np.arange(4) * 48 + rng.uniform(0, 8, 4), rng.uniform(10, 40, 4)
        size = rng.uniform(8, 24, (4, 2))
        edges = np.stack([left, top, left + size[:, 0], top + size[:, 1]], axis=1).astype(np.float32)
        places = np.stack([edges[:, [0, 2]].mean(1), rng.uniform(3, 30, 4)], axis=1).astype(np.float32)
        scenes.append(Objects(edges, np.arange(4), places, np.zeros(4, bool)))
    return scenes


def perfect(scene: Objects) -> Detections:
    return Detections(scene.boxes_px, scene.classes, np.linspace(0.9, 0.5, 4, dtype=np.float32), scene.places)


def test_a_broken_detector_has_a_low_precision() -> None:
    scenes = random_scenes(20)
    found = [perfect(scene) for scene in scenes]
    assert class_precisions(found, scenes) == dict.fromkeys(["person", "two_wheeler", "car", "truck", "mean"], 1.0)

    def changed(one: Detections, **parts: Any) -> Detections:
        return Detections(**(vars(one) | parts))

    # Half a width aside is an IoU of a third.
    half = [(one.boxes_px[:, 2] - one.boxes_px[:, 0]) / 2 for one in found]
    aside = [
        changed(one, boxes_px=one.boxes_px + width[:, None] * np.array([1, 0, 1, 0], np.float32))
        for one, width in zip(found, half, strict=True)
    ]
    assert class_precisions(aside, scenes)["mean"] == 0.0
    assert class_precisions(aside, scenes, at_least=0.3)["mean"] == 1.0
    assert class_precisions([changed(one, classes=one.classes[::-1].copy()) for one in found], scenes)["mean"] == 0.0
    # Another says everything twice: the k-th hit comes as number 2 k - 1.
    twice = [
        Detections(
            np.repeat(one.boxes_px, 2, axis=0),
            np.repeat(one.classes, 2),
            np.repeat(one.scores, 2),
            np.repeat(one.places, 2, axis=0),
        )
        for one in found
    ]
    assert class_precisions(twice, scenes)["mean"] == pytest.approx(sum(k / (2 * k - 1) for k in range(1, 21)) / 20)
    # One that knows half of the images.
    blind = changed(found[0], **{name: value[:0] for name, value in vars(found[0]).items()})
    assert class_precisions([*found[:10], *[blind] * 10], scenes)["mean"] == pytest.approx(0.5)


# Labels.


def image_of(width: int, height: int, objects: np.ndarray, instance: np.ndarray, depth_m: np.ndarray) -> Image:
    head = np.zeros(1, IMAGE)
    head["width"], head["height"], head["focal_px"] = width, height, focal_px(width, 90.0)
    mounted = MountedSensor("car", "", "camera", (0.0,) * 6, False)
    return Image(
        tick=0,
        sim_time_ns=0,
        vehicle=0,
        mounted=mounted,
        head=head[0],
        objects=objects,
        depth_m=depth_m,
        instance=instance,
        semantic=None,
        rgb=None,
        binary=None,
        infrared=None,
        flow_px=None,
        events=np.zeros(0, EVENT),
    )


def test_labels_have_what_is_visible_and_its_nearest_point() -> None:
    instance, depth = np.zeros((40, 40), np.uint32), np.full((40, 40), 100.0, np.float32)
    instance[10:20, 5:15], depth[10:20, 5:15] = 7, 12.0
    depth[15, [6, 12]] = 9.0  # as deep, but the second is nearer to the axis
    instance[10:20, 5], depth[10:20, 5] = 8, 2.0  # another object in the same box
    instance[30:35, 30:39], depth[30:35, 30:39] = 9, 50.0
    seen = np.zeros(4, SEEN)
    seen["object"], seen["visible_px"] = [7, 8, 9, 10], [90, 10, 45, 45]
    seen["label"] = [Label.BUS, Label.BICYCLE, Label.PERSON, Label.POLE]
    seen["visible_box_px"] = [(6, 10, 14, 19), (5, 10, 5, 19), (30, 30, 38, 34), (30, 30, 38, 34)]
    seen["full_box_px"] = [(5, 10, 15, 20), (5, 10, 6, 20), (30, 30, 39, 35), (30, 30, 39, 35)]
    found = objects_of(image_of(40, 40, seen, instance, depth))
    assert found.boxes_px.tolist() == [[6, 10, 15, 20], [5, 10, 6, 20], [30, 30, 39, 35]]
    assert found.classes.tolist() == [Class.TRUCK, Class.TWO_WHEELER, Class.PERSON]
    assert found.places.tolist()[:2] == [[12.5, 9.0], [5.5, 2.0]]
    # Too few pixels, and too low.
    assert found.ignored.tolist() == [False, True, True]
    # Hidden by more than two thirds; cut off by more than half.
    seen["full_box_px"][0] = 5, 5, 35, 20
    assert objects_of(image_of(40, 40, seen, instance, depth)).ignored.tolist() == [True, True, True]
    seen["full_box_px"][0], seen["truncated"][0] = (5, 10, 15, 20), 0.6
    assert objects_of(image_of(40, 40, seen, instance, depth)).ignored.tolist() == [True, True, True]


def test_mirrored_images_have_mirrored_labels() -> None:
    scenes = random_scenes(8)
    images = torch.zeros(8, 3, HEIGHT, WIDTH, dtype=torch.uint8)
    for row, scene in enumerate(scenes):
        left, top, right, bottom = scene.boxes_px[0].round().astype(int)
        images[row, :, top:bottom, left:right] = 255
    changed, labels = augmented(images, stacked(scenes), np.random.default_rng(1))
    mirrored = 0
    for row, scene in enumerate(scenes):
        area = (scene.boxes_px[:, 2:] - scene.boxes_px[:, :2]).prod(1)
        place = np.argsort(-area, kind="stable").tolist().index(0)
        left, top, right, bottom = (int(edge) for edge in labels.boxes_px[row, place].round())
        inside = changed[row].float()
        assert inside[:, top:bottom, left:right].mean() > 100 + inside[:, :10].mean()
        assert left <= labels.places[row, place, 0] <= right
        mirrored += int(labels.boxes_px[row, place, 0] != scene.boxes_px[0, 0])
    assert 0 < mirrored < 8


# Network and loss.


def said(labels: Labels) -> Cells:
    """What a perfect network says: a sure peak where a centre is, and everywhere the box of the cell's owner."""
    targets = encode(labels, HEIGHT, WIDTH)
    heat = torch.where(targets.heat == 1.0, 9.0, -12.0)
    rows = torch.arange(len(targets.owner))[:, None, None]
    boxes_px, places = labels.boxes_px[rows, targets.owner], labels.places[rows, targets.owner]
    return Cells(heat, boxes_px.permute(0, 3, 1, 2), places.permute(0, 3, 1, 2))


def test_what_is_encoded_is_decoded() -> None:
    scenes = random_scenes(10)
    labels = stacked(scenes)
    cells = said(labels)
    found = decode(cells.heat.sigmoid().numpy(), cells.boxes_px.numpy(), cells.places.numpy(), least_score=0.5)
    for scene, detections in zip(scenes, found, strict=True):
        order = np.argsort(detections.classes)
        np.testing.assert_array_equal(detections.classes[order], scene.classes)
        np.testing.assert_allclose(detections.boxes_px[order], scene.boxes_px, atol=1e-4)
        np.testing.assert_allclose(detections.places[order], scene.places, atol=1e-4)
    right = losses(cells, labels, encode(labels, HEIGHT, WIDTH))
    assert all(0.0 <= float(part) < 0.01 for part in right), right
    # Each part of the loss sees its own error.
    wide = cells._replace(boxes_px=cells.boxes_px + torch.tensor([-4.0, 0.0, 4.0, 0.0])[:, None, None])
    far = cells._replace(places=cells.places * torch.tensor([1.0, 1.5])[:, None, None])
    blank = cells._replace(heat=torch.full_like(cells.heat, -12.0))
    targets = encode(labels, HEIGHT, WIDTH)
    for place, wrong in enumerate((blank, wide, far)):
        changed = losses(wrong, labels, targets)
        assert [float(b) > float(a) + 0.1 for a, b in zip(right, changed, strict=True)] == [
            k == place for k in range(3)
        ]
    assert float(losses(far, labels, targets).place) == pytest.approx(2 * math.log(1.5), rel=1e-3)


def test_only_the_highest_of_neighbouring_cells_is_an_object() -> None:
    scores = np.zeros((1, len(Class), 4, 4), np.float32)
    scores[0, Class.CAR, 1, :] = 0.6, 0.9, 0.7, 0.8
    # Boxes that do not overlap, so that no other rule takes the lower ones away.
    boxes_px = np.zeros((1, 4, 4, 4), np.float32)
    boxes_px[0, [0, 2]] = np.array([[0, 4, 8, 12], [4, 8, 12, 16]], np.float32)[:, None]
    boxes_px[0, 3] = 8.0
    found = decode(scores, boxes_px, np.ones((1, 2, 4, 4), np.float32), least_score=0.3)[0]
    assert found.scores.tolist() == pytest.approx([0.9, 0.8])
    assert found.boxes_px[:, 0].tolist() == [4.0, 12.0]
    assert len(decode(scores, boxes_px, np.ones((1, 2, 4, 4), np.float32), least_score=0.85)[0].scores) == 1


def test_an_ignored_object_teaches_nothing() -> None:
    scene = random_scenes(1)[0]
    counted = stacked([scene])
    ignored = stacked([Objects(scene.boxes_px, scene.classes, scene.places, np.ones(4, bool))])
    cells = said(counted)
    targets = encode(ignored, HEIGHT, WIDTH)
    assert float(sum(losses(cells, ignored, targets))) < 0.01
    nothing = ignored._replace(ignored=torch.zeros_like(ignored.ignored))
    assert float(losses(cells, nothing, encode(nothing, HEIGHT, WIDTH)).heat) > 1.0


def test_a_cell_learns_the_smaller_of_two_boxes() -> None:
    box = np.array([[0, 0, 96, 80], [44, 36, 52, 44]], np.float32)
    labels = stacked([Objects(box, np.array([2, 0]), np.ones((2, 2), np.float32), np.zeros(2, bool))])
    targets = encode(labels, HEIGHT, WIDTH)
    small = int(labels.boxes_px[0, :, 0].argmax())
    assert targets.owner[0, 40 // STRIDE, 48 // STRIDE] == small
    assert targets.heat[0, 0].max() == targets.heat[0, 2].max() == 1.0
    assert targets.heat[0, 1].max() == 0.0


def test_generalised_iou_by_hand() -> None:
    one = torch.tensor([[0.0, 0.0, 2.0, 2.0]] * 3)
    other = torch.tensor([[0.0, 0.0, 2.0, 2.0], [1.0, 0.0, 3.0, 2.0], [3.0, 0.0, 4.0, 2.0]])
    # Overlap 2 of 6, hull 6; no overlap, union 6 of a hull of 8.
    assert generalised_iou(one, other).tolist() == pytest.approx([1.0, 1 / 3, -1 / 4])


def untrained() -> Network:
    """A network whose peaks and boxes differ from place to place: batch norms have statistics, heads have weights."""
    torch.manual_seed(2)
    network = Network().train()
    with torch.no_grad():
        for _ in range(3):
            network(torch.randint(0, 256, (4, 3, HEIGHT, WIDTH), dtype=torch.uint8))
    return network.eval()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of an untrained network."""
    path = tmp_path_factory.mktemp("detector") / "untrained.onnx"
    export(untrained(), path, HEIGHT, WIDTH)
    return path


def test_the_file_computes_what_torch_does(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = torch.randint(0, 256, (5, 3, HEIGHT, WIDTH), dtype=torch.uint8)
    assert difference_from_torch(untrained(), file, images) < 1e-3
    assert [len(output) for output in OnnxDetector(file).cells(images[:1].numpy())] == [1, 1, 1]
    other = untrained()
    with torch.no_grad():
        next(other.parameters()).mul_(1.2)
    assert difference_from_torch(other, file, images) > 1e-3
    monkeypatch.setattr(exported, "difference_from_torch", lambda *_: 2e-3)
    with pytest.raises(ExportError, match="differs from torch by 2"):
        export(untrained(), tmp_path / "other.onnx", HEIGHT, WIDTH)


# Places and fields.


def test_places_are_ahead_and_left_of_the_rear_axle() -> None:
    camera = {"width": 200, "height": 100, "horizontal_fov_deg": 90.0, "mount": [1.5, 0.25, 1.4, 0.0, 0.0, 0.0]}
    # f = 100 px: 50 columns left of the middle is 45° / 2 in slope, 5 m at a depth of 10 m; 20 rows down is 2 m.
    at = Mounting(camera).body_m(
        np.array([[50.0, 10.0], [150.0, 10.0]], np.float32), np.array([70.0, 50.0], np.float32)
    )
    np.testing.assert_allclose(at, [[11.5, 5.25, -0.6], [11.5, -4.75, 1.4]], atol=1e-6)
    # A camera that looks left sees to the left; one that looks down sees less far.
    ahead = np.array([[100.0, 10.0]], np.float32), np.array([50.0], np.float32)
    left = camera | {"mount": [1.5, 0.25, 1.4, 0.0, 0.0, math.pi / 2]}
    np.testing.assert_allclose(Mounting(left).body_m(*ahead), [[1.5, 10.25, 1.4]], atol=1e-6)
    down = camera | {"mount": [1.5, 0.25, 1.4, 0.0, -math.pi / 6, 0.0]}
    np.testing.assert_allclose(
        Mounting(down).body_m(*ahead), [[1.5 + 10 * math.cos(math.pi / 6), 0.25, -3.6]], atol=1e-6
    )
    # Its up is ahead, too: 20 rows up are 2 m, of which half is ahead.
    above = Mounting(down).body_m(ahead[0], np.array([30.0], np.float32))
    wanted = [[2.5 + 10 * math.cos(math.pi / 6), 0.25, -3.6 + 2 * math.cos(math.pi / 6)]]
    np.testing.assert_allclose(above, wanted, atol=1e-6)
    rolled = camera | {"mount": [0.0, 0.0, 0.0, math.pi / 2, 0.0, 0.0]}
    right = Mounting(rolled).body_m(np.array([[50.0, 10.0]], np.float32), np.array([50.0], np.float32))
    np.testing.assert_allclose(right, [[10.0, 0.0, 5.0]], atol=1e-6)


def run_of(**changes: Any) -> dict[str, Any]:
    """A run file with a camera and the fields `speed`, `object_1_*`, `object_2_*`."""
    camera = {"vehicles": 2, "observed": "rgb", "width": WIDTH, "height": HEIGHT, "horizontal_fov_deg": 90.0}
    camera |= {"mount": [1.0, 0.0, 1.4, 0.0, 0.0, 0.0]} | changes.pop("camera", {})
    names = changes.pop("fields", ["speed", "object_1_x", "object_1_y", "object_2_x", "object_2_y"])
    ranges = {name: [-RANGE_M, RANGE_M] if name.startswith("object") else [0.0, 30.0] for name in names}
    return {
        "config": {
            "camera": camera,
            "lidar": {"range_m": RANGE_M},
            "observation": {"fields": names, "scale": changes.pop("scale", "minus_one_to_one"), "history": 1} | changes,
        },
        "observation_fields": [{"name": name, "range": span} for name, span in ranges.items()],
    }


class Seer(OnnxDetector):
    """A detector that says what a test wants."""

    height, width = HEIGHT, WIDTH

    def __init__(self, *found: Detections) -> None:
        self._found = list(found)

    def detect(self, images: np.ndarray) -> list[Detections]:
        assert images.shape == (len(self._found), 3, HEIGHT, WIDTH)
        return self._found


def seen(*rows: tuple[float, float, float]) -> Detections:
    """Objects at these columns and depths with these scores, most certain first; a box of 8 x 8 pixels at each."""
    table = np.array(rows, np.float32).reshape(-1, 3)
    edges = table[:, :1] + np.array([-4.0, 0.0, 4.0, 0.0], np.float32) + np.array([0, 40, 0, 48], np.float32)
    return Detections(edges, np.full(len(table), Class.CAR), table[:, 2], table[:, :2])


IMAGES = torch.zeros(2, 3, HEIGHT, WIDTH, dtype=torch.uint8)


@pytest.mark.parametrize(("scale", "low"), [("minus_one_to_one", -1.0), ("zero_to_one", 0.0)])
def test_fields_have_the_nearest_objects_in_the_simulator_s_numbers(scale: str, low: float) -> None:
    # f = 96 px. Far right, near left, and one that is beyond the range.
    first = seen((144.0, 30.0, 0.9), (48.0, 9.0, 0.8), (96.0, 79.5, 0.7))
    objects = DetectedObjects(Seer(first, seen()), run_of(scale=scale))
    observation = torch.full((3, 5), 0.123)
    filled = objects.fill(observation, IMAGES)
    assert torch.equal(observation, torch.full((3, 5), 0.123))
    assert torch.equal(filled[:, 0], observation[:, 0])
    # 9 m before a camera 1 m ahead of the axle, half as much to the left; 31 m ahead, 15 m to the right.
    metres = torch.tensor([10.0, 4.5, 31.0, -15.0])
    unit = (metres + RANGE_M) / (2 * RANGE_M)
    torch.testing.assert_close(filled[0, 1:], low + (1 - low) * unit)
    assert filled[0, 2] > low + (1 - low) / 2 > filled[0, 4]
    assert objects.nearest_m(first)[2:].tolist() == [[RANGE_M, RANGE_M]] * 2
    # No object, and no camera.
    assert torch.equal(filled[1:, 1:], torch.ones(2, 4))


def test_an_object_of_two_classes_is_one_object() -> None:
    one = seen((96.0, 20.0, 0.9), (97.0, 10.0, 0.5))
    objects = DetectedObjects(Seer(one, one), run_of())
    assert objects.nearest_m(one).tolist() == [[21.0, 0.0]] + [[RANGE_M, RANGE_M]] * 3


def test_of_a_history_the_newest_tick_is_filled() -> None:
    objects = DetectedObjects(Seer(seen((96.0, 20.0, 0.9)), seen()), run_of(history=2))
    filled = objects.fill(torch.full((2, 10), 0.5), IMAGES)
    assert torch.equal(filled[:, :6], torch.full((2, 6), 0.5))
    assert filled[0, 6] == pytest.approx(21.0 / RANGE_M)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera": {"observed": "semantic"}}, "no images in colour"),
        ({"camera": {"observed": "none"}}, "no images in colour"),
        ({"camera": {"width": 160}}, "160 × 96 pixels"),
        ({"fields": ["speed"]}, "no `object_"),
    ],
)
def test_a_run_that_the_detector_cannot_serve_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        DetectedObjects(Seer(), run_of(**changes))


def test_accuracy_by_hand() -> None:
    mounting = Mounting(run_of()["config"]["camera"])
    truth = seen((96.0, 20.0, 1.0), (48.0, 10.0, 1.0), (144.0, 60.0, 1.0), (20.0, 30.0, 1.0))
    objects = Objects(truth.boxes_px, truth.classes, truth.places, np.zeros(4, bool))
    accuracy = Accuracy()
    # The first 3 m too far; the third, beyond 40 m, found; the second and fourth not; and a ghost.
    accuracy.add(seen((96.0, 23.0, 0.9), (144.0, 55.0, 0.8), (170.0, 15.0, 0.7)), objects, mounting)
    assert accuracy.table() == pytest.approx(
        {"error_median_m": 3.0, "error_p90_m": 3.0, "recall": 1 / 3, "precision": 1 / 2, "objects": 3}
    )


def test_a_map_without_mixed_traffic_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="town or avenue"):
        write_mixed_traffic("valley", tmp_path, 1, 10.0)


# A real simulation.


@pytest.fixture(scope="module")
def real() -> Iterator[tuple[LabelledImages, LabelledImages]]:
    """Images of two seeds of the town."""
    torch.set_num_threads(1)
    yield collect("town", 1, 60.0, 1.0), collect("town", 2, 50.0, 4.0)


def test_collected_images_show_every_class(real: tuple[LabelledImages, LabelledImages]) -> None:
    seen, unseen = real
    assert seen.rgb.shape[1:] == (3, CAMERA["camera.height"], CAMERA["camera.width"])
    assert len(seen) > 200 and len(unseen) > 50
    assert all(counted > 5 for counted, _ in seen.count().values()), seen.count()
    for one in seen.objects:
        inside = (one.places[:, 0] > one.boxes_px[:, 0]) & (one.places[:, 0] < one.boxes_px[:, 2])
        assert inside.all() and (one.places[:, 1] > 0).all()
    assert not np.array_equal(seen.rgb[: len(unseen)], unseen.rgb)


def test_labelled_places_are_where_the_lidar_measures_objects(tmp_path: Path) -> None:
    # Askew, so that a wrong sign or order of the rotations shows. The LIDAR is another sensor with its own mounting.
    settings = CAMERA | {
        "camera.vehicles": 16,
        "camera.mount": [1.0, 0.4, 1.6, 0.1, -0.25, 0.5],
        "lidar.vehicles": 16,
        "observation.fields": FIELDS,
        "run.window_ticks": 2,
        "episode.ticks": 200,
    }
    apart_m, waiting = [], list[Image]()
    with make(write_mixed_traffic("town", tmp_path, 5, 20.0), settings, 5) as simulation:
        channel, fields = simulation.channel, Fields.from_run(simulation.run)
        mounting = Mounting(simulation.run["config"]["camera"])
        channel.images()
        while (obs := simulation.receive()) is not None and obs.episode == 0:
            waiting = [image for image in [*waiting, *channel.images()] if image.tick >= obs.tick]
            slot_of = {int(vehicle): slot for slot, vehicle in enumerate(obs.vehicle)}
            for image in waiting:
                if image.tick != obs.tick or image.vehicle not in slot_of or len(image.objects) == 0:
                    continue
                row = obs.observation.numpy()[slot_of[image.vehicle]]
                lidar = np.array([[fields.si(row, f"object_{k}_{axis}") for axis in "xy"] for k in range(1, 5)])
                truth = objects_of(image)
                seen_at = mounting.body_m(truth.places, truth.boxes_px[:, [1, 3]].mean(1))[:, :2]
                nearest = seen_at[np.hypot(*seen_at.T).argmin()]
                if np.hypot(*nearest) < WITHIN_M:
                    apart_m.append(np.hypot(*(lidar - nearest).T).min())
            channel.consumed(obs.tick)
    # The row of the nearest point is not in a label, a beam may miss the point that the camera sees, and points move
    # while the LIDAR turns.
    assert len(apart_m) > 200
    assert np.median(apart_m) < 1.0 and np.quantile(apart_m, 0.9) < 2.5


def test_a_short_training_helps_and_the_detector_fills_fields_of_a_run(
    real: tuple[LabelledImages, LabelledImages], file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, unseen = real
    history: list[float] = []

    def report(step: int, loss: Losses, elapsed_s: float) -> None:
        history.append(float(sum(loss)))

    network = train(images, Settings(steps=100, batch_size=20), report)
    assert history[-1] < 0.7 * history[0], history
    trained = tmp_path / "trained.onnx"
    export(network, trained, HEIGHT, WIDTH)
    precision = {
        name: class_precisions(OnnxDetector(path, 0.01).detect(unseen.rgb), unseen.objects)["mean"]
        for name, path in (("before", file), ("after", trained))
    }
    assert precision["before"] < 0.02 and precision["after"] > 0.03, precision
    prefixes: list[str] = []

    def made(*arguments: Any) -> Simulation:
        simulation = make(*arguments)
        prefixes.append(simulation.run["shared_memory"]["prefix"])
        return simulation

    monkeypatch.setattr(loop, "make", made)
    figures = run(OnnxDetector(trained, 0.1), "town", 3, 16.0)
    assert figures["images"] > figures["ticks"] >= 100
    assert 0.0 < figures["recall"] <= 1.0 and 0.0 < figures["precision"] <= 1.0
    assert figures["objects"] > 20 and figures["error_median_m"] < 15.0
    # Other runs of the machine come and go meanwhile.
    assert len(prefixes) == 1 and not list(Path("/dev/shm").glob(f"{prefixes[0]}*"))
    assert set(FIELDS) > {"object_1_x", "object_4_y"}
