"""A trainer that checks what vehicles know from messages: `caraware train --set trainer.module=neighbours_probe`.

It kills itself once. Its successor gets the uncommitted ticks again and compares them, byte for byte, with what it
received before. The findings are in `parts/trainer.json`.
"""

import hashlib
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
from caraware.ipc.channel import Channel, Observation

COMMIT_AT, DIE_AT = 50, 80
CAM = 1


def digest(obs: Observation) -> str:
    """Hash of all that the slots know at a tick."""
    known = obs.neighbours
    arrays = (known.objects.numpy(), known.ids, known.radio, known.channel_load.numpy(), known.vehicle)
    return hashlib.blake2b(b"".join(array.tobytes() for array in arrays), digest_size=16).hexdigest()


def check_tick(obs: Observation, truth_before: dict[int, np.ndarray], found: dict[str, Any]) -> None:
    """Check that rows are those of the observation, and that what is known was true when it was measured."""
    known = obs.neighbours
    found["same_vehicles"] &= bool(np.array_equal(known.vehicle, obs.vehicle))
    objects, ids = known.objects.numpy(), known.ids
    # A tick old: measured at the tick before, which is the newest that can have arrived.
    newest = (ids[:, :, 2] == CAM) & (np.abs(objects[:, :, 7] - 0.1) < 0.02)
    for row, place in zip(*np.nonzero(newest), strict=True):
        truth = truth_before.get(int(ids[row, place, 0]))
        if truth is not None:
            away_m = float(np.hypot(*(objects[row, place, :2] - truth[:2])))
            found["compared"] += 1
            found["farthest_m"] = max(found["farthest_m"], away_m)
    found["known"] += int((ids[:, :, 2] != 0).sum())
    found["self_known"] += int((ids[:, :, 0] == (obs.id_hash & 0xFFFF_FFFF).astype(np.uint32)[:, None]).sum())


def main(run_file: str) -> None:
    """Take part in the run, die once, and compare."""
    channel = Channel(run_file)
    folder = Path(channel.run["run_dir"])
    log = folder / "neighbours.json"
    before: dict[str, str] = json.loads(log.read_text()) if log.exists() else {}
    found: dict[str, Any] = {"same_vehicles": True, "farthest_m": 0.0, "first_tick": channel.first_tick}
    found |= dict.fromkeys(("compared", "known", "self_known", "again", "different"), 0)
    seen: dict[str, str] = {}
    truth_before: dict[int, np.ndarray] = {}
    tick, last = channel.first_tick - 1, False
    while not last:
        for obs in channel.receive(1.0):
            found["consecutive"] = found.get("consecutive", True) and obs.tick == tick + 1
            tick, last = obs.tick, obs.last
            check_tick(obs, truth_before, found)
            stations = (obs.id_hash & 0xFFFF_FFFF).tolist()
            truth_before = dict(zip(stations, obs.truth.numpy().copy(), strict=True))
            seen[str(tick)] = digest(obs)
            if str(tick) in before:
                found["again"] += 1
                found["different"] += int(before[str(tick)] != seen[str(tick)])
            if not before and tick == COMMIT_AT:
                channel.commit(tick)
            if not before and tick == DIE_AT:
                log.write_text(json.dumps(seen))
                os.kill(os.getpid(), signal.SIGKILL)
            channel.consumed(tick)
    (folder / "parts" / "trainer.json").write_text(json.dumps(found | {"last_tick": tick, "env_steps": 0}))
    channel.done()


if __name__ == "__main__":
    main(sys.argv[1])
