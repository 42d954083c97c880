"""PPO whose policy sees: what differs from `caraware.learn.ppo` (docs/decisions/0044).

The samples of a horizon have stacks of images (`caraware.learn.frames`). The images of the newest ticks before a
horizon are part of the learner's state, so a checkpoint holds them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from caraware.ipc.stream import Observation
from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.frames import RecentFrames, Seen, Stacks, images_of
from caraware.learn.ppo import ForwardPass, PlainUpdate, Ppo
from caraware.learn.prediction import Predictor, Ticks, visible
from caraware.learn.rollout import Horizon
from caraware.tasks.contract import Task

ROWS_AT_ONCE = 1024
"""Of a forward pass without gradient: what lies between the layers stays within the caches."""


@dataclass(frozen=True)
class SeeingBatch(Batch):
    """Samples with the images that they were seen in."""

    frames: Tensor
    """u8 `[f, channels, height, width]`: images of all slots and ticks, a view of the rollout's buffer."""
    stack: Tensor
    """i64 `[s, frames]`: where the images of each sample are among them, the oldest first."""

    @property
    def stacks(self) -> Stacks:
        """The stack of each sample."""
        return Stacks(self.frames, self.stack)

    def followed_by(self, others: Sequence[Batch]) -> "SeeingBatch":
        """See `Batch.followed_by`."""
        batches = [self, *(batch for batch in others if isinstance(batch, SeeingBatch))]
        assert len(batches) == 1 + len(others)
        firsts = torch.tensor([0, *(len(batch.frames) for batch in batches[:-1])]).cumsum(0).tolist()
        return SeeingBatch(
            **vars(super().followed_by(others)),
            frames=torch.cat([batch.frames for batch in batches]),
            stack=torch.cat([batch.stack + first for batch, first in zip(batches, firsts, strict=True)]),
        )


class SeeingUpdate(PlainUpdate):
    """A `PlainUpdate` whose policy takes stacks of images beside the fields."""

    def _input(self, batch: Batch, rows: Tensor) -> Seen:
        """Bring the stacks of a minibatch together."""
        assert isinstance(batch, SeeingBatch)
        stacks = batch.stacks.of(rows.to(batch.stack.device))
        return Seen(batch.observation[rows], stacks.to(self.device))

    @torch.no_grad()
    def mean_seen(self, rows: Tensor, stacks: Stacks) -> Tensor:
        """Mean actions `[n, a]` of fields `[n, d]` and their stacks."""
        return torch.cat([self._policy(seen) for seen in in_parts(rows, stacks, self.device)])


