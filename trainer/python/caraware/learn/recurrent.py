"""PPO whose networks remember: what differs from `caraware.learn.ppo` (docs/decisions/0018).

A horizon is walked through tick by tick from the states that the horizon before left. Its trajectories are cut into
sequences of at most `trainer.truncation_ticks`, each with the state that the walk had at its first row; minibatches
are whole sequences, and no gradient reaches back beyond one. Objective, optimisers and statistics are `Ppo`'s.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caraware.ipc.arrays import Int64Array
from caraware.ipc.stream import Observation
from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.fast import FastUpdate, SharedBatch
from caraware.learn.gru import RecurrentNetwork, Sequences, Steps, Walk
from caraware.learn.memory import Memory
from caraware.learn.ppo import ForwardPass, Ppo
from caraware.learn.prediction import Ticks, visible
from caraware.learn.ranks import Minibatch
from caraware.learn.rollout import Horizon
from caraware.tasks.contract import Task

NO_SAMPLE = -1
"""In a table of sequences: a shorter one has no sample there."""


@dataclass(frozen=True)
class RecurrentBatch(Batch):
    """Samples, and which of them follow each other."""

    sequence: Tensor
    """i64 `[c, L]`: rows of each sequence in order, then `NO_SAMPLE`."""
    policy_start: Tensor
    """f32 `[c, h]`: the policy's state before each sequence."""
    value_start: Tensor
    """f32 `[c, h]`: the value network's."""

    def followed_by(self, others: Sequence[Batch]) -> "RecurrentBatch":
        """See `Batch.followed_by`."""
        batches = [self, *(batch for batch in others if isinstance(batch, RecurrentBatch))]
        assert len(batches) == 1 + len(others)
        return RecurrentBatch(
            **vars(super().followed_by(others)),
            sequence=one_table([batch.sequence for batch in batches]),
            policy_start=torch.cat([batch.policy_start for batch in batches]),
            value_start=torch.cat([batch.value_start for batch in batches]),
        )


@dataclass(frozen=True)
class SharedSequences:
    """The sequences of all ranks in the order of the ranks, and which of them are this one's."""

    table: Tensor
    """i64 `[c, L]`: rows of the union."""
    offset: int
    """First sequence that is this rank's."""
    own: int

    def packed(self, chosen: Tensor) -> "PackedSequences":
        """Some of them, longest first, step by step."""
        lengths = (self.table[chosen] != NO_SAMPLE).sum(1)
        longest_first = chosen[lengths.argsort(descending=True, stable=True)]
        by_step = self.table[longest_first].t()
        mine = (longest_first >= self.offset) & (longest_first < self.offset + self.own)
        is_sample, is_mine = by_step != NO_SAMPLE, mine.expand_as(by_step)
        return PackedSequences(
            rows=by_step[is_sample],
            is_own=is_mine[is_sample],
            sizes=(is_sample & is_mine).sum(1),
            own=longest_first[mine] - self.offset,
        )


@dataclass(frozen=True)
class PackedSequences:
    """The samples of some sequences: the first of each, the second of each, and so on."""

    rows: Tensor
    """i64 `[b]`: where they are in the union."""
    is_own: Tensor
    """bool `[b]`: those of this rank."""
    sizes: Tensor
    """i64 `[L]`: how many of this rank's sequences are that long."""
    own: Tensor
    """i64: this rank's sequences, among its own."""


class SequenceUpdate(FastUpdate):
    """A `FastUpdate` whose minibatches are whole sequences."""

    policy_network: RecurrentNetwork
    value_network: RecurrentNetwork

    def _pieces(self, shared: SharedBatch) -> int:
        """Sequences are shuffled, not samples."""
        assert isinstance(shared.batch, RecurrentBatch)
        tables = self.ranks.tables(shared.batch.sequence)
        before = sum(len(table) for table in tables[: self.ranks.rank])
        self._shared = SharedSequences(one_table(tables), before, len(shared.batch.sequence))
        return len(self._shared.table)

    def _minibatches(
        self, network: str, shared: SharedBatch, columns: Sequence[Tensor], order: Tensor
    ) -> Iterator[Minibatch]:
        """Whole sequences, about `batch_size` samples of them."""
        batch, union = shared.batch, shared.union
        assert isinstance(batch, RecurrentBatch)
        starts = batch.policy_start if network == "policy" else batch.value_start
        lengths = (self._shared.table != NO_SAMPLE).sum(1)
        for chosen in cut(order, lengths, shared.minibatches):
            packed = self._shared.packed(chosen)
            rows, sizes = packed.rows[packed.is_own] - union.offset, packed.sizes
            sequences = Sequences(batch.observation[rows], sizes[sizes > 0].cpu(), starts[packed.own])
            own = (sequences, *(column[rows] for column in columns))
            is_all = len(rows) == len(packed.rows)
            share = len(rows) / len(packed.rows)
            yield Minibatch(own, union.advantage[packed.rows], None if is_all else packed.is_own, share)


