"""The HUD: a text with the figures of the run and of the followed vehicles. Pure functions of the newest state."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from caraware_viewer import wire
from caraware_viewer.detail import sampling_order
from caraware_viewer.documents import ProcessStatus, RunMap, RunStatus, TrainingStatus
from caraware_viewer.layout import SENSORS
from caraware_viewer.messages import SOURCES
from caraware_viewer.pairing import mean_m
from caraware_viewer.picture import Picture

KMH = 3.6
MAX_VEHICLES = 40
"""Most rows of the table of errors; the followed vehicles come first."""

_COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
_NO_VALUE = "–"


@dataclass(frozen=True)
class ViewerFigures:
    """Figures of the viewer itself."""

    frames_per_s: float = math.nan
    """Ticks drawn per wall second."""
    age_ms: float = math.nan
    """Age of the newest tick when it was drawn; NaN if the clocks of both machines differ."""
    lost: int = 0
    """Samples that were lost on the network."""
    refused: int = 0
    """Samples that were refused."""
    skipped: int = 0
    """Samples that were not drawn because newer ones had arrived."""
    memory_mb: float = math.nan
    """Memory of the viewer's process, MB."""
    display_mb: float = math.nan
    """Memory of rerun's process: the window, or the server for browsers, MB."""


def hud(picture: Picture, run_map: RunMap, followed: Sequence[int], viewer: ViewerFigures) -> str:
    """The whole text, as Markdown."""
    blocks = [_run(picture, run_map, viewer)]
    blocks += [_vehicle(picture, id_hash) for id_hash in followed[:4]]
    blocks.append(_errors(picture, followed))
    return "\n\n".join(block for block in blocks if block)


def hanging(status: RunStatus) -> list[ProcessStatus]:
    """The processes of the run that have given no sign of life for `run.stall_s`."""
    return [process for process in status.get("processes") or () if process["state"] == "stalled"]


def _run(picture: Picture, run_map: RunMap, viewer: ViewerFigures) -> str:
    status = picture.status
    training = status.get("training") or TrainingStatus()
    title = f"#### {_escaped(str(run_map.get('run', 'run')))} · {run_map.get('mode', '')}"
    title += " · evaluation" if status.get("evaluation") else ""
    rows = [
        ("episode", _text(status.get("episode")) + f" · step {_text(status.get('step'))}"),
        ("time", f"{_clock(_sim_time_s(picture, run_map))} in total · {_episode_s(picture):.1f} s in this episode"),
        ("simulation", _speed(status, training)),
        ("road users", _counts(picture, run_map)),
        ("sensors on", _sensors(picture)),
    ]
    rows += [
        ("hangs", f"{process['name']}: no sign of life for {process['silent_s']:.0f} s") for process in hanging(status)
    ]
    if training.get("updates"):
        best = training.get("best_reward")
        rows.append(("reward", f"{_number(training.get('reward'), 3)} now · {_number(best, 3)} best"))
        rows.append(("policy", f"σ {_number(training.get('policy_std'), 3)} · {training['updates']} updates"))
    for metric in training.get("metrics") or ():
        rows.append((metric["label"], f"{metric['value']:.2f} {metric['unit']} in the newest update"))
    if picture.distances is not None:
        d = picture.distances
        means = (
            f"policy {_metres(mean_m(d.policy))} · EKF {_metres(mean_m(d.ekf))} · GNSS {_metres(mean_m(d.raw_gnss))}"
        )
        rows.append(("mean error", means))
    if picture.collisions:
        rows.append(("contacts", f"{picture.collisions} since this viewer joined"))
    rows.append(("viewer", _viewer(viewer)))
    if math.isfinite(viewer.memory_mb):
        rows.append(("memory", _memory(viewer)))
    if picture.thinned:
        rows.append(("shown", picture.thinned))
    return title + "\n" + _table(rows[0], rows[1:])


def _memory(viewer: ViewerFigures) -> str:
    parts = [f"viewer {viewer.memory_mb:.0f} MB"]
    parts += [f"display {viewer.display_mb:.0f} MB"] if math.isfinite(viewer.display_mb) else []
    return " · ".join(parts)


def _speed(status: RunStatus, training: TrainingStatus) -> str:
    parts = []
    if training.get("env_steps_per_s"):
        parts.append(f"{training['env_steps_per_s']:,.0f} samples/s".replace(",", " "))
    if status.get("ticks_per_s") is not None:
        parts.append(f"{status['ticks_per_s']:.0f} ticks/s")
    if status.get("real_time_factor") is not None:
        parts.append(f"{status['real_time_factor']:.1f} × real time")
    return " · ".join(parts) or _NO_VALUE


def _counts(picture: Picture, run_map: RunMap) -> str:
    if picture.world is None:
        return _NO_VALUE
    of_kind = picture.road_users()
    counts = [(wire.HERO, "heroes"), (wire.CAV, "CAV"), (wire.OTHER, "others"), (wire.PERSON, "pedestrians")]
    parts = [f"{of_kind[kind]} {name}" for kind, name in counts if of_kind[kind] or kind != wire.HERO]
    scene = run_map.get("scene")
    obstacles = 0 if scene is None else len(scene.get("obstacles", []))
    return " · ".join([*parts, f"{obstacles} obstacles"])


def _sensors(picture: Picture) -> str:
    if picture.observation is None:
        return _NO_VALUE
    held = picture.observation.vehicle != wire.EMPTY_SLOT
    sensors = picture.observation.sensors[held]
    return " · ".join(f"{sensor.label} {int((sensors & sensor.bit != 0).sum())}" for sensor in SENSORS)


