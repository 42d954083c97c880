"""Networks with memory: a task that needs it, gradients, trajectories, and the memory in checkpoints."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.ipc.stream import EMPTY_SLOT
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.learn.gru import RecurrentNetwork, Sequences, Steps, recurrent_policy
from caraware.learn.memory import Memory
from caraware.learn.networks import Activation
from caraware.learn.ppo import Ppo
from caraware.learn.recurrent import NO_SAMPLE, RecurrentPpo, SequenceUpdate, continues, cut, sequences
from caraware.learn.rollout import Rollout
from caraware.learn.stored import MEMORY
from caraware.run.checkpoint import load_checkpoint
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.run.loop import TrainingLoop
from caraware.run.manifest import CheckpointError, newest_sound_checkpoint
from safetensors.torch import load_file
from synthetic import (
    FIELDS,
    SIZE_M,
    SyntheticChannel,
    SyntheticObservation,
    latest_checkpoint,
    locating_ppo,
    run_file,
    street_ticks,
)
from test_loop import KilledError, final_parameters, loop_over, part, stream
from torch import Tensor, nn

CPU = torch.device("cpu")
RECALL_TICKS = 8
TOY: dict[str, Any] = {
    "hidden": [32],
    "horizon": 1024,
    "batch_size": 256,
    "learning_rate": 1e-2,
    "learning_rate_decay": 0.97,
    "initial_std": 0.5,
    "truncation_ticks": RECALL_TICKS,
    "supervised": False,
    "reward": "exponential",
    "reward_scale_m": 40.0,
}


@pytest.fixture(autouse=True)
def exact_products() -> None:
    torch.set_float32_matmul_precision("highest")


def fresh(network: str = "gru", **trainer: object) -> Ppo:
    config = TrainerConfig.from_run(run_file("x", network=network, **trainer))
    return locating_ppo(config, FIELDS, MapBounds(0.0, 0.0, SIZE_M, SIZE_M))


def recall_ticks(vehicles: int, seed: int) -> Iterator[SyntheticObservation]:
    """Every vehicle stands still for some ticks, and only the first of them shows its position."""
    rng = np.random.default_rng(seed)
    for tick, obs in enumerate(street_ticks(1_000_000, vehicles, 0.0, seed)):
        is_shown = tick % RECALL_TICKS == 0
        if is_shown:
            place_m = torch.from_numpy(rng.uniform(0.2 * SIZE_M, 0.8 * SIZE_M, (vehicles, 2)).astype(np.float32))
        fields, truth = torch.zeros(vehicles, FIELDS), torch.zeros(vehicles, 4)
        truth[:, :2] = place_m
        if is_shown:
            fields[:, :2], fields[:, 2] = place_m / (SIZE_M / 2) - 1, 1.0
        yield replace(obs, observation=fields, truth=truth, truncated=np.full(vehicles, is_shown and tick > 0))


def recall_error_m(ppo: Ppo, updates: int) -> float:
    """Error of the policy in the last of some updates."""
    rollout, error_m = Rollout(ppo.config.horizon, FIELDS, bootstrap=False), 0.0
    for obs in recall_ticks(64, seed=3):
        rollout.add(obs)
        if rollout.full():
            batch = ppo.score(rollout.take())
            error_m = batch.metrics["error_m"].mean().item()
            ppo.update(batch)
        if ppo.updates == updates:
            break
    return error_m


def test_only_the_recurrent_policy_remembers_an_earlier_tick() -> None:
    # Uniform places are 51 m from the middle of their square on average; 7 of 8 ticks show nothing.
    assert recall_error_m(fresh(**TOY), 30) < 5.0
    assert recall_error_m(fresh("mlp", **TOY), 30) > 35.0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_it_learns_the_same_task() -> None:
    ppo = fresh(**TOY, device="auto")
    assert ppo.device.type == "cuda"
    assert recall_error_m(ppo, 30) < 5.0


def reference(network: RecurrentNetwork, inputs: int, layers: list[nn.Module]) -> tuple[nn.Sequential, nn.GRU]:
    """Entry layers and the unit as torch's modules, with the network's weights."""
    value = network.parameters.value
    unit = nn.GRU(inputs, network.width)
    for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
        getattr(unit, f"{name}_l0").data.copy_(value[f"gru.{name}"])
    for i, layer in enumerate(m for m in layers if isinstance(m, nn.Linear)):
        layer.weight.data.copy_(value[f"layer{i}.weight"])
        layer.bias.data.copy_(value[f"layer{i}.bias"])
    return nn.Sequential(*layers), unit


def test_outputs_and_gradients_are_those_of_torch_s_gru() -> None:
    torch.manual_seed(0)
    network = recurrent_policy(5, 2, (12, 7), Activation.TANH, CPU)
    network.initialise(torch.Generator().manual_seed(1))
    for name in ("layer0.bias", "gru.bias_ih", "gru.bias_hh", "head.bias"):
        network.parameters.value[name].uniform_(-0.3, 0.3)
    entry, unit = reference(network, 12, [nn.Linear(5, 12), nn.Tanh()])
    lengths, start, x = [4, 2, 1], torch.randn(3, 7), torch.randn(3, 4, 5)
    weight = torch.randn(3, 4, 2)
    outputs = torch.zeros(3, 4, 2)
    head = nn.Linear(7, 2)
    head.weight.data.copy_(network.parameters.value["head.weight"])
    head.bias.data.copy_(network.parameters.value["head.bias"])
    for i, length in enumerate(lengths):
        states, _ = unit(entry(x[i, :length]).unsqueeze(1), start[i].view(1, 1, 7))
        outputs[i, :length] = head(states.squeeze(1)).tanh()
    (outputs * weight).sum().backward()
    rows = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2), (0, 3)]
    packed = Sequences(torch.stack([x[i, j] for i, j in rows]), torch.tensor([3, 2, 1, 1]), start)
    found = network.forward(packed)
    torch.testing.assert_close(found, torch.stack([outputs[i, j] for i, j in rows]).detach())
    network.backward(packed, torch.stack([weight[i, j] for i, j in rows]))
    expected = {f"gru.{name}": getattr(unit, f"{name}_l0").grad for name in ("weight_ih", "weight_hh", "bias_hh")}
    expected |= {"layer0.weight": entry[0].weight.grad, "head.weight": head.weight.grad, "head.bias": head.bias.grad}
    for name, gradient in expected.items():
        torch.testing.assert_close(network.parameters.grad[name], gradient, rtol=1e-4, atol=1e-5)


def test_a_walk_is_the_sequences_one_after_the_other() -> None:
    network = recurrent_policy(FIELDS, 2, (8, 6), Activation.RELU, CPU)
    network.initialise(torch.Generator().manual_seed(1))
    # Two slots; a new trajectory begins in the second one in the third of four ticks.
    x, start = torch.randn(8, FIELDS), torch.randn(2, 6)
    goes_on = torch.tensor([1, 1, 1, 1, 1, 0, 1, 1], dtype=torch.bool)
    walk = network.walk(Steps(x, torch.tensor([0, 1] * 4), goes_on, [2] * 4), start)
    assert torch.equal(walk.before[5], torch.zeros(6))
    first = network.forward(Sequences(x[0::2], torch.tensor([1] * 4), start[:1]))
    second = network.forward(Sequences(x[[1, 3]], torch.tensor([1, 1]), start[1:]))
    third = network.forward(Sequences(x[[5, 7]], torch.tensor([1, 1]), torch.zeros(1, 6)))
    torch.testing.assert_close(walk.output[0::2], first)
    torch.testing.assert_close(walk.output[1::2], torch.cat((second, third)))


def test_trajectories_are_cut_into_sequences() -> None:
    valid = torch.tensor([[1, 1, 0], [1, 0, 0], [1, 1, 1], [1, 1, 1], [1, 1, 1]], dtype=torch.bool)
    goes_on = valid & torch.tensor([[1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 1, 1], [0, 1, 1]], dtype=torch.bool)
    # Samples: tick 0: 0 1; tick 1: 2; tick 2: 3 4 5; tick 3: 6 7 8; tick 4: 9 10 11.
    table = sequences(valid, goes_on, 3)
    found = sorted([row for row in rows if row != NO_SAMPLE] for rows in table.tolist())
    assert found == [[0, 2, 3], [1], [4, 7, 10], [5, 8, 11], [6], [9]]
    assert sequences(valid, goes_on, 1).shape == (12, 1)
    assert sequences(valid, goes_on, 100).shape == (5, 4)


def test_minibatches_hold_every_sequence_once_and_about_as_many_samples() -> None:
    lengths = torch.randint(1, 33, (200,), generator=torch.Generator().manual_seed(0))
    pieces = cut(torch.randperm(200), lengths, 8)
    assert sorted(torch.cat(pieces).tolist()) == list(range(200))
    samples = [int(lengths[piece].sum()) for piece in pieces]
    assert len(pieces) == 8
    assert max(samples) - min(samples) <= 2 * 32
    assert [piece.tolist() for piece in cut(torch.tensor([0]), torch.tensor([50]), 4)] == [[0]]


def errors_m(ppo: Ppo, ticks: list[SyntheticObservation], horizon: int) -> Tensor:
    """Errors of the policy's mean in every sample, computed in horizons."""
    ppo.restore_memory({})
    rollout, found = Rollout(horizon, FIELDS, bootstrap=False), []
    for obs in ticks:
        rollout.add(obs)
        if rollout.full():
            found.append(ppo.score(rollout.take()).metrics["error_m"])
    return torch.cat(found)


