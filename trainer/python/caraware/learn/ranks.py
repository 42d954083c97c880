"""Trainers that learn together: every gradient step is one of all, over the union of what each has collected.

Each rank is the trainer of a run of its own and sees only its own environments. Before an update the ranks exchange
their numbers of samples, and their advantages, rewards and value targets: three numbers for each sample. All
shuffle the union alike and cut it into the same minibatches; a rank works on the rows that are its own, its gradient is
weighted by its share of the minibatch, and the sum over the ranks is the gradient of the whole minibatch. So all take
the step that one trainer with all the samples would take, and keep equal parameters.
"""

import hashlib
import hmac
import json
import logging
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from enum import IntEnum
from typing import Any

import safetensors.torch as safetensors
import torch
from torch import Tensor

from caraware.learn.gpu import has_usable_gpu
from caraware.learn.meeting import Meeting, MeetingError
from caraware.learn.waiting import WaitNotes

log = logging.getLogger("caraware.train")

WAIT_AT_MOST = timedelta(hours=1)
"""For ranks whose simulation is slower. One that has ended is noticed at once: its connections are closed."""
SECRET = "CARAWARE_RANKS_SECRET"
"""Environment variable with a text that the ranks of one launch share, and others do not know."""
LEAST_SECRET = 16
"""Characters of it."""
MOST_BYTES = 1 << 30
"""Of a value that ranks exchange: numbers, and what recurrent networks remember."""


class RankError(Exception):
    """The ranks cannot continue together."""


class Verdict(IntEnum):
    """Where a trainer stands when it could learn; the least of all ranks counts."""

    STOP = 0
    """It was asked to stop."""
    ENDED = 1
    """It will not fill a horizon any more."""
    FULL = 2
    """Its horizon is full."""


@dataclass(frozen=True)
class SampleUnion:
    """The samples of all ranks in the order of the ranks, and which of them are this one's."""

    advantage: Tensor
    """f32 `[S]`, or `[S, k]` with k > 1 actions per observation."""
    reward: Tensor
    """f32 `[S]`."""
    value_target: Tensor
    """f32 `[S]`."""
    offset: int
    """First row that is this rank's."""
    own: int
    """Number of rows that are."""

    def __len__(self) -> int:
        return len(self.advantage)

    def minibatches(self, columns: Sequence[Tensor], order: Tensor, parts: int) -> Iterator["Minibatch"]:
        """The union in `order`, cut into near-equal parts: the own rows of each, gathered at once from `columns`."""
        advantages = self.advantage.index_select(0, order).tensor_split(parts)
        if self.own == len(self):
            gathered = [column.index_select(0, order).tensor_split(parts) for column in columns]
            yield from (
                Minibatch(*part, None, 1.0) for part in zip(zip(*gathered, strict=True), advantages, strict=True)
            )
            return
        is_own = (order >= self.offset) & (order < self.offset + self.own)
        masks = is_own.tensor_split(parts)
        sizes = [int(mask.sum()) for mask in masks]
        rows = order[is_own] - self.offset
        gathered = [column.index_select(0, rows).split(sizes) for column in columns]
        for own, advantage, mask, size in zip(zip(*gathered, strict=True), advantages, masks, sizes, strict=True):
            yield Minibatch(own, advantage, mask, size / len(mask))


@dataclass(frozen=True)
class Minibatch:
    """One rank's part of a minibatch of the union."""

    own: tuple[Any, ...]
    """Its rows of the columns asked for: tensors, or `Sequences` in the place of the observations."""
    advantage: Tensor
    """f32 `[b]`: of the whole minibatch, before normalisation."""
    is_own: Tensor | None
    """bool `[b]`; None if all are."""
    share: float
    """Of the minibatch; the shares of all ranks add up to 1."""

    def mine(self, values: Tensor) -> Tensor:
        """This rank's rows of `values` `[b]`, those of the whole minibatch."""
        return values if self.is_own is None else values[self.is_own]


