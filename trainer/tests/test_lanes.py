"""SUMO's time, lanes, edges and places on routes beside the truth, compared with SUMO's own record of the same run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import sumolib
from caraware.data import Recording, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.fcd import front_m
from caraware.data.names import RoadUsers
from caraware.ipc.lane_positions import NO_INDEX, LaneIds
from test_system import run_with

ROOT = Path(__file__).parents[2]
CARAWARE = ROOT / "target" / "release" / "caraware"
ROUTES = {"car": "A0A1 A1B1 B1B2 B2C2", "van": "C0B0 B0B1 B1A1 A1A2", "bus": "B0B1 B1B2"}
SCENARIO = """<configuration><net-file value="a.net.xml"/><route-files value="a.rou.xml"/>
<fcd-output value="fcd.xml"/><fcd-output.attributes value="lane,pos,odometer,vehicle,edge"/><precision value="6"/>
<begin value="100"/><end value="170"/><step-length value="STEP"/></configuration>"""
DEMAND = f"""<routes>
<flow id="car" begin="100" end="160" number="12" departLane="random"><route edges="{ROUTES["car"]}"/></flow>
<flow id="van" begin="100" end="160" number="8" departLane="random"><route edges="{ROUTES["van"]}"/></flow>
<vehicle id="bus" depart="triggered" departPos="20"><route edges="{ROUTES["bus"]}"/></vehicle>
<person id="rider" depart="100"><walk edges="B0B1" arrivalPos="20"/><ride from="B0B1" to="B1B2" lines="bus"/></person>
</routes>"""


def simulate(directory: Path, step_s: float, name: str, *more: str) -> Path:
    """A recorded run of the scenario; returns its directory."""
    if not (directory / "a.net.xml").exists():
        program = Path(sumolib.checkBinary("netgenerate"))
        grid = ("--grid", "--grid.number", "3", "--grid.length", "150", "-L", "2", "--sidewalks.guess")
        subprocess.run([program, *grid, "-o", "a.net.xml"], cwd=directory, check=True, capture_output=True)
    (directory / "a.rou.xml").write_text(DEMAND)
    (directory / "a.sumocfg").write_text(SCENARIO.replace("STEP", str(step_s)))
    settings = ("map.origin_latitude_deg=52", "map.origin_longitude_deg=10", "fanout.enabled=false", *more)
    words = [word for setting in settings for word in ("--set", setting)]
    command: list[str | Path] = [CARAWARE, "simulate", "a.sumocfg", "--name", name, "--record", "--quiet", *words]
    environment = os.environ | {"CARAWARE_RUNTIME_DIR": f"{directory}/r", "CARAWARE_PYTHON": sys.executable}
    ran = subprocess.run(command, cwd=directory, env=environment, capture_output=True, text=True, timeout=600)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return directory / "runs" / name


@pytest.fixture(scope="module", params=[0.1, 1.0])
def run(request: pytest.FixtureRequest) -> Iterator[tuple[float, Path]]:
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        yield request.param, simulate(Path(short), request.param, "lanes", "traffic.lane_positions=true")


def sumo_record(run_dir: Path) -> dict[int, dict[str, dict[str, str]]]:
    """SUMO's floating car data: its time (ms), id, attributes of vehicles and persons."""
    record: dict[int, dict[str, dict[str, str]]] = {}
    for step in sumolib.xml.parse(str(run_dir / "sumo" / "fcd.xml"), "timestep"):
        users = [*(step.vehicle or []), *(step.person or [])]
        rows = {user.id: {name: user.getAttribute(name) for name, _ in user.getAttributes()} for user in users}
        record[round(float(step.time) * 1000)] = rows
    return record


def test_at_sumos_steps_they_are_what_sumo_records(run: tuple[float, Path]) -> None:
    step_s, run_dir = run
    recording, ids, record = open_recording(run_dir), LaneIds.read(run_dir), sumo_record(run_dir)
    users, compared, rides, persons = RoadUsers(recording), 0, 0, 0
    for message in recording.messages("lane-position"):
        time_s, rows = float(message.section("sumo_time_s")[0]), message.section("positions")
        # SUMO names a state in its outputs by the time at which its step began.
        theirs = record.get(round((time_s - step_s) * 1000))
        if theirs is None or not len(rows):
            continue
        ours = {users.of(row["id_hash"]).id: row for row in rows}
        vehicles = {str(name): int(row["vehicle"]) for name, row in ours.items()}
        assert set(ours) == set(theirs), time_s
        for name, row in ours.items():
            their = theirs[name]
            if name == "rider":
                persons += 1
                carrier = their.get("vehicle", "")
                assert (row["carrier"] == vehicles.get(carrier, NO_INDEX)) and np.isnan(row["odometer_m"])
                rides += bool(carrier)
                if not carrier:
                    assert ids.edge(row["edge"]) == their["edge"]
                    assert abs(row["lane_position_m"] - float(their["pos"])) < 1e-5
                continue
            assert ids.lane(row["lane"]) == their["lane"]
            assert ids.edge_of_lane[row["lane"]] == row["edge"]
            assert abs(row["lane_position_m"] - float(their["pos"])) < 1e-5
            assert abs(row["odometer_m"] - float(their["odometer"])) < 1e-5
            edge, route = ids.edge(row["edge"]) or "", ROUTES[name.split(".")[0]].split()
            if not edge.startswith(":"):
                assert route[row["route_edge"]] == edge
            compared += 1
    assert compared > 20 / step_s * 5 and persons > 20 and rides > 5