def with_ends(count: int, slots: int = 5) -> list[SyntheticObservation]:
    """Vehicles come and go, now and then a tick is missing, and an episode ends in the twentieth tick."""
    rng, ticks = np.random.default_rng(7), []
    vehicle = np.arange(slots, dtype=np.uint32)
    for obs in street_ticks(count, slots, 5.0, seed=6):
        ends = rng.random(slots) < 0.1
        vehicle = np.where(ends, vehicle + 10, vehicle).astype(np.uint32)
        valid = rng.random(slots) < 0.9
        shown = np.where(valid, vehicle, EMPTY_SLOT).astype(np.uint32)
        cut = ends | (obs.tick == 20)
        if obs.tick not in (11, 12, 29):
            ticks.append(replace(obs, vehicle=shown, valid=valid, terminated=ends, truncated=cut & ~ends))
    return ticks


def test_where_horizons_end_changes_nothing_that_is_remembered() -> None:
    ppo, ticks = fresh(), with_ends(40)
    samples = sum(int(obs.valid.sum()) for obs in ticks)
    whole = errors_m(ppo, ticks, samples)
    for horizon in (1, 10, 33):
        found = errors_m(ppo, ticks, horizon)
        torch.testing.assert_close(found, whole[: len(found)], rtol=1e-4, atol=1e-3)


