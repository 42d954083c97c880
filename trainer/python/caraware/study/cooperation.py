"""Localisation with others' help on recorded ticks, at several shares of vehicles with a radio.

Which vehicle a perceived object is, is known here: it is the one that is truly nearest to where the object was seen.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from caraware.baselines.ekf import Ekf
from caraware.baselines.motion import SPEED, YAW
from caraware.baselines.noise import SensorNoise
from caraware.baselines.samples import Samples, read_samples
from caraware.cooperation.implicit import ImplicitPositioning, View
from caraware.cooperation.joint import JointFilter, JointNoise
from caraware.cooperation.views import CPM, OWN, OffsetView, SlotRows
from caraware.ipc.arrays import BoolArray, Float64Array
from caraware.ipc.run_file import setting
from caraware.ipc.stream import EMPTY_SLOT
from caraware.study.recording import RecordedTick, Recording

SAME_VEHICLE_M = 2.0
"""An object farther than this from every vehicle is none of them: a pedestrian."""

UNKNOWN_M2 = 1e4
"""Variance of a position before the first view of it."""

FORGET_TICKS = 30
"""A receiver forgets a vehicle that it heard nothing of for so long."""

USUAL_LENGTH_M = 4.5
"""Of a vehicle whose length was never heard."""

MOST_COUNTED = 8
"""Vehicles whose errors count, where more have a radio: each has a filter over all that it hears of."""

ESTIMATORS = ("raw", "ekf", "implicit", "cooperative", "central", "smoother")
"""Columns of the table: the last two see what every vehicle perceives, and the last one the future too."""


@dataclass(frozen=True)
class Geometry:
    """What a vehicle knows of its own size, and its station."""

    station: int
    centre_m: float
    """From the rear axle to the centre."""
    half_m: float
    """From the centre to the front."""


@dataclass(frozen=True)
class SensedTick:
    """One tick: what each slot measures of itself, and where it truly is. n slots, all points are centres."""

    vehicle: list[int]
    counts: BoolArray
    """bool `[n]`: it has a radio and valid sensors, and its estimates count."""
    truth_m: Float64Array
    heading_rad: Float64Array
    """True; only to tell which vehicle an object is."""
    fix_m: Float64Array
    fix_new: BoolArray
    ekf_m: Float64Array
    moved_m: Float64Array
    """Since the tick before, by the vehicle's own filter."""
    variance_m2: Float64Array
    """f64 `[n]`: of the fix's white error on an axis."""
    begins: BoolArray
    rows: list[SlotRows]

    @cached_property
    def slot_of(self) -> dict[int, int]:
        """By vehicle, of those that count."""
        return {self.vehicle[slot]: slot for slot in np.flatnonzero(self.counts).tolist()}


PlacedView = tuple[int, int, OffsetView, Float64Array]
"""Observer, perceived vehicle, the view, and the offset between both centres (m)."""


