"""Actions drawn tick by tick: the same for the same tick, stored as drawn, and learnt with what followed."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from caraware.ipc.stream import EMPTY_SLOT
from caraware.learn.build import build_ppo
from caraware.learn.config import TrainerConfig
from caraware.learn.drawing import DrawingPredictor
from caraware.learn.networks import log_probability
from caraware.learn.ppo import Ppo
from caraware.learn.rollout import DrawnTick, Horizon, Rollout
from caraware.tasks import ends
from caraware.tasks.driving import DrivenStep, Driving, progress_reward
from synthetic import SyntheticObservation, run_file
from test_tasks import run_of
from torch import Tensor, nn

SLOTS, FIELDS = 3, 2


@dataclass
class HeroTick(SyntheticObservation):
    """A tick of heroes."""

    why: np.ndarray = field(default_factory=lambda: np.zeros(SLOTS, np.uint32))

    @property
    def ended_by(self) -> np.ndarray:
        """u32 `[n]`."""
        return self.why


def hero_tick(tick: int, **changes: Any) -> HeroTick:
    """Three heroes, of which the last slot is empty; each comes 1 m nearer to its end in a tick."""
    row = torch.tensor([(500.0 - tick) / 500 - 1, 0.0])
    truth = torch.tensor([[float(tick), 0.0, 0.0, 10.0]] * SLOTS)
    columns: dict[str, Any] = {
        "tick": tick,
        "observation": row.repeat(SLOTS, 1),
        "truth": truth,
        "gnss_m": truth[:, :2],
        "vehicle": np.array([0, 1, EMPTY_SLOT], np.uint32),
        "valid": np.array([True, True, False]),
        "terminated": np.zeros(SLOTS, bool),
        "truncated": np.zeros(SLOTS, bool),
    }
    return HeroTick(**(columns | changes))


def learner(**trainer: object) -> Ppo:
    run = run_of("driving")
    run["config"] |= {"trainer": run_file("/tmp", **trainer)["config"]["trainer"]}
    run["config"]["run"] |= {"seed": 1}
    config = TrainerConfig.from_run(run)
    return build_ppo(config, FIELDS, Driving.from_run(run))


class OneLayer(nn.Linear):
    """A network of a class."""

    def __init__(self, inputs: int, outputs: int, hidden: tuple[int, ...]) -> None:
        super().__init__(inputs, outputs)


SETTINGS: dict[str, object] = {
    "hidden": [8],
    "discount": 0.9,
    "gae_lambda": 0.5,
    "supervised": False,
    "actions_per_observation": 1,
    "horizon": 8,
    "batch_size": 4,
    "epochs": 1,
}


def collected(ppo: Ppo, ticks: list[HeroTick], horizon: int) -> Horizon:
    predictor = ppo.predictor(dark_is_nan=False)
    assert isinstance(predictor, DrawingPredictor)
    rollout = Rollout(horizon, FIELDS, bootstrap=True, drawn_actions=2)
    for obs in ticks:
        predictor.predict_m({0: [obs]})
        rollout.add(obs, predictor.drawn(0, obs.tick))
        if rollout.full():
            return rollout.take()
    raise AssertionError("the horizon is not full")


def test_a_tick_that_comes_again_gets_the_same_action_and_another_tick_another() -> None:
    def answers(tick: int) -> Tensor:
        predictor = learner(**SETTINGS).predictor(dark_is_nan=False)
        # Whatever came before: random numbers belong to their tick.
        predictor.predict_m({0: [hero_tick(n) for n in range(tick % 3)]})
        return predictor.predict_m({0: [hero_tick(tick)]})[0][0]

    assert answers(5).equal(answers(5)) and not answers(5).equal(answers(6))
    assert answers(5)[2].tolist() == [0.0, 0.0], "an empty slot has no action"
    assert answers(5).abs().max() <= 1


def test_steering_begins_with_less_noise_than_acceleration_in_any_network() -> None:
    for network in ("mlp", "test_drawing:OneLayer"):
        ppo = learner(**SETTINGS | {"initial_std": 0.4, "network": network})
        assert ppo.updater.log_std.exp().tolist() == pytest.approx([0.1, 0.4]), network


def test_an_evaluation_takes_the_mean_and_draws_nothing() -> None:
    ppo = learner(**SETTINGS)
    predictor = ppo.predictor(dark_is_nan=False)
    obs = hero_tick(5, evaluation=True)
    (answer,) = predictor.predict_m({0: [obs]})[0]
    assert isinstance(predictor, DrawingPredictor) and predictor.drawn(0, 5) is None
    assert answer[:2].equal(ppo.task.answer(ppo.updater.mean(obs.observation))[:2])


@pytest.mark.parametrize("end", [ends.COLLISION, ends.BLOCKED])
def test_a_batch_holds_what_was_drawn_and_what_followed(end: int) -> None:
    ppo = learner(**SETTINGS)
    why = np.array([end, 0, 0], np.uint32)
    ticks = [hero_tick(n) for n in range(3)]
    ticks.append(hero_tick(3, terminated=np.array([True, False, False]), why=why))
    ticks[3].vehicle[0] = 7
    ticks += [hero_tick(n) for n in (4, 5)]
    for obs in ticks[4:]:
        obs.vehicle[0] = 7
    horizon = collected(ppo, ticks, 10)
    assert horizon.drawn is not None
    batch = ppo.score(horizon)
    # The log-probability is that of the action under the policy that drew it, clipped or not.
    mean = ppo.updater.mean(batch.observation)
    assert torch.allclose(batch.log_probability, log_probability(batch.action, mean, ppo.updater.log_std), atol=1e-5)
    # 1 m of progress at 10 m/s pays 0.1 m in tens; the tick of the failure costs 10 and ends its chain.
    reward = torch.zeros(5, 2).index_put_((batch.tick, batch.vehicle.clamp(max=1) * (batch.vehicle < 7)), batch.reward)
    assert reward[:, 1].tolist() == pytest.approx([0.1] * 5, abs=1e-3)
    assert reward[:, 0].tolist() == pytest.approx([0.1, 0.1, -10.0, 0.1, 0.1], abs=1e-3)
    at_end = (batch.tick == 2) & (batch.vehicle == 0)
    assert batch.value_target[at_end].item() == pytest.approx(-10.0, abs=1e-4), "nothing follows a failure"
    # Two ticks before, by hand: r + γV' − V, chained by γλ.
    value = ppo.updater.value(batch.observation)
    of = {(int(t), int(v)): i for i, (t, v) in enumerate(zip(batch.tick, batch.vehicle, strict=True))}
    one, two = of[1, 0], of[2, 0]
    residual = batch.reward[one] + 0.9 * value[two] - value[one]
    expected = residual + 0.9 * 0.5 * (batch.reward[two] - value[two])
    assert batch.advantage[one].item() == pytest.approx(expected.item(), abs=1e-4)


def test_what_was_drawn_before_an_update_is_kept_for_the_tick_after_its_horizon() -> None:
    ppo = learner(**SETTINGS)
    ticks = [hero_tick(n) for n in range(6)]
    before = ppo.predictor(dark_is_nan=False).predict_m({0: [ticks[4]]})[0][0]
    ppo.learn(collected(ppo, ticks, 8))
    again = ppo.predictor(dark_is_nan=False)
    assert again.predict_m({0: [ticks[4]]})[0][0].equal(before)
    # A successor has it from the checkpoint, and draws later ticks by the new parameters.
    stored = {file: {n: t.clone() for n, t in tensors.items()} for file, tensors in ppo.tensors().items()}
    successor = learner(**SETTINGS)
    successor.restore(stored, ppo.updates)
    taken = successor.predictor(dark_is_nan=False)
    assert taken.predict_m({0: [ticks[4]]})[0][0].equal(before)
    assert taken.predict_m({0: [ticks[5]]})[0][0].equal(again.predict_m({0: [ticks[5]]})[0][0])
    successor.restore_memory({})
    assert not successor.predictor(dark_is_nan=False).predict_m({0: [ticks[4]]})[0][0].equal(before)


def test_a_rollout_that_grows_keeps_what_was_drawn() -> None:
    rollout = Rollout(60, FIELDS, bootstrap=True, drawn_actions=2)
    drawn = {}
    for n in range(31):
        drawn[n] = DrawnTick(n, torch.rand(SLOTS, 2), torch.rand(SLOTS))
        rollout.add(hero_tick(n), drawn[n])
    assert rollout.full()
    horizon = rollout.take()
    assert horizon.drawn is not None and horizon.drawn.held.action.equal(drawn[30].action)
    for n in range(30):
        assert horizon.drawn.action[n].equal(drawn[n].action)
        assert horizon.drawn.log_probability[n].equal(drawn[n].log_probability)


def driven(**changes: Tensor) -> DrivenStep:
    """A tick at 10 m/s in the lane, at the limit, without force."""
    zero, no = torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.bool)
    step: dict[str, Any] = {
        "progress_m": zero + 1,
        "offset_m": zero,
        "speed_mps": zero + 10,
        "speed_limit_mps": zero + 10,
        "accel_mps2": zero,
        "lateral_accel_mps2": zero,
        "arrived": no,
        "failed": no,
        "ended": no,
        "ended_by": torch.zeros(1, dtype=torch.int64),
        "action": torch.zeros(1, 2),
    }
    return DrivenStep(**(step | changes))


def test_progress_pays_lane_limit_and_comfort_multiply_it_and_ends_count_alone() -> None:
    def earned(**changes: float) -> float:
        return progress_reward(driven(**{n: torch.tensor([v], dtype=torch.float64) for n, v in changes.items()})).item()

    yes = torch.ones(1, dtype=torch.bool)
    assert earned() == pytest.approx(0.1)
    assert earned(progress_m=-1.0) == pytest.approx(-0.1)
    for worse in ({"offset_m": 1.0}, {"speed_mps": 13.0}, {"accel_mps2": -5.0}, {"lateral_accel_mps2": 5.0}):
        assert 0 < earned(**worse) < 0.1, worse
    assert earned(speed_mps=17.0) == 0, "far above the limit nothing pays"
    assert progress_reward(driven(ended=yes, arrived=yes)).item() == 10
    assert progress_reward(driven(ended=yes, failed=yes)).item() == -10
    assert progress_reward(driven(ended=yes)).item() == 0, "a time limit neither pays nor costs"


def test_an_own_reward_is_a_function_of_a_step() -> None:
    run = run_of("driving")
    run["config"]["task"]["reward"] = "test_drawing:speed_alone"
    task = Driving.from_run(run)
    assert task.reward_of_step is speed_alone
    run["config"]["task"]["reward"] = "test_drawing:nothing"
    with pytest.raises(Exception, match=r"`task.reward` is 'test_drawing:nothing'"):
        Driving.from_run(run)


def speed_alone(step: DrivenStep) -> Tensor:
    """A user's reward."""
    return torch.where(step.failed, -5.0, step.speed_mps / 100)
