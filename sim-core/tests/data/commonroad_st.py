"""Reference trajectories of the single-track model of the package `commonroad-vehicle-models` (TUM, BSD licence).

Run it to write `commonroad_st.csv` and `commonroad_st.json` beside this file. Sine steer for 10 s at constant speed,
vehicle 2 (BMW 320i): road-wheel angle `delta(t) = A sin(2 pi f t)`, the model's input being its derivative. SI units,
radians; `x_m`, `y_m` of the centre of gravity, which starts at the origin, straight ahead along x; `beta_rad` its slip
angle. The model's tyres are linear: lateral force = friction * stiffness * slip angle * load.
"""

import csv
import json
import math
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st

FREQUENCY_HZ = 0.5
DURATION_S = 10.0
ROW_S = 0.05
TOLERANCE = 1e-11
GRAVITY_MPS2 = 9.81
# Speed, m/s -> amplitude of the road-wheel angle, rad: peaks of lateral acceleration of 2 m/s², at 5 m/s what the
# package's bound on the rate of the road-wheel angle (0.4 rad/s) admits, 1.5 m/s².
AMPLITUDE_RAD = {5.0: 0.12, 15.0: 0.0245, 30.0: 0.0071}
COLUMNS = [
    "speed_mps",
    "amplitude_rad",
    "t_s",
    "x_m",
    "y_m",
    "delta_rad",
    "v_mps",
    "psi_rad",
    "psi_dot_radps",
    "beta_rad",
]


def trajectory(speed_mps: float, amplitude_rad: float) -> np.ndarray:
    """Rows `[t, x, y, delta, v, psi, psi_dot, beta]`, one each `ROW_S`."""
    parameters = parameters_vehicle2()
    pulsation = 2.0 * math.pi * FREQUENCY_HZ

    def rates(t: float, state: np.ndarray) -> list[float]:
        inputs = [amplitude_rad * pulsation * math.cos(pulsation * t), 0.0]
        derivative: list[float] = vehicle_dynamics_st(state, inputs, parameters)
        return derivative

    times = np.linspace(0.0, DURATION_S, round(DURATION_S / ROW_S) + 1)
    start = [0.0, 0.0, 0.0, speed_mps, 0.0, 0.0, 0.0]
    found = solve_ivp(rates, (0.0, DURATION_S), start, "DOP853", times, rtol=TOLERANCE, atol=TOLERANCE, max_step=0.05)
    if not found.success:
        raise RuntimeError(found.message)
    return np.column_stack([times, found.y.T])


def rows() -> np.ndarray:
    """All rows of the table, in the order of `COLUMNS`."""
    tables = []
    for speed_mps, amplitude_rad in AMPLITUDE_RAD.items():
        table = trajectory(speed_mps, amplitude_rad)
        tables.append(np.column_stack([np.full(len(table), speed_mps), np.full(len(table), amplitude_rad), table]))
    return np.vstack(tables)


def parameters() -> dict[str, float]:
    """What the model takes from the package: its height is that of the sprung mass."""
    p = parameters_vehicle2()
    stiffness = -p.tire.p_ky1 / p.tire.p_dy1
    return {
        "mass_kg": p.m,
        "yaw_inertia_kgm2": p.I_z,
        "cg_to_front_m": p.a,
        "cg_to_rear_m": p.b,
        "height_m": p.h_s,
        "friction": p.tire.p_dy1,
        "stiffness_front_per_rad": stiffness,
        "stiffness_rear_per_rad": stiffness,
        "gravity_mps2": GRAVITY_MPS2,
        "frequency_hz": FREQUENCY_HZ,
    }


def main() -> None:
    """Writes the table and the parameters."""
    here = Path(__file__).with_suffix("")
    with open(here.with_suffix(".csv"), "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([f"{value:.10g}" for value in row] for row in rows())
    here.with_suffix(".json").write_text(json.dumps(parameters(), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