class RecurrentPpo(Ppo):
    """`Ppo` with memory: what the networks remember at the last tick of the newest horizon is part of its state."""

    updater: SequenceUpdate

    def __init__(
        self,
        config: TrainerConfig,
        task: Task,
        observation_size: int,
        updater: SequenceUpdate,
        sampling: torch.Generator,
        environments: Sequence[int] = (0,),
    ) -> None:
        """See `Ppo`."""
        super().__init__(config, task, observation_size, updater, sampling, environments)
        self._widths = (updater.policy_network.width, updater.value_network.width)
        self.memories = [Memory.nothing(sum(self._widths)) for _ in environments]

    def predictor(self, dark_is_nan: bool, evaluations_alone: bool = True) -> "SequencePredictor":
        """See `Ppo.predictor`. Every tick goes alone."""
        return SequencePredictor(self, dark_is_nan)

    def policy_memory(self, environment: int) -> Memory:
        """What the policy remembers of an environment, after the last tick of its newest horizon."""
        return self.memories[environment].part(0, self._widths[0])

    def memory_tensors(self) -> dict[str, Tensor]:
        """See `Ppo.memory_tensors`: by the number of the environment."""
        named = zip(self._environments, self.memories, strict=True)
        return {name: tensor for number, memory in named for name, tensor in memory.tensors(f"{number}").items()}

    def restore_memory(self, tensors: dict[str, Tensor]) -> None:
        """See `Ppo.restore_memory`."""
        nothing = Memory.nothing(sum(self._widths))
        self.memories = [Memory.restored(tensors, f"{number}") or nothing for number in self._environments]

    @torch.no_grad()
    def score(self, horizon: Horizon, environment: int = 0) -> RecurrentBatch:
        """See `Ppo.score`. The next horizon of the environment begins with the memory that this one leaves."""
        goes_on = continues(horizon)
        rows = horizon.valid.flatten().nonzero().squeeze(1)
        slots = horizon.valid.shape[1]
        steps = Steps(
            observation=self.task.network_input(
                horizon.observation.flatten(0, 1).index_select(0, rows).to(self.device)
            ),
            slot=(rows % slots).to(self.device),
            goes_on=goes_on.flatten()[rows].to(self.device),
            sizes=horizon.valid.sum(1).tolist(),
        )
        start = self.memories[environment].before(int(horizon.tick[0]), horizon.vehicle[0], horizon.cut)
        policy_start, value_start = start.to(self.device).split(self._widths, 1)
        policy = self.updater.policy_network.walk(steps, policy_start)
        value = self.updater.value_network.walk(steps, value_start)
        after = self._value_after(horizon, value)
        forward = ForwardPass(rows, steps.observation, policy.output, value.output.squeeze(1), after)
        scored = self._scored(horizon, forward, environment)
        self.memories[environment] = Memory.after(
            int(horizon.tick[-1]), horizon.vehicle[-1], outlives(horizon), torch.cat((policy.last, value.last), 1).cpu()
        )
        table = sequences(horizon.valid, goes_on, self.config.truncation_ticks).to(self.device)
        first = table[:, 0]
        return RecurrentBatch(
            **vars(scored), sequence=table, policy_start=policy.before[first], value_start=value.before[first]
        )

    def _value_after(self, horizon: Horizon, walk: Walk) -> Tensor | None:
        """f32 `[N]`: the value of what followed the last tick; 0 where the trajectory did not continue."""
        if horizon.bootstrap is None or self.config.discount == 0.0:
            return None
        rows = outlives(horizon).nonzero().squeeze(1)
        observation, state = (each.index_select(0, rows.to(each.device)) for each in (horizon.bootstrap, walk.last))
        value, _ = self.updater.value_network.step(self.task.network_input(observation.to(self.device)), state)
        return torch.zeros(len(horizon.bootstrap)).index_copy_(0, rows, value.squeeze(1).cpu())


