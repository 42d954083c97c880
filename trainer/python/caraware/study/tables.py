"""The tables of the docs that `caraware reproduce` measures again: what each runs, from which seeds.

Filters see the bytes of a recorded run (`caraware.study.recording`). What is learnt is measured by whole runs, each
from a seed of its own: of traffic, of noise, of the networks, of the evaluations. What is timed runs `caraware bench`.
"""

import json
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from caraware.run.program import caraware_program
from caraware.study.cooperation import ESTIMATORS as COOPERATION_ESTIMATORS
from caraware.study.cooperation import errors_by_episode
from caraware.study.filtering import FilterComparison
from caraware.study.recording import FOLDER, Recording
from caraware.study.regression import Comparison
from caraware.study.sublane import write_sublane_scenario

Measured = dict[str, list[float]]
"""Values of each figure (m, or ratios), one for each independent seed: of an evaluation, or of a whole run."""

FUSION_EVALUATIONS = 5
COOPERATION_EVALUATIONS = 5
COOPERATION_SHARES = (0.1, 0.3, 0.5, 1.0)
"""Shares of the vehicles with a radio."""
MESSAGE_SHARES = (0.3, 1.0)
"""Shares of the vehicles with a radio, where what to say is learnt."""
MESSAGE_RULES = ("standard", "all", "needed")
DEFAULT_NOISE = ("gnss.correlated_std_m=0.0", "blackout.enabled=false")
SENSORS: Mapping[str, tuple[str, ...]] = {"default_noise": DEFAULT_NOISE, "faults": ()}
"""Settings beside the preset `fusion`, which has a slow error of fixes and blackouts."""
ON_SUBLANES = (
    "gnss.correlated_std_m=3.0",
    "blackout.enabled=true",
    "task.action=place",
    "traffic.max_cavs=32",
    "traffic.max_road_users=256",
    "episode.ticks=300",
    "episode.training_episodes=64",
    "episode.evaluation_ticks=300",
    "episode.final_evaluations=5",
    "trainer.module=caraware.fusion.train",
    "trainer.learning_rate=5e-3",
    "trainer.learning_rate_final=1e-4",
    "trainer.hidden=[64]",
    "trainer.supervised=false",
    "trainer.epochs=3",
    "trainer.batch_size=256",
    "fusion.segment_ticks=300",
    "fusion.truncation_ticks=30",
)
"""What the preset `fusion` sets, for a scenario."""
ESTIMATORS = {"ppo": "policy", "supervised": "regression", "raw_gnss": "raw_gnss", "ekf": "ekf", "map_ekf": "map_ekf"}
"""Names in `report.json`, and of figures."""
LEARNERS = {key: ESTIMATORS[key] for key in ("ppo", "supervised")}
PAPER_ESTIMATORS = {key: ESTIMATORS[key] for key in ("ppo", "supervised", "raw_gnss")}


class StudyError(Exception):
    """A run that a table needs is there, but cannot be used."""


@dataclass(frozen=True)
class Options:
    """What a table is measured with."""

    runs: Path
    """Directory of the runs; one that is there already is not made again."""
    seeds: Sequence[int]
    """Of whole runs."""


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
        of = FilterComparison(recording, FUSION_EVALUATIONS)
        measured |= {f"{label}.{name}": values for name, values in of.filters_m().items()}
        measured[f"{label}.raw_gnss"] = Comparison(recording, FUSION_EVALUATIONS).raw_gnss_m()
    return measured


def town(options: Options) -> Measured:
    """Policy, regression by as many samples and steps, and filters: whole runs of the preset `town`."""
    reports = [whole_run(options, f"town-{seed}", "town", (f"run.seed={seed}",)) for seed in options.seeds]
    measured = {name: [_error_m(report, key) for report in reports] for key, name in ESTIMATORS.items()}
    pairs = zip(measured["policy"], measured["regression"], strict=True)
    return measured | {"policy_by_regression": [policy / regression for policy, regression in pairs]}


