"""A driver for tests: keeps to its lane, and does at given times what `DRIVER_SCRIPT` (JSON) says.

`{"from_s": [steering, acceleration] | null, …}`: from that time of a hero's life on (s) this action; null for "keep the lane and
hold the speed". "stop_x_m" brakes so that the rear axle stands at this x. "mute_s" answers no more; "quit_s" ends the process.
What it saw goes to `parts/trainer.json`.
"""

import json
import math
import os
import sys
import time
from pathlib import Path

import numpy as np
from caraware.ipc.channel import Channel

SCRIPT = json.loads(os.environ["DRIVER_SCRIPT"])
PHASES = sorted(
    (float(key), value) for key, value in SCRIPT.items() if key[0].isdigit()
)


def keep_lane(row: dict[str, float], speed: float, wanted: float) -> list[float]:
    """Pure pursuit towards the route 10 m ahead, and a proportional controller of the speed."""
    x, y = row["route_x_10"] * 10, row["route_y_10"] * 10
    return [
        math.atan(2 * 2.7 * y / (x * x + y * y)) / 0.6,
        float(np.clip((wanted - speed) / 5, -1, 1)),
    ]


def act(row: dict[str, float], truth: list[float], age_s: float, first_speed: float) -> list[float]:
    """Steering and acceleration."""
    x, speed = truth[0], truth[3]
    phase = [action for start, action in PHASES if start <= age_s][-1]
    if phase is not None:
        return [float(part) for part in phase]
    if "stop_x_m" in SCRIPT:
        left = SCRIPT["stop_x_m"] - x
        return [
            keep_lane(row, speed, 0)[0],
            float(np.clip((math.sqrt(max(2 * 3 * left, 0)) - speed) / 2, -1, 0.3)),
        ]
    return keep_lane(row, speed, first_speed)


def main(run_file: str) -> None:
    """Drive every hero from the first tick to the last."""
    channel = Channel(run_file)
    config, ended = channel.run["config"], False
    first_speed: dict[tuple[int, int], float] = {}
    seen: list[list[float]] = []
    while not ended:
        for obs in channel.receive(0.2):
            steps = obs.episode_step
            actions = np.full((len(obs.vehicle), 2), np.nan, np.float32)
            for slot in range(len(obs.vehicle)):
                key = (obs.episode, int(obs.vehicle[slot]))
                truth, age_s = obs.truth[slot].tolist(), 0.1 * int(steps[slot])
                ends = [
                    bool(obs.valid[slot]),
                    bool(obs.terminated[slot]),
                    bool(obs.truncated[slot]),
                ]
                seen.append([obs.episode, obs.tick, slot, key[1], *ends, *truth])
                if obs.valid[slot]:
                    row = dict(
                        zip(
                            config["observation"]["fields"],
                            obs.observation[slot].tolist(),
                            strict=True,
                        )
                    )
                    first_speed.setdefault(key, truth[3])
                    actions[slot] = act(row, truth, age_s, first_speed[key])
                    if "mute_s" in SCRIPT and age_s >= SCRIPT["mute_s"]:
                        time.sleep(600)
                    if "quit_s" in SCRIPT and age_s >= SCRIPT["quit_s"]:
                        sys.exit("had enough")
            channel.publish_actions(obs, actions)
            channel.consumed(obs.tick)
            ended = obs.last
    part = {"env_steps": sum(row[4] for row in seen), "seen": seen}
    Path(channel.run["run_dir"], "parts", "trainer.json").write_text(json.dumps(part))
    channel.done()


if __name__ == "__main__":
    main(sys.argv[1])
