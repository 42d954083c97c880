"""The lane task: places on lanes, distances, metrics and their references."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.ipc.arrays import BoolArray
from caraware.ipc.run_file import ConfigError
from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.regression import Regression
from caraware.tasks.contract import TaskStep
from caraware.tasks.lane import LanePosition
from caraware.tasks.road_lanes import road_lanes
from synthetic import run_file
from torch import Tensor

NET = Path(__file__).parent / "two_lanes.net.xml"


@dataclass(frozen=True)
class Rows:
    """A tick as metrics take it."""

    truth: Tensor
    gnss_m: Tensor
    valid: BoolArray


def lane_run(folder: Path, **trainer: object) -> dict[str, Any]:
    """A run on a road of two lanes to the east and one to the west."""
    run = run_file(str(folder), reward="exponential", reward_scale_m=1.0, **trainer)
    run["config"]["task"] = {"kind": "lane"}
    return run | {"scene_files": {"net_file": str(NET)}}


def truth_of(*places: tuple[float, float, float]) -> Tensor:
    return torch.tensor([[x, y, yaw, 5.0] for x, y, yaw in places])


TRUTH = truth_of((10.0, -5.0, 0.1), (70.0, -2.25, 0.0), (20.0, 2.0, math.pi), (105.0, -1.0, -0.1))
EXPECTED = [(0.25, 0.0), (-0.5, 1.0), (-0.25, 0.0), (0.75, 0.0)]
"""Offset to the left of the middle (m), and the lane from the right; pavements do not count."""


def test_a_place_is_on_the_nearest_lane_that_leads_there(tmp_path: Path) -> None:
    task = LanePosition.from_run(lane_run(tmp_path))
    assert task.roads.lanes == 2
    torch.testing.assert_close(task.targets(TRUTH), torch.tensor(EXPECTED), atol=1e-5, rtol=0)
    # The world's (0, 0) lies elsewhere in the net.
    moved = road_lanes(NET, (5.0, -1.0))
    found = moved.locate(torch.tensor([5.0]), torch.tensor([-4.0]), torch.tensor([0.1]))
    torch.testing.assert_close(found.lateral_m, torch.tensor([0.25]), atol=1e-5, rtol=0)


def test_an_action_of_the_truth_earns_most_and_a_wrong_lane_counts_its_width(tmp_path: Path) -> None:
    task = LanePosition.from_run(lane_run(tmp_path))
    step = TaskStep(torch.zeros(4, 3), TRUTH)
    right = torch.tensor([[lateral / 2.0, 2.0 * lane - 1.0] for lateral, lane in EXPECTED])
    torch.testing.assert_close(task.answer(right), torch.tensor(EXPECTED))
    torch.testing.assert_close(task.reward(step, right), torch.ones(4))
    beside = right + torch.tensor([0.15, 0.0])
    other = right * torch.tensor([1.0, -1.0])
    tries = torch.stack((right, beside, other), 1)
    expected = torch.tensor([1.0, math.exp(-0.3), math.exp(-3.5)]).expand(4, 3)
    torch.testing.assert_close(task.reward(step, tries), expected)
    measured = task.measure(step, beside)
    torch.testing.assert_close(measured["lateral_error_m"], torch.full((4,), 0.3))
    assert measured["wrong_lane_percent"].tolist() == [0.0] * 4
    assert task.measure(step, other)["wrong_lane_percent"].tolist() == [100.0] * 4


def test_ticks_are_measured_on_their_valid_rows_alone(tmp_path: Path) -> None:
    task = LanePosition.from_run(lane_run(tmp_path))
    assert [metric.name for metric in task.metrics] == [
        "lateral_error_m",
        "wrong_lane_percent",
        "raw_gnss_lateral_error_m",
        "raw_gnss_wrong_lane_percent",
    ]
    # A fix 3 m to the right of a vehicle in lane 0 is beside the road: at the lane's edge. 3 m to its left is lane 1.
    truth = truth_of((10.0, -5.0, 0.0), (10.0, -5.0, 0.0), (10.0, -5.0, 0.0))
    fixes = torch.tensor([[11.0, -8.0, 0.0], [11.0, -2.0, 0.0], [11.0, -5.0, 0.0]])
    tick = Rows(truth, fixes, np.array([True, True, False]))
    references = task.measure_references([tick, tick])
    for column in references["raw_gnss_lateral_error_m"]:
        np.testing.assert_allclose(column, [1.75 + 0.25, 0.5], atol=1e-5)
    for column in references["raw_gnss_wrong_lane_percent"]:
        assert column.tolist() == [0.0, 100.0]
    errors = task.measure_answers(tick, torch.tensor([[0.5, 0.4], [0.25, 0.6], [0.0, 0.0]]))
    np.testing.assert_allclose(errors["lateral_error_m"], [0.25, 0.0], atol=1e-5)
    assert errors["wrong_lane_percent"].tolist() == [0.0, 100.0]


def test_a_run_without_one_net_is_refused(tmp_path: Path) -> None:
    run = lane_run(tmp_path)
    run["config"]["curriculum"]["maps"] = ["town", "avenue"]
    with pytest.raises(ConfigError, match="the lanes of one net"):
        LanePosition.from_run(run)
    (tmp_path / "broken.xml").write_text("<net><edge/></net>")
    with pytest.raises(ConfigError, match="no lane for cars"):
        LanePosition.from_run(lane_run(tmp_path) | {"scene_files": {"net_file": str(tmp_path / "broken.xml")}})


def test_the_regression_learns_from_the_truth_and_continues_where_it_was_stored(tmp_path: Path) -> None:
    run = lane_run(tmp_path, hidden=[32], epochs=4, batch_size=64)
    config, task = TrainerConfig.from_run(run), LanePosition.from_run(run)
    generator = torch.Generator().manual_seed(3)
    lateral = torch.rand(512, generator=generator) * 3.0 - 1.5
    lane = torch.randint(2, (512,), generator=generator)
    y = torch.where(lane == 1, -1.75, -5.25) + lateral
    truth = torch.stack((torch.full((512,), 50.0), y, torch.zeros(512), torch.ones(512)), 1)
    nothing = torch.zeros(512)
    batch = Batch(
        observation=torch.stack((y / 7.0, nothing), 1),
        action=torch.zeros(512, 2),
        log_probability=nothing,
        reward=nothing,
        advantage=nothing,
        value_target=nothing,
        truth=truth,
        metrics={},
        vehicle=nothing.long(),
        tick=nothing.long(),
    )
    one = Regression(config, 2, task, torch.device("cpu"))
    first = one.learn(batch, 3e-3)
    for _ in range(10):
        last = one.learn(batch, 3e-3)
    assert first > 1.5 and last < 0.9
    other = Regression(config, 2, task, torch.device("cpu"))
    other.restore({name: tensor.clone() for name, tensor in one.tensors().items()})
    assert one.learn(batch, 1e-3) == other.learn(batch, 1e-3)
    for name, tensor in one.tensors().items():
        assert torch.equal(tensor, other.tensors()[name]), name
