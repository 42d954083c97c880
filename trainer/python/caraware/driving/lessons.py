"""What the clone of a driver is taught: the teacher's actions, and how to get back to where the teacher drives.

SUMO's drivers never leave the middle of their lane, so what they do shows no way back to it, and a clone that is taught
their places alone drifts off within seconds (Ross et al., arXiv 1011.0686). The lessons move the hero aside in the
numbers of an observation, turn it, and change its speed; the taught action leads back, as in Bansal et al., arXiv
1812.03079.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from caraware.ipc.run_file import RunFile, config_table, setting
from caraware.tasks.fields import Fields

WHEELBASE_M = 2.7
"""Of a passenger car: the steering follows from speed and yaw rate by the single-track model without slip."""
STEERING_FROM_MPS = 1.0
"""Below it a yaw rate does not show the steering: such a pair teaches 0."""
AHEAD_S = 1.0
"""The acceleration that is taught is the mean over so long: SUMO's drivers dawdle at random from step to step."""
STANDS_MPS, HOLD_MPS2 = 0.3, -0.5
"""A teacher that stands and will still stand brakes: a demand of 0 would let the clone creep."""
ASIDE_M, TURNED_RAD, FASTER_MPS = 0.4, 0.1, 1.0
"""Standard deviations of how a hero is displaced: to the left, in heading, and in speed."""
PURSUIT_S, NEAREST_M, FARTHEST_M = 0.7, 5.0, 15.0
"""The steering that is taught leads to the place of the route that is `PURSUIT_S` ahead, within these distances."""
ROUTE_M = (5, 10, 20, 40)
USERS = 8


@dataclass(frozen=True)
class Limits:
    """What an action of 1 stands for."""

    accel_mps2: float
    decel_mps2: float
    angle_rad: float
    tick_s: float

    @classmethod
    def from_run(cls, run: RunFile) -> "Limits":
        """Of the run's vehicles."""
        vehicle = config_table(run, "vehicle")
        angle = float(vehicle["max_road_wheel_angle_rad"])
        limits = float(vehicle["max_accel_mps2"]), float(vehicle["max_decel_mps2"]), angle
        return cls(*limits, setting(run, "run.tick_s", float))

    @property
    def ahead_ticks(self) -> int:
        """Ticks between the two ends of a pair."""
        return max(1, round(AHEAD_S / self.tick_s))

    def action(self, before: Tensor, after: Tensor, later: Tensor) -> Tensor:
        """The actions f32 `[n, 2]` that lead from truth `[n, 4]` to that of the tick after, and on to that later.

        Steering is what the first tick shows, acceleration the mean until the last one.
        """
        turned_rad = after[:, 2] - before[:, 2]
        yaw_rate = torch.atan2(turned_rad.sin(), turned_rad.cos()) / self.tick_s
        angle_rad = torch.atan(WHEELBASE_M * yaw_rate / after[:, 3].clamp_min(STEERING_FROM_MPS))
        steering = torch.where(after[:, 3] > STEERING_FROM_MPS, angle_rad / self.angle_rad, 0.0)
        accel_mps2 = (later[:, 3] - before[:, 3]) / (self.ahead_ticks * self.tick_s)
        stands = torch.maximum(before[:, 3], later[:, 3]) < STANDS_MPS
        demand = self.demand(torch.where(stands, HOLD_MPS2, accel_mps2))
        return torch.stack((steering.clamp(-1, 1), demand), 1)

    def demand(self, accel_mps2: Tensor) -> Tensor:
        """The action for an acceleration, within its range."""
        return (accel_mps2 / torch.where(accel_mps2 > 0, self.accel_mps2, self.decel_mps2)).clamp(-1, 1)

    def accel_of(self, demand: Tensor) -> Tensor:
        """The acceleration of an action."""
        return demand * torch.where(demand > 0, self.accel_mps2, self.decel_mps2)


