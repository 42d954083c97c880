"""The training loop: ticks of all environments in, predictions out, an update whenever a horizon is full."""

import json
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caraware.ipc.arrays import FloatArray
from caraware.ipc.stream import Channel, Observation
from caraware.learn.batch import Batch, save_batch
from caraware.learn.build import build_ppo
from caraware.learn.ppo import NonFiniteLoss, Ppo, UpdateStats
from caraware.learn.prediction import visible
from caraware.learn.ranks import RankError, Ranks, Verdict
from caraware.learn.rewards import distance_m
from caraware.learn.supervised import Supervised
from caraware.report.evaluation import NO_HEADLINE, Evaluation, EvaluationResult, Mean, errors_m, pooled, raw_errors_m
from caraware.report.metrics import Metrics, TrainingPoint
from caraware.report.plots import plot_error, plot_sigma
from caraware.run.checkpoint import (
    Course,
    Keeping,
    checkpoint_name,
    load_checkpoint,
    load_course,
    mark_best,
    save_checkpoint,
)
from caraware.run.config import RunConfig
from caraware.run.curriculum import Curriculum
from caraware.run.environment import Environment, Place, share
from caraware.run.manifest import Counters
from caraware.tasks.localisation import Localisation

log = logging.getLogger(__name__)

CREDIT_TICKS = 8
"""The simulation gets its credit back after so many ticks, or when no more wait: each time it is woken."""
RECEIVE_TIMEOUT_S = 0.2
"""How long a request to stop may wait for the next tick."""


@dataclass
class Learner:
    """Policy, value network and how far they have come: new, or continued from a checkpoint."""

    ppo: Ppo
    supervised: Supervised | None
    """The baseline by regression, taught from the same batches."""
    counters: Counters
    course: Course

    @classmethod
    def begin(cls, config: RunConfig, observation_size: int, ranks: Ranks | None = None) -> "Learner":
        """A learner for observations of this size, continued from `config.resume_from`. Raises `CheckpointError`."""
        trainer = config.trainer
        ppo = build_ppo(trainer, observation_size, config.task, config.environments, ranks)
        beside = None
        if trainer.supervised and isinstance(config.task, Localisation):
            beside = Supervised(trainer, observation_size, config.task, ppo.device, ranks)
        learner = cls(ppo, beside, Counters(0, 0, 0, -1), Course())
        if config.resume_from is not None:
            learner.load(config.resume_from)
        return learner

    def warm_up(self) -> None:
        """Let everything that the first prediction needs be there before it is waited for."""
        self.ppo.predict_m([torch.zeros(1, self.ppo.observation_size)])

    def load(self, checkpoint: Path) -> None:
        """Continue from a checkpoint. Raises `CheckpointError`."""
        self.counters = load_checkpoint(checkpoint, self.ppo, self.supervised)
        self.course = load_course(checkpoint)

    def take_parameters(self, checkpoint: Path) -> None:
        """Parameters, moments and generators of any checkpoint; the count of updates and ticks stays this run's."""
        updates = self.ppo.updates
        load_checkpoint(checkpoint, self.ppo, self.supervised)
        self.ppo.updates = updates
        # What another network remembers of other ticks says nothing about this run's.
        self.ppo.restore_memory({})

    def places(self) -> list[Place]:
        """Where each environment stands; one that the checkpoint does not know stands at its beginning."""
        counters, course = self.counters, self.course
        first = Place(
            committed_tick=counters.committed_tick,
            received_ticks=course.received_ticks,
            lost_ticks=course.lost_ticks,
            duplicated_ticks=course.duplicated_ticks,
            evaluated_tick=course.evaluated_tick,
            next_episode=counters.next_episode,
            next_episode_tick=counters.next_episode_tick,
        )
        return [first, *course.others]

    def first_tick(self, environment: int = 0) -> int:
        """The first tick of an environment that is not in the checkpoint."""
        places = self.places()
        return places[environment].committed_tick + 1 if environment < len(places) else 0


