"""`caraware-viewer command`: commands to a run on another host, for those whom its `fanout.commanders` names."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

import zenoh

from caraware_viewer import access
from caraware_viewer.link import LinkError, RunKey, choose
from caraware_viewer.wire import SCHEMA_VERSION

ANSWER_S = 15.0
"""Longest wait for the simulation's answer; the run itself gives up after 12 s."""

_EXAMPLES = """Examples:
  caraware-viewer command tls/lab:7447 --user alice --password-file pw --ca ca.pem pause
  caraware-viewer command tls/lab:7447 --user alice --password-file pw --ca ca.pem sensor cav.3 gnss off
  caraware-viewer command tcp/127.0.0.1:7447 step 10

Exit codes: 0 done, 1 refused or nobody answers, 2 usage."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Sends one command and prints the answer."""
    options = _parser().parse_args(arguments)
    try:
        session = access.connect(options.endpoint, options.timeout, access.of_options(options))
        try:
            run = choose(session, options.endpoint, options.run, options.timeout)
            reply = ask(session, run, control(options))
        finally:
            session.close()
    except (access.AccessError, LinkError) as error:
        print(f"caraware-viewer command: {error}", file=sys.stderr)
        return 1
    if "done" in reply:
        print(f"{run.run}: tick {reply['done']['tick']}: {reply['done']['message']}")
        return 0
    refusal = reply.get("refused", {})
    print(f"caraware-viewer command: refused: {refusal.get('message')} ({refusal.get('kind')})", file=sys.stderr)
    return 1


def control_key(run: RunKey) -> str:
    """Key that takes the commands of `run`."""
    return "caraware-control" + run.prefix.removeprefix("caraware")


def ask(session: zenoh.Session, run: RunKey, command: dict[str, Any], timeout_s: float = ANSWER_S) -> dict[str, Any]:
    """The answer to `command`: `{"done": …}` or `{"refused": …}`. Raises `LinkError` if there is none."""
    request = json.dumps({"schema_version": SCHEMA_VERSION, "control": command})
    for reply in session.get(control_key(run), payload=request, timeout=timeout_s):
        if reply.ok:
            return json.loads(bytes(reply.ok.payload))
    raise LinkError(
        f"run {run.run!r} does not take our command: it may be watched, "
        "but only those whom its `fanout.commanders` names may command"
    )


def control(options: argparse.Namespace) -> dict[str, Any]:
    """The command that these options name, as it is sent."""
    command: dict[str, Any] = {"command": options.command}
    for name in ("ticks", "vehicle", "sensor", "state", "edge"):
        if hasattr(options, name):
            command[name] = getattr(options, name)
    if options.command == "sensor" and options.vehicle == "all":
        command["vehicle"] = None
    return command


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="caraware-viewer command",
        description="Send a command to a run, from another host, as somebody whom it lets command.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("endpoint", help="the run's `fanout.listen`, as seen from here")
    parser.add_argument("--run", metavar="NAME", help="name of the run, if several are fanned out there")
    parser.add_argument("--timeout", type=float, default=5.0, metavar="S", help="longest wait for the run to be there")
    access.add_arguments(parser.add_argument_group("who you are"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, meaning in [
        ("pause", "make no more ticks"),
        ("resume", "make ticks again"),
        ("reset", "begin the episode anew, with its own seed"),
    ]:
        commands.add_parser(name, help=meaning)
    step = commands.add_parser("step", help="make some ticks, and pause")
    step.add_argument("ticks", type=int, nargs="?", default=1)
    sensor = commands.add_parser("sensor", help="switch a sensor until the episode ends")
    sensor.add_argument("vehicle", help="SUMO's id, or all")
    sensor.add_argument("sensor", choices=("gnss", "imu", "speed_steering", "lidar", "all"))
    sensor.add_argument("state", choices=("on", "off"))
    for name, meaning in [
        ("start", "let a vehicle start anew from an edge"),
        ("destination", "lead a vehicle to an edge"),
    ]:
        place = commands.add_parser(name, help=meaning)
        place.add_argument("vehicle", help="SUMO's id")
        place.add_argument("edge", help="SUMO's id")
    return parser


if __name__ == "__main__":
    sys.exit(main())
