"""The layout of each mode has the views that have data, and no others."""

from __future__ import annotations

import pytest

from caraware_viewer import course, plots, space
from caraware_viewer.views import MAX_PLOTS, PLOTS, blueprint, layout_of, mode_of, shown_plots

ALL = [
    *(
        f"{course.ROOT}/{name}"
        for name in ("m/error_m", "ends/arrival", "mps/progress_mps", "reward/reward", "sigma/sigma")
    ),
    plots.SPEED,
    plots.GNSS_ERROR,
    plots.VEHICLES,
    plots.STEPS,
    plots.REAL_TIME,
]


def titles(mode: str, figures: list[str]) -> list[str]:
    return [plot.title for plot in shown_plots(mode, figures)]


@pytest.mark.parametrize("mode", ["train", "drive", "simulate", "play"])
def test_a_mode_has_its_own_plots_and_none_without_data(mode: str) -> None:
    assert titles(mode, []) == []
    shown = titles(mode, ALL)
    assert 2 < len(shown) <= MAX_PLOTS
    assert set(shown) <= {plot.title for plot in PLOTS if mode in plot.modes}
    assert len(titles(mode, [plots.GNSS_ERROR])) == 1


def test_a_simulation_has_no_learning_curve() -> None:
    assert not [title for title in titles("simulate", ALL) if "whole run" in title]
    assert titles("train", ALL)[0] == "Error over the whole run (m)"
    assert titles("drive", ALL)[0] == "How trips ended over the whole run (%)"


def test_heroes_make_a_training_run_one_of_driving() -> None:
    assert mode_of("train", driving=True) == "drive"
    assert mode_of("train", driving=False) == "train"
    assert mode_of("play", driving=True) == "play"


def test_a_layout_changes_when_a_view_gets_its_first_data() -> None:
    assert layout_of("train", [plots.GNSS_ERROR]) == layout_of("train", [plots.GNSS_ERROR, plots.EKF_ERROR])
    assert layout_of("train", [plots.GNSS_ERROR]) != layout_of("train", [plots.GNSS_ERROR, course.REWARD])
    assert layout_of("train", []) != layout_of("train", [space.VEHICLES])
    blueprint([0, 0, 100, 100], "play", ALL, (10.0, 10.0, 20.0, 20.0))
