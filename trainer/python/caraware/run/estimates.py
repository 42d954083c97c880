"""The Kalman filter beside the policy, for the viewers of a run."""

import numpy as np

from caraware.baselines import Ekf, SensorNoise
from caraware.baselines.samples import read_samples
from caraware.ipc.arrays import Float32Array
from caraware.ipc.stream import Observation


class Estimates:
    """Estimates of a filter for each slot. It has to see every tick, and starts again with an episode."""

    def __init__(self, noise: SensorNoise) -> None:
        self._noise = noise
        self._episode: int | None = None
        self._ekf = Ekf(noise)

    def position_m(self, obs: Observation) -> Float32Array:
        """f32 `[n, 2]`: x, y in the world (m) at the tick of `obs`; not-a-number where a row is not valid."""
        if obs.episode != self._episode:
            self._episode, self._ekf = obs.episode, Ekf(self._noise)
        self._ekf.step(read_samples(obs, self._noise.convention))
        position_m = np.asarray(self._ekf.position_m, dtype=np.float32)
        return np.where(np.asarray(obs.valid)[:, None], position_m, np.float32(np.nan))
