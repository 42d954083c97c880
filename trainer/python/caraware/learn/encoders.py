"""Networks for rows of alike things: those of `observation.fields = "driver"`, and the candidates of the messages task.

`GroupedNetwork` is for `observation.fields = "driver"`: each group of fields has an encoder, whose outputs are pooled.

The road users, junctions, traffic lights and persons around a hero are sets of alike things. One small network encodes
each member of a set, and the maximum over the members is what the layers above see: so the policy treats the third
nearest vehicle as it treats the first. It is the encoder of PufferDrive and GPUDrive, written anew.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from caraware import _native

EGO = 16
"""Fields of the hero itself and of its route: the preset "driving"."""
ENCODED = 32
"""Width of what a group becomes."""


@dataclass(frozen=True)
class Group:
    """Members of one kind, side by side in a row."""

    prefix: str
    """Their fields are called `prefix_1_…`, `prefix_2_…`."""
    members: int
    columns: int


GROUPS = (Group("user", 8, 13), Group("junction", 3, 3), Group("light", 2, 2), Group("person", 2, 3))
"""In the order of the preset "driver" (ipc-schema/src/field.rs)."""
FIELDS = EGO + sum(group.members * group.columns for group in GROUPS)


class GroupEncoder(nn.Module):
    """Members `[b, m, c]` to `[b, ENCODED]`: two layers for each member, then the maximum over them.

    With `context`, each member is encoded beside `[b, context]` numbers that all of a row share.
    """

    def __init__(self, columns: int, context: int = 0) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(columns, ENCODED), nn.ReLU(), nn.Linear(ENCODED, ENCODED))
        self.context = nn.Linear(context, ENCODED, bias=False) if context else None

    def forward(self, members: Tensor, context: Tensor | None = None) -> Tensor:
        """See the class."""
        first, *rest = self.layers
        seen: Tensor = first(members)
        if self.context is not None and context is not None:
            seen = seen + self.context(context).unsqueeze(1)
        for layer in rest:
            seen = layer(seen)
        return seen.amax(1)


class GroupedNetwork(nn.Module):
    """Rows `[b, inputs]` of the preset "driver" to `[b, outputs]`, through encoders and tanh layers.

    `inputs` is a multiple of the 139 fields if the observation has a history: its ticks are encoded by the same
    encoders and stand side by side. Raises `ValueError` for rows of other fields.
    """

    def __init__(self, inputs: int, outputs: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        if inputs == 0 or inputs % FIELDS:
            raise ValueError(
                f'rows of {inputs} numbers: this network takes the {FIELDS} of observation.fields = "driver"'
            )
        self.ticks = inputs // FIELDS
        self.ego = nn.Linear(EGO, 2 * ENCODED)
        self.groups = nn.ModuleList(GroupEncoder(group.columns, EGO) for group in GROUPS)
        widths = (self.ticks * (2 + len(GROUPS)) * ENCODED, *hidden)
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            linear = nn.Linear(before, after)
            nn.init.orthogonal_(linear.weight, 2**0.5)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.Tanh()]
        head = nn.Linear(widths[-1], outputs)
        # A policy begins near 0 on every axis, a value near 0.
        nn.init.orthogonal_(head.weight, 0.01 if outputs > 1 else 1.0)
        nn.init.zeros_(head.bias)
        self.trunk = nn.Sequential(*layers, head)

    def forward(self, rows: Tensor) -> Tensor:
        """See the class."""
        ticks = rows.view(len(rows) * self.ticks, FIELDS)
        ego = ticks[:, :EGO]
        encoded, at = [self.ego(ego)], EGO
        for group, encoder in zip(GROUPS, self.groups, strict=True):
            width = group.members * group.columns
            members = ticks[:, at : at + width].reshape(-1, group.members, group.columns)
            encoded.append(encoder(members, ego))
            at += width
        seen = torch.cat(encoded, 1).relu()
        out: Tensor = self.trunk(seen.view(len(rows), self.ticks * seen.shape[1]))
        return out


class CandidateNetwork(nn.Module):
    """Rows `[b, inputs]` of the messages task to `[b, outputs]`: a number for each candidate, or one for the station.

    One network judges each candidate by its own numbers, those of the station, and the maximum over all candidates: so
    the policy treats the third nearest object as it treats the first. Raises `ValueError` for rows of other numbers.
    """

    def __init__(self, inputs: int, outputs: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        station, columns = _native.SPEAKER_COLUMNS, _native.CANDIDATE_COLUMNS
        self.candidates = (inputs - station) // columns
        if self.candidates < 1 or (inputs - station) % columns or outputs not in (1, self.candidates):
            raise ValueError(f'rows of {inputs} numbers: this network is for `task.kind` = "messages"')
        self.station, self.columns = station, columns
        self.encoder = GroupEncoder(columns)
        widths = (columns + station + ENCODED, *hidden)
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.Tanh()]
        head = nn.Linear(widths[-1], 1)
        # A policy begins near 0 for every candidate.
        nn.init.orthogonal_(head.weight, 0.01)
        nn.init.zeros_(head.bias)
        self.judge = nn.Sequential(*layers, head)
        self.is_value = outputs == 1 and self.candidates > 1

    def forward(self, rows: Tensor) -> Tensor:
        """See the class."""
        station = rows[:, : self.station]
        candidates = rows[:, self.station :].reshape(len(rows), self.candidates, self.columns)
        around = torch.cat([station, self.encoder(candidates)], 1)
        wide = around.unsqueeze(1).expand(-1, self.candidates, -1)
        judged: Tensor = self.judge(torch.cat([candidates, wide], 2)).squeeze(2)
        # What a station achieves is the sum over those that are there.
        return (judged * candidates[:, :, 0]).sum(1, keepdim=True) if self.is_value else judged
