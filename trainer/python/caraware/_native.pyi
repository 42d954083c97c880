"""A trainer's place in a run: observations as read-only views over shared memory, and the answers to them.

Shapes use n for slots, d for observation fields and k for IMU samples of a tick. Times are in seconds where the name
ends in `_s` and in nanoseconds where it ends in `_ns`. A failure of the run raises RuntimeError, an argument out of
range ValueError.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import final

from torch import Tensor
from typing_extensions import Buffer

__all__ = [
    "CANDIDATE_COLUMNS",
    "CLIPPED",
    "EMPTY_SLOT",
    "ENDED_AGAINST_TRAFFIC",
    "ENDED_AT_RED",
    "ENDED_BLOCKED",
    "ENDED_BY_ARRIVAL",
    "ENDED_BY_COLLISION",
    "ENDED_BY_TIME",
    "ENDED_OFF_ROAD",
    "GNSS_COLUMNS",
    "IMU_COLUMNS",
    "LAYOUT_JSON",
    "LAYOUT_VERSION",
    "METRICS",
    "RESYNCHRONISED",
    "SCHEMA_VERSION",
    "SPEAKER_COLUMNS",
    "TERMINATED",
    "TRUNCATED",
    "TRUTH_COLUMNS",
    "VALID",
    "Attachment",
    "Lease",
    "Metric",
    "ObservationBlock",
    "Place",
    "PointCloud",
    "RecordingFile",
    "SectionView",
    "SightMessage",
    "exchange",
    "id_hash",
    "observation_size",
]

SCHEMA_VERSION: int
LAYOUT_VERSION: int
"""Version of the layout of a run's directory, in its `report.json`."""
"""Version of the layouts in shared memory; every process of a run has the same."""

METRICS: tuple[Metric, ...]
"""Every metric of every task, in the order of the board."""

SPEAKER_COLUMNS: int
"""Numbers of a station in a row of `speech` (messages task)."""
CANDIDATE_COLUMNS: int
"""Numbers of each candidate behind them."""

LAYOUT_JSON: str
"""The tables of `ipc-schema/layout.json`: records, payloads, sensors and fields."""

VALID: int
"""Bit of `flags`: the slot holds a vehicle whose sensors have all delivered."""
TERMINATED: int
"""Bit of `flags`: the trajectory that held the slot a tick before ended there."""
TRUNCATED: int
ENDED_BY_COLLISION: int
ENDED_OFF_ROAD: int
ENDED_BY_ARRIVAL: int
ENDED_AT_RED: int
ENDED_AGAINST_TRAFFIC: int
ENDED_BLOCKED: int
ENDED_BY_TIME: int
"""Bit of `flags`: the trajectory that held the slot a tick before was cut there."""
CLIPPED: int
"""Bit of `flags`: a field of the observation was outside its range."""
RESYNCHRONISED: int
"""Bit of `flags`: the vehicle was set onto SUMO's position instead of driving there."""
EMPTY_SLOT: int
"""Vehicle index of a slot without a vehicle."""

GNSS_COLUMNS: int
"""Columns of the section `gnss_m`: east, north, up (m, world)."""
IMU_COLUMNS: int
"""Columns of the section `imu`: acceleration x, y, z (m/s²), angular rate x, y, z (rad/s), compass (rad)."""
TRUTH_COLUMNS: int
"""Columns of the section `truth`: x, y (m, world), yaw (rad), speed (m/s)."""

@final
class Place:
    """The place in environment 0 of a run of a trainer that has no ports yet: it has a board. Any thread may note."""

    def __new__(cls, run_file: str) -> Place:
        """Join the run that `run_file` describes. No producer sends before an `Attachment` takes this place."""

    def note_waiting_for_ranks(self) -> None:
        """Note on the board that this trainer lives, and waits for the trainers of other ranks."""

    def note_working(self) -> None:
        """Note on the board that this trainer works."""

