"""`caraware-viewer command`: sends a command to a run on another host whose `fanout.commanders` names this user."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

import zenoh

from caraware_viewer import access
from caraware_viewer.documents import CommandReply, ControlCommand
from caraware_viewer.layout import SCHEMA_VERSION, SENSORS
from caraware_viewer.link import LinkError, RunKey, find_run

ANSWER_S = 15.0
"""Longest wait for the simulation's answer; the fan-out itself waits 12 s for it."""

_EXAMPLES = """Examples:
  caraware-viewer command tls/lab:7447 --user alice --password-file pw --ca ca.pem pause
  caraware-viewer command tls/lab:7447 --user alice --password-file pw --ca ca.pem sensor cav.3 gnss off
  caraware-viewer command tcp/127.0.0.1:7447 step 10

Exit codes: 0 done, 1 refused or no answer, 2 usage error."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Sends one command and prints the answer."""
    options = parser().parse_args(arguments)
    try:
        session = access.connect(options.endpoint, options.timeout, access.credentials_from(options))
        try:
            run = find_run(session, options.endpoint, options.run, options.timeout)
            reply = send_command(session, run, command_from(options))
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
    """The key on which `run` takes commands."""
    return "caraware-control" + run.prefix.removeprefix("caraware")


def send_command(
    session: zenoh.Session, run: RunKey, command: ControlCommand, timeout_s: float = ANSWER_S
) -> CommandReply:
    """Sends `command` and returns the answer: `{"done": …}` or `{"refused": …}`. Raises `LinkError` without one."""
    request = json.dumps({"schema_version": SCHEMA_VERSION, "control": command})
    for reply in session.get(control_key(run), payload=request, timeout=timeout_s):
        if reply.ok:
            answer: CommandReply = json.loads(bytes(reply.ok.payload))
            return answer
    raise LinkError(
        f"run {run.run!r} does not answer the command: you may watch it, "
        "but it takes commands only from users that its `fanout.commanders` names"
    )


def command_from(options: argparse.Namespace) -> ControlCommand:
    """The command that these options name, as it is sent."""
    command = ControlCommand(command=options.command)
    if options.command == "step":
        command["ticks"] = options.ticks
    elif options.command == "sensor":
        command["vehicle"] = None if options.vehicle == "all" else options.vehicle
        command["sensor"] = options.sensor
        command["state"] = options.state
    elif options.command in ("start", "destination"):
        command["vehicle"] = options.vehicle
        command["edge"] = options.edge
    return command


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="caraware-viewer command",
        description="Send a command to a run on another host. The run's `fanout.commanders` must name you.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("endpoint", help="the run's `fanout.listen`, as seen from here")
    parser.add_argument("--run", metavar="NAME", help="name of the run, if the endpoint has several")
    parser.add_argument(
        "--timeout",
        type=float,
        default=5.0,
        metavar="S",
        help="longest wait for the run to appear (default %(default)s s)",
    )
    access.add_arguments(parser.add_argument_group("credentials"))
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, meaning in [
        ("pause", "stop making ticks"),
        ("resume", "make ticks again"),
        ("reset", "start the episode again, with the same seed"),
    ]:
        commands.add_parser(name, help=meaning)
    step = commands.add_parser("step", help="make some ticks, then pause")
    step.add_argument("ticks", type=int, nargs="?", default=1)
    sensor = commands.add_parser("sensor", help="switch a sensor until the episode ends")
    sensor.add_argument("vehicle", help="SUMO id of the vehicle, or all")
    sensor.add_argument("sensor", choices=(*(spec.name for spec in SENSORS), "all"))
    sensor.add_argument("state", choices=("on", "off"))
    for name, meaning in [
        ("start", "make a vehicle start again from an edge"),
        ("destination", "route a vehicle to an edge"),
    ]:
        move = commands.add_parser(name, help=meaning)
        move.add_argument("vehicle", help="SUMO id of the vehicle")
        move.add_argument("edge", help="SUMO id of the edge")
    return parser


if __name__ == "__main__":
    sys.exit(main())
