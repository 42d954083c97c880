"""What the trainer needs of a stream of observations; `caraware.ipc.channel` provides it over shared memory."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypedDict, Unpack, runtime_checkable

from torch import Tensor

from caraware.ipc.arrays import BoolArray, Float32Array, FloatArray, UInt32Array, UInt64Array
from caraware.ipc.run_file import RunFile

EMPTY_SLOT = 0xFFFFFFFF
"""`vehicle` of a slot without one."""


class MeasuredTick(Protocol):
    """What the metrics of a task take of a tick of one environment. Row `i` is slot `i`."""

    @property
    def truth(self) -> Tensor:
        """f32 `[n, 4]`: x_m, y_m, yaw_rad, speed_mps in the world frame. Only for the reward and the metrics."""

    @property
    def gnss_m(self) -> Tensor:
        """f32 `[n, 2]` or `[n, 3]`: newest raw GNSS fix in world metres. Only for the baselines."""

    @property
    def valid(self) -> BoolArray:
        """bool `[n]`: the row holds a vehicle with valid sensors."""


class LearningTick(MeasuredTick, Protocol):
    """What a rollout takes of a tick of one environment.

    A slot keeps its vehicle until that vehicle is gone; `n` may grow during a run.
    """

    @property
    def tick(self) -> int:
        """Number of the tick in the run."""

    @property
    def observation(self) -> Tensor:
        """f32 `[n, d]`, normalised."""

    @property
    def vehicle(self) -> UInt32Array:
        """u32 `[n]`: dense vehicle index within the episode, `EMPTY_SLOT` where there is none."""

    @property
    def terminated(self) -> BoolArray:
        """bool `[n]`: the trajectory in this slot at the previous tick ended there (arrival, removal)."""

    @property
    def truncated(self) -> BoolArray:
        """bool `[n]`: ... was cut there from outside (episode reset, time limit)."""

    @property
    def ended_by(self) -> UInt32Array:
        """u32 `[n]`: bits `ENDED_…` of `caraware._native`: why a hero's trajectory ended there; 0 for others."""


@runtime_checkable
class SeeingTick(Protocol):
    """What a learner that sees takes of a tick beside the rest."""

    @property
    def images(self) -> Tensor:
        """u8 `[m, channels, height, width]`: the newest image of each of the first m slots."""


class Observation(LearningTick, Protocol):
    """One tick of one environment. The arrays are read-only views, valid while the object lives."""

    @property
    def episode(self) -> int:
        """Number of its episode."""

    @property
    def sim_time_ns(self) -> int:
        """Simulated time in the episode."""

    @property
    def evaluation(self) -> bool:
        """True in an evaluation episode, whose seeds training never sees."""

    @property
    def last(self) -> bool:
        """True for the very last tick of the run."""

    @property
    def episode_last(self) -> bool:
        """True for the last tick of its episode."""

    @property
    def lesson_last(self) -> bool:
        """True for the last tick of a lesson of the curriculum."""

    @property
    def stage(self) -> int:
        """Stage of the curriculum, counted from 1; 0 without one, and in evaluations."""

    @property
    def gnss_quality(self) -> Float32Array:
        """f32 `[n, 2]`: the receiver's estimate of its horizontal error (m, 1σ of the distance, 0 = none), satellites.

        This and the other raw sections are only for the baselines, which read them in evaluation episodes.
        """

    @property
    def imu(self) -> Tensor:
        """f32 `[n, k, 7]`: samples since the last tick, oldest first: accelerations, angular rates, compass."""

    @property
    def speed_steering(self) -> Tensor:
        """f32 `[n, 2]`: newest wheel speed (m/s) and steering-wheel angle (rad)."""

    @property
    def sensors(self) -> UInt32Array:
        """u32 `[n]`: bits of the sensors that deliver (`caraware.ipc.layout.SENSOR_BITS`)."""

    @property
    def age_s(self) -> Float32Array:
        """f32 `[n, 4]`: age of the newest GNSS, IMU, speed-steering and LIDAR sample (s)."""

    @property
    def episode_step(self) -> UInt32Array:
        """u32 `[n]`: ticks since the vehicle took the slot."""

    @property
    def id_hash(self) -> UInt64Array:
        """u64 `[n]`: hash of the vehicle's SUMO id. Only for its name."""


class TrainingReport(TypedDict, total=False):
    """How training goes, as the trainer's board shows it."""

    episode: int
    env_steps: int
    updates: int
    env_steps_per_s: float
    policy_std: float
    reward: float
    metrics: Mapping[str, float]
    """Values by the names of `caraware._native.METRICS`; those that are left out keep their last value."""


class Channel(Protocol):
    """The trainer's end of the observation stream of one run."""

    @property
    def run(self) -> RunFile:
        """The parsed run file."""

    def receive(self, timeout_s: float) -> Sequence[Observation]:
        """Wait for ticks and return all that are there, oldest first; empty after `timeout_s` without any."""

    def wait_for_any(self, timeout_s: float) -> None:
        """Wait until something comes from any environment of the run, at most `timeout_s`."""

    def consumed(self, tick: int) -> None:
        """Give the producer credit up to and including `tick`."""

    def committed(self, tick: int) -> None:
        """Publish a commit that is in the record: all ticks up to and including `tick` are learnt."""

    def decided(self, lessons: int, since: int, stage: int) -> None:
        """Say that all lessons below `lessons` have a stage of the curriculum, those from `since` on `stage`."""

    def publish_predictions(
        self,
        observation: Any,
        predictions: Tensor,
        policy_version: int,
        estimates: Float32Array | None = None,
    ) -> None:
        """Send f32 `[n, 2]` predicted positions in world metres for the tick of `observation`, and a filter's."""

    def publish_actions(
        self, observation: Any, actions: FloatArray, policy_version: int = 0, *, now: bool = True
    ) -> None:
        """Send f32 `[n, a]` actions for the tick of `observation`, at once or, without `now`, if no tick comes."""

    def lag_ticks(self) -> int:
        """Ticks that the traffic is ahead of the newest one consumed."""

    def actor_lag_ticks(self) -> int:
        """Ticks that the process that waits for actions has finished beyond the newest one consumed."""

    def done(self) -> None:
        """Say that all work is done, so that the run may end."""

    def report(self, **status: Unpack[TrainingReport]) -> None:
        """Tell the supervisor how training goes."""
