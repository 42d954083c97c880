"""The trainer's end of shared memory: observations as read-only tensors, credits, predictions, status."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Scalar, UInt32Array, UInt64Array
from caraware.ipc.commits import CommitLog, CommittedPosition, EpisodeStarts
from caraware.ipc.image import Image
from caraware.ipc.lane_positions import LanePositions
from caraware.ipc.mounts import SensorNames
from caraware.ipc.pointcloud import PointCloud
from caraware.ipc.radar import RadarDetections
from caraware.ipc.road_users import RoadUserStates
from caraware.ipc.run_file import RunFile, setting
from caraware.ipc.stream import TrainingReport

if TYPE_CHECKING:
    from typing_extensions import Buffer


ENDED_BY = np.uint32(
    _native.ENDED_BY_COLLISION
    | _native.ENDED_OFF_ROAD
    | _native.ENDED_BY_ARRIVAL
    | _native.ENDED_AT_RED
    | _native.ENDED_AGAINST_TRAFFIC
    | _native.ENDED_BLOCKED
    | _native.ENDED_BY_TIME
)
"""All bits of an observation's flags that say why a hero's trajectory ended."""

ANSWER_AGAIN_S = 0.2
"""Time without a tick after which the newest actions are sent again. `sim-core` skips what it has."""


def _lent_tensor(view: Buffer, slots: int, fields: int) -> Tensor:
    """The tensor over a place in shared memory, f32 [slots, fields], whatever lies there."""
    return read_only_tensor(np.frombuffer(memoryview(view), np.float32).reshape(slots, fields))


class StreamEndedError(Exception):
    """The last tick of the run has been received: nothing will follow."""


class ReadOnlyTensor(Tensor):
    """A tensor over memory that must not be written: the simulation's own shared memory.

    torch has no read-only tensors, and a write to this memory would kill the process. Every in-place operation and
    every `out=` on this tensor or a view of it raises; results in memory of their own are ordinary tensors.
    """

    array: NDArray[Any] | None = None
    """The array that the tensor lies over, not writable; None for a view of such a tensor."""

    # The trainer calls these two at every tick: 5 µs through `__torch_function__`, 0.2 µs from the array.
    def numpy(self, *, force: bool = False) -> NDArray[Any]:
        """The array itself, which is not writable; see `Tensor.numpy`."""
        if self.array is not None:
            return self.array
        array: NDArray[Any] = super().numpy(force=force)
        return array

    def __len__(self) -> int:
        """See `Tensor.__len__`."""
        if self.array is not None:
            return len(self.array)
        length: int = super().__len__()  # type: ignore[no-untyped-call]  # torch: no types
        return length

    @classmethod
    def __torch_function__(
        cls,
        func: Callable[..., Any],
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        writes = name in {"__setitem__", "set_", "data"} or (name.endswith("_") and not name.endswith("__"))
        in_place = name.startswith("__i") and name.endswith("__") and name not in {"__index__", "__int__", "__invert__"}
        if (writes or in_place) and args and isinstance(args[0], cls):
            raise RuntimeError(f"{name}: observations are read-only shared memory; write to a clone()")
        if isinstance(kwargs.get("out"), cls):
            raise RuntimeError(f"{name}(out=…): observations are read-only shared memory")
        result: Any = super().__torch_function__(func, types, args, kwargs)  # type: ignore[no-untyped-call]  # torch: no types
        if isinstance(result, cls) and not any(_shares_memory(result, arg) for arg in args if isinstance(arg, cls)):
            return result.as_subclass(Tensor)
        return result


def _shares_memory(a: Tensor, b: Tensor) -> bool:
    with torch._C.DisableTorchFunctionSubclass():
        return a.untyped_storage().data_ptr() == b.untyped_storage().data_ptr()


def read_only_tensor(array: NDArray[Any]) -> Tensor:
    """A tensor over a read-only numpy array, without a copy."""
    tensor = torch.from_numpy(array).as_subclass(ReadOnlyTensor)
    tensor.array = array
    return tensor


# torch warns once per process of an array that is not writable: here, where the warning is ignored.
with warnings.catch_warnings():
    warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
    read_only_tensor(np.frombuffer(bytes(4), np.float32))


class Observation:
    """One tick of one environment. n slots, d fields; a slot keeps its vehicle until that vehicle is gone.

    All arrays are read-only views over shared memory, valid while this object or any of them lives.
    """

    def __init__(self, block: _native.ObservationBlock) -> None:
        self.block = block

    @property
    def tick(self) -> int:
        """Tick number, 0-based over the run."""
        return self.block.tick

    @property
    def episode(self) -> int:
        """Episode number, 0-based over the run."""
        return self.block.episode

    @property
    def sim_time_ns(self) -> int:
        """Simulated time since the start of the episode."""
        return self.block.sim_time_ns

    @property
    def evaluation(self) -> bool:
        """True in an evaluation episode, whose seed training never sees."""
        return self.block.evaluation

    @property
    def last(self) -> bool:
        """True for the last tick of the run."""
        return self.block.last

    @property
    def episode_last(self) -> bool:
        """True for the last tick of its episode."""
        return self.block.episode_last

    @property
    def lesson_last(self) -> bool:
        """True for the last tick of a lesson of the curriculum."""
        return self.block.lesson_last

    @property
    def stage(self) -> int:
        """Stage of the curriculum, counted from 1; 0 without one, and in evaluations."""
        return self.block.stage

    def array(self, name: str, scalar: type[Scalar]) -> NDArray[Scalar]:
        """The section `name` in its type and shape; `scalar` names the type for the type checker."""
        array: NDArray[Scalar] = np.asarray(self.block.section(name))
        return array

    @cached_property
    def observation(self) -> Tensor:
        """f32 [n, d], normalised fields; what a policy may see."""
        return read_only_tensor(self.array("observation", np.float32))

    @cached_property
    def images(self) -> Tensor:
        """u8 [m, channels, height, width]: the newest image of each of the first m slots (`camera.observed`).

        m is the smaller of n and `camera.vehicles`; an image is 0 until the camera of its slot has delivered. Raises
        RuntimeError in a run whose observations hold no images.
        """
        shape = self.block.image_shape
        if shape is None:
            raise RuntimeError("no images in the observations of this run: set `camera.observed`")
        rows = self.array("images", np.uint8).reshape(-1, *shape)
        return read_only_tensor(rows).permute(0, 3, 1, 2)

    @cached_property
    def neighbours(self) -> Neighbours:
        """What the slots know from messages. Its arrays raise RuntimeError in a run without them (`v2x.share`)."""
        return Neighbours(self.block)

    @cached_property
    def truth(self) -> Tensor:
        """f32 [n, 4]: x and y of the rear axle (m, world), yaw (rad), speed (m/s). For rewards and errors only."""
        return read_only_tensor(self.array("truth", np.float32))

    @cached_property
    def gnss_m(self) -> Tensor:
        """f32 [n, 3]: newest raw GNSS fix, east, north and up (m, world); its x and y are the baseline."""
        return read_only_tensor(self.array("gnss_m", np.float32))

    @cached_property
    def gnss_geodetic(self) -> Float64Array:
        """f64 [n, 3]: the same fix as latitude, longitude (degrees) and altitude (m)."""
        return self.array("gnss_geodetic", np.float64)

    @cached_property
    def gnss_quality(self) -> Float32Array:
        """f32 [n, 2]: the receiver's estimate of its horizontal error (m, 1σ of the distance), satellites in use."""
        return self.array("gnss_quality", np.float32)

    @cached_property
    def imu(self) -> Tensor:
        """f32 [n, k, 7]: IMU samples since the last tick, oldest first.

        Columns: acceleration x, y, z (m/s²), angular rate x, y, z (rad/s), compass (rad). Frame and gravity are
        what `imu.convention` says; k is 1 for an IMU that samples once a tick or less often.
        """
        return read_only_tensor(self.array("imu", np.float32))

    @cached_property
    def speed_steering(self) -> Tensor:
        """f32 [n, 2]: newest wheel speed (m/s) and steering-wheel angle (rad, positive to the left)."""
        return read_only_tensor(self.array("speed_steering", np.float32))

    @cached_property
    def sensors(self) -> UInt32Array:
        """u32 [n]: bits of the sensors that deliver (`caraware.ipc.layout.SENSOR_BITS`)."""
        return self.array("sensors", np.uint32)

    @cached_property
    def vehicle(self) -> UInt32Array:
        """u32 [n]: dense index of the vehicle within its episode, 0xFFFFFFFF for an empty slot."""
        return self.array("vehicle", np.uint32)

    @cached_property
    def id_hash(self) -> UInt64Array:
        """u64 [n]: hash of the vehicle's SUMO id."""
        return self.array("id_hash", np.uint64)

    @cached_property
    def age_s(self) -> Float32Array:
        """f32 [n, 4]: age of the newest GNSS, IMU, speed-steering and LIDAR sample (s)."""
        return self.array("age_s", np.float32)

    @cached_property
    def episode_step(self) -> UInt32Array:
        """u32 [n]: ticks since the vehicle took the slot."""
        return self.array("episode_step", np.uint32)

    @cached_property
    def _flags(self) -> UInt32Array:
        return self.array("flags", np.uint32)

    def _flag(self, bit: int) -> BoolArray:
        """bool [n]: the slots whose flags have the bit."""
        flagged: BoolArray = (self._flags & bit).astype(bool)
        return flagged

    @cached_property
    def valid(self) -> BoolArray:
        """bool [n]: the slot holds a vehicle whose sensors have all delivered."""
        return self._flag(_native.VALID)

    @cached_property
    def terminated(self) -> BoolArray:
        """bool [n]: the trajectory in this slot at the previous tick ended there (arrival, removal)."""
        return self._flag(_native.TERMINATED)

    @cached_property
    def truncated(self) -> BoolArray:
        """bool [n]: the trajectory in this slot at the previous tick was cut there (end of episode)."""
        return self._flag(_native.TRUNCATED)

    @cached_property
    def ended_by(self) -> UInt32Array:
        """u32 [n]: bits `ENDED_…` of `caraware._native`: why a hero's trajectory in this slot ended."""
        reasons: UInt32Array = self._flags & ENDED_BY
        return reasons

    @cached_property
    def resynchronised(self) -> BoolArray:
        """bool [n]: the vehicle was set onto SUMO's position instead of driving there; its trajectory was cut."""
        return self._flag(_native.RESYNCHRONISED)


