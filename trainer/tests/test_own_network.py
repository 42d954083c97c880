"""A user's own network: a small `nn.Module` in a file trains, is stored, resumes bit for bit, and plays."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from caraware.learn.build import build_ppo
from caraware.learn.config import ConfigError, MapBounds, TrainerConfig
from caraware.learn.ppo import PlainUpdate
from caraware.run.checkpoint import Keeping, save_checkpoint
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.run.loop import TrainingLoop
from caraware.run.manifest import CheckpointError, Counters, newest_sound_checkpoint
from caraware.run.player import PlayLoop
from synthetic import FIELDS, SIZE_M, SyntheticChannel, locating_ppo, run_file
from synthetic_vehicle import vehicle_run
from test_loop import KilledError, final_parameters, loop_over, part, stream
from test_player import ticks
from test_ppo import errors_m, train

SOURCE = '''
from torch import nn


class Residual(nn.Module):
    """A hidden layer with a way around it; it inherits torch's own initial weights."""

    def __init__(self, inputs, outputs, hidden):
        super().__init__()
        self.enter = nn.Linear(inputs, hidden[0])
        self.norm = nn.LayerNorm(hidden[0])
        self.inner = nn.Linear(hidden[0], hidden[0])
        self.leave = nn.Linear(hidden[0], outputs)

    def forward(self, rows):
        entered = self.enter(rows).relu()
        return self.leave(entered + self.inner(self.norm(entered)).relu())


nothing = 1
'''
NETWORK = "own_networks:Residual"


@pytest.fixture(autouse=True)
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`own_networks.py` in a folder of `sys.path`, as PYTHONPATH puts one there."""
    (tmp_path / "python").mkdir()
    (tmp_path / "python" / "own_networks.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(str(tmp_path / "python"))
    monkeypatch.delitem(sys.modules, "own_networks", raising=False)
    monkeypatch.setattr(TrainingLoop, "_draw", lambda loop: None)


def settings(**trainer: object) -> TrainerConfig:
    return TrainerConfig.from_run(run_file("x", network=NETWORK, hidden=[24], **trainer))


def test_it_learns_by_autograd() -> None:
    toy = {"horizon": 1024, "batch_size": 128, "learning_rate": 4e-3, "initial_std": 0.6, "epochs": 4}
    ppo = locating_ppo(
        settings(reward="exponential", reward_scale_m=20.0, **toy), FIELDS, MapBounds(0, 0, SIZE_M, SIZE_M)
    )
    assert isinstance(ppo.updater, PlainUpdate)
    before_m, _ = errors_m(ppo)
    stats = train(ppo, 40)
    after_m, _ = errors_m(ppo)
    assert after_m < 0.4 * before_m
    assert stats[-1].sigma < stats[0].sigma


def test_the_same_seed_draws_the_same_weights() -> None:
    one, two, other = (
        locating_ppo(settings(seed=s), FIELDS, MapBounds(0, 0, 1, 1)).updater.parameters() for s in (1, 1, 2)
    )
    assert all(torch.equal(one[name], tensor) for name, tensor in two.items())
    assert not all(torch.equal(one[name], tensor) for name, tensor in other.items())


def test_a_killed_trainer_s_successor_ends_in_the_same_parameters(tmp_path: Path) -> None:
    settings = {
        name: run_file(str(tmp_path / name), checkpoint_interval=2, network=NETWORK, hidden=[24])
        for name in ("whole", "cut")
    }
    loop_over(tmp_path / "whole", stream(0), group=1, run=settings["whole"])
    with pytest.raises(KilledError):
        loop_over(tmp_path / "cut", stream(0, 60), group=1, run=settings["cut"])
    config = RunConfig.from_run(settings["cut"])
    newest = newest_sound_checkpoint(tmp_path / "cut" / "checkpoints")
    assert newest is not None
    learner = Learner.begin(replace(config, resume_from=newest), FIELDS)
    second = SyntheticChannel(settings["cut"], stream(learner.first_tick()), 1)
    assert TrainingLoop(second, config, lambda: False, learner=learner).run()
    one, two = (final_parameters(tmp_path / name) for name in ("whole", "cut"))
    assert {"policy.0.enter.weight", "policy.log_std", "value.norm.weight"} <= set(one)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert part(tmp_path / "cut") == part(tmp_path / "whole")


def test_it_plays(tmp_path: Path) -> None:
    trained, played = (vehicle_run(str(tmp_path / name), network=NETWORK, hidden=[24]) for name in ("run", "play"))
    size = next(ticks()).observation.shape[1]
    ppo = build_ppo(TrainerConfig.from_run(trained), size, RunConfig.from_run(trained).task)
    ppo.updater.parameters()["policy.log_std"].fill_(-2.5)
    (tmp_path / "play").mkdir()
    written = save_checkpoint(tmp_path / "run" / "checkpoints", ppo, Counters(3, 96, 1, 31), "0", Keeping(1))
    played["beginning"] = {"checkpoint": str(written)}
    config = RunConfig.from_run(played)
    learner = Learner.begin(config, size)
    PlayLoop(SyntheticChannel(played, ticks()), config, learner.for_play(), lambda: False).run()
    report = part(tmp_path / "play")
    assert report["updates"] == 3 and report["ppo_mean_error_m"] > 0
    assert report["policy_std"] == pytest.approx(math.exp(-2.5))


def test_another_network_s_checkpoint_is_refused(tmp_path: Path) -> None:
    run = run_file(str(tmp_path / "run"), checkpoint_interval=2)
    loop_over(tmp_path / "run", stream(0), group=1, run=run)
    newest = newest_sound_checkpoint(tmp_path / "run" / "checkpoints")
    config = RunConfig.from_run(run_file(str(tmp_path / "own"), network=NETWORK, hidden=[32, 32]))
    with pytest.raises(CheckpointError, match="its network is mlp, this run's is own_networks:Residual"):
        Learner.begin(replace(config, resume_from=newest), FIELDS)


@pytest.mark.parametrize("name", ["no_such_module:Net", "own_networks:Missing", "mlpx"])
def test_a_class_that_is_not_there_is_named(name: str) -> None:
    with pytest.raises(ConfigError, match=name.partition(":")[0]):
        locating_ppo(TrainerConfig.from_run(run_file("x", network=name)), FIELDS, MapBounds(0, 0, 1, 1))
