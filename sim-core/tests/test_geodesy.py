"""The committed reference positions equal those of their script, and pyproj and pymap3d agree."""

import csv
import runpy
from pathlib import Path

import numpy as np
import pymap3d
from numpy.typing import NDArray
from pyproj import Proj, Transformer

DATA = Path(__file__).parent / "data"
SCRIPT = runpy.run_path(str(DATA / "geodesy.py"))


def committed() -> tuple[list[str], NDArray[np.float64]]:
    with open(DATA / "geodesy.csv", newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    assert header == SCRIPT["COLUMNS"]
    return [row[0] for row in rows], np.array([row[1:] for row in rows], dtype=float)


def test_the_table_is_what_the_script_makes() -> None:
    names, numbers = committed()
    fresh = SCRIPT["rows"]()
    assert names == [row[0] for row in fresh]
    difference = abs(numbers - np.array([row[1:] for row in fresh]))
    assert (difference[:, 4:6] < 1e-11).all(), "latitude and longitude, degrees"
    assert (difference[:, 6:] < 1e-6).all(), "metres"


def test_both_packages_have_the_same_earth() -> None:
    """Earth-centred positions by PROJ's geocentric conversion and by pymap3d's, at heights from -100 m to 10 km."""
    _, numbers = committed()
    lat, lon = numbers[:, 4], numbers[:, 5]
    for height_m in (-100.0, 0.0, 10_000.0):
        to_centre = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
        theirs = np.array(to_centre.transform(lon, lat, np.full_like(lat, height_m)))
        ours = np.array(pymap3d.geodetic2ecef(lat, lon, height_m))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)
        back = np.array(pymap3d.ecef2geodetic(*theirs))
        np.testing.assert_allclose(back[:2], [lat, lon], rtol=0, atol=1e-11)
        np.testing.assert_allclose(back[2], height_m, rtol=0, atol=1e-6)


def test_there_and_back_over_50_km_square_within_a_millimetre() -> None:
    """Net coordinates -> latitude and longitude -> east, north, up -> latitude and longitude -> net coordinates."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-25e3, 25e3, 101), np.linspace(-25e3, 25e3, 101)))
    for definition, (offset_x, offset_y) in SCRIPT["NETS"].items():
        proj = Proj(definition)
        origin_lon, origin_lat = proj(-offset_x, -offset_y, inverse=True)
        lon, lat = proj(x - offset_x, y - offset_y, inverse=True)
        enu = pymap3d.geodetic2enu(lat, lon, 0.0, origin_lat, origin_lon, 0.0)
        lat, lon, height = pymap3d.enu2geodetic(*enu, origin_lat, origin_lon, 0.0)
        back_x, back_y = proj(lon, lat)
        error_m = np.hypot(back_x + offset_x - x, back_y + offset_y - y)
        assert error_m.max() < 1e-3 and abs(height).max() < 1e-3, definition
