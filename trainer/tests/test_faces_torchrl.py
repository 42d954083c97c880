"""TorchRL's own wrappers and checks over the faces, on real simulations, and the example that learns with TorchRL."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch
from caraware.envs import CarAwareParallelEnv, CarAwareVectorEnv, make
from caraware.examples import torchrl_ppo
from torchrl.envs import GymEnv, GymWrapper, PettingZooWrapper
from torchrl.envs.utils import check_env_specs

ROOT = Path(__file__).parents[2]
TOWN: dict[str, Any] = {"traffic.others": 2, "traffic.pedestrians": 2, "episode.ticks": 40}
DRIVING = {"traffic.others": 3, "traffic.pedestrians": 2, "episode.ticks": 150, "task.time_limit_s": 4.0}
HEROES: dict[str, Any] = DRIVING | {"traffic.heroes": 3, "traffic.hero_route": []}


@pytest.fixture(autouse=True, scope="module")
def runtime() -> Iterator[Path]:
    """A registry for these tests alone. Nothing may be left in it, or as a run directory."""
    with tempfile.TemporaryDirectory(prefix="caraware") as short, pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARAWARE_RUNTIME_DIR", f"{short}/r")
        patch.setenv("CARAWARE", str(ROOT / "target" / "release" / "caraware"))
        yield Path(short, "r")
        assert not Path(short, "r").exists()
        assert not list(Path(tempfile.gettempdir()).glob(f"caraware-env-{os.getpid()}-*"))


def test_torchrl_wraps_one_vehicle_by_its_id_and_as_an_environment() -> None:
    for env in (GymEnv("CarAware/Town-v0", set=TOWN), GymWrapper(gymnasium.make("CarAware/Driving-v0", set=DRIVING))):
        check_env_specs(env)
        rollout = env.rollout(60, break_when_any_done=False)
        assert rollout.batch_size == (60,) and rollout["next", "done"].any()
        env.close()


@pytest.mark.parametrize(("config", "settings"), [("town", TOWN | {"traffic.cavs": 4}), ("lap", HEROES)])
def test_torchrl_wraps_the_vector_face_with_its_masks_and_final_observations(
    config: str, settings: dict[str, Any]
) -> None:
    with make(config, settings) as simulation:
        face = CarAwareVectorEnv(simulation)
        env = GymWrapper(face)
        check_env_specs(env)
        rollout = env.rollout(160, break_when_any_done=False)
        done = rollout["next", "done"][..., 0]
        assert rollout.batch_size == (face.num_envs, 160) and done.sum() >= face.num_envs
        # An ended trajectory keeps its last observation; every other one continues with the next.
        assert torch.equal(rollout["next", "observation"][done], rollout["observation"][done])
        following, shown = rollout["observation"][:, 1:], rollout["next", "observation"][:, :-1]
        assert torch.equal(following[~done[:, :-1]], shown[~done[:, :-1]])
        assert not rollout["observation"][~rollout["mask"]].any()
        assert not rollout["next", "reward"][~rollout["mask"]].any()
        assert torch.equal(rollout["next", "done"], rollout["next", "terminated"] | rollout["next", "truncated"])


def test_torchrl_reads_actions_rewards_and_truth_of_the_same_tick() -> None:
    with make("town", TOWN | {"traffic.cavs": 4}) as simulation:
        rollout = GymWrapper(CarAwareVectorEnv(simulation)).rollout(100, break_when_any_done=False)
        low, high = torch.tensor(simulation.run["map"]["bounds_m"]).reshape(2, 2)
        predicted_m = low + (rollout["action"].double() + 1) / 2 * (high - low)
        error_m = (predicted_m - rollout["truth"][..., :2].double()).norm(dim=-1)
        assert torch.allclose(
            rollout["next", "reward"][..., 0].double()[rollout["mask"]],
            1 / (1 + error_m[rollout["mask"]] / 30),
            atol=1e-5,
        )


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested")
def test_torchrl_wraps_the_slots_of_the_parallel_face() -> None:
    with make("lap", HEROES) as simulation:
        face = CarAwareParallelEnv(simulation, infos="numbers")
        env = PettingZooWrapper(face, use_mask=True, done_on_any=False)
        assert env.group_map == {"slot": ["slot_0", "slot_1", "slot_2"]}
        check_env_specs(env)
        pid = simulation.pid
        rollout = env.rollout(200, break_when_any_done=False)
        assert simulation.pid == pid  # episodes follow each other in one world
        done = rollout["done"][1:, 0] | rollout["next", "done"][:-1, 0]
        assert done.any() and rollout["slot", "observation"].shape[:2] == (200, 3)
        acted, alone = rollout["slot", "mask"], rollout["next", "slot", "reward"]
        assert not acted.all() and not alone[~acted].any()
        # After the last agent's end all agents are there again.
        begins = torch.cat((torch.tensor([True]), rollout["next", "done"][:-1, 0]))
        assert acted[begins].all() and begins.sum() >= 3


def test_the_example_with_torchrl_learns() -> None:
    settings = torchrl_ppo.Settings(ticks=40, batch_size=80, epochs=5, learning_rate=3e-3)
    rewards = torchrl_ppo.main(6000, settings, **TOWN | {"traffic.cavs": 12})
    assert sum(rewards[-3:]) > 1.2 * sum(rewards[:3])
    driving = torchrl_ppo.Settings(ticks=40, discount=0.99)
    assert len(torchrl_ppo.main(240, driving, "lap", **HEROES)) == 2
