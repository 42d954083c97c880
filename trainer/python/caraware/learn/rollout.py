"""The rollout buffer: every tick's rows, copied once out of shared memory, until a horizon is full."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from caraware.ipc.image import ImageShape
from caraware.ipc.stream import EMPTY_SLOT, LearningTick, SeeingTick


@dataclass(frozen=True)
class DrawnTick:
    """The actions that were drawn for one tick of `n` slots, before the world went on."""

    tick: int
    action: Tensor
    """f32 `[n, a]`, as drawn, not clipped; 0 in rows that are not valid."""
    log_probability: Tensor
    """f32 `[n]`: of the policy that drew it."""


@dataclass(frozen=True)
class DrawnHorizon:
    """What was drawn in a horizon, and what followed its last tick."""

    action: Tensor
    """f32 `[T, N, a]`."""
    log_probability: Tensor
    """f32 `[T, N]`."""
    ended_by: Tensor
    """i64 `[T, N]`: bits `ENDED_…`: why a trajectory ended with this row."""
    truth_after: Tensor
    """f32 `[N, 4]`: of the tick after the last."""
    held: DrawnTick
    """Of the tick after the last, which opens the next horizon: drawn by the policy before the update."""


@dataclass(frozen=True)
class Horizon:
    """`T` consecutive training ticks of `N` slots. Row `[t, i]` of every array is the same vehicle at the same tick.

    Observation and truth are views of the buffer, valid until the rollout takes another tick.
    """

    observation: Tensor
    """f32 `[T, N, d]`."""
    truth: Tensor
    """f32 `[T, N, 4]`: x_m, y_m, yaw_rad, speed_mps."""
    vehicle: Tensor
    """i64 `[T, N]`: dense vehicle index."""
    tick: Tensor
    """i64 `[T]`."""
    valid: Tensor
    """bool `[T, N]`: rows that are samples."""
    terminated: Tensor
    """bool `[T, N]`: the trajectory ended with this row."""
    truncated: Tensor
    """bool `[T, N]`: it continued, but the next row of the slot is not its continuation."""
    cut: Tensor
    """bool `[N]`: the flags of the first tick say that the trajectory in the slot before it ended there."""
    bootstrap: Tensor | None
    """f32 `[N, d]`: what followed the last tick; None where no discount asks for it."""
    drawn: DrawnHorizon | None = None
    """None where actions are drawn when the horizon is full."""
    images: Tensor | None = None
    """u8 `[leading + T, N, channels, height, width]`, a view: the first `leading` are room for the ticks before.

    None for a learner that does not see."""

    def samples(self) -> int:
        """Rows that are samples."""
        return int(self.valid.sum())

    def last_tick(self) -> int:
        """The newest tick that this horizon learns from."""
        return int(self.tick[-1])


class Rollout:
    """Collects training ticks until `horizon` samples are there.

    With `bootstrap`, one more tick is kept: the tick after the last one shows how its trajectories ended and what
    they were still worth. That tick then opens the next horizon.
    """

    def __init__(
        self,
        horizon: int,
        observation_size: int,
        *,
        bootstrap: bool,
        dark_is_nan: bool = False,
        drawn_actions: int = 0,
        images: ImageShape | None = None,
        leading: int = 0,
    ) -> None:
        """`drawn_actions`: numbers of an action that is drawn tick by tick; 0 where none is. It needs `bootstrap`.

        With `images` every tick's images are kept, behind room for those of `leading` ticks before the first.
        """
        self._actions = drawn_actions
        self._image_shape, self._leading = images, leading
        self._horizon, self._size, self._bootstrap = horizon, observation_size, bootstrap
        self._dark_is_nan = dark_is_nan
        self._ticks = 0
        self._samples = self._newest_samples = 0
        self._last_tick = -1
        self._taken = 0
        self._cut = np.zeros(0, bool)
        self._newest_slots = b"", b""
        """`vehicle` and `valid` of the newest row, as bytes, which compare faster than arrays."""
        self._allocate(ticks=16, slots=1)

    def add(self, obs: LearningTick, drawn: DrawnTick | None = None) -> None:
        """Copy one training tick, and what was drawn for it. Ticks without a valid row are skipped."""
        self.ended(obs)
        vehicle, valid = obs.vehicle, obs.valid
        rows = len(vehicle)
        if rows > self._slots:
            self._grow(self._capacity, rows)
        samples = int(np.count_nonzero(valid))
        if samples == 0:
            return
        if self._ticks == self._capacity:
            self._grow(2 * self._capacity, self._slots)
        t = self._ticks
        if t == 0:
            self._cut = obs.terminated | obs.truncated
        self._observation[t, :rows] = obs.observation.numpy()
        if self._dark_is_nan:
            torch.from_numpy(self._observation[t, :rows]).nan_to_num_()
        self._truth[t, :rows] = obs.truth.numpy()
        if self._image_shape is not None:
            assert isinstance(obs, SeeingTick)
            frames = self._images[self._leading + t]
            frames[: len(obs.images)] = obs.images.numpy()
            frames[len(obs.images) :] = 0
        self._vehicle[t, :rows], self._valid[t, :rows] = vehicle, valid
        self._tick[t] = obs.tick
        if drawn is not None:
            self._action[t, :rows] = drawn.action.numpy()
            self._log_probability[t, :rows] = drawn.log_probability.numpy()
        slots = vehicle.tobytes(), valid.tobytes()
        if t > 0 and slots != self._newest_slots:
            self._close_changed_slots(t)
        self._newest_slots = slots
        self._ticks, self._last_tick = t + 1, obs.tick
        self._samples, self._newest_samples = self._samples + samples, samples

    def ended(self, obs: LearningTick) -> None:
        """Note how the trajectories of the newest row ended: the tick after it, of any episode, has the flags."""
        self._discard_taken()
        if self._ticks == 0:
            return
        t = self._ticks - 1
        if obs.tick == self._last_tick + 1:
            rows = min(len(obs.vehicle), self._slots)
            terminated, truncated = obs.terminated[:rows], obs.truncated[:rows]
            # Most ticks end no trajectory.
            if np.count_nonzero(terminated) or np.count_nonzero(truncated):
                self._terminated[t, :rows] |= terminated
                self._truncated[t, :rows] |= truncated & ~terminated
            if self._actions:
                self._ended_by[t, :rows] = obs.ended_by[:rows]
        elif obs.tick != self._last_tick:
            self._truncated[t] |= ~self._terminated[t]

    def pending_samples(self) -> int:
        """Samples that no horizon has taken."""
        return self._samples

    def full(self) -> bool:
        """Whether `take` has a horizon to give."""
        following = self._newest_samples if self._bootstrap else 0
        return self._samples - following >= self._horizon

    def take(self) -> Horizon:
        """The collected horizon, to be learned from before the next `add`, which starts again."""
        end = self._ticks - 1 if self._bootstrap else self._ticks
        horizon = Horizon(
            observation=torch.from_numpy(self._observation[:end]),
            truth=torch.from_numpy(self._truth[:end]),
            vehicle=torch.from_numpy(self._vehicle[:end].astype(np.int64)),
            tick=torch.from_numpy(self._tick[:end].copy()),
            valid=torch.from_numpy(self._valid[:end].copy()),
            terminated=torch.from_numpy(self._terminated[:end].copy()),
            truncated=torch.from_numpy(self._truncated[:end].copy()),
            cut=torch.from_numpy(np.pad(self._cut, (0, self._slots - len(self._cut)))),
            bootstrap=_clone(self._observation[end]) if self._bootstrap else None,
            drawn=self._drawn(end) if self._actions else None,
            images=torch.from_numpy(self._images[: self._leading + end]) if self._image_shape else None,
        )
        self._taken, self._samples = end, self._newest_samples if self._bootstrap else 0
        return horizon

    def _drawn(self, end: int) -> DrawnHorizon:
        """What was drawn in the `end` first ticks."""
        held = DrawnTick(int(self._tick[end]), _clone(self._action[end]), _clone(self._log_probability[end]))
        return DrawnHorizon(
            action=torch.from_numpy(self._action[:end]),
            log_probability=torch.from_numpy(self._log_probability[:end]),
            ended_by=torch.from_numpy(self._ended_by[:end].astype(np.int64)),
            truth_after=_clone(self._truth[end]),
            held=held,
        )

    def _discard_taken(self) -> None:
        """Move the tick that only served as a bootstrap, if any, to the front."""
        if self._taken == 0:
            return
        left = self._ticks - self._taken
        for array in self._arrays():
            array[:left] = array[self._taken : self._ticks]
        if self._image_shape is not None:
            images = self._images[self._leading + self._taken : self._leading + self._ticks]
            self._images[self._leading : self._leading + left] = images
        self._clear(left, self._ticks)
        self._ticks, self._taken = left, 0
        # The horizon before has the ends of trajectories before a tick that only served as a bootstrap.
        self._cut = np.zeros(0, bool)

    def _clear(self, begin: int, end: int) -> None:
        """Empty the slots of some rows. `add` relies on it: it writes only the slots and flags that a tick has."""
        self._vehicle[begin:end] = EMPTY_SLOT
        for array in (self._valid, self._terminated, self._truncated, self._ended_by):
            array[begin:end] = 0

    def _close_changed_slots(self, t: int) -> None:
        """A slot that changed hands, or has a gap, without a flag: its trajectory continued unseen."""
        went_on = (self._vehicle[t] == self._vehicle[t - 1]) & self._valid[t]
        self._truncated[t - 1] |= self._valid[t - 1] & ~went_on & ~self._terminated[t - 1]

    def _arrays(self) -> tuple[Any, ...]:
        return (
            self._observation,
            self._truth,
            self._vehicle,
            self._valid,
            self._terminated,
            self._truncated,
            self._tick,
            self._action,
            self._log_probability,
            self._ended_by,
        )

    def _allocate(self, ticks: int, slots: int) -> None:
        self._capacity, self._slots = ticks, slots
        self._observation = _zeros(ticks, slots, self._size)
        self._truth = _zeros(ticks, slots, 4)
        self._vehicle = np.full((ticks, slots), EMPTY_SLOT, np.uint32)
        self._valid = np.zeros((ticks, slots), bool)
        self._terminated = np.zeros((ticks, slots), bool)
        self._truncated = np.zeros((ticks, slots), bool)
        self._tick = np.zeros(ticks, np.int64)
        drawn_slots = slots if self._actions else 0
        self._action = _zeros(ticks, drawn_slots, self._actions)
        self._log_probability = _zeros(ticks, drawn_slots)
        self._ended_by = np.zeros((ticks, drawn_slots), np.uint32)
        if self._image_shape is not None:
            self._images = _zeros(self._leading + ticks, slots, *self._image_shape.size, dtype=torch.uint8)

    def _grow(self, ticks: int, slots: int) -> None:
        """More ticks or slots. Rare: the slots in use settle early, the ticks double up to one horizon."""
        old, t = self._arrays(), self._ticks
        images = None if self._image_shape is None else self._images
        wide = self._slots
        self._allocate(ticks, slots)
        if images is not None:
            self._images[: self._leading + t, :wide] = images[: self._leading + t]
        for new, array in zip(self._arrays(), old, strict=True):
            if array.ndim == 1:
                new[:t] = array[:t]
            else:
                new[:t, : min(wide, array.shape[1])] = array[:t]


def _zeros(*shape: int, dtype: torch.dtype = torch.float32) -> NDArray[Any]:
    """Zeros in memory that torch has aligned for its kernels, as an array: numpy assigns a small row much faster."""
    array: NDArray[Any] = torch.zeros(shape, dtype=dtype).numpy()
    return array


def _clone(array: NDArray[Any]) -> Tensor:
    """A copy in torch's memory."""
    return torch.from_numpy(array).clone()
