"""Ranks that learn together by `torch.distributed` learn what one trainer with all their environments learns."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from caraware.learn.build import build_ppo
from caraware.learn.config import ConfigError, TrainerConfig
from caraware.learn.ranks import SECRET, RankError, Ranks, SampleUnion, shared_secret
from caraware.parallel import Agree, Completed, Launch, RankPlace, RankRun, ResumeError, command
from caraware.run.checkpoint import load_history
from caraware.run.config import RunConfig
from caraware.run.loop import TrainingLoop
from caraware.run.manifest import BEGINNING, NEWEST, read_manifest
from rank_probe import TRAINING_TICKS, VEHICLES, channels, settings
from safetensors.torch import load_file
from synthetic import FIELDS, latest_checkpoint, run_file

HERE = Path(__file__).parent
UPDATES = 4
"""Of 256 samples of each of two environments."""
LARGEST_DIFFERENCE = 1e-5
"""Of a parameter after four updates of 64 gradient steps, which move it by up to 0.1: float32 sums in another order.
Seen: 2e-7, on CPUs by gloo and on two GPUs by NCCL (RANK_PROBE_DEVICE=auto)."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


TRAININGS: dict[str, dict[str, Any]] = {
    "default": {},
    "with memory": {"network": "gru", "hidden": [24, 12], "truncation_ticks": 5},
    "several actions": {"actions_per_observation": 4, "discount": 0.0},
    "own network": {"network": "own_residual:Residual", "hidden": [24], "target_kl": 0.02},
}
"""Settings of the trainer beside those of the probe, by name."""


