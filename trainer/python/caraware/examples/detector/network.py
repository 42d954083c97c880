"""A one-stage detector without anchors, in plain torch, and its loss.

- A peak of a class's heat map is an object: X. Zhou, D. Wang, P. Krähenbühl, *Objects as Points*, 2019 (CenterNet).
  Its loss is the focal loss in the form of H. Law, J. Deng, *CornerNet*, ECCV 2018, equation 1.
- A cell near the peak gives the distances to the four edges of the box: Z. Tian et al., *FCOS*, ICCV 2019. Every cell
  within a Gaussian of the box's shape learns them: Z. Liu et al., *Training-Time-Friendly Network for Real-Time Object
  Detection*, AAAI 2020. The loss is the generalised IoU: H. Rezatofighi et al., CVPR 2019.
- Features of strides 4 to 32 are added from coarse to fine: T.-Y. Lin et al., *Feature Pyramid Networks*, CVPR 2017.
- Depth is learnt as its logarithm, with an L1 loss.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from caraware.examples.detector.images import Class

STRIDE = 4
"""Pixels of the image for each cell, along both axes. Width and height of an image are multiples of `COARSEST`."""
COARSEST = 32
GAUSSIAN = 0.54 / 6
"""Standard deviation of the Gaussian of a box as a share of its width and height (`TTFNet`, alpha 0.54)."""
LEAST_WEIGHT = 0.1
"""Cells with less of the Gaussian than this do not learn the box."""


class Cells(NamedTuple):
    """What the network says of each cell of images [B, 3, height, width]; h = height / 4, w = width / 4."""

    heat: Tensor
    """f32 [B, 4, h, w]: logit that an object of a `Class` has its centre here."""
    boxes_px: Tensor
    """f32 [B, 4, h, w]: left, top, right and bottom edge, pixels from the upper left corner of the image."""
    places: Tensor
    """f32 [B, 2, h, w]: column (pixels) and depth (metres) of the object's nearest visible point."""


class Network(nn.Module):
    """1.0 million parameters."""

    def __init__(self) -> None:
        super().__init__()
        widths = (32, 64, 96, 128)
        self.stem = _convolution(3, 16, stride=2)
        self.stages = nn.ModuleList(
            nn.Sequential(_convolution(before, width, stride=2), *(Residual(width) for _ in range(blocks)))
            for before, width, blocks in zip((16, *widths), widths, (1, 2, 2, 1), strict=False)
        )
        self.lateral = nn.ModuleList(nn.Conv2d(width, 48, 1) for width in widths)
        self.of_class = nn.Sequential(_convolution(48, 32), nn.Conv2d(32, len(Class), 1))
        self.of_box = nn.Sequential(_convolution(48, 48), nn.Conv2d(48, 6, 1))
        last = self.of_class[-1]
        assert isinstance(last, nn.Conv2d) and last.bias is not None
        nn.init.constant_(last.bias, -4.0)  # objects are rare (FCOS and RetinaNet begin so)

    def forward(self, images: Tensor) -> Cells:
        """`images` are u8 [B, 3, height, width]."""
        x = self.stem(images.float() / 255.0 - 0.5)
        pyramid = []
        for stage in self.stages:
            x = stage(x)
            pyramid.append(x)
        joined = self.lateral[-1](pyramid[-1])
        for lateral, fine in zip(reversed(self.lateral[:-1]), reversed(pyramid[:-1]), strict=True):
            joined = lateral(fine) + F.interpolate(joined, scale_factor=2.0, mode="nearest")
        joined = F.relu(joined)
        return _cells(self.of_class(joined), self.of_box(joined))


