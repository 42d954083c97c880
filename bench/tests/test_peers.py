"""The measuring loops of `caraware bench peers`, with stand-ins for the peers."""

import json
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from caraware_bench import agent_steps, peer
from caraware_bench.agent_steps import WARM_UP_STEPS
from caraware_bench.cost import LoopCost, cpu_s
from caraware_bench.traffic_loop import SIGNAL_PERIOD_STEPS, Mirror, measure

VEHICLES = 6


class FakeSumo(ModuleType):
    """Six vehicles depart in the first step; the first of them arrives in the third."""

    def __init__(self) -> None:
        super().__init__("fake")
        self.steps = 0
        self.calls: Counter[str] = Counter()
        self.simulation = SimpleNamespace(
            getDepartedIDList=lambda: tuple(f"v{i}" for i in range(VEHICLES)) if self.steps == 1 else (),
            getArrivedIDList=lambda: ("v0",) if self.steps == 3 else (),
        )
        answers = {"getPosition3D": (1.0, 2.0, 3.0), "getAngle": 90.0, "getSpeed": 5.0, "getSignals": 8}
        self.vehicle = SimpleNamespace(**{name: self._getter(name, value) for name, value in answers.items()})

    def _getter(self, name: str, value: object) -> object:
        def get(vehicle: str) -> object:
            self.calls[name] += 1
            return value

        return get

    def start(self, arguments: list[str]) -> None:
        self.calls["start"] += 1

    def simulationStep(self) -> None:
        self.steps += 1

    def close(self) -> None:
        self.calls["close"] += 1


def test_the_loop_reads_the_bridges_fields_of_every_vehicle_at_every_step() -> None:
    sumo = FakeSumo()
    mirror = Mirror(sumo)
    assert [mirror.step() for _ in range(2)] == [VEHICLES, VEHICLES]
    assert mirror.states["v0"] == (1.0, 2.0, 3.0, 90.0, 5.0)
    assert mirror.step() == VEHICLES - 1
    assert "v0" not in mirror.states and "v0" not in mirror.signals
    reads = 3 * VEHICLES - 1
    assert [sumo.calls[name] for name in ("getPosition3D", "getAngle", "getSpeed")] == [reads] * 3


def test_signals_are_read_in_turn() -> None:
    sumo = FakeSumo()
    mirror = Mirror(sumo)
    mirror.step()
    counts = [sumo.calls["getSignals"]]
    for _ in range(SIGNAL_PERIOD_STEPS):
        mirror.step()
        counts.append(sumo.calls["getSignals"])
    assert all(1 <= later - before <= 2 for before, later in pairwise(counts)), counts
    assert mirror.signals.keys() == mirror.states.keys()


def test_a_loop_that_fails_ends_sumo() -> None:
    sound, broken = FakeSumo(), FakeSumo()
    assert measure(sound, ["sumo"], steps=2).steps == 2 * VEHICLES
    broken.vehicle.getAngle = None
    with pytest.raises(TypeError):
        measure(broken, ["sumo"], steps=2)
    assert [sumo.calls[name] for sumo in (sound, broken) for name in ("start", "close")] == [1] * 4


def test_agent_steps_are_counted_while_stepping_only(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr("caraware_bench.agent_steps.time.perf_counter", lambda: now_s)

    class World:
        """Seven agents, half a second a step; a reset takes ten."""

        steps = 0
        closed = False

        def ready(self) -> None:
            nonlocal now_s
            now_s += 10.0

        def step(self) -> int:
            nonlocal now_s
            now_s += 0.5
            self.steps += 1
            return 7

        def close(self) -> None:
            self.closed = True

    world = World()
    cost = agent_steps.measure(world, 3.0)
    assert (cost.steps, cost.rate) == (6 * 7, 14.0)
    assert world.closed and world.steps == WARM_UP_STEPS + 6


def test_a_peer_that_is_not_installed_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(options: object) -> tuple[str, dict[str, LoopCost]]:
        raise ImportError("No module named 'smarts'")

    monkeypatch.setitem(peer.PEERS, "smarts", absent)
    peer.main(["smarts", "--json", str(tmp_path / "out.json")])
    assert json.loads((tmp_path / "out.json").read_text()) == {"missing": "No module named 'smarts'"}
    monkeypatch.setitem(peer.PEERS, "smarts", lambda options: ("2", {"a": LoopCost(6, 4.0, 3.0)}))
    peer.main(["smarts", "--json", str(tmp_path / "out.json")])
    assert json.loads((tmp_path / "out.json").read_text()) == {
        "version": "2",
        "rates": {"a": 1.5},
        "cpu_us": {"a": 5e5},
    }


def test_processor_time_counts_the_processes_that_were_started() -> None:
    before_s = cpu_s()
    work = "print(sum(range(20_000_000)), flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", work], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        used_s = cpu_s() - before_s
        child.communicate(b"\n")
    assert used_s > 0.1
