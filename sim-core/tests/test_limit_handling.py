"""The committed reference manoeuvres at the limit equal those that their script computes with the package."""

import csv
import json
import runpy
from pathlib import Path

import numpy as np
import pytest

DATA = Path(__file__).parent / "data"
SCRIPT = runpy.run_path(str(DATA / "limit_handling.py"))


@pytest.mark.parametrize("model", ["std", "mb"])
def test_manoeuvres(model: str) -> None:
    with open(DATA / "limit_handling.csv", encoding="utf-8", newline="") as file:
        header, *lines = csv.reader(file)
    assert header == SCRIPT["COLUMNS"]
    committed = [line for line in lines if line[1] == model]
    computed = SCRIPT["rows"](model)
    assert [line[:2] for line in committed] == [line[:2] for line in computed]
    wanted, found = (np.array([line[2:] for line in rows], dtype=float) for rows in (committed, computed))
    # Seven digits are committed. A vehicle that spins multiplies the rounding of another machine's library.
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5)


def test_parameters() -> None:
    committed = json.loads((DATA / "limit_handling.json").read_text(encoding="utf-8"))
    assert committed == json.loads(json.dumps(SCRIPT["parameters"]()))


def test_the_track_is_that_of_iso_3888_2() -> None:
    assert sum(SCRIPT["SECTIONS_M"]) == 61.0
    offset_m = SCRIPT["lane_change_offset_m"](1.8)
    # Widths 2.23 m and 2.8 m, 1 m apart.
    assert offset_m == pytest.approx(0.5 * 2.23 + 1.0 + 0.5 * 2.8)
    line = [SCRIPT["lane_change_line_m"](12.0 + x, offset_m) for x in (6.0, 12.0, 25.5, 36.5, 49.0, 60.0)]
    assert line == pytest.approx([0.0, 0.0, offset_m, offset_m, 0.0, 0.0])
