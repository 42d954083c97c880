"""`python -m caraware.consumer RUN_FILE`: in the trainer's place, reads every observation and learns nothing.

It measures the cost of delivering observations without a learner: `trainer.module = "caraware.consumer"`.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from caraware import _native
from caraware.ipc.report_part import write_entries


def consume(attachment: _native.Attachment, stop: list[int]) -> dict[str, object]:
    """Take all observations as tensors, read every number of them, give them back; what came."""
    # torch takes seconds to import: the simulation runs its window ahead meanwhile.
    import torch

    from caraware.ipc.channel import Observation

    # Tensors are small: a second thread would cost more than it saves, on a core that has other work.
    torch.set_num_threads(1)

    began_s = time.process_time()
    ticks = env_steps = 0
    total = 0.0
    while not attachment.ended and not stop:
        for block in map(Observation, attachment.receive(0.2)):
            total += float(block.observation.sum())
            env_steps += int(block.valid.sum())
            ticks += 1
            # Nothing is kept, so nothing has to be given again: the sensors' journal stays short.
            attachment.committed(block.tick)
            attachment.consumed(block.tick)
    now_s = time.process_time()
    used = {"cpu_s": now_s, "loop_cpu_s": now_s - began_s}
    return {"env_steps": env_steps, "received_ticks": ticks, "sum": total, "process": used}


def main(run_file: str) -> None:
    """Consume one run and write `parts/trainer.json`."""
    stop: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: stop.append(number))
    attachment = _native.Attachment(run_file)
    part = consume(attachment, stop)
    run_dir = json.loads(attachment.run_json)["run_dir"]
    write_entries(Path(run_dir), part, lambda: bool(stop))
    attachment.done()


if __name__ == "__main__":
    main(sys.argv[1])
    # torch would take a while to tidy up, and the run ends when this process does.
    os._exit(0)
