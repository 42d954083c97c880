"""A real run with V2X, a real viewer with `--messages`, and what the recording shows of a vehicle's map and links."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import recordings
from numpy.typing import NDArray
from ports import free_port

from caraware_viewer import legend, messages, scene, top

ROOT = Path(__file__).parents[2]
COMMAND = ROOT / "target" / "release" / "caraware"
LIMIT_S = 120.0
SETTINGS = (
    "v2x.share=1.0",
    "v2x.perception_range_m=50.0",
    "traffic.cavs=12",
    "traffic.others=4",
    "traffic.pedestrians=4",
    "episode.ticks=300",
    "episode.training_episodes=1",
    "episode.evaluation_interval=0",
    "episode.evaluation_ticks=40",
    "episode.final_evaluations=1",
    # A viewer draws the newest state: on a busy machine only one or two in a second.
    "run.real_time_factor=1.0",
)


def test_the_map_and_the_links_of_a_vehicle_in_a_real_run(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = [word for setting in (*SETTINGS, f"fanout.listen={endpoint}") for word in ("--set", setting)]
    recorded = tmp_path / "run.rrd"
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        environment = os.environ | {"CARAWARE_RUNTIME_DIR": f"{short}/r", "CARAWARE_PYTHON": sys.executable}
        run = [str(COMMAND), "simulate", "town", "--runs", str(tmp_path), *settings]
        simulating = subprocess.Popen(run, env=environment, stdout=subprocess.DEVNULL)
        view = [sys.executable, "-m", "caraware_viewer", endpoint, "--messages", "--save", str(recorded)]
        view += ["--timeout", str(LIMIT_S / 2)]
        viewed = subprocess.run(view, env=environment, capture_output=True, text=True, timeout=LIMIT_S)
        assert simulating.wait(timeout=LIMIT_S) == 0
    assert viewed.returncode == 0, viewed.stderr
    found = recordings.read(recorded)
    assert "known by CPM" in found[legend.SIGNS].newest("Points2D:labels")
    shown = [row for at, row in found[messages.KNOWN].rows if at > 0 and row.get("LineStrips2D:strips")]
    assert len(shown) > 20
    colors = {color for row in shown for color in row["LineStrips2D:colors"]}
    assert colors >= {int(messages.SOURCE_COLORS[1]), int(messages.SOURCE_COLORS[2])}, "CAMs and CPMs"
    # What is known is near road users, up to the errors of receivers; mirrored it would not be.
    bodies = {at: row["LineStrips2D:strips"] for at, row in found[top.OUTLINES].rows if row.get("LineStrips2D:strips")}
    away_m, mirrored_away_m = [], []
    for at, row in found[messages.KNOWN].rows:
        if at in bodies and row.get("LineStrips2D:strips"):
            users = centres(bodies[at])
            known = centres(row["LineStrips2D:strips"])
            away_m += nearest(known, users)
            mirrored_away_m += nearest(known * [1, -1] + [0, 2 * users[:, 1].mean()], users)
    assert np.median(away_m) < 0.6 * np.median(mirrored_away_m), (np.median(away_m), np.median(mirrored_away_m))
    for path in (messages.LINKS, messages.SENDERS):
        assert any(row.get("LineStrips2D:strips") for at, row in found[path].rows if at > 0), path
    texts = [row["TextDocument:text"][0] for _, row in found[scene.HUD].rows if row.get("TextDocument:text")]
    assert any("received · channel" in text and "CAM" in text for text in texts)


def centres(outlines: list[list[list[float]]]) -> NDArray[np.float64]:
    """Middles `[n, 2]` of outlines that begin with the corners of a box."""
    return np.array([np.mean([outline[0], outline[1], outline[2], outline[4]], axis=0) for outline in outlines])


def nearest(points: NDArray[np.float64], others: NDArray[np.float64]) -> list[float]:
    """Distance from each point to the nearest of the others, metres."""
    return [float(np.linalg.norm(others - point, axis=1).min()) for point in points]
