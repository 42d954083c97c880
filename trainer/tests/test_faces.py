"""Faces under Gymnasium's ids, their images, and what Gymnasium and Stable-Baselines3 document; real simulations."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import caraware.envs
import gymnasium
import numpy as np
import pytest
from caraware.envs import CarAwareParallelEnv, CarAwareVecEnv, CarAwareVectorEnv, SimulationError, Transition, make
from caraware.envs.outside import LINE
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.env_checker import data_equivalence as equal
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NormalizeReward, RecordEpisodeStatistics
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

ROOT = Path(__file__).parents[2]
TOWN: dict[str, Any] = {"traffic.others": 2, "traffic.pedestrians": 2, "episode.ticks": 40}
DRIVING = {"traffic.others": 3, "traffic.pedestrians": 2, "episode.ticks": 150, "task.time_limit_s": 4.0}
HEROES: dict[str, Any] = DRIVING | {"traffic.heroes": 3, "traffic.hero_route": []}
IDS = {"CarAware/Town-v0": TOWN, "CarAware/Driving-v0": DRIVING}


@pytest.fixture(autouse=True, scope="module")
def runtime() -> Iterator[Path]:
    """A registry for these tests alone. Nothing may be left in it, or as a run directory."""
    with tempfile.TemporaryDirectory(prefix="caraware") as short, pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARAWARE_RUNTIME_DIR", f"{short}/r")
        patch.setenv("CARAWARE", str(ROOT / "target" / "release" / "caraware"))
        yield Path(short, "r")
        assert not Path(short, "r").exists()
        assert not list(Path(tempfile.gettempdir()).glob(f"caraware-env-{os.getpid()}-*"))


def is_running(pid: int) -> bool:
    """Whether a process of this number exists."""
    return Path(f"/proc/{pid}").exists()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("id", IDS)
def test_gymnasiums_checker_passes_without_a_warning_on_every_id_images_included(id: str) -> None:
    env = gymnasium.make(id, set=IDS[id], seed=3)
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("id", IDS)
def test_stable_baselines_checker_passes_on_every_id(id: str) -> None:
    env = gymnasium.make(id, set=IDS[id], render_mode="rgb_array")
    sb3_check_env(env.unwrapped)
    env.close()


def test_an_id_takes_config_set_and_seed_and_closing_ends_its_simulation() -> None:
    env = gymnasium.make("CarAware/Driving-v0", config="lap", set=DRIVING, seed=9)
    face: Any = env.unwrapped
    simulation = face.slots.source
    run = simulation.run["config"]
    assert (run["run"]["seed"], run["traffic"]["heroes"], run["task"]["time_limit_s"]) == (9, 1, 4.0)
    assert env.reset(seed=9)[1]["id"] == "hero.0"
    pid = simulation.pid
    assert is_running(pid)
    env.close()
    assert not is_running(pid)
    with pytest.raises(SimulationError, match="closed"):
        env.reset(seed=10)


def test_an_id_makes_a_vector_of_vehicles_in_one_world_or_of_worlds() -> None:
    env = gymnasium.make_vec("CarAware/Town-v0", num_envs=5, set=TOWN)
    face: Any = env.unwrapped
    assert isinstance(face, CarAwareVectorEnv)
    assert face.slots.source.channel.run["config"]["traffic"]["cavs"] == 5
    observation, _ = env.reset(seed=2)
    assert len(observation) == 5 and env.observation_space.contains(observation)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.close()
    worlds: Any = gymnasium.make_vec("CarAware/Town-v0", num_envs=2, vectorization_mode="sync", set=TOWN)
    observation, _ = worlds.reset(seed=[4, 5])
    assert observation.shape[0] == 2 and not np.array_equal(observation[0], observation[1])
    worlds.step(worlds.action_space.sample())
    worlds.close()


def test_ids_and_images_work_on_a_scenario_that_decides_itself_how_many_vehicles_there_are(tmp_path: Path) -> None:
    generate = [str(ROOT / "target" / "release" / "caraware"), "generate", str(tmp_path / "city")]
    subprocess.run(
        [*generate, "--vehicles", "6", "--junctions", "3", "--duration-s", "60"], check=True, capture_output=True
    )
    config = tmp_path / "city" / "city.sumocfg"
    env = gymnasium.make("CarAware/Town-v0", config=config, render_mode="rgb_array")
    observation, info = env.reset()
    assert observation in env.observation_space and info["vehicle"] >= 0
    image = env.render()
    assert isinstance(image, np.ndarray) and image.shape == (512, 512, 3) and chosen(image) > 10
    env.close()
    vector = gymnasium.make_vec("CarAware/Town-v0", num_envs=4, config=config)
    _, infos = vector.reset()
    assert infos["mask"].sum() == 4
    vector.close()


def test_the_vector_face_keeps_gymnasiums_contract_of_same_step_autoreset() -> None:
    """What `check_env` examines of one environment, here of a vector; Gymnasium has no checker of its own for it."""
    env = gymnasium.make_vec("CarAware/Driving-v0", num_envs=3, config="lap", set=HEROES)
    assert isinstance(env.metadata["autoreset_mode"], AutoresetMode) and env.metadata["render_modes"] == ["rgb_array"]
    assert env.observation_space.shape == (3, *(env.single_observation_space.shape or ()))
    actions = [env.action_space.sample() for _ in range(120)]
    runs = []
    for _ in range(2):
        observation, _ = env.reset(seed=6)
        steps = []
        for action in actions:
            before = observation
            observation, reward, terminated, truncated, infos = env.step(action)
            assert env.observation_space.contains(observation) and reward.shape == (3,)
            assert terminated.dtype == truncated.dtype == np.bool_
            assert observation is not before and not np.shares_memory(observation, before)
            ended = terminated | truncated
            for slot in np.flatnonzero(ended):
                assert np.array_equal(infos["final_obs"][slot], before[slot])
            assert all(len(infos[key]) == 3 for key in infos if key != "final_info")
            steps.append((observation, reward, ended))
        runs.append(steps)
    assert equal(runs[0], runs[1], exact=True)
    assert sum(int(ended.sum()) for *_, ended in runs[0]) >= 3
    env.close()


def test_gymnasiums_wrappers_of_vectors_read_the_autoreset_mode() -> None:
    env = NormalizeReward(RecordEpisodeStatistics(gymnasium.make_vec("CarAware/Town-v0", num_envs=3, set=TOWN)))
    env.reset(seed=1)
    episodes = [env.step(env.action_space.sample())[-1].get("episode") for _ in range(90)]
    lengths = [episode["l"].max() for episode in episodes if episode is not None]
    assert lengths and max(lengths) <= 40
    env.close()


def test_a_process_that_keeps_a_trainers_place_does_not_import_gymnasium() -> None:
    script = "import sys, caraware.envs; print('gymnasium' in sys.modules)"
    environ = os.environ | {"PYTHONPATH": str(Path(caraware.envs.__file__).parents[2])}
    for extra, expected in (({}, "True"), ({LINE: "x"}, "False")):
        finished = subprocess.run([sys.executable, "-c", script], env=environ | extra, capture_output=True, text=True)
        assert finished.stdout.split() == [expected], finished.stderr


def coloured(image: np.ndarray, red: range, blue: range) -> int:
    """Number of pixels of an image u8 `[H, W, 3]` whose red and blue are in these ranges."""
    return int((np.isin(image[..., 0], list(red)) & np.isin(image[..., 2], list(blue))).sum())


def chosen(image: np.ndarray) -> int:
    """Pixels of the vehicle whose image it is."""
    return coloured(image, range(190, 230), range(0, 70))


def others(image: np.ndarray) -> int:
    """Pixels of the other vehicles with a slot."""
    return coloured(image, range(0, 70), range(190, 230))


def test_every_face_draws_the_map_with_its_vehicles() -> None:
    settings = TOWN | {"traffic.cavs": 4}
    with make("town", settings, seed=2) as simulation:
        env = CarAwareVectorEnv(simulation, render_mode="rgb_array")
        with pytest.raises(RuntimeError, match="reset"):
            env.render()
        env.reset()
        for _ in range(5):
            _, _, _, _, infos = env.step(env.action_space.sample())
        images = env.render()
        assert images is not None and len(images) == 4
        assert all(image.dtype == np.uint8 and image.shape == images[0].shape for image in images)
        assert images[0].ndim == 3 and images[0].shape[2] == 3 and max(images[0].shape) == 512
        roads = coloured(images[0], range(85, 100), range(95, 110)) / images[0][..., 0].size
        assert 0.1 < roads < 0.4
        for slot, image in enumerate(images):
            assert (chosen(image) > 10) == infos["mask"][slot] and others(image) > 10
        # The pixels of a vehicle lie where its truth says, north up.
        slot = int(np.flatnonzero(infos["mask"])[0])
        x_min, _, x_max, y_max = simulation.run["map"]["bounds_m"]
        px_per_m = images[0].shape[1] / (x_max - x_min)
        alone = np.argwhere((images[slot][..., 0] > 190) & (images[slot][..., 2] < 70)).mean(0)
        truth = infos["truth"][slot]
        expected = ((y_max - truth[1]) * px_per_m, (truth[0] - x_min) * px_per_m)
        assert np.hypot(*(alone - expected)) < 3.0 * px_per_m

        stable = CarAwareVecEnv(simulation, render_mode="rgb_array")
        stable.reset()
        whole = stable.render()
        assert whole is not None and whole.shape == images[0].shape and others(whole) > 30
        parallel = CarAwareParallelEnv(simulation, render_mode="rgb_array")
        parallel.reset()
        whole = parallel.render()
        assert whole is not None and whole.shape == images[0].shape and others(whole) > 30
        assert CarAwareParallelEnv(simulation).render() is None


@pytest.mark.parametrize(("fields", "drawn"), [("driver", True), (["user_1_x", "user_1_y", "speed"], False)])
def test_vehicles_that_a_hero_observes_are_drawn_where_the_observation_says_all_of_them(
    fields: object, drawn: bool
) -> None:
    settings = {"traffic.others": 30, "observation.fields": fields}
    env = gymnasium.make("CarAware/Driving-v0", set=settings, seed=1, render_mode="rgb_array", reward=nothing)
    env.reset(seed=1)
    for _ in range(10):
        env.step(np.zeros(2, np.float32))
    image = env.render()
    assert isinstance(image, np.ndarray) and chosen(image) > 10
    assert (coloured(image, range(235, 256), range(230, 256)) > 10) == drawn
    env.close()


def nothing(obs: Transition, action: np.ndarray) -> np.ndarray:
    """A reward of 0: the task's own needs fields of the route."""
    return np.zeros(len(action))