class SpeakingObservation(Observation):
    """One tick of the messages task: what a policy sees, and what it achieved, come from `v2x` (docs/messages.md).

    `observation` is f32 [n, 8 + 15 c], what the station of each slot knows, 0 for one that cannot tell of anything:
    the 8 numbers of a station (`SPEAKER_COLUMNS` of `ipc_schema::neighbours`) and the 15 of each of its c candidates
    (`CANDIDATE_COLUMNS`), the nearest first. `truth` is f32 [n, 4], what the messages of the tick before have achieved,
    for rewards and metrics only.
    """

    def array(self, name: str, scalar: type[Scalar]) -> NDArray[Scalar]:
        """See `Observation.array`."""
        section = {"observation": "speech", "truth": "achieved"}.get(name)
        return super().array(name, scalar) if section is None else self.neighbours.array(section, scalar)

    @cached_property
    def valid(self) -> BoolArray:
        """bool [n]: the slot holds a vehicle with a radio that has a fix of its place."""
        speaks: BoolArray = self._flag(_native.VALID) & (self.array("observation", np.float32)[:, 0] > 0)
        return speaks


class Neighbours:
    """What the slots of an observation know from messages. n slots, k objects in each, the nearest first.

    All arrays are read-only views over shared memory. `ipc_schema::neighbours` describes the columns.
    """

    def __init__(self, block: _native.ObservationBlock) -> None:
        self._block = block

    def array(self, name: str, scalar: type[Scalar]) -> NDArray[Scalar]:
        """The section `name`. Raises RuntimeError in a run without messages."""
        view = self._block.neighbours(name)
        if view is None:
            raise RuntimeError("no messages in this run: set `v2x.share` above 0")
        array: NDArray[Scalar] = np.asarray(view)
        return array

    @cached_property
    def objects(self) -> Tensor:
        """f32 [n, k, 11]: zeros where there is no object.

        Columns: x, y (m, world, centre), velocity x, y (m/s, world), heading (rad), length, width (m), age (s), then
        standard deviations: position on each axis (m), velocity on each axis (m/s), heading (rad).
        """
        return read_only_tensor(self.array("objects", np.float32))

    @cached_property
    def ids(self) -> UInt32Array:
        """u32 [n, k, 3]: its station (0: perceived), station heard from, 1 CAM, 2 CPM, 3 VAM, 4 BSM, 5 own sensors."""
        return self.array("ids", np.uint32)

    @cached_property
    def radio(self) -> UInt32Array:
        """u32 [n, 5]: 1 with a radio, objects known; messages sent, their bytes, and received in the tick before."""
        return self.array("radio", np.uint32)

    @cached_property
    def channel_load(self) -> Tensor:
        """f32 [n]: share of the tick before in which the radio found the channel busy."""
        return read_only_tensor(self.array("channel_load", np.float32))

    @cached_property
    def vehicle(self) -> UInt32Array:
        """u32 [n]: dense index of the vehicle, as in the observation."""
        return self.array("vehicle", np.uint32)

    @cached_property
    def speech(self) -> Tensor:
        """f32 [s, i]: what the policy of the messages task sees; s and i are 0 in other tasks."""
        return read_only_tensor(self.array("speech", np.float32))

    @cached_property
    def achieved(self) -> Tensor:
        """f32 [s, 4], of the messages task: what the messages of the tick before have achieved.

        Columns: seconds for which others newly know what the slot's CPM listed, bytes of that message, road users
        within `v2x.awareness_range_m` that the slot knows now, all road users within that range.
        """
        return read_only_tensor(self.array("achieved", np.float32))


