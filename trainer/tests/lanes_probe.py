"""A trainer that reads lanes beside its observations: `caraware train --set trainer.module=lanes_probe`.

What it finds is in `parts/trainer.json`.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from caraware.ipc.channel import Channel
from caraware.ipc.lane_positions import NO_INDEX, LaneIds, LanePositions


def main(run_file: str) -> None:
    """Take part in the run, and join each observation with the lanes of its tick."""
    channel = Channel(run_file)
    folder = Path(channel.run["run_dir"])
    by_tick: dict[int, LanePositions] = {}
    channel.lane_positions()
    found: dict[str, Any] = dict.fromkeys(("ticks", "without", "rows", "unknown", "off_lane"), 0)
    found["latest_s"] = 0.0
    edges: set[str | None] = set()
    last = False
    while not last:
        for obs in channel.receive(1.0):
            by_tick |= {message.tick: message for message in channel.lane_positions()}
            found["ticks"] += 1
            last = obs.last
            channel.consumed(obs.tick)
            lanes = by_tick.pop(obs.tick, None)
            if lanes is None:
                found["without"] += 1
                continue
            found["latest_s"] = max(found["latest_s"], abs(lanes.sumo_time_s - obs.sim_time_ns * 1e-9))
            rows = {int(row["id_hash"]): row for row in lanes.positions}
            ids = LaneIds.read(folder)
            for id_hash in obs.id_hash[obs.vehicle != np.uint32(NO_INDEX)].tolist():
                row = rows.get(int(id_hash))
                found["rows"] += 1
                if row is None:
                    found["unknown"] += 1
                    continue
                found["off_lane"] += int(row["lane"] == NO_INDEX)
                edges.add(ids.edge(int(row["edge"])))
    found["edges"] = len(edges)
    (folder / "parts" / "trainer.json").write_text(json.dumps(found | {"env_steps": 0}))
    channel.done()


if __name__ == "__main__":
    main(sys.argv[1])
