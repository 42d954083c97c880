"""The baseline trained on the truth: its gradient and what it learns. It does not change PPO."""

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from caraware.learn.ppo import Ppo
from caraware.learn.rewards import distance_m
from caraware.learn.rollout import Rollout
from caraware.learn.supervised import Supervised
from caraware.run.checkpoint import Keeping, TrainingHistory, load_checkpoint, save_checkpoint
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.run.loop import TrainingLoop
from caraware.run.manifest import Counters, newest_sound_checkpoint
from caraware.tasks.localisation import Localisation
from safetensors.torch import load_file
from synthetic import FIELDS, SyntheticChannel, run_file, street_ticks
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_loop import KilledError, final_parameters, loop_over, part, stream
from test_networks import modules
from test_ppo import NOISE_M, TOY, errors_m, fresh, parameters, train


def beside(ppo: Ppo) -> Supervised:
    assert isinstance(ppo.task, Localisation)
    return Supervised(ppo.config, FIELDS, ppo.task, ppo.device)


def both(ppo: Ppo, baseline: Supervised) -> Learner:
    return Learner(ppo, baseline, Counters(0, 0, 0, -1), TrainingHistory())


def train_both(ppo: Ppo, baseline: Supervised, updates: int) -> None:
    """As `test_ppo.train`, and the baseline learns from the same batches."""
    rollout = Rollout(ppo.config.horizon, FIELDS, bootstrap=ppo.config.discount > 0)
    for obs in street_ticks(1_000_000, 64, NOISE_M, seed=5):
        rollout.add(obs)
        if rollout.full():
            batch = ppo.score(rollout.take())
            baseline.learn(batch, ppo.update(batch).learning_rate)
            updates -= 1
        if updates == 0:
            return


def test_it_does_not_change_ppo(tmp_path: Path) -> None:
    for name, is_there in (("with", True), ("without", False)):
        loop_over(tmp_path / name, stream(0), run=run_file(str(tmp_path / name), supervised=is_there))
    one, two = (final_parameters(tmp_path / name) for name in ("with", "without"))
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    with_it, without = part(tmp_path / "with"), part(tmp_path / "without")
    assert with_it["ppo_mean_error_m"] == without["ppo_mean_error_m"]
    assert with_it["supervised_mean_error_m"] > 0.0 and without["supervised_mean_error_m"] is None


def test_it_learns_the_toy_task() -> None:
    ppo = fresh(**TOY)
    baseline = beside(ppo)
    train_both(ppo, baseline, 80)
    _, raw_m = errors_m(ppo)
    ticks = list(street_ticks(200, 64, NOISE_M, seed=99))
    predicted_m = baseline.predict_m(torch.cat([obs.observation for obs in ticks]))
    taught_m = distance_m(predicted_m, torch.cat([obs.truth for obs in ticks])).mean().item()
    assert taught_m < 0.95 * raw_m


def test_it_has_the_samples_and_the_gradient_steps_of_ppo() -> None:
    """A baseline with fewer would lose to a policy that is no better."""
    ppo = fresh(horizon=512, batch_size=128, epochs=3)
    baseline, updater = beside(ppo), ppo.updater
    train_both(ppo, baseline, 2)
    assert int(baseline.optimiser.steps) == int(updater.moments()["policy.steps"]) == 2 * 3 * 4


def test_its_gradient_is_that_of_the_mean_distance() -> None:
    ppo = fresh(matmul_precision="float32", batch_size=256)
    rollout = Rollout(256, FIELDS, bootstrap=False)
    for obs in street_ticks(4, 64, NOISE_M, seed=5):
        rollout.add(obs)
    batch, baseline = ppo.score(rollout.take()), beside(ppo)
    reference = modules(baseline.mlp)
    expected_m = distance_m(ppo.task.answer(reference(batch.observation)), batch.truth).mean()
    expected_m.backward()
    assert baseline.learn(batch, 0.0) == pytest.approx(expected_m.item(), rel=1e-5)
    gradient = torch.cat([value.grad.flatten() for value in reference.parameters() if value.grad is not None])
    torch.testing.assert_close(baseline.mlp.parameters.gradient[: len(gradient)], gradient, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("tick", [36, 60, 99, 125])
def test_a_successor_of_a_killed_trainer_has_the_same_baseline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tick: int
) -> None:
    monkeypatch.setattr(TrainingLoop, "_draw", lambda loop: None)
    settings = {name: run_file(str(tmp_path / name), checkpoint_interval=2) for name in ("whole", "cut")}
    loop_over(tmp_path / "whole", stream(0), group=1, run=settings["whole"])
    with contextlib.suppress(KilledError):
        loop_over(tmp_path / "cut", stream(0, tick), group=1, run=settings["cut"])
    config = RunConfig.from_run(settings["cut"])
    newest = newest_sound_checkpoint(tmp_path / "cut" / "checkpoints")
    learner = Learner.begin(replace(config, resume_from=newest), FIELDS)
    second = SyntheticChannel(settings["cut"], stream(learner.first_tick()), 1)
    assert TrainingLoop(second, config, lambda: False, learner=learner).run()
    one, two = (load_file(next(tmp_path.glob(f"{name}/checkpoints/*5/supervised.safetensors"))) for name in settings)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert part(tmp_path / "cut") == part(tmp_path / "whole")


def test_it_starts_again_if_the_checkpoint_has_none(tmp_path: Path) -> None:
    alone, other = fresh(), fresh()
    baseline = beside(other)
    train(alone, 2)
    written = save_checkpoint(tmp_path, alone, Counters(2, 512, 0, 7), "0", Keeping(1))
    load_checkpoint(written, both(other, baseline))
    assert torch.equal(parameters(other), parameters(alone))
    assert torch.equal(baseline.mlp.parameters.values, beside(fresh()).mlp.parameters.values)
    (tmp_path / "other").mkdir()
    trained = fresh()
    taught = beside(trained)
    train_both(trained, taught, 2)
    written = save_checkpoint(tmp_path / "other", both(trained, taught), Counters(2, 512, 0, 7), "0", Keeping(1))
    load_checkpoint(written, alone)
    load_checkpoint(written, both(other, baseline))
    assert torch.equal(baseline.mlp.parameters.values, taught.mlp.parameters.values)


def test_report_and_tensorboard_have_it_with_an_interval(tmp_path: Path) -> None:
    loop_over(tmp_path, stream(0))
    report = part(tmp_path)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    points = events.Scalars("error/evaluation_supervised_m")
    assert len(points) == 3
    assert points[-1].value == pytest.approx(report["supervised_mean_error_m"], rel=1e-5)
    assert report["evaluations"][-1]["supervised_standard_error_m"] > 0.0
    assert "supervised_ci95_m" in report