def paper(options: Options) -> Measured:
    """The paper's case study: policy, regression by as many samples and steps, and raw GNSS, by whole runs."""
    reports = [whole_run(options, f"paper-{seed}", "paper", (f"run.seed={seed}",)) for seed in options.seeds]
    return {name: [_error_m(report, key) for report in reports] for key, name in PAPER_ESTIMATORS.items()}


def camera(options: Options) -> Measured:
    """Place in the lane and lane from four images, and without images from the fields alone: whole runs of `camera`.

    Both learners see the same traffic.
    """
    measured: Measured = {}
    for seed in options.seeds:
        reports = {}
        for eyes, settings in (("images", ()), ("fields", ("trainer.network=mlp",))):
            own = (f"run.seed={seed}", *settings)
            reports[eyes] = whole_run(options, f"camera-{eyes}-{seed}", "camera", own)["trainer"]
        for metric in ("lateral_error_m", "wrong_lane_percent"):
            for eyes, report in reports.items():
                for key, name in LEARNERS.items():
                    measured.setdefault(f"{eyes}.{name}.{metric}", []).append(report[f"{key}_mean_{metric}"])
            measured.setdefault(f"raw_gnss.{metric}", []).append(reports["images"][f"raw_gnss_mean_{metric}"])
    return measured


def fusion(options: Options) -> Measured:
    """The learned estimator and the filter that it starts as: whole runs with each sensor setting, and on sublanes."""
    measured: Measured = {}
    for label, settings in SENSORS.items():
        measured |= _learnt(label, (_fusion_run(options, label, "fusion", settings, seed) for seed in options.seeds))
    # The net and the types of the scenario are those of a run that is there by now.
    run = json.loads((options.runs / _name("faults", options.seeds[0]) / "run.json").read_text())
    files = [Path(file) for file in run["scene_files"]["additional_files"]]
    types = next(file for file in files if file.name.endswith(".vtypes.add.xml"))
    scenario = write_sublane_scenario(Path(run["scene_files"]["net_file"]), types, options.runs / "sublane-scenario")
    runs = (_fusion_run(options, "sublane", str(scenario), ON_SUBLANES, seed) for seed in options.seeds)
    return measured | _learnt("sublane", runs)


def _learnt(label: str, reports: Iterable[Mapping[str, Any]]) -> Measured:
    errors_m = [(_error_m(report, "ppo"), _error_m(report, "map_ekf")) for report in reports]
    return {
        f"{label}.fusion": [learnt for learnt, _ in errors_m],
        f"{label}.map_ekf": [filtered for _, filtered in errors_m],
        f"{label}.fusion_by_map_ekf": [learnt / filtered for learnt, filtered in errors_m],
    }


def _fusion_run(options: Options, label: str, config: str, settings: Sequence[str], seed: int) -> Mapping[str, Any]:
    own = (f"run.seed={seed}", "episode.evaluation_interval=0")
    return whole_run(options, _name(label, seed), config, (*settings, *own))


def _name(label: str, seed: int) -> str:
    return f"fusion-{label}-{seed}"


def overhead(options: Options) -> Measured:
    """Wall time of co-simulation by that of bare `sumo`, with either allocator: one run of the benchmark."""
    return _of_benchmark(options, "overhead", ("ratio of wall times", "ratio of wall times, same allocator"))


def peers(options: Options) -> Measured:
    """Rate of sensed vehicle-steps by that of Python loops over SUMO: one run of the benchmark."""
    return _of_benchmark(options, "peers", ("ratio to libsumo, Python loop", "ratio to TraCI, Python loop"))


def _of_benchmark(options: Options, part: str, names: Sequence[str]) -> Measured:
    file = options.runs / f"{part}.json"
    options.runs.mkdir(parents=True, exist_ok=True)
    subprocess.run([str(caraware_program()), "bench", part, "--json", str(file)], check=True)
    figures = json.loads(file.read_text())["figures"]
    return {name: [float(figures[name])] for name in names if name in figures}


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


