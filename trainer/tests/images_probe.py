"""A trainer that checks the images in observations: `caraware train --set trainer.module=images_probe`.

It kills itself once. Its successor gets the uncommitted ticks again and compares their images, byte for byte, with what
it received before. The findings are in `parts/trainer.json`.
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
from caraware.ipc.image import Image, Label

COMMIT_AT, DIE_AT = 50, 80
SHOWN = (Label.ROAD, Label.LANE_MARKING, Label.SIDEWALK)


def digest(obs: Observation) -> str:
    """Hash of all images of a tick."""
    return hashlib.blake2b(np.ascontiguousarray(obs.images).tobytes(), digest_size=16).hexdigest()


def compare(obs: Observation, watched: list[Image], found: dict[str, Any]) -> None:
    """Compare what watchers get with the images of the observation of the same tick and vehicle."""
    for image in watched:
        if image.tick != obs.tick:
            continue
        slots = np.flatnonzero(np.asarray(obs.vehicle) == image.vehicle)
        found["watched"] += 1
        assert image.semantic is not None
        same = len(slots) == 1 and np.array_equal(obs.images[int(slots[0]), 0], image.semantic)
        found["unlike"] += int(not same)


def main(run_file: str) -> None:
    """Take part in the run, die once, and compare."""
    channel = Channel(run_file)
    folder = Path(channel.run["run_dir"])
    log = folder / "images.json"
    before: dict[str, str] = json.loads(log.read_text()) if log.exists() else {}
    found: dict[str, Any] = dict.fromkeys(("watched", "unlike", "again", "different", "valid", "shown"), 0)
    found |= {"first_tick": channel.first_tick, "consecutive": True, "shape": []}
    seen: dict[str, str] = {}
    watched: list[Image] = []
    tick, last = channel.first_tick - 1, False
    channel.images()
    while not last:
        for obs in channel.receive(1.0):
            found["consecutive"] &= obs.tick == tick + 1
            tick, last = obs.tick, obs.last
            images = np.asarray(obs.images)
            found["shape"] = list(images.shape)
            valid = np.flatnonzero(obs.valid[: len(images)])
            found["valid"] += len(valid)
            found["shown"] += int(np.isin(images[valid], SHOWN).reshape(len(valid), -1).any(1).sum())
            # An image is sent before the observation that holds it.
            watched = [image for image in [*watched, *channel.images()] if image.tick >= tick]
            compare(obs, watched, found)
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