class Residual(nn.Module):
    """Two convolutions beside the identity (K. He et al., CVPR 2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _convolution(width, width)
        self.second = nn.Sequential(nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: Tensor) -> Tensor:
        """[B, width, h, w] both ways."""
        return F.relu(x + self.second(self.first(x)))


def _convolution(before: int, after: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride, padding=1, bias=False), nn.BatchNorm2d(after), nn.ReLU(inplace=True)
    )


def cell_centres_px(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Columns f32 [w] and rows f32 [h] of the middles of the cells of an image, pixels."""
    return (torch.arange(width // STRIDE) + 0.5) * STRIDE, (torch.arange(height // STRIDE) + 0.5) * STRIDE


def _cells(heat: Tensor, raw: Tensor) -> Cells:
    x, y = cell_centres_px(heat.shape[2] * STRIDE, heat.shape[3] * STRIDE)
    middle = torch.stack([x.expand(len(y), len(x)), y[:, None].expand(len(y), len(x))]).to(raw)
    before, after = (raw[:, :4].clamp(max=5.0).exp() * STRIDE).split(2, dim=1)
    boxes = torch.cat([middle - before, middle + after], dim=1)
    column = boxes[:, :1] + raw[:, 4:5].sigmoid() * (boxes[:, 2:3] - boxes[:, :1])
    depth = (raw[:, 5:6].clamp(-4.0, 4.0) + 2.5).exp()
    return Cells(heat, boxes, torch.cat([column, depth], dim=1))


class Labels(NamedTuple):
    """The objects of B images, at most K of each."""

    boxes_px: Tensor
    """f32 [B, K, 4]."""
    classes: Tensor
    """i64 [B, K]."""
    places: Tensor
    """f32 [B, K, 2]."""
    counted: Tensor
    """bool [B, K]: there is an object, and it is not ignored."""
    ignored: Tensor
    """bool [B, K]: there is an object, and it is ignored."""


class Targets(NamedTuple):
    """What the cells should say."""

    heat: Tensor
    """f32 [B, 4, h, w]: 1 at the cell of a centre, falling with a Gaussian around it."""
    free: Tensor
    """bool [B, 1, h, w]: no ignored object's box is here, so a heat map is wrong that shows something without cause."""
    owner: Tensor
    """i64 [B, h, w]: the object whose box the cell learns."""
    weight: Tensor
    """f32 [B, h, w]: how much the cell counts; the cells of an object have 1 together, unless another owns some."""


def encode(labels: Labels, height: int, width: int) -> Targets:
    """Targets of images of `height` x `width` pixels."""
    x, y = (axis.to(labels.boxes_px) for axis in cell_centres_px(height, width))
    box = labels.boxes_px[..., None, None]
    left, top, right, bottom = box.unbind(2)
    # The Gaussian's centre is the middle of the cell that holds the box's middle.
    centre_x, centre_y = ((low + high) / 2 for low, high in ((left, right), (top, bottom)))
    centre_x = ((centre_x / STRIDE).floor() + 0.5).clamp(0.5, len(x) - 0.5) * STRIDE
    centre_y = ((centre_y / STRIDE).floor() + 0.5).clamp(0.5, len(y) - 0.5) * STRIDE
    away = ((x - centre_x) / (right - left).clamp(min=1.0)) ** 2 + (
        (y[:, None] - centre_y) / (bottom - top).clamp(min=1.0)
    ) ** 2
    gauss = torch.exp(-away / (2 * GAUSSIAN**2)) * labels.counted[..., None, None]
    of_class = F.one_hot(labels.classes, len(Class)).movedim(-1, 0)[..., None, None]
    heat = (gauss * of_class).amax(2).movedim(0, 1)
    covers = (x + STRIDE / 2 > left) & (x - STRIDE / 2 < right)
    covers = covers & (y[:, None] + STRIDE / 2 > top) & (y[:, None] - STRIDE / 2 < bottom)
    free = ~(covers & labels.ignored[..., None, None]).any(1, keepdim=True)
    # A cell belongs to the smallest object among those that it is near to.
    near = gauss > LEAST_WEIGHT
    area = ((right - left) * (bottom - top)).expand_as(gauss).masked_fill(~near, torch.inf)
    owner = area.argmin(1)
    share = gauss * near / (gauss * near).sum((2, 3), keepdim=True).clamp(min=1e-6)
    return Targets(heat, free, owner, share.gather(1, owner[:, None])[:, 0])


class Losses(NamedTuple):
    """Their sum is what training lowers."""

    heat: Tensor
    box: Tensor
    place: Tensor


def losses(cells: Cells, labels: Labels, targets: Targets) -> Losses:
    """Means over the objects that count."""
    objects = labels.counted.sum().clamp(min=1)
    # Focal loss of the heat maps.
    log_p, log_not_p = F.logsigmoid(cells.heat), F.logsigmoid(-cells.heat)
    p, is_centre = cells.heat.sigmoid(), targets.heat == 1.0
    hit = (1 - p) ** 2 * log_p * is_centre
    false = (1 - targets.heat) ** 4 * p**2 * log_not_p * (~is_centre & targets.free)
    heat = -(hit + false).sum() / objects
    # Boxes and places, of the cells that learn one.
    image, row, column = torch.nonzero(targets.weight, as_tuple=True)
    weight, owner = targets.weight[image, row, column], targets.owner[image, row, column]
    box, wanted_box = cells.boxes_px[image, :, row, column], labels.boxes_px[image, owner]
    place, wanted = cells.places[image, :, row, column], labels.places[image, owner]
    box_loss = 5.0 * (weight * (1.0 - generalised_iou(box, wanted_box))).sum() / objects
    width = (wanted_box[:, 2] - wanted_box[:, 0]).clamp(min=2.0)
    off = (place[:, 1].log() - wanted[:, 1].clamp(min=0.3).log()).abs() + (place[:, 0] - wanted[:, 0]).abs() / width
    return Losses(heat, box_loss, 2.0 * (weight * off).sum() / objects)


def generalised_iou(a: Tensor, b: Tensor) -> Tensor:
    """f32 [M] of boxes [M, 4], -1 ... 1; 1 for equal boxes."""
    overlap = (torch.min(a[:, 2:], b[:, 2:]) - torch.max(a[:, :2], b[:, :2])).clamp(min=0).prod(1)
    hull = (torch.max(a[:, 2:], b[:, 2:]) - torch.min(a[:, :2], b[:, :2])).prod(1)
    union = (a[:, 2:] - a[:, :2]).prod(1) + (b[:, 2:] - b[:, :2]).prod(1) - overlap
    return overlap / union - (hull - union) / hull
