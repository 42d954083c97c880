"""The JSON documents of a run: the topics `map` and `status` (`docs/fanout.md`), commands and their answers."""

from __future__ import annotations

from typing import Literal, TypedDict


class Lane(TypedDict):
    """A lane of the map; `points_m` is its centre line, `[x, y, z]` each."""

    id: str
    kind: str
    inside: bool
    width_m: float
    right: str
    left: str
    points_m: list[list[float]]


class Area(TypedDict):
    """A junction or a walking area."""

    kind: str
    points_m: list[list[float]]


class Building(TypedDict):
    """A building, a wall or a structure; it stands on `base_m`."""

    points_m: list[list[float]]
    base_m: float
    height_m: float


class Obstacle(TypedDict):
    """A box on the ground; `center_m` is the centre of its foot."""

    center_m: list[float]
    yaw_rad: float
    size_m: list[float]


class SignalLink(TypedDict):
    """A link of a traffic light and its stop line."""

    link: int
    position_m: list[float]


class Signal(TypedDict):
    """A traffic light; `id_hash` is hexadecimal text."""

    id_hash: str
    links: list[SignalLink]


class SceneDocument(TypedDict, total=False):
    """The static scene."""

    lanes: list[Lane]
    areas: list[Area]
    buildings: list[Building]
    obstacles: list[Obstacle]
    signals: list[Signal]


class MapBounds(TypedDict):
    """Extent of the map: x_min, y_min, x_max, y_max, metres."""

    bounds_m: list[float]


class SensorUnit(TypedDict):
    """A sensor that sends messages of its own."""

    kind: str
    """Name of its kind, as in `layout.SENSORS`."""
    suite: str
    """Name of its suite; "" for that of a section of the configuration."""
    name: str


class Roadside(TypedDict):
    """A carrier that stands beside the road."""

    name: str
    suite: str


class RunMap(TypedDict, total=False):
    """The topic `map`."""

    schema_version: int
    run: str
    run_id: str
    mode: str
    task: str
    """`task.kind`: only the answers of "localisation" are positions."""
    map: MapBounds
    tick_s: float
    real_time_factor: float
    rates_hz: dict[str, float]
    """Most frames per wall second of each topic."""
    sensor_units: list[SensorUnit]
    roadsides: list[Roadside]
    scene: SceneDocument | None


class RoadUserCounts(TypedDict, total=False):
    """Road users by kind."""

    cav: int
    other: int
    person: int
    hero: int


class MetricStatus(TypedDict):
    """A metric of the task, on the samples of the newest update."""

    label: str
    unit: str
    value: float


class TrainingStatus(TypedDict, total=False):
    """Progress of learning; all numbers are 0 before the first update."""

    updates: int
    env_steps_per_s: float
    policy_std: float
    reward: float
    best_reward: float
    metrics: list[MetricStatus]


class ProcessStatus(TypedDict):
    """A process of the run."""

    name: str
    state: str
    silent_s: float
    waits_for: str


class RunStatus(TypedDict, total=False):
    """The topic `status`."""

    tick: int
    episode: int
    step: int
    evaluation: bool
    ticks_per_s: float
    real_time_factor: float
    road_users: RoadUserCounts
    training: TrainingStatus | None
    processes: list[ProcessStatus]


class CommandDone(TypedDict):
    """A command took effect at `tick`."""

    tick: int
    message: str


class CommandRefused(TypedDict, total=False):
    """A command was refused."""

    kind: str
    message: str


class CommandReply(TypedDict, total=False):
    """The answer to a command: one of the two."""

    done: CommandDone
    refused: CommandRefused


class ControlCommand(TypedDict, total=False):
    """A command as it is sent; which members it has follows from `command`."""

    command: str
    ticks: int
    vehicle: str | None
    sensor: str
    state: Literal["on", "off"]
    edge: str
