"""The networks of `trainer.network = "cnn"`: convolutions over a stack of images, then hidden layers.

Only the policy sees. The value network is the paper's, over the fields alone: PPO needs it to subtract what an
observation earns on average, which moves no gradient's mean, and a second pair of eyes would double the cost.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from caraware.ipc.image import ImageShape, Label
from caraware.learn.config import ConfigError, TrainerConfig
from caraware.learn.frames import Seen
from caraware.learn.networks import MEAN_HEAD_SCALE

SMALLEST_PX = 23
"""Rows and columns that the three convolutions need."""
BRIGHTNESS = {
    Label.SKY: 0.0,
    Label.BUILDING: 0.1,
    Label.STATIC: 0.1,
    Label.DYNAMIC: 0.1,
    Label.WALL: 0.1,
    Label.BARRIER: 0.1,
    Label.BRIDGE: 0.1,
    Label.POLE: 0.1,
    Label.VEGETATION: 0.2,
    Label.TERRAIN: 0.25,
    Label.SIDEWALK: 0.4,
    Label.ROAD: 0.55,
    Label.RAIL_TRACK: 0.6,
    Label.CROSSING: 0.8,
    Label.STOP_LINE: 0.9,
    Label.LANE_MARKING: 1.0,
    Label.PERSON: -0.5,
    Label.BICYCLE: -0.6,
    Label.MOTORCYCLE: -0.7,
    Label.CAR: -0.8,
    Label.TRUCK: -0.9,
    Label.BUS: -1.0,
    Label.TRAIN: -1.0,
}
"""What the network sees of each class of a semantic image; markings are the brightest, road users are below zero."""


class ConvolutionalNetwork(nn.Module):
    """Fields `[b, inputs]` and stacks of images to `[b, outputs]`."""

    brightness: Tensor

    def __init__(
        self, inputs: int, outputs: int, hidden: Sequence[int], images: ImageShape, frames: int, activation: str
    ) -> None:
        """Raises `ConfigError` for images that are too small."""
        super().__init__()
        if min(images.height, images.width) < SMALLEST_PX:
            raise ConfigError(
                f"`trainer.network` = 'cnn' with images of {images.width} × {images.height}",
                f"set camera.width and camera.height to {SMALLEST_PX} or more",
            )
        self.register_buffer("brightness", brightness(images), persistent=False)
        layer = nn.ReLU if activation == "relu" else nn.Tanh
        self.eyes = nn.Sequential(
            nn.Conv2d(frames * images.channels, 16, 5, stride=3),
            layer(),
            nn.Conv2d(16, 32, 3, stride=2),
            layer(),
            nn.Conv2d(32, 32, 3),
            layer(),
            nn.Flatten(),
        )
        features = self.eyes(torch.zeros(1, frames * images.channels, images.height, images.width)).shape[1]
        widths = (features + inputs, *hidden)
        layers: list[nn.Module] = []
        for a, b in pairwise(widths):
            layers += [nn.Linear(a, b), layer()]
        head = nn.Linear(widths[-1], outputs)
        with torch.no_grad():
            head.weight.mul_(MEAN_HEAD_SCALE)
        self.body = nn.Sequential(*layers, head)

    def forward(self, seen: Seen) -> Tensor:
        """See the class."""
        flat = seen.stacks.flatten().int()
        bright = self.brightness.index_select(0, flat).view(seen.stacks.shape)
        outputs: Tensor = self.body(torch.cat((self.eyes(bright), seen.rows), 1))
        return outputs


def brightness(images: ImageShape) -> Tensor:
    """f32 `[256]`: what the network sees of each value of a pixel."""
    if images.plane != "semantic":
        return torch.arange(256) / 255
    table = torch.zeros(256)
    for label, value in BRIGHTNESS.items():
        table[label] = value
    return table


def mean_network(config: TrainerConfig, inputs: int, outputs: int, seed: int) -> nn.Module:
    """The network of the mean, bounded to ±1, its first weights drawn from `seed`. Raises `ConfigError`."""
    if config.images is None:
        raise ConfigError(
            "`trainer.network` = 'cnn', but the observations hold no images",
            'set camera.observed = "semantic", and camera.vehicles to the number of vehicles that learn',
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = ConvolutionalNetwork(
            inputs, outputs, config.hidden, config.images, config.frames, str(config.activation)
        )
    return nn.Sequential(network, nn.Tanh())
