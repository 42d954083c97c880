"""The wheels: they are made from what is compiled, and run in an environment of their own without the checkout."""

import os
import socket
import subprocess
import sys
import sysconfig
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
PACKAGES = Path(sysconfig.get_path("purelib"))
PATIENCE_S = 300.0


class Installed:
    """An environment with the two wheels, which sees the packages of others in the project's environment."""

    def __init__(self, directory: Path) -> None:
        """Make the wheels and install them."""
        self.wheels = directory / "wheels"
        # To compress the programs takes 20 s of a core, and they are unpacked at once.
        stored = {"PIP_CONFIG_SETTINGS": "--build-option=--compression=stored"}
        make_wheels: list[str | Path] = [ROOT / "scripts" / "wheels.sh", sys.executable, self.wheels]
        subprocess.run(make_wheels, check=True, cwd=directory, env=os.environ | stored)
        self.environment = directory / "environment"
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", self.environment], check=True)
        self.packages = next(self.environment.glob("lib/python3*/site-packages"))
        # SUMO is beside the programs, as pip would have it. The project's own files `.pth` have no effect here.
        for package in PACKAGES.iterdir():
            if package.name.startswith(("sumo", "eclipse_sumo")):
                (self.packages / package.name).symlink_to(package)
        (self.packages / "others.pth").write_text(f"{PACKAGES}\n")
        self.work = directory / "work"
        self.work.mkdir()
        pip: list[str | Path] = [sys.executable, "-m", "pip", "--python", self.environment]
        options = ("--quiet", "--no-index", "--no-deps")
        subprocess.run([*pip, "install", *options, *self.wheels.glob("*.whl")], check=True, cwd=self.work)

    def start(self, program: str, *arguments: str) -> subprocess.Popen[str]:
        """Start a program of the environment in an empty directory."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("CARAWARE", "PYTHON"))}
        # A socket's path is short; the directory of the test is not.
        registry = {"CARAWARE_RUNTIME_DIR": f"/tmp/caraware-w{os.getpid()}"}
        return subprocess.Popen(
            [self.environment / program, *arguments],
            cwd=self.work,
            env=kept | registry,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, program: str, *arguments: str) -> str:
        """Run a program; what it printed."""
        return end_of(self.start(program, *arguments))


def end_of(process: subprocess.Popen[str]) -> str:
    """Wait until a program has succeeded; what it printed."""
    try:
        printed, _ = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 0, printed
    return printed


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installed]:
    yield Installed(tmp_path_factory.mktemp("wheels"))


def test_the_wheel_has_the_programs_and_no_path_of_this_machine(installed: Installed) -> None:
    (wheel,) = installed.wheels.glob("caraware-*.whl")
    assert "-cp311-abi3-linux_x86_64" in wheel.name
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        bridge = archive.read("caraware/programs/traffic-bridge")
    assert {"caraware/_native.abi3.so", "caraware/_native.pyi", "caraware/py.typed"} <= names
    assert not [name for name in names if name.startswith("caraware/programs/") and name.endswith("bench")]
    assert b"\0$ORIGIN/../../sumo/lib64\0" in bridge
    assert b"/sumo/lib64:" not in bridge


def test_every_part_is_found(installed: Installed) -> None:
    checks = installed.run("bin/caraware", "doctor")
    assert f"ok       traffic-bridge: {installed.packages}/caraware/programs/traffic-bridge" in checks
    assert f"ok       Python packages: {installed.environment}/bin/python" in checks


def test_a_run_learns_and_a_viewer_saves_it(installed: Installed) -> None:
    episodes = ("episode.ticks=60", "episode.training_episodes=2", "episode.evaluation_ticks=40")
    short = (*episodes, "trainer.horizon=512", "trainer.batch_size=256")
    with socket.create_server(("127.0.0.1", 0)) as server:
        listen = f"fanout.listen=tcp/127.0.0.1:{server.getsockname()[1]}"
    settings = [word for setting in (*short, listen) for word in ("--set", setting)]
    training = installed.start("bin/caraware", "train", "town", "--name", "wheel", *settings)
    run_file = installed.work / "runs" / "wheel" / "run.json"
    deadline = time.monotonic() + PATIENCE_S
    while not run_file.exists() and time.monotonic() < deadline:
        assert training.poll() is None, end_of(training)
        time.sleep(0.05)
    installed.run("bin/caraware", "view", "wheel", "--save", "wheel.rrd")
    printed = end_of(training)
    assert "first training step" in printed
    assert "wheel completed" in printed
    assert (installed.work / "runs" / "wheel" / "report.json").is_file()
    assert (installed.work / "wheel.rrd").stat().st_size > 0


def test_an_environment_face_finds_the_program(installed: Installed) -> None:
    script = """
from caraware.envs import CarAwareVectorEnv, make

with make("town", {"traffic.cavs": 4}, seed=1) as simulation:
    env = CarAwareVectorEnv(simulation)
    env.reset()
    for _ in range(10):
        observation, *_ = env.step(env.action_space.sample())
    print(observation.shape[0], env.__class__.__module__, __import__("caraware").__file__)
"""
    printed = installed.run("bin/python", "-c", script)
    assert printed.startswith("4 ")
    assert str(installed.packages) in printed
