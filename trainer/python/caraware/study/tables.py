"""The tables of the docs that `caraware reproduce` measures again: what each runs, from which seeds.

A table records a run once (`caraware.study.recording`), then lets every estimator see the same bytes.
"""

import json
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caraware.run.program import caraware_program
from caraware.study.cooperation import ESTIMATORS as COOPERATION_ESTIMATORS
from caraware.study.cooperation import errors_by_episode
from caraware.study.fusing import FusionComparison
from caraware.study.recording import FOLDER, Recording
from caraware.study.regression import Comparison, same_steps

Measured = dict[str, list[float]]
"""Values of each figure (m), one for each independent seed: of an evaluation, or of a learner."""

FUSION_EVALUATIONS, TOWN_EVALUATIONS = 5, 4
COOPERATION_EVALUATIONS = 5
COOPERATION_SHARES = (0.1, 0.3, 0.5, 1.0)
"""Shares of the vehicles with a radio."""
DEFAULT_NOISE = ("gnss.correlated_std_m=0.0", "blackout.enabled=false")
SENSORS: Mapping[str, tuple[str, ...]] = {"default_noise": DEFAULT_NOISE, "faults": ()}
"""Settings beside the preset `fusion`, which has a slow error of fixes and blackouts."""


@dataclass(frozen=True)
class Options:
    """What a table is measured with."""

    runs: Path
    """Directory of the recorded runs; one that is there already is not made again."""
    seeds: Sequence[int]
    """Of learners."""


@dataclass(frozen=True)
class Table:
    """One table of the docs."""

    page: str
    title: str
    measure: Callable[[Options], Measured]


def filters(options: Options) -> Measured:
    """EKF, the same with a map, and raw GNSS: five evaluation seeds, each one value."""
    measured: Measured = {}
    for label, settings in SENSORS.items():
        recording = recorded(options, "fusion", label, settings)
        of = FusionComparison(recording, FUSION_EVALUATIONS)
        measured |= {f"{label}.{name}": values for name, values in of.filters_m().items()}
        measured[f"{label}.raw_gnss"] = Comparison(recording, FUSION_EVALUATIONS).raw_gnss_m()
    return measured


def fusion(options: Options) -> Measured:
    """The learned estimator, and its error as a share of the two filters': each learner's seed one value."""
    of = FusionComparison(recorded(options, "fusion", "faults", SENSORS["faults"]), FUSION_EVALUATIONS)
    filters_m = {name: float(np.mean(values)) for name, values in of.filters_m().items()}
    means_m = [float(np.mean(of.errors_m(of.trained(seed)))) for seed in options.seeds]
    shares = {f"fusion_by_{name}": [mean_m / filter_m for mean_m in means_m] for name, filter_m in filters_m.items()}
    return {"fusion": means_m} | shares


def regression(options: Options) -> Measured:
    """Regression by PPO's samples and gradient steps: each learner's seed one value."""
    of = Comparison(recorded(options, "town", "town", ()), TOWN_EVALUATIONS)
    return {"regression": [each.mean_m for seed in options.seeds for each in same_steps(of, seed, ppo=False)]}


def cooperation(options: Options) -> Measured:
    """Estimators with others' help, at several shares of vehicles with a radio: five evaluation seeds, each one value.

    Without radios no message is sent, and `raw` and `ekf` at full share are what is known.
    """
    measured: Measured = {}
    for share in COOPERATION_SHARES:
        settings = [f"v2x.share={share}"]
        errors = errors_by_episode(
            recorded(options, "cooperation", f"share-{share}", settings), COOPERATION_EVALUATIONS
        )
        for name in COOPERATION_ESTIMATORS:
            measured[f"{share}.{name}"] = [each[name] for each in errors]
        # Each seed's own ratio: all estimators see the same ticks.
        for name, by in (("cooperative", "ekf"), ("cooperative", "implicit"), ("smoother", "ekf")):
            measured[f"{share}.{name}_by_{by}"] = [each[name] / each[by] for each in errors]
    return measured


TABLES: Mapping[str, Table] = {
    "filters": Table("docs/baselines.md", "the filters with and without a map", filters),
    "regression": Table("docs/baselines.md", "regression with PPO's samples and gradient steps", regression),
    "cooperation": Table("docs/cooperation.md", "localisation with others' help", cooperation),
    "fusion": Table("docs/fusion.md", "the learned estimator beside the filters", fusion),
}


def recorded(options: Options, preset: str, label: str, settings: Sequence[str]) -> Recording:
    """The recorded run of a preset; made unless it is there whole. Raises `CalledProcessError` where it fails."""
    name = f"recorded-{label}"
    recording = Recording(options.runs / name)
    part = recording.run_dir / "parts" / "trainer.json"
    if part.exists() and json.loads(part.read_text())["recorded_episodes"] == len(
        list((recording.run_dir / FOLDER).glob("*.npz"))
    ):
        return recording
    sets = ["trainer.module=caraware.study.recording", *settings]
    command = [str(caraware_program()), "train", preset, "--runs", str(options.runs), "--name", name]
    subprocess.run([*command, *(word for each in sets for word in ("--set", each))], check=True)
    return recording
