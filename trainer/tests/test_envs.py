"""Standard faces on real simulations: the official checkers, seeds, ends of every kind, the examples."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from caraware import envs
from caraware.envs import CarAwareEnv, CarAwareParallelEnv, CarAwareVecEnv, CarAwareVectorEnv, SimulationError, make
from caraware.examples import cleanrl_style, custom_reward, sb3_ppo
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from pettingzoo.test import parallel_api_test, parallel_seed_test
from stable_baselines3.common.env_checker import check_env as sb3_check_env

ROOT = Path(__file__).parents[2]
CARAWARE = ROOT / "target" / "release" / "caraware"
TOWN: dict[str, Any] = {"traffic.cavs": 4, "traffic.others": 2, "traffic.pedestrians": 2, "episode.ticks": 40}
DRIVING = {"traffic.others": 3, "traffic.pedestrians": 2, "episode.ticks": 150, "task.time_limit_s": 4.0}
SPEAKING: dict[str, Any] = TOWN | {"v2x.candidates": 3}
HEROES: dict[str, Any] = DRIVING | {"traffic.heroes": 3, "traffic.hero_route": []}


@pytest.fixture(autouse=True, scope="module")
def runtime() -> Iterator[Path]:
    """A registry for these tests alone. Nothing may be left in it, in shared memory, or as a run directory."""
    with tempfile.TemporaryDirectory(prefix="caraware") as short, pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARAWARE_RUNTIME_DIR", f"{short}/r")
        patch.setenv("CARAWARE", str(CARAWARE))
        yield Path(short, "r")
        assert not Path(short, "r").exists()
        assert not list(Path(tempfile.gettempdir()).glob(f"caraware-env-{os.getpid()}-*"))


def wait_until(condition: Callable[[], object], within_s: float = 20.0) -> None:
    """Waits for a condition on other processes."""
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def left_in_shared_memory(prefix: str) -> list[str]:
    """Files of a run."""
    return [name for name in os.listdir("/dev/shm") if name.startswith(prefix)]


def processes_of(pid: int) -> list[psutil.Process]:
    """A supervisor and all processes that it started."""
    supervisor = psutil.Process(pid)
    return [supervisor, *supervisor.children(recursive=True)]


def gone(process: psutil.Process) -> bool:
    """Ended, even if its parent has not reaped it."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    return True


def test_gymnasiums_checker_passes_on_one_vehicle() -> None:
    with make("town", TOWN | {"traffic.cavs": 1}) as simulation:
        check_env(CarAwareEnv(simulation), skip_render_check=True)


def test_stable_baselines_checker_passes_on_one_hero() -> None:
    with make("lap", DRIVING) as simulation:
        sb3_check_env(CarAwareEnv(simulation))


def test_pettingzoos_api_test_passes_with_heroes_that_come_and_go() -> None:
    with make("lap", HEROES) as simulation:
        env = CarAwareParallelEnv(simulation, agents="ids")
        parallel_api_test(env, num_cycles=150)
        assert len(env.possible_agents) > 3 and all(agent.startswith("hero.") for agent in env.possible_agents)


@pytest.mark.filterwarnings("error:.*[Aa]gent:UserWarning")
@pytest.mark.parametrize(("config", "settings"), [("town", TOWN), ("lap", HEROES), ("messages", SPEAKING)])
def test_pettingzoos_api_test_passes_with_slots_as_agents(config: str, settings: dict[str, Any]) -> None:
    with make(config, settings) as simulation:
        env = CarAwareParallelEnv(simulation)
        slots = list(env.possible_agents)
        parallel_api_test(env, num_cycles=150)
        assert env.possible_agents == slots


@pytest.mark.parametrize("agents", ["slots", "ids"])
def test_pettingzoos_seed_test_passes(agents: str) -> None:
    parallel_seed_test(lambda: CarAwareParallelEnv(make("town", TOWN), agents=agents), num_cycles=50)


def episode_of(env: CarAwareVectorEnv, steps: int) -> list[np.ndarray]:
    """Everything that `steps` steps with the same actions give."""
    shape = (steps, env.num_envs, int(env.single_action_space.sample().size))
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    seen = []
    for action in actions:
        observation, reward, terminated, truncated, infos = env.step(action)
        seen += [observation, reward, terminated, truncated, infos["mask"], infos["truth"], infos["id_hash"]]
    return seen


