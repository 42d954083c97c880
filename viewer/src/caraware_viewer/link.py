"""The zenoh side: finds a run, subscribes to it, and keeps the newest frames: those of one tick together.

zenoh's callbacks only store: a slow display skips frames, and never delays the network or the run.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from urllib.parse import quote, unquote

import zenoh

from caraware_viewer import access
from caraware_viewer.documents import RunMap
from caraware_viewer.layout import SCHEMA_VERSION
from caraware_viewer.sets import EVERY_RUNS_TOPICS, TICK_TOPICS, TickSets
from caraware_viewer.wire import FrameError, decode_header

TOPICS = (*TICK_TOPICS, "status", "learning", "vehicles", "signals", "routes", "event")
MESSAGES = "neighbours"
"""The topic of what is known from messages, which the fan-out sends while a viewer subscribes."""
WHOLE_COURSE = "learning/whole"
"""Name under which the answer to a query for `learning` is stored."""

RESTART_LIMIT_S = 5.0
"""Time without a liveliness token after which the run counts as ended; a dead fan-out is restarted sooner."""

_EMPTY_NAME = "%"
_ATTACHMENT = struct.Struct("<QQ")
_PLAUSIBLE_AGE_MS = 60_000.0


class LinkError(RuntimeError):
    """There is nothing to watch; the message says where the viewer looked and what to do."""


@dataclass(frozen=True)
class RunKey:
    """One environment of one run."""

    run: str
    env: int

    @property
    def prefix(self) -> str:
        """Prefix of the keys."""
        return f"caraware/{encoded(self.run)}/{self.env}"

    @classmethod
    def of_alive_key(cls, key: str) -> RunKey:
        """The run of a liveliness token `caraware/RUN/ENV/alive`."""
        _, run, env, _ = key.split("/")
        return cls("" if run == _EMPTY_NAME else unquote(run), int(env))


def encoded(name: str) -> str:
    """`name` as one part of a key."""
    return quote(name, safe="") or _EMPTY_NAME


@dataclass(frozen=True)
class Sample:
    """A sample of a topic."""

    payload: bytes
    sequence: int | None = None
    """Sequence number on its topic; `None` without an attachment."""
    taken_ns: int | None = None
    """UNIX time at which the fan-out took it out of shared memory; `None` without an attachment."""

    @classmethod
    def of(cls, sample: zenoh.Sample) -> Sample:
        """A sample of zenoh, with the sequence number and time of its attachment."""
        attachment = b"" if sample.attachment is None else bytes(sample.attachment)
        payload = bytes(sample.payload)
        return cls(payload, *_ATTACHMENT.unpack(attachment)) if len(attachment) == _ATTACHMENT.size else cls(payload)

    def age_ms(self) -> float:
        """Age by this machine's clock; NaN if unknown, or if the clocks of both machines clearly differ."""
        age_ms = float("nan") if self.taken_ns is None else (time.time_ns() - self.taken_ns) * 1e-6
        return age_ms if 0 <= age_ms < _PLAUSIBLE_AGE_MS else float("nan")


