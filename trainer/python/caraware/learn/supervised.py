"""A baseline beside PPO: the policy's network, trained by regression on the truth.

PPO learns from rewards alone. A network of the same size, from the same samples by as many gradient steps of the same
size, that is shown where the vehicle was has an easier task: PPO's distance to it is the price of learning by trial.
It is no bound: what an estimator without memory can reach at all takes more passes (docs/baselines.md). It takes no
part in PPO: random numbers, parameters and moments are its own.
"""

import torch
from torch import Tensor

from caraware.learn.adam import Adam
from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.fast import minibatches
from caraware.learn.fast_mlp import FastMlp
from caraware.learn.networks import Activation, GaussianPolicy, policy_mlp
from caraware.learn.ranks import Minibatch, Ranks
from caraware.tasks.localisation import Localisation
from caraware.tasks.rewards import distance_m

SEED_OFFSET = 0x5E_ED00
"""Between the seed of a run and those of this baseline."""
SMALLEST_DISTANCE_M = 1e-6
"""Below this a distance has no direction."""


class Supervised:
    """The policy's network, taught to be close to the truth: from every horizon in as many epochs as PPO makes."""

    def __init__(
        self,
        config: TrainerConfig,
        observation_size: int,
        task: Localisation,
        device: torch.device,
        ranks: Ranks | None = None,
    ) -> None:
        self._config, self._task, self._device, self._ranks = config, task, device, ranks or Ranks()
        self._seed = config.seed + SEED_OFFSET
        network = policy_mlp(observation_size, task.actions.size, config.hidden, Activation(config.activation))
        network.initialise(torch.Generator().manual_seed(self._seed))
        policy = GaussianPolicy(network, task.actions.size, initial_std=1.0).to(device)
        self.mlp = FastMlp(network, {"log_std": policy.log_std})
        self.optimiser = Adam(self.mlp.parameters)
        self._metres_per_action = torch.tensor(task.metres_per_action(), device=device)

    def tensors(self) -> dict[str, Tensor]:
        """Parameters and moments by name, for a checkpoint."""
        return dict(self.mlp.parameters.value) | self.optimiser.state()

    def restore(self, stored: dict[str, Tensor]) -> None:
        """Continue with what `tensors` returned."""
        for name, tensor in self.tensors().items():
            tensor.copy_(stored[name])

    @torch.no_grad()
    def predict_m(self, observation: Tensor) -> Tensor:
        """Positions `[n, 2]` in world metres for `[n, d]` observations."""
        action = self.mlp.infer(self._task.network_input(observation.to(self._device)))
        return self._task.answer(action.cpu(), observation)

    @torch.no_grad()
    def learn(self, batch: Batch, learning_rate: float) -> float:
        """PPO's epochs over the samples of all ranks, in minibatches of PPO's size; the mean error, in metres.

        The order follows from the seed and the steps taken, so a checkpoint needs no state of a generator.
        """
        union = self._ranks.union(batch.advantage, batch.reward, batch.value_target)
        generator = torch.Generator().manual_seed(self._seed + 1 + int(self.optimiser.steps))
        parts = minibatches(union, self._config, self._ranks)
        error_m = torch.zeros((), device=self._device)
        for _ in range(self._config.epochs):
            order = torch.randperm(len(union), generator=generator).to(self._device)
            for part in union.minibatches((batch.observation, batch.truth), order, parts):
                error_m += self._gradient(part) / (parts * self._config.epochs)
                self._ranks.add_up("policy", self.mlp.parameters.gradient)
                self.optimiser.step(learning_rate)
        return error_m.item()

    def _gradient(self, part: Minibatch) -> Tensor:
        """This rank's part of the gradient, and of the mean distance."""
        if part.share == 0.0:
            self.mlp.parameters.gradient.zero_()
            return torch.zeros((), device=self._device)
        observation, truth = part.own
        return self.gradient(observation, truth, part.share)

    @torch.no_grad()
    def gradient(self, observation: Tensor, truth: Tensor, share: float = 1.0) -> Tensor:
        """Set the gradient of the mean Euclidean distance, the figure that evaluations report; that distance.

        Rows `[n, d]` are as the network takes them, truth `[n, 4]`; both results are times `share`.
        """
        predicted_m = self._task.answer(self.mlp.forward(observation), observation)
        distances_m = distance_m(predicted_m, truth)
        towards = (predicted_m - truth[:, :2]) / distances_m.clamp_min(SMALLEST_DISTANCE_M).unsqueeze(1)
        self.mlp.backward(observation, towards * self._metres_per_action * (share / len(truth)))
        return distances_m.mean() * share
