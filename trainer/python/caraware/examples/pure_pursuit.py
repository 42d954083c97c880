"""A scripted driver for the driving task: pure pursuit for the steering, a PI controller for the speed."""

import math
import signal
import sys
from pathlib import Path

import numpy as np
from torch import Tensor

from caraware.ipc.channel import Channel
from caraware.ipc.run_file import ConfigTable

AHEAD_M, WHEELBASE_M, BRAKING_MPS2, LATERAL_MPS2, STAND_OFF_M, KP, KI = (5, 10, 20), 2.7, 2.0, 2.0, 5.0, 1.0, 0.1


def si_units(row: Tensor, names: list[str], ranges: dict[str, list[float]]) -> dict[str, float]:
    """A normalised row of the observation (-1 ... 1) by field, in SI units."""
    values = zip(names, row.tolist(), strict=True)
    return {name: ((1 - v) * ranges[name][0] + (1 + v) * ranges[name][1]) / 2 for name, v in values}


def drive(o: dict[str, float], integral_m: float, config: ConfigTable) -> tuple[float, float, float]:
    """Steering and acceleration (-1 ... 1), and the next value of the controller's integral."""
    ahead_m = float(np.clip(0.7 * o["speed"], 5.0, 15.0))
    x, y = (np.interp(ahead_m, AHEAD_M, [o[f"route_{axis}_{d}"] for d in AHEAD_M]) for axis in "xy")
    angle_rad = math.atan(2 * WHEELBASE_M * y / (x * x + y * y))
    bends_mps = (d * math.sqrt(LATERAL_MPS2 / max(2 * abs(o[f"route_y_{d}"]), 0.02)) for d in AHEAD_M)
    wanted = min(o["speed_limit"], *bends_mps)
    for gap_m, speed in ((o["leader_gap"], max(o["leader_speed"], 0.0)), (o["signal_gap"] + 2.0, 0.0)):
        if gap_m < 99.0:
            wanted = min(wanted, math.sqrt(speed**2 + 2 * BRAKING_MPS2 * max(gap_m - STAND_OFF_M, 0.0)))
    error, stands = wanted - o["speed"], wanted < 0.5
    integral_m = 0.0 if stands else float(np.clip(integral_m + 0.1 * error, -5.0, 5.0))
    accel_mps2 = KP * error + KI * integral_m - 0.5 * stands
    full = [config["vehicle"][f"max_{name}"] for name in ("road_wheel_angle_rad", "accel_mps2", "decel_mps2")]
    return angle_rad / full[0], accel_mps2 / full[1 if accel_mps2 > 0 else 2], integral_m


def main(run_file: str) -> None:
    channel, ended, steps = Channel(run_file), False, 0
    stop: list[int] = []
    integrals: dict[int, float] = {}
    config, names = channel.run["config"], channel.run["config"]["observation"]["fields"]
    ranges = {field["name"]: field["range"] for field in channel.run["observation_fields"]}
    signal.signal(signal.SIGTERM, lambda number, _: stop.append(number))
    while not ended and not stop:
        for obs in channel.receive(0.2):
            actions = np.zeros((len(obs.vehicle), 2), np.float32)
            for slot in np.flatnonzero(obs.valid):
                seen, before = si_units(obs.observation[slot], names, ranges), integrals.get(obs.vehicle[slot], 0.0)
                *actions[slot], integrals[obs.vehicle[slot]] = drive(seen, before, config)
            channel.publish_actions(obs, np.clip(actions, -1.0, 1.0))
            channel.consumed(obs.tick)
            ended, steps = obs.last, steps + int(obs.valid.sum())
    Path(channel.run["run_dir"], "parts", "trainer.json").write_text(f'{{"env_steps": {steps}}}')
    channel.done()


if __name__ == "__main__":
    main(sys.argv[1])
