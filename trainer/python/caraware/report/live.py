"""`caraware metrics`: how a live run fares, as lines of JSON or for Prometheus; `caraware ps --json` measures it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

Family = type[CounterMetricFamily] | type[GaugeMetricFamily]

PROCESS_METRICS: Mapping[str, tuple[Family, str, str]] = {
    "caraware_ticks": (CounterMetricFamily, "tick", "Ticks that a process has produced or consumed"),
    "caraware_drops": (CounterMetricFamily, "drops", "Messages dropped towards consumers that are not required"),
    "caraware_restarts": (CounterMetricFamily, "restarts", "Replacements of a process"),
    "caraware_lag_ticks": (GaugeMetricFamily, "lag", "Ticks behind the first process of the environment"),
    "caraware_process_memory_mebibytes": (GaugeMetricFamily, "memory_mib", "Resident memory of a process"),
}
"""Kind, key of a process in `ps --json`, and meaning by name; the name of a counter gets `_total`."""

ENVIRONMENT_METRICS: Mapping[str, tuple[Family, str, str]] = {
    "caraware_episode": (GaugeMetricFamily, "episode", "Episode of the newest observation"),
    "caraware_simulated_seconds": (GaugeMetricFamily, "sim_time_s", "Simulated time of the episode"),
    "caraware_real_time_factor": (GaugeMetricFamily, "real_time_factor", "Simulated seconds per wall second"),
    "caraware_vehicle_steps_per_second": (GaugeMetricFamily, "steps_per_s", "Observations of a vehicle per second"),
    "caraware_road_users": (GaugeMetricFamily, "road_users", "Road users of the newest tick"),
    "caraware_sensing_vehicles": (GaugeMetricFamily, "cavs", "Vehicles with sensors in the newest tick"),
}
"""The same of an environment."""

TRAINING_METRICS: Mapping[str, tuple[Family, str, str]] = {
    "caraware_env_steps": (CounterMetricFamily, "env_steps", "Samples used for training"),
    "caraware_updates": (CounterMetricFamily, "updates", "Updates of the policy"),
    "caraware_env_steps_per_second": (GaugeMetricFamily, "env_steps_per_s", "Samples per wall second, lately"),
    "caraware_policy_std": (GaugeMetricFamily, "policy_std", "Standard deviation of the policy"),
    "caraware_reward": (GaugeMetricFamily, "reward", "Mean reward, lately"),
}
"""The same of the training, which also has `caraware_metric` for each metric of the task."""


def families(status: Mapping[str, Any]) -> Iterator[Metric]:
    """The metrics of a run in `ps --json`."""
    run = str(status["run"])
    processes = []
    for row in status["processes"]:
        # The name has the environment behind it if the run has several.
        process, _, environment = str(row["process"]).partition("/")
        processes.append(([run, process, environment or "0"], row))
    yield from _families(PROCESS_METRICS, ["run", "process", "environment"], processes)
    labels = ["run", "process", "environment", "state"]
    state = GaugeMetricFamily("caraware_process_state", "1 for the state of a process", labels=labels)
    for values, row in processes:
        state.add_metric([*values, row["state"]], 1)
    yield state
    environments = [([run, str(row["environment"])], row) for row in status["environments"]]
    yield from _families(ENVIRONMENT_METRICS, ["run", "environment"], environments)
    training = status["training"]
    if training is None:
        return
    yield from _families(TRAINING_METRICS, ["run"], [([run], training)])
    measured = GaugeMetricFamily("caraware_metric", "A metric of the task, lately", labels=["run", "metric", "unit"])
    for metric in training["measured"]:
        measured.add_metric([run, metric["name"], metric["unit"]], metric["value"])
    yield measured


def _families(
    table: Mapping[str, tuple[Family, str, str]],
    labels: Sequence[str],
    rows: Iterable[tuple[list[str], Mapping[str, Any]]],
) -> Iterator[Metric]:
    listed = list(rows)
    for name, (kind, key, meaning) in table.items():
        family = kind(name, meaning, labels=labels)
        for values, row in listed:
            # JSON has no not-a-number: what was not measured is null.
            if row[key] is not None:
                family.add_metric(values, row[key])
        yield family


class NewestStatus:
    """A collector of the newest measurement."""

    def __init__(self) -> None:
        self.status: Mapping[str, Any] | None = None

    def collect(self) -> Iterator[Metric]:
        """The metrics, none before the first measurement."""
        return iter(()) if self.status is None else families(self.status)


def measured(run: str, interval_s: float) -> Iterator[dict[str, Any]]:
    """The run in `ps --json`, measured each `interval_s` seconds of wall time until it has ended."""
    due = time.monotonic()
    while True:
        ran = subprocess.run([os.environ["CARAWARE"], "ps", run, "--json"], capture_output=True, text=True, check=False)
        # A run that has ended is refused; one that ends while it is measured is in no list.
        found = json.loads(ran.stdout) if ran.returncode == 0 else []
        if not found:
            return
        yield found[0]
        due = max(due + interval_s, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0.0))


def serve(run: str, interval_s: float, address: str) -> int:
    """Answer Prometheus until the run has ended; 2 for an address that cannot be used."""
    host, _, port = address.rpartition(":")
    host = host.strip("[]") or "127.0.0.1"
    newest, registry = NewestStatus(), CollectorRegistry()
    registry.register(newest)
    try:
        server, _ = start_http_server(int(port), addr=host, registry=registry)
    except (OSError, ValueError, OverflowError) as error:
        print(f"caraware metrics: cannot listen at {address}: {error}", file=sys.stderr)
        return 2
    # The port is the system's choice if 0 was asked for.
    print(f"Prometheus is answered at http://{host}:{server.server_port}/metrics until the run ends", flush=True)
    for status in measured(run, interval_s):
        newest.status = status
    server.shutdown()
    return 0


def main(arguments: Sequence[str]) -> int:
    """Print or serve until the run has ended, or until the reader of the lines leaves."""
    parser = argparse.ArgumentParser(prog="caraware metrics")
    parser.add_argument("run")
    parser.add_argument("--interval-s", type=float, default=1.0)
    parser.add_argument("--prometheus", metavar="HOST:PORT")
    options = parser.parse_args(arguments)
    # A shell that starts it in the background has Ctrl-C ignored: a signal that is sent ends it nevertheless.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        if options.prometheus:
            return serve(options.run, options.interval_s, options.prometheus)
        for status in measured(options.run, options.interval_s):
            print(json.dumps(status), flush=True)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Nothing more can be written, not even at the end of the interpreter.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