@pytest.mark.parametrize(("config", "settings"), [("town", TOWN), ("lap", HEROES), ("messages", SPEAKING)])
def test_the_same_seed_gives_the_same_episodes_and_another_seed_others(config: str, settings: dict[str, Any]) -> None:
    def run(env: CarAwareVectorEnv, seed: int) -> list[np.ndarray]:
        first, infos = env.reset(seed=seed)
        return [first, infos["mask"], *episode_of(env, 60)]

    with make(config, settings, seed=8) as simulation:
        env = CarAwareVectorEnv(simulation)
        pid, eight, nine = simulation.pid, run(env, 8), run(env, 9)
        assert simulation.pid != pid and simulation.run["config"]["run"]["seed"] == 9
        again = run(env, 8)
    assert all(np.array_equal(a, b) for a, b in zip(eight, again, strict=True))
    assert not np.array_equal(eight[0], nine[0])


def test_autoreset_continues_the_same_run_and_works_with_gymnasiums_statistics() -> None:
    with make("town", TOWN) as simulation:
        env = RecordEpisodeStatistics(CarAwareVectorEnv(simulation))
        _, infos = env.reset()
        held, pid, ends = infos["mask"], simulation.pid, 0
        for _ in range(130):
            observation, reward, terminated, truncated, infos = env.step(env.action_space.sample())
            ended = terminated | truncated
            assert np.array_equal(infos.get("_final_obs", np.zeros(4, bool)), ended)
            assert not (ended & ~held).any() and not reward[~held].any() and not observation[~infos["mask"]].any()
            assert env.observation_space.contains(observation)
            ends, held = ends + int(ended.sum()), infos["mask"]
            if ended.any():
                assert infos["episode"]["l"][ended].max() <= 40
        assert ends >= 3 * 4 and simulation.pid == pid


def test_a_run_that_has_ended_is_followed_by_another() -> None:
    settings = TOWN | {"episode.training_episodes": 1, "traffic.cavs": 2}
    with make("town", settings, seed=3) as simulation:
        env = CarAwareVecEnv(simulation)
        env.reset()
        ends = np.zeros(2, int)
        for _ in range(45):
            ends += env.step(np.zeros((2, 2), np.float32))[2]
        assert ends.tolist() == [1, 1] and simulation.seed != 3


def test_close_leaves_nothing_and_a_closed_simulation_raises() -> None:
    simulation = make("town", TOWN)
    env = CarAwareVectorEnv(simulation)
    env.reset()
    processes, run = processes_of(simulation.pid), simulation.run
    assert len(processes) == 5 and left_in_shared_memory(run["shared_memory"]["prefix"])
    env.close()
    env.close()
    assert all(gone(process) for process in processes)
    assert not left_in_shared_memory(run["shared_memory"]["prefix"]) and not Path(run["run_dir"]).exists()
    for seed in (None, 4):
        with pytest.raises(SimulationError, match="closed"):
            env.reset(seed=seed)
    with pytest.raises(SimulationError, match="closed"):
        env.step(np.zeros((4, 2), np.float32))


def test_a_second_face_continues_a_simulation_that_waits_for_an_action() -> None:
    with make("lap", HEROES, seed=3) as simulation:
        first = CarAwareVectorEnv(simulation)
        start = first.reset(seed=3)[0].copy()
        for _ in range(20):
            first.step(np.full((3, 2), 0.5, np.float32))
        second = CarAwareVectorEnv(simulation)
        assert np.array_equal(second.reset(seed=3)[0], start), "a run that was stepped starts again with its seed"
        for _ in range(5):
            second.step(np.full((3, 2), 0.5, np.float32))
        third = CarAwareVectorEnv(simulation)
        assert third.reset()[0].shape == start.shape


def test_kept_runs_have_a_report(tmp_path: Path) -> None:
    with make("town", TOWN, runs=tmp_path) as simulation:
        env = CarAwareVectorEnv(simulation)
        env.reset()
        episode_of(env, 20)
        env.close()
    report = json.loads((tmp_path / "town-1" / "report.json").read_text())
    assert report["result"] == "interrupted" and 60 <= report["trainer"]["env_steps"] <= 80


