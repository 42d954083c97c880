"""A live run as JSON and for Prometheus, whose own parser reads what is served."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.error import URLError
from urllib.request import urlopen

import pytest
from caraware.report.live import families
from prometheus_client.parser import text_string_to_metric_families
from recorded_run import CARAWARE

T = TypeVar("T")
SETTINGS = ("traffic.cavs=4", "traffic.others=3", "run.real_time_factor=5", "fanout.enabled=false")
PATIENCE_S = 120.0


@dataclass(frozen=True)
class LiveRun:
    """A run that lasts as long as a test needs it."""

    process: subprocess.Popen[str]
    environment: dict[str, str]

    def ask(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """What a command prints."""
        return subprocess.run(
            [CARAWARE, *arguments], env=self.environment, capture_output=True, text=True, timeout=PATIENCE_S
        )

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """A command beside the run."""
        return subprocess.Popen(
            [CARAWARE, *arguments], env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def status(self) -> dict[str, Any] | None:
        """The run in `caraware ps --json`; None before it is registered."""
        ran = self.ask("ps", "--json")
        assert ran.returncode == 0, ran.stderr
        runs: list[dict[str, Any]] = json.loads(ran.stdout)
        return next((run for run in runs if run["run"] == "live"), None)


def _eventually(attempt: Callable[[], T | None]) -> T:
    """What `attempt` gives as soon as it gives something."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        found = attempt()
        if found is not None:
            return found
        time.sleep(0.05)
    raise AssertionError("not within two minutes")


@pytest.fixture(scope="module")
def live() -> Iterator[LiveRun]:
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        environment = os.environ | {"CARAWARE_RUNTIME_DIR": f"{short}/r", "CARAWARE_PYTHON": sys.executable}
        words = [word for setting in SETTINGS for word in ("--set", setting)]
        command: list[str | Path] = [CARAWARE, "train", "town", "--name", "live", "--quiet", *words]
        with subprocess.Popen(command, cwd=short, env=environment, text=True) as process:
            run = LiveRun(process, environment)
            try:
                _eventually(lambda: _at_work(run.status()))
                yield run
            finally:
                process.send_signal(signal.SIGINT)
                process.wait(PATIENCE_S)


def _at_work(status: dict[str, Any] | None) -> dict[str, Any] | None:
    """The status once every process has made a tick."""
    return status if status and all(process["tick"] > 20 for process in status["processes"]) else None


def _samples(text: str) -> dict[tuple[str, str], float]:
    """Values by name and process, or by name and nothing for those that have no process."""
    return {
        (sample.name, sample.labels.get("process", "")): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if family.name != "caraware_process_state"
    }


def test_ps_prints_one_document_of_what_its_table_shows(live: LiveRun) -> None:
    status = live.status()
    assert status is not None and status["mode"] == "train"
    names = [process["process"] for process in status["processes"]]
    assert names[:3] == ["traffic-bridge", "sim-core", "sensor-daemon"] and "trainer" in names
    table = live.ask("ps", "live").stdout
    for process in status["processes"]:
        row = next(line.split() for line in table.splitlines() if f" {process['process']} " in line)
        assert int(row[3]) == process["pid"] and Path(f"/proc/{process['pid']}").exists()
        assert process["state"] in ("ready", "running") and process["restarts"] == 0
        assert int(row[4]) >= process["tick"] and process["memory_mib"] > 0
    by_name = {process["process"]: process for process in status["processes"]}
    bridge, daemon = by_name["traffic-bridge"], by_name["sensor-daemon"]
    assert bridge["lag"] == 0 and daemon["lag"] == bridge["tick"] - daemon["tick"]
    (environment,) = status["environments"]
    assert environment["cavs"] == 4 and environment["sim_time_s"] > 0
    # Five times real time is asked for; a busy machine makes less.
    assert 0 < environment["real_time_factor"] < 8
    assert live.ask("ps", "ghost", "--json").returncode == 2


def test_lines_of_json_follow_the_run(live: LiveRun) -> None:
    with live.start("metrics", "live", "--interval-s", "0.5") as process:
        assert process.stdout is not None
        lines = [json.loads(process.stdout.readline()) for _ in range(5)]
        # A reader that leaves ends it, at the next line.
        process.stdout.close()
        assert process.wait(PATIENCE_S) == 0
    ticks = [line["processes"][0]["tick"] for line in lines]
    assert ticks == sorted(ticks) and ticks[-1] > ticks[0]
    assert {line["run"] for line in lines} == {"live"}
    assert live.ask("metrics", "live", "--interval-s", "0").returncode == 2


def test_prometheus_reads_what_ps_shows(live: LiveRun) -> None:
    with live.start("metrics", "live", "--interval-s", "0.5", "--prometheus=127.0.0.1:0") as process:
        assert process.stdout is not None
        announced = process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:(\d+)/metrics", announced)
        assert found, announced
        port = int(found.group(1))

        def scraped() -> dict[tuple[str, str], float] | None:
            with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S) as answer:
                return _samples(answer.read().decode()) or None

        before = _eventually(scraped)
        status = live.status()
        assert status is not None

        def later() -> dict[tuple[str, str], float] | None:
            samples = scraped()
            reached = status["processes"][0]["tick"]
            return samples if samples and samples["caraware_ticks_total", "traffic-bridge"] >= reached else None

        after = _eventually(later)
        for row in status["processes"]:
            name = row["process"]
            first, last = before["caraware_ticks_total", name], after["caraware_ticks_total", name]
            assert 0 < first <= last and first <= row["tick"], name
            assert after["caraware_restarts_total", name] == 0 and after["caraware_drops_total", name] >= 0
            assert ("caraware_lag_ticks", name) in after
        assert after["caraware_sensing_vehicles", ""] == 4
        # It listens on loopback alone: other addresses of this machine refuse.
        with pytest.raises((URLError, OSError)):
            urlopen(f"http://{_own_address()}:{port}/metrics", timeout=5)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 130


def _own_address() -> str:
    """An address of this machine that is not 127.0.0.1: of its network, or another one of loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # A datagram socket that is connected sends nothing.
            probe.connect(("192.0.2.1", 9))
            address = str(probe.getsockname()[0])
        except OSError:
            address = "127.0.0.2"
    return "127.0.0.2" if address == "127.0.0.1" else address


def test_a_port_in_use_and_a_wrong_address_are_refused(live: LiveRun) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for address in (f"127.0.0.1:{taken.getsockname()[1]}", "127.0.0.1:port", "127.0.0.1:70000"):
            ran = live.ask("metrics", "live", f"--prometheus={address}")
            assert ran.returncode == 2 and address in ran.stderr and "Traceback" not in ran.stderr


def test_what_was_not_measured_is_left_out() -> None:
    status = {
        "run": "a",
        "processes": [],
        "environments": [],
        "training": {
            "env_steps": 7,
            "updates": 1,
            "env_steps_per_s": None,
            "policy_std": 0.5,
            "reward": 0.1,
            "measured": [{"name": "error_m", "unit": "m", "value": 4.5}],
        },
    }
    samples = {sample.name: sample for family in families(status) for sample in family.samples}
    assert samples["caraware_metric"].labels == {"run": "a", "metric": "error_m", "unit": "m"}
    assert samples["caraware_env_steps_total"].value == 7 and "caraware_env_steps_per_second" not in samples
    assert "caraware_env_steps_total" not in {s.name for f in families(status | {"training": None}) for s in f.samples}