class LatestFrames:
    """The newest sample of each topic, until it is taken; counts the samples that were replaced and that were lost.

    Of `world`, `observation`, `prediction` and `neighbours` it has the samples of the newest tick that arrived on all
    of them.
    """

    def __init__(self, topics: Collection[str] = EVERY_RUNS_TOPICS) -> None:
        """`topics` are those of a tick that are subscribed to."""
        self._frames: dict[str, Sample] = {}
        self._sets: TickSets[Sample] = TickSets(topics=topics)
        self._changed = threading.Condition()
        self._closed = False
        self.ended = False
        """True once the run has ended."""
        self.skipped: Counter[str] = Counter()
        """Samples that were replaced before they were taken, by topic."""
        self.lost = 0
        """Samples that were lost on the network, from the gaps in the sequence numbers."""
        self._newest: dict[str, int] = {}

    def store(self, topic: str, sample: Sample) -> None:
        """Replaces the newest sample of `topic`."""
        with self._changed:
            if sample.sequence is not None:
                before = self._newest.get(topic, sample.sequence)
                # After a jump back, the samples are of a restarted fan-out.
                self.lost += max(0, sample.sequence - before - 1)
                self._newest[topic] = sample.sequence
            if not self._add_to_set(topic, sample):
                self.skipped[topic] += topic in self._frames
                self._frames[topic] = sample
            self._changed.notify()

    def add(self, topic: str, sample: Sample) -> None:
        """Stores a sample that is older than the subscription, unless there is a newer one."""
        with self._changed:
            if not self._add_to_set(topic, sample):
                self._frames.setdefault(topic, sample)
            self._changed.notify()

    def _add_to_set(self, topic: str, sample: Sample) -> bool:
        """True if the sample belongs to a tick. One without a readable header is kept apart, and refused later."""
        if topic not in TICK_TOPICS:
            return False
        try:
            header = decode_header(sample.payload)
        except FrameError:
            return False
        self._sets.add(topic, (header.run_id, header.tick), sample)
        return True

    def take(self, timeout_s: float) -> dict[str, Sample]:
        """The newest samples since the last call, those of a tick last; waits at most `timeout_s` for one."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._frames) or self._sets.ready() or self._closed, timeout_s)
            frames, self._frames = self._frames, {}
            return frames | self._sets.take(at_once=self._closed)

    def wait_for_close(self, timeout_s: float) -> None:
        """Waits at most `timeout_s` for the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed, max(0.0, timeout_s))

    def close(self) -> None:
        """Ends the wait of `take`: the viewer needs no more frames."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def end(self) -> None:
        """Marks the run as ended, and ends the wait of `take`."""
        self.ended = True
        self.close()

    @property
    def skipped_ticks(self) -> int:
        """Frames of ticks that were not returned because newer ones had arrived."""
        return self._sets.skipped

    @property
    def closed(self) -> bool:
        """True once `close` was called."""
        return self._closed


def connect(endpoint: str, timeout_s: float, credentials: access.Credentials = access.ANONYMOUS) -> zenoh.Session:
    """Opens a session to the fan-out at `endpoint`. Raises `LinkError`."""
    try:
        return access.connect(endpoint, timeout_s, credentials)
    except access.AccessError as error:
        raise LinkError(str(error)) from error


def list_runs(session: zenoh.Session, timeout_s: float) -> list[RunKey]:
    """The runs that this session can watch, by their liveliness tokens."""
    replies = session.liveliness().get("caraware/*/*/alive", timeout=timeout_s)
    keys = {RunKey.of_alive_key(str(reply.ok.key_expr)) for reply in replies if reply.ok}
    return sorted(keys, key=lambda key: (key.run, key.env))


def find_run(
    session: zenoh.Session, endpoint: str, name: str | None, timeout_s: float, env: int | None = None
) -> RunKey:
    """The run called `name`, or the only run, and its environment `env`, or its first. Waits at most `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while True:
        runs = list_runs(session, max(0.5, deadline - time.monotonic()))
        wanted = [key for key in runs if name in (None, key.run) and env in (None, key.env)]
        if len({key.run for key in wanted}) == 1:
            return wanted[0]
        if time.monotonic() > deadline:
            break
        time.sleep(0.1)
    found = ", ".join(sorted({key.run for key in runs})) or "none"
    if wanted:
        raise LinkError(f"{endpoint} has several runs ({found}): name one with --run NAME")
    missing = "no run" if name is None else f"no run called {name!r}"
    missing += "" if env is None else f" with an environment {env}"
    raise LinkError(f"{endpoint} answers, but {missing} appeared there within {timeout_s:g} s (runs there: {found})")


class RunLink:
    """The subscriptions to a run. Use as a context manager."""

    def __init__(self, session: zenoh.Session, run: RunKey, *, messages: bool = False) -> None:
        """`messages` subscribes to what road users know from messages, too."""
        self.run = run
        self._topics = tuple(topic for topic in TOPICS if messages or topic != MESSAGES)
        self.frames = LatestFrames([topic for topic in TICK_TOPICS if topic in self._topics])
        self._session = session
        self._end_timer: threading.Timer | None = None
        # A subscriber ends when it is garbage-collected, so they are kept here.
        self._subscribers = [self._subscribe(topic) for topic in self._topics]
        self._sensors: dict[str, zenoh.Subscriber[None]] = {}
        # zenoh reports the end of a killed peer's token only to clients that have seen the token: hence the history.
        self._tokens = session.liveliness().declare_subscriber(f"{run.prefix}/alive", self._on_token, history=True)
        self._query_newest()

    def __enter__(self) -> RunLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.frames.close()
        self._session.close()

    def map(self, timeout_s: float) -> RunMap:
        """Queries the run's map and tick settings."""
        for reply in self._session.get(f"{self.run.prefix}/map", timeout=timeout_s):
            if reply.ok:
                return _parse_map(bytes(reply.ok.payload), self.run.run)
        raise LinkError(
            f"run {self.run.run!r} did not send its map within {timeout_s:g} s: its fan-out may have just ended"
        )

    def subscribe_sensors(self, topics: Collection[str]) -> None:
        """Subscribes to these topics of mounted sensors, and to no others of them."""
        for topic in self._sensors.keys() - set(topics):
            self._sensors.pop(topic).undeclare()
        for topic in set(topics) - self._sensors.keys():
            self._sensors[topic] = self._subscribe(topic)

    def _subscribe(self, topic: str) -> zenoh.Subscriber[None]:
        def store(sample: zenoh.Sample) -> None:
            self.frames.store(topic, Sample.of(sample))

        return self._session.declare_subscriber(f"{self.run.prefix}/{topic}", store)

    def _query_newest(self) -> None:
        """Queries the values that were published before the subscription."""
        for reply in self._session.get(f"{self.run.prefix}/**", timeout=2.0):
            if reply.ok is None:
                continue
            topic = str(reply.ok.key_expr).removeprefix(f"{self.run.prefix}/")
            if topic in self._topics:
                # Samples of this topic have the newest points only, the answer has all.
                self.frames.add(WHOLE_COURSE if topic == "learning" else topic, Sample.of(reply.ok))

    def _on_token(self, sample: zenoh.Sample) -> None:
        """Ends the run when its token has been away for `RESTART_LIMIT_S`."""
        if self._end_timer is not None:
            self._end_timer.cancel()
            self._end_timer = None
        if sample.kind == zenoh.SampleKind.DELETE:
            self._end_timer = threading.Timer(RESTART_LIMIT_S, self.frames.end)
            self._end_timer.daemon = True
            self._end_timer.start()


def _parse_map(payload: bytes, run: str) -> RunMap:
    """The map, if it has this viewer's schema version."""
    try:
        run_map: RunMap = json.loads(payload)
        version = run_map.get("schema_version", SCHEMA_VERSION)
    except (ValueError, AttributeError) as error:
        raise LinkError(f"the map of run {run!r} cannot be read: {error}") from error
    if version != SCHEMA_VERSION:
        raise LinkError(
            f"run {run!r} has schema version {version}, and this viewer knows {SCHEMA_VERSION}: "
            "install the viewer of the run's version"
        )
    return run_map
