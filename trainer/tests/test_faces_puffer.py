"""PufferLib over the faces, in the environment that `make puffer` makes: it asks for another version of Gymnasium."""

import os
import subprocess
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".venv-puffer" / "bin" / "python"
TOWN = {"traffic.cavs": 12, "traffic.others": 2, "traffic.pedestrians": 2, "episode.ticks": 40}
DRIVING = {"traffic.heroes": 3, "traffic.others": 2, "traffic.pedestrians": 0, "task.time_limit_s": 4.0}
LEARN = f"""
import math
from caraware.examples import puffer_ppo

returns = puffer_ppo.main(256, 128, **{DRIVING!r})
assert len(returns) == 2 and math.isfinite(returns[-1]), returns
returns = puffer_ppo.main(2560, 64, "town", **{TOWN!r})
assert sum(returns[-3:]) > 1.2 * sum(returns[:3]), returns
"""
WRAP = f"""
from caraware.envs import CarAwareEnv, CarAwareParallelEnv, make
from caraware.examples import puffer_ppo
from pufferlib import vector
from pufferlib.emulation import GymnasiumPufferEnv, PettingZooPufferEnv


def one_hero(buf=None, seed=0):
    return GymnasiumPufferEnv(CarAwareEnv(make("driving", {DRIVING!r})), buf=buf)


def slots(buf=None, seed=0):
    return PettingZooPufferEnv(CarAwareParallelEnv(make("driving", {DRIVING!r}), infos="numbers"), buf=buf)


for creator, agents in ((one_hero, 1), (slots, 3)):
    env, ends = vector.make(creator, backend="Serial"), 0
    env.reset(seed=3)
    for _ in range(100):
        observation, reward, terminated, truncated, infos = env.step(env.action_space.sample())
        ends += int((terminated | truncated).sum())
    assert observation.shape == (agents, env.single_observation_space.shape[0]) and ends > agents
    env.close()
"""


@pytest.mark.skipif(not PYTHON.exists(), reason="needs the environment of `make puffer`")
@pytest.mark.parametrize(("script", "updates"), [(LEARN, 42), (WRAP, 0)], ids=["learns", "wraps"])
def test_pufferlib_works_over_the_faces(script: str, updates: int) -> None:
    with tempfile.TemporaryDirectory(prefix="caraware") as short:
        environ = os.environ | {
            "CARAWARE": str(ROOT / "target" / "release" / "caraware"),
            "CARAWARE_RUNTIME_DIR": f"{short}/r",
            "PYTHONPATH": str(ROOT / "trainer" / "python"),
        }
        finished = subprocess.run(
            [PYTHON, "-c", script], env=environ, cwd=short, capture_output=True, text=True, timeout=300
        )
        assert finished.returncode == 0, finished.stdout + finished.stderr
        assert finished.stdout.count(" ticks, return ") == updates
        assert not list(Path(short).iterdir())
