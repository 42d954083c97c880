"""The zenoh side: find a run, listen to it, keep the newest frame of each topic.

zenoh's callbacks only store: a slow display skips frames, it never holds up the network or the run.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote, unquote

import zenoh

from caraware_viewer import access
from caraware_viewer.wire import SCHEMA_VERSION

TOPICS = ("world", "observation", "prediction", "status", "vehicles", "signals", "event")
CLOUDS = "pointcloud/"
"""Topics of point clouds begin with this; a vehicle's id follows."""

RETURN_S = 5.0
"""How long a fan-out may be away before its run counts as ended: long enough to be started again."""

_EMPTY_NAME = "%"
_ATTACHMENT = struct.Struct("<QQ")
_PLAUSIBLE_AGE_MS = 60_000.0


class LinkError(RuntimeError):
    """There is nothing to watch; the message says where it was looked for and what to do."""


@dataclass(frozen=True)
class RunKey:
    """One environment of one run."""

    run: str
    env: int

    @property
    def prefix(self) -> str:
        """Prefix of its keys."""
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
    """What came on a topic."""

    payload: bytes
    sequence: int | None = None
    """Number of the sample on its topic, if it says."""
    taken_ns: int | None = None
    """UNIX time at which it was taken out of shared memory, if it says."""

    @classmethod
    def of(cls, sample: zenoh.Sample) -> Sample:
        """With the attachment: sequence number and time."""
        attachment = b"" if sample.attachment is None else bytes(sample.attachment)
        payload = bytes(sample.payload)
        return cls(payload, *_ATTACHMENT.unpack(attachment)) if len(attachment) == _ATTACHMENT.size else cls(payload)

    def age_ms(self) -> float:
        """Age by this machine's clock; NaN if unknown or if the clocks plainly differ."""
        age_ms = float("nan") if self.taken_ns is None else (time.time_ns() - self.taken_ns) * 1e-6
        return age_ms if 0 <= age_ms < _PLAUSIBLE_AGE_MS else float("nan")


class LatestFrames:
    """The newest sample of each topic that was not taken; counts those that nobody saw and those that never came."""

    def __init__(self) -> None:
        self._frames: dict[str, Sample] = {}
        self._changed = threading.Condition()
        self._closed = False
        self.ended = False
        """True once the run has ended."""
        self.skipped: Counter[str] = Counter()
        """Samples that were replaced before anybody took them, by topic."""
        self.lost = 0
        """Samples that the network dropped, by their sequence numbers."""
        self._newest: dict[str, int] = {}

    def store(self, topic: str, sample: Sample) -> None:
        """Replaces the newest sample of `topic`."""
        with self._changed:
            if sample.sequence is not None:
                before = self._newest.get(topic, sample.sequence)
                # A jump back is a fan-out that was started again.
                self.lost += max(0, sample.sequence - before - 1)
                self._newest[topic] = sample.sequence
            self.skipped[topic] += topic in self._frames
            self._frames[topic] = sample
            self._changed.notify()

    def add(self, topic: str, sample: Sample) -> None:
        """Stores an older sample, unless there is a newer one."""
        with self._changed:
            self._frames.setdefault(topic, sample)
            self._changed.notify()

    def take(self, timeout_s: float) -> dict[str, Sample]:
        """All samples that came since the last call, waiting at most `timeout_s` for one."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._closed, timeout_s)
            frames, self._frames = self._frames, {}
            return frames

    def close(self) -> None:
        """No more frames are wanted: ends the wait of `take`."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def end(self) -> None:
        """The run is over: no more frames will come."""
        self.ended = True
        self.close()

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


def alive(session: zenoh.Session, timeout_s: float) -> list[RunKey]:
    """The runs that are fanned out behind this session."""
    replies = session.liveliness().get("caraware/*/*/alive", timeout=timeout_s)
    keys = {RunKey.of_alive_key(str(reply.ok.key_expr)) for reply in replies if reply.ok}
    return sorted(keys, key=lambda key: (key.run, key.env))


