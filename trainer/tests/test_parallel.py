"""`torchrun -m caraware.parallel` with real runs: real SUMO, real processes, two supervisors."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from caraware.run.checkpoint import POINTS
from caraware.run.manifest import newest_update, read_manifest
from caraware.run.program import caraware_program
from safetensors.torch import load_file
from synthetic import latest_checkpoint

SETTINGS = {
    "traffic.cavs": 4,
    "traffic.others": 2,
    "traffic.pedestrians": 2,
    "episode.ticks": 150,
    "episode.training_episodes": 2,
    "episode.evaluation_ticks": 50,
    "episode.final_evaluations": 1,
    # In networks of 500 x 300 some gradients are as small as rounding, which Adam's first steps make large.
    "trainer.hidden": "[64, 64]",
    "trainer.matmul_precision": "float32",
    "fanout.enabled": "false",
}
LARGEST_DIFFERENCE = 1e-5
"""Of a tensor, relative (L2): a few updates from scratch, float32 sums in another order. Seen: 6e-7."""
PATIENCE_S = 240
SLOW = "run.real_time_factor=0.7"
"""For runs that go on while three pairs of trainers start, which takes a busy machine 10 s a pair. It lasts 50 s."""


@contextmanager
def empty_registry() -> Iterator[Path]:
    """A registry of runs, short enough for a socket's path, that must be empty in the end."""
    with tempfile.TemporaryDirectory(prefix="caraware") as folder:
        registry = Path(folder) / "r"
        yield registry
        assert not registry.exists(), "something is left of a run"


@pytest.fixture
def registry() -> Iterator[Path]:
    with empty_registry() as registry:
        yield registry


