"""A scenario in which drivers do not keep the middle of the lane: SUMO's sublane model with its lateral imperfection.

The net, the types and the mix of vehicles are the town's. Their lateral place in the lane has a standard deviation of
0.22 m (90 % within 0.38 m, `sumo --fcd-output.attributes posLat`), where the town's own drivers have centimetres.
"""

import random
import re
from pathlib import Path
from xml.etree import ElementTree

LATERAL_RESOLUTION_M = 0.4
LATERAL_IMPERFECTION = 0.5
"""SUMO's `lcSigma`."""
TRIPS, AT_ONCE, INTERVAL_S, END_S = 220, 60, 0.5, 200
"""Trips, those of them that depart at the begin, the time between the others, and the end of the scenario."""
TRIPS_SEED = 7

SCENARIO = """<configuration>
  <input><net-file value="{net}"/><additional-files value="types.add.xml"/><route-files value="trips.rou.xml"/></input>
  <time><begin value="0"/><end value="{end_s}"/><step-length value="0.1"/></time>
  <processing>
    <lateral-resolution value="{resolution_m}"/><time-to-teleport value="120"/>
  </processing>
</configuration>
"""


def write_sublane_scenario(net: Path, types: Path, folder: Path) -> Path:
    """Write the `.sumocfg` and its files, with the vehicle types of the file `types`; its path."""
    folder.mkdir(parents=True, exist_ok=True)
    text = re.sub(r'<vType id="pedestrian".*?/>', "", types.read_text(), flags=re.DOTALL)
    drifting = f'\\g<0> lcSigma="{LATERAL_IMPERFECTION}" minGapLat="0.3"'
    (folder / "types.add.xml").write_text(re.sub(r'<vType id="(?:car_small|car_sedan|van)"', drifting, text))
    (folder / "trips.rou.xml").write_text("<routes>\n" + "\n".join(_trips(_streets(net))) + "\n</routes>\n")
    scenario = folder / "sublane.sumocfg"
    scenario.write_text(SCENARIO.format(net=net.absolute(), end_s=END_S, resolution_m=LATERAL_RESOLUTION_M))
    return scenario


def _streets(net: Path) -> list[str]:
    """Ids of the edges that cars may use, in the order of the file."""
    inner = ("internal", "crossing", "walkingarea")
    edges = (edge for edge in ElementTree.parse(net).iter("edge") if edge.get("function") not in inner)
    return [edge.attrib["id"] for edge in edges if any(map(_for_cars, edge.iter("lane")))]


def _for_cars(lane: ElementTree.Element) -> bool:
    return "passenger" in lane.get("allow", "passenger") and "passenger" not in lane.get("disallow", "")


def _trips(streets: list[str]) -> list[str]:
    """Trips between random streets, none back along its own; no two runs differ in them."""
    draw, rows = random.Random(TRIPS_SEED), []
    for number in range(TRIPS):
        start = draw.choice(streets)
        goal = draw.choice([street for street in streets if street.lstrip("-") != start.lstrip("-")])
        depart_s = 0.0 if number < AT_ONCE else number * INTERVAL_S
        rows.append(
            f'<trip id="v{number}" type="town_traffic" depart="{depart_s:.1f}" from="{start}" to="{goal}"'
            ' departPos="random_free" departSpeed="max" departLane="best"/>'
        )
    return rows
