"""Reference manoeuvres at the limit of the tyres, by two models of the package `commonroad-vehicle-models` (TUM, BSD).

Run it to write `limit_handling.csv` and `limit_handling.json` beside this file. Vehicle 2 (BMW 320i) in the
single-track drift model (STD) and in the multi-body model (MB, four sprung wheels with camber and compliance). Tyres:
Pacejka's magic formula with combined slip; a wet or snowy road scales the friction coefficients and leaves the
stiffness. SI units, radians; positions, `lateral_mps2` and `beta_rad` are those of the centre of gravity, which starts
at the origin along x.

The input is the same for every model, ours included (`tests/limit_handling.rs`): the road-wheel angle follows the
driver's demand at 20 1/s and at most 0.4 rad/s; the longitudinal acceleration is that of the driver at once.
"""

import copy
import csv
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from vehiclemodels.init_mb import init_mb
from vehiclemodels.init_std import init_std
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std

STEP_S = 0.002
ROW_S = 0.05
STEERING_RATE_PER_S = 20.0
MAX_ROAD_WHEEL_RATE_RADPS = 0.4
SPEED_RATE_PER_S = 3.0
PREVIEW_S = 0.45
FRICTION = {"dry": 1.0, "wet": 0.7, "snow": 0.3}


class Manoeuvre(NamedTuple):
    """One manoeuvre: what the driver wants of steering and speed."""

    kind: str
    surface: str
    speed_mps: float
    # `ramp`: rate of the road-wheel angle, rad/s; `brake`: held road-wheel angle, rad; `step`: angle, rad; else 0.
    steer: float
    # `brake`: deceleration, m/s²; else 0.
    decel_mps2: float
    duration_s: float


# `ramp`: the wheel turns slowly until the front tyres are saturated. `brake` (ISO 7975): a steady bend, then braking.
# `step` (ISO 7401): a step of the steering. `lane_change`: the track of ISO 3888-2, driven by a driver with preview.
MANOEUVRES = [
    Manoeuvre("ramp", "dry", 20.0, 0.02, 0.0, 8.0),
    Manoeuvre("ramp", "wet", 20.0, 0.02, 0.0, 6.0),
    Manoeuvre("ramp", "snow", 20.0, 0.01, 0.0, 6.0),
    Manoeuvre("brake", "dry", 22.0, 0.027, 2.0, 6.0),
    Manoeuvre("brake", "dry", 22.0, 0.027, 4.0, 6.0),
    Manoeuvre("brake", "dry", 22.0, 0.027, 6.0, 5.5),
    Manoeuvre("brake", "wet", 22.0, 0.022, 2.0, 6.0),
    Manoeuvre("brake", "wet", 22.0, 0.022, 4.0, 6.0),
    Manoeuvre("brake", "snow", 15.0, 0.016, 1.0, 6.0),
    Manoeuvre("step", "dry", 22.22, 0.02, 0.0, 5.0),
    Manoeuvre("step", "dry", 22.22, 0.03, 0.0, 5.0),
    Manoeuvre("lane_change", "dry", 12.0, 0.0, 0.0, 7.0),
    Manoeuvre("lane_change", "dry", 15.0, 0.0, 0.0, 6.0),
    Manoeuvre("lane_change", "dry", 17.0, 0.0, 0.0, 5.5),
    Manoeuvre("lane_change", "wet", 12.0, 0.0, 0.0, 7.0),
    Manoeuvre("lane_change", "wet", 15.0, 0.0, 0.0, 6.0),
    Manoeuvre("lane_change", "snow", 8.5, 0.0, 0.0, 9.0),
]
COLUMNS = [
    "manoeuvre",
    "model",
    "t_s",
    "x_m",
    "y_m",
    "psi_rad",
    "u_mps",
    "psi_dot_radps",
    "beta_rad",
    "lateral_mps2",
    "delta_rad",
]
BRAKE_AT_S = 3.0
STEP_AT_S = 0.5
# The track of ISO 3888-2: lengths of its five sections, m, before which lie 12 m of approach.
SECTIONS_M = [12.0, 13.5, 11.0, 12.5, 12.0]
APPROACH_M = 12.0


