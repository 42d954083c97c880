"""Everything that the trainer reads of a run file, read once, then frozen."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from caraware.baselines.lanes import LaneMap
from caraware.baselines.map_ekf import lanes_of_net, net_of_run, world_origin_of_run
from caraware.baselines.noise import SensorNoise
from caraware.ipc.commits import CommitLog
from caraware.ipc.run_file import BlackoutPolicy, RunFile, config_table, setting
from caraware.learn.config import ConfigError, EstimateTimes, MapBounds, TrainerConfig
from caraware.run.curriculum import Stage
from caraware.tasks.contract import Task
from caraware.tasks.table import task_of_run


@dataclass(frozen=True)
class RunConfig:
    """Everything the trainer reads of a run file."""

    run_dir: Path
    trainer: TrainerConfig
    bounds: MapBounds
    task: Task
    config_sha256: str
    """Of the resolved configuration, as canonical JSON: a checkpoint remembers what it was trained with."""
    dark_is_nan: bool
    """Fields of a sensor in a blackout are not numbers (`blackout.policy`); the networks see 0, mid-range, instead."""
    training_episodes: int
    """With a curriculum: most lessons."""
    curriculum: tuple[Stage, ...]
    evaluation_interval: int
    """Training episodes between two evaluation episodes; 0: none between."""
    sensors: SensorNoise | None
    """Errors of the sensors, which the classical baselines are tuned with; None for a run file without sensors."""
    net_file: Path | None
    """The net of all episodes, for baselines with a map; None where episodes have several."""
    world_origin_m: tuple[float, float]
    """Where the world frame's (0, 0) lies in the net."""
    environments: tuple[int, ...]
    """Indices of this run's environments among those of all runs that learn together."""
    is_paced: bool
    """The simulation keeps to the wall clock: there is time for what only a watcher sees."""
    resume_from: Path | None
    """A checkpoint directory to continue from."""
    commits: CommitLog
    """Which learner has learnt which ticks of the run."""
    begin_from: Path | None = None
    """A checkpoint or file whose parameters a new policy begins with."""

    @classmethod
    def from_run(cls, run: RunFile) -> "RunConfig":
        """Check the whole run file. Raises `ConfigError`."""
        if missing := [key for key in ("run_dir", "config") if key not in run]:
            raise ConfigError(f"the run file has no `{missing[0]}`", "start the trainer through `caraware train`")
        canonical = json.dumps(run["config"], sort_keys=True, separators=(",", ":")).encode()
        beginning = run.get("beginning")
        first_env = setting(run, "run.first_env", int)
        return cls(
            run_dir=Path(run["run_dir"]),
            trainer=TrainerConfig.from_run(run),
            bounds=MapBounds.from_run(run),
            task=task_of_run(run),
            config_sha256=hashlib.sha256(canonical).hexdigest(),
            dark_is_nan=setting(run, "blackout.policy", BlackoutPolicy) is BlackoutPolicy.NAN,
            training_episodes=setting(run, "episode.training_episodes", int),
            curriculum=Stage.from_run(run),
            evaluation_interval=setting(run, "episode.evaluation_interval", int),
            sensors=SensorNoise.from_run(run),
            net_file=net_of_run(run),
            world_origin_m=world_origin_of_run(run),
            environments=tuple(range(first_env, first_env + setting(run, "run.envs", int))),
            is_paced=setting(run, "run.real_time_factor", float) > 0.0,
            resume_from=Path(beginning["checkpoint"]) if beginning else None,
            commits=CommitLog(run),
            begin_from=_path(config_table(run, "task").get("begin_from", "")),
        )

    def lanes(self) -> LaneMap | None:
        """The map of the baselines, read when the first evaluation begins; None without one."""
        return lanes_of_net(self.net_file, self.world_origin_m) if self.net_file and self.sensors else None

    def shows_estimates(self) -> bool:
        """The Kalman filter runs beside the policy. At full speed it would cost more than the policy."""
        times = self.trainer.estimates
        wanted = times is EstimateTimes.ALWAYS or (times is EstimateTimes.PACED and self.is_paced)
        return wanted and self.sensors is not None

    def progress(self, episode: int) -> float:
        """Share of the training episodes that lie before the run's `episode`-th; evaluations stand between them."""
        interval = self.evaluation_interval
        trained = episode - episode // (interval + 1) if interval > 0 else episode
        return min(1.0, trained / self.training_episodes)


def _path(text: object) -> Path | None:
    """A path that is set."""
    return Path(str(text)) if text else None
