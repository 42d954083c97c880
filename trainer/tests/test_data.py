"""A recorded run as data: arrays, episodes, vehicles, a data set, and exports, each compared with the messages."""

from __future__ import annotations

import csv
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pyarrow.dataset
import pyarrow.parquet
import pytest
import sumolib
import torch
from caraware import _native
from caraware.data import Recording, RecordingError, TickDataset, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.fcd import angle_deg
from caraware.data.names import RoadUsers
from recorded_run import TRAINED_TICKS, assert_has_card, recorded_run, unseen
from torch.utils.data import DataLoader

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebooks" / "figure.ipynb"


@pytest.fixture(scope="module")
def run_dir(trained_run: Path) -> Path:
    return trained_run


@pytest.fixture(scope="module")
def recording(run_dir: Path) -> Recording:
    return open_recording(run_dir)


def test_arrays_are_the_messages_and_lie_in_memory_maps(recording: Recording) -> None:
    assert recording.damage is None and recording.end is not None
    assert recording.end["missed_ticks"] == 0 and recording.start["is_lossless"]
    messages = list(recording.messages("observation"))
    assert [message.tick for message in messages] == list(range(TRAINED_TICKS))
    assert np.array_equal(recording.ticks(), np.arange(TRAINED_TICKS))
    truth = recording.rows("observation", "truth")
    assert isinstance(truth, np.memmap) and not truth.flags.writeable
    for place in (0, 187, 419):
        for name in ("truth", "imu", "gnss_geodetic", "vehicle"):
            expected = messages[place].section(name)
            assert np.array_equal(recording.at("observation", place, name), expected, equal_nan=True), name
    states = recording.at("world", 50, "states")
    assert len(states) >= 5 and {"x_m", "velocity_body_mps"} <= set(states.dtype.names or ())
    with pytest.raises(RecordingError, match="pointcloud"):
        recording.rows("pointcloud", "points")
    with pytest.raises(RecordingError, match="gnss_m"):
        recording.rows("observation", "gnss")


def test_episodes_and_vehicles_follow_the_truth_without_jumps(recording: Recording) -> None:
    episodes = list(recording.episodes())
    assert [len(episode) for episode in episodes] == [150, 150, 60, 60]
    assert [episode.is_evaluation for episode in episodes] == [False, False, True, True]
    assert len({episode.seed for episode in episodes}) == 4
    users = RoadUsers(recording)
    for episode in episodes:
        tracks = list(episode.vehicles())
        assert len(tracks) >= 5
        assert all(users.of(track.id_hash).id.startswith("cav.") for track in tracks)
        track = max(tracks, key=lambda track: len(track.ticks))
        truth, ticks = track.section("truth"), track.ticks
        moved_m = np.hypot(*np.diff(truth[:, :2], axis=0).T)
        # A vehicle moves as fast as its speed says.
        assert np.all(moved_m <= (truth[1:, 3] + 3.0) * recording.tick_s * np.diff(ticks) + 0.5)
        assert track.valid.dtype == np.bool_


def test_the_stages_of_a_curriculum_are_the_lines_of_the_run_s_log() -> None:
    stages = {
        "curriculum.stages": "[{cavs=2,until_lessons=2},{cavs=3}]",
        "episode.ticks": 20,
        "episode.training_episodes": 4,
        "episode.evaluation_interval": 0,
        "episode.evaluation_ticks": 10,
        "fanout.enabled": "false",
    }
    with recorded_run("simulate", stages) as run_dir:
        logged = [json.loads(line) for line in (run_dir / "curriculum.jsonl").read_text().splitlines()]
        assert [(line["stage"], line["lesson"], line["tick"]) for line in logged] == [(0, 0, 0), (1, 2, 40)]
        assert list(open_recording(run_dir).lines("curriculum")) == logged


