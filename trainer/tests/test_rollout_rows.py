"""The rollout beside a plain one that copies every row with torch and evaluates every rule at every tick."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest
import torch
from caraware.ipc.channel import read_only_tensor
from caraware.ipc.image import ImageShape
from caraware.ipc.stream import EMPTY_SLOT
from caraware.learn.rollout import DrawnHorizon, DrawnTick, Horizon, Rollout
from synthetic import SyntheticObservation
from torch import Tensor

FIELDS, ACTIONS, LEADING = 5, 2, 2
SHAPE = ImageShape("binary", channels=1, height=2, width=3)


@dataclass(kw_only=True)
class Tick(SyntheticObservation):
    """A tick of heroes with cameras, `n` slots."""

    ends: np.ndarray
    images: Tensor

    @property
    def ended_by(self) -> np.ndarray:
        """u32 `[n]`."""
        return self.ends


class PlainRollout:
    """The rules of `Rollout`, one after the other, on buffers of a fixed number of ticks."""

    def __init__(self, *, bootstrap: bool, dark_is_nan: bool, drawn_actions: int, images: ImageShape | None) -> None:
        self.bootstrap, self.dark_is_nan, self.actions, self.shape = bootstrap, dark_is_nan, drawn_actions, images
        self.slots, self.ticks, self.taken, self.last_tick = 1, 0, 0, -1
        self.cut = np.zeros(0, bool)
        self.buffers = self.empty(16, 1)

    def empty(self, ticks: int, slots: int) -> dict[str, Tensor]:
        """Buffers without a tick. Row `t` of each is a tick, of images after room for those before."""
        wide = slots if self.actions else 0
        buffers = {
            "observation": torch.zeros(ticks, slots, FIELDS),
            "truth": torch.zeros(ticks, slots, 4),
            "vehicle": torch.full((ticks, slots), EMPTY_SLOT),
            "valid": torch.zeros(ticks, slots, dtype=torch.bool),
            "terminated": torch.zeros(ticks, slots, dtype=torch.bool),
            "truncated": torch.zeros(ticks, slots, dtype=torch.bool),
            "tick": torch.zeros(ticks, dtype=torch.int64),
            "action": torch.zeros(ticks, wide, self.actions),
            "log_probability": torch.zeros(ticks, wide),
            "ended_by": torch.zeros(ticks, wide, dtype=torch.int64),
        }
        if self.shape is not None:
            buffers["images"] = torch.zeros(LEADING + ticks, slots, *self.shape.size, dtype=torch.uint8)
        return buffers

    def grow(self, ticks: int, slots: int) -> None:
        """More ticks or slots, with what is there."""
        old, self.buffers = self.buffers, self.empty(ticks, slots)
        for name, buffer in self.buffers.items():
            used = self.ticks + LEADING * (name == "images")
            part = buffer[:used] if buffer.ndim == 1 else buffer[:used, : old[name].shape[1]]
            part.copy_(old[name][:used])
        self.slots = slots

    def add(self, obs: Tick, drawn: DrawnTick | None) -> None:
        """See `Rollout.add`."""
        self.ended(obs)
        b, n = self.buffers, len(obs.vehicle)
        if n > self.slots:
            self.grow(len(b["tick"]), n)
        if not obs.valid.any():
            return
        if self.ticks == len(self.buffers["tick"]):
            self.grow(2 * self.ticks, self.slots)
        b, t = self.buffers, self.ticks
        if t == 0:
            self.cut = obs.terminated | obs.truncated
        b["observation"][t, :n] = obs.observation
        if self.dark_is_nan:
            b["observation"][t, :n].nan_to_num_()
        b["truth"][t, :n] = obs.truth
        b["vehicle"][t] = EMPTY_SLOT
        b["vehicle"][t, :n] = torch.from_numpy(obs.vehicle.astype(np.int64))
        b["valid"][t] = False
        b["valid"][t, :n] = torch.from_numpy(obs.valid)
        b["terminated"][t] = b["truncated"][t] = False
        b["ended_by"][t] = 0
        b["tick"][t] = obs.tick
        if self.shape is not None:
            b["images"][LEADING + t] = 0
            b["images"][LEADING + t, : len(obs.images)] = obs.images
        if drawn is not None:
            b["action"][t, :n], b["log_probability"][t, :n] = drawn.action, drawn.log_probability
        if t > 0:
            went_on = (b["vehicle"][t] == b["vehicle"][t - 1]) & b["valid"][t]
            b["truncated"][t - 1] |= b["valid"][t - 1] & ~went_on & ~b["terminated"][t - 1]
        self.ticks, self.last_tick = t + 1, obs.tick

    def ended(self, obs: Tick) -> None:
        """See `Rollout.ended`."""
        if self.taken:
            left = self.ticks - self.taken
            for name, buffer in self.buffers.items():
                first = LEADING * (name == "images")
                buffer[first : first + left] = buffer[first + self.taken : first + self.ticks].clone()
            self.ticks, self.taken, self.cut = left, 0, np.zeros(0, bool)
        if self.ticks == 0:
            return
        b, t, n = self.buffers, self.ticks - 1, min(len(obs.vehicle), self.slots)
        if obs.tick == self.last_tick + 1:
            terminated, truncated = (torch.from_numpy(each[:n]) for each in (obs.terminated, obs.truncated))
            b["terminated"][t, :n] |= terminated
            b["truncated"][t, :n] |= truncated & ~terminated
            if self.actions:
                b["ended_by"][t, :n] = torch.from_numpy(obs.ended_by[:n].astype(np.int64))
        elif obs.tick != self.last_tick:
            b["truncated"][t] |= ~b["terminated"][t]

    def take(self) -> Horizon:
        """See `Rollout.take`."""
        b, end = self.buffers, self.ticks - self.bootstrap
        self.taken = end
        drawn = None
        if self.actions:
            held = DrawnTick(int(b["tick"][end]), b["action"][end].clone(), b["log_probability"][end].clone())
            drawn = DrawnHorizon(
                action=b["action"][:end],
                log_probability=b["log_probability"][:end],
                ended_by=b["ended_by"][:end].clone(),
                truth_after=b["truth"][end].clone(),
                held=held,
            )
        copied = ("vehicle", "tick", "valid", "terminated", "truncated")
        return Horizon(
            observation=b["observation"][:end],
            truth=b["truth"][:end],
            **{name: b[name][:end].clone() for name in copied},
            cut=torch.from_numpy(np.pad(self.cut, (0, self.slots - len(self.cut)))),
            bootstrap=b["observation"][end].clone() if self.bootstrap else None,
            drawn=drawn,
            images=b["images"][: LEADING + end] if self.shape else None,
        )


class Street:
    """Random ticks: vehicles come, go and change slots, rows go dark, ticks are missing, slots grow."""

    def __init__(self, seed: int, slots: int) -> None:
        self.rng, self.slots, self.tick = np.random.default_rng(seed), slots, 0
        self.vehicle = np.full(slots, EMPTY_SLOT, np.uint32)
        self.vehicles = 0

    def next(self) -> Tick:
        """The next tick; now and then with fewer or more slots, or none that is valid."""
        rng = self.rng
        self.tick += 1 if rng.random() < 0.9 else int(rng.integers(1, 4))
        if rng.random() < 0.03:
            self.slots += int(rng.integers(1, 4))
        quiet = rng.random() < 0.5
        self.vehicle = np.append(self.vehicle, np.full(self.slots - len(self.vehicle), EMPTY_SLOT, np.uint32))
        for slot in range(self.slots) if not quiet else ():
            if rng.random() < 0.1:
                self.vehicles += 1
                self.vehicle[slot] = self.vehicles
            elif rng.random() < 0.1:
                self.vehicle[slot] = EMPTY_SLOT
        n = self.slots if rng.random() < 0.9 else int(rng.integers(1, self.slots + 1))
        valid = self.vehicle[:n] != EMPTY_SLOT
        if not quiet:
            valid &= rng.random(n) < (0.0 if rng.random() < 0.1 else 0.9)
        flagged = np.zeros((2, n), bool) if quiet else rng.random((2, n)) < 0.1
        observation = rng.standard_normal((n, FIELDS)).astype(np.float32)
        observation[rng.random(n) < 0.1, 0] = rng.choice([np.nan, np.inf, -np.inf])
        seen = int(rng.integers(0, n + 1))
        return Tick(
            tick=self.tick,
            observation=self.lent(observation),
            truth=self.lent(rng.standard_normal((n, 4)).astype(np.float32)),
            gnss_m=torch.zeros(n, 2),
            vehicle=self.vehicle[:n].copy(),
            valid=valid,
            terminated=flagged[0],
            truncated=flagged[1],
            ends=np.where(flagged.any(0), rng.integers(0, 2**32, n), 0).astype(np.uint32),
            images=self.lent(rng.integers(0, 256, (seen, *SHAPE.size), np.uint8)),
        )

    def lent(self, array: np.ndarray) -> Tensor:
        """Over memory that must not be written, a view of such a tensor, or an ordinary tensor."""
        kind = self.rng.integers(3)
        if kind == 0:
            return torch.from_numpy(array)
        return read_only_tensor(array) if kind == 1 else read_only_tensor(array)[:]

    def drawn(self, obs: Tick) -> DrawnTick:
        """Actions for a tick."""
        n, draw = len(obs.vehicle), self.rng.standard_normal
        numbers = torch.from_numpy(draw((n, ACTIONS + 1)).astype(np.float32))
        return DrawnTick(obs.tick, numbers[:, :ACTIONS], numbers[:, ACTIONS])


def same(found: Any, expected: Any) -> None:
    """Both hold the same bits in the same shapes and types."""
    if isinstance(expected, Horizon | DrawnHorizon | DrawnTick):
        for each in fields(expected):
            same(getattr(found, each.name), getattr(expected, each.name))
    elif isinstance(expected, Tensor):
        assert (type(found), found.dtype, found.shape) == (Tensor, expected.dtype, expected.shape)
        assert found.contiguous().numpy().tobytes() == expected.contiguous().numpy().tobytes()
    else:
        assert found == expected


@pytest.mark.parametrize("seed", range(40))
def test_horizons_are_those_of_the_plain_rollout(seed: int) -> None:
    rng = np.random.default_rng(1000 + seed)
    draws, sees = bool(seed & 1), bool(seed & 2)
    bootstrap, dark_is_nan = draws or bool(seed & 4), bool(seed & 8)
    options: dict[str, Any] = {"bootstrap": bootstrap, "dark_is_nan": dark_is_nan}
    options |= {"drawn_actions": ACTIONS if draws else 0, "images": SHAPE if sees else None}
    size = int(rng.integers(1, 120))
    rollout, plain = Rollout(size, FIELDS, leading=LEADING, **options), PlainRollout(**options)
    street, horizons = Street(seed, slots=int(rng.integers(1, 9))), 0
    for _ in range(300):
        obs = street.next()
        if rng.random() < 0.05:
            # A tick of an evaluation.
            rollout.ended(obs)
            plain.ended(obs)
            continue
        drawn = street.drawn(obs) if draws else None
        rollout.add(obs, drawn)
        plain.add(obs, drawn)
        if rollout.full():
            taken, expected = rollout.take(), plain.take()
            same(taken, expected)
            horizons += 1
    assert horizons > 1
