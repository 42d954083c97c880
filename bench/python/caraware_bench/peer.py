"""Measures one peer of `caraware bench peers`: `python -m caraware_bench.peer NAME … --json FILE`.

It runs in the virtual environment in which the peer is installed, and needs only this package of the project. It writes
`{"version": …, "rates": {case: rate}, "cpu_us": {case: µs}}`, vehicle-updates or agent-steps per wall second and the
processor time of each, or `{"missing": reason}` if the peer is not installed.
"""

import argparse
import json
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from caraware_bench.cost import LoopCost

Costs = dict[str, LoopCost]
"""By case."""


def libsumo(options: argparse.Namespace) -> tuple[str, Costs]:
    """Measure a Python loop over libsumo, with SUMO in the same process."""
    import libsumo

    from caraware_bench.traffic_loop import measure

    return version("libsumo"), {"libsumo, Python loop": measure(libsumo, arguments(options), options.steps)}


def traci(options: argparse.Namespace) -> tuple[str, Costs]:
    """Measure a Python loop over TraCI, with SUMO at the other end of a socket."""
    import traci

    from caraware_bench.traffic_loop import measure

    return version("traci"), {"TraCI, Python loop": measure(traci, arguments(options), options.steps)}


def arguments(options: argparse.Namespace) -> list[str]:
    """SUMO's command line."""
    return [options.sumo, "-c", options.sumocfg, "--output-prefix", options.prefix, "--no-step-log", "true"]


def metadrive(options: argparse.Namespace) -> tuple[str, Costs]:
    """Measure MetaDrive's multi-agent roundabout."""
    from caraware_bench.metadrive_peer import VERSION, costs

    return VERSION, costs(options.seconds)


def smarts(options: argparse.Namespace) -> tuple[str, Costs]:
    """Measure SMARTS's HiWayEnv on a SUMO net."""
    from caraware_bench.smarts_peer import VERSION, costs

    return VERSION, costs(options.net, options.seconds)


PEERS: dict[str, Callable[[argparse.Namespace], tuple[str, Costs]]] = {
    "libsumo": libsumo,
    "traci": traci,
    "metadrive": metadrive,
    "smarts": smarts,
}


def main(argv: list[str] | None = None) -> None:
    """Measure one peer and write what it costs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("--sumo", help="the program `sumo`")
    parser.add_argument("--sumocfg", help="scenario of a loop over SUMO")
    parser.add_argument("--prefix", default="", help="prefix of the names of SUMO's result files")
    parser.add_argument("--steps", type=int, help="SUMO steps of a loop")
    parser.add_argument("--net", type=Path, help="SUMO net that the agents drive on, if the peer has no map of its own")
    parser.add_argument("--seconds", type=float, default=10.0, help="wall time of each case of a driving environment")
    parser.add_argument("--json", type=Path, required=True, help="where to write the costs")
    options = parser.parse_args(argv)
    try:
        release, costs = PEERS[options.peer](options)
        measured: dict[str, object] = {
            "version": release,
            "rates": {case: cost.rate for case, cost in costs.items()},
            "cpu_us": {case: cost.cpu_us for case, cost in costs.items()},
        }
    except ImportError as reason:
        measured = {"missing": str(reason)}
    options.json.write_text(json.dumps(measured))


if __name__ == "__main__":
    main()
