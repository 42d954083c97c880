"""Names of recorded sensors in exports, what a format has no place for, and tables of them for the data card."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from caraware.data.export.frames import CHANNELS, DeliveredSensors, SensorKey, sensor_messages
from caraware.data.recording import Recording
from caraware.ipc.image import ImageShape
from caraware.ipc.mounts import OWN_SENSOR, ROADSIDE
from caraware.ipc.run_file import RunFile


class Omission(NamedTuple):
    """What a format leaves out of a sensor of a carrier."""

    sensor: SensorKey
    reason: str
    messages: int
    """How many of its messages are concerned."""


Lacks = Callable[[DeliveredSensors, int], list[Omission]]
"""What a format leaves out of the sensors of a carrier, from the settled ticks of an episode."""


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


def left_out(delivered: DeliveredSensors, carrier: int, sensors: Iterable[SensorKey], reason: str) -> list[Omission]:
    """All messages of these sensors of a carrier are left out."""
    return [Omission(key, reason, delivered.ticks_with(carrier, [key])) for key in sensors]


def left_out_without(
    delivered: DeliveredSensors, carrier: int, sensors: Iterable[SensorKey], needed: Iterable[SensorKey], reason: str
) -> list[Omission]:
    """Messages of these sensors are left out at ticks at which one of those that are needed has not delivered."""
    needed = frozenset(needed)
    without = (
        (key, delivered.ticks_with(carrier, [key]) - delivered.ticks_with(carrier, {key} | needed)) for key in sensors
    )
    return [Omission(key, reason, count) for key, count in without if count]


def all_lack(reason: str) -> Lacks:
    """For a format that has no place for any sensor that sends messages of its own."""
    return lambda delivered, carrier: left_out(delivered, carrier, delivered.of[carrier], reason)


def lack_colours(delivered: DeliveredSensors, carrier: int) -> list[Omission]:
    """For a format with the colours of images: cameras that have none, and the other planes."""
    found = []
    for key in delivered.cameras(carrier):
        planes = delivered.of[carrier][key].planes
        others = [plane for plane in planes if plane != "rgb"]
        if "rgb" not in planes:
            found += left_out(delivered, carrier, [key], "its images have no colours (`camera.rgb`)")
        elif others:
            found += left_out(delivered, carrier, [key], f"of its images only the colours, not {', '.join(others)}")
    return found


def omissions(recording: Recording, lacks: Lacks, *, has_observations: bool = False) -> list[str]:
    """What an export lacks, a sentence for each sensor: what has no place in the format, and what was not recorded.

    `has_observations` says that the format has observations, but not the images that may stand in them.
    """
    by_episode: dict[int, DeliveredSensors] = {}
    newest = -1
    for sensor, message in sensor_messages(recording):
        if sensor is not None:
            episode = int(message.header["episode"])
            if episode > newest:
                # Ticks of an episode may be recorded after the first of the next one, those of the one before may not.
                for number in [number for number in by_episode if number < newest]:
                    by_episode[number].settle()
                newest = episode
            by_episode.setdefault(episode, DeliveredSensors()).add(sensor)
    # Carriers and messages by sensor and reason.
    lacking: dict[tuple[str, str], tuple[set[str], int]] = {}
    for delivered in by_episode.values():
        delivered.settle()
        for carrier in delivered.of:
            for omission in lacks(delivered, carrier):
                mounted = delivered.of[carrier][omission.sensor].mounted
                sentence = _called(omission.sensor[0], mounted.sensor, mounted.suite), omission.reason
                carriers, count = lacking.get(sentence, (set(), 0))
                lacking[sentence] = carriers | {mounted.carrier}, count + omission.messages
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
