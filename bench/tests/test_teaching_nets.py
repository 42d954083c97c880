"""Nets for teaching drivers: `scripts/teaching_nets.py`."""

import subprocess
import sys
import xml.etree.ElementTree as ET
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
SCRIPT = ROOT / "scripts" / "teaching_nets.py"


def build(directory: Path, first: int, last: int) -> list[Path]:
    """Run the script."""
    subprocess.run(
        [sys.executable, str(SCRIPT), str(directory), str(first), str(last)], check=True, capture_output=True
    )
    return [directory / f"net_{seed}.net.xml" for seed in range(first, last + 1)]


@pytest.fixture(scope="module")
def nets(tmp_path_factory: pytest.TempPathFactory) -> list[ET.Element]:
    """The nets of seeds 1 to 6."""
    return [ET.parse(path).getroot() for path in build(tmp_path_factory.mktemp("nets"), 1, 6)]


def test_the_same_seed_writes_the_same_net(tmp_path: Path) -> None:
    first, again = (build(tmp_path / name, 3, 3)[0] for name in ("first", "again"))
    texts = [path.read_text(encoding="utf-8").split("-->", 1)[1] for path in (first, again)]
    assert texts[0] == texts[1]
    assert sorted(path.name for path in first.parent.iterdir()) == [first.name], "sources are left behind"


def test_it_explains_itself_and_writes_nothing(tmp_path: Path) -> None:
    said = subprocess.run(
        [sys.executable, str(SCRIPT), "--help"], check=True, capture_output=True, text=True, cwd=tmp_path
    )
    assert "last seed (default: 12)" in said.stdout
    assert not list(tmp_path.iterdir())


def test_together_they_have_every_kind_of_junction_slopes_and_bends(nets: list[ET.Element]) -> None:
    kinds: Counter[str] = Counter()
    for net in nets:
        kinds.update(junction.attrib["type"] for junction in net.findall("junction"))
    assert min(kinds[kind] for kind in ("priority", "right_before_left", "traffic_light")) > 10, kinds
    assert any(net.findall("roundabout") for net in nets)
    lanes = [lane.attrib["shape"].split() for net in nets for lane in net.iter("lane")]
    heights = [[float(point.split(",")[2]) for point in lane if point.count(",") == 2] for lane in lanes]
    assert any(max(line) - min(line) > 1.0 for line in heights if line), "some streets climb"
    assert sum(len(lane) > 6 for lane in lanes) > 50, "some streets bend"


def test_bends_are_not_too_tight_for_their_limit(nets: list[ET.Element]) -> None:
    for net in nets:
        for edge in net.findall("edge"):
            if edge.get("function") or edge.attrib["id"].startswith("ring_"):
                continue
            lane = edge.findall("lane")[-1]
            line = [complex(*map(float, point.split(",")[:2])) for point in lane.attrib["shape"].split()]
            for (a, b), (_, c) in pairwise(pairwise(line)):
                if min(abs(b - a), abs(c - b)) < 3.0:
                    continue  # the end of a street is cut where its junction begins
                turned = abs((c - b) / (b - a) / abs((c - b) / (b - a)) - 1)
                accel_mps2 = float(lane.attrib["speed"]) ** 2 * turned / (0.5 * (abs(b - a) + abs(c - b)))
                assert accel_mps2 < 6.0, f"{edge.attrib['id']}: {accel_mps2:.1f} m/s²"