def test_memory_ends_where_trajectories_do() -> None:
    memory = Memory.after(4, torch.tensor([7, 8, 9]), torch.tensor([True, True, False]), torch.ones(3, 2))
    none = torch.zeros(4, dtype=torch.bool)
    vehicles = torch.tensor([7, 8, 9, 5])
    assert memory.before(5, vehicles, none)[:, 0].tolist() == [1, 1, 0, 0]
    assert memory.before(5, torch.tensor([7, 3]), none[:2])[:, 0].tolist() == [1, 0]
    assert memory.before(5, vehicles, torch.tensor([True, False, False, False]))[:, 0].tolist() == [0, 1, 0, 0]
    assert memory.before(6, vehicles, none).sum() == 0
    rollout = Rollout(1, FIELDS, bootstrap=False)
    for obs in with_ends(30):
        rollout.add(obs)
    horizon = rollout.take()
    follows = continues(horizon)
    same = horizon.vehicle[1:] == horizon.vehicle[:-1]
    assert not (follows[1:] & ~same).any() and follows[1:].sum() > 40
    assert not follows[horizon.tick.tolist().index(13)].any() and not follows[horizon.tick.tolist().index(20)].any()


def test_empty_slots_change_no_bit() -> None:
    def wider(obs: SyntheticObservation) -> SyntheticObservation:
        def padded(array: np.ndarray, fill: object) -> np.ndarray:
            return np.concatenate((array, np.full(3, fill, array.dtype)))

        rows = [torch.cat((each, torch.zeros(3, each.shape[1]))) for each in (obs.observation, obs.truth, obs.gnss_m)]
        wide = replace(obs, observation=rows[0], truth=rows[1], gnss_m=rows[2], vehicle=padded(obs.vehicle, EMPTY_SLOT))
        wide.valid, wide.terminated = padded(obs.valid, False), padded(obs.terminated, False)
        wide.truncated = padded(obs.truncated, False)
        return wide

    learnt = []
    for ticks in (with_ends(40), [wider(obs) for obs in with_ends(40)]):
        ppo = fresh(discount=0.9, hidden=[33, 17], batch_size=32, horizon=40)
        rollout = Rollout(40, FIELDS, bootstrap=True)
        for obs in ticks:
            rollout.add(obs)
            if rollout.full():
                ppo.learn(rollout.take())
        learnt.append(torch.cat([each.flatten() for each in ppo.updater.parameters().values()]))
        assert ppo.updates == 3
    assert torch.equal(*learnt)


