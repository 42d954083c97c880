"""The training loop: ticks of all environments in, predictions out, an update whenever a horizon is full."""

import logging
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from torch import Tensor

from caraware.ipc.arrays import FloatArray
from caraware.ipc.stream import Channel, Observation
from caraware.learn.batch import Batch, save_batch
from caraware.learn.drawing import DrawingPredictor
from caraware.learn.ppo import NonFiniteLoss, UpdateStats
from caraware.learn.ranks import RankError, Ranks, Verdict
from caraware.learn.rollout import DrawnTick
from caraware.report.evaluation import EvaluationResult, pooled
from caraware.report.metrics import Metrics, TrainingPoint
from caraware.run.checkpoint_writer import CheckpointWriter
from caraware.run.config import RunConfig
from caraware.run.curriculum import Curriculum
from caraware.run.environment import Environment, share
from caraware.run.evaluation_phase import EvaluationPhase
from caraware.run.learner import Learner
from caraware.run.report_part import write_part
from caraware.run.sample_count import SampleCount
from caraware.run.stream_position import StreamPosition
from caraware.run.trips import EndedTrips, has_trips, sum_of

log = logging.getLogger(__name__)

CREDIT_TICKS = 8
"""Returns credit to the simulation every 8 ticks, or when none waits: each time it is woken."""
RECEIVE_TIMEOUT_S = 0.2
"""How long a request to stop may wait for the next tick."""


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
        leave_now_requested: Callable[[], bool] = lambda: False,
        learner: Learner | None = None,
        ranks: Ranks | None = None,
    ) -> None:
        """`channel` is environment 0's, `others` those of the further ones; `ranks` are the trainers learning together.

        Without a `learner`, one begins at the first tick. A request to leave is met where nothing has to be learnt
        again; at once where no tick comes (a paused run), and where it is to be met now.
        """
        self._channel, self._config, self._stop_requested = channel, config, stop_requested
        self._ranks = ranks or Ranks()
        self._environments = [Environment(i, each, config) for i, each in enumerate((channel, *others))]
        self._phases = [EvaluationPhase(config, self._number(i)) for i in range(len(self._environments))]
        self._leave_requested, self._left = leave_requested, False
        self._leave_now_requested, self._idle_waits = leave_now_requested, 0
        self._task, self._metrics = config.task, Metrics(config.run_dir / "tensorboard", config.task.metrics)
        self._ended_trips = EndedTrips()
        self._learner: Learner | None = None
        self._samples, self._vehicles = SampleCount(), 0
        self._others_stopped = False
        self._agreed_episode = 0
        self._learns = True
        """Until an environment ends before its share of the horizon is full."""
        self._curriculum = Curriculum(config.curriculum, channel)
        self._curriculum.begin(learner.history.curriculum if learner else None)
        self._lesson_end: Observation | None = None
        """Last tick of a lesson whose gate is not decided yet."""
        self._checkpoints = CheckpointWriter(
            config, self._ranks, self._environments, self._curriculum, self._metrics, stop_requested
        )
        self._commit_due = False
        if learner is not None:
            self._start(learner)

    def run(self) -> bool:
        """Train until the last tick or a request to stop; then commit, plot and write `parts/trainer.json`.

        False if it left to a successor instead, after a commit.
        """
        while not (self._left or self._ended() or self._stopped()):
            self._receive()
            if self._leave_now_requested() or (self._idle_waits > 1 and self._may_leave_alone()):
                self._left = True
                break
            self._consume()
        if self._learns and not self._left:
            self._agree(Verdict.STOP if self._stopped() else Verdict.ENDED)
        if self._left:
            self._leave()
            return False
        # The end of training: the last evaluation, the last commit, the report.
        for environment in self._environments:
            self._finish_evaluation(environment)
        if self._learner is not None and self._updates() != self._checkpoints.saved_updates:
            self.commit()
        self._metrics.close()
        if self._config.trainer.plots:
            self._draw()
        self._write_part()
        if self._ranks.all(self._ended()):
            self._ranks.note_end()
        if self._ended():
            for environment in self._environments:
                environment.channel.done()
        log.info("%s after %d updates", "run complete" if self._ended() else "stopped", self._updates())
        if self._others_stopped and not self._stop_requested():
            raise RankError(f"another rank was asked to stop, after update {self._updates()}")
        return True

    def commit(self) -> None:
        """Write a checkpoint of everything learned so far."""
        assert self._learner is not None
        self._checkpoints.write(self._learner, self._trained_steps(), self._episode(), self._vehicles)
        self._commit_due = False

    def _start(self, learner: Learner) -> None:
        """Continue from the position of `learner`."""
        trainer, counters, history = self._config.trainer, learner.counters, learner.history
        self._learner = learner
        size, positions, count = learner.ppo.observation_size, learner.positions(), len(self._environments)
        self._samples, self._vehicles = SampleCount(counters.env_steps), history.vehicles
        for environment in self._environments:
            index = environment.index
            position = positions[index] if index < len(positions) else StreamPosition()
            horizon, follows_another = share(trainer.horizon, count, index), learner.follows_another
            environment.start(position, horizon, size, follows_another=follows_another)
            environment.episode = counters.episode
        if counters.updates > 0:
            self._checkpoints.saved_updates = counters.updates
            self._metrics.resume(history.training, history.evaluations, counters.env_steps)
        self._predictor = learner.ppo.predictor(self._config.dark_is_nan)
        log.info("observations of %d fields, %s", size, self._config.trainer)

    def _receive(self) -> None:
        """Queue the ticks that wait in the environments that may continue; wait for a tick if there is none."""
        continuing = [environment for environment in self._environments if self._may_continue(environment)]
        if any(environment.pending for environment in continuing):
            self._idle_waits = 0
            return
        alone = len(self._environments) == 1
        for environment in continuing:
            if environment.listens and (ticks := environment.channel.receive(RECEIVE_TIMEOUT_S if alone else 0.0)):
                if self._learner is None:
                    # The first tick has the size of the observation, which the networks need.
                    self._start(Learner.begin(self._config, ticks[0].observation.shape[1], self._ranks))
                environment.admit(list(ticks))
        if any(environment.pending for environment in continuing):
            self._idle_waits = 0
            return
        self._idle_waits += 1
        if not alone:
            self._channel.wait_for_any(RECEIVE_TIMEOUT_S)

    def _may_continue(self, environment: Environment) -> bool:
        """An environment whose share of the horizon is full waits for the update, and for the policy after it."""
        return not (self._learns and self._learner is not None and environment.rollout.full())

    def _consume(self) -> None:
        """Predict for all waiting ticks at once, then process them until the horizon is full; learn if it is."""
        continuing = [each for each in self._environments if each.pending and self._may_continue(each)]
        if continuing:
            predicted_m = self._predictor.predict_m({each.index: each.pending for each in continuing})
            for environment in continuing:
                references = self._task.measure_references(environment.pending)
                if not self._process_waiting(environment, predicted_m[environment.index], references):
                    return
        if self._learner is not None and self._learns:
            self._learn_or_give_up(self._learner)
        self._end_lesson()
        # A lesson that ended with the horizon is part of the checkpoint: its last tick will not come again.
        if self._commit_due:
            self.commit()

    def _process_waiting(
        self, environment: Environment, predicted_m: list[Tensor], references: Mapping[str, list[FloatArray]]
    ) -> bool:
        """Process waiting ticks while the environment may continue; False if this trainer leaves to a successor.

        `references` are the task's reference metrics on the valid rows of each tick.
        """
        processed = 0
        for index, prediction_m in enumerate(predicted_m):
            if not self._may_continue(environment):
                break
            obs = environment.pending.popleft()
            self._process(environment, obs, prediction_m, {name: ticks[index] for name, ticks in references.items()})
            processed += 1
            if processed % CREDIT_TICKS == 0:
                environment.channel.consumed(obs.tick)
            if self._curriculum and obs.lesson_last:
                self._lesson_end = obs
                break
            # A successor can continue amid an evaluation, or after an update.
            if obs.evaluation and self._may_leave_alone():
                self._left = True
                break
        if processed % CREDIT_TICKS:
            environment.channel.consumed(obs.tick)
        return not self._left

    def _process(
        self, environment: Environment, obs: Observation, predicted_m: Tensor, references: Mapping[str, FloatArray]
    ) -> None:
        """Publish the prediction of one tick, then evaluate it or collect it."""
        assert self._learner is not None
        channel, progress = environment.channel, environment.progress
        drawn: DrawnTick | None = None
        if isinstance(self._predictor, DrawingPredictor):
            drawn = self._predictor.drawn(environment.index, obs.tick)
            self._publish_actions(environment, obs, predicted_m)
        elif (estimates_m := environment.estimates_m(obs)) is None:
            channel.publish_predictions(obs, predicted_m, self._updates())
        else:
            channel.publish_predictions(obs, predicted_m, self._updates(), estimates_m)
        environment.episode = obs.episode
        progress.starts.note(obs)
        samples = int(np.count_nonzero(obs.valid))
        self._vehicles = max(self._vehicles, samples)
        if obs.tick <= environment.answered_by_another:
            self._pass(environment, obs, samples, references)
            return
        if obs.evaluation:
            environment.rollout.ended(obs)
            self._phases[environment.index].add(progress, obs, predicted_m, references, self._learner.supervised)
            return
        self._finish_evaluation(environment)
        self._samples.add(samples, references, learns=self._learns)
        if self._learns:
            environment.rollout.add(obs, drawn)

    def _pass(
        self, environment: Environment, obs: Observation, samples: int, references: Mapping[str, FloatArray]
    ) -> None:
        """Neither learn from a tick nor evaluate it: the world has gone on with what another policy drew.

        The last of them is committed at once, so that a trainer that comes again receives only ticks that it drew.
        """
        if not obs.evaluation:
            self._samples.add(samples, references, learns=False)
        if obs.tick == environment.answered_by_another:
            environment.progress.committed_tick = obs.tick
            # The trainers of several ranks commit together, after their next update.
            self._commit_due |= self._ranks.size == 1
            log.info("ticks up to %d were driven by another policy, and are not learnt from", obs.tick)

    def _publish_actions(self, environment: Environment, obs: Observation, actions: Tensor) -> None:
        """Publish the actions of one tick, unless the world has gone on with what a predecessor drew."""
        environment.trips.add(obs)
        # If the world waits for these after all, they are sent as soon as no further tick comes.
        awaited = environment.is_awaited(obs)
        environment.channel.publish_actions(obs, actions.detach().numpy(), self._updates(), now=awaited)

    def _learn_or_give_up(self, learner: Learner) -> None:
        """Learn if every horizon is full; give up learning if one can never be filled."""
        full = [environment.rollout.full() for environment in self._environments]
        if all(full):
            if self._agree(Verdict.FULL):
                self._learn(learner)
                self._left = self._ranks.all(self._leave_requested())
        elif any(environment.ended and not full[environment.index] for environment in self._environments):
            self._agree(Verdict.ENDED)

    def _learn(self, learner: Learner) -> None:
        """One update, while the simulation already makes the next ticks."""
        ppo = learner.ppo
        horizons = [environment.rollout.take() for environment in self._environments]
        batch = Batch.joined([ppo.score(horizon, index) for index, horizon in enumerate(horizons)])
        ppo.progress = self._share_done()
        try:
            stats = ppo.update(batch)
        except NonFiniteLoss as error:
            error.batch_file = self._config.run_dir / "logs" / f"nonfinite-update-{error.update:06d}.safetensors"
            save_batch(batch, ppo.updater.parameters(), error.batch_file)
            raise
        if learner.supervised is not None:
            learner.supervised.learn(batch, stats.learning_rate)
        for environment, horizon in zip(self._environments, horizons, strict=True):
            environment.progress.committed_tick = horizon.last_tick()
        self._report(stats, {name: values.double().mean().item() for name, values in batch.metrics.items()})
        self._commit_due = ppo.updates % self._config.trainer.checkpoint_interval_updates == 0

    def _report(self, stats: UpdateStats, of_policy: Mapping[str, float]) -> None:
        """Record an update, and publish how training goes."""
        rate, of_references = self._samples.since_last_update()
        metrics = {**of_policy, **of_references}
        env_steps = self._samples.env_steps
        point = TrainingPoint(env_steps, stats.sigma, stats.reward_mean, metrics, rate)
        tick = self._environments[0].progress.committed_tick
        ends = None
        if has_trips(self._task):
            ends = self._ended_trips.take(environment.trips.training for environment in self._environments)
        self._metrics.updated(point, stats, self._channel.lag_ticks(), tick, ends)
        self._channel.report(
            episode=self._episode(),
            env_steps=env_steps,
            env_steps_per_s=rate,
            policy_std=stats.sigma,
            reward=stats.reward_mean,
            metrics=metrics,
            updates=self._updates(),
        )

    def _end_lesson(self) -> None:
        """Decide the gate after a lesson: the simulation waits for the stage of the next one."""
        if self._lesson_end is not None and self._learner is not None:
            metrics = self._metrics.training[-1].metrics if self._metrics.training else {}
            sigma = self._learner.ppo.sigma()
            self._curriculum.lesson_ended(self._lesson_end, self._samples.env_steps, sigma, metrics)
        self._lesson_end = None

    def _finish_evaluation(self, environment: Environment) -> None:
        """Close the evaluation phase of an environment, if one is open; keep the checkpoint of the best policy."""
        phase, updates = self._phases[environment.index], self._updates()
        result = phase.finish(environment.progress, self._samples.env_steps, updates)
        if result is None:
            return
        self._metrics.evaluated(result)
        if self._checkpoints.is_best(result):
            if self._checkpoints.saved_updates != result.policy_version:
                self.commit()
            self._checkpoints.mark_best(result.policy_version)

    def _agree(self, verdict: Verdict) -> bool:
        """Whether all trainers that learn together can learn. If not they never will again, and each ends by itself."""
        assert not self._others_stopped
        agreed, self._agreed_episode = self._ranks.agree(verdict, self._episode())
        self._learns = agreed is Verdict.FULL
        self._others_stopped = agreed is Verdict.STOP
        return self._learns

    def _may_leave_alone(self) -> bool:
        """Whether a successor waits, and no other trainer has to leave at the same update."""
        return self._ranks.size == 1 and self._leave_requested()

    def _stopped(self) -> bool:
        """Whether this trainer, or one that learns together with it, has been asked to stop."""
        return self._others_stopped or self._stop_requested()

    def _ended(self) -> bool:
        return all(environment.ended for environment in self._environments)

    def _leave(self) -> None:
        """Commit what is learned and leave to a successor, which receives every tick since then again."""
        if self._updates() > max(self._checkpoints.saved_updates, 0):
            self.commit()
        self._metrics.close()
        log.info("left to a successor after %d updates", self._updates())

    def _draw(self) -> None:
        # Loaded here: matplotlib takes a fifth of the time in which a trainer starts.
        from caraware.report.plots import plot_headline, plot_sigma

        folder = self._config.run_dir / "plots"
        metrics = self._metrics
        try:
            plot_headline(folder, self._task.metrics[0], metrics.training, pooled(metrics.evaluations))
            plot_sigma(folder / "sigma.png", metrics.training)
        except OSError as error:
            metrics.dropped.drop("plots", error)

    def _write_part(self) -> None:
        """The trainer's part of the run's report, with the evaluations of all ranks."""
        env_steps = self._samples.env_steps
        own = [result.report() for result in self._metrics.evaluations]
        every_rank = self._ranks.gather((own, env_steps))
        ledgers = [environment.progress.ledger for environment in self._environments] if self._learner else []
        entries = {
            "env_steps": env_steps,
            "ranks": self._ranks.size,
            "env_steps_of_all_ranks": sum(steps for _, steps in every_rank),
            "policy_std": self._learner.ppo.sigma() if self._learner else None,
            "updates": self._updates(),
            "vehicles": self._vehicles,
            "curriculum": self._curriculum.report(),
            "received_ticks": sum(ledger.received for ledger in ledgers),
            "lost_ticks": sum(ledger.lost for ledger in ledgers),
            "duplicated_ticks": sum(ledger.duplicated for ledger in ledgers),
            "untrained_env_steps": env_steps - self._trained_steps(),
            "dropped": self._metrics.dropped.report(),
        }
        if has_trips(self._task) and self._learner:
            entries["trips"] = {
                phase: sum_of(getattr(environment.trips, phase) for environment in self._environments)
                for phase in ("training", "evaluation")
            }
        phases = pooled([EvaluationResult.restored(result) for results, _ in every_rank for result in results])
        write_part(self._config.run_dir, entries, phases, self._task.metrics[0].name, self._stop_requested)

    def _number(self, index: int) -> int:
        """The index of an environment among those of all ranks."""
        numbers = self._config.environments
        return numbers[index] if index < len(numbers) else index

    def _share_done(self) -> float:
        """Share of training that is done."""
        if self._curriculum:
            return self._curriculum.share(self._config.training_episodes)
        return self._config.progress(self._agreed_episode)

    def _episode(self) -> int:
        """The episode of the environment that is farthest behind."""
        return min(environment.episode for environment in self._environments)

    def _trained_steps(self) -> int:
        """Samples that an update has learned from; others wait in the rollouts, or are passed."""
        if self._learner is None:
            return 0
        pending = sum(environment.rollout.pending_samples() for environment in self._environments)
        return self._samples.env_steps - self._samples.passed_steps - pending

    def _updates(self) -> int:
        return self._learner.ppo.updates if self._learner else 0
