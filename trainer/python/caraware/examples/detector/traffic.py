"""A scenario of SUMO with every class that the detector knows, on one of the project's maps.

The maps' own traffic has no bicycles, motorcycles, trucks or buses. Here the seed draws the trips, so two seeds share
the streets and nothing else.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from caraware.envs import make

MAPS = ("town", "avenue")
"""Maps of the project that mixed traffic can drive on."""

PERSON_RATE_HZ = 0.5
"""Pedestrians that set off in a second."""

_TYPES = """\
    <vType id="hatchback" vClass="passenger" length="3.70" width="1.66" height="1.48" speedDev="0.10"/>
    <vType id="sedan" vClass="passenger" length="4.70" width="1.83" height="1.45" speedDev="0.10"/>
    <vType id="van" vClass="delivery" length="5.90" width="2.02" height="2.55" speedDev="0.10"/>
    <vType id="truck" vClass="truck" length="7.50" width="2.40" height="3.20" accel="1.3" speedDev="0.05"/>
    <vType id="bus" vClass="bus" length="12.00" width="2.50" height="3.10" accel="1.2" speedDev="0.05"/>
    <vType id="bicycle" vClass="bicycle" length="1.80" width="0.65" height="1.75" maxSpeed="7.0" speedDev="0.15"/>
    <vType id="motorcycle" vClass="motorcycle" length="2.20" width="0.90" height="1.50" speedDev="0.10"/>
    <vType id="walker" vClass="pedestrian" length="0.30" width="0.50" height="1.72" speedDev="0.12"/>
"""
_SHARES = {
    "hatchback": 0.22,
    "sedan": 0.26,
    "van": 0.12,
    "truck": 0.08,
    "bus": 0.04,
    "bicycle": 0.16,
    "motorcycle": 0.12,
}
"""Shares of the vehicles: more two-wheelers than on most streets, so that the detector sees enough of them."""


def write_mixed_traffic(town: str, folder: Path, seed: int, duration_s: float, vehicle_rate_hz: float = 0.8) -> Path:
    """Writes a scenario of `duration_s` on a map of `MAPS` into `folder` and returns its `.sumocfg`.

    `seed` draws type, begin and end of every trip; `vehicle_rate_hz` vehicles set off in a second.
    """
    folder.mkdir(parents=True, exist_ok=True)
    net = _copy_map(town, folder)
    edges = [
        edge.attrib["id"] for edge in ElementTree.parse(net).getroot().iter("edge") if "function" not in edge.attrib
    ]
    rng = np.random.default_rng(seed)
    lines = ["<routes>", _TYPES.rstrip()]
    for number, depart_s in enumerate(np.arange(0.0, duration_s, 1.0 / vehicle_rate_hz)):
        kind = rng.choice(list(_SHARES), p=list(_SHARES.values()))
        start, end = rng.choice(edges, 2, replace=False)
        lines.append(
            f'    <trip id="{kind}.{number}" type="{kind}" depart="{depart_s:.1f}" from="{start}" to="{end}" '
            'departLane="best" departSpeed="max"/>'
        )
        # Whole walks begin at once: SUMO wants departures in order.
        if rng.random() < PERSON_RATE_HZ / vehicle_rate_hz:
            start, end = rng.choice(edges, 2, replace=False)
            lines.append(
                f'    <person id="walker.{number}" type="walker" depart="{depart_s:.1f}">'
                f'<walk from="{start}" to="{end}"/></person>'
            )
    (folder / "mixed.rou.xml").write_text("\n".join([*lines, "</routes>"]) + "\n")
    config = folder / "mixed.sumocfg"
    config.write_text(
        f"""<configuration>
    <input>
        <net-file value="{net.name}"/>
        <route-files value="mixed.rou.xml"/>
        <additional-files value="{town}.poly.xml"/>
    </input>
    <time>
        <begin value="0"/>
        <end value="{duration_s}"/>
        <step-length value="0.1"/>
    </time>
    <processing>
        <ignore-route-errors value="true"/>
        <time-to-teleport value="60"/>
    </processing>
</configuration>
"""
    )
    return config


def _copy_map(town: str, folder: Path) -> Path:
    """Copies net and buildings of a map of the project, which every run builds anew; returns the net."""
    if town not in MAPS:
        raise ValueError(f"no map {town!r}: mixed traffic drives on {' or '.join(MAPS)}")
    net = folder / f"{town}.net.xml"
    if not net.exists():
        with make("town", {"traffic.cavs": 1} | ({} if town == "town" else {"curriculum.maps": [town]})) as simulation:
            built = Path(simulation.run["run_dir"]) / "map"
            for name in (f"{town}.poly.xml", net.name):
                shutil.copyfile(built / name, folder / name)
    return net