@pytest.mark.parametrize("tries", [1, 4])
def test_the_first_pass_is_the_policy_that_sampled(tries: int) -> None:
    ppo = fresh(actions_per_observation=tries, epochs=1, batch_size=256)
    rollout = Rollout(256, FIELDS, bootstrap=False)
    for obs in with_ends(100):
        rollout.add(obs)
        if rollout.full():
            break
    stats = ppo.learn(rollout.take())
    assert stats.ratio_mean == pytest.approx(1.0, abs=1e-5)
    assert stats.clip_fraction == 0.0
    assert stats.approximate_kl == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_gives_the_same_parameters(threads: int) -> None:
    one, two = fresh(threads=1), fresh(threads=threads)
    for ppo in (one, two):
        rollout = Rollout(64, FIELDS, bootstrap=False)
        for obs in with_ends(60):
            rollout.add(obs)
            if rollout.full():
                ppo.learn(rollout.take())
    for name, parameter in one.updater.parameters().items():
        assert torch.equal(parameter, two.updater.parameters()[name])


def test_published_predictions_are_those_of_the_horizon(tmp_path: Path) -> None:
    """Before the first update, the predictions of ticks that came one by one are the means of the horizon."""
    ticks = [replace(obs, last=obs.tick == 39) for obs in with_ends(40)]
    channel = loop_over(tmp_path, iter(ticks), 3, run_file(str(tmp_path), network="gru", horizon=10_000))
    ppo = fresh()
    rollout = Rollout(1, FIELDS, bootstrap=False)
    for obs in ticks:
        rollout.add(obs)
    error_m = ppo.score(rollout.take()).metrics["error_m"]
    shown = [(channel.predictions[obs.tick] - obs.truth[:, :2]).norm(dim=1)[obs.valid] for obs in ticks]
    torch.testing.assert_close(torch.cat(shown), error_m, rtol=1e-4, atol=1e-3)


def test_how_ticks_arrive_together_changes_nothing(tmp_path: Path) -> None:
    for group in (1, 3, 8):
        folder = tmp_path / str(group)
        loop_over(folder, stream(0), group, run_file(str(folder), network="gru", discount=0.9))
    one, three, eight = (final_parameters(tmp_path / str(group)) for group in (1, 3, 8))
    assert all(torch.equal(tensor, three[name]) and torch.equal(tensor, eight[name]) for name, tensor in one.items())
    evaluations = [part(tmp_path / str(group))["evaluations"] for group in (1, 3, 8)]
    assert evaluations == [evaluations[0]] * 3


def stream_settings(folder: Path, discount: float) -> dict[str, Any]:
    """An update every 16 training ticks, in the middle of trajectories; a checkpoint with every second."""
    return run_file(str(folder), network="gru", discount=discount, checkpoint_interval=2, epochs=2)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[float, Path]:
    """Directories of undisturbed runs, by their discount."""
    folders = {discount: tmp_path_factory.mktemp("whole") for discount in (0.0, 0.9)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingLoop, "_draw", lambda loop: None)
        for discount, folder in folders.items():
            loop_over(folder, stream(0), group=1, run=stream_settings(folder, discount))
    return folders


@pytest.mark.parametrize("discount", [0.0, 0.9])
@pytest.mark.parametrize("tick", [2, 36, 60, 99])
@pytest.mark.parametrize("end", ["left", "killed"])
def test_a_successor_ends_where_the_undisturbed_run_does(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    undisturbed: dict[float, Path],
    end: str,
    tick: int,
    discount: float,
) -> None:
    monkeypatch.setattr(TrainingLoop, "_draw", lambda loop: None)
    whole, settings = undisturbed[discount], stream_settings(tmp_path, discount)
    config = RunConfig.from_run(settings)
    first = SyntheticChannel(settings, stream(0, tick if end == "killed" else None), 1)
    loop = TrainingLoop(
        first, config, lambda: False, leave_requested=lambda: end == "left" and first.consumed_up_to >= tick
    )
    with contextlib.suppress(KilledError):
        assert not loop.run()
    newest = newest_sound_checkpoint(tmp_path / "checkpoints")
    learner = Learner.begin(replace(config, resume_from=newest), FIELDS)
    second = SyntheticChannel(settings, stream(learner.first_tick()), 1)
    assert TrainingLoop(second, config, lambda: False, learner=learner).run()
    one, two = final_parameters(whole), final_parameters(tmp_path)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert part(tmp_path) == part(whole)


