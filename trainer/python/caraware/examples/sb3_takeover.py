"""Stable-Baselines3's PPO replaces the trainer of a running simulation and continues with its networks.

`caraware handover RUN --set trainer.module=caraware.examples.sb3_takeover`: it gets ready beside the old trainer, takes
its networks out of its last checkpoint, and continues with the tick after it. docs/environments.md
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
from caraware.examples.sb3_ppo import ppo
from caraware.ipc.channel import Channel
from caraware.run.manifest import newest_sound_checkpoint, read_manifest
from caraware.run.process import HandoverRole

MODEL, PLACE = "sb3_takeover.zip", "sb3_takeover.json"
"""In the run directory: the model, and the first tick that it has not learned from."""


class SaveAndCommit(BaseCallback):
    """After every update: the model on disk, then the report that earlier ticks need not be delivered again."""

    def __init__(self, env: CarAwareVecEnv, run_dir: Path) -> None:
        super().__init__()
        self._env, self._run_dir = env, run_dir

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps > 0:
            save(self.model, self._env, self._run_dir)
            self._env.slots.commit()


def save(model: BaseAlgorithm, env: CarAwareVecEnv, run_dir: Path) -> None:
    """Both files under temporary names, then renamed; the model first: the place never says too much."""
    model.save(run_dir / f".partial.{MODEL}")
    (run_dir / f".partial.{MODEL}").rename(run_dir / MODEL)
    (run_dir / f".partial.{PLACE}").write_text(json.dumps({"tick": env.slots.answered + 1}))
    (run_dir / f".partial.{PLACE}").rename(run_dir / PLACE)


def first_tick(run_dir: Path) -> int:
    """The first tick that neither an earlier process of this module nor the trainer before it has learned from."""
    if (run_dir / PLACE).exists():
        return int(json.loads((run_dir / PLACE).read_text())["tick"])
    checkpoint = newest_sound_checkpoint(run_dir / "checkpoints")
    return read_manifest(checkpoint).counters.committed_tick + 1 if checkpoint else 0


def take_networks(model: PPO, checkpoint: Path) -> None:
    """Give the model the networks of a checkpoint of `caraware.train`: their layers, activations and parameters."""
    stored, policy = load_file(checkpoint / "parameters.safetensors"), model.policy
    manifest = read_manifest(checkpoint)
    if manifest.network != "mlp":
        raise SystemExit(f"{checkpoint}: its network is {manifest.network}; this example continues from an MLP")
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
    if role.gets_ready and not role.wait_for_turn():
        return 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    run_dir = Path(json.loads(Path(run_file).read_text())["run_dir"])
    begin = first_tick(run_dir)
    channel = Channel(run_file, begin)
    trainer = channel.run["config"]["trainer"]
    env = CarAwareVecEnv(channel, evaluation_policy=lambda obs: model.predict(obs, deterministic=True)[0])
    model = ppo(env, trainer["horizon"], trainer["batch_size"])
    checkpoint = newest_sound_checkpoint(run_dir / "checkpoints")
    if checkpoint is not None:
        take_networks(model, checkpoint)
    if (run_dir / MODEL).exists():
        model.set_parameters(str(run_dir / MODEL))
    print(f"Stable-Baselines3 takes over at tick {begin}", file=sys.stderr, flush=True)
    try:
        model.learn(sys.maxsize, callback=SaveAndCommit(env, run_dir))
    except RunEndedError:
        print("run complete", file=sys.stderr)
    finally:
        save(model, env, run_dir)
        env.close()
    return 0


if __name__ == "__main__":
    status = main(sys.argv[1])
    sys.stderr.flush()
    os._exit(status)  # torch takes seconds to tidy up