def test_a_data_set_loads_in_batches(recording: Recording) -> None:
    rows = TickDataset([recording], ("observation", "truth", "gnss_m"))
    training = TickDataset([recording, recording], evaluation=False)
    flags = recording.rows("observation", "flags")
    assert len(rows) == int(((flags & _native.VALID) != 0).sum())
    assert 0 < len(training) < 2 * len(rows)
    batch = next(iter(DataLoader(rows, batch_size=64, shuffle=True, generator=torch.Generator().manual_seed(1))))
    assert batch["observation"].shape == (64, 9) and batch["truth"].shape == (64, 4)
    # Raw GNSS is some metres from the truth it belongs to.
    assert torch.linalg.vector_norm(batch["gnss_m"][:, :2] - batch["truth"][:, :2], dim=1).max() < 60
    first_of_second = training[len(training) // 2]
    assert torch.equal(first_of_second["truth"], training[0]["truth"])
    with pytest.raises(IndexError):
        rows[len(rows)]


def test_parquet_and_csv_have_the_values_of_the_messages(recording: Recording, run_dir: Path, tmp_path: Path) -> None:
    shown: list[tuple[int, int]] = []
    directory = tmp_path / "parquet"
    assert export(run_dir, "parquet", directory, 1, lambda done, total: shown.append((done, total))) == 4
    assert shown[0] == (0, 4) and shown[-1] == (4, 4)
    table = pyarrow.dataset.dataset(directory, format="parquet", exclude_invalid_files=True).to_table()
    vehicle = recording.rows("observation", "vehicle")
    assert table.num_rows == int((vehicle != _native.EMPTY_SLOT).sum())
    about = pyarrow.parquet.read_schema(directory / "episode-00000.parquet").metadata
    assert about[b"caraware.config_hash"].decode() == recording.start["config_hash"]
    # Each value is that of the message of its tick and slot.
    columns = table.to_pydict()
    by_tick = {message.tick: message for message in recording.messages("observation")}
    answers = {message.tick: message.section("prediction") for message in recording.messages("prediction")}
    for row in range(0, table.num_rows, 97):
        slot, message = columns["slot"][row], by_tick[columns["tick"][row]]
        truth, answer = message.section("truth")[slot], answers[message.tick][slot]
        assert columns["vehicle"][row] == message.section("vehicle")[slot]
        assert columns["truth_y_m"][row] == truth[1] and columns["truth_yaw_rad"][row] == truth[2]
        assert columns["gnss_latitude_deg"][row] == message.section("gnss_geodetic")[slot][0]
        assert columns["gyro_z_radps"][row] == message.section("imu")[slot, -1, 5]
        assert columns["time_s"][row] == pytest.approx(message.header["sim_time_ns"] * 1e-9)
        assert columns["predicted_x_m"][row] == answer[0]
        error_m = math.hypot(*(answer[:2].astype(float) - truth[:2]))
        assert columns["predicted_error_m"][row] == pytest.approx(error_m, rel=1e-4)
        assert columns["reward"][row] == pytest.approx(1 / (1 + error_m / 30), rel=1e-4)
    # What is there is kept: an export continues where it was interrupted.
    (directory / "episode-00001.parquet").unlink()
    kept = (directory / "episode-00000.parquet").stat().st_mtime_ns
    assert export(run_dir, "parquet", directory, 1, unseen) == 1
    assert (directory / "episode-00000.parquet").stat().st_mtime_ns == kept
    assert_has_card(directory, run_dir)

    assert export(run_dir, "csv", tmp_path / "csv", 1, unseen) == 4
    assert_has_card(tmp_path / "csv", run_dir)
    with (tmp_path / "csv" / "episode-00002.csv").open() as file:
        lines = list(csv.DictReader(file))
    last = [row for row in range(table.num_rows) if columns["episode"][row] == 2]
    assert len(lines) == len(last)
    for line, row in list(zip(lines, last, strict=True))[::53]:
        assert (int(line["tick"]), line["id"]) == (columns["tick"][row], columns["id"][row])
        assert np.float32(line["truth_x_m"]) == np.float32(columns["truth_x_m"][row])


def test_an_interrupted_export_of_two_jobs_continues_as_a_command(run_dir: Path, tmp_path: Path) -> None:
    # What a kill leaves: a part that is not whole, which is a directory in some formats.
    (tmp_path / ".episode-00001.parquet.partial").mkdir()
    module = [sys.executable, "-m", "caraware.data.export", str(run_dir), "--to", "parquet", "--jobs", "2"]
    ran = subprocess.run([*module, "--output", str(tmp_path)], capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    assert "4 episodes written as Parquet" in ran.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "README.md",
        *(f"episode-{number:05}.parquet" for number in range(4)),
    ]
    # Two processes write what one writes.
    assert export(run_dir, "parquet", tmp_path / "alone", 1, unseen) == 4
    for part in sorted(tmp_path.glob("*.parquet")):
        alone = pyarrow.parquet.read_table(tmp_path / "alone" / part.name)
        assert pyarrow.parquet.read_table(part).equals(alone, check_metadata=True)


def test_sumo_reads_the_floating_car_data_and_it_lies_on_sumos_own_positions(
    recording: Recording, run_dir: Path, tmp_path: Path
) -> None:
    export(run_dir, "fcd", tmp_path, 1, unseen)
    assert_has_card(tmp_path, run_dir)
    parts = sorted(tmp_path.glob("*.fcd.xml"))
    assert len(parts) == 4
    attributes = ["id", "x", "y", "angle"]
    steps = list(sumolib.xml.parse_fast_nested(str(parts[0]), "timestep", ["time"], "vehicle", attributes))
    assert len({step.time for step, _ in steps}) == 150 and len(steps) > 150 * 5
    users, compared = RoadUsers(recording), 0
    traffic = {message.tick: message.section("states") for message in recording.messages("traffic")}
    world = {message.tick: message.section("states") for message in recording.messages("world")}
    for tick in range(40, 110, 10):
        sumo = {int(state["vehicle"]): state for state in traffic[tick]}
        time = f"{float(recording.headers('world')['sim_time_ns'][tick]) * 1e-9:.2f}"
        at_tick = {vehicle.id: vehicle for step, vehicle in steps if step.time == time}
        for state in world[tick]:
            if state["kind"] == 2:
                continue
            exported, own = at_tick[users.of(state["id_hash"]).id], sumo[int(state["vehicle"])]
            # The mirror follows SUMO's front bumper half a step behind: never far beside it, nor turned.
            behind_m = 1.0 + float(own["speed_mps"]) * recording.tick_s
            distance_m = math.hypot(float(exported.x) - own["front_x_m"], float(exported.y) - own["front_y_m"])
            assert distance_m < behind_m, (tick, distance_m)
            turned = abs((float(exported.angle) - float(angle_deg(own["yaw_rad"])) + 180) % 360 - 180)
            compared += turned < 25
    assert compared > 40


def test_angles_are_sumos() -> None:
    # East, north, west, south, and a heading between that no symmetry hides.
    yaw_rad = np.array([0.0, math.pi / 2, math.pi, -math.pi / 2, 0.3])
    assert angle_deg(yaw_rad) == pytest.approx([90, 0, 270, 180, 90 - math.degrees(0.3)])


def test_a_damaged_recording_opens_up_to_the_damage(run_dir: Path, tmp_path: Path) -> None:
    whole = (run_dir / "recording.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    recording = open_recording(cut)
    assert recording.damage is not None and recording.damage[0] <= len(whole) // 2
    ticks = recording.ticks()
    assert 0 < len(ticks) < TRAINED_TICKS and np.array_equal(ticks, np.arange(len(ticks)))
    cut.write_bytes(whole[:20])
    with pytest.raises(RecordingError, match="byte"):
        open_recording(cut)


def test_the_notebook_makes_its_figure(run_dir: Path, recording: Recording, tmp_path: Path) -> None:
    """Its cells run as written, on this recording, and its errors are the trainer's own."""
    matplotlib.use("Agg")
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    for name, path in (("RECORDING", run_dir), ("FIGURE", tmp_path / "errors.pdf")):
        code, found = re.subn(rf'(?m)^{name} = "[^"]*"', f'{name} = "{path}"', code)
        assert found == 1
    values: dict[str, Any] = {}
    exec(compile(code, str(NOTEBOOK), "exec"), values)
    assert (tmp_path / "errors.pdf").read_bytes().startswith(b"%PDF")
    rows, errors_m = values["rows"], values["errors_m"]
    assert len(rows) > 100 and set(rows["episode"]) == {2, 3}
    assert np.allclose(errors_m["policy"], rows["predicted_error_m"], rtol=1e-4)
    assert 3 < errors_m["GNSS"].mean() < 12 and values["summary"].notna().all(axis=None)
