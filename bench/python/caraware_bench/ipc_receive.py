"""The consumer of `caraware bench ipc`: the time from publish to a visible tensor.

`python -m caraware_bench.ipc_receive RUN_FILE` attaches as the trainer of a run, takes every observation while
busy-polling, and writes `latencies.json` into the run directory: for each number of rows and each way, the nanoseconds
until the block was taken from shared memory, and until a tensor existed. Ticks come in turn by `Channel.lease` and by
`Channel.receive`. The sender stamps `sim_time_ns` with the monotonic
clock right before it publishes.
"""

import json
import sys
import time
from pathlib import Path

from torch import Tensor

from caraware import _native
from caraware.ipc.channel import Channel, Observation


def main() -> None:
    """Receives until the last block of the run."""
    channel = Channel(sys.argv[1])
    lease = channel.lease()
    latencies: dict[str, dict[int, list[tuple[int, int]]]] = {"lent": {}, "received": {}}

    def take(way: str, tick: _native.Lease | Observation, tensor: Tensor, received_ns: int, now_ns: int) -> bool:
        """Note a tick; True for the last."""
        rows = tensor.shape[0]
        sent_ns = tick.sim_time_ns
        latencies[way].setdefault(rows, []).append((received_ns - sent_ns, now_ns - sent_ns))
        if tensor[0, 0].item() != rows or tensor[-1, -1].item() != tick.tick:
            raise SystemExit(f"tick {tick.tick}: the tensor does not hold what was sent")
        channel.consumed(tick.tick)
        channel.committed(tick.tick)
        return tick.last

    last = False
    while not last:
        tensor = lease.next(10.0)
        now_ns = time.monotonic_ns()
        if tensor is None:
            raise SystemExit("nothing came for 10 s")
        last = take("lent", lease, tensor, lease.received_ns, now_ns)
        for observation in [] if last else channel.receive(10.0, busy=True):
            tensor = observation.observation
            now_ns = time.monotonic_ns()
            last = take("received", observation, tensor, observation.block.received_ns, now_ns)
    path = Path(channel.run["run_dir"]) / "latencies.json"
    path.write_text(json.dumps(latencies))
    channel.done()


if __name__ == "__main__":
    main()
