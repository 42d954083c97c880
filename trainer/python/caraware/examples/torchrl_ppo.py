"""PPO from the parts of TorchRL, over the Gymnasium face: `python -m caraware.examples.torchrl_ppo [STEPS]`.

TorchRL's wrapper puts `infos["mask"]` beside the observations, so that rows without a vehicle are left out of every
batch, and takes what a trajectory ended with from `final_obs`.
"""

import math
import sys
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import GymWrapper
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from caraware.envs import CarAwareVectorEnv, make


@dataclass(frozen=True)
class Settings:
    """Hyper-parameters."""

    ticks: int = 128
    """Ticks between updates; each is a sample of every slot that holds a vehicle."""
    batch_size: int = 512
    epochs: int = 4
    learning_rate: float = 1e-3
    discount: float = 0.0
    """Predictions do not change the world; 0.99 for driving."""
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.001


def make_networks(fields: int, actions: int) -> tuple[ProbabilisticActor, ValueOperator]:
    """A Gaussian policy over `actions` numbers and a value, both of observations of `fields` numbers."""
    parameters = nn.Sequential(
        MLP(in_features=fields, out_features=actions, num_cells=[256, 128], activation_class=nn.Tanh),
        AddStateIndependentNormalScale(actions),
    )
    policy = ProbabilisticActor(
        TensorDictModule(parameters, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    value = MLP(in_features=fields, out_features=1, num_cells=[128], activation_class=nn.Tanh)
    return policy, ValueOperator(value, in_keys=["observation"])


def update(loss: ClipPPOLoss, optimizer: torch.optim.Optimizer, collected: TensorDictBase, settings: Settings) -> None:
    """A few epochs over the rows `[samples]` that hold vehicles."""
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(len(collected)), sampler=SamplerWithoutReplacement(), batch_size=settings.batch_size
    )
    buffer.extend(collected)
    for _ in range(settings.epochs):
        for batch in buffer:
            losses = loss(batch)
            optimizer.zero_grad()
            sum(losses[key] for key in ("loss_objective", "loss_critic", "loss_entropy")).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()


def main(steps: int, settings: Settings | None = None, config: str = "town", **changes: object) -> list[float]:
    """Learns for about `steps` env-steps; the mean reward before each update."""
    settings, rewards, done = settings or Settings(), [], 0
    torch.manual_seed(1)
    torch.set_num_threads(1)  # of two cores the simulation needs one; torch's idle threads would spin on it
    with make(config, changes) as simulation:
        face = CarAwareVectorEnv(simulation)
        run, slots = face.slots.settings, face.num_envs
        policy, value = make_networks(run.fields.width, run.task.actions.size)
        loss = ClipPPOLoss(
            policy, value, clip_epsilon=settings.clip, entropy_coeff=settings.entropy, normalize_advantage=True
        )
        advantage = GAE(gamma=settings.discount, lmbda=settings.gae_lambda, value_network=value)
        optimizer = torch.optim.Adam(loss.parameters(), settings.learning_rate)
        frames = settings.ticks * slots
        collector = Collector(
            GymWrapper(face),
            policy,
            frames_per_batch=frames,
            total_frames=frames * math.ceil(steps / frames),
            auto_register_policy_transforms=True,
        )
        for batch in collector:
            with torch.no_grad():
                advantage(batch)
            held = batch[batch["mask"]]
            update(loss, optimizer, held, settings)
            done += len(held)
            rewards.append(float(held["next", "reward"].mean()))
            print(f"{done} env-steps, reward {rewards[-1]:.4f}")
        collector.shutdown()
    return rewards


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
