"""A trainer that only reads observations, run by `caraware train --set trainer.module=lease_probe`.

The environment variable LEASE selects how it takes the ticks: `lent`, `received` or `mixed`. It writes what it found,
such as a digest of every observation, to `parts/trainer.json`, so that a test can compare the ways.
"""

import hashlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from caraware.ipc.channel import Channel
from probe import lies_in_shared_memory
from torch import Tensor


def digest(tensor: Tensor) -> str:
    """Digest of the numbers of a tensor."""
    return hashlib.sha256(tensor.clone().numpy().tobytes()).hexdigest()


def leased(channel: Channel) -> dict[str, Any]:
    """Take all ticks of a run, each lent."""
    lease = channel.lease()
    digests: list[str] = []
    tensor: Tensor | None = None
    in_shared_memory, refused_writes, last = True, 0, False
    while not last:
        tensor = lease.next(60.0)
        assert tensor is not None and lease.tick == len(digests), lease.tick
        digests.append(digest(tensor))
        in_shared_memory &= lies_in_shared_memory(tensor.data_ptr())
        try:
            tensor.add_(1)
        except RuntimeError:
            refused_writes += 1
        channel.consumed(lease.tick)
        channel.committed(lease.tick)
        last = lease.last
    nothing = lease.next(0.01)
    places = lease.places
    del lease
    # A tensor that is kept keeps the memory mapped.
    kept = tensor is not None and digest(tensor) == digests[-1]
    return {
        "digests": digests,
        "in_shared_memory": in_shared_memory,
        "refused_writes": refused_writes,
        "nothing_after_the_last": nothing is None,
        "kept": kept,
        "places": places,
    }


def received(channel: Channel) -> dict[str, Any]:
    """Take all ticks of a run, each as an observation that is kept."""
    digests, last = [], False
    while not last:
        for observation in channel.receive(60.0):
            digests.append(digest(observation.observation))
            channel.consumed(observation.tick)
            channel.committed(observation.tick)
            last = observation.last
    return {"digests": digests}


def mixed(channel: Channel) -> dict[str, Any]:
    """Receive ticks of the first episode, borrow those after it up to the first of the second, then receive again."""

    def give_back(tick: int) -> None:
        channel.consumed(tick)
        channel.committed(tick)

    first = channel.receive(60.0)
    give_back(first[-1].tick)
    lease = channel.lease()
    while lease.episode == 0:
        assert lease.next(60.0) is not None
        give_back(lease.tick)
    then = channel.receive(60.0)
    give_back(then[-1].tick)
    while not lease.last:
        assert lease.next(60.0) is not None
        give_back(lease.tick)
    blocks = [first[0].block, then[0].block]
    return {"bounds": [(block.episode, block.bounds_episode) for block in blocks]}


def main() -> None:
    """Take all ticks and write the digests."""
    channel = Channel(sys.argv[1])
    found = {"lent": leased, "received": received, "mixed": mixed}[os.environ["LEASE"]](channel)
    path = Path(channel.run["run_dir"]) / "parts" / "trainer.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(found))
    channel.done()


if __name__ == "__main__":
    main()
