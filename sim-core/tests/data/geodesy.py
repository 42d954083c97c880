"""Reference positions over 50 km x 50 km by two independent packages: pyproj (PROJ) and pymap3d.

Run it to write `geodesy.csv` beside this file. For five projections with their offsets (`NETS`), net coordinates every
12.5 km from (0, 0):

- `latitude_deg`, `longitude_deg`: the inverse projection by pyproj;
- `east_m`, `north_m`, `up_m`: that place at height 0 in the plane that touches the WGS 84 ellipsoid at net (0, 0), by
  pymap3d;
- `sphere_*`: the same latitude and longitude on the paper's sphere: earth-centred (its equation 1) and east and north
  (its equation 2), by pymap3d with an ellipsoid that is a sphere.
"""

import csv
from pathlib import Path

import pymap3d
from pyproj import Proj

NETS = {
    "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs": (-402_990.32, -5_794_389.48),
    "+proj=tmerc +lat_0=52.2773 +lon_0=10.5391 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs": (0.0, 0.0),
    "+proj=utm +zone=23 +south +datum=WGS84 +units=m +no_defs": (-323_000.0, -7_394_000.0),
    "+proj=merc +lon_0=0 +datum=WGS84 +units=m +no_defs": (-1_000_000.0, -6_000_000.0),
    "+proj=lcc +lat_1=49 +lat_2=44 +lat_0=46.5 +lon_0=3 +x_0=700000 +y_0=6600000 +datum=WGS84 +units=m +no_defs": (
        -650_000.0,
        -6_860_000.0,
    ),
}
STEP_M = 12_500.0
COLUMNS = [
    "projection",
    "offset_x_m",
    "offset_y_m",
    "x_m",
    "y_m",
    "latitude_deg",
    "longitude_deg",
    "east_m",
    "north_m",
    "up_m",
    "sphere_x_m",
    "sphere_y_m",
    "sphere_z_m",
    "sphere_east_m",
    "sphere_north_m",
]
SPHERE = pymap3d.Ellipsoid(6_378_137.0, 6_378_137.0)


def rows() -> list[list[str | float]]:
    """One row for each place of each net."""
    found: list[list[str | float]] = []
    for definition, (offset_x, offset_y) in NETS.items():
        proj = Proj(definition)
        origin_lon, origin_lat = proj(-offset_x, -offset_y, inverse=True)
        origin = (origin_lat, origin_lon, 0.0)
        for i in range(-2, 3):
            for j in range(-2, 3):
                x, y = i * STEP_M, j * STEP_M
                lon, lat = proj(x - offset_x, y - offset_y, inverse=True)
                enu = pymap3d.geodetic2enu(lat, lon, 0.0, *origin)
                centred = pymap3d.geodetic2ecef(lat, lon, 0.0, ell=SPHERE)
                east, north, _ = pymap3d.geodetic2enu(lat, lon, 0.0, *origin, ell=SPHERE)
                numbers = [offset_x, offset_y, x, y, lat, lon, *enu, *centred, east, north]
                found.append([definition, *(float(number) for number in numbers)])
    return found


def main() -> None:
    """Writes the table: 1e-12 degrees are a ten-thousandth of a millimetre."""
    with open(Path(__file__).with_suffix(".csv"), "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for definition, *numbers in rows():
            places = [2, 2, 1, 1, 12, 12, *([7] * 8)]
            texts = [f"{number:.{digits}f}" for number, digits in zip(numbers, places, strict=True)]
            writer.writerow([definition, *texts])


if __name__ == "__main__":
    main()