def test_agents_of_slots_carry_sumos_ids_and_their_episodes_follow_in_one_world() -> None:
    with make("lap", HEROES, seed=4) as simulation:
        env = CarAwareParallelEnv(simulation)
        pid, seen = simulation.pid, []
        for _ in range(3):
            _, infos = env.reset()
            assert env.agents == ["slot_0", "slot_1", "slot_2"]
            ids = {agent: info["id"] for agent, info in infos.items()}
            ends: dict[str, str] = {}
            while env.agents:
                actions = {agent: np.array([0.0, 0.2], np.float32) for agent in env.agents}
                _, _, terminated, truncated, infos = env.step(actions)
                for agent in infos:
                    ids[agent] = ids[agent] or infos[agent]["id"]
                    assert infos[agent]["id"] == ids[agent]  # an agent is one vehicle for the whole episode
                    if terminated[agent] or truncated[agent]:
                        ends[agent] = infos[agent]["end"]
            assert ends.keys() == ids.keys() and all(ends.values())
            seen.append(ids)
        assert all(id.startswith("hero.") for ids in seen for id in ids.values())
        assert simulation.pid == pid and len({id for ids in seen for id in ids.values()}) > 3


def test_infos_of_the_stable_baselines_face_are_those_of_its_own_monitor_and_vector() -> None:
    settings = TOWN | {"traffic.cavs": 1}
    single = DummyVecEnv([lambda: Monitor(gymnasium.make("CarAware/Town-v0", set=settings, seed=5))])
    face = CarAwareVecEnv(make("town", settings, seed=5))
    expected, got = (ends_of(env) for env in (single, face))
    assert len(got) >= 2 and expected[0].keys() - got[0].keys() <= {"id", "vehicle", "truth"}
    for one, other in zip(expected, got, strict=False):
        assert one["TimeLimit.truncated"] == other["TimeLimit.truncated"]
        assert np.array_equal(one["terminal_observation"], other["terminal_observation"])
        assert one["episode"].keys() == other["episode"].keys() == {"r", "l", "t"}
        assert other["episode"]["r"] == pytest.approx(one["episode"]["r"], abs=1e-4)
        assert one["episode"]["l"] == other["episode"]["l"] and 0 < other["episode"]["t"] < 60