def test_files_of_a_killed_program_are_removed_and_those_of_a_live_one_are_kept() -> None:
    dead = Path(tempfile.mkdtemp(prefix=f"caraware-env-{os.getpid()}-"))
    (dead / "lock").touch()
    with make("town", TOWN) as one:
        assert not dead.exists()
        with make("town", TOWN):
            assert Path(one.run["run_dir"]).is_dir()
        child = os.fork()
        if child == 0:
            one.close()  # not the child's to close
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        CarAwareVectorEnv(one).reset()


def test_seed_and_trainer_are_no_settings() -> None:
    for key in ("run.seed", "run.envs", "trainer.module"):
        with pytest.raises(ValueError, match=key):
            make("town", {key: "1"})


def test_a_wrong_setting_raises_with_the_message_of_caraware() -> None:
    with pytest.raises(SimulationError, match=r"traffic\.cavz"):
        make("town", {"traffic.cavz": 4})
    with pytest.raises(SimulationError, match="cannot start /no/caraware"):
        make("town", program="/no/caraware")
    assert not list(Path(tempfile.gettempdir()).glob(f"caraware-env-{os.getpid()}-*"))


def test_a_run_that_dies_is_an_exception_with_the_reason() -> None:
    with make("lap", DRIVING) as simulation:
        env = CarAwareVectorEnv(simulation)
        env.reset()
        prefix = simulation.run["shared_memory"]["prefix"]
        processes = processes_of(simulation.pid)
        next(process for process in processes if process.name() == "caraware").kill()
        with pytest.raises(SimulationError, match=r"signal 9"):
            for _ in range(100_000):
                env.step(np.zeros((1, 2), np.float32))
        wait_until(lambda: all(gone(process) for process in processes))
    with make("town", TOWN):  # cleans up after killed processes
        assert not left_in_shared_memory(prefix)


def test_a_simulator_that_dies_changes_nothing_that_a_driver_sees() -> None:
    seen = []
    for victims in ([], ["sim-core", "traffic-bridge", "sensor-daemon"]):
        with make("lap", DRIVING, seed=4) as simulation:
            env = CarAwareVectorEnv(simulation)
            observations = [env.reset()[0]]
            for step in range(60):
                if step % 15 == 14 and victims:
                    victim = victims.pop()
                    # The processes change with every restart.
                    next(process for process in processes_of(simulation.pid) if process.name() == victim).kill()
                observations.append(env.step(np.full((1, 2), 0.1, np.float32))[0])
            seen.append(np.stack(observations))
    np.testing.assert_array_equal(seen[0], seen[1])


def test_a_simulation_that_is_stopped_raises_with_the_reason() -> None:
    with make("town", TOWN) as simulation:
        env = CarAwareVectorEnv(simulation)
        env.reset()
        assert subprocess.run([CARAWARE, "stop", simulation.run["name"]], capture_output=True).returncode == 0
        with pytest.raises(SimulationError, match="caraware stop"):
            for _ in range(100_000):
                env.step(np.zeros((4, 2), np.float32))


USER = """
    import signal, numpy as np
    from caraware.envs import CarAwareVectorEnv, make
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background starts programs without it
    simulation = make("lap", {settings!r})
    env = CarAwareVectorEnv(simulation)
    env.reset()
    print(simulation.pid, simulation.run["shared_memory"]["prefix"], flush=True)
    while True:
        env.step(np.zeros((1, 2), np.float32))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_simulation_ends_with_a_program_that_is_killed_or_interrupted(number: signal.Signals) -> None:
    script = textwrap.dedent(USER.format(settings=DRIVING))
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as user:
        assert user.stdout is not None
        pid, prefix = user.stdout.readline().split()
        processes = processes_of(int(pid))
        user.send_signal(number)
        errors = user.communicate(timeout=60)[1]
        assert user.returncode == -number and (number == signal.SIGKILL) == (errors == "")
        assert number == signal.SIGKILL or errors.rstrip().endswith("KeyboardInterrupt")
    wait_until(lambda: all(gone(process) for process in processes))
    assert not left_in_shared_memory(prefix)


class Alarm(Exception):
    """Takes Ctrl-C's part."""


