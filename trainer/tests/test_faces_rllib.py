"""RLlib over the parallel face, in the environment that `make faces` makes: it pins another version of Gymnasium."""

import os
import subprocess
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".venv-faces" / "bin" / "python"
EPISODES = {"traffic.heroes": 3, "traffic.others": 2, "traffic.pedestrians": 0, "task.time_limit_s": 4.0}
SCRIPT = f"""
import math
import gymnasium
from caraware.examples import rllib_ppo
from gymnasium.utils.env_checker import check_env

env = gymnasium.make("CarAware/Town-v0", render_mode="rgb_array")
check_env(env.unwrapped, skip_render_check=True)
env.close()
returns = rllib_ppo.main(400, 200, **{EPISODES!r})
assert len(returns) == 2 and math.isfinite(returns[-1]), returns
"""


@pytest.mark.skipif(not PYTHON.exists(), reason="needs the environment of `make faces`")
def test_rllib_learns_over_the_parallel_face() -> None:
    with tempfile.TemporaryDirectory(prefix="caraware") as short:
        environ = os.environ | {
            "CARAWARE": str(ROOT / "target" / "release" / "caraware"),
            "CARAWARE_RUNTIME_DIR": f"{short}/r",
            "RAY_TMPDIR": short,
            "PYTHONPATH": str(ROOT / "trainer" / "python"),
        }
        finished = subprocess.run([PYTHON, "-c", SCRIPT], env=environ, capture_output=True, text=True, timeout=300)
        assert finished.returncode == 0, finished.stdout + finished.stderr
        assert finished.stdout.count(" ticks, return ") == 2
        assert not Path(short, "r").exists()