def lane_change_offset_m(width_m: float) -> float:
    """Distance between the middles of the two lanes, by the vehicle's width (ISO 3888-2, table 1)."""
    return 0.5 * (1.1 * width_m + 0.25) + 1.0 + 0.5 * (width_m + 1.0)


def lane_change_line_m(x_m: float, offset_m: float) -> float:
    """The driver's line through the track: the middles of the lanes, joined by half waves of a cosine."""
    ahead = x_m - APPROACH_M
    ends = np.cumsum(SECTIONS_M)
    if ahead < ends[0] or ahead > ends[3]:
        return 0.0
    if ahead < ends[1]:
        return 0.5 * offset_m * (1.0 - math.cos(math.pi * (ahead - ends[0]) / SECTIONS_M[1]))
    if ahead < ends[2]:
        return offset_m
    return 0.5 * offset_m * (1.0 + math.cos(math.pi * (ahead - ends[2]) / SECTIONS_M[3]))


class Motion(NamedTuple):
    """What the driver sees: position and heading of the centre of gravity, speed along the body."""

    x_m: float
    y_m: float
    psi_rad: float
    u_mps: float


def driver(
    manoeuvre: Manoeuvre, t_s: float, motion: Motion, wheelbase_m: float, offset_m: float
) -> tuple[float, float]:
    """The driver's road-wheel angle, rad, and longitudinal acceleration, m/s²."""
    accel, speed = 0.0, manoeuvre.speed_mps
    braked_s = max(t_s - BRAKE_AT_S, 0.0)
    if manoeuvre.kind == "brake":
        # The deceleration builds up in 0.2 s.
        grown = min(braked_s / 0.2, 1.0)
        accel = -manoeuvre.decel_mps2 * grown
        speed -= manoeuvre.decel_mps2 * (0.5 * 0.2 * grown * grown + max(braked_s - 0.2, 0.0))
    accel += SPEED_RATE_PER_S * (speed - motion.u_mps)
    if manoeuvre.kind == "ramp":
        return manoeuvre.steer * t_s, accel
    if manoeuvre.kind == "brake":
        return manoeuvre.steer, accel
    if manoeuvre.kind == "step":
        return (manoeuvre.steer if t_s >= STEP_AT_S else 0.0), accel
    ahead = PREVIEW_S * motion.u_mps
    aim_x = motion.x_m + ahead
    aim_y = lane_change_line_m(aim_x, offset_m) - motion.y_m
    angle = math.atan2(aim_y, ahead) - motion.psi_rad
    # Pure pursuit (R. Coulter, CMU-RI-TR-92-01).
    return math.atan(2.0 * wheelbase_m * math.sin(angle) / math.hypot(ahead, aim_y)), accel


def parameters_on(surface: str) -> Any:
    """Vehicle 2 on a surface."""
    p = copy.deepcopy(parameters_vehicle2())
    p.tire.p_dx1 *= FRICTION[surface]
    p.tire.p_dy1 *= FRICTION[surface]
    return p