def test_an_interrupted_step_can_be_taken_again() -> None:
    def ring(number: int, frame: object) -> None:
        raise Alarm

    before = signal.signal(signal.SIGALRM, ring)
    try:
        with make("lap", DRIVING) as simulation:
            env = CarAwareVectorEnv(simulation)
            env.reset()
            supervisor = processes_of(simulation.pid)
            core = next(process for process in supervisor if process.name() == "sim-core")
            for _ in range(3):
                core.suspend()  # so that the alarm meets a step that waits
                signal.setitimer(signal.ITIMER_REAL, 0.1)
                with pytest.raises(Alarm):
                    for _ in range(100):
                        env.step(np.zeros((1, 2), np.float32))
                core.resume()
                for _ in range(5):
                    env.step(np.zeros((1, 2), np.float32))
    finally:
        signal.signal(signal.SIGALRM, before)


def test_two_simulations_run_side_by_side() -> None:
    with make("town", TOWN, seed=1) as one, make("town", TOWN, seed=1) as two:
        first, second = CarAwareVectorEnv(one), CarAwareVectorEnv(two)
        assert np.array_equal(first.reset()[0], second.reset()[0])
        assert all(np.array_equal(a, b) for a, b in zip(episode_of(first, 10), episode_of(second, 10), strict=True))


def test_the_package_exports_all_faces() -> None:
    assert all(getattr(envs, name) is not None for name in envs.__all__)


def code_in_the_documentation() -> list[str]:
    """Every block of docs/environments.md that is meant to run."""
    text = (ROOT / "docs" / "environments.md").read_text()
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("code", code_in_the_documentation())
def test_the_code_in_the_documentation_runs(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(code, "docs/environments.md", "exec"), {})
    expected = re.findall(r"print\(.*# (\S+\.\d+)", code)
    assert all(name in capsys.readouterr().out for name in expected)


def test_the_example_with_a_reward_of_its_own() -> None:
    assert 0 < custom_reward.main(50, **TOWN) < 0.5


def test_the_example_in_plain_torch_learns(capsys: pytest.CaptureFixture[str]) -> None:
    settings = cleanrl_style.Settings(ticks=40, batch_size=80, epochs=5, learning_rate=3e-3)
    errors_m = cleanrl_style.main(6000, settings, **TOWN | {"traffic.cavs": 12})
    # 13 updates of 480 samples; random predictions are about 130 m wrong.
    assert np.mean(errors_m[-3:]) < 0.8 * np.mean(errors_m[:3])
    assert cleanrl_style.main(200, settings, "lap", **HEROES)


def test_the_example_with_stable_baselines_alone(capsys: pytest.CaptureFixture[str]) -> None:
    model = sb3_ppo.alone(640, horizon=320, batch_size=64, **TOWN)
    assert model.num_timesteps == 640 and model.ep_info_buffer


def test_the_example_with_stable_baselines_as_the_trainer_of_a_run(tmp_path: Path) -> None:
    settings = TOWN | {"episode.training_episodes": 4, "episode.evaluation_interval": 2, "episode.evaluation_ticks": 20}
    settings |= {"episode.final_evaluations": 1, "trainer.horizon": 320, "trainer.batch_size": 64}
    settings |= {"trainer.module": "caraware.examples.sb3_ppo", "fanout.enabled": "false"}
    command: list[str | Path] = [
        CARAWARE,
        "train",
        "town",
        "--name",
        "sb3",
        *(f"--set={key}={value}" for key, value in settings.items()),
    ]
    package = str(Path(envs.__file__).parents[2])
    finished = subprocess.run(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": package}, capture_output=True, text=True
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    report = json.loads((tmp_path / "runs" / "sb3" / "report.json").read_text())
    # 4 episodes of 40 ticks with 4 vehicles, some of which enter late; no learner sees the evaluations.
    assert 4 * 40 * 3 < report["env_steps"] <= 4 * 40 * 4
    assert report["ppo_mean_error_m"] > report["raw_gnss_mean_error_m"] > 0
    assert (tmp_path / "runs" / "sb3" / "sb3_ppo.zip").is_file()
