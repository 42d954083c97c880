"""Implicit cooperative positioning: G. Soatti, M. Nicoli, N. Garcia, B. Denis, R. Raulefs, H. Wymeersch, Implicit
Cooperative Positioning in Vehicular Networks, IEEE Transactions on Intelligent Transportation Systems 19(12), 2018.

Vehicles perceive common features. At each tick every feature's position is agreed on by Gaussian messages, and helps
each vehicle that perceives it. As in the paper, which feature is which is known, and the agreement is that of perfect
links: what a consensus over many exchanges tends to. Features are tracked from tick to tick. A vehicle's own filter
carries the slow error of its fixes beside its position, which the paper's receivers do not have.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caraware.cooperation.joint import JointFilter, JointNoise
from caraware.ipc.arrays import Float64Array

ROUNDS = 4
"""Exchanges of messages in a tick."""

FEATURE_STD_M = 0.3
"""Motion of a feature between two ticks beside its perceived velocity, on each axis."""


@dataclass(frozen=True)
class View:
    """Vehicle `observer` perceives `seen` at an offset."""

    observer: int
    seen: int
    offset_m: Float64Array
    """f64 `[2]`: from one centre to the other, world."""
    moved_m: Float64Array
    """f64 `[2]`: how far the perceived one moved since the tick before, by its perceived velocity."""


@dataclass
class _Feature:
    mean_m: Float64Array
    variance_m2: float


class ImplicitPositioning:
    """The vehicles of a run: each has a filter of its own, and no vehicle knows how its errors hang together."""

    def __init__(self, noise: JointNoise) -> None:
        self.noise = noise
        self.filters: dict[int, JointFilter] = {}
        self._features: dict[int, _Feature] = {}

    def agree(self, views: Sequence[View]) -> None:
        """One tick of messages, after every vehicle has predicted and taken its fix."""
        priors = {key: (each.position_m(key).copy(), each.variance_m2(key)) for key, each in self.filters.items()}
        views = [view for view in views if view.observer in priors]
        variance_m2 = self.noise.view_std_m**2
        self._move_features(views)
        # From feature to vehicle, as precision and precision × mean, by view.
        back = [(0.0, np.zeros(2)) for _ in views]
        by_vehicle, by_feature = _grouped(views, "observer"), _grouped(views, "seen")
        for _ in range(ROUNDS):
            forth: list[tuple[float, Float64Array]] = [(0.0, np.zeros(2))] * len(views)
            for vehicle, places in by_vehicle.items():
                mean_m, variance = priors[vehicle]
                for place in places:
                    others = [back[other] for other in places if other != place]
                    precision = 1.0 / variance + sum(message[0] for message in others)
                    weighted = mean_m / variance + sum((message[1] for message in others), np.zeros(2))
                    spread = 1.0 / precision + variance_m2
                    forth[place] = (1.0 / spread, (weighted / precision + views[place].offset_m) / spread)
            for feature, places in by_feature.items():
                known = self._features.get(feature)
                prior = (1.0 / known.variance_m2, known.mean_m / known.variance_m2) if known else (0.0, np.zeros(2))
                for place in places:
                    others = [forth[other] for other in places if other != place]
                    precision = prior[0] + sum(message[0] for message in others)
                    weighted = prior[1] + sum((message[1] for message in others), np.zeros(2))
                    if precision == 0.0:
                        continue
                    spread = 1.0 / precision + variance_m2
                    back[place] = (1.0 / spread, (weighted / precision - views[place].offset_m) / spread)
        for feature, places in by_feature.items():
            known = self._features.get(feature)
            precision = sum(forth[place][0] for place in places) + (1.0 / known.variance_m2 if known else 0.0)
            weighted = sum((forth[place][1] for place in places), np.zeros(2))
            weighted = weighted + (known.mean_m / known.variance_m2 if known else 0.0)
            self._features[feature] = _Feature(weighted / precision, 1.0 / precision)
        for vehicle, places in by_vehicle.items():
            precision = sum(back[place][0] for place in places)
            if precision > 0.0:
                mean_m = sum((back[place][1] for place in places), np.zeros(2)) / precision
                self.filters[vehicle].pull(vehicle, mean_m, 1.0 / precision)

    def _move_features(self, views: Sequence[View]) -> None:
        """Features that are perceived no more are forgotten; the others move by what is perceived of them."""
        moved: dict[int, list[Float64Array]] = {}
        for view in views:
            moved.setdefault(view.seen, []).append(view.moved_m)
        self._features = {key: each for key, each in self._features.items() if key in moved}
        for key, each in self._features.items():
            each.mean_m = each.mean_m + np.mean(moved[key], axis=0)
            each.variance_m2 += FEATURE_STD_M**2


def _grouped(views: Sequence[View], name: str) -> Mapping[int, list[int]]:
    groups: dict[int, list[int]] = {}
    for place, view in enumerate(views):
        groups.setdefault(getattr(view, name), []).append(place)
    return groups
