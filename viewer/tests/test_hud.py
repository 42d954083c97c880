"""The HUD shows the figures that are known and leaves out the others."""

from __future__ import annotations

import math

import frames
import numpy as np
import pytest

from caraware_viewer import wire
from caraware_viewer.documents import RunMap
from caraware_viewer.hud import ViewerFigures, compass_letters, hud
from caraware_viewer.pairing import distances
from caraware_viewer.picture import Picture

MAP: RunMap = {"run": "town-1", "mode": "train", "tick_s": 0.1, "scene": None}
TRUTH = np.array([[10.0, 20.0], [30.0, 40.0]], np.float32)


def picture(wanted: tuple[str, ...] = (), **fields: np.ndarray) -> Picture:
    result = Picture(wanted)
    result.world = wire.decode_world(frames.world(35999, 3))
    result.observation = wire.decode_observation(frames.observation(35999, TRUTH, TRUTH + np.array([3, 4]), **fields))
    result.distances = distances(result.observation, wire.decode_prediction(frames.prediction(0, TRUTH + 1)))
    result.enter_names(
        wire.decode_table(frames.vehicles(0, {100: "cav|0", 101: "<b>\n`1`", 102: "walker"}), wire.VEHICLE_META)
    )
    return result


def test_it_has_counts_times_sensors_and_errors() -> None:
    text = hud(picture(), MAP, [], ViewerFigures(9.87, 12.3, 4, 5))
    for part in ("town-1", "01:00:00", "1 CAV", "1 others", "1 pedestrians", "0 obstacles", "GNSS 2", "LIDAR 0"):
        assert part in text, part
    for part in ("policy 1.41 m", "EKF –", "GNSS 5.00 m", "9.9 frames/s", "12 ms old", "4 lost", "5 refused"):
        assert part in text, part


def test_a_crowd_is_counted_by_the_status_because_a_frame_has_a_sample() -> None:
    seen = picture()
    few = {wire.CAV: 1, wire.OTHER: 1, wire.PERSON: 1, wire.HERO: 0}
    assert seen.road_users() == few
    # A status may be of the episode before.
    seen.status = {"road_users": {"cav": 10_000, "other": 3, "person": 1}}
    assert seen.road_users() == few
    seen.world = wire.decode_world(frames.world(0, 5920))
    assert seen.road_users() == {wire.CAV: 10_000, wire.OTHER: 3, wire.PERSON: 1, wire.HERO: 0}
    assert "10000 CAV" in hud(seen, MAP, [], ViewerFigures())


def test_every_sensor_of_the_table_is_counted() -> None:
    sensors = np.array([wire.sensor_bit("ultrasonic") | wire.sensor_bit("gnss"), wire.sensor_bit("gnss")], np.uint32)
    text = hud(picture(sensors=sensors), MAP, [], ViewerFigures())
    assert "GNSS 2" in text
    assert "ultrasonic 1" in text


def test_a_followed_vehicle_has_the_figures_of_its_sensors() -> None:
    imu = np.zeros((2, 1, 7), np.float32)
    imu[1, 0] = [1, -2, 9.8, 0, 0, math.radians(30), math.radians(93)]
    text = hud(picture(imu=imu, speed_steering=np.array([[0, 0], [10, -0.5]])), MAP, [101], ViewerFigures())
    for part in ("36.0 km/h", "-28.6°", "93.0° E", "+1.00 -2.00 +9.80 m/s²", "+30.00 °/s", "(sensed)"):
        assert part in text, part


def test_without_sensors_a_vehicle_has_its_true_figures() -> None:
    text = hud(picture(), MAP, [102], ViewerFigures())
    assert "walker (true)" in text
    assert "90.0° E" in text


def test_names_cannot_break_the_tables() -> None:
    text = hud(picture(), MAP, [], ViewerFigures())
    assert r"cav\|0" in text
    assert r"\<b> \`1\`" in text


def test_errors_of_followed_vehicles_come_first() -> None:
    lines = hud(picture(), MAP, [101], ViewerFigures()).split("error (m)")[1].splitlines()
    assert "1.41" in lines[3]
    assert r"\<b>" in lines[3]


def test_with_nothing_known_there_is_still_a_text() -> None:
    assert "town-1" in hud(Picture(), MAP, [], ViewerFigures())


@pytest.mark.parametrize(("degrees", "letters"), [(0, "N"), (44, "NE"), (91, "E"), (180, "S"), (270, "W"), (359, "N")])
def test_compass_letters(degrees: float, letters: str) -> None:
    assert compass_letters(math.radians(degrees)) == letters


def test_the_followed_vehicles() -> None:
    assert picture().followed() == [100]
    assert picture(("<b>\n`1`", "absent", "cav|0")).followed() == [101, 100]
    assert picture(sensors=np.array([7, 15])).followed() == [101]
    with_hero = picture()
    with_hero.world = wire.decode_world(frames.world(0, 3, kind=[0, 0, 3]))
    assert with_hero.followed() == [102]
    assert Picture().followed() == []


def test_the_default_stays_while_it_is_on_the_road() -> None:
    seen = picture()
    assert seen.followed() == [100]
    seen.observation = wire.decode_observation(frames.observation(1, TRUTH, TRUTH, id_hash=np.array([101, 100])))
    assert seen.followed() == [100]
    seen.world = wire.decode_world(frames.world(1, 2, id_hash=[101, 102]))
    assert seen.followed() == [101]


def test_each_episode_has_its_own_names() -> None:
    seen = picture()
    seen.enter_names(wire.decode_table(frames.vehicles(1, {7: "more"}), wire.VEHICLE_META))
    assert seen.name(100) == "cav|0"
    seen.enter_names(wire.decode_table(frames.vehicles(2, {7: "more"}, episode=1), wire.VEHICLE_META))
    assert seen.name(7) == "more"
    assert seen.name(100) == "#0064"


def test_a_process_that_hangs_is_named() -> None:
    shown = picture()
    shown.status = {
        "processes": [
            {"name": "sim-core", "state": "stalled", "silent_s": 312.4, "waits_for": ""},
            {"name": "trainer", "state": "running", "silent_s": 0.01, "waits_for": "sensor-daemon"},
        ]
    }
    text = hud(shown, MAP, [], ViewerFigures())
    assert "| hangs | sim-core: no sign of life for 312 s |" in text
    assert text.count("hangs") == 1
