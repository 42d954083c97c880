"""Learning curves of the driving task from one configuration: our PPO, Stable-Baselines3's, and one in CleanRL's style.

`driving_curves.py learn LEARNER FILE` learns, and writes a line of JSON for each update: agent-steps so far, seconds
since the start, mean reward of an agent-step. `driving_curves.py draw IMAGE FILE …` draws them, for docs/driving.md.
"""

import argparse
import contextlib
import io
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

SETTINGS = {"trainer.network": "mlp", "fanout.enabled": "false"}
"""Beside the preset `driving`: the two others have no encoder of groups."""
PRESET = tomllib.loads((Path(__file__).parents[1] / "configs" / "driving.toml").read_text())
OURS = PRESET["trainer"]
"""What our PPO learns with. The others take it over."""
HEROES = PRESET["traffic"]["heroes"]
TICKS = OURS["horizon"] // HEROES
MEAN_OF = 15
"""Updates of which a point of the image is the mean."""
NAMES = {"ours": "CarAware", "sb3": "Stable-Baselines3", "cleanrl": "CleanRL's style"}


class Curve:
    """Writes the points of a curve."""

    def __init__(self, file: Path) -> None:
        self._file, self._begun = file.open("w"), time.monotonic()

    def add(self, steps: int, reward: float) -> None:
        """A point after an update."""
        point = {"steps": steps, "seconds": round(time.monotonic() - self._begun, 1), "reward": reward}
        print(json.dumps(point), file=self._file, flush=True)


