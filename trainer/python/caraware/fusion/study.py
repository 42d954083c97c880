"""`python -m caraware.fusion.study`: trains the preset `fusion` and prints its errors beside the filters', over seeds.

Every setting of the sensors has its own training, `--training-seeds` times. Evaluation seeds, and the trips of vehicles
in evaluations (`traffic.held_out_trips`), are ones that no training episode has seen. Intervals are 95 % (Student's t)
over the evaluation seeds of a run, or over runs where there are several.
"""

import argparse
import json
import subprocess
from pathlib import Path

from caraware.report.statistics import mean_interval

DEFAULT_NOISE = ["gnss.correlated_std_m=0.0", "blackout.enabled=false"]
SETTINGS = {"default noise": DEFAULT_NOISE, "slow GNSS error and blackouts": []}
ESTIMATORS = {
    "ppo": "fusion",
    "map_ekf": "EKF with a map",
    "ekf": "EKF",
    "rts": "RTS (sees the future)",
    "raw_gnss": "raw GNSS",
}


def main() -> None:
    """Run what is asked for, then print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--caraware", default="target/release/caraware", help="the command")
    parser.add_argument("--runs", type=Path, required=True, help="directory for the runs")
    parser.add_argument("--training-seeds", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], dest="settings", help="key=value, for every run")
    options = parser.parse_args()
    print(
        "| sensors | runs | "
        + " | ".join(f"{label} [m]" for label in ESTIMATORS.values())
        + " | fusion / EKF with a map |"
    )
    print("|---|---|" + "---|" * (len(ESTIMATORS) + 1))
    for label, changes in SETTINGS.items():
        runs = [_seeds_m(options, label, changes, seed) for seed in range(1, options.training_seeds + 1)]
        seeds = [seed for run in runs for seed in run] if len(runs) == 1 else [_mean(run) for run in runs]
        columns = [str(mean_interval([seed[name] for seed in seeds])) for name in ESTIMATORS]
        ratio = mean_interval([seed["ppo"] / seed["map_ekf"] for seed in seeds])
        print(f"| {label} | {len(runs)} × {len(runs[0])} seeds | " + " | ".join(columns) + f" | {ratio} |", flush=True)


def _seeds_m(options: argparse.Namespace, label: str, changes: list[str], seed: int) -> list[dict[str, float]]:
    """Mean errors of every evaluation seed at the end of one run, which is made unless it is there already."""
    name = f"{label.replace(' ', '-')}-{seed}"
    part = options.runs / name / "parts" / "trainer.json"
    if not part.exists():
        sets = [f"run.seed={seed}", *changes, *options.settings]
        command = [options.caraware, "train", "fusion", "--runs", str(options.runs), "--name", name]
        subprocess.run([*command, *(word for change in sets for word in ("--set", change))], check=True)
    seeds_m: list[dict[str, float]] = json.loads(part.read_text())["seeds_m"]
    return seeds_m


def _mean(seeds: list[dict[str, float]]) -> dict[str, float]:
    return {name: sum(seed[name] for seed in seeds) / len(seeds) for name in ESTIMATORS}


if __name__ == "__main__":
    main()