class Ranks:
    """A trainer that learns alone."""

    rank, size = 0, 1

    def agree(self, verdict: Verdict, episode: int) -> tuple[Verdict, int]:
        """The least verdict and episode of all ranks. Waits for all of them."""
        return verdict, episode

    def all(self, value: bool) -> bool:
        """Whether it is true on all ranks."""
        return value

    def union(self, advantage: Tensor, reward: Tensor, value_target: Tensor) -> SampleUnion:
        """The samples of all, `[s]` (of the advantage `[s]` or `[s, k]`) of this rank given."""
        return SampleUnion(advantage, reward, value_target, 0, len(advantage))

    def tables(self, own: Tensor) -> list[Tensor]:
        """The tables `[rows, columns]` of all ranks, in their order; they may differ in both sizes."""
        return [own]

    def add_up(self, network: str, values: Tensor) -> None:
        """Replace `values` by their sum over the ranks. The networks `policy` and `value` may add up side by side."""

    def largest(self, value: float) -> float:
        """The largest of all ranks."""
        return value

    def gather(self, value: Any) -> list[Any]:
        """The values of all ranks, in their order; what JSON can hold, and tuples come back as lists."""
        return [value]

    def gather_tensors(self, tensors: dict[str, Tensor]) -> list[dict[str, Tensor]]:
        """The tensors of all ranks by their names, in the order of the ranks."""
        return [tensors]

    def check_equal(self, what: str, tensors: Sequence[Tensor]) -> None:
        """Raises `RankError` where they are not the same on all ranks, bit for bit."""

    def note_end(self) -> None:
        """Note that all ranks have written all their results: a successor of one has nothing to learn any more."""

    def close(self) -> None:
        """Part from the others, when all are done."""


def shared_secret(environment: Mapping[str, str]) -> bytes:
    """What the ranks of this launch know and others do not. Raises `RankError` where there is nothing.

    On one machine that is the random identity of a `torchrun --standalone`; several machines need `SECRET`.
    """
    if secret := environment.get(SECRET, ""):
        if len(secret) < LEAST_SECRET:
            raise RankError(f"{SECRET} has {len(secret)} characters; it needs {LEAST_SECRET} (openssl rand -hex 16)")
        return secret.encode()
    if int(environment.get("GROUP_WORLD_SIZE", "1")) > 1:
        raise RankError(
            f"ranks on several machines prove that they belong together: set {SECRET} to the same text on each"
            " (openssl rand -hex 16)"
        )
    return environment.get("TORCHELASTIC_RUN_ID", "").encode()