def launch(
    folder: Path, *options: str, fault: str = "", trainings: Sequence[str] = ("default",), secret: str = ""
) -> subprocess.Popen[str]:
    """`torchrun` over the probe with these trainings, started and not waited for."""
    path = os.pathsep.join(filter(None, (str(HERE), os.environ.get("PYTHONPATH"))))
    chosen = {name: TRAININGS[name] for name in trainings}
    torchrun = [sys.executable, "-m", "torch.distributed.run", *options]
    return subprocess.Popen(
        [*torchrun, str(HERE / "rank_probe.py"), str(folder), fault],
        env=os.environ | {"PYTHONPATH": path, "RANK_PROBE_TRAININGS": json.dumps(chosen), SECRET: secret},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> str:
    said, _ = process.communicate(timeout=240)
    assert process.returncode == 0, said
    return said


def parameters(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(latest_checkpoint(folder / "checkpoints") / "parameters.safetensors")


def part(folder: Path) -> dict[str, Any]:
    written: dict[str, Any] = json.loads((folder / "parts" / "trainer.json").read_text())
    return written


def learn_alone(folder: Path, training: str) -> Path:
    """One trainer with both environments, and a horizon and batch of twice the size."""
    run = settings(folder, 2, 0, 1, TRAININGS[training])
    first, *others = channels(run)
    TrainingLoop(first, RunConfig.from_run(run), lambda: False, others=others).run()
    return folder


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of one trainer with the default network."""
    return learn_alone(tmp_path_factory.mktemp("alone"), "default")


@pytest.fixture(scope="module")
def together(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every training in two ranks, in a directory of its name. One launch runs all: each process imports torch once."""
    folder = tmp_path_factory.mktemp("together")
    finish(launch(folder, "--standalone", "--nproc-per-node=2", trainings=list(TRAININGS)))
    return folder


def assert_the_same(alone: Path, rank0: Path) -> None:
    one, two = parameters(alone), parameters(rank0)
    assert {name: tensor.shape for name, tensor in one.items()} == {name: tensor.shape for name, tensor in two.items()}
    differences = {name: (tensor - two[name]).abs().max().item() for name, tensor in one.items()}
    assert max(differences.values()) < LARGEST_DIFFERENCE, differences
    of_one, of_two = part(alone), part(rank0)
    assert (of_two["updates"], of_two["ranks"]) == (UPDATES, 2)
    assert of_two["env_steps_of_all_ranks"] == of_one["env_steps"] == 2 * TRAINING_TICKS * VEHICLES
    assert of_two["ppo_mean_error_m"] == pytest.approx(of_one["ppo_mean_error_m"], rel=1e-4)
    assert [e["samples"] for e in of_two["evaluations"]] == [e["samples"] for e in of_one["evaluations"]]


def test_two_ranks_learn_what_one_does_with_twice_the_batch(together: Path, alone: Path) -> None:
    ranks = together / "default"
    assert_the_same(alone, ranks / "rank0")
    # Rank 0's checkpoint is that of one trainer with both environments.
    mine, theirs = (latest_checkpoint(folder / "checkpoints") for folder in (alone, ranks / "rank0"))
    assert load_history(theirs).others == load_history(mine).others
    for name, state in load_file(mine / "random.safetensors").items():
        assert torch.equal(state, load_file(theirs / "random.safetensors")[name])
    # Rank 1's has the same parameters, and where its own environment stands.
    own = latest_checkpoint(ranks / "rank1" / "checkpoints")
    assert read_manifest(own).files["parameters.safetensors"] == read_manifest(theirs).files["parameters.safetensors"]
    assert not load_history(own).others
    assert load_file(own / "random.safetensors").keys() == {"sampling1", "shuffling"}


@pytest.mark.parametrize("training", ["with memory", "several actions"])
def test_ranks_share_sequences_and_several_actions_too(tmp_path: Path, together: Path, training: str) -> None:
    alone, rank0 = learn_alone(tmp_path, training), together / training / "rank0"
    assert_the_same(alone, rank0)
    mine, theirs = (latest_checkpoint(folder / "checkpoints") / "memory.safetensors" for folder in (alone, rank0))
    assert mine.exists() == theirs.exists() == (training == "with memory")
    if mine.exists():
        remembered, shared = load_file(mine), load_file(theirs)
        assert remembered.keys() == shared.keys()
        for name, tensor in remembered.items():
            assert torch.allclose(tensor, shared[name], atol=1e-4), name


def test_ranks_share_a_network_of_the_user_s_own(tmp_path: Path, together: Path) -> None:
    """`PlainUpdate` alone against `RankedUpdate` in two ranks; its checkpoints of other ranks have the same rows."""
    alone = learn_alone(tmp_path, "own network")
    assert_the_same(alone, together / "own network" / "rank0")
    assert "policy.0.enter.weight" in parameters(alone)


def test_two_nodes_meet_at_a_rendezvous_address(tmp_path: Path, alone: Path) -> None:
    meeting = ("--nnodes=2", "--nproc-per-node=1", "--rdzv-backend=c10d", f"--rdzv-endpoint=127.0.0.1:{free_port()}")
    nodes = [launch(tmp_path, *meeting, "--local-addr=127.0.0.1", secret="a text of both nodes") for _ in range(2)]
    for node in nodes:
        finish(node)
    assert_the_same(alone, tmp_path / "default" / "rank0")


def test_a_rank_that_does_not_know_the_secret_ends_the_launch() -> None:
    # It ends as the trainer does: torch's threads may abort a process that tidies up while they still run.
    meet = """
import os, sys
from caraware.learn.ranks import RankError, TorchRanks
try:
    TorchRanks(2)
except RankError as error:
    print(error, file=sys.stderr, flush=True)
    os._exit(1)
"""
    meeting = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    ranks = [
        subprocess.Popen(
            [sys.executable, "-c", meet],
            env=os.environ | meeting | {"RANK": str(rank), SECRET: f"sixteen characters, {secret}"},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank, secret in enumerate(("ours", "not ours"))
    ]
    ends = [(rank.communicate(timeout=120)[1], rank.returncode) for rank in ranks]
    assert [code for _, code in ends] == [1, 1], ends
    for other, (said, _) in zip((1, 0), ends, strict=True):
        assert f"rank {other} has another secret" in said, said


def test_several_machines_need_a_secret_and_one_has_that_of_torchrun() -> None:
    assert shared_secret({"GROUP_WORLD_SIZE": "1", "TORCHELASTIC_RUN_ID": "9d3f"}) == b"9d3f"
    assert shared_secret({"GROUP_WORLD_SIZE": "2", SECRET: "sixteen letters."}) == b"sixteen letters."
    with pytest.raises(RankError, match=f"set {SECRET} to the same text"):
        shared_secret({"GROUP_WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "none"})
    with pytest.raises(RankError, match="it needs 16"):
        shared_secret({SECRET: "short"})


@pytest.mark.parametrize(("fault", "says"), [("dies", "exitcode  : 9"), ("differs", "parameters differ")])
def test_all_ranks_end_when_one_cannot_continue(tmp_path: Path, fault: str, says: str) -> None:
    process = launch(tmp_path, "--standalone", "--nproc-per-node=2", fault=fault)
    said, _ = process.communicate(timeout=240)
    assert process.returncode != 0
    assert says in said, said


def test_batch_statistics_are_refused_with_several_ranks() -> None:
    ranks = Ranks()
    ranks.size = 2
    config = TrainerConfig.from_run(run_file("x", network="own_residual:Normalising", hidden=[8], ranks=2))
    with pytest.raises(ConfigError, match="its BatchNorm1d takes the statistics of a minibatch") as refused:
        build_ppo(config, FIELDS, RunConfig.from_run(run_file("x")).task, ranks=ranks)
    assert "torch.nn.LayerNorm" in refused.value.help


def test_a_minibatch_of_the_union_is_what_the_ranks_have_of_it_together() -> None:
    columns = torch.arange(10.0)
    whole = Ranks().union(columns, columns, columns)
    order = torch.randperm(10, generator=torch.Generator().manual_seed(3))
    parts = [SampleUnion(columns, columns, columns, offset, own) for offset, own in ((0, 3), (3, 7))]
    cut = [list(part.minibatches([columns[part.offset :][: part.own]], order, 4)) for part in parts]
    for together, first, second in zip(whole.minibatches([columns], order, 4), *cut, strict=True):
        assert first.share + second.share == together.share == 1.0
        assert torch.equal(first.advantage, together.advantage)
        rows = torch.cat((first.own[0], second.own[0]))
        assert torch.equal(rows.sort().values, together.own[0].sort().values)
        assert torch.equal(first.own[0], first.mine(together.advantage))


def disagree(place: RankPlace, name: str, own: RankRun) -> list[RankRun]:
    raise AssertionError("there is nothing to agree on")


def beside(other: RankRun) -> Agree:
    """What this rank and another have of their runs."""
    return lambda place, name, own: [own, other]


MADE, COMPLETED = RankRun(True, False, ()), RankRun(True, True, ("update-000002",))
AHEAD = RankRun(True, False, ("update-000001", "update-000002"))
FIRST = RankPlace(0, 2, 0, 2)


def test_a_launch_that_is_started_again_continues_the_runs_that_it_has_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(NEWEST, "")
    monkeypatch.delenv(NEWEST)
    words = ["town", "--runs", str(tmp_path), "--name", "x", "--set", "traffic.cavs=8", "--viewer=web", "--user", "u"]
    run, again = tmp_path / "x", Launch(7, time.time() - 60, restarts=1)
    # What a supervisor that died in its preparation has left is removed; other directories stay.
    run.mkdir()
    (run / ".preparing-999999999").touch()
    (tmp_path / "y").mkdir()
    (tmp_path / "y" / "file").touch()
    assert command(words, FIRST, again, beside(MADE)) == command(words, FIRST, Launch(7, 0.0), disagree)
    assert [path.name for path in tmp_path.iterdir()] == ["y"]
    command([*words, "--name", "y"], FIRST, again, beside(MADE))
    assert (tmp_path / "y" / "file").exists()

    run.mkdir()
    (run / "run.json").write_text("{}")
    continued = ["train", "--viewer=web", "--user", "u", "--resume", str(run)]
    assert command(words, FIRST, again, beside(RankRun(False, False, ()))) == continued
    assert NEWEST not in os.environ
    assert command(words, FIRST, again, beside(MADE)) == continued
    assert os.environ[NEWEST] == BEGINNING
    with pytest.raises(ResumeError, match="no checkpoint here that all 2 ranks have"):
        command(words, FIRST, again, beside(AHEAD))
    # Another launch has made it, before this one began.
    os.utime(run / "run.json", (0, 0))
    assert "--name" in command(words, FIRST, again, beside(MADE))


def test_ranks_that_have_all_completed_their_runs_do_not_continue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(NEWEST, "")
    monkeypatch.delenv(NEWEST)
    run, again = tmp_path / "x", Launch(7, time.time() - 60, restarts=1)
    run.mkdir()
    (run / "run.json").write_text("{}")
    (run / "report.json").write_text(json.dumps({"result": "completed"}))
    for words in (["--name", "x", "--runs", str(tmp_path)], ["--resume", "x", "--runs", str(tmp_path)]):
        with pytest.raises(Completed):
            command(words, FIRST, again, beside(COMPLETED))
        assert "--resume" in command(words, FIRST, again, beside(MADE))
    with pytest.raises(ResumeError, match="ranks on several machines do not continue by themselves"):
        command([], FIRST, Launch(7, 0.0, restarts=1, machines=2), disagree)


def test_each_rank_gets_its_own_environments_and_cores() -> None:
    place = RankPlace(rank=1, ranks=2, local_rank=1, local_ranks=2)
    words = command(["town", "--set", "traffic.cavs=8", "--envs", "3", "--name", "x"], place, Launch(7, 0.0), disagree)
    assert words[:4] == ["train", "town", "--set", "traffic.cavs=8"]
    assert words[words.index("--name") + 1] == "x-rank1"
    for setting in ("run.envs=3", "run.first_env=3", "trainer.ranks=2", "fanout.enabled=false"):
        assert f"--set={setting}" in words
    assert words.count("--quiet") == 1
    assert command(["--quiet"], place, Launch(7, 0.0), disagree).count("--quiet") == 1
    first = command([], RankPlace(0, 2, 0, 2), Launch(7, 0.0), disagree)
    assert "--quiet" not in first
    assert first[first.index("--name") + 1] == "town-p7"
    assert not any("fanout" in word for word in first)
    assert place.cores([0, 1, 2, 3, 8]) == [2, 3]
    assert place.cores([4]) == [4]
