"""The rule that corrects a driver: junctions by hand, and a pupil that is taught it."""

import copy
from collections.abc import Iterator

import pytest
import torch
from caraware.driving.dagger import BATCH, VARIED_BY, CorrectedPolicy, MixedDrivers, Pupil, SeenRows, varied
from caraware.driving.right_of_way import RightOfWay, arrives_s
from caraware.learn.encoders import FIELDS, GroupedNetwork
from caraware.tasks.fields import Fields, UnknownFieldError
from test_foresight import ENCOUNTER, RANGES
from torch import Tensor

MAX_DECEL = 9.0
USER = {**RANGES, **ENCOUNTER, "turn": (-1.0, 1.0)}
NO_USER = {"x": 50.0, "y": 50.0, "way": 50.0, "reaches": 10.0, "enters": 10.0, "leaves": 10.0}
JUNCTION = {"gap": (0.0, 100.0), "priority": (0.0, 1.0), "rival": (0.0, 10.0)}
OWN = ("speed", *(f"own_{number}" for number in range(15)))


def fields() -> Fields:
    """As many as the preset "driver" has; those that the rule reads have its names."""
    ranges = {name: (0.0, 30.0) if name == "speed" else (-1.0, 1.0) for name in OWN}
    ranges |= {f"user_{n}_{name}": span for n in range(1, 9) for name, span in USER.items()}
    ranges |= {f"junction_{n}_{name}": span for n in range(1, 4) for name, span in JUNCTION.items()}
    ranges |= {f"rest_{number}": (-1.0, 1.0) for number in range(FIELDS - len(ranges))}
    return Fields(tuple(ranges), 1, -1.0, ranges)


def row(speed: float, gap: float, priority: float, *users: dict[str, float]) -> Tensor:
    """What a hero sees `gap` metres before the line of its next junction."""
    known, values = fields(), {"speed": speed, "junction_1_gap": gap, "junction_1_priority": priority}
    for number in range(1, 9):
        user = users[number - 1] if number <= len(users) else {}
        values |= {f"user_{number}_{name}": value for name, value in {**NO_USER, **user}.items()}
    unit = []
    for name in known.names:
        low, high = known.range(name)
        unit.append(2 * (values.get(name, (low + high) / 2) - low) / (high - low) - 1)
    return torch.tensor([unit])


def crossing(way: float, enters: float, leaves: float, speed: float = 8.0, **more: float) -> dict[str, float]:
    """A vehicle from the left that comes across the hero's way."""
    seen = {"x": 20.0, "y": 20.0, "cos": 0.0, "forward": 0.0, "left": -speed}
    return seen | {"way": way, "enters": enters, "leaves": leaves} | more


def most(seen: Tensor, wants: float = 0.5) -> float:
    """The acceleration that is left of the one that the policy wants."""
    corrected = RightOfWay(fields(), MAX_DECEL).corrected(seen, torch.tensor([[0.3, wants]]))
    assert corrected[0, 0] == pytest.approx(0.3), "steering is the policy's"
    return float(corrected[0, 1])


@pytest.mark.parametrize(
    ("what", "seen", "expected"),
    [
        ("no vehicle is there", row(8, 12, 0), 0.5),
        ("it stops at the line: 64 / 2 / 11.3 m, and a tenth", row(8, 12, 0, crossing(16, 2, 3)), -2.83 * 1.1 / 9),
        ("it has right of way, and the other can stop", row(8, 12, 1, crossing(16, 2, 3)), 0.5),
        ("the other has passed before", row(8, 12, 0, crossing(16, 0.5, 1.0)), 0.5),
        ("the other comes long after", row(8, 12, 0, crossing(16, 9, 9.8)), 0.5),
        ("it is far from the line: it coasts", row(8, 30, 0, crossing(34, 4, 5)), 0.0),
        ("what stands gives way", row(8, 12, 0, crossing(16, 2, 3, speed=0.1)), 0.5),
        ("a follower does not cross", row(8, 12, 0, crossing(16, 2, 3, x=-10.0, cos=1.0)), 0.5),
        ("an encounter before the line is not the junction's", row(8, 12, 0, crossing(4, 2, 3)), 0.5),
        ("in the junction it stops before the place: 16 / 2 / 4.5 m", row(4, 0, 0, crossing(6, 2, 3)), -1.78 * 1.1 / 9),
        ("at the place it drives on", row(2, 0, 0, crossing(1.5, 2, 3)), 0.5),
        ("with right of way it brakes for what cannot stop", row(8, 0, 1, crossing(8, 0.6, 1.4)), -4.57 * 1.1 / 9),
        ("too late to brake", row(12, 0, 1, crossing(4, 0.3, 1.0)), 0.5),
        ("at the line it holds", row(0.5, 1.0, 0, crossing(4, 2, 3)), -0.4),
    ],
)
def test_a_hero_that_has_to_give_way_brakes(what: str, seen: Tensor, expected: float) -> None:
    assert most(seen) == pytest.approx(expected, abs=0.01), what


