"""How trajectories in slots become episodes of standard faces: hand-made ticks, no simulation."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.envs import CarAwareEnv, CarAwareParallelEnv, CarAwareVecEnv, CarAwareVectorEnv, RunEndedError, Transition
from caraware.envs.slots import RUN_ON_TICKS
from caraware.ipc.names import VEHICLE_IDS, Names
from caraware.ipc.run_file import sumo_begin_s
from caraware.ipc.stream import EMPTY_SLOT, Observation
from caraware.tasks.fields import Fields, UnknownFieldError
from synthetic import SyntheticChannel, SyntheticObservation

E = EMPTY_SLOT
FIELDS = ["gnss_x", "gnss_y", "speed"]


def run_file(run_dir: str, slots: int, *, drives: bool = False, episode_ticks: int = 1000) -> dict[str, Any]:
    """A run file of population control."""
    observation = {"fields": FIELDS, "history": 1, "scale": "minus_one_to_one"}
    config = {
        "run": {"seed": 5, "tick_s": 0.1, "window_ticks": 1},
        "task": {"kind": "driving" if drives else "localisation"},
        "traffic": {"cavs": slots, "heroes": slots, "hero_ids": [], "pedestrians": 0},
        "episode": {"ticks": episode_ticks},
        "observation": observation,
        "gnss": {"pedestrians": False},
        "blackout": {"policy": "hold"},
        "trainer": {"reward": "bounded_inverse", "reward_scale_m": 5.0},
    }
    return {
        "run_dir": run_dir,
        "config": config,
        "map": {"bounds_m": [0.0, 0.0, 200.0, 100.0]},
        "observation_fields": [
            {"name": "gnss_x", "unit": "m", "range": [0.0, 200.0]},
            {"name": "gnss_y", "unit": "m", "range": [0.0, 100.0]},
            {"name": "speed", "unit": "m/s", "range": [0.0, 30.0]},
            {"name": "route_left", "unit": "m", "range": [0.0, 1000.0]},
            {"name": "route_offset", "unit": "m", "range": [-5.0, 5.0]},
        ],
        "source": {"population": {}},
    }


def tick(
    number: int,
    vehicles: list[int],
    terminated: tuple[int, ...] = (),
    truncated: tuple[int, ...] = (),
    **more: Any,
) -> SyntheticObservation:
    """A tick whose rows say which vehicle and tick they are of: observation = truth = [vehicle, tick, …] / 1000."""
    vehicle = np.array(vehicles, np.uint32)
    valid = vehicle != E
    # Rows without a vehicle hold rubbish: a test that uses them fails.
    ids = np.where(valid, vehicle.astype(float), 777.0)
    rows = np.stack((ids / 1000, np.full(len(ids), number / 1000), np.zeros(len(ids))), 1).astype(np.float32)
    truth = np.concatenate((rows[:, :2] * 1000, np.zeros((len(ids), 2), np.float32)), 1)
    flags = [np.isin(np.arange(len(ids)), np.array(slots, int)) for slots in (terminated, truncated)]
    observation, truths, fixes = (torch.from_numpy(values) for values in (rows, truth, truth[:, :2].copy()))
    return SyntheticObservation(number, observation, truths, fixes, vehicle, valid, flags[0], flags[1], **more)


@dataclass
class DrivingChannel(SyntheticChannel):
    """Records actions too, and returns one tick at a time: the simulation waits."""

    group: int = 1

    def __post_init__(self) -> None:
        self.actions: dict[int, np.ndarray] = {}

    def publish_actions(
        self, observation: SyntheticObservation, actions: np.ndarray, policy_version: int = 0, *, now: bool = True
    ) -> None:
        """Remember the actions; each tick is answered once."""
        assert observation.tick not in self.actions
        assert actions.shape == (len(observation.vehicle), 2)
        self.actions[observation.tick] = actions.copy()


def channel_of(ticks: list[SyntheticObservation], tmp_path: Path, slots: int, **options: Any) -> DrivingChannel:
    """A channel over these ticks, the last of which ends the run."""
    ticks = [*ticks[:-1], replace(ticks[-1], last=True)]
    return DrivingChannel(run_file(str(tmp_path), slots, **options), iter(ticks))


def vehicles_of(observation: np.ndarray) -> Any:
    """Vehicles that rows are of: a list, or a number for a single row."""
    return np.rint(observation[..., 0] * 1000).astype(int).tolist()


def when(observation: np.ndarray) -> Any:
    """Ticks that rows are of, alike."""
    return np.rint(observation[..., 1] * 1000).astype(int).tolist()


def which(obs: Transition, action: np.ndarray) -> np.ndarray:
    """A reward that names its receiver: vehicle, and a thousandth of the tick answered."""
    return obs.truth[:, 0].astype(np.float64) + obs.truth[:, 1] / 1000


NOTHING = np.zeros((2, 2), np.float32)


def test_a_terminated_trajectory_keeps_its_last_observation_and_the_slot_is_empty_until_the_next(
    tmp_path: Path,
) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, E], terminated=(1,)), tick(2, [1, 3]), tick(3, [1, 3])]
    env = CarAwareVectorEnv(channel_of(ticks, tmp_path, 2), reward=which)
    observation, infos = env.reset()
    assert vehicles_of(observation) == [1, 2] and infos["mask"].tolist() == [True, True]

    observation, reward, terminated, truncated, infos = env.step(NOTHING)
    assert terminated.tolist() == [False, True] and truncated.tolist() == [False, False]
    assert reward.tolist() == pytest.approx([1.0, 2.0])  # of tick 0, whose action it was
    assert infos["mask"].tolist() == [True, False] and observation[1].tolist() == [0, 0, 0]
    assert (
        infos["final_obs"][0] is None and vehicles_of(infos["final_obs"][1]) == 2 and when(infos["final_obs"][1]) == 0
    )
    assert infos["_final_obs"].tolist() == [False, True] and infos["final_info"]["vehicle"][1] == 2

    observation, reward, terminated, truncated, infos = env.step(NOTHING)
    assert not terminated.any() and not truncated.any() and "final_obs" not in infos
    assert vehicles_of(observation) == [1, 3] and reward.tolist() == pytest.approx([1.001, 0.0])


def test_the_end_of_an_episode_truncates_and_gives_the_next_episodes_first_row(tmp_path: Path) -> None:
    # The same dense index means another vehicle in the next episode.
    ticks = [tick(0, [1, 2]), tick(1, [1, 2], truncated=(0, 1), episode=1), tick(2, [1, 2], episode=1)]
    env = CarAwareVectorEnv(channel_of(ticks, tmp_path, 2), reward=which)
    env.reset()
    observation, _, terminated, truncated, infos = env.step(NOTHING)
    assert truncated.all() and not terminated.any()
    assert when(observation) == [1, 1] and [when(row) for row in infos["final_obs"]] == [0, 0]
    *_, truncated, _ = env.step(NOTHING)
    assert not truncated.any()


def test_terminated_wins_over_truncated(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, 2], terminated=(0,), truncated=(0, 1), episode=1), tick(2, [1, 2], episode=1)]
    env = CarAwareVectorEnv(channel_of(ticks, tmp_path, 2))
    env.reset()
    _, _, terminated, truncated, _ = env.step(NOTHING)
    assert terminated.tolist() == [True, False] and truncated.tolist() == [False, True]


def test_a_gap_without_a_flag_truncates(tmp_path: Path) -> None:
    dark = tick(1, [1, 2])
    dark.valid[1] = False
    ticks = [tick(0, [1, 2]), dark, tick(2, [1, 2]), tick(3, [7, 2])]
    env = CarAwareVectorEnv(channel_of(ticks, tmp_path, 2))
    env.reset()
    *_, truncated, infos = env.step(NOTHING)
    assert truncated.tolist() == [False, True] and infos["mask"].tolist() == [True, False]
    *_, truncated, _ = env.step(NOTHING)
    assert not truncated.any()
    *_, truncated, _ = env.step(NOTHING)
    assert truncated.tolist() == [True, False]  # another vehicle


def test_slots_that_are_not_there_yet_are_empty_and_those_beyond_are_left_out(tmp_path: Path) -> None:
    ticks = [tick(0, [1]), tick(1, [1, 2, 3]), tick(2, [1, 2, 3])]
    channel = channel_of(ticks, tmp_path, 2)
    env = CarAwareVectorEnv(channel)
    _, infos = env.reset()
    assert infos["mask"].tolist() == [True, False]
    observation, *_ = env.step(NOTHING)
    assert vehicles_of(observation) == [1, 2]
    env.step(NOTHING)
    assert channel.predictions[1].shape == (3, 2)


def test_ticks_without_any_vehicle_ask_for_no_decision(tmp_path: Path) -> None:
    ticks = [tick(0, [E, E]), tick(1, [1, E]), tick(2, [E, E], terminated=(0,)), tick(3, [E, E]), tick(4, [E, 2])]
    ticks.append(tick(5, [E, 2]))
    channel = channel_of(ticks, tmp_path, 2, drives=True)
    env = CarAwareVectorEnv(channel, reward=which)
    observation, _ = env.reset()
    assert vehicles_of(observation)[0] == 1
    observation, _, terminated, _, infos = env.step(np.ones((2, 2), np.float32))
    assert terminated.tolist() == [True, False] and infos["mask"].tolist() == [False, True]
    assert vehicles_of(observation)[1] == 2 and vehicles_of(infos["final_obs"][0]) == 1
    assert sorted(channel.actions) == [0, 1, 2, 3]  # every tick is answered, by whomever
    assert channel.actions[1].tolist() == [[1, 1], [1, 1]] and not channel.actions[2].any()


def test_actions_beyond_the_range_are_clipped_where_they_drive_and_not_where_they_predict(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, 2]), tick(2, [1, 2])]
    wild = np.array([[2.0, -3.0], [0.0, np.nan]], np.float32)
    channel = channel_of(ticks, tmp_path, 2, drives=True)
    env = CarAwareVectorEnv(channel, reward=which)
    env.reset()
    env.step(wild)
    assert channel.actions[0][0].tolist() == [1.0, -1.0] and np.isnan(channel.actions[0][1, 1])
    channel = channel_of(ticks, tmp_path, 2)
    env = CarAwareVectorEnv(channel)
    env.reset()
    env.step(np.array([[-1.0, 1.0], [2.0, 0.0]], np.float32))
    assert channel.predictions[0].tolist() == [[0.0, 100.0], [300.0, 50.0]]


def test_evaluation_episodes_are_answered_by_their_policy_without_steps(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, 2], truncated=(0, 1), episode=1, evaluation=True)]
    ticks += [tick(2, [1, 2], episode=1, evaluation=True), tick(3, [4, 5], truncated=(0, 1), episode=2)]
    ticks += [tick(4, [4, 5], episode=2)]
    channel = channel_of(ticks, tmp_path, 2)
    env = CarAwareVectorEnv(channel, evaluation_policy=lambda observation: np.full((2, 2), -1.0))
    env.reset()
    observation, _, _, truncated, infos = env.step(NOTHING)
    assert truncated.all() and vehicles_of(infos["final_obs"][0]) == 1 and vehicles_of(observation) == [4, 5]
    assert channel.predictions[1].tolist() == [[0.0, 0.0], [0.0, 0.0]]
    *_, truncated, _ = env.step(NOTHING)
    assert not truncated.any()  # the flags of tick 3 were those of the evaluation
    env.close()
    text = (tmp_path / "parts" / "trainer.json").read_text()
    # Places are (vehicle, tick): the mean distance of (1, 1), (2, 1), (1, 2), (2, 2) to (0, 0).
    expected = np.mean([np.hypot(a, b) for a in (1, 2) for b in (1, 2)])
    assert f'"ppo_mean_error_m": {expected}'[:30] in text and '"env_steps": 4' in text


def test_the_end_of_the_run_truncates_and_then_nothing_can_be_stepped(tmp_path: Path) -> None:
    channel = channel_of([tick(0, [1, 2]), tick(1, [1, 2])], tmp_path, 2)
    env = CarAwareVectorEnv(channel)
    env.reset()
    env.step(NOTHING)
    *_, truncated, infos = env.step(NOTHING)
    assert truncated.all() and not infos["mask"].any() and when(infos["final_obs"][0]) == 1
    for call in (env.reset, lambda: env.step(NOTHING)):
        with pytest.raises(RunEndedError):
            call()
    assert channel.consumed_up_to == 1 and not channel.is_done
    env.slots.commit()
    assert channel.committed_up_to == 1
    env.close()
    assert channel.is_done


def test_reset_continues_to_the_next_episode_but_not_twice_without_a_step(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, 2]), tick(2, [1, 2]), tick(3, [4, 5], truncated=(0, 1), episode=1)]
    ticks += [tick(4, [4, 5], episode=1)]
    env = CarAwareVectorEnv(channel_of(ticks, tmp_path, 2))
    assert vehicles_of(env.reset()[0]) == [1, 2]
    env.step(NOTHING)
    assert vehicles_of(env.reset()[0]) == [4, 5]
    assert when(env.reset()[0]) == [3, 3]
    for seed in (99, 5):  # even its own: it is past its beginning
        with pytest.warns(UserWarning, match="cannot start this run again"):
            env.reset(seed=seed)


@dataclass
class TakenOverChannel(DrivingChannel):
    """A channel whose world has gone on for some ticks with what a predecessor answered."""

    ahead: int = 0
    first_tick: int = 0

    def actor_lag_ticks(self) -> int:
        """Ticks that the world has finished."""
        return self.ahead


@pytest.mark.parametrize(("ahead", "first"), [(0, 10), (1, 10), (4, 14)])
def test_ticks_that_a_predecessor_drove_are_answered_and_not_learnt_from(
    tmp_path: Path, ahead: int, first: int
) -> None:
    ticks = [tick(number, [7]) for number in range(10, 20)]
    stream = iter([*ticks[:-1], replace(ticks[-1], last=True)])
    channel = TakenOverChannel(run_file(str(tmp_path), 1, drives=True), stream, ahead=ahead, first_tick=10)
    env = CarAwareVectorEnv(channel, reward=which)
    observation, _ = env.reset()
    assert when(observation) == [first]
    env.step(np.full((1, 2), 0.5, np.float32))
    # The world may still wait for the answer to the newest of them.
    assert sorted(channel.actions) == list(range(10, first + 1))
    assert all(not channel.actions[number].any() for number in range(10, first))
    assert channel.actions[first].any()


class Restartable:
    """A source of hand-made runs that can be started again."""

    can_restart = True

    def __init__(self, channel: DrivingChannel, make_ticks: Callable[[int], Iterator[SyntheticObservation]]) -> None:
        self.channel, self._make, self.seed, self.seeds = channel, make_ticks, 5, [5]
        self.current: Observation | None = None
        self._ticks: Iterator[SyntheticObservation] = make_ticks(5)

    def receive(self) -> Observation | None:
        """The next tick."""
        self.current = next(self._ticks, None)
        return self.current

    def is_passed(self) -> bool:
        """No other policy has answered before."""
        return False

    def restart(self, seed: int | None = None) -> None:
        """Start the run again."""
        self.seed = self.seed + 1000 if seed is None else seed
        self.seeds.append(self.seed)
        self.channel.consumed_up_to = self.channel.committed_up_to = -1
        self._ticks = self._make(self.seed)
        self.current = None

    def close(self, part: dict[str, Any] | None = None) -> None:
        """Nothing to close."""


def restartable(tmp_path: Path, episode_ticks: int) -> Restartable:
    """Runs of three ticks whose vehicle is the seed."""
    channel = DrivingChannel(run_file(str(tmp_path), 1, episode_ticks=episode_ticks), iter(()))
    return Restartable(channel, lambda seed: iter([tick(number, [seed]) for number in range(3)]))


def test_a_run_is_started_again_only_for_another_seed_or_after_its_end(tmp_path: Path) -> None:
    source = restartable(tmp_path, episode_ticks=3)
    env = CarAwareVectorEnv(source)
    action = np.zeros((1, 2), np.float32)
    env.reset(seed=5)
    env.reset(seed=5)
    assert source.seeds == [5]
    env.step(action)
    assert when(env.reset(seed=5)[0]) == [0] and source.seeds == [5, 5]
    assert vehicles_of(env.reset(seed=6)[0]) == [6] and source.seeds == [5, 5, 6]
    ends = [bool(env.step(action)[3][0]) for _ in range(7)]
    assert ends == [False, False, True, False, False, True, False] and source.seeds[3:] == [1006, 2006]


def test_a_reset_far_from_the_end_of_an_episode_starts_a_new_run(tmp_path: Path) -> None:
    source = restartable(tmp_path, episode_ticks=RUN_ON_TICKS + 100)
    env = CarAwareVectorEnv(source)
    env.reset()
    env.step(np.zeros((1, 2), np.float32))
    assert vehicles_of(env.reset()[0]) == [1005]


def test_the_single_face_ends_with_its_vehicle_and_continues_with_the_next_in_the_slot(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [E, 2], terminated=(0,)), tick(2, [E, 2]), tick(3, [3, 2]), tick(4, [3, 2])]
    env = CarAwareEnv(channel_of(ticks, tmp_path, 2), reward=which)
    observation, info = env.reset()
    assert vehicles_of(observation) == 1 and info["vehicle"] == 1
    observation, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert (terminated, truncated) == (True, False) and vehicles_of(observation) == 1 and info["vehicle"] == 1
    assert reward == pytest.approx(1.0)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(2, np.float32))
    observation, info = env.reset()
    assert (vehicles_of(observation), when(observation)) == (3, 3)


def test_agents_come_and_go_under_their_ids_and_an_episode_ends_with_the_simulations(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, E], terminated=(1,)), tick(2, [1, 3]), tick(3, [1, 3])]
    ticks += [tick(4, [1, 9], truncated=(0, 1), episode=1), tick(5, [1, 9], episode=1)]
    env = CarAwareParallelEnv(channel_of(ticks, tmp_path, 2), reward=which, agents="ids")
    observations, _ = env.reset()
    one, two, three = (f"0x{number:016x}" for number in (1, 2, 3))
    assert env.agents == [one, two] and vehicles_of(observations[two]) == 2
    observations, rewards, terminated, _, _ = env.step({one: NOTHING[0], two: NOTHING[0]})
    assert terminated == {one: False, two: True} and env.agents == [one]
    assert when(observations[two]) == 0 and rewards[two] == pytest.approx(2.0)
    observations, rewards, terminated, _, _ = env.step({one: NOTHING[0]})
    assert env.agents == [one, three] and rewards[three] == 0.0 and vehicles_of(observations[three]) == 3
    env.step({})
    *_, truncated, _ = env.step({})
    assert truncated == {one: True, three: True} and env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})
    observations, _ = env.reset()
    assert {when(row) for row in observations.values()} == {4}
    assert env.possible_agents == [one, two, three, f"0x{9:016x}"]


def test_slots_as_agents_have_one_trajectory_each_and_the_episode_ends_with_the_last_of_them(tmp_path: Path) -> None:
    ticks = [tick(0, [1, E]), tick(1, [1, 2]), tick(2, [E, 2], terminated=(0,)), tick(3, [3, 2])]
    ticks += [tick(4, [3, E], truncated=(1,)), tick(5, [3, 4])]
    channel = channel_of(ticks, tmp_path, 2, drives=True)
    env = CarAwareParallelEnv(channel, reward=which)
    assert env.possible_agents == ["slot_0", "slot_1"]
    ones = dict.fromkeys(env.possible_agents, np.ones(2, np.float32))
    observations, infos = env.reset()
    assert env.agents == env.possible_agents and not observations["slot_1"].any()
    assert infos["slot_0"]["id"] == f"0x{1:016x}" and infos["slot_0"]["mask"]
    assert (infos["slot_1"]["id"], infos["slot_1"]["vehicle"], infos["slot_1"]["mask"]) == ("", -1, False)

    observations, rewards, terminated, truncated, infos = env.step(ones)
    assert rewards == {"slot_0": pytest.approx(1.0), "slot_1": 0.0} and not any(terminated.values())
    assert vehicles_of(observations["slot_1"]) == 2 and infos["slot_1"]["mask"]

    observations, _, terminated, truncated, infos = env.step(ones)
    assert terminated == {"slot_0": True, "slot_1": False} and env.agents == ["slot_1"]
    assert (vehicles_of(observations["slot_0"]), when(observations["slot_0"])) == (1, 1)
    assert infos["slot_0"]["vehicle"] == 1

    observations, *_ = env.step(ones)  # vehicle 3 takes slot 0, whose agent has ended
    assert list(observations) == ["slot_1"]
    _, _, _, truncated, _ = env.step(ones)
    assert truncated == {"slot_1": True} and env.agents == []
    assert channel.actions[1].tolist() == [[1, 1], [1, 1]]
    assert channel.actions[3].tolist() == [[0, -1], [1, 1]]  # the vehicle without an agent brakes
    assert env.step(ones) == ({}, {}, {}, {}, {})

    observations, infos = env.reset()
    assert env.agents == env.possible_agents and when(observations["slot_0"]) == 4 and not infos["slot_1"]["mask"]
    with pytest.raises(KeyError, match="slot_7"):
        env.step({"slot_7": np.zeros(2)})


def test_a_slot_without_a_vehicle_ends_with_the_simulations_episode(tmp_path: Path) -> None:
    ticks = [tick(0, [1, E]), tick(1, [5, 6], truncated=(0,), episode=1), tick(2, [5, 6], episode=1)]
    env = CarAwareParallelEnv(channel_of(ticks, tmp_path, 2), infos="numbers")
    _, infos = env.reset()
    keys = infos["slot_0"].keys()
    observations, _, _, truncated, infos = env.step({})
    assert truncated == {"slot_0": True, "slot_1": True} and env.agents == []
    assert vehicles_of(observations["slot_0"]) == 1 and not observations["slot_1"].any()
    assert {info.keys() == keys for info in infos.values()} == {True}
    assert all(isinstance(value, int | np.ndarray) for info in infos.values() for value in info.values())
    assert [vehicles_of(row) for row in env.reset()[0].values()] == [5, 6]


def test_a_policy_drives_the_vehicles_whose_agents_wait_for_the_next_episode(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [3, 2], terminated=(0,)), tick(2, [3, 2])]
    channel = channel_of(ticks, tmp_path, 2, drives=True)
    env = CarAwareParallelEnv(channel, reward=which, waiting_policy=lambda observation: observation[:, :2] + 0.5)
    env.reset()
    env.step({})
    env.step({"slot_1": np.ones(2, np.float32)})
    assert channel.actions[1].tolist() == [pytest.approx([0.503, 0.501]), [1, 1]]


def test_agents_infos_and_render_modes_that_are_not_offered_are_refused(tmp_path: Path) -> None:
    wrong: tuple[dict[str, Any], ...] = ({"agents": "vehicles"}, {"infos": "all"}, {"render_mode": "human"})
    for arguments in wrong:
        with pytest.raises(ValueError, match=str(*arguments.values())):
            CarAwareParallelEnv(channel_of([tick(0, [1, 2])], tmp_path, 2), **arguments)
    for face in (CarAwareEnv, CarAwareVectorEnv, CarAwareVecEnv):
        with pytest.raises(ValueError, match="human"):
            face(channel_of([tick(0, [1, 2])], tmp_path, 2), render_mode="human")


def test_stable_baselines_gets_the_last_observation_and_the_sums_of_an_episode(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, 2]), tick(2, [1, E], terminated=(1,)), tick(3, [1, E], truncated=(0,))]
    ticks[3] = replace(tick(3, [1, E], truncated=(0,), episode=1))
    ticks.append(tick(4, [1, E], episode=1))
    env = CarAwareVecEnv(channel_of(ticks, tmp_path, 2), reward=lambda obs, action: np.ones(2))
    env.reset()
    env.step(NOTHING)
    _, _, done, infos = env.step(NOTHING)
    assert done.tolist() == [False, True] and infos[1]["TimeLimit.truncated"] is False
    seconds = infos[1]["episode"].pop("t")
    assert infos[0]["TimeLimit.truncated"] is False and 0.0 < seconds < 60.0
    assert infos[1]["episode"] == {"r": 2.0, "l": 2} and when(infos[1]["terminal_observation"]) == 1
    _, reward, done, infos = env.step(NOTHING)
    assert reward.tolist() == [1.0, 0.0] and done.tolist() == [True, False]
    assert infos[0]["TimeLimit.truncated"] is True and infos[0]["episode"]["l"] == 3


@pytest.mark.parametrize("face", [CarAwareVectorEnv, CarAwareVecEnv])
def test_a_learner_may_change_what_it_gets_in_place(
    face: type[CarAwareVectorEnv] | type[CarAwareVecEnv], tmp_path: Path
) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, 2]), tick(2, [1, E], terminated=(1,)), tick(3, [1, 3])]
    env: Any = face(channel_of(ticks, tmp_path, 2), reward=which)
    first = env.reset()
    (first[0] if isinstance(first, tuple) else first)[:] = 0.7
    for expected in (2.0, 2.001):
        observation, reward, *_, infos = env.step(NOTHING)
        assert reward[1] == pytest.approx(expected)
        last, observation[:] = observation.copy(), 0.7
        if isinstance(infos, dict):
            infos["truth"][:] = 0.7
    assert last[1].tolist() == [0, 0, 0]
    final = infos["final_obs"][1] if isinstance(infos, dict) else infos[1]["terminal_observation"]
    assert (vehicles_of(final), when(final)) == (2, 1)


def test_a_reward_of_the_wrong_shape_is_refused(tmp_path: Path) -> None:
    ticks = [tick(0, [1, 2]), tick(1, [1, 2])]
    env = CarAwareVectorEnv(channel_of(ticks, tmp_path, 2), reward=lambda obs, action: np.ones(1))
    env.reset()
    with pytest.raises(ValueError, match="reward"):
        env.step(NOTHING)


def test_fields_by_name_are_in_si_units_of_the_newest_tick() -> None:
    run = run_file("", 1)
    fields = Fields.from_run(run)
    row = np.array([[-1.0, 1.0, 0.0]], np.float32)
    assert [float(fields.si(row, name)[0]) for name in FIELDS] == [0.0, 100.0, 15.0]
    run["config"]["observation"] |= {"history": 2, "scale": "zero_to_one"}
    fields = Fields.from_run(run)
    assert fields.width == 6 and float(fields.si(np.array([[9, 9, 9, 0.5, 0, 0]], np.float32), "gnss_x")[0]) == 100.0
    with pytest.raises(UnknownFieldError, match="gnss_x, gnss_y, speed"):
        fields.si(row, "leader_gap")


def test_names_of_the_population_and_of_named_heroes_are_found_and_others_shown_as_hashes() -> None:
    from caraware._native import id_hash

    names = Names(run_file("", 1))
    assert [names.of(id_hash(name)) for name in ("cav.0", "hero.300", "cav.5000")] == ["cav.0", "hero.300", "cav.5000"]
    run = run_file("", 1)
    run["source"] = {"scenario": {}}
    run["config"]["traffic"]["hero_ids"] = ["veh7"]
    names = Names(run)
    assert names.of(id_hash("veh7")) == "veh7" and names.of(id_hash("cav.0")) == f"0x{id_hash('cav.0'):016x}"


def test_the_driving_reward_distinguishes_arrival_other_ends_and_a_time_limit() -> None:
    from caraware.envs import rewards
    from caraware.envs.settings import FaceSettings
    from caraware.envs.transition import Rows

    run = run_file("", 5, drives=True)
    run["config"]["observation"]["fields"] = ["route_left", "route_offset"]
    settings = FaceSettings.from_run(run)

    def rows(left_m: list[float], offset_m: list[float]) -> Rows:
        observation = np.stack((np.array(left_m) / 500 - 1, np.array(offset_m) / 5), 1).astype(np.float32)
        truth = np.tile(np.array([0, 0, 0, 8.0], np.float32), (5, 1))
        return Rows(settings, observation, truth, truth[:, :2])

    # On its way, arrived, crashed, out of time, and too far from its end for the range of `route_left`.
    before, after = rows([100, 4, 50, 50, 1000], [0] * 5), rows([99, 4, 50, 50, 1000], [2.5, 0, 0, 0, 0])
    terminated, truncated = np.array([0, 1, 1, 0, 0], bool), np.array([0, 0, 0, 1, 0], bool)
    ids = np.zeros(5, np.uint32), np.zeros(5, np.uint64)
    fields = (before.observation, before.truth, before.gnss_m, np.ones(5, bool), *ids, terminated, truncated)
    reward = rewards.of_task(settings.task)(Transition(settings, *fields, after), np.zeros((5, 2), np.float32))
    # 1 m of way and 2.5 m beside the line; 8 m/s for 0.1 s. Steps of 1000 m / 2²⁴ are 0.06 mm.
    assert reward.tolist() == pytest.approx([0.1 - 0.05, 10, -10, 0, 0.08], abs=1e-4)


def test_the_localisation_reward_is_that_of_the_configuration_at_the_tick_answered(tmp_path: Path) -> None:
    env = CarAwareVectorEnv(channel_of([tick(0, [30, 0]), tick(1, [90, 0]), tick(2, [1, 1])], tmp_path, 2))
    env.reset()
    # Predicted (100, 50) and (0, 50), true (30, 0) and (0, 0).
    _, reward, *_, infos = env.step(np.array([[0, 0], [-1, 0]], np.float32))
    errors_m = [np.hypot(70, 50), 50.0]
    assert infos["error_m"].tolist() == pytest.approx(errors_m, rel=1e-5)
    assert reward.tolist() == pytest.approx([1 / (1 + error / 5) for error in errors_m], rel=1e-5)


def test_ids_of_a_scenario_are_read_as_traffic_bridge_writes_them(tmp_path: Path) -> None:
    from caraware._native import id_hash

    run = run_file("", 1)
    run["source"] = {"scenario": {"sumocfg": "a.sumocfg"}}
    run["run_dir"] = str(tmp_path)
    assert sumo_begin_s(run) == 0.0
    run["source"]["scenario"]["own"] = {"begin_s": 54000.0}
    assert sumo_begin_s(run) == 54000.0
    names = Names(run)
    long = "x" * 150 + "\u00e4"
    hashes = [id_hash(name) for name in ("taxi 1", long, "late")]
    assert names.of(hashes[0]) == f"0x{hashes[0]:016x}"
    (tmp_path / VEHICLE_IDS).write_text(f'"taxi 1"\n"ha\n{json.dumps(long)}\n"la', encoding="utf-8")
    assert [names.of(number) for number in hashes[:2]] == ["taxi 1", long]
    assert names.of(hashes[2]).startswith("0x")
    with (tmp_path / VEHICLE_IDS).open("a", encoding="utf-8") as stream:
        stream.write('te"\n')
    assert names.of(hashes[2]) == "late"
