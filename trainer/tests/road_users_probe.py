"""A trainer that reads all road users beside its observations: `caraware train --set trainer.module=road_users_probe`.

What it finds is in `parts/trainer.json`.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from caraware import _native
from caraware.ipc.channel import Channel
from caraware.ipc.road_users import RoadUserStates


def main(run_file: str) -> None:
    """Take part in the run, and compare each observation's truth with the states of its tick."""
    channel = Channel(run_file)
    found: dict[str, Any] = dict.fromkeys(("ticks", "first", "gaps", "rows", "unknown", "others"), 0)
    found |= {"largest_error_m": 0.0, "smallest_box_m": 99.0}
    if not channel.run["config"]["trainer"]["road_users"]:
        try:
            channel.road_users()
        except RuntimeError as error:
            found["refused"] = str(error)
    by_tick: dict[int, RoadUserStates] = {}
    last = False
    while not last:
        for obs in channel.receive(1.0):
            last = obs.last
            channel.consumed(obs.tick)
            if "refused" in found:
                continue
            by_tick |= {message.tick: message for message in channel.road_users()}
            found["ticks"] += 1
            world = by_tick.pop(obs.tick, None)
            if world is None:
                found["first" if found["rows"] == 0 else "gaps"] += 1
                continue
            assert world.sim_time_ns == obs.sim_time_ns
            places = {int(vehicle): place for place, vehicle in enumerate(world.states["vehicle"])}
            sensing = obs.vehicle[obs.vehicle != _native.EMPTY_SLOT].tolist()
            found["others"] = max(found["others"], len(places) - len(sensing))
            found["smallest_box_m"] = min(found["smallest_box_m"], float(world.boxes_m[:, 3:6].min()))
            for slot in np.flatnonzero(obs.vehicle != _native.EMPTY_SLOT).tolist():
                found["rows"] += 1
                place = places.get(int(obs.vehicle[slot]))
                if place is None:
                    found["unknown"] += 1
                    continue
                state, truth = world.states[place], obs.truth[slot].numpy()
                error_m = np.hypot(state["x_m"] - truth[0], state["y_m"] - truth[1])
                found["largest_error_m"] = max(found["largest_error_m"], float(error_m))
    folder = Path(channel.run["run_dir"])
    (folder / "parts" / "trainer.json").write_text(json.dumps(found | {"env_steps": 0}))
    channel.done()


if __name__ == "__main__":
    main(sys.argv[1])
