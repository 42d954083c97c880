"""Disturbs one run by handovers and kills of its trainer at random moments, and compares it with an undisturbed run.

    PYTHONPATH=trainer/python .venv/bin/python docs/endurance.py --handovers 20 --kills 50 --seed 1

Both runs go to a temporary directory. Prints one line of JSON; the exit code is 0 if nothing was lost or learnt twice,
observation hash and final tensors are equal, and nothing is left in shared memory.
"""

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

CARAWARE = Path(__file__).parents[1] / "target" / "release" / "caraware"
SETTINGS = {
    "traffic.cavs": 6,
    "traffic.others": 3,
    "traffic.pedestrians": 3,
    "episode.ticks": 400,
    "episode.evaluation_interval": 2,
    "episode.evaluation_ticks": 50,
    "trainer.horizon": 600,
    "trainer.batch_size": 300,
    "trainer.checkpoint_interval": 2,
    "fanout.enabled": "false",
}


def command(name: str, episodes: int, *more: str) -> list[str]:
    """A small run on the town."""
    settings = SETTINGS | {"episode.training_episodes": episodes}
    return [str(CARAWARE), "train", "town", "--name", name, *(f"--set={k}={v}" for k, v in settings.items()), *more]


def learnt(run: Path) -> str:
    """SHA-256 of every tensor of the newest checkpoint."""
    newest = run / "checkpoints" / (run / "checkpoints" / "latest").read_text()
    files = [newest / f"{name}.safetensors" for name in ("parameters", "optimiser", "random")]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def trainer_pid(run: Path) -> int | None:
    """The youngest trainer of the run."""
    pids = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            line = (process / "cmdline").read_bytes()
        except OSError:
            continue
        if b"caraware.train" in line and os.fsencode(run) in line:
            pids.append(int(process.name))
    return max(pids, default=None)


def newest(run: Path) -> str:
    """Name of the newest checkpoint; empty before the first."""
    latest = run / "checkpoints" / "latest"
    return latest.read_text() if latest.exists() else ""


@dataclass
class Disturbances:
    """Numbers of a run's disturbances."""

    handovers: int = 0
    refused: int = 0
    kills: int = 0
    handovers_s: list[float] = field(default_factory=list)


def disturb(run: Path, process: subprocess.Popen[bytes], disturbances: list[str], rng: random.Random) -> Disturbances:
    """Hands over and kills at random moments, until all disturbances are made or the run is over.

    Waits for a new checkpoint between two disturbances: the run ends after five deaths in a row without one, by design.
    """
    done = Disturbances()
    before = ""
    for disturbance in disturbances:
        while process.poll() is None and newest(run) == before:
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 1.0))
        if process.poll() is not None:
            break
        before = newest(run)
        if disturbance == "handover":
            answer = subprocess.run(
                [CARAWARE, "handover", run.name], cwd=run.parents[1], capture_output=True, text=True, check=False
            )
            if answer.returncode == 0:
                done.handovers += 1
                done.handovers_s.append(float(answer.stdout.split()[-2]))
            else:
                done.refused += 1
        elif (pid := trainer_pid(run)) is not None:
            os.kill(pid, signal.SIGKILL)
            done.kills += 1
    return done


def main() -> int:
    """Both runs and the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--handovers", type=int, default=20)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--episodes", type=int, default=400)
    parser.add_argument("--pace", type=float, default=0.0, help="simulated seconds per second of the disturbed run")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    disturbances = ["handover"] * arguments.handovers + ["kill"] * arguments.kills
    rng.shuffle(disturbances)
    with tempfile.TemporaryDirectory(prefix="endure") as directory:
        os.environ["CARAWARE_RUNTIME_DIR"] = f"{directory}/r"
        silent: dict[str, Any] = {"cwd": directory, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        pace = f"--set=run.real_time_factor={arguments.pace}"
        process = subprocess.Popen(command("disturbed", arguments.episodes, pace), **silent)
        run = Path(directory, "runs", "disturbed")
        done = disturb(run, process, disturbances, rng)
        code = process.wait()
        subprocess.run(command("undisturbed", arguments.episodes), check=True, **silent)
        reports = [json.loads((run.parent / n / "report.json").read_text()) for n in ("disturbed", "undisturbed")]
        result = {
            **asdict(done),
            "exit_code": code,
            "ticks": reports[0]["ticks"],
            "lost_ticks": reports[0]["lost_ticks"],
            "duplicated_ticks": reports[0]["duplicated_ticks"],
            "redelivered_ticks": reports[0]["redelivered_ticks"],
            "restarts": reports[0]["restarts"],
            "wall_s": [report["wall_s"] for report in reports],
            "same_observations": reports[0]["observation_hash"] == reports[1]["observation_hash"],
            "same_tensors": learnt(run) == learnt(run.parent / "undisturbed"),
            "left_in_shared_memory": os.listdir(f"{directory}/r") if os.path.isdir(f"{directory}/r") else [],
        }
    print(json.dumps(result))
    sound = code == 0 and result["same_observations"] and result["same_tensors"] and not result["left_in_shared_memory"]
    return 0 if sound and result["lost_ticks"] == result["duplicated_ticks"] == 0 else 1


if __name__ == "__main__":
    raise SystemExit(main())
