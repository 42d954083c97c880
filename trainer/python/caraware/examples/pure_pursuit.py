"""A scripted driver for the driving task: pure pursuit for the steering, a PI controller for the speed."""

import json
import math
import signal
import sys
from pathlib import Path

import numpy as np

from caraware.channel import Channel

WHEELBASE_M, COMFORTABLE_MPS2, LATERAL_MPS2, STAND_OFF_M = 2.7, 2.0, 2.0, 4.0
KP, KI = 1.0, 0.1


def metres(row: np.ndarray, config: dict) -> dict[str, float]:
    """A normalised row of the observation (-1 ... 1) by field, in SI units."""
    speed, steering = config["observation"]["speed_range_mps"], config["observation"]["steering_range_rad"]
    halves = {"speed": speed, "speed_limit": speed, "leader_speed": speed, "leader_gap": 100, "signal_gap": 100}
    wholes = {"steering": steering, "route_offset": 5} | {f"route_{a}_{d}": d for a in "xy" for d in (5, 10, 20, 40)}
    values = zip(config["observation"]["fields"], row.tolist(), strict=True)
    return {f: halves[f] * (v + 1) / 2 if f in halves else wholes.get(f, 1) * v for f, v in values}


def drive(o: dict[str, float], integral: float, config: dict) -> tuple[float, float, float]:
    """Steering and acceleration (-1 ... 1), and the next value of the integral (m)."""
    ahead_m = float(np.clip(0.7 * o["speed"], 5.0, 15.0))
    x, y = (np.interp(ahead_m, (5, 10, 20), [o[f"route_{axis}_{d}"] for d in (5, 10, 20)]) for axis in "xy")
    angle_rad = math.atan(2 * WHEELBASE_M * y / (x * x + y * y))
    bends = (abs(2 * o[f"route_y_{d}"]) / d**2 for d in (5, 10, 20))
    wanted = min(o["speed_limit"], *(math.sqrt(LATERAL_MPS2 / max(bend, 1e-3)) for bend in bends))
    for gap_m, speed in ((o["leader_gap"], max(o["leader_speed"], 0.0)), (o["signal_gap"] + 2.0, 0.0)):
        if gap_m < 99.0:
            wanted = min(wanted, math.sqrt(speed**2 + 2 * COMFORTABLE_MPS2 * max(gap_m - STAND_OFF_M, 0.0)))
    error = wanted - o["speed"]
    integral = float(np.clip(integral + 0.1 * error, -5.0, 5.0)) if wanted > 0.5 else 0.0
    accel = KP * error + KI * integral - (0.5 if wanted < 0.5 else 0.0)
    limit = config["vehicle"]["max_accel_mps2" if accel > 0 else "max_decel_mps2"]
    return angle_rad / config["vehicle"]["max_road_wheel_angle_rad"], accel / limit, integral


def main(run_file: str) -> None:
    stop: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: stop.append(number))
    channel = Channel(run_file)
    config, integrals, ended, steps = channel.run["config"], {}, False, 0
    while not ended and not stop:
        for obs in channel.receive(0.2):
            actions = np.zeros((len(obs.vehicle), 2), np.float32)
            for slot in np.flatnonzero(obs.valid):
                seen, key = metres(obs.observation[slot].numpy(), config), (obs.episode, obs.vehicle[slot])
                *action, integrals[key] = drive(seen, integrals.get(key, 0.0), config)
                actions[slot] = np.clip(action, -1.0, 1.0)
            channel.publish_actions(obs, actions)
            channel.consumed(obs.tick)
            ended, steps = obs.last, steps + int(obs.valid.sum())
    Path(channel.run["run_dir"], "parts", "trainer.json").write_text(json.dumps({"env_steps": steps}))
    if ended:
        channel.done()


if __name__ == "__main__":
    main(sys.argv[1])
