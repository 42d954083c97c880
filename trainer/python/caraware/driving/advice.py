"""SUMO's own driver as the teacher of a policy that drives: what it would have done where the policy has come to.

With `observation.fields = "advised-driver"` SUMO says, for each hero and tick, which acceleration its own driver would
have chosen. That driver knows where each vehicle goes. But it brakes late and hard, and does not see how near a person
is. So it is followed where it brakes more than the policy would, and where a slow policy could drive on and no person
is near.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from caraware.driving.lessons import Limits
from caraware.ipc.run_file import RunFile
from caraware.learn.encoders import FIELDS
from caraware.tasks.fields import Fields, UnknownFieldError

FIELD = "advised_accel"
"""The last field of "advised-driver"; all before it are those of "driver"."""
FREE_MPS2 = 1.0
"""Advised to accelerate like that, a hero may accelerate as the policy wants; half of it leaves half of the action."""
SLOW_MPS, STARTS = 1.5, 0.5
"""Below this speed a hero does what is advised, and accelerates by this action at most."""
LINE_M, GREEN = 8.0, 0.9
"""But not so near to a line whose signal is not green,"""
PERSON_M, PERSON_BESIDE_M = 12.0, 6.0
"""nor with a person so near ahead and beside the route."""
STANDS_MPS, STAYS_MPS, HOLD_MPS2 = 0.3, 0.02, -1.5
"""A hero that stands, and that is advised to, brakes like that."""

_SEEN = ("speed", "light_1_gap", "light_1_green", "person_1_ahead", "person_1_left", "person_2_ahead", "person_2_left")


@dataclass(frozen=True)
class SumoAdvice:
    """Corrects actions of heroes. Raises `UnknownFieldError` for other observations than "advised-driver"."""

    fields: Fields
    limits: Limits

    @classmethod
    def from_run(cls, run: RunFile) -> "SumoAdvice":
        """Read the fields of the observation and the limits of the vehicle. Raises `ConfigError`."""
        return cls(Fields.from_run(run), Limits.from_run(run))

    def is_there(self) -> bool:
        """Whether the observation has it."""
        return self.fields.has(FIELD)

    def of(self, observation: Tensor) -> Tensor:
        """f32 `[n]`: the acceleration that rows `[n, d]` show, m/s²: advice on the tick before theirs."""
        return self.fields.si_columns(observation, [FIELD])[:, 0].float()

    def corrected(self, observation: Tensor, action: Tensor, advised_mps2: Tensor) -> Tensor:
        """Actions f32 `[n, 2]` for rows `[n, d ≥ FIELDS]` with advice `[n]` on their tick: steering as it is."""
        does, speed = self._does(observation)
        stays = (speed < STANDS_MPS) & (speed + advised_mps2 * self.limits.tick_s < STAYS_MPS)
        accel = torch.where(stays, HOLD_MPS2, advised_mps2)
        demand = self.limits.demand(accel)
        most = torch.where(accel > 0, (accel / FREE_MPS2).clamp_max(1), demand)
        wanted = torch.where(does, demand.clamp_max(STARTS), torch.minimum(most, action[:, 1]))
        return torch.stack([action[:, 0], wanted.to(action.dtype)], 1)

    def does(self, observation: Tensor) -> Tensor:
        """bool `[n]`: so slow, and nothing near, that the hero does what is advised."""
        return self._does(observation)[0]

    def _does(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        missing = [name for name in _SEEN if not self.fields.has(name)]
        if missing:
            raise UnknownFieldError(f'no field {missing[0]!r}: set observation.fields = "advised-driver"')
        speed, gap, green, *persons = self.fields.si_columns(observation[:, :FIELDS], _SEEN).float().unbind(1)
        is_near = torch.zeros_like(speed, dtype=torch.bool)
        for ahead, left in zip(persons[::2], persons[1::2], strict=True):
            is_near |= (ahead < PERSON_M) & (left.abs() < PERSON_BESIDE_M)
        is_red = (gap < LINE_M) & (green < GREEN)
        return (speed < SLOW_MPS) & ~is_red & ~is_near, speed