def test_a_policy_that_brakes_harder_is_left_alone() -> None:
    assert most(row(8, 12, 0, crossing(16, 2, 3)), wants=-0.9) == pytest.approx(-0.9)


def test_arrival_times_are_those_of_a_car_moved_step_by_step() -> None:
    for way, speed, accel in [(20.0, 0.0, 2.0), (3.0, 1.0, 1.5), (60.0, 4.0, 2.0), (30.0, 12.0, 2.0), (0.0, 5.0, 2.0)]:
        place, now, time, step = 0.0, speed, 0.0, 1e-4
        while place < way:
            place, now, time = place + now * step, max(now, min(now + accel * step, 9.0)), time + step
        got = arrives_s(torch.tensor([way]), torch.tensor([speed]), accel)
        assert float(got) == pytest.approx(time, abs=2e-3)


def test_other_observations_are_refused_by_name() -> None:
    known = fields()
    less = Fields(known.names[:60], 1, -1.0, {name: known.range(name) for name in known.names[:60]})
    with pytest.raises(UnknownFieldError, match=r'user_5_x.*observation.fields = "driver"'):
        RightOfWay(less, MAX_DECEL).corrected(row(8, 12, 0)[:, :60], torch.zeros(1, 2))


def test_columns_are_the_fields_one_by_one() -> None:
    known, seen = fields(), row(8, 12, 0, crossing(16, 2, 3))
    one_by_one = torch.stack([known.si_tensor(seen, name) for name in known.names], 1)
    assert torch.equal(known.si_columns(seen, known.names), one_by_one)


def test_a_full_store_keeps_a_fair_sample() -> None:
    rows = SeenRows(200, torch.Generator().manual_seed(3))
    for first in range(0, 2000, 40):
        rows.add(torch.arange(first, first + 40).unsqueeze(1).float().repeat(1, 2))
    kept = rows.drawn(20_000)[:, 0]
    assert len(rows) == 200 and rows.offered == 2000
    # 200 of 2000 numbers: their mean is within 3.5 of its standard deviations, 577 / √200, of 1000.
    assert abs(float(kept.mean()) - 1000) < 3.5 * 41
    assert all(((kept >= first) & (kept < first + 400)).any() for first in range(0, 2000, 400))


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Threads of small steps wait for each other where other work has the cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("one_thread")
def test_a_pupil_learns_to_give_way_and_keeps_what_it_could() -> None:
    torch.manual_seed(5)
    network = GroupedNetwork(FIELDS, 2, (32, 32))
    teacher = CorrectedPolicy(copy.deepcopy(network), RightOfWay(fields(), MAX_DECEL))
    generator = torch.Generator().manual_seed(6)
    rows, pupil = SeenRows(5000, generator), Pupil(network, teacher, generator)
    scenes = [row(8, gap, 0, crossing(gap + 4, 2, 3)) for gap in range(8, 24, 2)] + [row(8, 12, 1), row(8, 40, 0)]
    rows.add(torch.cat(scenes * 50))
    before = pupil.errors(rows)
    for _ in range(120):
        pupil.learn(rows, 2e-3)
    after = pupil.errors(rows)
    assert after["corrected_error"][1] < 0.35 * before["corrected_error"][1]
    assert before["other_error"] == [0.0, 0.0]
    assert after["other_error"][0] < 0.02 and after["other_error"][1] < 0.3 * before["corrected_error"][1]
    assert float(varied(rows, BATCH, VARIED_BY, generator).abs().max()) <= 1.0


def test_the_teacher_drives_some_and_noise_all() -> None:
    drivers, by_teacher, noise = MixedDrivers(4), 0, []
    for _ in range(400):
        actions = drivers.actions(torch.zeros(20, 2), torch.full((20, 2), 0.5))
        is_teacher = actions[:, 0] > 0.25
        by_teacher += int(is_teacher.sum())
        noise.append(actions[~is_teacher, 0])
    assert 0.1 < by_teacher / 8000 < 0.35
    assert 0.02 < float(torch.cat(noise).std()) < 0.04
