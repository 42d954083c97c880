"""Stable-Baselines3's PPO replaces the trainer of a running simulation and continues with its networks.

`caraware handover RUN --set trainer.module=caraware.examples.sb3_takeover`: it gets ready beside the old trainer, takes
its networks out of its last checkpoint, and continues with the first tick that is not committed. docs/learners.md
"""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

from safetensors.torch import load_file
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from caraware.envs import CarAwareVecEnv, RunEndedError
from caraware.envs.settings import FaceSettings
from caraware.examples.sb3_ppo import ppo
from caraware.ipc.channel import Channel
from caraware.ipc.commits import CommitLog
from caraware.ipc.run_file import RunFile
from caraware.ipc.storage import when_there_is_space
from caraware.run.continuation import own_checkpoints
from caraware.run.manifest import read_manifest
from caraware.run.process import HandoverRole, SuccessorClaims

FOLDER = "sb3_takeover"
"""In the run directory: a model for each of the newest commits, named by the tick up to which it has learnt."""


class SaveAndCommit(BaseCallback):
    """After every update: the model on disk, then the commit of its ticks. What comes after comes again."""

    def __init__(self, env: CarAwareVecEnv, folder: Path) -> None:
        super().__init__()
        self._env, self._folder = env, folder

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # A rollout begins behind the update that has learnt from the one before; the first has none before it.
        if self.num_timesteps > 0:
            kept = save(self.model, self._folder, self._env.slots.answered)
            self._env.slots.commit()
            for old in set(self._folder.glob("*.zip")) - {kept}:
                old.unlink()


def save(model: BaseAlgorithm, folder: Path, tick: int) -> Path:
    """Put the model on disk under the name of its newest tick, complete or not at all. A full disk is waited for."""
    file, partial = model_file(folder, tick), folder / ".partial"

    def write() -> Path:
        folder.mkdir(exist_ok=True)
        with partial.open("wb") as stream:
            model.save(stream)
            stream.flush()
            os.fsync(stream.fileno())
        return partial.rename(file)

    return when_there_is_space(file, write)


def model_file(folder: Path, tick: int) -> Path:
    """The model that has learnt up to `tick`."""
    return folder / f"{tick}.zip"


def fitting_checkpoint(run: RunFile) -> Path | None:
    """The newest checkpoint of our PPO, whose networks this learner begins with. Exits where they are no MLP."""
    folder = Path(run["run_dir"], "checkpoints")
    checkpoint = next(own_checkpoints(folder, CommitLog(run), "ppo"), None)
    if checkpoint is not None and (network := read_manifest(checkpoint).network) != "mlp":
        raise SystemExit(f"{checkpoint}: its network is {network}; this example continues from an MLP")
    return checkpoint


def claims(run: RunFile) -> SuccessorClaims:
    """One environment of any task, without the lessons of a curriculum."""
    settings = FaceSettings.from_run(run)
    return SuccessorClaims(
        observation_size=settings.fields.width,
        action_size=settings.task.actions.size,
        task=settings.task.name,
        environments=1,
        decides_lessons=False,
    )


def take_networks(model: PPO, checkpoint: Path) -> None:
    """Give the model the networks of a checkpoint of `caraware.train`: their layers, activations and parameters."""
    stored, policy = load_file(checkpoint / "parameters.safetensors"), model.policy
    manifest = read_manifest(checkpoint)
    activation = {"relu": nn.ReLU, "tanh": nn.Tanh}[manifest.activation]
    for name, last, head in (("policy", nn.Tanh, nn.Tanh), ("value", activation, nn.Identity)):
        layers = sum(key.startswith(f"{name}.layer") and key.endswith("weight") for key in stored)
        linear = []
        for i in range(layers):
            weight, bias = stored[f"{name}.layer{i}.weight"], stored[f"{name}.layer{i}.bias"]
            layer = nn.Linear(weight.shape[1], weight.shape[0])
            layer.weight.data.copy_(weight)
            layer.bias.data.copy_(bias)
            linear.append(layer)
        hidden = [module for layer in linear[:-1] for module in (layer, activation())]
        hidden[-1] = last()
        out = nn.Sequential(linear[-1], head())
        if name == "policy":
            policy.mlp_extractor.policy_net = nn.Sequential(*hidden)
            policy.action_net = out
        else:
            policy.mlp_extractor.value_net = nn.Sequential(*hidden)
            policy.value_net = out  # type: ignore[assignment]  # as above
    policy.log_std.data.copy_(stored["policy.log_std"])
    settings: dict[str, Any] = {"lr": model.lr_schedule(1.0), **policy.optimizer_kwargs}
    policy.optimizer = policy.optimizer_class(policy.parameters(), **settings)


def main(run_file: str) -> int:
    """Take over the run, and learn until it ends or is stopped."""
    role = HandoverRole.from_environment()
    run: RunFile = json.loads(Path(run_file).read_text())
    if role.gets_ready:
        fitting_checkpoint(run)  # where it does not fit, the old trainer continues
        if not role.wait_for_turn(claims(run)):
            return 0
    # The old trainer has left its last checkpoint. A restart chooses the same one, so that the saved model fits it.
    checkpoint = fitting_checkpoint(run)
    # Ticks since the last commit are not learnt: a successor gets them again.
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    channel = Channel(run_file)
    trainer, folder = run["config"]["trainer"], Path(run["run_dir"], FOLDER)
    env = CarAwareVecEnv(channel, evaluation_policy=lambda obs: model.predict(obs, deterministic=True)[0])
    model = ppo(env, trainer["horizon"], trainer["batch_size"])
    if checkpoint is not None:
        take_networks(model, checkpoint)
    if (own := channel.own_tick()) is not None:
        model.set_parameters(str(model_file(folder, own)))
    networks = f"the networks of {checkpoint.name}" if checkpoint else "new networks"
    print(f"Stable-Baselines3 takes over at tick {channel.first_tick} with {networks}", file=sys.stderr, flush=True)
    try:
        model.learn(sys.maxsize, callback=SaveAndCommit(env, folder))
    except RunEndedError:
        print("run complete", file=sys.stderr)
    env.close()
    return 0


if __name__ == "__main__":
    status = main(sys.argv[1])
    sys.stderr.flush()
    os._exit(status)  # torch takes seconds to tidy up
