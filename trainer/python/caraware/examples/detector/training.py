"""Training on labelled images."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caraware.examples.detector.images import LabelledImages, Objects
from caraware.examples.detector.network import Labels, Losses, Network, encode, losses

MOST_OBJECTS = 48
"""Objects of an image that training looks at, the largest ones."""


@dataclass(frozen=True)
class Settings:
    """Hyper-parameters."""

    steps: int = 1000
    batch_size: int = 24
    learning_rate: float = 4e-3
    weight_decay: float = 1e-4
    seed: int = 1


def train(
    images: LabelledImages, settings: Settings, report: Callable[[int, Losses, float], None] | None = None
) -> Network:
    """A network after `settings.steps` steps; `report` gets step, losses and seconds every 50 steps."""
    torch.manual_seed(settings.seed)
    rng = np.random.default_rng(settings.seed)
    network = Network().to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=settings.steps, pct_start=0.1
    )
    labels = stacked(images.objects)
    order: list[int] = []
    network.train()
    began = time.perf_counter()
    for step in range(settings.steps):
        if len(order) < settings.batch_size:
            order = rng.permutation(len(images)).tolist()
        rows = [order.pop() for _ in range(min(settings.batch_size, len(order)))]
        batch, wanted = augmented(torch.from_numpy(images.rgb[rows]), Labels(*(column[rows] for column in labels)), rng)
        batch = batch.contiguous(memory_format=torch.channels_last)
        found = losses(network(batch), wanted, encode(wanted, *batch.shape[2:]))
        optimiser.zero_grad()
        sum(found, torch.zeros(())).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
        schedule.step()
        if report is not None and (step % 50 == 0 or step == settings.steps - 1):
            report(step, Losses(*(part.detach() for part in found)), time.perf_counter() - began)
    return network.eval()


def stacked(objects: list[Objects]) -> Labels:
    """The objects of N images, [N, K, ...], with empty places behind those of an image."""
    count = min(MOST_OBJECTS, max(len(one.classes) for one in objects))
    boxes, places = torch.zeros(len(objects), count, 4), torch.zeros(len(objects), count, 2)
    classes = torch.zeros(len(objects), count, dtype=torch.long)
    counted, ignored = (torch.zeros(len(objects), count, dtype=torch.bool) for _ in range(2))
    for row, one in enumerate(objects):
        size = (one.boxes_px[:, 2:] - one.boxes_px[:, :2]).prod(1)
        kept = np.argsort(-size, kind="stable")[:count]
        number = len(kept)
        boxes[row, :number] = torch.from_numpy(one.boxes_px[kept])
        places[row, :number] = torch.from_numpy(one.places[kept])
        classes[row, :number] = torch.from_numpy(one.classes[kept])
        counted[row, :number] = torch.from_numpy(~one.ignored[kept])
        ignored[row, :number] = torch.from_numpy(one.ignored[kept])
    return Labels(boxes, classes, places, counted, ignored)


def augmented(images: Tensor, labels: Labels, rng: np.random.Generator) -> tuple[Tensor, Labels]:
    """Half of the images mirrored, and all with another brightness, contrast, tint and a little noise."""
    width = images.shape[3]
    mirrored = torch.from_numpy(rng.random(len(images)) < 0.5)
    images = torch.where(mirrored[:, None, None, None], images.flip(3), images)
    flipped = labels.boxes_px * torch.tensor([-1.0, 1.0, -1.0, 1.0]) + torch.tensor([width, 0.0, width, 0.0])
    boxes = torch.where(mirrored[:, None, None], flipped[..., [2, 1, 0, 3]], labels.boxes_px)
    placed = labels.places * torch.tensor([-1.0, 1.0]) + torch.tensor([width, 0.0])
    places = torch.where(mirrored[:, None, None], placed, labels.places)
    shape = (len(images), 3, 1, 1)
    gain = torch.from_numpy(rng.uniform(0.7, 1.3, (shape[0], 1, 1, 1)) * rng.uniform(0.93, 1.07, shape)).float()
    shift = torch.from_numpy(rng.uniform(-20.0, 20.0, (shape[0], 1, 1, 1))).float()
    noise = torch.from_numpy(rng.normal(0.0, 3.0, images.shape).astype(np.float32))
    changed = ((images.float() - 128.0) * gain + 128.0 + shift + noise).clamp(0, 255).to(torch.uint8)
    return changed, labels._replace(boxes_px=boxes, places=places)