class SensedEpisode:
    """The ticks of an episode, with every vehicle's own filter run over them."""

    def __init__(self, ticks: Sequence[RecordedTick], noise: SensorNoise) -> None:
        self.noise, self._recorded = noise, ticks
        self.geometry = _geometry(ticks)
        self.station = {each.station: vehicle for vehicle, each in self.geometry.items()}
        self.ticks = list(self._sensed(ticks))
        self._views: dict[tuple[int, int, int], list[PlacedView]] = {}
        vehicles = sorted(self.geometry)
        self.counted = set(vehicles[:: math.ceil(len(vehicles) / MOST_COUNTED)]) if vehicles else set()
        """Every n-th vehicle with a radio, by its number."""

    def _sensed(self, ticks: Sequence[RecordedTick]) -> Iterator[SensedTick]:
        ekf = Ekf(self.noise)
        before: dict[int, Float64Array] = {}
        last_fix_s: dict[int, float] = {}
        for obs in ticks:
            samples = read_samples(obs, self.noise.convention)
            ekf.step(samples)
            yaw, speed = ekf.belief.mean[YAW], ekf.belief.mean[SPEED]
            vehicle = [int(number) for number in samples.vehicle]
            ahead_m = np.array([self.geometry[key].centre_m if key in self.geometry else 0.0 for key in vehicle])
            direction = np.stack((np.cos(yaw), np.sin(yaw)), 1)
            truth = obs.truth.numpy().astype(float)
            true_direction = np.stack((np.cos(truth[:, 2]), np.sin(truth[:, 2])), 1)
            moved_m, begins = np.zeros((len(vehicle), 2)), np.ones(len(vehicle), bool)
            for slot, key in enumerate(vehicle):
                course = np.array((yaw[slot], speed[slot]))
                if key in before and ekf.running[slot] and not ekf.started[slot]:
                    moved_m[slot] = _moved_m(before[key], course, self.noise.tick_s, ahead_m[slot])
                    begins[slot] = False
                before[key] = course
            equipped = obs.neighbour_radio[:, 0] == 1
            known = np.array([key in self.geometry for key in vehicle])
            yield SensedTick(
                vehicle=vehicle,
                counts=samples.valid & ekf.running & equipped & known,
                truth_m=truth[:, :2] + ahead_m[:, None] * true_direction,
                heading_rad=truth[:, 2],
                fix_m=samples.fix_m.T + ahead_m[:, None] * direction,
                fix_new=_fresh(samples, last_fix_s),
                ekf_m=ekf.position_m + ahead_m[:, None] * direction,
                moved_m=moved_m,
                variance_m2=np.full(len(vehicle), np.mean(np.square(self.noise.fix_std_m))),
                begins=begins,
                rows=[
                    SlotRows(objects, ids, self.noise.tick_s)
                    for objects, ids in zip(obs.neighbour_objects, obs.neighbour_ids, strict=True)
                ],
            )

    def views(self, tick: int, slot: int, source: int) -> list[PlacedView]:
        """Views that a slot lists at `tick`, about the tick before."""
        key = (tick, slot, source)
        if key not in self._views:
            self._views[key] = list(self._placed(*key))
        return self._views[key]

    def _placed(self, tick: int, slot: int, source: int) -> Iterator[PlacedView]:
        then = self.ticks[tick - 1]
        for view in self.ticks[tick].rows[slot].views(source):
            observer = self.station.get(view.station)
            if observer is None or observer not in then.slot_of:
                continue
            ahead = np.array((math.cos(view.heading_rad), math.sin(view.heading_rad)))
            offset_m = view.offset_m + self.geometry[observer].half_m * ahead
            seen = _nearest(then, then.truth_m[then.slot_of[observer]] + offset_m, observer)
            if seen is not None:
                yield observer, seen, view, offset_m


def _moved_m(before: Float64Array, now: Float64Array, dt_s: float, ahead_m: float) -> Float64Array:
    """Way of the centre between two ticks, by yaw (rad) and speed (m/s) at both."""
    turn = (now[0] - before[0] + math.pi) % (2.0 * math.pi) - math.pi
    course = before[0] + 0.5 * turn
    way_m = 0.5 * (before[1] + now[1]) * dt_s
    turned = np.array((math.cos(now[0]) - math.cos(before[0]), math.sin(now[0]) - math.sin(before[0])))
    moved_m: Float64Array = way_m * np.array((math.cos(course), math.sin(course))) + ahead_m * turned
    return moved_m


def _fresh(samples: Samples, last_s: dict[int, float]) -> BoolArray:
    """bool `[n]`: the fix was not there at the tick before."""
    fresh = np.zeros(len(samples.vehicle), bool)
    for slot, key in enumerate(samples.vehicle.tolist()):
        taken_s = samples.time_s - float(samples.fix_age_s[slot])
        if samples.fix_on[slot] and samples.valid[slot] and taken_s > last_s.get(key, -1.0) + 1e-3:
            fresh[slot], last_s[key] = True, taken_s
    return fresh


def _nearest(tick: SensedTick, position_m: Float64Array, other_than: int) -> int | None:
    """The vehicle that is truly at a place."""
    distances_m = np.linalg.norm(tick.truth_m - position_m, axis=1)
    order: list[int] = np.argsort(distances_m).tolist()
    for slot in order:
        if distances_m[slot] > SAME_VEHICLE_M:
            return None
        key = tick.vehicle[slot]
        if key not in (EMPTY_SLOT, other_than):
            return key
    return None