class SeeingPpo(Ppo):
    """`Ppo` whose policy sees: the newest images before the next horizon are part of its state."""

    updater: SeeingUpdate

    def __init__(
        self,
        config: TrainerConfig,
        task: Task,
        observation_size: int,
        updater: SeeingUpdate,
        sampling: torch.Generator,
        environments: Sequence[int] = (0,),
    ) -> None:
        """See `Ppo`; `config.images` is not None."""
        super().__init__(config, task, observation_size, updater, sampling, environments)
        assert config.images is not None
        self.shape_of_images = config.images
        self.recent = [self._nothing() for _ in environments]

    def _nothing(self) -> RecentFrames:
        return RecentFrames.nothing(self.shape_of_images, self.config.frames)

    @torch.no_grad()
    def predict_m(self, observations: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """See `Ppo.predict_m`; of rows without images, as if every image were 0."""
        return tuple(self.answers(rows, self._unseen(len(rows))) for rows in observations)

    def answers(self, rows: Tensor, stacks: Stacks) -> Tensor:
        """What is published for fields `[n, d]` and their stacks: the policy's mean."""
        mean = self.updater.mean_seen(self.task.network_input(rows), stacks)
        return self.task.answer(mean.cpu(), rows)

    def _unseen(self, rows: int) -> Stacks:
        frames = torch.zeros(1, *self.shape_of_images.size, dtype=torch.uint8)
        return Stacks(frames, torch.zeros(rows, self.config.frames, dtype=torch.int64))

    def predictor(self, dark_is_nan: bool, evaluations_alone: bool = True) -> Predictor:
        """See `Ppo.predictor`. Every tick goes alone."""
        return SeeingPredictor(self, dark_is_nan)

    @torch.no_grad()
    def score(self, horizon: Horizon, environment: int = 0) -> SeeingBatch:
        """See `Ppo.score`. The stacks of the environment's next horizon reach back into this one."""
        assert horizon.images is not None
        rows = horizon.valid.flatten().nonzero().squeeze(1)
        observation = self.task.network_input(horizon.observation.flatten(0, 1).index_select(0, rows))
        places, self.recent[environment] = self.recent[environment].lead_into(horizon)
        stacks = Stacks(horizon.images.flatten(0, 1), places.flatten(0, 1)[rows])
        mean = self.updater.mean_seen(observation, stacks)
        observation = observation.to(self.device)
        after = None
        if horizon.bootstrap is not None and self.config.discount > 0.0:
            after = self.updater.value(self.task.network_input(horizon.bootstrap.to(self.device))).cpu()
        forward = ForwardPass(rows, observation, mean, self.updater.value(observation), after)
        scored = self._scored(horizon, forward, environment)
        return SeeingBatch(**vars(scored), frames=stacks.frames, stack=stacks.places)

    def memory_tensors(self) -> dict[str, Tensor]:
        """See `Ppo.memory_tensors`: the newest images, by the number of the environment."""
        named = zip(self._environments, self.recent, strict=True)
        return {name: tensor for number, recent in named for name, tensor in recent.tensors(f"{number}").items()}

    def restore_memory(self, tensors: dict[str, Tensor]) -> None:
        """See `Ppo.restore_memory`."""
        self.recent = [RecentFrames.restored(tensors, f"{number}") or self._nothing() for number in self._environments]


class SeeingPredictor:
    """Predicts tick by tick, with the images of the ticks before, of the valid rows of every tick alone."""

    def __init__(self, ppo: SeeingPpo, dark_is_nan: bool) -> None:
        """It begins with what `ppo` has seen."""
        self._ppo, self._dark_is_nan = ppo, dark_is_nan
        self._histories = [FrameHistory(ppo.config, recent) for recent in ppo.recent]

    def predict_m(self, ticks: Ticks) -> dict[int, list[Tensor]]:
        """See `caraware.learn.prediction.Predictor.predict_m`."""
        for index, of_one in ticks.items():
            self._histories[index].forget_before(of_one[0].tick)
        return {index: [self._one(index, obs) for obs in of_one] for index, of_one in ticks.items()}

    def _one(self, index: int, obs: Observation) -> Tensor:
        valid = torch.from_numpy(obs.valid)
        rows = valid.nonzero().squeeze(1)
        stacks = self._histories[index].stacks(obs)
        answers = torch.zeros(len(valid), self._ppo.task.actions.size)
        if len(rows):
            seen = visible(obs, self._dark_is_nan).index_select(0, rows)
            answers[rows] = self._ppo.answers(seen, Stacks(stacks.frames, stacks.places[rows]))
        return answers


class FrameHistory:
    """The stacks of the ticks of one environment as they come. Ticks may be asked for again."""

    def __init__(self, config: TrainerConfig, recent: RecentFrames | None = None) -> None:
        """It begins with what was seen before, if anything was."""
        assert config.images is not None
        self._shape = config.images
        self._nothing = RecentFrames.nothing(config.images, config.frames)
        recent = recent or self._nothing
        self._by_tick = {int(recent.tick): recent}

    def forget_before(self, tick: int) -> None:
        """Ticks before this one are not asked for again."""
        for old in [known for known in self._by_tick if known < tick - 1]:
            del self._by_tick[old]

    def stacks(self, obs: Observation) -> Stacks:
        """The stack of each slot of a tick."""
        recent = self._by_tick.get(obs.tick - 1) or self._nothing
        stacks, self._by_tick[obs.tick] = recent.followed_by(obs, images_of(obs, self._shape))
        frames = len(self._nothing.frames) + 1
        of_slots = torch.arange(len(stacks) * frames).view(len(stacks), frames)
        return Stacks(stacks.view(-1, *self._shape.size), of_slots)


def in_parts(rows: Tensor, stacks: Stacks, device: torch.device) -> Iterator[Seen]:
    """Fields and stacks of some samples after others, brought together on a device."""
    for part in torch.arange(len(rows)).split(ROWS_AT_ONCE):
        yield Seen(rows[part].to(device), stacks.of(part).to(device))