def messages(options: Options) -> Measured:
    """What stations know, and what they send, by a learnt policy and by rules: whole runs, at two shares of radios.

    The rules run on the evaluation seeds of the policy beside them.
    """
    measured: Measured = {}
    for share in MESSAGE_SHARES:
        for seed in options.seeds:
            own = (f"run.seed={seed}", f"v2x.share={share}", "episode.evaluation_interval=0")
            reports = {"policy": whole_run(options, f"messages-{share}-policy-{seed}", "messages", own)}
            for rule in MESSAGE_RULES:
                settings = (*own, f"v2x.inclusion={rule}", "episode.training_episodes=1", "episode.ticks=1")
                reports[rule] = whole_run(options, f"messages-{share}-{rule}-{seed}", "messages", settings)
            for name, report in reports.items():
                for metric in ("awareness_percent", "message_kbitps"):
                    value = float(report["trainer"][f"ppo_mean_{metric}"])
                    measured.setdefault(f"{share}.{name}.{metric}", []).append(value)
        for metric in ("awareness_percent", "message_kbitps"):
            pairs = zip(measured[f"{share}.policy.{metric}"], measured[f"{share}.standard.{metric}"], strict=True)
            measured[f"{share}.policy_by_standard.{metric}"] = [policy / standard for policy, standard in pairs]
    return measured


TABLES: Mapping[str, Table] = {
    "filters": Table("docs/baselines.md", "the filters with and without a map", filters),
    "cooperation": Table("docs/cooperation.md", "localisation with others' help", cooperation),
    "messages": Table("docs/messages.md", "what to tell others, learnt and by rules", messages),
    "town": Table("docs/baselines.md", "policy and regression by as many samples and steps", town),
    "fusion": Table("docs/fusion.md", "the learned estimator beside the filter that it starts as", fusion),
    "paper": Table("docs/paper.md", "the paper's case study", paper),
    "camera": Table("docs/seeing.md", "the lane from images, and without", camera),
    "overhead": Table("docs/benchmarks.md", "co-simulation beside bare `sumo`", overhead),
    "peers": Table("docs/benchmarks.md", "rates beside Python loops over SUMO", peers),
}


def whole_run(options: Options, name: str, config: str, settings: Sequence[str]) -> Mapping[str, Any]:
    """`report.json` of a completed run; made unless it is there. Raises `StudyError`, `CalledProcessError`."""
    report = options.runs / name / "report.json"
    if not report.exists():
        _train(options, name, config, settings)
    found: Mapping[str, Any] = json.loads(report.read_text())
    if found["result"] != "completed":
        raise StudyError(f"{report}: the run is {found['result']}; remove its directory, then start again")
    return found


def _error_m(report: Mapping[str, Any], estimator: str) -> float:
    return float(report[f"{estimator}_mean_error_m"])


def recorded(options: Options, preset: str, label: str, settings: Sequence[str]) -> Recording:
    """The recorded run of a preset; made unless it is there whole. Raises `CalledProcessError` where it fails."""
    name = f"recorded-{label}"
    recording = Recording(options.runs / name)
    part = recording.run_dir / "parts" / "trainer.json"
    if part.exists() and json.loads(part.read_text())["recorded_episodes"] == len(
        list((recording.run_dir / FOLDER).glob("*.npz"))
    ):
        return recording
    _train(options, name, preset, ("trainer.module=caraware.study.recording", *settings))
    return recording


def _train(options: Options, name: str, config: str, settings: Sequence[str]) -> None:
    command = [str(caraware_program()), "train", config, "--runs", str(options.runs), "--name", name]
    subprocess.run([*command, *(word for each in settings for word in ("--set", each))], check=True)
