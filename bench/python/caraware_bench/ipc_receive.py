"""The consumer of `caraware bench ipc`: measures the time from publish to a visible tensor.

`python -m caraware_bench.ipc_receive RUN_FILE` attaches as the trainer of a run, takes every observation, and writes
`latencies.json` into the run directory. The file holds, for each way and number of rows, the nanoseconds until the
block was taken from shared memory, and until a tensor existed. Three ways take ticks in turn: `Channel.lease` and
`Channel.receive(busy=True)`, which poll, and `Channel.receive`, which sleeps until the sender wakes it. The sender
writes the monotonic time into `sim_time_ns` right before it publishes.
"""

import json
import sys
import time
from pathlib import Path

from torch import Tensor

from caraware import _native
from caraware.ipc.channel import Channel, Observation


def main() -> None:
    """Receive until the last block of the run, then write the latencies."""
    channel = Channel(sys.argv[1])
    lease = channel.lease()
    latencies: dict[str, dict[int, list[tuple[int, int]]]] = {"lent": {}, "received": {}, "asleep": {}}

    def take(way: str, tick: _native.Lease | Observation, tensor: Tensor, received_ns: int, now_ns: int) -> bool:
        """Record the latencies of a tick; True for the last tick."""
        rows = tensor.shape[0]
        sent_ns = tick.sim_time_ns
        latencies[way].setdefault(rows, []).append((received_ns - sent_ns, now_ns - sent_ns))
        if tensor[0, 0].item() != rows or tensor[-1, -1].item() != tick.tick:
            raise SystemExit(f"tick {tick.tick}: the tensor does not hold the values that were sent")
        channel.consumed(tick.tick)
        channel.committed(tick.tick)
        return tick.last

    last = False
    while not last:
        tensor = lease.next(10.0)
        now_ns = time.monotonic_ns()
        if tensor is None:
            raise SystemExit("no block arrived for 10 s")
        last = take("lent", lease, tensor, lease.received_ns, now_ns)
        for way in ("received", "asleep"):
            for observation in [] if last else channel.receive(10.0, busy=way == "received"):
                tensor = observation.observation
                now_ns = time.monotonic_ns()
                last = take(way, observation, tensor, observation.block.received_ns, now_ns)
    path = Path(channel.run["run_dir"]) / "latencies.json"
    path.write_text(json.dumps(latencies))
    channel.done()


if __name__ == "__main__":
    main()