def _viewer(viewer: ViewerFigures) -> str:
    parts = [f"{_number(viewer.frames_per_s, 1)} frames/s", f"{_number(viewer.age_ms, 0)} ms old"]
    parts += [f"{viewer.lost} lost"] if viewer.lost else []
    parts += [f"{viewer.refused} refused"] if viewer.refused else []
    parts += [f"{viewer.skipped} skipped"] if viewer.skipped else []
    return " · ".join(parts)


def _vehicle(picture: Picture, id_hash: int) -> str:
    """Speed, steering, heading, accelerations and rates as the sensors measure them; without sensors, the true ones."""
    row, slot = picture.row(id_hash), picture.slot(id_hash)
    if row is None:
        return ""
    if picture.observation is not None and slot is not None and picture.observation.imu.shape[1]:
        speed_mps, steering_rad = (float(value) for value in picture.observation.speed_steering[slot])
        newest = picture.observation.imu[slot, -1]
        accel, rate, compass_rad = newest[:3], newest[3:6], float(newest[6])
        source, steering = "sensed", "steering wheel"
    else:
        speed_mps, steering_rad = float(np.hypot(*row["velocity_body_mps"][:2])), float(row["road_wheel_angle_rad"])
        accel, rate = row["accel_body_mps2"], row["angular_rate_body_radps"]
        compass_rad = (math.pi / 2 - float(row["yaw_rad"])) % (2 * math.pi)
        source, steering = "true", "road wheels"
    rows = [
        ("speed", f"{speed_mps * KMH:.1f} km/h"),
        (steering, f"{math.degrees(steering_rad):+.1f}°"),
        ("heading", f"{math.degrees(compass_rad):.1f}° {compass_letters(compass_rad)}"),
        ("acceleration", _vector(accel, "m/s²")),
        ("rates", _vector(np.degrees(rate), "°/s")),
    ]
    # First: they were asked for.
    rows = [*_radio(picture, int(row["vehicle"])), *rows]
    return f"#### {_escaped(picture.name(id_hash))} ({source})\n" + _table(rows[0], rows[1:])


def _radio(picture: Picture, vehicle: int) -> list[tuple[str, str]]:
    """What a vehicle's radio did in the tick before, and how it knows others, if messages are shown."""
    neighbours = picture.neighbours
    slot = None if neighbours is None else neighbours.slot_of(vehicle)
    if neighbours is None or slot is None:
        return []
    _, known, sent, sent_bytes, received = (int(number) for number in neighbours.radio[slot])
    busy = f"channel {100 * float(neighbours.channel_load[slot]):.0f} % busy"
    counts = np.bincount(neighbours.known_in(slot)[1][:, 2], minlength=len(SOURCES))
    listed = [f"{name} {count}" for name, count in zip(SOURCES[1:], counts[1:], strict=False) if count]
    radio = f"{sent} sent ({sent_bytes} B) · {received} received · {busy}"
    # Each station's view of an object is one; what is sent and drawn is the nearest objects.
    return [("radio", radio), ("knows", " · ".join([f"{known} views of objects", *listed]))]


def compass_letters(compass_rad: float) -> str:
    """N, NE, E, … of a compass angle, clockwise from north."""
    return _COMPASS[round(math.degrees(compass_rad) / 45) % 8]


def _errors(picture: Picture, followed: Sequence[int]) -> str:
    """The table of each vehicle's errors: the followed ones first; of many, the same ones in every tick."""
    observation, distances = picture.observation, picture.distances
    if observation is None or distances is None:
        return ""
    slots = np.flatnonzero(observation.valid)
    if not len(slots):
        return ""
    order = sampling_order(observation.id_hash)
    chosen = sorted(slots.tolist(), key=lambda slot: (int(observation.id_hash[slot]) not in followed, order[slot]))
    names = {slot: picture.name(int(observation.id_hash[slot])) for slot in chosen[:MAX_VEHICLES]}
    ordered = sorted(names, key=lambda slot: (int(observation.id_hash[slot]) not in followed, names[slot]))
    rows = [
        (
            names[slot],
            *(_NO_VALUE if d is None else _number(float(d[slot]), 2) for d in (distances.policy, distances.ekf)),
            _number(float(distances.raw_gnss[slot]), 2),
        )
        for slot in ordered
    ]
    rest = f"\n\n… and {len(slots) - MAX_VEHICLES} more" if len(slots) > MAX_VEHICLES else ""
    return "#### error (m)\n" + _table(("vehicle", "policy", "EKF", "GNSS"), rows) + rest


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(_escaped(cell) for cell in line) + " |" for line in lines)


def _escaped(cell: str) -> str:
    """Text for a cell of a Markdown table; ids may hold any characters."""
    return cell.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ").replace("<", "\\<").replace("`", "\\`")


def _sim_time_s(picture: Picture, run_map: RunMap) -> float:
    if picture.world is None:
        return 0.0
    return (picture.world.header.tick + 1) * float(run_map["tick_s"])


def _episode_s(picture: Picture) -> float:
    return 0.0 if picture.world is None else picture.world.header.sim_time_ns * 1e-9


def _clock(seconds: float) -> str:
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours:02d}:{minute:02d}:{second:02d}"


def _text(value: object) -> str:
    return _NO_VALUE if value is None else str(value)


def _number(value: float | None, digits: int) -> str:
    return _NO_VALUE if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _metres(value: float) -> str:
    return f"{value:.2f} m" if math.isfinite(value) else _NO_VALUE


def _vector(values: Iterable[float], unit: str) -> str:
    return " ".join(f"{float(value):+.2f}" for value in values) + f" {unit}"