def _geometry(ticks: Sequence[RecordedTick]) -> dict[int, Geometry]:
    """Of each vehicle with a radio: the front from its own rows, the length from what others heard."""
    fronts_m: dict[int, list[float]] = {}
    stations: dict[int, int] = {}
    lengths_m: dict[int, float] = {}
    for before, obs in itertools.pairwise(ticks):
        fixes_m = before.gnss_m.numpy()[:, :2]
        for slot, (objects, ids) in enumerate(zip(obs.neighbour_objects, obs.neighbour_ids, strict=True)):
            key = int(obs.vehicle[slot])
            if key == EMPTY_SLOT or slot >= len(before.vehicle) or int(before.vehicle[slot]) != key:
                continue
            rows = SlotRows(objects, ids, 0.1)
            for station, (front_m, _) in rows.reference(OWN).items():
                stations[key] = station
                fronts_m.setdefault(key, []).append(float(np.linalg.norm(front_m - fixes_m[slot])))
            for fix in rows.fixes():
                lengths_m[fix.station] = fix.length_m
    geometry: dict[int, Geometry] = {}
    for key, values in fronts_m.items():
        half_m = 0.5 * lengths_m.get(stations[key], USUAL_LENGTH_M)
        geometry[key] = Geometry(stations[key], float(np.median(values)) - half_m, half_m)
    return geometry


Errors = Mapping[str, float]
"""Mean error by estimator (m)."""


def errors_m(episode: SensedEpisode, noise: JointNoise) -> Errors:
    """Mean error of each estimator over the vehicles that count."""
    estimates = {
        "implicit": _implicit(episode, noise),
        "cooperative": _cooperative(episode, noise),
        **_central(episode, noise),
    }
    sums: dict[str, list[float]] = {name: [] for name in ESTIMATORS}
    for number, tick in enumerate(episode.ticks):
        for key, slot in tick.slot_of.items():
            if key not in episode.counted:
                continue
            known = {"raw": tick.fix_m[slot], "ekf": tick.ekf_m[slot]}
            known |= {name: by_tick[number].get(key, tick.ekf_m[slot]) for name, by_tick in estimates.items()}
            for name, position_m in known.items():
                sums[name].append(math.dist(position_m, tick.truth_m[slot]))
    return {name: float(np.mean(values)) for name, values in sums.items()}


ByTick = list[dict[int, Float64Array]]
"""Positions by vehicle, of each tick (m)."""


def _own_fixes(each: JointFilter, tick: SensedTick, keys: Sequence[int]) -> None:
    """Vehicles that begin start at their fix; the others are corrected by it."""
    for key in keys:
        slot = tick.slot_of[key]
        if key not in each:
            each.add_at_fix(key, tick.fix_m[slot])
        elif tick.fix_new[slot]:
            each.fix(key, tick.fix_m[slot], float(tick.variance_m2[slot]))


def _central(episode: SensedEpisode, noise: JointNoise) -> dict[str, ByTick]:
    """One filter over all vehicles with everything that any of them perceives, and its smoother: bounds."""
    joint, filtered = JointFilter(noise, remembers=True), []
    seen_moves: dict[int, Float64Array] = {}
    for number, tick in enumerate(episode.ticks):
        if number:
            then = episode.ticks[number - 1]
            seen_moves = {}
            for slot in then.slot_of.values():
                if tick.vehicle[slot] == then.vehicle[slot]:
                    for observer, seen, view, offset_m in episode.views(number, slot, OWN):
                        _take_view(joint, observer, seen, offset_m)
                        seen_moves[seen] = view.velocity_mps * episode.noise.tick_s
            joint.remember()
        joint.keep({key for key, slot in tick.slot_of.items() if not tick.begins[slot]} | set(seen_moves))
        moves = seen_moves | {key: tick.moved_m[slot] for key, slot in tick.slot_of.items()}
        joint.predict(moves, episode.noise.tick_s, set(tick.slot_of))
        _own_fixes(joint, tick, list(tick.slot_of))
        filtered.append({key: joint.position_m(key).copy() for key in tick.slot_of})
    joint.remember()
    return {"central": filtered, "smoother": joint.smoothed_m()}


def _take_view(joint: JointFilter, observer: int, seen: int, offset_m: Float64Array) -> None:
    """A view by a vehicle that the filter knows."""
    if observer not in joint:
        return
    if seen not in joint:
        joint.add(seen, joint.position_m(observer) + offset_m, UNKNOWN_M2, has_fix=False)
    joint.see(observer, seen, offset_m, joint.noise.view_std_m**2)


