"""Stacks of images: what a slot's camera saw at the newest ticks of its trajectory.

Every image is kept once, in the rollout's buffer. A stack is a row of places in that buffer, so neighbouring samples
share their images; they are brought together when a minibatch is. Where a trajectory is younger than the stack, its
first image stands for the missing ones. A stack reaches back over ticks that follow one another, at which the slot's
row was valid: the rules by which `caraware.learn.rollout` ends trajectories.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from caraware.ipc.image import ImageShape
from caraware.ipc.stream import EMPTY_SLOT, LearningTick, SeeingTick
from caraware.learn.rollout import Horizon


class Seen(NamedTuple):
    """What a network that sees takes of some samples."""

    rows: Tensor
    """f32 `[b, d]`: the observation's fields."""
    stacks: Tensor
    """u8 `[b, frames * channels, height, width]`, the oldest image first."""


class Stacks(NamedTuple):
    """Stacks that are not brought together yet."""

    frames: Tensor
    """u8 `[f, channels, height, width]`: images of all slots and ticks, a view."""
    places: Tensor
    """i64 `[b, frames]`: where the images of each stack are among them, the oldest first."""

    def of(self, rows: Tensor) -> Tensor:
        """u8 `[r, frames * channels, height, width]`: those of some rows, a copy."""
        places = self.places[rows]
        # No size is left to be deduced: a tick without vehicles has none of its numbers.
        channels = places.shape[1] * self.frames.shape[1]
        return self.frames.index_select(0, places.flatten()).view(len(rows), channels, *self.frames.shape[2:])


@dataclass(frozen=True)
class RecentFrames:
    """The images of the slots of an environment up to one tick: the stacks of later ticks reach back to them."""

    tick: Tensor
    """i64 `[]`; -1 before the first."""
    vehicle: Tensor
    """i64 `[N]`: the vehicle in the slot, `EMPTY_SLOT` where no trajectory continues."""
    depth: Tensor
    """i64 `[N]`: how many of the images below are of that trajectory."""
    frames: Tensor
    """u8 `[frames - 1, N, channels, height, width]`, the oldest first."""

    @classmethod
    def nothing(cls, shape: ImageShape, frames: int) -> "RecentFrames":
        """Before the first tick, for stacks of so many `frames`."""
        none = torch.zeros(0, dtype=torch.int64)
        return cls(torch.tensor(-1), none, none.clone(), torch.zeros(frames - 1, 0, *shape.size, dtype=torch.uint8))

    def reaching_back(self, tick: int, vehicle: Tensor, valid: Tensor, cut: Tensor) -> Tensor:
        """i64 `[n]`: how many images before those of `tick` belong to the trajectories in its slots.

        `vehicle` is i64 `[n]`, `valid` and `cut` bool `[n]`; `cut`: the trajectory in the slot before it has ended.
        """
        depth = torch.zeros(len(vehicle), dtype=torch.int64)
        if tick == int(self.tick) + 1:
            known = min(len(vehicle), len(self.vehicle))
            same = (self.vehicle[:known] == vehicle[:known]) & valid[:known] & ~cut[:known]
            depth[:known] = torch.where(same, self.depth[:known], 0)
        return depth

    def followed_by(self, obs: LearningTick, images: Tensor) -> "tuple[Tensor, RecentFrames]":
        """The stacks u8 `[n, frames * channels, height, width]` of a tick with `images` `[n, …]`, and what follows."""
        vehicle = torch.from_numpy(np.asarray(obs.vehicle).astype(np.int64))
        valid = torch.from_numpy(np.asarray(obs.valid))
        before = self.reaching_back(
            obs.tick, vehicle, valid, torch.from_numpy(np.asarray(obs.terminated | obs.truncated))
        )
        older = torch.zeros(len(self.frames), *images.shape, dtype=torch.uint8)
        known = min(len(images), self.frames.shape[1])
        older[:, :known] = self.frames[:, :known]
        frames = torch.cat((older, images.unsqueeze(0)))
        places = _places(before, len(older), torch.tensor(0))
        stacks = Stacks(frames.flatten(0, 1), places).of(torch.arange(len(images)))
        after = _after(before, valid, len(older))
        return stacks, RecentFrames(torch.tensor(obs.tick), torch.where(valid, vehicle, EMPTY_SLOT), after, frames[1:])

    def lead_into(self, horizon: Horizon) -> "tuple[Tensor, RecentFrames]":
        """The places i64 `[T, N, frames]` of the stacks of a horizon, and what the next horizon follows.

        The images here are written to the room before those of the horizon.
        """
        assert horizon.images is not None
        leading, slots = len(self.frames), horizon.valid.shape[1]
        horizon.images[:leading].zero_()
        horizon.images[:leading, : self.frames.shape[1]] = self.frames
        depth = self.reaching_back(int(horizon.tick[0]), horizon.vehicle[0], horizon.valid[0], horizon.cut)
        depths = [depth]
        ended = horizon.terminated | horizon.truncated
        follows = horizon.valid[1:] & horizon.valid[:-1] & ~ended[:-1]
        follows &= (horizon.tick[1:] == horizon.tick[:-1] + 1).unsqueeze(1)
        for t, went_on in enumerate(follows):
            depth = torch.where(went_on, _after(depth, horizon.valid[t], leading), 0)
            depths.append(depth)
        before = torch.stack(depths)
        newest = torch.arange(len(before)).unsqueeze(1) * slots
        places = _places(before, leading, newest)
        last = horizon.valid[-1] & ~ended[-1]
        recent = RecentFrames(
            horizon.tick[-1].clone(),
            torch.where(last, horizon.vehicle[-1], EMPTY_SLOT),
            _after(depth, last, leading),
            horizon.images[len(horizon.images) - leading :].clone(),
        )
        return places, recent

    def tensors(self, suffix: str) -> dict[str, Tensor]:
        """For a checkpoint: fields by name."""
        return {f"{f.name}{suffix}": getattr(self, f.name).contiguous() for f in fields(self)}

    @classmethod
    def restored(cls, tensors: dict[str, Tensor], suffix: str) -> "RecentFrames | None":
        """Continue from the result of `tensors`; None if it holds none."""
        names = [f.name for f in fields(cls)]
        if any(f"{name}{suffix}" not in tensors for name in names):
            return None
        return cls(**{name: tensors[f"{name}{suffix}"] for name in names})


def images_of(obs: LearningTick, shape: ImageShape) -> Tensor:
    """u8 `[n, channels, height, width]`: the images of every slot of a tick, 0 for a slot without a camera; a copy."""
    assert isinstance(obs, SeeingTick)
    images = torch.zeros(len(obs.vehicle), *shape.size, dtype=torch.uint8)
    images[: len(obs.images)] = obs.images
    return images


def _after(before: Tensor, valid: Tensor, most: int) -> Tensor:
    """How many images a later tick may reach back to."""
    return torch.where(valid, (before + 1).clamp_max(most), 0)


def _places(before: Tensor, leading: int, newest: Tensor) -> Tensor:
    """i64 `[…, n, leading + 1]`: places of stacks in images of `n` slots, tick by tick behind `leading` others.

    `before` is i64 `[…, n]`, `newest` the place of the first slot at each tick.
    """
    slots = before.shape[-1]
    age = torch.arange(leading, -1, -1)
    back = torch.minimum(age.expand(*before.shape, leading + 1), before.unsqueeze(-1))
    own = (newest + torch.arange(slots)).unsqueeze(-1)
    return own + (leading - back) * slots
