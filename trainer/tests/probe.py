"""A trainer that checks instead of learning, run by `caraware train --set trainer.module=probe`.

It is the trainer of a real run with noiseless sensors. It checks every sample on its way from shared memory through
the rollout buffer to the batch that PPO learns from, and writes its findings to `parts/trainer.json`.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from caraware import _native
from caraware.data import layout
from caraware.ipc.channel import Channel, Observation
from caraware.learn.build import build_ppo
from caraware.learn.ppo import Ppo
from caraware.learn.rewards import REWARDS
from caraware.learn.rollout import Rollout
from caraware.run.config import RunConfig


def shared_segments() -> list[tuple[int, int]]:
    """Address ranges of this process that are mapped from the run's shared memory."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    ranges = [line.split()[0].split("-") for line in lines if "/dev/shm/caraware_" in line]
    return [(int(first, 16), int(last, 16)) for first, last in ranges]


def lies_in_shared_memory(address: int) -> bool:
    """Whether an address belongs to a shared segment."""
    return any(first <= address < last for first, last in shared_segments())


def position_m(normalised: torch.Tensor, bounds: list[float]) -> torch.Tensor:
    """World metres from the first two fields of a −1 … 1 observation."""
    low, high = torch.tensor(bounds[:2]), torch.tensor(bounds[2:])
    return low + (normalised[..., :2] + 1) / 2 * (high - low)


def differing_sections(obs: Observation) -> list[str]:
    """The sections whose array is not, in place, type and shape, what `layout.json` says."""
    (payload,) = (row for row in json.loads(_native.LAYOUT_JSON)["payloads"] if row["name"] == "observation")
    arrays = {name: np.asarray(obs.block.section(name)) for name in layout.sections("observation")}
    sizes = {
        dimension: size
        for section in payload["sections"]
        for dimension, size in zip(section["dimensions"], arrays[section["name"]].shape, strict=False)
    }
    places = layout.places("observation", tuple(sizes[name] for name in payload["dimensions"]))
    return [
        name
        for name, place in places.items()
        if (arrays[name].dtype, arrays[name].shape, arrays[name].flags.writeable) != (place.dtype, place.shape, False)
        or arrays[name].__array_interface__["data"][0] - obs.block.address != place.offset
    ]


def check_tick(obs: Observation, bounds: list[float], found: dict[str, Any]) -> None:
    """Check one tick: it lies in shared memory, is read-only, and each row belongs to one vehicle."""
    views = (obs.observation, obs.truth, obs.gnss_m)
    found["in_shared_memory"] &= all(lies_in_shared_memory(view.data_ptr()) for view in views)
    found["differing_sections"] += differing_sections(obs)
    found["in_the_block"] &= obs.observation.data_ptr() == obs.block.address
    rows = torch.from_numpy(np.flatnonzero(obs.valid))
    error = (position_m(obs.observation[rows], bounds) - obs.truth[rows, :2]).abs()
    found["largest_position_error_m"] = max(found["largest_position_error_m"], float(error.max()))
    found["distinct_vehicles"] &= len(np.unique(obs.vehicle[obs.valid])) == len(rows)
    for write in (lambda: obs.observation.add_(1), lambda: obs.observation.__setitem__(0, 1.0)):
        try:
            write()
            found["writable"] = True
        except RuntimeError:
            found["refused_writes"] += 1


def check_batch(
    ppo: Ppo,
    rollout: Rollout,
    config: RunConfig,
    bounds: list[float],
    found: dict[str, Any],
    seen: dict[tuple[int, int], torch.Tensor],
) -> None:
    """Check that observation, action, reward and truth of a sample belong to the same vehicle and the same tick."""
    batch = ppo.score(rollout.take())
    found["samples"] += len(batch.reward)
    place = position_m(batch.observation, bounds)
    found["largest_batch_error_m"] = max(
        found["largest_batch_error_m"], float((place - batch.truth[:, :2]).abs().max())
    )
    distance = (config.bounds.to_world_m(batch.action) - batch.truth[:, :2]).norm(dim=1)
    reward = REWARDS[config.trainer.reward](distance, config.trainer.reward_scale_m)
    found["largest_reward_error"] = max(found["largest_reward_error"], float((reward - batch.reward).abs().max()))
    for tick, vehicle, truth in zip(batch.tick.tolist(), batch.vehicle.tolist(), batch.truth, strict=True):
        found["foreign_samples"] += int(not torch.equal(seen.pop((tick, vehicle)), truth))


def main(run_file: str) -> None:
    """Take part in the run from the first tick to the last."""
    channel = Channel(run_file)
    config = RunConfig.from_run(channel.run)
    bounds = channel.run["map"]["bounds_m"]
    found: dict[str, Any] = {
        "differing_sections": [],
        **dict.fromkeys(("in_shared_memory", "in_the_block", "distinct_vehicles"), True),
        **dict.fromkeys(("largest_position_error_m", "largest_batch_error_m", "largest_reward_error"), 0.0),
        **dict.fromkeys(("writable", "refused_writes", "samples", "foreign_samples", "env_steps"), 0),
        "ticks": [],
    }
    ppo: Ppo | None = None
    seen: dict[tuple[int, int], torch.Tensor] = {}
    last = False
    while not last:
        for obs in channel.receive(1.0):
            check_tick(obs, bounds, found)
            found["ticks"].append(obs.tick)
            if ppo is None:
                ppo = build_ppo(config.trainer, obs.observation.shape[1], config.task)
                rollout = Rollout(config.trainer.horizon, obs.observation.shape[1], bootstrap=False)
            for row in np.flatnonzero(obs.valid):
                seen[obs.tick, int(obs.vehicle[row])] = obs.truth[row].clone()
            rollout.add(obs)
            last = obs.last
            channel.consumed(obs.tick)
            if rollout.full():
                check_batch(ppo, rollout, config, bounds, found, seen)
    found["consecutive"] = found["ticks"] == list(range(len(found["ticks"])))
    found["ticks"] = len(found["ticks"])
    Path(channel.run["run_dir"], "parts", "trainer.json").write_text(json.dumps(found))
    channel.done()


if __name__ == "__main__":
    main(sys.argv[1])
