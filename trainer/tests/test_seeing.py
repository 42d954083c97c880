"""A policy that sees: stacks of images, a task that needs them, and the images in checkpoints."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.ipc.image import ImageShape
from caraware.ipc.run_file import ConfigError
from caraware.ipc.stream import EMPTY_SLOT
from caraware.learn.build import build_ppo
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.learn.frames import RecentFrames, Stacks, images_of
from caraware.learn.ppo import Ppo
from caraware.learn.rollout import Rollout
from caraware.learn.seeing import FrameHistory, SeeingBatch, SeeingPpo
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.run.loop import TrainingLoop
from caraware.run.manifest import newest_sound_checkpoint
from caraware.tasks.localisation import Localisation
from synthetic import FIELDS, SIZE_M, SyntheticChannel, SyntheticObservation, run_file, street_ticks
from test_loop import KilledError, final_parameters, loop_over, part
from torch import Tensor

FRAMES, SIZE = 3, 24
SHAPE = ImageShape("binary", 1, SIZE, SIZE)
CAMERA = {"vehicles": 100, "observed": "binary", "height": SIZE, "width": SIZE}
TOY: dict[str, Any] = {
    "network": "cnn",
    "frames": FRAMES,
    "hidden": [32],
    "horizon": 1024,
    "batch_size": 256,
    "learning_rate": 5e-3,
    "learning_rate_decay": 0.97,
    "initial_std": 0.4,
    "actions_per_observation": 4,
    "supervised": False,
    "reward": "exponential",
    "reward_scale_m": 40.0,
}


@dataclass
class SeeingObservation(SyntheticObservation):
    """A tick with images."""

    images: Tensor = field(default_factory=lambda: torch.zeros(0, *SHAPE.size, dtype=torch.uint8))


def seeing_run(folder: str, **trainer: object) -> dict[str, Any]:
    """A run file of a learner that sees."""
    run = run_file(folder, **trainer)
    run["config"]["camera"] = CAMERA
    return run


def fresh(**trainer: object) -> Ppo:
    config = TrainerConfig.from_run(seeing_run("x", **TOY | trainer))
    bounds = MapBounds(0.0, 0.0, SIZE_M, SIZE_M)
    return build_ppo(config, FIELDS, Localisation(bounds, config.reward, config.reward_scale_m))


def seen(obs: SyntheticObservation, images: Tensor) -> SeeingObservation:
    return SeeingObservation(**vars(obs), images=images)


def showing(obs: SyntheticObservation) -> SeeingObservation:
    """The tick without fields; its images show the place as a bright column and a bright row."""
    images = torch.zeros(len(obs.vehicle), *SHAPE.size, dtype=torch.uint8)
    place = (obs.truth[:, :2] / SIZE_M * SIZE).long().clamp(0, SIZE - 1)
    for slot, (x, y) in enumerate(place.tolist()):
        images[slot, 0, :, x] = 255
        images[slot, 0, y, :] = 255
    return seen(replace(obs, observation=torch.zeros(len(obs.vehicle), FIELDS)), images)


def error_m(ppo: Ppo, updates: int) -> float:
    """Error of the policy in the last of some updates."""
    images = ppo.config.images if isinstance(ppo, SeeingPpo) else None
    rollout = Rollout(ppo.config.horizon, FIELDS, bootstrap=False, images=images, leading=FRAMES - 1)
    for obs in street_ticks(10_000, 64, 0.0, seed=3):
        rollout.add(showing(obs))
        if rollout.full():
            batch = ppo.score(rollout.take())
            found = batch.metrics["error_m"].mean().item()
            ppo.update(batch)
        if ppo.updates == updates:
            return found
    raise AssertionError


def test_only_the_policy_that_sees_finds_what_the_images_show() -> None:
    # Places on the streets are 78 m from the middle of the map on average.
    torch.set_float32_matmul_precision("highest")
    assert error_m(fresh(), 14) < 45.0
    assert error_m(fresh(network="mlp"), 4) > 60.0


def wild_ticks(count: int) -> list[SeeingObservation]:
    """Trajectories that end, rows that are not valid, ticks that are missing, slots that come later, random images."""
    rng = np.random.default_rng(7)
    ticks, vehicle = [], np.arange(6, dtype=np.uint32)
    for obs in street_ticks(count, 6, 0.0, seed=1):
        ends = rng.random(6) < 0.1
        vehicle = np.where(ends, vehicle + 10, vehicle).astype(np.uint32)
        valid = rng.random(6) < 0.9
        images = torch.from_numpy(rng.integers(0, 255, (6, *SHAPE.size), np.uint8))
        shown = np.where(valid, vehicle, EMPTY_SLOT).astype(np.uint32)
        tick = replace(obs, vehicle=shown, valid=valid, terminated=ends, truncated=np.full(6, obs.tick == 20))
        if obs.tick < 5:
            # Two slots come later; the camera of the last slot too.
            rows = {name: getattr(tick, name)[:4] for name in ("observation", "truth", "gnss_m", "vehicle", "valid")}
            tick = replace(tick, **rows, terminated=ends[:4], truncated=tick.truncated[:4])
            images = images[:3]
        if obs.tick not in (11, 12, 29):
            ticks.append(seen(tick, images))
    return ticks


@pytest.mark.parametrize("horizon", [1, 10, 33, 10_000])
def test_stacks_of_a_horizon_are_those_of_the_ticks_as_they_come(horizon: int) -> None:
    ticks = wild_ticks(40)
    config = TrainerConfig.from_run(seeing_run("x", **TOY))
    history = FrameHistory(config)
    expected: dict[tuple[int, int], Tensor] = {}
    for obs in ticks:
        history.forget_before(obs.tick)
        stacks = history.stacks(obs)
        again = history.stacks(obs)
        for slot in np.flatnonzero(obs.valid).tolist():
            one = torch.tensor([slot])
            expected[obs.tick, slot] = stacks.of(one)[0]
            assert torch.equal(stacks.of(one), again.of(one))
    rollout = Rollout(horizon, FIELDS, bootstrap=False, images=SHAPE, leading=FRAMES - 1)
    recent, compared = RecentFrames.nothing(SHAPE, FRAMES), 0
    for obs in ticks:
        rollout.add(obs)
        if not (rollout.full() or obs is ticks[-1]) or rollout.pending_samples() == 0:
            continue
        taken = rollout.take()
        assert taken.images is not None
        places, recent = recent.lead_into(taken)
        found = Stacks(taken.images.flatten(0, 1), places.flatten(0, 1))
        for t, slot in taken.valid.nonzero().tolist():
            row = torch.tensor([t * taken.valid.shape[1] + slot])
            assert torch.equal(found.of(row)[0], expected[int(taken.tick[t]), slot])
            compared += 1
    assert compared == len(expected) > 150


def test_a_tick_without_vehicles_has_no_stacks_and_those_after_it_begin_there() -> None:
    history = FrameHistory(TrainerConfig.from_run(seeing_run("x", **TOY)))
    (first, second) = street_ticks(2, 2, 0.0, seed=1)
    names = ("observation", "truth", "gnss_m", "vehicle", "valid", "terminated", "truncated")
    nothing = replace(first, **{name: getattr(first, name)[:0] for name in names})
    none = history.stacks(seen(nothing, torch.zeros(0, *SHAPE.size, dtype=torch.uint8)))
    assert none.of(torch.arange(0)).shape == (0, FRAMES * SHAPE.size[0], *SHAPE.size[1:])
    images = torch.full((2, *SHAPE.size), 7, dtype=torch.uint8)
    assert history.stacks(seen(second, images)).of(torch.arange(2))[:, :, 0, 0].tolist() == [[7, 7, 7]] * 2


def test_a_trajectory_s_first_image_stands_for_those_before_it() -> None:
    config = TrainerConfig.from_run(seeing_run("x", **TOY))
    history, ticks = FrameHistory(config), []
    for obs in street_ticks(5, 2, 0.0, seed=1):
        cut = np.array([False, obs.tick == 3])
        images = torch.full((2, *SHAPE.size), obs.tick, dtype=torch.uint8)
        ticks.append(seen(replace(obs, truncated=cut), images))
    pixels = [history.stacks(obs).of(torch.arange(2))[:, :, 0, 0].tolist() for obs in ticks]
    assert [of_tick[0] for of_tick in pixels] == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4]]
    assert [of_tick[1] for of_tick in pixels] == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [3, 3, 3], [3, 3, 4]]


def test_every_image_is_kept_once_and_stacks_are_places_in_the_rollout_s_buffer() -> None:
    ppo = fresh()
    rollout = Rollout(256, FIELDS, bootstrap=False, images=SHAPE, leading=FRAMES - 1)
    for obs in street_ticks(4, 64, 0.0, seed=3):
        rollout.add(showing(obs))
    horizon = rollout.take()
    batch = ppo.score(horizon)
    assert isinstance(batch, SeeingBatch) and horizon.images is not None
    assert batch.frames.data_ptr() == horizon.images.data_ptr()
    assert batch.frames.shape == ((FRAMES - 1 + 4) * 64, *SHAPE.size)
    assert batch.stack.shape == (256, FRAMES)


def test_batches_of_two_environments_keep_their_own_images() -> None:
    ppo, batches = fresh(), []
    for seed in (3, 4):
        rollout = Rollout(128, FIELDS, bootstrap=False, images=SHAPE, leading=FRAMES - 1)
        for obs in street_ticks(2, 64, 0.0, seed=seed):
            rollout.add(showing(obs))
        batches.append(ppo.score(rollout.take()))
    joined = SeeingBatch.joined(batches)
    assert isinstance(joined, SeeingBatch)
    own = [batch.stacks.of(torch.arange(128)) for batch in batches if isinstance(batch, SeeingBatch)]
    assert torch.equal(joined.stacks.of(torch.arange(256)), torch.cat(own))


def test_the_first_pass_is_the_policy_that_sampled() -> None:
    ppo = fresh(epochs=1, batch_size=1024)
    rollout = Rollout(1024, FIELDS, bootstrap=False, images=SHAPE, leading=FRAMES - 1)
    for obs in street_ticks(16, 64, 0.0, seed=3):
        rollout.add(showing(obs))
    stats = ppo.learn(rollout.take())
    assert stats.ratio_mean == pytest.approx(1.0, abs=1e-5)
    assert stats.clip_fraction == 0.0


def stream(first: int, death: int | None = None) -> Iterator[SeeingObservation]:
    """Evaluations at the ticks 0 to 19, 60 to 79 and 120 to 139; training in between."""
    for obs in street_ticks(140, 16, 5.0, seed=4):
        if obs.tick == death:
            raise KilledError
        if obs.tick >= first:
            episode, evaluation = obs.tick // 20, obs.tick // 20 in (0, 3, 6)
            truncated = np.full(16, obs.tick % 20 == 0)
            tick = replace(obs, episode=episode, evaluation=evaluation, truncated=truncated, last=obs.tick == 139)
            yield showing(tick)


def stream_settings(folder: Path) -> dict[str, Any]:
    """An update every 16 training ticks, in the middle of trajectories; a checkpoint with every second."""
    small = {"horizon": 256, "batch_size": 128, "checkpoint_interval": 2, "epochs": 2}
    return seeing_run(str(folder), **TOY | small)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory of an undisturbed run."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingLoop, "_draw", lambda loop: None)
        loop_over(folder, stream(0), group=1, run=stream_settings(folder))
    return folder


@pytest.mark.parametrize(("end", "tick"), [("killed", 36), ("killed", 60), ("killed", 99), ("left", 36), ("left", 60)])
def test_a_successor_ends_where_the_undisturbed_run_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: Path, end: str, tick: int
) -> None:
    monkeypatch.setattr(TrainingLoop, "_draw", lambda loop: None)
    settings = stream_settings(tmp_path)
    config = RunConfig.from_run(settings)
    first = SyntheticChannel(settings, stream(0, tick if end == "killed" else None), 1)
    loop = TrainingLoop(
        first, config, lambda: False, leave_requested=lambda: end == "left" and first.consumed_up_to >= tick
    )
    with contextlib.suppress(KilledError):
        assert not loop.run()
    newest = newest_sound_checkpoint(tmp_path / "checkpoints")
    learner = Learner.begin(replace(config, resume_from=newest), FIELDS)
    assert isinstance(learner.ppo, SeeingPpo)
    if newest is not None:
        assert learner.ppo.recent[0].depth.tolist() == [FRAMES - 1] * 16
    second = SyntheticChannel(settings, stream(learner.first_tick()), 1)
    assert TrainingLoop(second, config, lambda: False, learner=learner).run()
    one, two = final_parameters(undisturbed), final_parameters(tmp_path)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert part(tmp_path) == part(undisturbed)


def test_what_does_not_see_is_refused() -> None:
    with pytest.raises(ConfigError, match="hold no images"):
        config = TrainerConfig.from_run(run_file("x", **TOY))
        build_ppo(config, FIELDS, Localisation(MapBounds(0, 0, 1, 1), config.reward, 1.0))
    run = seeing_run("x", **TOY)
    run["config"]["camera"] = CAMERA | {"height": 20}
    config = TrainerConfig.from_run(run)
    with pytest.raises(ConfigError, match="images of 24 × 20"):
        build_ppo(config, FIELDS, Localisation(MapBounds(0, 0, 1, 1), config.reward, 1.0))


def test_a_slot_without_a_camera_sees_nothing() -> None:
    obs = next(street_ticks(1, 3, 0.0, seed=1))
    images = torch.full((2, *SHAPE.size), 9, dtype=torch.uint8)
    assert images_of(seen(obs, images), SHAPE)[:, 0, 0, 0].tolist() == [9, 9, 0]