class TorchRanks(Ranks):
    """A trainer among others that `torchrun` started (`caraware.parallel`)."""

    def __init__(self, ranks: int, meeting: Meeting | None = None, notes: WaitNotes | None = None) -> None:
        """Join the others. Raises `RankError` if they do not come, or are not `ranks`.

        With a `meeting`, at which all have gathered, trainers that come later may form further groups. `notes` are
        made while this trainer waits for others.
        """
        import torch.distributed as dist

        self._dist, self._meeting, self._notes = dist, meeting, notes or WaitNotes()
        if (started := int(os.environ.get("WORLD_SIZE", "0"))) != ranks:
            raise RankError(f"`trainer.ranks` is {ranks}, and torchrun started {started} processes")
        self._is_shared = False
        """Several ranks learn on one GPU, which NCCL refuses: what they add up goes through the CPU."""
        if has_usable_gpu():
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
            self._is_shared = int(os.environ.get("LOCAL_WORLD_SIZE", "1")) > torch.cuda.device_count()
        with self._together("meeting"):
            nccl = has_usable_gpu() and not self._is_shared
            backend = "cpu:gloo,cuda:nccl" if nccl else "gloo"
            if meeting is None:
                dist.init_process_group(backend, timeout=WAIT_AT_MOST)
            else:
                store = meeting.store()
                dist.init_process_group(backend, timeout=WAIT_AT_MOST, world_size=ranks, rank=meeting.rank, store=store)
            self._groups: dict[str, Any] = {network: dist.new_group() for network in ("policy", "value")}
        self.rank, self.size = dist.get_rank(), dist.get_world_size()
        self._authenticate(shared_secret(os.environ))

    def _authenticate(self, secret: bytes) -> None:
        """Each rank proves to each other that it knows the secret. Raises `RankError` if one does not."""
        # A proof covers the random numbers of all: one that was overheard earlier is worth nothing.
        nonces = json.dumps(self.gather(secrets.token_hex(16))).encode()

        def proof(rank: int) -> str:
            return hmac.new(secret, b"%d %s" % (rank, nonces), hashlib.sha256).hexdigest()

        proofs = self.gather(proof(self.rank))
        for rank, given in enumerate(proofs):
            if not isinstance(given, str) or not hmac.compare_digest(given, proof(rank)):
                raise RankError(f"rank {rank} has another secret: set the same {SECRET} on every machine")

    @contextmanager
    def _together(self, doing: str) -> Iterator[None]:
        """What torch says of a lost connection names addresses, not what happened."""
        with self._notes.waiting():
            try:
                yield
            except (MeetingError, RuntimeError, ValueError) as error:
                lost = f"another rank has ended or cannot be reached ({doing}: {str(error).splitlines()[0]})"
                if self._meeting is not None:
                    log.warning("%s; waiting for its successor", lost)
                    self._meeting.await_successor()
                raise RankError(lost) from error

    def agree(self, verdict: Verdict, episode: int) -> tuple[Verdict, int]:
        """See `Ranks.agree`."""
        values = torch.tensor([int(verdict), episode])
        with self._together("waiting for all horizons"):
            self._dist.all_reduce(values, op=self._dist.ReduceOp.MIN)
        return Verdict(int(values[0])), int(values[1])

    def all(self, value: bool) -> bool:
        """See `Ranks.all`."""
        own = torch.tensor([int(value)])
        with self._together("asking all"):
            self._dist.all_reduce(own, op=self._dist.ReduceOp.MIN)
        return bool(own[0])

    def union(self, advantage: Tensor, reward: Tensor, value_target: Tensor) -> SampleUnion:
        """See `Ranks.union`."""
        tries = advantage.reshape(len(reward), -1)
        of_all = self.tables(torch.cat((tries, reward.unsqueeze(1), value_target.unsqueeze(1)), 1))
        before = sum(len(each) for each in of_all[: self.rank])
        columns = torch.cat(of_all).t().contiguous()
        advantages = columns[:-2].t().contiguous().view(-1, *advantage.shape[1:])
        return SampleUnion(advantages, columns[-2], columns[-1], before, len(reward))

    def tables(self, own: Tensor) -> list[Tensor]:
        """See `Ranks.tables`."""
        sizes = self.gather(tuple(own.shape))
        padded = torch.zeros(max(rows for rows, _ in sizes), max(columns for _, columns in sizes), dtype=own.dtype)
        padded[: own.shape[0], : own.shape[1]] = own.cpu()
        of_all = [torch.empty_like(padded) for _ in sizes]
        with self._together("exchanging samples"):
            self._dist.all_gather(of_all, padded)
        return [each[:rows, :columns].to(own.device) for each, (rows, columns) in zip(of_all, sizes, strict=True)]

    def add_up(self, network: str, values: Tensor) -> None:
        """See `Ranks.add_up`."""
        there = values.cpu() if self._is_shared else values
        with self._together("adding up gradients"):
            self._dist.all_reduce(there, group=self._groups[network])
        if there is not values:
            values.copy_(there)

    def largest(self, value: float) -> float:
        """See `Ranks.largest`."""
        return float(max(self.gather(value)))

    def gather(self, value: Any) -> list[Any]:
        """See `Ranks.gather`."""
        return [json.loads(text) for text in self._gather_bytes(json.dumps(value).encode())]

    def gather_tensors(self, tensors: dict[str, Tensor]) -> list[dict[str, Tensor]]:
        """See `Ranks.gather_tensors`."""
        own = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        return [safetensors.load(data) for data in self._gather_bytes(safetensors.save(own))]

    def _gather_bytes(self, own: bytes) -> list[bytes]:
        """Torch's own exchange of objects unpickles what comes, and a pickle can run code: ranks exchange bytes."""
        sizes = [torch.zeros(1, dtype=torch.int64) for _ in range(self._dist.get_world_size())]
        with self._together("exchanging values"):
            self._dist.all_gather(sizes, torch.tensor([len(own)]))
            longest = max(int(size) for size in sizes)
            if not 0 < longest <= MOST_BYTES:
                raise RankError(f"a rank announces a value of {longest} bytes, of {MOST_BYTES} at most")
            padded = torch.zeros(longest, dtype=torch.uint8)
            padded[: len(own)] = torch.frombuffer(bytearray(own), dtype=torch.uint8)
            values = [torch.empty_like(padded) for _ in sizes]
            self._dist.all_gather(values, padded)
        return [bytes(value[: int(size)].numpy()) for value, size in zip(values, sizes, strict=True)]

    def check_equal(self, what: str, tensors: Sequence[Tensor]) -> None:
        """See `Ranks.check_equal`."""
        digest = hashlib.blake2b(digest_size=16)
        for tensor in tensors:
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        digests = self.gather(digest.hexdigest())
        if len(set(digests)) > 1:
            raise RankError(f"{what} differ between the ranks: {', '.join(digests)}")

    def note_end(self) -> None:
        """See `Ranks.note_end`."""
        if self._meeting is not None:
            self._meeting.note_end()

    def close(self) -> None:
        """See `Ranks.close`."""
        if self._meeting is not None:
            self._meeting.part()
        self._dist.destroy_process_group()


def of_run(ranks: int, meeting: Meeting | None = None, notes: WaitNotes | None = None) -> Ranks:
    """Alone, or among the others that `torchrun` started. Raises `RankError`.

    With a `meeting`, waits until all have gathered there. `notes` are made while this trainer waits for others.
    """
    if ranks == 1:
        return Ranks()
    notes = notes or WaitNotes()
    if meeting is not None:
        try:
            with notes.waiting():
                meeting.gather()
        except MeetingError as error:
            raise RankError(str(error)) from error
        if meeting.is_over:
            return Ranks()
    return TorchRanks(ranks, meeting, notes)