def start(folder: Path, registry: Path, words: list[str], horizon: int, *more: str) -> subprocess.Popen[str]:
    sizes = {"trainer.horizon": horizon, "trainer.batch_size": horizon // 2, "trainer.plots": "false"}
    settings = [f"--set={key}={value}" for key, value in (SETTINGS | sizes).items()]
    return launch(folder, registry, [*words, "town", *settings, *(f"--set={setting}" for setting in more)])


def launch(folder: Path, registry: Path, words: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*words, "--runs", str(folder)],
        env=os.environ | {"CARAWARE_RUNTIME_DIR": str(registry), "CARAWARE_PYTHON": sys.executable},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def torchrun(*options: str) -> list[str]:
    options = ("--standalone", "--nproc-per-node=2", *options)
    return [sys.executable, "-m", "torch.distributed.run", *options, "-m", "caraware.parallel"]


def two_ranks(folder: Path, registry: Path, name: str = "two", *more: str) -> subprocess.Popen[str]:
    return start(folder, registry, [*torchrun(), f"--name={name}"], 256, *more)


def resume(folder: Path, registry: Path, named: str, *more: str) -> tuple[int, str]:
    process = launch(folder, registry, [*torchrun(), f"--resume={named}", *more])
    said, _ = process.communicate(timeout=PATIENCE_S)
    return process.returncode, said


EVERY_UPDATE = ("trainer.checkpoint_interval=1", "trainer.checkpoint_keep_every=1")


@dataclass(frozen=True)
class WholeRun:
    """Two ranks, `whole` and `whole-rank1`, that ran undisturbed and kept the checkpoint of every update."""

    folder: Path
    said: str
    """Standard output and standard error."""

    def copy_to(self, folder: Path) -> None:
        """Copies both ranks, for a test that changes them."""
        for name in ("whole", "whole-rank1"):
            shutil.copytree(self.folder / name, folder / name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> WholeRun:
    folder = tmp_path_factory.mktemp("whole")
    with empty_registry() as registry:
        process = two_ranks(folder, registry, "whole", *EVERY_UPDATE)
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    return WholeRun(folder, said)


def report(run: Path) -> dict[str, Any]:
    written: dict[str, Any] = json.loads((run / "report.json").read_text())
    return written


def parameters(run: Path) -> dict[str, torch.Tensor]:
    return load_file(latest_checkpoint(run / "checkpoints") / "parameters.safetensors")


def tensors(run: Path) -> dict[str, str]:
    """SHA-256 of a rank's last checkpoint: parameters, moments, random numbers."""
    files = read_manifest(latest_checkpoint(run / "checkpoints")).files
    return {name: digest for name, digest in files.items() if name.endswith(".safetensors") and name != POINTS}


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_two_ranks_are_one_trainer_with_two_environments(tmp_path: Path, registry: Path, whole: WholeRun) -> None:
    one = start(tmp_path, registry, [str(caraware_program()), "train", "--envs=2", "--name=one"], 512)
    said, _ = one.communicate(timeout=PATIENCE_S)
    assert one.returncode == 0, said
    alone, ranks = report(tmp_path / "one"), [report(whole.folder / name) for name in ("whole", "whole-rank1")]
    hashes = [environment["observation_hash"] for environment in alone["environments"]]
    assert [rank["observation_hash"] for rank in ranks] == hashes
    assert alone["trainer"]["updates"] == ranks[0]["trainer"]["updates"] > 1
    assert ranks[0]["trainer"]["env_steps_of_all_ranks"] == alone["env_steps"]
    expected, found = parameters(tmp_path / "one"), parameters(whole.folder / "whole")
    differences = {name: ((tensor - found[name]).norm() / tensor.norm()).item() for name, tensor in expected.items()}
    assert max(differences.values()) < LARGEST_DIFFERENCE, differences
    # Only rank 0 shows its progress.
    assert "run whole: results go to" in whole.said
    assert "whole-rank1" not in whole.said


def test_ranks_continue_from_the_newest_checkpoint_that_all_have(
    tmp_path: Path, registry: Path, whole: WholeRun
) -> None:
    whole.copy_to(tmp_path)
    expected = [tensors(tmp_path / name) for name in ("whole", "whole-rank1")]

    cut = two_ranks(tmp_path, registry, "cut", *EVERY_UPDATE, "run.real_time_factor=10")
    checkpoints = tmp_path / "cut-rank1" / "checkpoints"
    wait_until(lambda: (checkpoints / "update-000003").exists(), cut)
    os.kill(cut.pid, signal.SIGINT)
    said, _ = cut.communicate(timeout=PATIENCE_S)
    newest = latest_checkpoint(checkpoints)
    assert newest == latest_checkpoint(checkpoints).parent / latest_checkpoint(tmp_path / "cut" / "checkpoints").name
    # The same state as after a kill before all ranks had the newest checkpoint.
    shutil.rmtree(newest)
    code, said = resume(tmp_path, registry, "cut", "--set=run.real_time_factor=0")
    assert code == 0, said
    beginning = report(tmp_path / "cut")["beginning"]
    assert int(Path(beginning["checkpoint"]).name.removeprefix("update-")) == int(newest.name[-6:]) - 1
    assert [tensors(tmp_path / name) for name in ("cut", "cut-rank1")] == expected

    # Another run, from a checkpoint amid the second episode.
    older = tmp_path / "whole" / "checkpoints" / "update-000003"
    code, said = resume(tmp_path, registry, str(older), "--name=other")
    assert code == 0, said
    assert report(tmp_path / "other-rank1")["beginning"]["episode"] > 0
    assert [tensors(tmp_path / name) for name in ("other", "other-rank1")] == expected

    alone = launch(tmp_path, registry, [str(caraware_program()), "train", "--resume=whole"])
    said, _ = alone.communicate(timeout=PATIENCE_S)
    assert alone.returncode == 2, said
    assert "torchrun --nproc-per-node 2 -m caraware.parallel" in " ".join(said.replace("│", "").split())
    shutil.rmtree(tmp_path / "whole-rank1" / "checkpoints")
    code, said = resume(tmp_path, registry, "whole")
    assert code != 0
    assert "no checkpoint here that all 2 ranks have" in said
    shutil.rmtree(tmp_path / "whole-rank1")
    code, said = resume(tmp_path, registry, "whole")
    assert code != 0
    assert "each rank needs its run, on its machine; rank 1 has none" in said


def has_begun(run: Path) -> bool:
    """Whether the trainer of a run receives ticks."""
    log = run / "logs" / "trainer.log"
    return log.is_file() and "observations of" in log.read_text()


def supervisor_of(run: Path) -> int:
    return int(json.loads((run / "run.json").read_text())["supervisor_pid"])


def test_ranks_that_were_killed_before_their_first_common_checkpoint_continue_from_their_beginning(
    tmp_path: Path, registry: Path, whole: WholeRun
) -> None:
    names = ("cut", "cut-rank1")
    cut = two_ranks(tmp_path, registry, "cut", *EVERY_UPDATE, "run.real_time_factor=2")
    runs = [tmp_path / name for name in names]
    wait_until(lambda: all(map(has_begun, runs)), cut)
    # As by a loss of power: a trainer whose supervisor dies alone writes a checkpoint.
    for run in runs:
        os.kill(supervisor_of(run), signal.SIGSTOP)
    for run in runs:
        kill_trainer(run, "caraware.train", cut)
        os.kill(supervisor_of(run), signal.SIGKILL)
    said, _ = cut.communicate(timeout=PATIENCE_S)
    assert cut.returncode != 0, said
    assert not [checkpoint for run in runs for checkpoint in run.glob("checkpoints/update-*")]
    # The same state as after a kill when only rank 0 had its first checkpoint.
    first = "checkpoints/update-000001"
    shutil.copytree(whole.folder / "whole" / first, runs[0] / first)
    code, said = resume(tmp_path, registry, "cut", "--name=other")
    assert code != 0 and "no checkpoint that all ranks have, with which another run could begin" in said, said
    code, said = resume(tmp_path, registry, "cut", "--set=run.real_time_factor=0")
    assert code == 0, said
    assert [report(run)["beginning"] for run in runs] == [None, None]
    assert_undisturbed(tmp_path, names, whole)
    assert "update-000001 was not written by all ranks" in (runs[0] / "logs" / "trainer.log").read_text()


KILLS_ITS_SUPERVISOR = """
import os, signal, sys, time
from pathlib import Path
from caraware.learn.ranks import TorchRanks
from caraware.train import main

run = Path(sys.argv[1]).parent
note_end = TorchRanks.note_end
def note_end_and_kill(ranks):
    note_end(ranks)
    killed = run / "killed"
    if ranks.rank == 0 and not killed.exists():
        killed.touch()
        while not (run.with_name(run.name + "-rank1") / "report.json").exists():
            time.sleep(0.01)
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(3600)
TorchRanks.note_end = note_end_and_kill
sys.exit(main(sys.argv[1:]))
"""
"""A trainer that on rank 0 kills its supervisor, once, when rank 1 has completed its run, and then does not end."""


def memory_of(run: Path) -> str:
    """How the names of a run's files in shared memory begin."""
    return str(json.loads((run / "run.json").read_text())["shared_memory"]["prefix"])


def test_a_launch_whose_supervisors_are_killed_continues_by_itself(
    tmp_path: Path, registry: Path, whole: WholeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_modules(tmp_path, monkeypatch, kills_its_supervisor=KILLS_ITS_SUPERVISOR)
    names, settings = ("two", "two-rank1"), (*EVERY_UPDATE, "run.real_time_factor=5")
    words = [*torchrun("--max-restarts=3"), "--name=two"]
    two = start(tmp_path, registry, words, 256, *settings, "trainer.module=kills_its_supervisor")
    runs, memory = [tmp_path / name for name in names], set()
    # Before the first checkpoint, in the middle, and when the other rank has completed its run.
    wait_until(lambda: all(map(has_begun, runs)), two)
    assert not [checkpoint for run in runs for checkpoint in run.glob("checkpoints/update-*")]
    memory |= set(map(memory_of, runs))
    os.kill(supervisor_of(runs[1]), signal.SIGKILL)
    wait_until(lambda: (runs[0] / "checkpoints" / "update-000002").exists(), two)
    memory |= set(map(memory_of, runs))
    os.kill(supervisor_of(runs[0]), signal.SIGKILL)
    wait_until((runs[0] / "killed").exists, two)
    memory |= set(map(memory_of, runs))
    said, _ = two.communicate(timeout=PATIENCE_S)
    assert two.returncode == 0, said
    assert_undisturbed(tmp_path, names, whole)
    memory |= set(map(memory_of, runs))
    assert len(memory) == 8
    assert not [file for prefix in memory for file in Path("/dev/shm").glob(f"{prefix}*")]
    assert not [line for _, line in command_lines() if str(tmp_path) in line]


def test_a_launch_that_began_at_a_checkpoint_continues_its_own_runs(
    tmp_path: Path, registry: Path, whole: WholeRun
) -> None:
    whole.copy_to(tmp_path)
    older, names = tmp_path / "whole" / "checkpoints" / "update-000001", ("other", "other-rank1")
    words = [*torchrun("--max-restarts=1"), f"--resume={older}", "--name=other", "--set=run.real_time_factor=5"]
    other = launch(tmp_path, registry, words)
    runs = [tmp_path / name for name in names]
    wait_until(lambda: (runs[1] / "checkpoints" / "update-000003").exists(), other)
    os.kill(supervisor_of(runs[0]), signal.SIGKILL)
    said, _ = other.communicate(timeout=PATIENCE_S)
    assert other.returncode == 0, said
    assert [tensors(run) for run in runs] == [tensors(whole.folder / name) for name in ("whole", "whole-rank1")]
    written = report(runs[0])
    assert int(Path(written["beginning"]["checkpoint"]).name.removeprefix("update-")) >= 2
    # A name that an earlier launch has used is refused again, however often `torchrun` tries.
    again = start(tmp_path, registry, [*torchrun("--max-restarts=1"), "--name=other"], 256)
    said, _ = again.communicate(timeout=PATIENCE_S)
    assert again.returncode != 0 and "is in use" in said, said
    assert report(runs[0]) == written


DIES_AT_THE_END = """
import os, signal, sys
from caraware.learn.ranks import TorchRanks
from caraware.train import main

note_end = TorchRanks.note_end
def die_after_noting(ranks):
    note_end(ranks)
    if ranks.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
TorchRanks.note_end = die_after_noting
sys.exit(main(sys.argv[1:]))
"""
"""A trainer whose rank 1 dies when all results are written, before it says that it is done."""


def trainer_of(run: Path, module: str) -> int | None:
    """Process id of the trainer of a run."""
    run_file = str(run / "run.json")
    return next((pid for pid, line in command_lines() if run_file in line and module in line), None)


def kill_trainer(run: Path, module: str, process: subprocess.Popen[str]) -> None:
    wait_until(lambda: trainer_of(run, module) is not None, process)
    pid = trainer_of(run, module)
    assert pid is not None
    os.kill(pid, signal.SIGKILL)


def assert_undisturbed(runs: Path, names: tuple[str, str], whole: WholeRun) -> None:
    """Both ranks have learnt and observed what those of the undisturbed launch have, and nothing twice."""
    for name, undisturbed in zip(names, ("whole", "whole-rank1"), strict=True):
        assert tensors(runs / name) == tensors(whole.folder / undisturbed)
        written, expected = report(runs / name), report(whole.folder / undisturbed)
        assert (written["result"], written["lost_ticks"], written["duplicated_ticks"]) == ("completed", 0, 0)
        assert written["observation_hash"] == expected["observation_hash"]
        assert written["trainer"]["updates"] == expected["trainer"]["updates"]


def test_a_killed_trainer_comes_back_and_the_ranks_end_as_if_it_had_lived(
    tmp_path: Path, registry: Path, whole: WholeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_modules(tmp_path, monkeypatch, dies_at_the_end=DIES_AT_THE_END)
    names, module = ("two", "two-rank1"), "dies_at_the_end"
    settings = (*EVERY_UPDATE, "run.real_time_factor=5", f"trainer.module={module}")
    two = two_ranks(tmp_path, registry, "two", *settings)
    runs = [tmp_path / name for name in names]
    # Before the first update, from which nothing could be continued.
    wait_until(lambda: has_begun(runs[1]), two)
    kill_trainer(runs[1], module, two)
    # Later rank 0, which had come back because of the other.
    wait_until(lambda: (runs[1] / "checkpoints" / "update-000002").exists(), two)
    kill_trainer(runs[0], module, two)
    said, _ = two.communicate(timeout=PATIENCE_S)
    assert two.returncode == 0, said
    assert_undisturbed(tmp_path, names, whole)
    logs = [(run / "logs" / "trainer.log").read_text() for run in runs]
    assert all("the trainer of another rank has been replaced" in text for text in logs)
    # Of rank 1 a third one died, when the others had nothing left to do.
    assert [report(run)["restarts"] for run in runs] == [2, 3]
    assert "all ranks had written their results before this trainer came" in logs[1]
    assert not [line for _, line in command_lines() if str(tmp_path) in line]


HANGS_AT_THE_END = """
import os, signal, sys
from pathlib import Path
from caraware.run.loop import TrainingLoop
from caraware.train import main

write_part = TrainingLoop._write_part
def hang_before(loop):
    run = Path(sys.argv[1]).parent
    if run.name.endswith("-rank1") and not (run / "hung").exists():
        (run / "hung").touch()
        os.kill(os.getpid(), signal.SIGSTOP)
    write_part(loop)
TrainingLoop._write_part = hang_before
sys.exit(main(sys.argv[1:]))
"""
"""A trainer that on rank 1 stops, once, when all is learnt and evaluated, before it writes its results."""
STALL_S = 15
"""Far longer than an update of these networks, and than any other piece of work, on a machine that is loaded."""


def trainer_row(folder: Path, registry: Path, run: str) -> dict[str, Any]:
    """What `caraware ps` says of the trainer of a live run."""
    code, said = answer(ask(folder, registry, "ps", run, "--json"))
    assert code == 0, said
    rows = [row for measured in json.loads(said) for row in measured["processes"]]
    return next((row for row in rows if row["process"] == "trainer"), {})


def test_a_hung_trainer_alone_is_replaced(
    tmp_path: Path, registry: Path, whole: WholeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_modules(tmp_path, monkeypatch, hangs_at_the_end=HANGS_AT_THE_END)
    names, module = ("two", "two-rank1"), "hangs_at_the_end"
    of_stalls = (f"run.stall_s={STALL_S}", "run.on_stall=replace", f"trainer.module={module}")
    two = two_ranks(tmp_path, registry, "two", *EVERY_UPDATE, "run.real_time_factor=2", *of_stalls)
    runs = [tmp_path / name for name in names]

    def shown(rank: int, incarnation: int, column: str, text: str) -> bool:
        row = trainer_row(tmp_path, registry, names[rank])
        return (row.get("restarts"), row.get(column)) == (incarnation, text)

    def is_waiting(incarnation: int) -> bool:
        return shown(0, incarnation, "waits_for", "other ranks")

    def stop_one_while_the_other_waits(incarnation: int) -> None:
        """Stop this trainer of rank 1 after an update, and wait until that of rank 0 waits for it."""
        wait_until(lambda: shown(1, incarnation, "state", "running"), two)
        updates = newest_update(runs[1] / "checkpoints")
        wait_until(lambda: newest_update(runs[1] / "checkpoints") > updates, two)
        pid = trainer_of(runs[1], module)
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        wait_until(lambda: is_waiting(incarnation), two)

    wait_until(lambda: all(map(has_begun, runs)), two)
    # In an operation of all ranks.
    stop_one_while_the_other_waits(incarnation=0)
    # In the meeting: the trainer of rank 0 is another one, and the hung one is still there.
    stop_one_while_the_other_waits(incarnation=1)
    kill_trainer(runs[0], module, two)
    wait_until(lambda: is_waiting(2), two)
    # Before the last operation of all, the exchange of results.
    wait_until((runs[1] / "hung").exists, two)
    wait_until(lambda: is_waiting(2), two)
    said, _ = two.communicate(timeout=PATIENCE_S)
    assert two.returncode == 0, said
    assert_undisturbed(tmp_path, names, whole)
    logs = [(run / "logs" / "trainer.log").read_text() for run in runs]
    stopped = "a signal or a debugger has stopped it; it is killed"
    assert [text.count(stopped) for text in logs] == [0, 3]
    assert "has made no progress" not in logs[0]
    assert [report(run)["restarts"] for run in runs] == [3, 3]


def ask(folder: Path, registry: Path, *words: str) -> subprocess.Popen[str]:
    """`caraware` with these arguments, started and not waited for."""
    return subprocess.Popen(
        [caraware_program(), *words],
        cwd=folder,
        env=os.environ | {"CARAWARE_RUNTIME_DIR": str(registry), "CARAWARE_PYTHON": sys.executable},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def answer(asked: subprocess.Popen[str]) -> tuple[int, str]:
    said, _ = asked.communicate(timeout=PATIENCE_S)
    return asked.returncode, " ".join(said.replace("│", "").split())


REFUSER = """
import os, sys
if "rank1" in sys.argv[1]:
    sys.exit(5)
os.write(1, b"ready\\n")
os.read(0, 16)
"""
"""A trainer whose rank 1 does not get ready."""


SUCCESSOR = """
import os, signal, sys
if os.environ.pop("CARAWARE_SUCCESSOR", ""):
    os.write(1, b"ready\\n")
    os.dup2(2, 1)
    if os.read(0, 16) != b"go\\n":
        sys.exit(0)
    if "rank1" in sys.argv[1]:
        DIES
from caraware.train import main
sys.exit(main(sys.argv[1:]))
"""
"""A trainer whose rank 1 dies when the old trainers have left."""
KILLED_ONCE = SUCCESSOR.replace("DIES", "os.kill(os.getpid(), signal.SIGKILL)")
GIVES_UP = SUCCESSOR.replace("DIES", "sys.exit(5)")


def find_modules(folder: Path, monkeypatch: pytest.MonkeyPatch, **modules: str) -> None:
    """Lets trainers import `modules`, whose sources are given by name."""
    for name, source in modules.items():
        (folder / f"{name}.py").write_text(source)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH")))))


def test_a_handover_replaces_the_trainers_of_all_ranks_after_one_update(
    tmp_path: Path, registry: Path, whole: WholeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_modules(tmp_path, monkeypatch, refuser=REFUSER)
    names = ("handed", "handed-rank1")
    handed = two_ranks(tmp_path, registry, "handed", "trainer.checkpoint_interval=1", "run.real_time_factor=2")
    wait_until(lambda: (tmp_path / "handed-rank1" / "checkpoints" / "update-000001").exists(), handed)
    # A paused run makes no update, after which its trainer could leave.
    for name in names:
        code, said = answer(ask(tmp_path, registry, "control", "pause", "--run", name))
        assert code == 0, said
    # The successor of rank 0 is ready, that of rank 1 ends: both old trainers continue.
    code, said = answer(ask(tmp_path, registry, "handover", "handed", "--set=trainer.module=refuser"))
    assert code == 1 and "the old trainer continues" in said, said
    handover = ask(tmp_path, registry, "handover", "handed-rank1")
    logs = [tmp_path / name / "logs" / "trainer.log" for name in names]
    wait_until(lambda: all("the successor is ready" in log.read_text() for log in logs), handed)
    for name in names:
        code, said = answer(ask(tmp_path, registry, "control", "resume", "--run", name))
        assert code == 0, said
    code, said = answer(handover)
    assert code == 0 and all(f"{name}: trainer 1 continues" in said for name in names), said
    said, _ = handed.communicate(timeout=PATIENCE_S)
    assert handed.returncode == 0, said
    assert_undisturbed(tmp_path, names, whole)
    for name in names:
        written = report(tmp_path / name)
        assert (len(written["handovers"]), written["restarts"]) == (1, 0)


def test_a_handover_now_replaces_the_trainers_of_all_ranks_wherever_they_are(
    tmp_path: Path, registry: Path, whole: WholeRun
) -> None:
    names = ("now", "now-rank1")
    # With a checkpoint after every second update, ticks that were learnt from are sent again.
    now = two_ranks(tmp_path, registry, "now", "trainer.checkpoint_interval=2", SLOW)
    runs = [tmp_path / name for name in names]
    wait_until(lambda: all(map(has_begun, runs)), now)
    replaced = []

    def replace_trainers(*more: str) -> None:
        code, said = answer(ask(tmp_path, registry, "handover", "now", "--now", *more))
        assert code == 0 and all(f"{name}: trainer" in said for name in names), said
        replaced.append(said)

    replace_trainers()
    wait_until(lambda: (runs[1] / "checkpoints" / "update-000002").exists(), now)
    for name in names:
        code, said = answer(ask(tmp_path, registry, "control", "pause", "--run", name))
        assert code == 0, said
    # Paused ranks do not have to be resumed for it.
    replace_trainers("--timeout-s=120")
    for name in names:
        code, said = answer(ask(tmp_path, registry, "control", "resume", "--run", name))
        assert code == 0, said
    replace_trainers()
    said, _ = now.communicate(timeout=PATIENCE_S)
    assert now.returncode == 0, said
    assert_undisturbed(tmp_path, names, whole)
    for run in runs:
        written = report(run)
        assert (len(written["handovers"]), written["restarts"]) == (len(replaced), 0)


def test_a_successor_that_dies_after_the_old_trainers_have_left_does_not_end_the_launch(
    tmp_path: Path, registry: Path, whole: WholeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_modules(tmp_path, monkeypatch, killed_once=KILLED_ONCE, gives_up=GIVES_UP)
    names = ("handed", "handed-rank1")
    handed = two_ranks(tmp_path, registry, "handed", *EVERY_UPDATE, SLOW)
    wait_until(lambda: (tmp_path / "handed-rank1" / "checkpoints" / "update-000001").exists(), handed)
    # One that is killed comes back.
    code, said = answer(ask(tmp_path, registry, "handover", "handed", "--set=trainer.module=killed_once"))
    assert code == 0 and all(f"{name}: trainer" in said for name in names), said
    newest = latest_checkpoint(tmp_path / "handed" / "checkpoints").name
    wait_until(lambda: latest_checkpoint(tmp_path / "handed-rank1" / "checkpoints").name > newest, handed)
    # One that exits by itself is no learner for this launch: both ranks go back to the learner before it.
    code, said = answer(ask(tmp_path, registry, "handover", "handed", "--set=trainer.module=gives_up"))
    assert code == 1 and "the learner before it returns" in said, said
    said, _ = handed.communicate(timeout=PATIENCE_S)
    assert handed.returncode == 0, said
    assert_undisturbed(tmp_path, names, whole)
    for name in names:
        run = json.loads((tmp_path / name / "run.json").read_text())
        assert run["config"]["trainer"]["module"] == "killed_once"


def command_lines() -> list[tuple[int, str]]:
    """Process ids and command lines of all processes."""
    lines = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            lines.append((int(folder.name), (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()))
        except OSError:
            continue
    return lines
