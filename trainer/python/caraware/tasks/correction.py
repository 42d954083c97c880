"""An action that corrects the newest fix: as precise on a map of 50 km as in a town, and the raw fix from the start.

The unit of a correction is the standard deviation of a fix, as the configuration gives it. The networks see older fixes
relative to the newest, in the same unit, since on a large map the normalised places of two ticks are too much alike.
Where the observation has wheel speed and compass, older fixes are carried forward by them.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from caraware.ipc.run_file import BlackoutPolicy, ConfigError, ConfigTable, RunFile, config_table, setting
from caraware.tasks.fields import Fields

METRES_PER_DEGREE = 111_320.0
SMALLEST_UNIT_M = 0.5
FURTHEST_UNITS = 10.0
"""Older fixes further away than this are cut: what they say of the newest is over."""
PLACE = ("gnss_x", "gnss_y")
MOTION = ("speed", "compass")


@dataclass(frozen=True)
class FixCorrection:
    """Corrections of the fixes in observations of one run."""

    fields: Fields
    unit_m: float
    tick_s: float

    @classmethod
    def from_run(cls, run: RunFile) -> "FixCorrection":
        """Read fields and noise. Raises `ConfigError` where the observation holds no fix."""
        fields = Fields.from_run(run)
        if not all(fields.has(name) for name in PLACE):
            raise ConfigError(
                '`task.action` = "correction" needs `gnss_x` and `gnss_y` in `observation.fields`',
                'add the fields, or set task.action = "place"',
            )
        policy = setting(run, "blackout.policy", BlackoutPolicy)
        if config_table(run, "blackout").get("enabled") and policy is BlackoutPolicy.NAN:
            raise ConfigError(
                '`task.action` = "correction" with `blackout.policy` = "nan": in a blackout there is no fix to correct',
                'set blackout.policy = "hold", or task.action = "place"',
            )
        return cls(fields, _fix_std_m(config_table(run, "gnss")), setting(run, "run.tick_s", float))

    def answer(self, action: Tensor, observation: Tensor) -> Tensor:
        """Places `[..., 2]` (m, world) of actions `[..., 2]` on rows `[n, d]`; actions are `[n, 2]` or `[n, k, 2]`."""
        fix_m = torch.stack([self.fields.si_tensor(observation, name) for name in PLACE], -1).to(action.dtype)
        return action * self.unit_m + (fix_m if action.ndim == observation.ndim else fix_m.unsqueeze(1))

    def network_input(self, observation: Tensor) -> Tensor:
        """Rows `[n, d]` as the networks take them: older fixes as the way from the newest one, in units.

        The newest fix stays where it is, so that `answer` reads the same place from both.
        """
        history, fields = self.fields.history, self.fields
        if history == 1:
            return observation
        rows = observation.unflatten(-1, (history, len(fields.names))).clone()
        moved_m = self._moved_m(observation)
        for axis, name in enumerate(PLACE):
            column = fields.names.index(name)
            low, high = fields.range(name)
            way_m = (rows[..., :-1, column] - rows[..., -1:, column]) * ((high - low) / (1.0 - fields.low))
            units = (way_m + moved_m[axis]) / self.unit_m
            rows[..., :-1, column] = units.clamp(-FURTHEST_UNITS, FURTHEST_UNITS)
        seen: Tensor = rows.flatten(-2)
        return seen

    def _moved_m(self, observation: Tensor) -> tuple[Tensor | float, Tensor | float]:
        """East and north `[n, history - 1]`: the way from each older tick to the newest, by wheel speed and compass."""
        fields = self.fields
        if not all(fields.has(name) for name in MOTION):
            return 0.0, 0.0
        rows = observation.unflatten(-1, (fields.history, len(fields.names)))
        speed, compass = (
            low + (rows[..., fields.names.index(name)] - fields.low) / (1.0 - fields.low) * (high - low)
            for name, (low, high) in ((name, fields.range(name)) for name in MOTION)
        )
        steps = (speed * self.tick_s * direction for direction in (compass.sin(), compass.cos()))
        east, north = (0.5 * (step[..., :-1] + step[..., 1:]) for step in steps)
        return _left(east), _left(north)


def _left(step: Tensor) -> Tensor:
    """Sums from each column to the last."""
    return step.flip(-1).cumsum(-1).flip(-1)


def _fix_std_m(gnss: ConfigTable) -> float:
    """Standard deviation of a fix on its worse axis: white, slow and constant errors."""

    def axis(key: str, index: int) -> float:
        value = gnss.get(key, 0.0)
        return abs(float(value[index] if isinstance(value, list) else value))

    def of(index: int) -> float:
        degrees = [axis(key, index) * METRES_PER_DEGREE for key in ("noise_std_deg", "bias_deg")]
        return math.hypot(*degrees, *(axis(key, index) for key in ("noise_std_m", "bias_m", "correlated_std_m")))

    return max(of(0), of(1), SMALLEST_UNIT_M)
