"""Recorded ticks are the bytes that were sent, and a reproduced table fails when a figure leaves its interval."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from caraware.ipc.stream import EMPTY_SLOT
from caraware.study import reproduce
from caraware.study.recording import ARRAYS, FOLDER, SCALARS, TENSORS, EpisodeWriter, Recording
from caraware.study.regression import Comparison, converged, same_steps
from caraware.study.reproduce import ExpectedFigure, FiguresError, compare, expected_figures
from caraware.study.sublane import TRIPS, write_sublane_scenario
from caraware.study.tables import ON_SUBLANES, TABLES, Options, StudyError, Table, town, whole_run
from synthetic_vehicle import VehicleObservation, observations, town_track, vehicle_run


def episode(number: int, *, evaluation: bool, vehicles: int = 3) -> list[VehicleObservation]:
    ticks = list(observations(town_track(6, vehicles, number), seed=number))
    last = len(ticks) - 1
    return [
        replace(obs, episode=number, tick=10 * number + obs.tick, evaluation=evaluation, episode_last=obs.tick == last)
        for obs in ticks
    ]


def test_what_is_read_back_is_what_was_sent(tmp_path: Path) -> None:
    sent = {number: episode(number, evaluation=number == 1) for number in range(3)}
    writer = EpisodeWriter(tmp_path / FOLDER)
    for ticks in sent.values():
        for obs in ticks:
            writer.add(obs)
    recording = Recording(tmp_path)
    (evaluated,) = recording.episodes(evaluation=True)
    trained = list(recording.episodes(evaluation=False))
    assert [ticks[0].episode for ticks in trained] == [0, 2]
    for read, expected in zip((*evaluated, *trained[1]), (*sent[1], *sent[2]), strict=True):
        for name in (*TENSORS, *ARRAYS):
            np.testing.assert_array_equal(np.asarray(getattr(read, name)), np.asarray(getattr(expected, name)))
        assert [getattr(read, name) for name in SCALARS] == [getattr(expected, name) for name in SCALARS]


def test_a_slot_that_came_later_is_empty_before(tmp_path: Path) -> None:
    few, many = episode(0, evaluation=False, vehicles=2), episode(0, evaluation=False, vehicles=4)
    writer = EpisodeWriter(tmp_path / FOLDER)
    for obs in (*few[:3], *many[3:]):
        writer.add(obs)
    ((first, *_, last),) = Recording(tmp_path).episodes(evaluation=False)
    assert first.vehicle.tolist()[2:] == [EMPTY_SLOT] * 2 and not first.valid[2:].any()
    assert torch.equal(last.truth, many[-1].truth)


FIGURES = """
[filters]
"a.ekf" = [0.7, 0.8]
"""


@pytest.fixture
def figures(tmp_path: Path) -> Path:
    file = tmp_path / "figures.toml"
    file.write_text(FIGURES)
    return file


@pytest.mark.parametrize(
    ("measured", "exit_code", "says"),
    [
        ({"a.ekf": [0.7, 0.78]}, 0, ""),
        ({"a.ekf": [0.9, 0.92]}, 1, "a.ekf is 0.910, outside 0.7 … 0.8"),
        ({"a.ekf": [0.1, 0.2]}, 1, "outside"),
        ({"a.ekf": [float("nan"), 0.7]}, 1, "outside"),
        ({}, 1, "a.ekf was not measured"),
        ({"a.ekf": [0.75, 0.75], "b": [1.0]}, 1, "b has no interval"),
    ],
)
def test_a_figure_outside_its_interval_fails(
    figures: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    measured: dict[str, list[float]],
    exit_code: int,
    says: str,
) -> None:
    monkeypatch.setattr(reproduce, "TABLES", {"filters": Table("docs", "title", lambda _: measured)})
    assert reproduce.main(["filters", "--figures", str(figures)]) == exit_code
    assert says in capsys.readouterr().err


@pytest.mark.parametrize("wrong", ['"a" = [0.8, 0.7]', '"a" = 0.8', '"a" = [0.1]', '"a" = [nan, 1.0]'])
def test_a_figure_without_an_interval_is_refused(tmp_path: Path, wrong: str) -> None:
    file = tmp_path / "figures.toml"
    file.write_text(f"[filters]\n{wrong}\n")
    with pytest.raises(FiguresError, match="not \\[low, high\\]"):
        expected_figures(file, "filters")


def test_every_table_has_its_page_its_line_in_the_docs_and_its_figures() -> None:
    root = Path(__file__).parents[2]
    page = (root / "docs" / "reproduce.md").read_text()
    for name, table in TABLES.items():
        assert (root / table.page).exists()
        assert f"`caraware reproduce {name}`" in page
        assert expected_figures(reproduce.FIGURES, name)


def test_an_interval_contains_its_ends_and_no_more() -> None:
    figure = ExpectedFigure(1.0, 2.0)
    assert [figure.holds(value) for value in (0.99, 1.0, 2.0, 2.01)] == [False, True, True, False]
    assert compare({"x": [1.5]}, {"x": figure}) == []


def recorded_run(folder: Path) -> Comparison:
    """Three training episodes and two of evaluation, with the run file beside them."""
    run = vehicle_run(str(folder), horizon=128, batch_size=32, epochs=2, learning_rate=1e-3)
    (folder / "run.json").write_text(json.dumps(run))
    writer = EpisodeWriter(folder / FOLDER)
    for number in range(5):
        for obs in observations(town_track(30, 8, number), seed=number):
            last = obs.tick == 29
            writer.add(
                replace(obs, episode=number, tick=30 * number + obs.tick, evaluation=number > 2, episode_last=last)
            )
    return Comparison(Recording(folder), final_evaluations=2)


def test_ppo_and_regression_learn_from_the_same_ticks_by_as_many_steps(tmp_path: Path) -> None:
    of = recorded_run(tmp_path)
    ppo, beside = same_steps(of, seed=3, ppo=True)
    (alone,) = same_steps(of, seed=3, ppo=False)
    assert (ppo.samples, ppo.gradient_steps) == (beside.samples, beside.gradient_steps)
    # 720 samples fill five horizons of 16 ticks; each is four minibatches, twice.
    assert (beside.samples, beside.gradient_steps) == (5 * 128, 5 * 4 * 2)
    assert alone.error_m == beside.error_m, "the policy changes nothing of the regression"
    assert len(ppo.error_m) == 2 and ppo.error_m != beside.error_m
    many, few = (converged(of, seed=3, epochs=epochs, share=1) for epochs in (30, 1))
    assert (many.samples, many.gradient_steps) == (720, 30 * 23)
    assert many.mean_m < few.mean_m
    assert of.raw_gnss_m() == pytest.approx([7.0, 7.0], abs=1.0)


def write_report(folder: Path, **entries: object) -> None:
    folder.mkdir(parents=True)
    errors_m = {f"{name}_mean_error_m": 1.0 for name in ("ppo", "supervised", "raw_gnss", "ekf", "map_ekf")}
    (folder / "report.json").write_text(json.dumps({"result": "completed"} | errors_m | entries))


def test_a_table_of_whole_runs_has_a_value_of_each_seed(tmp_path: Path) -> None:
    for seed in (1, 2):
        write_report(tmp_path / f"town-{seed}", ppo_mean_error_m=4.0 + seed, supervised_mean_error_m=4.0)
    measured = town(Options(tmp_path, (1, 2)))
    assert (measured["policy"], measured["regression"]) == ([5.0, 6.0], [4.0, 4.0])
    assert measured["policy_by_regression"] == [1.25, 1.5]
    assert measured["map_ekf"] == [1.0, 1.0]


def test_a_run_that_was_stopped_is_no_value(tmp_path: Path) -> None:
    write_report(tmp_path / "town-1", result="interrupted")
    with pytest.raises(StudyError, match="the run is interrupted; remove its directory"):
        whole_run(Options(tmp_path, (1,)), "town-1", "town", ())


def test_drivers_of_the_sublane_scenario_drift_in_their_lanes(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    net = tmp_path / "net.net.xml"
    streets = "".join(f'<edge id="{way}{name}"><lane index="0"/></edge>' for name in "abc" for way in ("", "-"))
    closed = '<edge id=":j" function="internal"><lane/></edge><edge id="walk"><lane allow="pedestrian"/></edge>'
    net.write_text(f"<net>{streets}{closed}</net>")
    types = root / "maps" / "town" / "town.vtypes.add.xml"
    scenario = write_sublane_scenario(net, types, tmp_path / "scenario")
    assert "<lateral-resolution" in scenario.read_text() and str(net) in scenario.read_text()
    written = (scenario.parent / "types.add.xml").read_text()
    assert written.count('lcSigma="0.5"') == 3 and 'id="pedestrian"' not in written
    trips = (scenario.parent / "trips.rou.xml").read_text()
    assert trips.count("<trip ") == TRIPS and '":j"' not in trips and '"walk"' not in trips
    write_sublane_scenario(net, types, tmp_path / "again")
    assert (tmp_path / "again" / "trips.rou.xml").read_text() == trips


def test_the_estimator_learns_on_sublanes_by_the_settings_of_its_preset() -> None:
    preset = tomllib.loads((Path(__file__).parents[2] / "configs" / "fusion.toml").read_text())
    settings = {f"{table}.{key}": value for table, keys in preset.items() for key, value in keys.items()}
    # What neither changes what is learnt nor what is evaluated in the end.
    for key in ("episode.evaluation_interval", "trainer.checkpoint_interval"):
        del settings[key]
    on_sublanes = dict(text.split("=", 1) for text in ON_SUBLANES)

    def value(text: str) -> object:
        return tomllib.loads(f"it = {text}")["it"]

    for key, preset_value in settings.items():
        given = on_sublanes[key]
        assert (given if isinstance(preset_value, str) else value(given)) == preset_value, key