class TrainingLoop:
    """One run of the trainer over the channels of its environments."""

    def __init__(
        self,
        channel: Channel,
        config: RunConfig,
        stop_requested: Callable[[], bool],
        *,
        others: Sequence[Channel] = (),
        leave_requested: Callable[[], bool] = lambda: False,
        learner: Learner | None = None,
        ranks: Ranks | None = None,
    ) -> None:
        """`channel` is environment 0's, `others` those of the further ones; `ranks` are those who learn together.

        Without a `learner`, one begins at the first tick. A request to leave is met where a successor can go on.
        """
        self._channel, self._config, self._stop_requested = channel, config, stop_requested
        self._ranks = ranks or Ranks()
        self._environments = [Environment(i, each, config) for i, each in enumerate((channel, *others))]
        self._leave_requested, self._left = leave_requested, False
        self._metrics = Metrics(config.run_dir / "tensorboard")
        self._ppo: Ppo | None = None
        self._supervised: Supervised | None = None
        self._env_steps = self._passed_steps = self._vehicles = 0
        """Samples seen, and those among them that came when no horizon could be filled any more."""
        self._saved_updates = -1
        self._others_stopped = False
        self._agreed_episode = 0
        self._learns = True
        """Until an environment ends before its share of the horizon is full."""
        self._raw_gnss_error_m = Mean()
        """Since the last update."""
        self._curriculum = Curriculum(config.curriculum, channel)
        self._curriculum.begin(learner.course.curriculum if learner else None)
        self._lesson_end: Observation | None = None
        """Last tick of a lesson that is not decided about yet."""
        self._commit_due = False
        if learner is not None:
            self._start(learner)

    def run(self) -> bool:
        """Train until the last tick or a request to stop; then commit, plot and write `parts/trainer.json`.

        False if it left to a successor instead, after a commit.
        """
        while not (self._left or self._ended() or self._stopped()):
            self._receive()
            self._consume()
        if self._learns and not self._left:
            self._agree(Verdict.STOP if self._stopped() else Verdict.ENDED)
        if self._left:
            self._leave()
            return False
        for environment in self._environments:
            self._finish_evaluation(environment)
        if self._ppo is not None and self._ppo.updates != self._saved_updates:
            self.commit()
        self._metrics.close()
        self._draw()
        self._write_part()
        if self._ended():
            for environment in self._environments:
                environment.channel.done()
        log.info("%s after %d updates", "run complete" if self._ended() else "stopped", self._updates())
        if self._others_stopped and not self._stop_requested():
            raise RankError(f"another rank was asked to stop, after update {self._updates()}")
        return True

    def _stopped(self) -> bool:
        """Whether this trainer, or one that it learns together with, has been asked to stop."""
        return self._others_stopped or self._stop_requested()

    def _agree(self, verdict: Verdict) -> bool:
        """Whether all who learn together can learn. If not they never will again, and each ends by itself."""
        assert not self._others_stopped
        agreed, self._agreed_episode = self._ranks.agree(verdict, self._episode())
        self._learns = agreed is Verdict.FULL
        self._others_stopped = agreed is Verdict.STOP
        return self._learns

    def _ended(self) -> bool:
        return all(environment.ended for environment in self._environments)

    def _ensure_started(self, first: Observation) -> None:
        """The first tick tells the size of the observation, which the networks need."""
        if self._ppo is None:
            self._start(Learner.begin(self._config, first.observation.shape[1], self._ranks))

    def _start(self, learner: Learner) -> None:
        """Go on where `learner` stands."""
        trainer, counters, course = self._config.trainer, learner.counters, learner.course
        self._ppo, self._supervised = learner.ppo, learner.supervised
        size, places, count = self._ppo.observation_size, learner.places(), len(self._environments)
        self._env_steps, self._vehicles = counters.env_steps, course.vehicles
        for environment in self._environments:
            place = places[environment.index] if environment.index < len(places) else Place()
            environment.start(place, share(trainer.horizon, count, environment.index), size)
            environment.episode = counters.episode
        if counters.updates > 0:
            self._saved_updates = counters.updates
            self._metrics.resume(course.training, course.evaluations, counters.env_steps)
        self._sample_clock = (time.monotonic(), self._env_steps)
        self._predictor = self._ppo.predictor(self._config.dark_is_nan)
        log.info("observations of %d fields, %s", size, self._config.trainer)

    def _receive(self) -> None:
        """Take what waits in the environments that may go on; wait for a tick if there is none."""
        going_on = [environment for environment in self._environments if self._may_go_on(environment)]
        if any(environment.pending for environment in going_on):
            return
        alone = len(self._environments) == 1
        for environment in going_on:
            if environment.listens and (ticks := environment.channel.receive(RECEIVE_TIMEOUT_S if alone else 0.0)):
                self._ensure_started(ticks[0])
                environment.admit(list(ticks))
        if not alone and not any(environment.pending for environment in going_on):
            self._channel.wait_for_any(RECEIVE_TIMEOUT_S)

    def _may_go_on(self, environment: Environment) -> bool:
        """An environment whose share of the horizon is full waits for the update, and for the policy after it."""
        return not (self._learns and self._ppo is not None and environment.rollout.full())

    def _consume(self) -> None:
        """Predict for all waiting ticks at once, then take them until the horizon is full; learn if it is."""
        going_on = [each for each in self._environments if each.pending and self._may_go_on(each)]
        if going_on:
            assert self._ppo is not None
            predicted_m = self._predictor.predict_m({each.index: each.pending for each in going_on})
            for environment in going_on:
                raw_m = raw_errors_m(environment.pending)
                if not self._take_all(environment, predicted_m[environment.index], raw_m):
                    return
        if self._ppo is not None and self._learns:
            self._learn_or_give_up()
        self._end_lesson()
        # A lesson that ended with the horizon is part of the checkpoint: its last tick will not come again.
        if self._commit_due:
            self.commit()

    def _take_all(self, environment: Environment, predicted_m: list[Tensor], raw_m: list[FloatArray]) -> bool:
        """Take waiting ticks while the environment may go on; False if a successor takes over."""
        taken = 0
        for prediction_m, raw_error_m in zip(predicted_m, raw_m, strict=True):
            if not self._may_go_on(environment):
                break
            obs = environment.pending.popleft()
            self._take(environment, obs, prediction_m, raw_error_m)
            taken += 1
            if taken % CREDIT_TICKS == 0:
                environment.channel.consumed(obs.tick)
            if obs.lesson_last:
                self._lesson_end = obs
                break
            # What comes in an evaluation, or after an update, a successor can take up as well.
            if obs.evaluation and self._leave_requested():
                self._left = True
                break
        if taken % CREDIT_TICKS:
            environment.channel.consumed(obs.tick)
        return not self._left

    def _learn_or_give_up(self) -> None:
        full = [environment.rollout.full() for environment in self._environments]
        if all(full):
            if self._agree(Verdict.FULL):
                self._learn()
                self._left = self._leave_requested()
        elif any(environment.ended and not full[environment.index] for environment in self._environments):
            self._agree(Verdict.ENDED)

    def _supervised_errors_m(self, obs: Observation) -> FloatArray | None:
        """Of the baseline that is taught beside the policy, on the valid rows; None without it."""
        if self._supervised is None:
            return None
        rows = torch.from_numpy(np.flatnonzero(obs.valid))
        observation = visible(obs, self._config.dark_is_nan)
        predicted_m = self._supervised.predict_m(observation.index_select(0, rows))
        return distance_m(predicted_m, obs.truth.index_select(0, rows)).numpy()

    def _take(self, environment: Environment, obs: Observation, predicted_m: Tensor, raw_m: FloatArray) -> None:
        """Everything that one tick causes; `raw_m` are the errors of raw GNSS on its valid rows."""
        assert self._ppo is not None
        channel = environment.channel
        estimates_m = environment.estimates_m(obs)
        if estimates_m is None:
            channel.publish_predictions(obs, predicted_m, self._updates())
        else:
            channel.publish_predictions(obs, predicted_m, self._updates(), estimates_m)
        environment.episode = obs.episode
        environment.starts.note(obs)
        self._vehicles = max(self._vehicles, int(np.count_nonzero(obs.valid)))
        if obs.evaluation:
            environment.rollout.ended(obs)
            # A predecessor may have evaluated ticks that it had not learnt up to.
            if obs.tick > environment.evaluated_tick:
                environment.evaluation = environment.evaluation or Evaluation(
                    self._config.sensors, supervised=self._supervised is not None
                )
                policy_m, _ = errors_m(obs, predicted_m)
                environment.evaluation.add(obs, policy_m, raw_m, self._supervised_errors_m(obs))
                environment.evaluation_tick = obs.tick
            return
        self._finish_evaluation(environment)
        self._raw_gnss_error_m.add(raw_m)
        self._env_steps += len(raw_m)
        if self._learns:
            environment.rollout.add(obs)
        else:
            self._passed_steps += len(raw_m)

    def _end_lesson(self) -> None:
        """Before the next lesson the simulation waits for its stage of the curriculum."""
        if self._lesson_end is not None and self._ppo is not None:
            error_m = self._metrics.training[-1].error_m if self._metrics.training else math.nan
            self._curriculum.lesson_ended(self._lesson_end, self._env_steps, self._ppo.sigma(), error_m)
        self._lesson_end = None

    def _learn(self) -> None:
        """One update, while the simulation already makes the next ticks."""
        assert self._ppo is not None
        horizons = [environment.rollout.take() for environment in self._environments]
        batch = Batch.joined([self._ppo.score(horizon, index) for index, horizon in enumerate(horizons)])
        self._ppo.progress = self._progress()
        try:
            stats = self._ppo.update(batch)
        except NonFiniteLoss as error:
            error.batch_file = self._config.run_dir / "logs" / f"nonfinite-update-{error.update:06d}.safetensors"
            save_batch(batch, self._ppo.updater.parameters(), error.batch_file)
            raise
        if self._supervised is not None:
            self._supervised.learn(batch, stats.learning_rate)
        for environment, horizon in zip(self._environments, horizons, strict=True):
            environment.committed_tick = horizon.last_tick()
        self._record(stats, batch.metrics["error_m"].double().mean().item())
        self._commit_due = self._ppo.updates % self._config.trainer.checkpoint_interval_updates == 0

    def _progress(self) -> float:
        """Share of training that is behind."""
        if self._curriculum:
            return self._curriculum.share(self._config.training_episodes)
        return self._config.progress(self._agreed_episode)

    def _episode(self) -> int:
        """The episode of the environment that is farthest behind."""
        return min(environment.episode for environment in self._environments)

    def _record(self, stats: UpdateStats, error_m: float) -> None:
        raw_gnss_error_m = self._raw_gnss_error_m.value()
        self._raw_gnss_error_m = Mean()
        now, (since, steps) = time.monotonic(), self._sample_clock
        self._sample_clock = (now, self._env_steps)
        rate = (self._env_steps - steps) / max(now - since, 1e-9)
        point = TrainingPoint(self._env_steps, stats.sigma, stats.reward_mean, error_m, raw_gnss_error_m, rate)
        self._metrics.updated(point, stats, self._channel.lag_ticks())
        self._channel.report(
            episode=self._episode(),
            env_steps=self._env_steps,
            env_steps_per_s=rate,
            policy_std=stats.sigma,
            reward=stats.reward_mean,
            metrics={"error_m": error_m, "raw_gnss_error_m": raw_gnss_error_m},
            updates=self._updates(),
        )

    def _number(self, environment: Environment) -> int:
        """Its index among the environments of all ranks."""
        numbers = self._config.environments
        return numbers[environment.index] if environment.index < len(numbers) else environment.index

    def _finish_evaluation(self, environment: Environment) -> None:
        """Close the evaluation phase of an environment, if one is open."""
        evaluation, environment.evaluation = environment.evaluation, None
        result = evaluation.result(self._env_steps, self._updates(), self._number(environment)) if evaluation else None
        if result is not None:
            environment.evaluated_tick = environment.evaluation_tick
            self._metrics.evaluated(result)
            log.info("evaluation at %d env steps: %s", result.env_steps, result)
            self._keep_best(result)

    def _keep_best(self, result: EvaluationResult) -> None:
        """Let `best` name a checkpoint of the policy that was evaluated, if none before had less error.

        Ranks would have to agree on it, and environments to have finished the same phase: only one of one does it.
        """
        if self._ranks.size > 1 or len(self._environments) > 1:
            return
        errors_m = [other.ppo_mean_error_m for other in self._metrics.evaluations if other.policy_version > 0]
        if result.policy_version > 0 and result.ppo_mean_error_m <= min(errors_m):
            if self._saved_updates != result.policy_version:
                self.commit()
            mark_best(self._config.run_dir / "checkpoints" / checkpoint_name(result.policy_version))

    def commit(self) -> None:
        """Write a checkpoint of everything learnt so far."""
        assert self._ppo is not None
        folder = self._config.run_dir / "checkpoints"
        committed_tick = self._environments[0].committed_tick
        counters = Counters(
            self._updates(),
            self._trained_steps(),
            self._episode(),
            committed_tick,
            *self._environments[0].starts.behind(committed_tick),
        )
        keep = Keeping.of(self._config.trainer)
        course, random, memory = self._of_all_ranks()
        config = self._config.config_sha256
        saved = save_checkpoint(folder, self._ppo, counters, config, keep, course, random, memory, self._supervised)
        log.info("checkpoint %s, learnt up to tick %d", saved.name, committed_tick)
        # Learnt is what all ranks have kept.
        self._ranks.gather(None)
        self._saved_updates, self._commit_due = counters.updates, False
        for environment in self._environments:
            if environment.committed_tick >= 0:
                environment.channel.committed(environment.committed_tick)

    def _of_all_ranks(self) -> tuple[Course, dict[str, Tensor], dict[str, Tensor]]:
        """How training went, the states of the random numbers, and what networks remember.

        Of a rank's own environments, from which it goes on; rank 0's is that of one trainer that has them all.
        """
        assert self._ppo is not None
        own = self._course()
        self._ranks.check_equal("the parameters", list(self._ppo.updater.parameters().values()))
        states = {name: generator.get_state() for name, generator in self._ppo.sampling_generators().items()}
        places = [environment.place() for environment in self._environments]
        everybody = self._ranks.gather((places, states, self._ppo.memory_tensors()))
        if self._ranks.rank > 0:
            return own, {}, {}
        beside = [place for theirs, *_ in everybody[1:] for place in theirs]
        random = {name: state for _, theirs, _ in everybody for name, state in theirs.items()}
        memory = {name: tensor for *_, theirs in everybody for name, tensor in theirs.items()}
        return replace(own, others=[*own.others, *beside]), random, memory

    def _course(self) -> Course:
        """How training went, of what the checkpoint contains."""
        first, *others = (environment.place() for environment in self._environments)
        return Course(
            received_ticks=first.received_ticks,
            lost_ticks=first.lost_ticks,
            duplicated_ticks=first.duplicated_ticks,
            vehicles=self._vehicles,
            evaluated_tick=first.evaluated_tick,
            curriculum=self._curriculum.saved(),
            evaluations=self._metrics.evaluations,
            training=self._metrics.training,
            others=others,
        )

    def _leave(self) -> None:
        """Commit what is learnt and make room for a successor; it gets every tick since again."""
        if self._updates() > max(self._saved_updates, 0):
            self.commit()
        self._metrics.close()
        log.info("left to a successor after %d updates", self._updates())

    def _draw(self) -> None:
        folder = self._config.run_dir / "plots"
        plot_error(folder / "error.png", self._metrics.training, pooled(self._metrics.evaluations))
        plot_sigma(folder / "sigma.png", self._metrics.training)

    def _write_part(self) -> None:
        """The trainer's part of the run's report. The headline errors are the last evaluation's."""
        everybody = self._ranks.gather((self._metrics.evaluations, self._env_steps))
        phases = pooled([result for results, _ in everybody for result in results])
        ledgers = [environment.ledger for environment in self._environments] if self._ppo else []
        part = {
            "env_steps": self._env_steps,
            "ranks": self._ranks.size,
            "env_steps_of_all_ranks": sum(steps for _, steps in everybody),
            **(phases[-1].headline() if phases else NO_HEADLINE),
            "rts_note": "the smoother sees the future: a bound, not an estimator",
            "policy_std": self._ppo.sigma() if self._ppo else None,
            "updates": self._updates(),
            "vehicles": self._vehicles,
            "curriculum": self._curriculum.report(),
            "received_ticks": sum(ledger.received for ledger in ledgers),
            "lost_ticks": sum(ledger.lost for ledger in ledgers),
            "duplicated_ticks": sum(ledger.duplicated for ledger in ledgers),
            "untrained_env_steps": self._env_steps - self._trained_steps(),
            "evaluations": [asdict(result) for result in phases],
        }
        file = self._config.run_dir / "parts" / "trainer.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(part, indent=2) + "\n")

    def _trained_steps(self) -> int:
        """Samples that an update has learnt from; the rest waits in the rollouts, or came when none could be filled."""
        if self._ppo is None:
            return 0
        pending = sum(environment.rollout.pending_samples() for environment in self._environments)
        return self._env_steps - self._passed_steps - pending

    def _updates(self) -> int:
        return self._ppo.updates if self._ppo else 0
