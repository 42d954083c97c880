"""The data card of an export: what it is, where it comes from, and what its values mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from caraware import _native
from caraware.data.export.sensors import mounted_sensors, roadside_carriers
from caraware.data.recording import Episode, Recording

SENSORS = ("gnss", "imu", "speed_steering", "lidar", "ultrasonic", "camera", "radar")
"""Tables of the configuration that describe sensors."""


def card(recording: Recording, format_name: str, meaning: str, parts: list[str], lacking: list[str]) -> str:
    """The card as Markdown; `lacking` has a sentence for each sensor that the export leaves out in whole or in part."""
    start, run = recording.start, recording.run
    end, config = recording.end, run["config"]
    hash_line = end["observation_hash"] if end else "none: the recording was not finished"
    missed = end["missed_ticks"] if end else "unknown"
    lines = [
        f"# {start['run']}: {format_name}",
        "",
        f"{meaning} Written by `caraware export` from a recording of `caraware` {start['program_version']}.",
        "",
        "| what | value |",
        "|---|---|",
        f"| run | {start['run']}, environment {start['env_index']} |",
        f"| seed | {start['seed']} |",
        f"| configuration (BLAKE3) | `{start['config_hash']}` |",
        f"| observation hash (BLAKE3) | `{hash_line}` |",
        f"| recorded | {'without loss' if start['is_lossless'] else 'as a watcher'}, {missed} ticks missed |",
        f"| length of a tick | {start['tick_s']} s |",
        f"| versions | recording {start['recording_version']}, schema {start['schema_version']} |",
        f"| this program's schema | {_native.SCHEMA_VERSION} |",
        f"| map | `{run['map']['projection']}` |",
        f"| task | {config['task']['kind']} |",
        f"| episodes | {len(parts)} |",
        "",
        "World frame: metres in the projection of the map, x east, y north, z up; angles in radians, counter-clockwise",
        "from east, unless a column or a format says otherwise. The truth is the centre of the rear axle.",
        "",
        "## Sensors",
        "",
    ]
    for name in SENSORS:
        lines += [f"### {name}", "", *_settings(config.get(name, {})), ""]
    if run.get("sensor_units"):
        lines += ["## Mounted sensors", "", *mounted_sensors(run), ""]
        lines += ["What a sensor of a suite does not set is as in the section of its kind, above.", ""]
    if carriers := roadside_carriers(run):
        lines += ["## Beside the road", "", *carriers, ""]
    lines += [
        "## Left out",
        "",
        *([f"- {line}" for line in lacking] or ["No recorded sensor is left out."]),
        "",
        "## Licence",
        "",
        "The program is under MIT or Apache-2.0, and puts no terms on its results. Maps and demand of a scenario of",
        "your own keep the licence that you have them under; the built-in town is part of the program.",
        "",
        "## Parts",
        "",
        *(f"- `{part}`" for part in parts),
        "",
    ]
    return "\n".join(lines)


def source(recording: Recording, episode: Episode) -> dict[str, str]:
    """What a part of an export is of, for formats whose files have room for it."""
    start = recording.start
    about = {
        "caraware.run": start["run"],
        "caraware.seed": start["seed"],
        "caraware.episode": episode.number,
        "caraware.episode_seed": episode.seed,
        "caraware.config_hash": start["config_hash"],
        "caraware.schema_version": start["schema_version"],
        "caraware.program_version": start["program_version"],
    }
    return {name: str(value) for name, value in about.items()}


def _settings(values: dict[str, Any]) -> list[str]:
    return [f"- `{key}` = {value}" for key, value in values.items()]


def write_card(
    recording: Recording, directory: Path, format_name: str, meaning: str, parts: list[str], lacking: list[str]
) -> None:
    """Write `README.md` of an export (`card`)."""
    (directory / "README.md").write_text(card(recording, format_name, meaning, parts, lacking), encoding="utf-8")