def ends_of(env: Any) -> list[dict[str, Any]]:
    """Infos of the last steps of all trajectories in 100 steps with the same actions."""
    actions = np.random.default_rng(0).uniform(-1, 1, (100, 1, 2)).astype(np.float32)
    env.seed(5)
    env.reset()
    ends = []
    for action in actions:
        _, _, done, infos = env.step(action)
        assert infos[0]["TimeLimit.truncated"] in (False, True)
        if done[0]:
            ends.append(infos[0])
        else:
            assert "terminal_observation" not in infos[0] and infos[0]["TimeLimit.truncated"] is False
    env.close()
    return ends


def test_stable_baselines_learns_on_the_face_and_on_an_id() -> None:
    with make("lap", HEROES) as simulation:
        face = CarAwareVecEnv(simulation)
        model = PPO("MlpPolicy", face, n_steps=64, batch_size=64, n_epochs=1, device="cpu").learn(384)
        assert model.num_timesteps == 384 and model.ep_info_buffer
        assert {"r", "l", "t"} <= model.ep_info_buffer[0].keys() and model.ep_success_buffer
    model = PPO("MlpPolicy", "CarAware/Town-v0", n_steps=64, batch_size=64, n_epochs=1, device="cpu").learn(128)
    assert model.num_timesteps == 128
    environment = model.get_env()
    assert environment is not None
    environment.close()
