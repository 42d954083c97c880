"""A learner in plain torch that may take over a live run at any tick: docs/learners.md."""

import json
import sys
from pathlib import Path

import torch
from torch import nn

from caraware import _native
from caraware.ipc.channel import Channel, StreamEndedError
from caraware.run.process import HandoverRole


def main(run_file: str) -> None:
    """Learn a linear estimate of each vehicle's position, an update every 64 ticks."""
    run = json.loads(Path(run_file).read_text())
    role = HandoverRole.from_environment()
    if role.gets_ready and not role.wait_for_turn():
        return  # refused: the old trainer continues
    channel = Channel(run_file)  # begins after the last commit, whichever learner made it
    folder = Path(run["run_dir"], "minimal_learner")
    x_min_m, y_min_m, x_max_m, y_max_m = run["map"]["bounds_m"]
    centre_m = torch.tensor([x_min_m + x_max_m, y_min_m + y_max_m]) / 2
    half_m = torch.tensor([x_max_m - x_min_m, y_max_m - y_min_m]) / 2
    network, batch = nn.Linear(_native.observation_size(run_file), 2), []
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    if (own := channel.own_tick()) is not None:
        network.load_state_dict(torch.load(folder / f"{own}.pt", weights_only=True))
    try:
        while True:
            for obs in channel.receive(1.0):
                rows = obs.observation.nan_to_num().clone()
                channel.publish_predictions(obs, network(rows) * half_m + centre_m, 0)
                channel.consumed(obs.tick)
                if obs.evaluation:
                    continue
                batch.append((rows[obs.valid], (obs.truth[obs.valid, :2] - centre_m) / half_m))
                if len(batch) == 64:
                    seen, truth = (torch.cat(column) for column in zip(*batch, strict=True))
                    optimiser.zero_grad()
                    (network(seen) - truth).square().mean().backward()
                    optimiser.step()
                    batch.clear()
                    folder.mkdir(exist_ok=True)
                    torch.save(network.state_dict(), folder / f"{obs.tick}.pt")  # saved first,
                    channel.commit(obs.tick)  # then committed: these ticks never come again
    except StreamEndedError:
        channel.done()


if __name__ == "__main__":
    main(sys.argv[1])