class _Answer(NamedTuple):
    """Actions that were sent, until others are."""

    observation: Observation
    rows: bytes
    columns: int
    """Also of a tick without vehicles, which has no rows."""
    policy_version: int
    sent_s: float


class Channel:
    """A trainer's place in a run. One for each process; opening it lets the simulation start.

    `outside` is for a process that the supervisor did not start (`caraware.envs.make`): it does not end with the run,
    and may have places in several.
    """

    def __init__(
        self,
        run_file: str,
        first_tick: int | None = None,
        *,
        learner: str | None = None,
        outside: bool = False,
        place: _native.Place | None = None,
    ) -> None:
        """Join the run; ticks come from the one after the last commit of any learner on, whichever it was.

        `learner` is the name under which this one commits; without, that of its module. A learner whose checkpoint is
        older than its last commit gives the `first_tick` to begin with: later ones are not learnt, and come again.
        With a `place` this process has joined before.

        Raises `CommitLogError`, and `RuntimeError` where the tick is not in the journal any more.
        """
        run: RunFile = json.loads(Path(run_file).read_text())
        self.learner = learner or str(setting(run, "trainer.module", str))
        self._commits = CommitLog(run)
        begin = self._begin(0, first_tick)
        self._hold(_native.Attachment(run_file, begin, outside=outside, place=place))

    def _begin(self, environment: int, first_tick: int | None) -> int:
        """Where this environment begins; what has been committed beyond that is not learnt any more."""
        position = self._commits.positions()[environment]
        if first_tick is not None and first_tick < position.ticks:
            position = position.at_most(first_tick)
            self._commits.begin(self.learner, {environment: position})
        self._environment, self.first_tick = environment, position.ticks if first_tick is None else first_tick
        self._starts = EpisodeStarts(position.episode, position.episode_tick)
        return self.first_tick

    def _hold(self, attachment: _native.Attachment) -> None:
        self._attachment = attachment
        self.run: RunFile = json.loads(attachment.run_json)
        speaks = setting(self.run, "task.kind", str) == "messages"
        self._tick_of: Callable[[_native.ObservationBlock], Observation] = (
            SpeakingObservation if speaks else Observation
        )
        self._answer: _Answer | None = None

    def in_environment(self, index: int, first_tick: int | None = None) -> Channel:
        """This trainer's place in another environment of the run (`run.envs`); this one is environment 0's.

        Each has its own ticks, credits and commits. A trainer has to take a place in every environment.
        """
        channel = object.__new__(Channel)
        channel.learner, channel._commits = self.learner, self._commits
        channel._hold(self._attachment.in_environment(index, channel._begin(index, first_tick)))
        return channel

    def wait_for_any(self, timeout_s: float) -> None:
        """Wait until something comes from any environment, at most `timeout_s`. Look with `receive(0)` first."""
        self._attachment.wait_for_any(timeout_s)

    def receive(self, timeout_s: float, *, busy: bool = False) -> list[Observation]:
        """All ticks that are waiting, in order, at least one; an empty list after `timeout_s`.

        `busy` polls instead of sleeping: it takes a whole core and saves the wake-up, some 30 µs.

        Raises StreamEndedError once the last tick has been received before.
        """
        if self._attachment.ended:
            raise StreamEndedError
        blocks = self._attachment.receive(timeout_s, busy=busy)
        if not blocks and self._answer is not None:
            self._answer_again(self._answer)
        for block in blocks:
            if block.bounds_episode:
                self._starts.note(block)
        return [self._tick_of(block) for block in blocks]

    def lease(self) -> _native.Lease:
        """The observations one by one, each lent until the next is taken: a microsecond from publish to tensor.

        `lease.next(timeout_s)` is f32 [n, d] as `Observation.observation`, or None. It busy-polls, gives no other
        array, and takes back the tensor before: clone what is to stay. `lease.tick`, `episode`, `sim_time_ns`, `last`
        and `episode_last` are those of the newest; `consumed` and `committed` are called as ever.
        """
        return _native.Lease(self._attachment, _lent_tensor)

    @cached_property
    def _sensors(self) -> SensorNames:
        return SensorNames(self.run)

    def scans(self) -> list[PointCloud]:
        """LIDAR scans since the last call, oldest first; the newest of them if more came than shared memory holds.

        One for each LIDAR (`lidar.vehicles`, `[[suite]]`) and each tick in which it samples; `mounted` names it and its
        carrier. The first call subscribes and gives none.
        """
        return [PointCloud.of(scan, self._sensors) for scan in self._attachment.scans()]

    def images(self) -> list[Image]:
        """Images since the last call, oldest first; the newest of them if more came than shared memory holds.

        One for each camera (`camera.vehicles`, `[[suite]]`) and each sample; `mounted` names it and its carrier. The
        first call subscribes and gives none.
        """
        return [Image.of(image, self._sensors) for image in self._attachment.images()]

    def detections(self) -> list[RadarDetections]:
        """Radar scans since the last call, oldest first; the newest of them if more came than shared memory holds.

        One for each radar (`radar.vehicles`, `[[suite]]`) and each sample; `mounted` names it and its carrier. The
        first call subscribes and gives none.
        """
        return [RadarDetections.of(scan, self._sensors) for scan in self._attachment.detections()]

    def lane_positions(self) -> list[LanePositions]:
        """SUMO's lanes, edges and route positions since the last call, oldest first (`traffic.lane_positions`).

        The first call subscribes and gives none. Call it after each `receive`: every tick from then on comes once, with
        the number of its observation, except ticks that a restarted trainer receives again.
        """
        return [LanePositions.of(message) for message in self._attachment.lane_positions()]

    def road_users(self) -> list[RoadUserStates]:
        """States and boxes of all road users since the last call, oldest first (`trainer.road_users`).

        Call it after each `receive`: every tick comes once, with the number of its observation, except the first ticks,
        which the simulation makes before there is a trainer (at most two windows, `run.window_ticks`), and ticks that
        a restarted trainer receives again. Raises RuntimeError in a run without `trainer.road_users`.
        """
        return [RoadUserStates.of(message) for message in self._attachment.road_users()]

    def consumed(self, tick: int) -> None:
        """Gives the simulation credit for all ticks up to and including `tick`."""
        self._attachment.consumed(tick)

    def commit(self, tick: int, stop_requested: Callable[[], bool] = lambda: False) -> None:
        """What this learner has learnt from all ticks up to and including `tick` is on disk: they never come again.

        This is the moment that counts: `commits.json` is renamed into place. Save first, under a name that has the
        tick (`own_tick`), and remove older states afterwards. Blocks while the disk is full, until there is space or
        `stop_requested` says true; then it raises `OSError`. Raises `CommitLogError`.
        """
        episode, episode_tick = self._starts.after(tick)
        position = CommittedPosition(tick + 1, episode, episode_tick)
        self._commits.record(self.learner, {self._environment: position}, stop_requested)
        self.committed(tick)

    def own_tick(self) -> int | None:
        """The newest tick that this learner itself has committed in this run, at any time; None before its first."""
        own = self._commits.own(self.learner)
        return own.positions[self._environment].ticks - 1 if own else None

    def committed(self, tick: int) -> None:
        """Publish a commit that is in the record: the journal need not keep all ticks up to and including `tick`."""
        self._attachment.committed(tick)

    def decided(self, lessons: int, since: int, stage: int) -> None:
        """All lessons of a curriculum below `lessons` have a stage; those from `since` on `stage`, counted from 0.

        The simulation waits for that before every lesson, the first included. `caraware.run.curriculum` says it.
        """
        self._attachment.decided(lessons, since, stage)

    def publish_predictions(
        self,
        observation: Observation,
        predictions: Tensor,
        policy_version: int,
        estimates: Float32Array | None = None,
    ) -> None:
        """Predicted positions, f32 [n, 2] in world metres, for viewers.

        `estimates`, f32 [n, 2], are those of a filter beside the policy, not-a-number where it has none.
        """
        rows = predictions.detach().to(torch.float32).contiguous().numpy()
        beside = None if estimates is None else np.ascontiguousarray(estimates, dtype=np.float32).tobytes()
        self._attachment.publish_predictions(observation.block, rows.tobytes(), rows.shape[1], policy_version, beside)

    def publish_actions(
        self, observation: Observation, actions: FloatArray, policy_version: int = 0, *, now: bool = True
    ) -> None:
        """Actions of a task whose simulation waits for those of every tick and makes the next one with them.

        Driving: f32 [n, 2], steering (left is positive) and acceleration, each in -1 ... 1, a row for every slot; rows
        of empty slots are not read. What is no number or out of range is refused: the last valid action of that vehicle
        is held. Messages: f32 [n, `v2x.candidates`]; a candidate whose number is above 0 is listed.

        The newest actions are sent again while no tick comes, because a simulator that died may have lost them. Without
        `now` they are only sent then: another learner has answered the tick, as far as is known.
        """
        rows = np.ascontiguousarray(actions, dtype=np.float32)
        speaks = self._tick_of is SpeakingObservation
        expected = (observation.block.slots, setting(self.run, "v2x.candidates", int) if speaks else 2)
        if rows.shape != expected:
            raise ValueError(f"actions of shape {rows.shape}, the task takes {expected}")
        self._answer = _Answer(observation, rows.tobytes(), rows.shape[1], policy_version, time.monotonic())
        if now:
            self._send(self._answer)

    def _send(self, answer: _Answer) -> None:
        block = answer.observation.block
        self._attachment.publish_predictions(block, answer.rows, answer.columns, answer.policy_version)

    def _answer_again(self, answer: _Answer) -> None:
        """Send the newest actions again if no tick has come for long: a simulator that died may have lost them."""
        if time.monotonic() - answer.sent_s > ANSWER_AGAIN_S:
            self._answer = answer._replace(sent_s=time.monotonic())
            self._send(self._answer)

    def report(self, **status: Unpack[TrainingReport]) -> None:
        """Shows how training goes; what is left out keeps its last value."""
        self._attachment.report(**status)

    def lag_ticks(self) -> int:
        """Ticks that the traffic is ahead of the newest one consumed."""
        return self._attachment.lag_ticks()

    def actor_lag_ticks(self) -> int:
        """Ticks that the process that waits for actions has finished beyond the newest one consumed."""
        return self._attachment.actor_lag_ticks()

    def note_waiting_for_ranks(self) -> None:
        """Note that this trainer lives, and waits for those of other ranks. Any thread may; not the one that waits."""
        self._attachment.note_waiting_for_ranks()

    def note_working(self) -> None:
        """Note that this trainer works."""
        self._attachment.note_working()

    def done(self) -> None:
        """All work is done: the process may end."""
        self._attachment.done()

    def close(self) -> None:
        """Releases the run's shared memory, even if this object is still referenced; it is of no use afterwards."""
        del self._attachment
