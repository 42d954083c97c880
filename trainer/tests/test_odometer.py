"""Wheel speed and steering-wheel angle of a recorded run against the recorded truth: slip, and each set's ratio."""

from __future__ import annotations

from typing import Any

import numpy as np
from caraware.data import open_recording
from recorded_run import recorded_run

EXACT: dict[str, Any] = {
    "traffic.cavs": 12,
    "traffic.others": 3,
    "traffic.pedestrians": 0,
    "episode.ticks": 300,
    "episode.training_episodes": 1,
    "fanout.enabled": "false",
    "vehicle.steering_ratio": 0,
    "speed_steering.wheel_slip": "true",
    "speed_steering.speed_noise_std_mps": 0.0,
    "speed_steering.steering_noise_std_rad": 0.0,
    "record.channels": '["world", "observation", "traffic-meta"]',
}
RATIOS = {15.0, 15.5, 16.0}
"""Those of the sets `sedan`, `small_car` and `van`: `sim-core/data/vehicles.toml`."""


def test_the_odometer_turns_with_the_wheels_and_the_wheel_with_its_ratio() -> None:
    with recorded_run("simulate", EXACT) as run_dir:
        recording = open_recording(run_dir)
        worlds = {message.tick: message.section("states") for message in recording.messages("world")}
        rows = []
        for message in recording.messages("observation"):
            moved = {int(state["vehicle"]): state for state in worlds[message.tick]}
            for number, sample in zip(
                message.section("vehicle").tolist(), message.section("speed_steering"), strict=True
            ):
                if number in moved:
                    rows.append((moved[number], sample))
    states, samples = np.array([row[0] for row in rows]), np.array([row[1] for row in rows], dtype=np.float64)
    speed, slip = states["velocity_body_mps"][:, 0].astype(np.float64), states["rear_wheel_slip"].astype(np.float64)
    np.testing.assert_allclose(samples[:, 0], speed * (1.0 + slip), rtol=1e-6, atol=1e-6)
    angle = states["road_wheel_angle_rad"].astype(np.float64)
    np.testing.assert_allclose(samples[:, 1], angle * states["steering_ratio"], rtol=1e-5, atol=1e-6)
    assert set(states["steering_ratio"].tolist()) == RATIOS
    accel = states["accel_body_mps2"][:, 0]
    assert (slip[accel > 1.0] > 0.0).mean() > 0.5, "rear-wheel and four-wheel drive"
    assert (slip[accel < -1.0] < 0.0).all() and slip.min() > -0.14 and slip.max() < 0.14
    assert np.abs(angle).max() > 0.05 and (accel < -1.0).sum() > 50