@final
class Attachment:
    """A trainer's place in one environment of a run, and its ports.

    A process that the supervisor started has one for each environment; a process from outside may have any number.
    Methods may be called from any thread; `receive` and `wait_for_any` release the GIL while they wait.
    """

    def __new__(
        cls, run_file: str, first_tick: int = 0, *, outside: bool = False, place: Place | None = None
    ) -> Attachment:
        """Join the run that `run_file` describes. Producers send from `first_tick` on: all before are committed.

        With `place` the trainer has joined the run before. Raises RuntimeError where another attachment has it.

        With `outside`, the supervisor did not start this process. It then does not end with the supervisor; `receive`
        raises RuntimeError instead.
        """

    @property
    def run_json(self) -> str:
        """The run file's text."""

    def in_environment(self, env_index: int, first_tick: int) -> Attachment:
        """This trainer's place in environment `env_index` of the run, whose ticks begin with `first_tick`."""

    def wait_for_any(self, timeout_s: float) -> None:
        """Wait for a message in any environment, at most `timeout_s` and at most 50 ms.

        Call `receive(0)` before it, or a message that is already there waits for the next one.
        """

    def receive(self, timeout_s: float, *, busy: bool = False) -> list[ObservationBlock]:
        """All waiting blocks, oldest first; an empty list after `timeout_s` without any.

        With `busy` the call polls on its core instead of sleeping, which saves the wake-up of some 30 µs.
        """

    def images(self) -> list[SightMessage]:
        """Images since the last call, oldest first; the newest of them if there were more than fit.

        The first call subscribes and gives none. Raises RuntimeError.
        """

    def detections(self) -> list[SightMessage]:
        """Radar scans since the last call, oldest first; the newest of them if there were more than fit.

        The first call subscribes and gives none. Raises RuntimeError.
        """

    def road_users(self) -> list[SightMessage]:
        """Messages of `world` since the last call, oldest first; only the oldest if there were more than fit.

        Raises RuntimeError, also in a run without `trainer.road_users`.
        """

    def lane_positions(self) -> list[SightMessage]:
        """Messages of `lane-position` since the last call, oldest first; the newest if there were more than fit.

        The first call subscribes and gives none. Raises RuntimeError.
        """

    def scans(self) -> list[PointCloud]:
        """LIDAR scans since the last call, oldest first; the newest of them if there were more than fit.

        The first call subscribes and returns none.
        """

    def actor_lag_ticks(self) -> int:
        """Ticks that the process that waits for actions has finished beyond the newest tick consumed here."""

    def lag_ticks(self) -> int:
        """Ticks that `traffic-bridge` is ahead of the newest tick consumed here."""

    @property
    def refused(self) -> int:
        """Messages that were refused because they came from another run or from a replaced incarnation."""

    @property
    def ended(self) -> bool:
        """True once the last block of the run has been received."""

    def consumed(self, tick: int) -> None:
        """Return credit to the producer for all ticks up to and including `tick`."""

    def committed(self, tick: int) -> None:
        """Publish that all ticks up to and including `tick` are in a checkpoint that has been renamed into place."""

    def decided(self, lessons: int, since: int, stage: int) -> None:
        """Publish that all lessons below `lessons` have a stage; lessons from `since` on have `stage`, counted from 0.

        `traffic-bridge` waits for this before each lesson of a curriculum.
        """

    def note_waiting_for_ranks(self) -> None:
        """Note on the board that this trainer lives, and waits for the trainers of other ranks."""

    def note_working(self) -> None:
        """Note on the board that this trainer works."""

    def done(self) -> None:
        """Publish that all work is done."""

    def publish_predictions(
        self,
        block: ObservationBlock,
        rows: bytes,
        columns: int,
        policy_version: int,
        estimates: bytes | None = None,
    ) -> None:
        """Publish the answer to `block`: `rows` is f32 `[n, columns]` in C order.

        In the localisation task a row is a position (m, world). In the driving task it is steering and acceleration,
        each in -1 … 1, and the simulation waits for it. `estimates`, f32 `[n, 2]`, are a filter's positions (m, world)
        beside them. Raises ValueError for a length that does not fit the block.
        """

    def report(
        self,
        *,
        episode: int | None = None,
        env_steps: int | None = None,
        updates: int | None = None,
        env_steps_per_s: float | None = None,
        policy_std: float | None = None,
        reward: float | None = None,
        metrics: Mapping[str, float] | None = None,
    ) -> None:
        """Publish the progress of training on the trainer's board; a value that is left out keeps its last one.

        `metrics` are values by the names of `METRICS`. Raises ValueError for another name.
        """

@final
class ObservationBlock:
    """One tick of one environment in shared memory, which stays valid while this object or a view of it lives."""

    @property
    def received_ns(self) -> int:
        """When the block was taken, on the system's monotonic clock, nanoseconds."""

    @property
    def tick(self) -> int:
        """Tick number, 0-based over the run."""

    @property
    def episode(self) -> int:
        """Episode number, 0-based over the run."""

    @property
    def sim_time_ns(self) -> int:
        """Simulated time since the start of the episode, nanoseconds."""

    @property
    def slots(self) -> int:
        """Number of slots n."""

    @property
    def fields(self) -> int:
        """Number of observation fields d."""

    @property
    def imu_samples(self) -> int:
        """Number of IMU samples k."""

    @property
    def image_shape(self) -> tuple[int, int, int] | None:
        """Rows, columns and bytes of a pixel of the images in the section `images`; None where there are none."""

    @property
    def evaluation(self) -> bool:
        """True in an evaluation episode."""

    @property
    def episode_last(self) -> bool:
        """True for the last tick of its episode."""

    @property
    def lesson_last(self) -> bool:
        """True for the last tick of a lesson; before the next lesson the simulation waits for `Attachment.decided`."""

    @property
    def stage(self) -> int:
        """Stage of the curriculum, counted from 1; 0 without a curriculum and in evaluations."""

    @property
    def last(self) -> bool:
        """True for the last tick of the run."""

    @property
    def bounds_episode(self) -> bool:
        """True for the first and the last tick of an episode, of those that `receive` returns."""

    @property
    def address(self) -> int:
        """Address of the payload, which proves where it lies."""

    def section(self, name: str) -> SectionView:
        """One array (`observation`, `truth`, `gnss_m`, …) as a read-only buffer over shared memory.

        `ipc_schema::observation::ObservationLayout` lists the names. Raises KeyError for any other.
        """

    def neighbours(self, name: str) -> SectionView | None:
        """One array of the neighbours of this tick (`objects`, `ids`, `radio`, …), read-only.

        None in a run without messages between road users (`v2x.share`). `ipc_schema::neighbours::NeighboursLayout`
        lists the names. Raises KeyError for any other.
        """

