"""The committed reference trajectories equal those that their script computes with the package."""

import json
import runpy
from pathlib import Path

import numpy as np

DATA = Path(__file__).parent / "data"
SCRIPT = runpy.run_path(str(DATA / "commonroad_st.py"))


def test_trajectories() -> None:
    header, *lines = (DATA / "commonroad_st.csv").read_text(encoding="utf-8").splitlines()
    assert header.split(",") == SCRIPT["COLUMNS"]
    committed = np.array([line.split(",") for line in lines], dtype=float)
    # Ten digits are committed; the integrator's own error is below 1e-9.
    np.testing.assert_allclose(committed, SCRIPT["rows"](), rtol=1e-8, atol=1e-8)


def test_parameters() -> None:
    committed = json.loads((DATA / "commonroad_st.json").read_text(encoding="utf-8"))
    assert committed == SCRIPT["parameters"]()


def test_lateral_acceleration_is_the_stated_one() -> None:
    rows = SCRIPT["rows"]()
    for speed_mps, peak_mps2 in {5.0: 1.5, 15.0: 2.0, 30.0: 2.0}.items():
        mine = rows[rows[:, 0] == speed_mps]
        course_rate = mine[:, 8] + np.gradient(mine[:, 9], mine[:, 2])
        assert np.isclose(abs(speed_mps * course_rate).max(), peak_mps2, atol=0.02)