def lane_point(net: Any, ids: LaneIds, row: np.void) -> Any:
    """The point of the lane's centre line where SUMO has the front bumper (m)."""
    lane = net.getLane(ids.lane(row["lane"]))
    shape = lane.getShape()
    scaled = row["lane_position_m"] * sumolib.geomhelper.polyLength(shape) / lane.getLength()
    return sumolib.geomhelper.positionAtShapeOffset(shape, min(scaled, sumolib.geomhelper.polyLength(shape)))


def distances_m(recording: Recording, run_dir: Path, late: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Distances of mirrored front bumpers from the places where SUMO has them in the message `late` ticks later.

    On the first road of their route: behind a corner that SUMO takes faster than a vehicle can, mirrors lag.
    """
    net = sumolib.net.readNet(str(run_dir.parents[1] / "a.net.xml"), withInternal=True)
    ids, away = LaneIds.read(run_dir), []
    ticks = {int(tick): place for place, tick in enumerate(recording.ticks("lane-position"))}
    for index, tick in enumerate(recording.ticks("world").tolist()):
        if tick + late not in ticks:
            continue
        rows = recording.at("lane-position", ticks[tick + late], "positions")
        by_vehicle = {int(row["vehicle"]): row for row in rows if row["lane"] != NO_INDEX}
        states = np.asarray(recording.at("world", index, "states"))
        for state, x_m, y_m in zip(states, *front_m(states), strict=True):
            row = by_vehicle.get(int(state["vehicle"]))
            is_moving = state["velocity_body_mps"][0] > 5.0
            if row is not None and is_moving and ids.edge(row["edge"]) in ("A0A1", "C0B0"):
                point = lane_point(net, ids, row)
                away.append(np.hypot(x_m - point[0], y_m - point[1]))
    return np.array(away)


def test_they_belong_to_the_mirrored_vehicles_of_their_tick(run: tuple[float, Path]) -> None:
    _, run_dir = run
    recording = open_recording(run_dir)
    away_m = distances_m(recording, run_dir, 0)
    later_m = distances_m(recording, run_dir, 15)
    assert len(away_m) > 500
    assert np.percentile(away_m, 95) < 0.6 and away_m.max() < 4.0
    # The mirrors are 1.5 s behind SUMO: without the delay of the positions they would be elsewhere.
    assert np.median(later_m) > 10.0


def test_a_table_has_them_beside_the_truth(run: tuple[float, Path], tmp_path: Path) -> None:
    _, run_dir = run
    recording = open_recording(run_dir)
    assert export(run_dir, "parquet", tmp_path / "out", 1, lambda done, total: None) == 1
    table = pyarrow.parquet.read_table(next((tmp_path / "out").glob("*.parquet"))).to_pydict()
    known = [place for place, lane in enumerate(table["sumo_lane"]) if lane is not None]
    assert len(known) > 0.9 * len(table["tick"])
    ids = LaneIds.read(run_dir)
    by_tick = {int(tick): place for place, tick in enumerate(recording.ticks("lane-position"))}
    for place in known[:: max(1, len(known) // 300)]:
        rows = recording.at("lane-position", by_tick[table["tick"][place]], "positions")
        row = rows[rows["vehicle"] == table["vehicle"][place]][0]
        assert table["sumo_lane"][place] == ids.lane(row["lane"])
        assert table["sumo_edge"][place] == ids.edge(row["edge"])
        assert table["sumo_lane_index"][place] == row["lane"]
        assert table["sumo_lane_position_m"][place] == row["lane_position_m"]
        assert table["sumo_route_edge"][place] == row["route_edge"]
        assert 100.0 <= table["sumo_time_s"][place] <= 170.0


def test_a_run_without_them_has_the_same_observations_and_no_columns(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        hashes = []
        for name, setting in (("with", "true"), ("without", "false")):
            run_dir = simulate(Path(short), 0.1, name, f"traffic.lane_positions={setting}", "traffic.end_s=120")
            hashes.append(json.loads((run_dir / "report.json").read_text())["observation_hash"])
        assert hashes[0] == hashes[1]
        assert not (run_dir / "lanes.json").exists()
        recording = open_recording(run_dir)
        assert len(recording.headers("lane-position")) == 0


def test_a_trainer_reads_them_beside_its_observations(tmp_path: Path) -> None:
    finished = run_with(tmp_path, "lanes_probe", {"traffic.lane_positions": "true"})
    assert finished.returncode == 0, finished.stdout + finished.stderr
    run = tmp_path / "runs" / "probe"
    found = json.loads((run / "parts" / "trainer.json").read_text())
    # Only ticks that SUMO had made before the trainer subscribed are missing.
    assert found["ticks"] == 3 * 100 + 20 and found["without"] < 50
    assert found["rows"] > 1000 and found["unknown"] == found["off_lane"] == 0
    assert found["latest_s"] < 1e-6
    assert found["edges"] > 10
