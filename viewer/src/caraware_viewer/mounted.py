"""Which mounted sensors a viewer shows: those that its options name, else those of the followed vehicle."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from caraware_viewer.documents import RunMap
from caraware_viewer.link import LinkError, encoded

OFF = "off"
"""What an option says to show none."""


@dataclass(frozen=True)
class MountedKind:
    """A kind of sensors that sends messages of its own."""

    kind: str
    """Its name, as in `layout.SENSORS`."""
    topic: str
    """Beginning of its topics; the carrier's id follows, with `@` and the sensor's name if it is of a suite."""

    def topic_of(self, name: str) -> str:
        """The topic of the sensor `ID` or `ID@SENSOR`."""
        return f"{self.topic}/{encoded(name)}"

    def has(self, topic: str) -> bool:
        """True for the topics of this kind."""
        return topic.startswith(self.topic + "/")


LIDAR = MountedKind("lidar", "pointcloud")
CAMERA = MountedKind("camera", "image")
RADAR = MountedKind("radar", "radar")


def carrier_of(name: str) -> str:
    """The carrier's id in `ID` or `ID@SENSOR`."""
    return name.rpartition("@")[0] or name


def names_on(kind: MountedKind, carrier: str, run_map: RunMap) -> list[str]:
    """Names that the main sensor of this kind on a carrier may have: that of a section, else the first of its suite.

    The map does not say which suite a vehicle carries; there is no message under the other names.
    """
    if "sensor_units" not in run_map:
        return [carrier]
    units = [unit for unit in run_map["sensor_units"] if unit["kind"] == kind.kind]
    first: dict[str, str] = {}
    for unit in units:
        first.setdefault(unit["suite"], f"{carrier}@{unit['name']}" if unit["suite"] else carrier)
    return list(first.values())


def check_choices(kind: MountedKind, names: Iterable[str], run_map: RunMap) -> None:
    """Raises `LinkError` if the run has no such sensor, or does not publish its messages."""
    names = list(names)
    if not names:
        return
    option = f"--{kind.kind} {names[0]}"
    if run_map.get("rates_hz", {}).get(kind.topic, 1.0) <= 0.0:
        raise LinkError(f"{option}: the run publishes no `{kind.topic}`: its `fanout.{kind.topic}_hz` is 0")
    units = [unit for unit in run_map.get("sensor_units", []) if unit["kind"] == kind.kind]
    if not units:
        raise LinkError(
            f"{option}: nothing in the run carries a {kind.kind}: "
            f"start it with --set {kind.kind}.vehicles=2, or with a suite that has one"
        )
    suites = {roadside["name"]: roadside["suite"] for roadside in run_map.get("roadsides", [])}
    for name in names:
        carrier, _, sensor = name.rpartition("@")
        possible = [
            unit for unit in units if carrier_of(name) not in suites or unit["suite"] == suites[carrier_of(name)]
        ]
        known = [f"@{unit['name']}" if unit["suite"] else "no @" for unit in possible]
        if (f"@{sensor}" if carrier else "no @") not in known:
            choices = ", ".join(dict.fromkeys(known)) or "none there"
            raise LinkError(f"--{kind.kind} {name}: there is no such {kind.kind}; names behind the id: {choices}")


def carriers(names: Sequence[str], run_map: RunMap) -> list[str]:
    """Ids of the vehicles among the carriers of these sensors, each once."""
    beside_the_road = {roadside["name"] for roadside in run_map.get("roadsides", [])}
    ids = dict.fromkeys(carrier_of(name) for name in names)
    return [carrier for carrier in ids if carrier not in beside_the_road]
