"""One rank of small data-parallel trainings over prepared ticks; `torchrun` starts it for test_ranks.py."""

import json
import os
import sys
from pathlib import Path
from typing import Any

from caraware.learn import ranks
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.run.loop import TrainingLoop
from synthetic import FIELDS, SyntheticChannel, run_file, with_evaluation

DEVICE = os.environ.get("RANK_PROBE_DEVICE", "cpu")
TRAININGS: dict[str, dict[str, Any]] = json.loads(os.environ.get("RANK_PROBE_TRAININGS", "{}"))
"""By the name of each training, its settings of the trainer beside the sizes below. A process runs them in turn."""
HORIZON, BATCH, VEHICLES, TRAINING_TICKS = 256, 64, 16, 64


def settings(folder: Path, envs: int, first_env: int, world: int, more: dict[str, Any]) -> dict[str, Any]:
    """The run file of one trainer with `envs` environments among `world` ranks; sizes are of each environment."""
    sizes = {"ranks": world, "horizon": envs * HORIZON, "batch_size": envs * BATCH}
    own = sizes | {"checkpoint_interval": 1, "device": DEVICE} | more
    run = run_file(str(folder), **own)
    run["config"]["run"] |= {"envs": envs, "first_env": first_env}
    return run


def channels(run: dict[str, Any]) -> list[SyntheticChannel]:
    """The ticks of its environments; an environment has the same ticks in every rank."""
    place = run["config"]["run"]
    numbers = range(place["first_env"], place["first_env"] + place["envs"])
    return [SyntheticChannel(run, with_evaluation(TRAINING_TICKS, 6, VEHICLES, 5.0, 1 + env)) for env in numbers]


def main(folder: Path, fault: str) -> None:
    """Train as rank `RANK`. A fault makes one of the ranks fail."""
    world = int(os.environ["WORLD_SIZE"])
    together = ranks.of_run(world)
    for name, more in TRAININGS.items():
        train(folder / name, world, together, more, fault)
    together.close()


def train(folder: Path, world: int, together: ranks.Ranks, more: dict[str, Any], fault: str) -> None:
    """One training, in the directory of this rank."""
    rank = int(os.environ["RANK"])
    run = settings(folder / f"rank{rank}", 1, rank, world, more)
    first, *others = channels(run)
    loop = TrainingLoop(first, RunConfig.from_run(run), lambda: False, others=others, ranks=together)
    if rank == 1 and fault == "dies":
        learn = loop._learn
        setattr(loop, "_learn", lambda learner: os._exit(9) if loop._updates() == 2 else learn(learner))  # noqa: B010
    if rank == 1 and fault == "differs":
        learner = Learner.begin(RunConfig.from_run(run), FIELDS, together)
        loop._start(learner)
        learner.ppo.updater.parameters()["policy.layer0.weight"][0, 0] += 1e-3
    loop.run()


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "")
    except ranks.RankError as error:
        print(f"RankError: {error}", file=sys.stderr, flush=True)
        sys.exit(1)