def simulate(model: str, manoeuvre: Manoeuvre) -> list[list[float]]:
    """Rows from `t_s` on, one each `ROW_S`, to the end of the manoeuvre or until a wheel has lifted."""
    p = parameters_on(manoeuvre.surface)
    wheelbase_m, offset_m = p.a + p.b, lane_change_offset_m(p.w)
    start = [0.0, 0.0, 0.0, manoeuvre.speed_mps, 0.0, 0.0, 0.0]
    dynamics: Callable[[list[float], list[float], Any], list[float]]
    if model == "std":
        state, dynamics = np.array(init_std(start, p)), vehicle_dynamics_std
    else:
        state, dynamics = np.array(init_mb(start, p)), vehicle_dynamics_mb

    def motion(x: np.ndarray) -> Motion:
        return Motion(x[0], x[1], x[4], x[3] * math.cos(x[6]) if model == "std" else x[3])

    def rates(t_s: float, x: np.ndarray) -> np.ndarray:
        angle, accel = driver(manoeuvre, t_s, motion(x), wheelbase_m, offset_m)
        turning = STEERING_RATE_PER_S * (angle - x[2])
        turning = min(max(turning, -MAX_ROAD_WHEEL_RATE_RADPS), MAX_ROAD_WHEEL_RATE_RADPS)
        return np.array(dynamics(x.tolist(), [turning, accel], p))

    def row(t_s: float, x: np.ndarray) -> list[float]:
        change = rates(t_s, x)
        u = motion(x).u_mps
        if model == "std":
            beta = x[6]
            across = change[3] * math.sin(beta) + x[3] * math.cos(beta) * change[6]
        else:
            beta = math.atan2(x[10], x[3])
            across = change[10]
        return [t_s, x[0], x[1], x[4], u, x[5], beta, across + u * x[5], x[2]]

    def lifted(x: np.ndarray) -> bool:
        """Whether a wheel of the multi-body model has left the road, which that model then pulls down."""
        return model == "mb" and any(
            x[height] + p.R_w * (math.cos(x[roll]) - 1.0) < 0.5 * track * abs(math.sin(x[roll]))
            for height, roll, track in ((16, 13, p.T_f), (21, 18, p.T_r))
        )

    steps, each = round(manoeuvre.duration_s / STEP_S), round(ROW_S / STEP_S)
    found = [row(0.0, state)]
    for step in range(steps):
        # The classical Runge-Kutta method.
        t_s = step * STEP_S
        first = rates(t_s, state)
        second = rates(t_s + 0.5 * STEP_S, state + 0.5 * STEP_S * first)
        third = rates(t_s + 0.5 * STEP_S, state + 0.5 * STEP_S * second)
        fourth = rates(t_s + STEP_S, state + STEP_S * third)
        state = state + STEP_S / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
        if (step + 1) % each == 0:
            found.append(row((step + 1) * STEP_S, state))
        if lifted(state):
            break
    return found


def rows(model: str) -> list[list[str]]:
    """All rows of one model, in the order of `COLUMNS`."""
    return [
        [str(index), model, *(f"{value:.7g}" for value in values)]
        for index, manoeuvre in enumerate(MANOEUVRES)
        for values in simulate(model, manoeuvre)
    ]


def parameters() -> dict[str, object]:
    """What our model takes from the package, and the manoeuvres."""
    p = parameters_vehicle2()
    return {
        "mass_kg": p.m,
        "yaw_inertia_kgm2": p.I_z,
        "cg_to_front_m": p.a,
        "cg_to_rear_m": p.b,
        "cg_height_m": p.h_s,
        "length_m": p.l,
        "width_m": p.w,
        "friction": p.tire.p_dy1,
        "stiffness_per_rad": -p.tire.p_ky1,
        "drive_share_front": p.T_se,
        "brake_share_front": p.T_sb,
        "max_road_wheel_rate_radps": MAX_ROAD_WHEEL_RATE_RADPS,
        "steering_rate_per_s": STEERING_RATE_PER_S,
        "speed_rate_per_s": SPEED_RATE_PER_S,
        "preview_s": PREVIEW_S,
        "manoeuvres": [manoeuvre._asdict() for manoeuvre in MANOEUVRES],
    }


def main() -> None:
    """Writes the table and the parameters."""
    here = Path(__file__).with_suffix("")
    with open(here.with_suffix(".csv"), "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for model in ("std", "mb"):
            writer.writerows(rows(model))
    here.with_suffix(".json").write_text(json.dumps(parameters(), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
