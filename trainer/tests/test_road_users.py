"""States and boxes of all road users on a trainer's channel, beside its observations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from caraware.ipc.road_users import VEHICLE_STATE, RoadUserStates
from test_system import run_with


def _found(tmp_path: Path, setting: str) -> dict[str, Any]:
    finished = run_with(tmp_path, "road_users_probe", {"trainer.road_users": setting})
    assert finished.returncode == 0, finished.stdout + finished.stderr
    found: dict[str, Any] = json.loads((tmp_path / "runs" / "probe" / "parts" / "trainer.json").read_text())
    return found


def test_every_observation_has_the_states_of_all_road_users_of_its_tick(tmp_path: Path) -> None:
    found = _found(tmp_path, "true")
    # What was made before there was a trainer is missing, and nothing after that.
    assert found["ticks"] == 3 * 100 + 20 and found["first"] <= 16 and found["gaps"] == 0
    assert found["rows"] > 1000 and found["unknown"] == 0
    # Single precision over the town is 0.02 mm.
    assert found["largest_error_m"] < 1e-3
    # Vehicles without sensors and pedestrians are there too, each with a box.
    assert found["others"] >= 1 and found["smallest_box_m"] > 0.1


def test_a_run_that_was_not_made_for_it_says_which_key_to_set(tmp_path: Path) -> None:
    assert "trainer.road_users" in _found(tmp_path, "false")["refused"]


def test_a_box_is_around_the_middle_of_its_road_user() -> None:
    # A lorry that heads north-west: its middle is ahead of the rear axle, on the way there.
    states = np.zeros(1, VEHICLE_STATE)
    for name, value in (("x_m", 10.0), ("y_m", -4.0), ("z_m", 1.0), ("yaw_rad", 2.5), ("length_m", 12.0)):
        states[name] = value
    states["width_m"], states["height_m"], states["rear_overhang_m"] = 2.5, 3.0, 2.0
    box = RoadUserStates(0, 0, states).boxes_m[0]
    middle = [10 + 4 * np.cos(2.5), -4 + 4 * np.sin(2.5), 2.5]
    assert box == pytest.approx([*middle, 12.0, 2.5, 3.0, 2.5])
