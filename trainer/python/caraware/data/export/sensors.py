"""Names of recorded sensors in exports, what a format has no place for, and tables of them for the data card."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from caraware.data.export.frames import CHANNELS, DeliveredSensors, SensorKey, sensor_messages
from caraware.data.recording import Recording
from caraware.ipc.image import ImageShape
from caraware.ipc.mounts import OWN_SENSOR, ROADSIDE
from caraware.ipc.run_file import RunFile

Lacks = Callable[[DeliveredSensors, int], dict[SensorKey, str]]
"""The sensors of a carrier that a format has no place for, or only a part of, and why."""


def carrier_name(carrier: int) -> str:
    """Name of a carrier in directories, scenes, topics and frames: its number in the episode or beside the road."""
    return f"roadside_{carrier & ~ROADSIDE}" if carrier & ROADSIDE else f"vehicle_{carrier}"


class SensorLabels:
    """A label for each sensor, different from those of all other sensors that its carrier may have."""

    def __init__(self, run: RunFile, label: Callable[[str, str], str], reserved: Iterable[str] = ()) -> None:
        """`label` makes the label of a kind and a name; one that is taken, or is `reserved`, gets a number."""
        self._label, self._labels = label, dict[SensorKey, str]()
        taken: dict[str, set[str]] = {"": set()}
        # A vehicle may have the sensors of the sections and those of one suite.
        units: list[dict[str, Any]] = sorted(run.get("sensor_units", []), key=lambda unit: str(unit["suite"]) != "")
        for unit in units:
            kind, number, suite = str(unit["kind"]), int(unit["sensor"]), str(unit["suite"])
            others = taken[""] | taken.setdefault(suite, set()) | (set(reserved) if number != OWN_SENSOR else set())
            wanted = label(kind, str(unit["name"]))
            found, copy = wanted, 2
            while found in others:
                found, copy = f"{wanted}_{copy}", copy + 1
            taken[suite].add(found)
            self._labels[kind, number] = found

    def of(self, key: SensorKey) -> str:
        """The label of a sensor; recordings from before suites have those of the sections alone."""
        return self._labels.get(key) or self._label(key[0], key[0])


def all_lack(reason: str) -> Lacks:
    """For a format that has no place for any sensor that sends messages of its own."""
    return lambda delivered, carrier: dict.fromkeys(delivered.of[carrier], reason)


def lack_colours(delivered: DeliveredSensors, carrier: int) -> dict[SensorKey, str]:
    """For a format with the colours of images: cameras that have none, and the other planes."""
    lacking = {}
    for key in delivered.cameras(carrier):
        others = [plane for plane in delivered.of[carrier][key].planes if plane != "rgb"]
        if "rgb" not in delivered.of[carrier][key].planes:
            lacking[key] = "its images have no colours (`camera.rgb`)"
        elif others:
            lacking[key] = f"of its images only the colours, not {', '.join(others)}"
    return lacking


def omissions(recording: Recording, lacks: Lacks, *, has_observations: bool = False) -> list[str]:
    """What an export lacks, a sentence for each sensor: what has no place in the format, and what was not recorded.

    `has_observations` says that the format has observations, but not the images that may stand in them.
    """
    by_episode: dict[int, DeliveredSensors] = {}
    messages: dict[tuple[int, int, SensorKey], int] = {}
    for sensor, message in sensor_messages(recording):
        if sensor is not None:
            episode = int(message.header["episode"])
            delivered = by_episode.setdefault(episode, DeliveredSensors())
            delivered.add(sensor)
            delivered.at.clear()
            of = (episode, int(sensor.head["vehicle"]), sensor.key)
            messages[of] = messages.get(of, 0) + 1
    # Carriers and messages by sensor and reason.
    lacking: dict[tuple[str, str], tuple[set[str], int]] = {}
    for episode, delivered in by_episode.items():
        for carrier in delivered.of:
            for key, reason in lacks(delivered, carrier).items():
                mounted = delivered.of[carrier][key].mounted
                carriers, count = lacking.get((_called(key[0], mounted.sensor, mounted.suite), reason), (set(), 0))
                lacking[_called(key[0], mounted.sensor, mounted.suite), reason] = (
                    carriers | {mounted.carrier},
                    count + messages[episode, carrier, key],
                )
    lines = [
        f"{called}: {reason} ({count} messages of {', '.join(sorted(carriers)[:3])}{' …' if len(carriers) > 3 else ''})"
        for (called, reason), (carriers, count) in sorted(lacking.items())
    ]
    if has_observations and ImageShape.from_run(recording.run) is not None:
        lines.append("images in observations (`camera.observed`): an observation has its numbers alone")
    channels = {kind: channel for channel, kind in CHANNELS.items()}
    for unit in recording.run.get("sensor_units", []):
        if (channel := channels[str(unit["kind"])]) not in recording.channels:
            called = _called(str(unit["kind"]), str(unit["name"]), str(unit["suite"]))
            lines.append(f"{called}: not recorded, for `record.channels` lacks `{channel}`")
    return lines


def _called(kind: str, name: str, suite: str) -> str:
    names = {"lidar": "LIDAR", "camera": "camera", "radar": "radar"}
    return f"{names[kind]} `{name}` of suite `{suite}`" if suite else f"{names[kind]} of the section `{kind}`"


def mounted_sensors(run: RunFile) -> list[str]:
    """The lines of a Markdown table of all sensors that send messages of their own, with their mountings."""
    lines = [
        "| kind | suite | name | x, y, z (m) | roll, pitch, yaw (rad) | period (ticks) |",
        "|---|---|---|---|---|---|",
    ]
    for unit in run.get("sensor_units", []):
        place, turn = (
            ", ".join(f"{float(value):g}" for value in part) for part in (unit["mount"][:3], unit["mount"][3:])
        )
        suite = unit["suite"] or "–"
        lines.append(f"| {unit['kind']} | {suite} | {unit['name']} | {place} | {turn} | {unit['period_ticks']} |")
    return lines


def roadside_carriers(run: RunFile) -> list[str]:
    """The lines of a Markdown table of the carriers beside the road; none without one."""
    carriers: list[dict[str, Any]] = run["config"].get("roadside", [])
    if not carriers:
        return []
    lines = ["| in this export | name | suite | place |", "|---|---|---|---|"]
    for number, carrier in enumerate(carriers):
        where = {key: value for key, value in carrier.items() if key not in ("name", "suite")}
        place = ", ".join(f"`{key}` = {value}" for key, value in where.items())
        lines.append(f"| `{carrier_name(ROADSIDE | number)}` | {carrier['name']} | {carrier['suite']} | {place} |")
    return lines