@final
class SectionView:
    """One array of an observation block as a read-only buffer with its type and shape; it keeps the block alive."""

    def __buffer__(self, flags: int, /) -> memoryview: ...

@final
class Lease:
    """The observations of an attachment one at a time, each lent until the next is taken."""

    def __new__(cls, attachment: Attachment, make: Callable[[Buffer, int, int], Tensor]) -> Lease:
        """`make(buffer, n, d)` returns the tensor f32 `[n, d]` over a buffer; it is called once for each place."""

    def next(self, timeout_s: float) -> Tensor | None:
        """The tensor f32 `[n, d]` of the next tick; None after `timeout_s`. Polls on its core.

        The tensor before it is given back: its content is undefined from now on.
        """

    @property
    def tick(self) -> int:
        """Tick number of the newest, 0-based over the run."""

    @property
    def episode(self) -> int:
        """Episode of the newest, 0-based over the run."""

    @property
    def sim_time_ns(self) -> int:
        """Simulated time of the newest since the start of the episode, nanoseconds."""

    @property
    def received_ns(self) -> int:
        """When the newest was taken, on the system's monotonic clock, nanoseconds."""

    @property
    def episode_last(self) -> bool:
        """True if the newest is the last of its episode."""

    @property
    def last(self) -> bool:
        """True if the newest is the last of the run."""

    @property
    def places(self) -> int:
        """Number of tensors made: one for each place in shared memory that a message has lain in."""

@final
class Metric:
    """A row of `METRICS`: a number that a task measures."""

    @property
    def name(self) -> str:
        """Name, which ends in its unit: the key in reports, logs and plots."""

    @property
    def label(self) -> str:
        """Name for people."""

    @property
    def unit(self) -> str:
        """Unit for people."""

    @property
    def higher_is_better(self) -> bool:
        """True if larger values are better, as of progress; false as of an error."""

    @property
    def task(self) -> str:
        """`task.kind` of the task that measures it."""

    @property
    def reference_for(self) -> str | None:
        """Name of the policy's metric that this one is a reference for; None if it is the policy's own."""

@final
class PointCloud:
    """The scan of one LIDAR in one tick, copied out of shared memory."""

    @property
    def tick(self) -> int:
        """Tick number, 0-based over the run."""

    @property
    def sim_time_ns(self) -> int:
        """Simulated time at the end of the tick, nanoseconds since the start of the episode."""

    @property
    def vehicle(self) -> int:
        """Dense index of the vehicle within the episode."""

    @property
    def scan(self) -> bytes:
        """The bytes of one `Scan`: pose of the sensor and counts."""

    @property
    def points(self) -> bytes:
        """The bytes of the points, `LidarPoint [count]`."""

@final
class SightMessage:
    """What one camera or one radar has sent at a tick, copied out of shared memory."""

    @property
    def tick(self) -> int:
        """Tick number, 0-based over the run."""

    @property
    def sim_time_ns(self) -> int:
        """Simulated time at the end of the tick, nanoseconds since the start of the episode."""

    @property
    def sections(self) -> list[bytes]:
        """The bytes of each section, in the order of the message."""

def id_hash(id: str) -> int:
    """Hash of a SUMO id, as the section `id_hash` of an observation has it."""

def observation_size(run_file: str) -> int:
    """Numbers in a row of the observation (d) of the run that `run_file` describes. Raises RuntimeError."""

def exchange(one: Path, other: Path) -> None:
    """Give two paths each other's names, from one moment to the next. Raises OSError."""

@final
class RecordingFile:
    """A recording of an environment, as bytes. `caraware.data` gives it as arrays."""

    def __new__(cls, path: str | Path) -> RecordingFile:
        """Open it; one that was cut off or damaged opens up to there. Raises ValueError with the place or versions."""

    @property
    def start_json(self) -> str:
        """Versions, run, seed and channels."""

    def attachment(self, name: str) -> bytes | None:
        """Content of an attached file of the run, such as "run.json"."""

    @property
    def chunks(self) -> int:
        """Number of chunks."""

    @property
    def damage(self) -> tuple[int, str] | None:
        """Byte and reason, if the file was cut off or its structure is damaged."""

    def chunk(self, index: int) -> list[tuple[str, bytes, bytes]]:
        """Topic, header and payload of every message of a chunk. Raises ValueError if it is damaged."""
