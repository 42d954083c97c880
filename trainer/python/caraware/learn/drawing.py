"""Actions drawn tick by tick, for a task whose world waits for them (decision 34).

What is drawn for a tick depends on the policy, the observation, and random numbers keyed by seed, environment and tick
alone. So a trainer that receives a tick again, after a kill or a handover, draws the same action again.
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from caraware.ipc.stream import Observation
from caraware.learn.networks import log_probability
from caraware.learn.prediction import Ticks, visible
from caraware.learn.rollout import DrawnTick

if TYPE_CHECKING:
    from caraware.learn.ppo import Ppo

MASK = (1 << 64) - 1


class DrawingPredictor:
    """Draws an action for each tick by itself; in evaluations it takes the policy's mean.

    A matrix product rounds as its shape demands, so ticks never go through the network together.
    """

    def __init__(self, ppo: "Ppo", dark_is_nan: bool) -> None:
        self._ppo, self._dark_is_nan = ppo, dark_is_nan
        self._generator = torch.Generator()
        self._version, self._log_std_here = (-1, -1), torch.zeros(0)
        self._newest: dict[int, dict[int, DrawnTick]] = {}

    def predict_m(self, ticks: Ticks) -> dict[int, list[Tensor]]:
        """What is published for each tick: demands f32 `[n, a]`. See `Predictor.predict_m`."""
        self._newest = {index: {} for index in ticks}
        return {index: [self._answer(index, obs) for obs in of_one] for index, of_one in ticks.items()}

    def drawn(self, environment: int, tick: int) -> DrawnTick | None:
        """What the newest call of `predict_m` drew for a tick; None in an evaluation."""
        return self._newest.get(environment, {}).get(tick)

    @torch.no_grad()
    def _answer(self, environment: int, obs: Observation) -> Tensor:
        ppo = self._ppo
        valid = torch.from_numpy(obs.valid).unsqueeze(1)
        held = ppo.held.get(environment)
        if not obs.evaluation and held is not None and held.tick == obs.tick:
            drawn = DrawnTick(held.tick, held.action[: len(valid)], held.log_probability[: len(valid)])
        else:
            mean = ppo.updater.mean(visible(obs, self._dark_is_nan)).cpu()
            if obs.evaluation:
                return torch.where(valid, ppo.task.answer(mean), 0.0)
            drawn = self._draw(environment, obs.tick, mean, valid)
        self._newest[environment][obs.tick] = drawn
        return torch.where(valid, ppo.task.answer(drawn.action), 0.0)

    def _draw(self, environment: int, tick: int, mean: Tensor, valid: Tensor) -> DrawnTick:
        log_std = self._log_std()
        self._generator.manual_seed(_key(self._ppo.config.seed, self._ppo.numbered(environment), tick))
        noise = torch.randn(mean.shape, generator=self._generator)
        action = torch.where(valid, mean + log_std.exp() * noise, 0.0)
        return DrawnTick(tick, action, log_probability(action, mean, log_std))

    def _log_std(self) -> Tensor:
        """Logarithm of the standard deviation, on the CPU; read from a GPU once an update."""
        there = self._ppo.updater.log_std
        version = self._ppo.updates, there._version
        if version != self._version:
            self._version, self._log_std_here = version, there.cpu().clone()
        return self._log_std_here


def _key(seed: int, environment: int, tick: int) -> int:
    """Seed of a tick's random numbers: splitmix64 over its three parts."""
    key = 0
    for part in (seed, environment, tick):
        key = (key + part + 0x9E3779B97F4A7C15) & MASK
        key = ((key ^ (key >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        key = ((key ^ (key >> 27)) * 0x94D049BB133111EB) & MASK
        key ^= key >> 31
    return key >> 1
