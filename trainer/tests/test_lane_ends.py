"""What the map says of the place on a lane and of its end: ways, signals, right of way, speeds across the junction."""

from pathlib import Path

import pytest
import torch
from caraware.baselines.lanes import LaneMap, read_pieces

NET = """<net>
<edge id=":j_0"><lane id=":j_0_0" speed="4" length="10" shape="100,0 110,0"/></edge>
<edge id=":j_1"><lane id=":j_1_0" speed="6" length="5" shape="100,0 105,4"/></edge>
<edge id=":j_2"><lane id=":j_2_0" speed="6" length="5" shape="105,4 110,8"/></edge>
<edge id="in"><lane id="in_0" speed="13" length="100" shape="0,0 40,0 100,0"/></edge>
<edge id="lit"><lane id="lit_0" speed="13" length="50" shape="0,40 50,40"/></edge>
<edge id="out"><lane id="out_0" speed="8" length="90" shape="110,0 200,0"/></edge>
<connection from="in" to="out" fromLane="0" toLane="0" via=":j_0_0" dir="s" state="M"/>
<connection from="in" to="up" fromLane="0" toLane="0" via=":j_1_0" dir="l" state="m"/>
<connection from="lit" to="out" fromLane="0" toLane="0" via=":j_0_0" tl="t" linkIndex="0" dir="s" state="O"/>
<connection from=":j_0" to="out" fromLane="0" toLane="0" dir="s" state="M"/>
<connection from=":j_1" to="up" fromLane="0" toLane="0" via=":j_2_0" dir="l" state="m"/>
<connection from=":j_2" to="up" fromLane="0" toLane="0" dir="l" state="M"/>
</net>"""


def test_a_lane_knows_its_end(tmp_path: Path) -> None:
    file = tmp_path / "net.net.xml"
    file.write_text(NET)
    match = LaneMap(read_pieces(file), (4.0,)).match(
        torch.tensor([[70.0, 20.0, 105.0, 101.0, 150.0]]),
        torch.tensor([[1.0, 40.0, 0.0, 1.0, 0.0]]),
        torch.tensor([[0.0, 0.0, 0.0, 0.67, 0.0]]),
    )
    assert match.found.all()
    assert match.from_start_m[0, :3].tolist() == pytest.approx([70.0, 20.0, 5.0], abs=1e-3)
    assert match.to_end_m[0, :3].tolist() == pytest.approx([30.0, 30.0, 5.0], abs=1e-3)
    # Slowest and fastest way on, within a junction, signals, share that gives way, waits within the junction.
    assert match.end[0].tolist() == [
        [4.0, 6.0, 0.0, 0.0, 0.5, 0.0],
        [4.0, 4.0, 0.0, 1.0, 0.0, 0.0],
        [4.0, 4.0, 1.0, 0.0, 0.0, 0.0],
        [6.0, 6.0, 1.0, 0.0, 0.0, 1.0],
        [8.0, 8.0, 0.0, 0.0, 0.0, 0.0],
    ]