def _implicit(episode: SensedEpisode, noise: JointNoise) -> ByTick:
    """Implicit cooperative positioning over what all vehicles with a radio perceive."""
    positioning, estimates = ImplicitPositioning(noise), []
    for number, tick in enumerate(episode.ticks):
        if number:
            then = episode.ticks[number - 1]
            views = [
                View(observer, seen, offset_m, view.velocity_mps * episode.noise.tick_s)
                for slot in then.slot_of.values()
                if tick.vehicle[slot] == then.vehicle[slot]
                for observer, seen, view, offset_m in episode.views(number, slot, OWN)
            ]
            positioning.agree(views)
        filters = positioning.filters
        going = {key for key, slot in tick.slot_of.items() if not tick.begins[slot]}
        for key in [key for key in filters if key not in going]:
            del filters[key]
        for key, slot in tick.slot_of.items():
            each = filters.setdefault(key, JointFilter(noise))
            each.predict({key: tick.moved_m[slot]}, episode.noise.tick_s, {key})
            _own_fixes(each, tick, [key])
        estimates.append({key: each.position_m(key).copy() for key, each in filters.items()})
    return estimates


class Receiver:
    """The filter of one vehicle over itself and those that it perceives or hears of."""

    def __init__(self, key: int, noise: JointNoise) -> None:
        self.key, self.joint = key, JointFilter(noise)
        self._velocities: dict[int, Float64Array] = {}
        self._last_tick: dict[int, int] = {}

    def hear(self, episode: SensedEpisode, number: int, slot: int) -> None:
        """What arrived before tick `number`, about the tick before."""
        tick, joint = episode.ticks[number], self.joint
        for fix in tick.rows[slot].fixes():
            key = episode.station.get(fix.station)
            if key is None or key == self.key:
                continue
            if key not in joint:
                joint.add_at_fix(key, fix.position_m)
            else:
                joint.fix(key, fix.position_m, float(tick.variance_m2[slot]))
            self._velocities[key], self._last_tick[key] = fix.velocity_mps, number
        for source in (OWN, CPM):
            for observer, seen, view, offset_m in episode.views(number, slot, source):
                _take_view(joint, observer, seen, offset_m)
                if seen != self.key and seen in joint:
                    self._velocities[seen], self._last_tick[seen] = view.velocity_mps, number

    def step(self, tick: SensedTick, number: int, slot: int, dt_s: float) -> None:
        """Move to tick `number`, and take the own fix."""
        recent = {key for key, last in self._last_tick.items() if number - last <= FORGET_TICKS}
        self.joint.keep(recent | {self.key})
        moves = {key: self._velocities[key] * dt_s for key in recent} | {self.key: tick.moved_m[slot]}
        self.joint.predict(moves, dt_s, {self.key})
        _own_fixes(self.joint, tick, [self.key])


def _cooperative(episode: SensedEpisode, noise: JointNoise) -> ByTick:
    """Every vehicle with a filter over what it perceives itself and what arrived."""
    receivers: dict[int, Receiver] = {}
    estimates: ByTick = []
    for number, tick in enumerate(episode.ticks):
        going = {key for key, slot in tick.slot_of.items() if not tick.begins[slot]}
        receivers = {key: each for key, each in receivers.items() if key in going}
        for key, slot in tick.slot_of.items():
            if key not in episode.counted:
                continue
            if key in receivers:
                receivers[key].hear(episode, number, slot)
            else:
                receivers[key] = Receiver(key, noise)
            receivers[key].step(tick, number, slot, episode.noise.tick_s)
        estimates.append({key: each.joint.position_m(key).copy() for key, each in receivers.items()})
    return estimates


def errors_by_episode(recording: Recording, evaluations: int) -> list[Errors]:
    """Of the last evaluation episodes, each with a seed of its own. Raises `ValueError` without sensor tables."""
    run = recording.run()
    sensors = SensorNoise.from_run(run)
    if sensors is None:
        raise ValueError("the recorded run has no sensor tables")
    noise = JointNoise(
        fix_std_m=float(np.sqrt(np.mean(np.square(sensors.fix_std_m)))),
        slow_std_m=max(sensors.fix_slow_std_m),
        slow_time_s=sensors.fix_slow_time_s,
        view_std_m=setting(run, "v2x.perception_position_std_m", float),
    )
    episodes = list(recording.episodes(evaluation=True))[-evaluations:]
    return [errors_m(SensedEpisode(ticks, sensors), noise) for ticks in episodes]