def _has_consumed(channel: SyntheticChannel, tick: int) -> bool:
    return channel.consumed_up_to >= tick


def stopped_at(folder: Path, tick: int) -> tuple[RunConfig, Path]:
    """A run that has been stopped, and a checkpoint of its second update, with which its configuration begins."""
    run = run_file(str(folder), network="gru")
    channel = SyntheticChannel(run, street_ticks(200, 16, 5.0, seed=4), 1)
    config = RunConfig.from_run(run)
    TrainingLoop(channel, config, lambda: channel.consumed_up_to >= tick).run()
    checkpoint = latest_checkpoint(folder / "checkpoints")
    return replace(config, resume_from=checkpoint), checkpoint


def test_the_memory_of_the_committed_tick_is_in_the_checkpoint(tmp_path: Path) -> None:
    config, checkpoint = stopped_at(tmp_path, 40)
    stored = load_file(checkpoint / MEMORY)
    assert (int(stored["tick0"]), stored["vehicle0"].tolist()) == (31, list(range(16)))
    assert stored["state0"].shape == (16, 2 * 16)
    rest = {}
    for forgets in (False, True):
        learner = Learner.begin(config, FIELDS)
        if forgets:
            learner.ppo.restore_memory({})
        ticks = (obs for obs in street_ticks(60, 16, 5.0, seed=4) if obs.tick > 31)
        channel = SyntheticChannel(run_file(str(tmp_path / str(forgets))), ticks)
        TrainingLoop(channel, config, partial(_has_consumed, channel, 50), learner=learner).run()
        assert isinstance(learner.ppo.updater, SequenceUpdate)
        rest[forgets] = learner.ppo.updater.policy_network.parameters.values
    assert not torch.equal(rest[False], rest[True])


def test_parameters_of_another_checkpoint_come_without_its_memory(tmp_path: Path) -> None:
    config, checkpoint = stopped_at(tmp_path, 40)
    learner = Learner.begin(config, FIELDS)
    assert isinstance(learner.ppo, RecurrentPpo)
    assert learner.ppo.memories[0].state.abs().sum() > 0
    learner.take_parameters(checkpoint)
    assert len(learner.ppo.memories[0].vehicle) == 0


def test_environments_remember_apart(tmp_path: Path) -> None:
    found = {}
    for name, groups in (("even", (8, 8)), ("uneven", (1, 13))):
        run = run_file(str(tmp_path / name), network="gru")
        run["config"]["run"] |= {"envs": 2, "first_env": 0}
        streams = [street_ticks(40, 16, 5.0, seed) for seed in (1, 2)]
        marked = [(replace(obs, last=obs.tick == 39) for obs in ticks) for ticks in streams]
        first, second = (SyntheticChannel(run, ticks, group) for ticks, group in zip(marked, groups, strict=True))
        TrainingLoop(first, RunConfig.from_run(run), lambda: False, others=[second]).run()
        checkpoint = latest_checkpoint(tmp_path / name / "checkpoints")
        found[name] = load_file(checkpoint / "parameters.safetensors") | load_file(checkpoint / MEMORY)
    assert {"tick0", "tick1", "state0", "state1"} < set(found["even"])
    assert not torch.equal(found["even"]["state0"], found["even"]["state1"])
    assert all(torch.equal(tensor, found["uneven"][name]) for name, tensor in found["even"].items())


def test_another_network_is_refused_with_both_named(tmp_path: Path) -> None:
    _, checkpoint = stopped_at(tmp_path, 40)
    with pytest.raises(CheckpointError, match="its network is gru, this run's is mlp"):
        load_checkpoint(checkpoint, fresh("mlp"))
    with pytest.raises(CheckpointError, match="its hidden is"):
        load_checkpoint(checkpoint, fresh(hidden=[32, 8]))
    loaded = fresh(seed=5)
    load_checkpoint(checkpoint, loaded)
    assert isinstance(loaded, RecurrentPpo) and int(loaded.memories[0].tick) == 31