def ours(curve: Curve, seed: int) -> None:
    """`caraware train driving`, whose curve is read while it runs."""
    from caraware.run.program import caraware_program

    endless = {"episode.training_episodes": 100_000, "episode.evaluation_interval": 0, "trainer.plots": "false"}
    settings = SETTINGS | endless | {"run.seed": seed}
    with tempfile.TemporaryDirectory() as runs:
        command = [str(caraware_program()), "train", "driving", "--runs", runs, "--name", "ours", "--quiet"]
        command += [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        run = subprocess.Popen(command)
        try:
            lines = new_lines(Path(runs, "ours", "learning.jsonl"), lambda: run.poll() is None)
            for line in lines:
                point = json.loads(line)
                if "training" in point:
                    curve.add(point["env_steps"], point["training"]["reward"])
        finally:
            run.send_signal(signal.SIGINT)
            run.wait()


def new_lines(file: Path, goes_on: Callable[[], bool]) -> Iterator[str]:
    """The lines of a file, also those that are still to come."""
    read = 0
    while goes_on():
        lines = file.read_text().splitlines(keepends=True) if file.exists() else []
        for line in lines[read:]:
            if line.endswith("\n"):
                read += 1
                yield line
        time.sleep(0.2)


def sb3(curve: Curve, seed: int) -> None:
    """Stable-Baselines3's PPO over all heroes."""
    import math

    import torch
    from caraware.envs import CarAwareVecEnv, make
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    class Rewards(BaseCallback):
        steps, earned, before = 0, 0.0, 0
        acted = (True,) * HEROES

        def _on_step(self) -> bool:
            # A reward belongs to the vehicle that was in the slot when it acted.
            rewards = [float(reward) for reward, acted in zip(self.locals["rewards"], self.acted, strict=True) if acted]
            self.steps, self.earned = self.steps + len(rewards), self.earned + sum(rewards)
            self.acted = tuple(info["mask"] for info in self.locals["infos"])
            return True

        def _on_rollout_end(self) -> None:
            curve.add(self.steps, self.earned / max(self.steps - self.before, 1))
            self.before, self.earned = self.steps, 0.0

    torch.set_num_threads(1)
    with make("driving", SETTINGS, seed=seed) as simulation:
        model = PPO(
            "MlpPolicy",
            CarAwareVecEnv(simulation),
            learning_rate=OURS["learning_rate"],
            n_steps=TICKS,
            batch_size=OURS["batch_size"],
            n_epochs=OURS["epochs"],
            gamma=OURS["discount"],
            gae_lambda=OURS["gae_lambda"],
            policy_kwargs={"net_arch": OURS["hidden"], "log_std_init": math.log(OURS["initial_std"])},
            seed=seed,
            device="cpu",
        )
        model.learn(sys.maxsize, callback=Rewards())


def cleanrl(curve: Curve, seed: int) -> None:
    """`caraware.examples.cleanrl_style`, whose curve is what it prints."""
    from caraware.examples.cleanrl_style import Settings, main

    class Printed(io.StringIO):
        def write(self, text: str) -> int:
            found = re.search(r"(\d+) env-steps.* reward (\S+)", text)
            if found:
                curve.add(int(found[1]), float(found[2]))
            return len(text)

    settings = Settings(
        ticks=TICKS,
        batch_size=OURS["batch_size"],
        epochs=OURS["epochs"],
        learning_rate=OURS["learning_rate"],
        discount=OURS["discount"],
        gae_lambda=OURS["gae_lambda"],
        entropy=OURS["entropy_scale"],
        initial_std=OURS["initial_std"],
        seed=seed,
    )
    with contextlib.redirect_stdout(Printed()):
        main(sys.maxsize, settings, "driving", **SETTINGS)


LEARNERS: dict[str, Callable[[Curve, int], None]] = {"ours": ours, "sb3": sb3, "cleanrl": cleanrl}


class TimeIsOver(Exception):
    """Ends a learner in order."""


def learn(learner: str, file: Path, seed: int, seconds: int) -> None:
    """Learns for `seconds`."""

    def end(*_: object) -> None:
        raise TimeIsOver

    signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    with contextlib.suppress(TimeIsOver):
        LEARNERS[learner](Curve(file), seed)


def read(file: Path) -> tuple[str, list[dict[str, Any]]]:
    """Learner and points of a file, which is called LEARNER-SEED.jsonl."""
    return file.stem.split("-")[0], [json.loads(line) for line in file.read_text().splitlines()]


def draw(image: Path, files: list[Path]) -> None:
    """Each run a line, the mean of its last updates, over agent-steps and over seconds."""
    import numpy as np
    from matplotlib import pyplot

    figure, (by_steps, by_seconds) = pyplot.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    colours = {name: f"C{index}" for index, name in enumerate(NAMES)}
    named: set[str] = set()
    for file in sorted(files):
        learner, points = read(file)
        rewards = np.convolve([point["reward"] for point in points], np.full(MEAN_OF, 1 / MEAN_OF), "valid")
        points = points[MEAN_OF - 1 :]
        style = {"color": colours[learner], "label": None if learner in named else NAMES[learner], "linewidth": 1}
        named.add(learner)
        by_steps.plot([point["steps"] / 1e6 for point in points], rewards, **style)
        by_seconds.plot([point["seconds"] / 60 for point in points], rewards, **style)
    by_steps.set(xlabel="agent-steps (millions)", ylabel=f"reward of an agent-step, {MEAN_OF} updates")
    by_seconds.set(xlabel="minutes")
    for axes in (by_steps, by_seconds):
        axes.set_yscale("symlog", linthresh=0.01)
        axes.grid(alpha=0.3)
    by_steps.legend()
    figure.savefig(image, dpi=110)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("learn")
    one.add_argument("learner", choices=list(LEARNERS))
    one.add_argument("file", type=Path)
    one.add_argument("--seed", type=int, default=1)
    one.add_argument("--seconds", type=int, default=600)
    some = commands.add_parser("draw")
    some.add_argument("image", type=Path)
    some.add_argument("files", type=Path, nargs="+")
    arguments = parser.parse_args()
    if arguments.command == "learn":
        learn(arguments.learner, arguments.file, arguments.seed, arguments.seconds)
    else:
        draw(arguments.image, arguments.files)


if __name__ == "__main__":
    main()
