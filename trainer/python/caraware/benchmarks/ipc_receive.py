"""The consumer of `caraware bench ipc`: the time from publish to a visible tensor.

`python -m caraware.benchmarks.ipc_receive RUN_FILE` attaches as the trainer of a run, takes every observation while
busy-polling, and writes `latencies.json` into the run directory: for each number of rows, the nanoseconds until the
block was taken from shared memory, and until a tensor existed. The sender stamps `sim_time_ns` with the monotonic
clock right before it publishes.
"""

import json
import sys
import time
from pathlib import Path

from caraware.channel import Channel


def main() -> None:
    """Receives until the last block of the run."""
    channel = Channel(sys.argv[1])
    latencies: dict[int, list[tuple[int, int]]] = {}
    last = False
    while not last:
        for observation in channel.receive(10.0, busy=True):
            tensor = observation.observation
            now_ns = time.monotonic_ns()
            rows = tensor.shape[0]
            sent_ns = observation.sim_time_ns
            latencies.setdefault(rows, []).append((observation.block.received_ns - sent_ns, now_ns - sent_ns))
            if tensor[0, 0].item() != rows or tensor[-1, -1].item() != observation.tick:
                raise SystemExit(f"tick {observation.tick}: the tensor does not hold what was sent")
            last = observation.last
            channel.consumed(observation.tick)
            channel.committed(observation.tick)
    path = Path(channel.run["run_dir"]) / "latencies.json"
    path.write_text(json.dumps(latencies))
    channel.done()


if __name__ == "__main__":
    main()