class SequencePredictor:
    """Predicts tick by tick with states of its own, of the valid rows of every tick alone."""

    def __init__(self, ppo: RecurrentPpo, dark_is_nan: bool) -> None:
        """It begins with what `ppo` remembers."""
        self._ppo, self._dark_is_nan = ppo, dark_is_nan
        known = [ppo.policy_memory(index) for index in range(len(ppo.memories))]
        self._memories = [{int(memory.tick): memory} for memory in known]
        """Of each environment, by tick: the newest that was taken and those that may be asked for again."""

    def predict_m(self, ticks: Ticks) -> dict[int, list[Tensor]]:
        """See `caraware.learn.prediction.Predictor.predict_m`."""
        return {index: self._of_one(index, of_one) for index, of_one in ticks.items()}

    def _of_one(self, index: int, ticks: Sequence[Observation]) -> list[Tensor]:
        memories, before = self._memories[index], ticks[0].tick - 1
        for old in [tick for tick in memories if tick < before]:
            del memories[old]
        return [self._step_m(memories, obs) for obs in ticks]

    @torch.no_grad()
    def _step_m(self, memories: dict[int, Memory], obs: Observation) -> Tensor:
        network, device = self._ppo.updater.policy_network, self._ppo.device
        valid = torch.from_numpy(np.asarray(obs.valid))
        rows = valid.nonzero().squeeze(1)
        vehicle = torch.from_numpy(np.asarray(obs.vehicle).astype(np.int64))
        cut_before = torch.from_numpy(np.asarray(obs.terminated | obs.truncated))
        known = memories.get(obs.tick - 1) or Memory.nothing(network.width)
        state = known.before(obs.tick, vehicle, cut_before)
        seen = visible(obs, self._dark_is_nan).index_select(0, rows).to(device)
        task = self._ppo.task
        mean, after = network.step(task.network_input(seen), state.index_select(0, rows).to(device))
        memories[obs.tick] = Memory.after(obs.tick, vehicle, valid, state.index_copy_(0, rows, after.cpu()))
        predicted_m = task.answer(mean, seen).cpu()
        return torch.zeros(len(valid), self._ppo.task.actions.size).index_copy_(0, rows, predicted_m)


def outlives(horizon: Horizon) -> Tensor:
    """bool `[N]`: the slot's trajectory was not over, as far as the horizon knows, with its last tick."""
    return horizon.valid[-1] & ~horizon.terminated[-1] & ~horizon.truncated[-1]


def continues(horizon: Horizon) -> Tensor:
    """bool `[T, N]`: the row continues the slot's trajectory; in the first row, as far as the memory says so."""
    went_on = horizon.valid & ~horizon.terminated & ~horizon.truncated
    return torch.cat((torch.ones_like(went_on[:1]), went_on[:-1])) & horizon.valid


def sequences(valid: Tensor, goes_on: Tensor, length: int) -> Tensor:
    """i64 `[c, L]`: the sequences of at most `length` samples that the trajectories of a horizon are cut into.

    `valid` and `goes_on` are bool `[T, N]`; samples are counted tick by tick. Every trajectory is cut from its first
    row in the horizon on, which may be the middle of its life.
    """
    is_valid, follows = valid.numpy(), goes_on.numpy()
    ticks, slots = is_valid.shape
    place, number, count = np.zeros(slots, np.int64), np.zeros(slots, np.int64), 0
    cells: list[tuple[Int64Array, Int64Array]] = []
    for t in range(ticks):
        place = np.where(follows[t] & (t > 0), (place + 1) % length, 0)
        begins = np.flatnonzero(is_valid[t] & (place == 0))
        number[begins] = np.arange(count, count + len(begins))
        count += len(begins)
        rows = np.flatnonzero(is_valid[t])
        cells.append((number[rows], place[rows]))
    numbers, places = (np.concatenate(column) for column in zip(*cells, strict=True))
    table = np.full((count, int(places.max()) + 1), NO_SAMPLE)
    table[numbers, places] = np.arange(len(numbers))
    return torch.from_numpy(table)


def one_table(tables: Sequence[Tensor]) -> Tensor:
    """Tables of sequences `[_, _]` one below the other, rows counted on through all: each has every row once."""
    longest = max(table.shape[1] for table in tables)
    shifted, first = [], 0
    for table in tables:
        rows = torch.where(table == NO_SAMPLE, NO_SAMPLE, table + first)
        shifted.append(torch.nn.functional.pad(rows, (0, longest - table.shape[1]), value=NO_SAMPLE))
        first += int((table != NO_SAMPLE).sum())
    return torch.cat(shifted)


def cut(order: Tensor, lengths: Tensor, parts: int) -> list[Tensor]:
    """Sequences in `order`, i64 `[c]`, in at most `parts` pieces with about as many samples each; `lengths` `[c]`."""
    ordered = lengths[order]
    twice_the_middle = 2 * ordered.cumsum(0) - ordered
    part = twice_the_middle * parts // (2 * int(ordered.sum()))
    return [piece for piece in order.split(torch.bincount(part, minlength=parts).tolist()) if len(piece)]