class Lessons:
    """Displaces heroes in rows of observations. Groups of fields that a row lacks stay as they are."""

    def __init__(self, fields: Fields, limits: Limits) -> None:
        self._fields, self._limits = fields, limits
        places = {name: number for number, name in enumerate(fields.names)}
        self._at = places if fields.history == 1 else {}

    def displaced(self, observation: Tensor, action: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Observations `[n, d]` as they were if each hero stood aside, and the actions `[n, 2]` for them."""
        if not {"route_offset", "speed", "steering", *(f"route_{xy}_{d}" for xy in "xy" for d in ROUTE_M)} <= {
            *self._at
        }:
            return observation, action
        aside_m, turned_rad, faster_mps = torch.randn(3, len(action), generator=generator).double()
        speed_mps = self._get(observation, "speed")
        moves = (speed_mps > STANDS_MPS).double()
        aside_m, turned_rad = ASIDE_M * aside_m, TURNED_RAD * turned_rad
        faster_mps = torch.maximum(FASTER_MPS * faster_mps * moves, -speed_mps)
        sin, cos = turned_rad.sin(), turned_rad.cos()
        rows = observation.clone()

        def turned(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
            return cos * x + sin * y, cos * y - sin * x

        def move(x_name: str, y_name: str, shift_m: Tensor | float) -> None:
            x, y = turned(self._get(observation, x_name), self._get(observation, y_name) - shift_m)
            self._set(rows, x_name, x)
            self._set(rows, y_name, y)

        for distance_m in ROUTE_M:
            move(f"route_x_{distance_m}", f"route_y_{distance_m}", aside_m)
        self._set(rows, "route_offset", self._get(observation, "route_offset") - aside_m)
        for number in range(1, USERS + 1):
            if (name := f"user_{number}") + "_x" in self._at:
                # A place without a user stays as it is.
                is_there = (self._get(observation, f"{name}_length") > 0).unsqueeze(1)
                before = rows.clone()
                move(f"{name}_x", f"{name}_y", aside_m)
                move(f"{name}_cos", f"{name}_sin", 0.0)
                move(f"{name}_forward", f"{name}_left", 0.0)
                rows = torch.where(is_there, rows, before)
        self._set(rows, "speed", speed_mps + faster_mps)
        # A steering that shows what the teacher does would be copied, and the road not looked at.
        shuffled = torch.randperm(len(rows), generator=generator)
        rows[:, self._at["steering"]] = observation[shuffled, self._at["steering"]]
        ahead_s = self._limits.ahead_ticks * self._limits.tick_s
        accel_mps2 = self._limits.accel_of(action[:, 1].double()) - faster_mps / ahead_s
        return rows, torch.stack((self.steering(rows), self._limits.demand(accel_mps2)), 1).float()

    def steering(self, rows: Tensor) -> Tensor:
        """f64 `[n]`: the steering of pure pursuit along the route that rows `[n, d]` show."""
        ahead_m = (PURSUIT_S * self._get(rows, "speed")).clamp(NEAREST_M, FARTHEST_M)
        share = (ahead_m / 5 - 1).clamp(0, 1), (ahead_m / 10 - 1).clamp(0, 1)

        def place(axis: str) -> Tensor:
            near, middle, far = (self._get(rows, f"route_{axis}_{distance_m}") for distance_m in ROUTE_M[:3])
            return near + share[0] * (middle - near) + share[1] * (far - middle)

        x, y = place("x"), place("y")
        angle_rad = torch.atan(2 * WHEELBASE_M * y / (x.square() + y.square()).clamp_min(1.0))
        return (angle_rad / self._limits.angle_rad).clamp(-1, 1)

    def _get(self, rows: Tensor, name: str) -> Tensor:
        return self._fields.si_tensor(rows, name)

    def _set(self, rows: Tensor, name: str, values: Tensor) -> None:
        low, high = self._fields.range(name)
        unit = (values.clamp(low, high) - low) / (high - low)
        rows[:, self._at[name]] = (self._fields.low + unit * (1.0 - self._fields.low)).float()