def choose(session: zenoh.Session, endpoint: str, name: str | None, timeout_s: float, env: int | None = None) -> RunKey:
    """The run called `name`, or the only one, its environment `env` or its first; waits for it at most `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while True:
        runs = alive(session, max(0.5, deadline - time.monotonic()))
        wanted = [key for key in runs if name in (None, key.run) and env in (None, key.env)]
        if len({key.run for key in wanted}) == 1:
            return wanted[0]
        if time.monotonic() > deadline:
            break
        time.sleep(0.1)
    there = ", ".join(sorted({key.run for key in runs})) or "none"
    if wanted:
        raise LinkError(f"several runs are fanned out at {endpoint} ({there}): name one with --run NAME")
    what = "no run" if name is None else f"no run called {name!r}"
    what += "" if env is None else f" with an environment {env}"
    raise LinkError(f"{endpoint} answers, but {what} is fanned out there within {timeout_s:g} s (there: {there})")


class Link:
    """A run being watched. Use as a context manager."""

    def __init__(self, session: zenoh.Session, run: RunKey) -> None:
        self.run = run
        self.frames = LatestFrames()
        self._session = session
        self._farewell: threading.Timer | None = None
        # Subscribers end when they are collected: keep them.
        self._subscribers = [self._subscribe(topic) for topic in TOPICS]
        self._clouds: dict[str, zenoh.Subscriber] = {}
        # With the history: a client is told that a killed peer's token is gone only if it knew of it.
        self._tokens = session.liveliness().declare_subscriber(f"{run.prefix}/alive", self._on_token, history=True)
        self._catch_up()

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self.frames.close()
        self._session.close()

    def map(self, timeout_s: float) -> dict[str, Any]:
        """The run's map and tick settings."""
        for reply in self._session.get(f"{self.run.prefix}/map", timeout=timeout_s):
            if reply.ok:
                return _known(bytes(reply.ok.payload), self.run.run)
        raise LinkError(
            f"run {self.run.run!r} did not tell its map within {timeout_s:g} s: is its fan-out being killed?"
        )

    def follow_clouds(self, vehicles: Iterable[str]) -> None:
        """Subscribes to the point clouds of these vehicles, by their ids, and of no others."""
        wanted = {CLOUDS + encoded(vehicle) for vehicle in vehicles}
        for topic in self._clouds.keys() - wanted:
            self._clouds.pop(topic).undeclare()
        for topic in wanted - self._clouds.keys():
            self._clouds[topic] = self._subscribe(topic)

    def _subscribe(self, topic: str) -> zenoh.Subscriber:
        def store(sample: zenoh.Sample) -> None:
            self.frames.store(topic, Sample.of(sample))

        return self._session.declare_subscriber(f"{self.run.prefix}/{topic}", store)

    def _catch_up(self) -> None:
        """Asks for what was published before the subscription."""
        for reply in self._session.get(f"{self.run.prefix}/**", timeout=2.0):
            topic = str(reply.ok.key_expr).removeprefix(f"{self.run.prefix}/") if reply.ok else ""
            if topic in TOPICS:
                self.frames.add(topic, Sample.of(reply.ok))

    def _on_token(self, sample: zenoh.Sample) -> None:
        if self._farewell is not None:
            self._farewell.cancel()
            self._farewell = None
        if sample.kind == zenoh.SampleKind.DELETE:
            self._farewell = threading.Timer(RETURN_S, self.frames.end)
            self._farewell.daemon = True
            self._farewell.start()


def _known(payload: bytes, run: str) -> dict[str, Any]:
    """The map, if it is one of this viewer's version."""
    try:
        run_map = json.loads(payload)
        version = run_map.get("schema_version", SCHEMA_VERSION)
    except (ValueError, AttributeError) as error:
        raise LinkError(f"the map of run {run!r} is not what this viewer knows: {error}") from error
    if version != SCHEMA_VERSION:
        raise LinkError(
            f"run {run!r} speaks schema version {version}, this viewer {SCHEMA_VERSION}: "
            "install the viewer of the run's version"
        )
    return run_map
