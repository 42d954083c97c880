"""What surrounds learning to drive: the encoders, the teacher's actions, the trips of the benchmark."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch
from caraware import _native
from caraware.driving.imitate import Teacher, clone
from caraware.driving.lessons import Lessons, Limits
from caraware.driving.manoeuvres import BETWEEN, NEEDED, Manoeuvres
from caraware.driving.trips import Motion, TripLog
from caraware.ipc.channel import ENDED_BY
from caraware.ipc.stream import EMPTY_SLOT
from caraware.learn.config import TrainerConfig
from caraware.learn.encoders import EGO, FIELDS, GROUPS, GroupedNetwork, GroupEncoder
from caraware.learn.networks import GaussianPolicy
from caraware.learn.ppo import PlainUpdate
from caraware.run.learner import begin_from
from caraware.run.manifest import CheckpointError
from caraware.tasks import ends
from caraware.tasks.driving import ENDS, Driving
from caraware.tasks.ends import name_of
from caraware.tasks.fields import Fields
from safetensors.torch import save_file
from synthetic import run_file
from test_tasks import run_of
from torch import Tensor, nn

LIMITS = Limits(accel_mps2=3.0, decel_mps2=6.0, angle_rad=0.5, tick_s=0.1)


def network(outputs: int = 2) -> GroupedNetwork:
    torch.manual_seed(1)
    return GroupedNetwork(FIELDS, outputs, (16, 16))


def test_the_order_of_a_groups_members_does_not_matter_and_their_number_is_that_of_the_fields() -> None:
    assert FIELDS == 139 and EGO == 16
    rows, mixed = torch.rand(4, FIELDS) * 2 - 1, []
    at = EGO
    for group in GROUPS:
        width = group.members * group.columns
        members = rows[:, at : at + width].view(4, group.members, group.columns)
        mixed.append(members.flip(1).reshape(4, width))
        at += width
    assert at == FIELDS
    net = network()
    assert torch.allclose(net(torch.cat((rows[:, :EGO], *mixed), 1)), net(rows), atol=1e-6)
    other = rows.clone()
    other[:, EGO] += 0.5
    assert not torch.allclose(net(other), net(rows), atol=1e-6), "a member counts"
    with pytest.raises(ValueError, match=r'observation\.fields = "driver"'):
        GroupedNetwork(16, 2, (16,))


@pytest.mark.parametrize("ticks", [1, 3])
def test_a_tick_without_heroes_has_no_actions(ticks: int) -> None:
    net = GroupedNetwork(ticks * FIELDS, 2, (16,))
    assert net(torch.zeros(0, ticks * FIELDS)).shape == (0, 2)
    assert net(torch.zeros(5, ticks * FIELDS)).shape == (5, 2)


def test_members_are_encoded_beside_what_the_hero_itself_does() -> None:
    net, rows = network(), torch.rand(4, FIELDS) * 2 - 1
    with torch.no_grad():
        # Without the direct way of the hero's own fields, they act through the encoders of members alone.
        net.ego.weight.zero_()
        faster = rows.clone()
        faster[:, 0] += 0.5
        assert not torch.allclose(net(faster), net(rows), atol=1e-6)
        for encoder in net.groups:
            assert isinstance(encoder, GroupEncoder) and encoder.context is not None
            encoder.context.weight.zero_()
        assert torch.equal(net(faster), net(rows))


def test_the_teachers_action_is_what_the_ticks_after_it_show() -> None:
    # 10 m/s on a circle of 50 m, then harder braking than acceleration, then standing.
    before = torch.tensor([[0.0, 0.0, 3.1, 10.0], [0.0, 0.0, 0.0, 10.0], [0.0, 0.0, 0.0, 10.0], [0.0, 0.0, 0.0, 0.0]])
    after = torch.tensor([[1.0, 0.0, -3.1631853, 10.0], [1.0, 0, 0.0, 9.0], [1.0, 0, 0.0, 10.3], [0.0, 0.0, 0.2, 0.0]])
    later = torch.tensor([[9.0, 0.0, -2.0, 10.0], [9.0, 0, 0.0, 7.0], [9.0, 0, 0.0, 13.0], [0.0, 0.0, 0.2, 0.0]])
    action = LIMITS.action(before, after, later)
    assert action[0].tolist() == pytest.approx([math.atan(2.7 / 50) / 0.5, 0.0], abs=1e-4), "across ±π"
    assert action[1].tolist() == pytest.approx([0.0, -0.5], abs=1e-5), "3 m/s less after a second, not in the tick"
    assert action[2].tolist() == pytest.approx([0.0, 1.0], abs=1e-5)
    assert action[3, 0] == 0.0, "a yaw rate at standstill shows no steering"
    assert action[3, 1] == pytest.approx(-0.5 / 6), "what stands brakes"


@dataclass
class Tick:
    """A tick of heroes."""

    tick: int
    vehicle: np.ndarray
    episode: int = 0
    left_m: float = 400.0
    ended: dict[int, int] = field(default_factory=dict)

    @property
    def valid(self) -> np.ndarray:
        valid: np.ndarray = self.vehicle != EMPTY_SLOT
        return valid

    @property
    def observation(self) -> Tensor:
        return torch.tensor([[self.left_m / 500 - 1, 0.0]] * len(self.vehicle))

    @property
    def truth(self) -> Tensor:
        return torch.tensor([[0.0, 0.0, 0.0, 10.0]] * len(self.vehicle))

    @property
    def id_hash(self) -> np.ndarray:
        return np.array([_native.id_hash(f"hero.{vehicle}") for vehicle in self.vehicle], np.uint64)

    @property
    def ended_by(self) -> np.ndarray:
        return np.array([self.ended.get(slot, 0) for slot in range(len(self.vehicle))], np.uint32)

    @property
    def terminated(self) -> np.ndarray:
        return np.array([slot in self.ended for slot in range(len(self.vehicle))])

    @property
    def truncated(self) -> np.ndarray:
        return np.zeros(len(self.vehicle), bool)


def heroes(*vehicles: int) -> np.ndarray:
    return np.array([EMPTY_SLOT if vehicle < 0 else vehicle for vehicle in vehicles], np.uint32)


def test_a_pair_is_of_a_hero_that_stays_in_its_slot() -> None:
    teacher = Teacher(replace(LIMITS, tick_s=0.5))
    for tick in (
        Tick(0, heroes(0, 1)),
        Tick(1, heroes(0, 1)),
        Tick(2, heroes(0, 2)),  # one pair: another hero took the second slot
        Tick(3, heroes(0, 2)),  # one, for the same reason
        Tick(5, heroes(0, 2)),  # none: a tick is missing
        Tick(6, heroes(0, 2)),
        Tick(7, heroes(0, -1), episode=1),  # none: another episode
        Tick(8, heroes(0, -1), episode=1),
        Tick(9, heroes(0, -1), episode=1),  # one
    ):
        teacher.add(tick)  # type: ignore[arg-type]  # what the teacher reads of a tick
    assert teacher.pairs == 3 and teacher.tensors()["observation"].shape == (3, 2)


NAMES = ("speed", "steering", *(f"route_{xy}_{d}" for d in (5, 10, 20, 40) for xy in "xy"), "route_offset")
USER = tuple(f"user_1_{name}" for name in ("x", "y", "cos", "sin", "forward", "left", "length", "width"))


def test_a_displaced_hero_sees_what_it_would_see_there_and_is_taught_the_way_back() -> None:
    # Straight on at 10 m/s; a vehicle 20 m ahead and 3 m to the left comes towards the hero.
    seen = [10.0, 0.0, 5.0, 0.0, 10.0, 0.0, 20.0, 0.0, 40.0, 0.0, 0.0, 20.0, 3.0, -1.0, 0.0, -8.0, 0.0, 4.0, 2.0]
    ranges = dict.fromkeys((*NAMES, *USER), (-50.0, 50.0))
    fields = Fields((*NAMES, *USER), 1, -1.0, ranges)
    count, lessons = 4000, Lessons(fields, LIMITS)
    rows, action = torch.tensor([seen] * count) / 50, torch.zeros(count, 2)

    def there(name: str, of: Tensor) -> Tensor:
        return fields.si_tensor(of, name)

    moved, taught = lessons.displaced(rows, action, torch.Generator().manual_seed(3))
    aside_m = -there("route_offset", moved)
    assert aside_m.std().item() == pytest.approx(0.4, rel=0.1)
    # From the route it still is as far to the place 20 m ahead and to the vehicle, and the two see each other alike.
    along, beside = there("route_x_20", moved), there("route_y_20", moved)
    assert torch.allclose(along.square() + beside.square(), 400 + aside_m.square(), atol=1e-2)
    x, y = there("user_1_x", moved), there("user_1_y", moved)
    assert torch.allclose(x.square() + y.square(), 400 + (3 - aside_m).square(), atol=1e-2)
    assert torch.allclose(there("user_1_forward", moved), 8 * there("user_1_cos", moved), atol=1e-3)
    # To the left of the route and not turned, the way back is to the right; too fast, it is braking.
    straight = (there("user_1_sin", moved).abs() < 0.02) & (aside_m > 0.3)
    assert straight.any() and (taught[straight, 0] < -0.02).all()
    faster = there("speed", moved) > 11
    assert faster.any() and (taught[faster, 1] <= -1 / 6 + 1e-5).all()
    # A place without a vehicle stays as it is; and rows without a route are taught as they are.
    rows[:, len(NAMES) :] = torch.tensor([50, 50, 0, 0, 0, 0, 0, 0]) / 50
    assert torch.equal(lessons.displaced(rows, action, torch.Generator())[0][:, len(NAMES) :], rows[:, len(NAMES) :])
    other = Lessons(Fields(("speed",), 1, -1.0, {"speed": (0.0, 30.0)}), LIMITS)
    assert other.displaced(rows, action, torch.Generator())[0] is rows


def test_a_clone_comes_nearer_to_its_teacher_than_doing_nothing_and_a_policy_begins_as_it(tmp_path: Any) -> None:
    generator = torch.Generator().manual_seed(2)
    observation = torch.rand(8000, FIELDS, generator=generator) * 2 - 1
    data = {"observation": observation, "action": torch.stack((observation[:, 3], -observation[:, 5]), 1) * 0.5}
    config = TrainerConfig.from_run(run_file(str(tmp_path)))

    def updater() -> PlainUpdate:
        return PlainUpdate(
            config, GaussianPolicy(nn.Sequential(network(), nn.Tanh()), 2, 0.5), network(1), torch.device("cpu")
        )

    taught = updater()
    figures = clone(data, taught, generator, Lessons(Fields((), 1, -1.0, {}), LIMITS))
    assert figures.pairs == 8000
    assert all(error < 0.7 * none for error, none in zip(figures.error, figures.error_of_zero, strict=True))
    file, fresh = tmp_path / "clone.safetensors", updater()
    kept = {name: tensor.clone() for name, tensor in taught.parameters().items() if name.startswith("policy.")}
    save_file(kept, file)
    begin_from(fresh.parameters(), file)
    assert torch.allclose(fresh.mean(observation[:9]), taught.mean(observation[:9]), atol=1e-6)
    save_file({"policy.0.trunk.0.weight": torch.zeros(2, 2)}, file)
    with pytest.raises(CheckpointError, match="does not hold parameters of this run's networks"):
        begin_from(fresh.parameters(), file)


def test_a_policy_on_a_gpu_acts_by_a_copy_on_the_cpu_that_follows_it(tmp_path: Any) -> None:
    config = TrainerConfig.from_run(run_file(str(tmp_path)))
    policy = GaussianPolicy(nn.Sequential(network(), nn.Tanh()), 2, 0.5)
    updater, rows = PlainUpdate(config, policy, network(1), torch.device("cpu")), torch.rand(9, FIELDS)
    # No GPU is needed to see which of the two answers: the policy is said to be elsewhere.
    updater.device = torch.device("cuda")
    first = updater.mean(rows)
    assert first.equal(policy(rows).detach())
    with torch.no_grad():
        updater.parameters()["policy.0.trunk.0.weight"].add_(0.1)
    assert updater.mean(rows).equal(policy(rows).detach()) and not updater.mean(rows).equal(first)


def trip_log() -> TripLog:
    run = run_of("driving")
    run["config"]["traffic"] |= {"heroes": 2, "cavs": 0, "others": 0, "pedestrians": 0}
    run["config"]["trainer"] = run_file("/tmp")["config"]["trainer"]
    return TripLog(run, Driving.from_run(run))


def test_every_end_that_the_flags_tell_has_a_name_that_the_task_lists() -> None:
    bits = 0
    for bit, name in ends.END_NAMES.items():
        assert bits & bit == 0 and name_of(bit) == name
        bits |= bit
    assert bits == int(ENDED_BY)
    assert {*ends.END_NAMES.values(), ends.RUN_ENDED} == {end.name for end in ENDS}


def test_a_trip_is_that_of_a_hero_of_the_list_and_counts_once() -> None:
    log = trip_log()
    log.add(Tick(0, heroes(0, -1)))  # type: ignore[arg-type]  # what the log reads of a tick
    log.add(Tick(1, heroes(0, 1)))  # type: ignore[arg-type]
    log.add(Tick(2, heroes(-1, 1), ended={0: ends.COLLISION | ends.OFF_ROAD}))  # type: ignore[arg-type]
    log.add(Tick(3, heroes(5, 1)))  # type: ignore[arg-type]  # a hero that replaces another is not of the list
    log.add(Tick(4, heroes(5, -1), ended={1: ends.ARRIVAL}))  # type: ignore[arg-type]
    log.add(Tick(5, heroes(0, -1), episode=1, left_m=700.0))  # type: ignore[arg-type]
    log.add(Tick(6, heroes(-1, -1), episode=2, ended={0: 0}))  # type: ignore[arg-type]
    found = [(trip.episode, trip.hero, trip.end, round(trip.length_m), round(trip.way_m, 3)) for trip in log.trips]
    assert found == [
        (0, "hero.0", "collision", 400, 1.0),
        (0, "hero.1", "arrival", 400, 2.0),
        (1, "hero.0", "end of the run's episode", 700, 0.0),
    ]


def test_jerk_is_of_the_second_difference_of_the_speed_alone() -> None:
    steady = Motion(3.0)
    assert [steady.advance(3.0 + 0.2 * tick, 0.1) for tick in range(1, 4)] == pytest.approx([2.0] * 3)
    assert steady.jerk_mps3() == pytest.approx(0.0, abs=1e-9)
    jerky = Motion(3.0)
    assert jerky.jerk_mps3() == 0.0
    # 2, 0 and −1 m/s²: 20 and 10 m/s³.
    for speed in (3.2, 3.2, 3.1):
        jerky.advance(speed, 0.1)
    assert jerky.jerk_mps3() == pytest.approx(math.sqrt((20.0**2 + 10.0**2) / 2))


def test_a_manoeuvre_is_how_the_hero_turns_and_who_has_the_right_of_way_until_the_junction_is_behind() -> None:
    fields = Fields(NEEDED, 1, 0.0, {name: (-100.0, 100.0) for name in NEEDED})

    def row(gap_m: float, priority: float, light_m: float, turn_rad: float) -> Tensor:
        ahead = 20 * math.cos(turn_rad), 20 * math.sin(turn_rad)
        values = [gap_m, priority, light_m, 20.0, 0.0, 20 + ahead[0], ahead[1]]
        return (torch.tensor(values) + 100) / 200

    seen = Manoeuvres()
    for gap_m, priority, light_m, turn_rad, expected in [
        (20, 0, 20, 1.6, BETWEEN),
        (2, 0, 2, 1.6, BETWEEN),
        # Behind the stop line: the next junction is far, and what is ahead of the hero does not matter any more.
        (60, 1, 100, 0.0, "left turn, green, yielding"),
        (50, 1, 100, 0.0, "left turn, green, yielding"),
        (40, 1, 100, 0.0, "left turn, green, yielding"),
        (30, 1, 100, 0.0, "left turn, green, yielding"),
        (19, 1, 100, 0.0, BETWEEN),
        (4, 1, 100, -0.1, BETWEEN),
        (30, 0, 100, 0.0, "straight on, right of way"),
        # A second junction, nearer than the end of the first; on it the gap is 0 and the turn is not ahead any more.
        (3, 0, 100, -1.5, "straight on, right of way"),
        (0, 1, 100, 0.0, "right turn, yielding"),
        (0, 1, 100, 0.0, "right turn, yielding"),
        (100, 0, 3, 3.0, "right turn, yielding"),
    ]:
        seen.add(fields, row(gap_m, priority, light_m, turn_rad), 10.0)
        assert seen.now == expected, (gap_m, priority)
    assert seen.passed == dict.fromkeys(
        ("left turn, green, yielding", "straight on, right of way", "right turn, yielding"), 1
    )
    without = Manoeuvres()
    without.add(Fields(("speed",), 1, 0.0, {"speed": (0.0, 30.0)}), torch.zeros(1), 10.0)
    assert without.now == BETWEEN and not without.passed
