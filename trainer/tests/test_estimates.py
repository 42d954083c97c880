"""The filter beside the policy: when it runs, and what it sends."""

from pathlib import Path

import numpy as np
import pytest
from caraware.run.config import RunConfig
from caraware.run.estimates import Estimates
from synthetic import run_file
from synthetic_vehicle import in_slots, observations, sensor_tables, steady_track
from test_ekf import noise_of


@pytest.mark.parametrize(
    ("estimates", "real_time_factor", "shown"),
    [("paced", 0.0, False), ("paced", 1.0, True), ("always", 0.0, True), ("never", 1.0, False)],
)
def test_it_runs_where_it_may(tmp_path: Path, estimates: str, real_time_factor: float, shown: bool) -> None:
    run = run_file(str(tmp_path))
    run["config"] |= {name: table for name, table in sensor_tables().items() if name != "run"}
    run["config"].setdefault("run", {}).update(tick_s=0.1, real_time_factor=real_time_factor)
    run["config"]["trainer"]["estimates"] = estimates
    assert RunConfig.from_run(run).shows_estimates() == shown


def test_positions_near_the_truth_in_the_rows_of_the_vehicles() -> None:
    estimates = Estimates(noise_of(sensor_tables()))
    for tick in observations(steady_track(100, 3, seed=1)):
        obs = in_slots(tick, [0, 2, 3], 5)
        position_m = estimates.position_m(obs)
    assert position_m.dtype == np.float32
    assert position_m.shape == (5, 2)
    assert np.isnan(position_m[[1, 4]]).all()
    error_m = np.hypot(*(position_m - obs.truth.numpy()[:, :2])[[0, 2, 3]].T)
    # The raw fix is 7 m off in the mean.
    assert error_m.max() < 4.0
