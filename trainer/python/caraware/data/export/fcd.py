"""SUMO's floating car data (`--fcd-output`): every road user at every tick, in SUMO's own conventions."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from caraware.data.names import Kind, RoadUsers
from caraware.data.recording import Array, Episode, Recording, RecordingError


def front_m(states: Array) -> tuple[Array, Array]:
    """x and y of the front bumpers (m, world): SUMO's positions. Persons keep their centres."""
    ahead_m = np.where(states["kind"] == Kind.PERSON, 0.0, states["length_m"] - states["rear_overhang_m"])
    ahead_m = ahead_m * np.cos(states["pitch_rad"])
    return states["x_m"] + ahead_m * np.cos(states["yaw_rad"]), states["y_m"] + ahead_m * np.sin(states["yaw_rad"])


def angle_deg(yaw_rad: Array) -> Array:
    """SUMO's angle: degrees clockwise from north, from counter-clockwise radians from east."""
    angle: Array = np.mod(90.0 - np.rad2deg(yaw_rad), 360.0)
    return angle


def write_fcd(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode, from the channel `world`. Raises `RecordingError` if the recording lacks it."""
    if "world" not in recording.channels:
        raise RecordingError(f"{recording.path} has no channel 'world': record it with record.channels")
    users = RoadUsers(recording)
    headers = recording.headers("world")
    messages = np.flatnonzero(headers["episode"] == episode.number)
    with path.open("w", encoding="utf-8") as file:
        file.write('<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n')
        for message in messages:
            time_s = float(headers["sim_time_ns"][message]) * 1e-9
            file.write(f'    <timestep time="{time_s:.2f}">\n')
            states = np.asarray(recording.at("world", int(message), "states"))
            states = states[states["kind"] != Kind.TRAILING]
            (x_m, y_m), angles = front_m(states), angle_deg(states["yaw_rad"])
            speeds = np.hypot(states["velocity_body_mps"][:, 0], states["velocity_body_mps"][:, 1])
            slopes = np.rad2deg(states["pitch_rad"])
            for place, state in enumerate(states):
                user = users.of(state["id_hash"])
                tag = "person" if state["kind"] == Kind.PERSON else "vehicle"
                file.write(
                    f'        <{tag} id={quoteattr(user.id)} x="{x_m[place]:.3f}" y="{y_m[place]:.3f}" '
                    f'z="{state["z_m"]:.3f}" angle="{angles[place]:.3f}" type={quoteattr(user.type)} '
                    f'speed="{speeds[place]:.3f}" slope="{slopes[place]:.3f}"/>\n'
                )
            file.write("    </timestep>\n")
        file.write("</fcd-export>\n")
