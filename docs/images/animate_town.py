"""Draws `docs/images/town.gif`, the README's animation, from a recording of a run.

.venv/bin/python docs/images/animate_town.py record /tmp/town    # makes the run: some 10 s
.venv/bin/python docs/images/animate_town.py draw /tmp/town/runs/town-gif
"""

import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from caraware import _native
from caraware.data import Recording, open_recording
from caraware.ipc.pointcloud import GROUND
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

HERE = Path(__file__).parent
SETTINGS = {
    "episode.ticks": "400",
    "episode.training_episodes": "1",
    "episode.evaluation_interval": "0",
    "episode.final_evaluations": "1",
    "episode.evaluation_ticks": "1",
    "trainer.supervised": "false",
    "trainer.estimates": '"always"',
    "fanout.enabled": "false",
    "lidar.vehicles": "1",
    "lidar.channels": "1",
    "lidar.points_per_second": "3600",
    "lidar.upper_fov_deg": "-0.5",
    "lidar.lower_fov_deg": "-1",
}
"""One episode with the Kalman filter beside the policy, and one LIDAR of one laser."""

WIDTH_PX, HEIGHT_PX, LEGEND_PX = 720, 570, 34
SCALE = 2
"""Everything is drawn this much larger, then reduced: smooth edges."""
WINDOW_M = (100.0, 62.0, 244.0, 176.0)
"""West, south, east and north edge of the picture (m, world)."""
FIRST_TICK, TICKS_PER_FRAME, FRAMES, FRAME_MS = 60, 2, 100, 100
"""20 s of simulated time in 10 s."""

GROUND_COLOUR, ROAD, WALK, ZEBRA = "#e8eadf", "#7d828a", "#cfccc4", "#f4f4f0"
BUILDING, BUILDING_EDGE, GREEN = "#b39d86", "#8f7a65", "#bfd6a8"
SENSING, OTHER, PERSON = "#1f4fa8", "#f2f2f2", "#d98200"
FIX, ESTIMATE, POINT, EDGE = "#e8175d", "#00b894", "#ffdd33", "#20242c"
PERSON_KIND = 2
"""`kind` of a person in the states of `world`."""
Array = NDArray[Any]


def record(directory: str) -> None:
    """Run the town with `SETTINGS` and record it below a directory."""
    settings = [part for key, value in SETTINGS.items() for part in ("--set", f"{key}={value}")]
    command = ["caraware", "train", "town", "--record", "--name", "town-gif", *settings]
    Path(directory).mkdir(parents=True, exist_ok=True)
    subprocess.run(command, cwd=directory, check=True)


def pixels(points_m: Array) -> list[tuple[float, float]]:
    """[n, 2] points (m, world) as pixels of the enlarged picture."""
    west, south, east, north = WINDOW_M
    x = (points_m[:, 0] - west) / (east - west) * WIDTH_PX * SCALE
    y = (north - points_m[:, 1]) / (north - south) * HEIGHT_PX * SCALE
    return list(zip(x.tolist(), y.tolist(), strict=True))


def metres(length_m: float) -> float:
    """A length in pixels of the enlarged picture."""
    return length_m / (WINDOW_M[2] - WINDOW_M[0]) * WIDTH_PX * SCALE


def shape(text: str) -> Array:
    """[n, 2] corners of a SUMO shape attribute (m)."""
    return np.array([[float(value) for value in corner.split(",")[:2]] for corner in text.split()])


def background(run: Path) -> Image.Image:
    """Roads, pavements, crossings, greens and buildings of the map that the run used."""
    image = Image.new("RGB", (WIDTH_PX * SCALE, HEIGHT_PX * SCALE), GROUND_COLOUR)
    draw = ImageDraw.Draw(image)
    polygons = ET.parse(run / "map" / "town.poly.xml").getroot().findall("poly")
    for polygon in polygons:
        if polygon.get("type") != "building":
            draw.polygon(pixels(shape(polygon.attrib["shape"])), fill=GREEN)
    net = ET.parse(run / "map" / "town.net.xml").getroot()
    for junction in net.findall("junction"):
        if junction.get("type") != "internal" and junction.get("shape"):
            draw.polygon(pixels(shape(junction.attrib["shape"])), fill=ROAD)
    lanes = [(edge, lane) for edge in net.findall("edge") for lane in edge.findall("lane")]
    for wanted, colour in (("road", ROAD), ("walk", WALK), ("crossing", ZEBRA)):
        for edge, lane in lanes:
            width = round(metres(float(lane.get("width", "3.2"))))
            is_walk = lane.get("allow") == "pedestrian"
            kind = edge.get("function") or ("walk" if is_walk else "road")
            if kind == wanted == "crossing":
                for stripe in stripes(shape(lane.attrib["shape"])):
                    draw.line(pixels(stripe), fill=colour, width=width)
            elif kind == wanted:
                draw.line(pixels(shape(lane.attrib["shape"])), fill=colour, width=width, joint="curve")
            elif kind == "walkingarea" and wanted == "walk":
                draw.polygon(pixels(shape(lane.attrib["shape"])), fill=WALK)
    for polygon in polygons:
        if polygon.get("type") == "building":
            draw.polygon(pixels(shape(polygon.attrib["shape"])), fill=BUILDING, outline=BUILDING_EDGE, width=2)
    return image


def stripes(centre_m: Array) -> list[Array]:
    """Pieces of half a metre, one for each metre of a crossing's centre line."""
    ahead = centre_m[-1] - centre_m[0]
    length_m = float(np.hypot(*ahead))
    unit = ahead / length_m
    return [np.stack([centre_m[0] + unit * at, centre_m[0] + unit * (at + 0.5)]) for at in range(int(length_m))]


def palette() -> Image.Image:
    """The colours of the picture and the shades between them that smooth edges have."""
    grounds = [np.array(ImageColor.getrgb(name)) for name in (ROAD, GROUND_COLOUR, BUILDING, WALK, "#ffffff")]
    marks = [np.array(ImageColor.getrgb(name)) for name in (SENSING, OTHER, PERSON, FIX, ESTIMATE, POINT, EDGE)]
    others = [np.array(ImageColor.getrgb(name)) for name in (GREEN, ZEBRA, BUILDING_EDGE, "#000000", "#777777")]
    between = [(share * a + (1 - share) * b) for a in marks for b in grounds for share in (0.33, 0.67)]
    colours = np.rint(np.array([*grounds, *marks, *others, *between])).astype(int)
    image = Image.new("P", (1, 1))
    image.putpalette(colours.flatten().tolist())
    return image


def box(state: np.void) -> Array:
    """[6, 2] corners of a vehicle (m, world), which narrows towards its front."""
    front, half = float(state["length_m"] - state["rear_overhang_m"]), float(state["width_m"]) / 2
    rear = -float(state["rear_overhang_m"])
    nose = front - min(1.2, (front - rear) / 3)
    corners = np.array(
        [[rear, half], [nose, half], [front, half / 3], [front, -half / 3], [nose, -half], [rear, -half]]
    )
    return placed(corners, state)


def placed(points: Array, state: np.void) -> Array:
    """[n, 2] points in the axes of a vehicle's rear axle, in the world."""
    cos, sin = np.cos(state["yaw_rad"]), np.sin(state["yaw_rad"])
    world: Array = points @ np.array([[cos, sin], [-sin, cos]]) + [state["x_m"], state["y_m"]]
    return world


def dot(draw: ImageDraw.ImageDraw, at_m: Array, radius_px: float, colour: str, is_ring: bool = False) -> None:
    """A dot, or a ring, of a radius in pixels of the final picture."""
    (x, y), r = pixels(at_m[None])[0], radius_px * SCALE
    bounds = (x - r, y - r, x + r, y + r)
    draw.ellipse(bounds, fill=None if is_ring else colour, outline=colour, width=2 * SCALE if is_ring else 1)


def frame(recording: Recording, index: int, ground: Image.Image) -> Image.Image:
    """The picture of one tick."""
    image = ground.copy()
    draw = ImageDraw.Draw(image)
    states = recording.at("world", index, "states")
    flags = recording.at("observation", index, "flags")
    vehicles = recording.at("observation", index, "vehicle")
    fixes = recording.at("observation", index, "gnss_m")
    truth = recording.at("observation", index, "truth")
    estimates = recording.at("prediction", index, "estimate_m")
    sensing = set(vehicles[vehicles != _native.EMPTY_SLOT].tolist())
    for state in states:
        if state["kind"] == PERSON_KIND:
            dot(draw, np.array([state["x_m"], state["y_m"]]), 2.2, PERSON)
            continue
        colour = SENSING if int(state["vehicle"]) in sensing else OTHER
        draw.polygon(pixels(box(state)), fill=colour, outline=EDGE, width=SCALE)
    for scan in recording.at("pointcloud", index, "scan"):
        draw_points(draw, scan, recording.at("pointcloud", index, "points"))
    for slot in np.flatnonzero(flags & _native.VALID):
        line = pixels(np.stack([truth[slot, :2], fixes[slot, :2]]))
        draw.line(line, fill=FIX, width=SCALE)
        dot(draw, fixes[slot, :2], 2.5, FIX)
        if slot < len(estimates) and np.isfinite(estimates[slot]).all():
            dot(draw, estimates[slot], 4.5, ESTIMATE, is_ring=True)
    small = image.resize((WIDTH_PX, HEIGHT_PX), Image.Resampling.LANCZOS)
    return legend(small, index * recording.tick_s)


def draw_points(draw: ImageDraw.ImageDraw, scan: np.void, points: Array) -> None:
    """The points of a scan that lie on walls and road users."""
    seen = points[points["object"] != GROUND]["position_m"][:, :2].astype(float)
    yaw = float(scan["attitude_rad"][2])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    for x, y in pixels(seen @ turn + scan["position_m"][:2]):
        draw.rectangle((x - SCALE, y - SCALE, x + SCALE, y + SCALE), fill=POINT)


def legend(picture: Image.Image, time_s: float) -> Image.Image:
    """The picture above a line that names its colours."""
    whole = Image.new("RGB", (WIDTH_PX, HEIGHT_PX + LEGEND_PX), "white")
    whole.paste(picture, (0, 0))
    draw = ImageDraw.Draw(whole)
    font = ImageFont.load_default(15)
    x, y = 12, HEIGHT_PX + LEGEND_PX // 2
    names = (
        (SENSING, "car with sensors"),
        (OTHER, "other vehicle"),
        (PERSON, "person"),
        (FIX, "GNSS fix"),
        (ESTIMATE, "Kalman estimate"),
        (POINT, "LIDAR point"),
    )
    for colour, name in names:
        edge = colour if colour in (FIX, ESTIMATE, PERSON) else EDGE
        fill = "white" if colour == ESTIMATE else colour
        draw.ellipse((x, y - 5, x + 10, y + 5), fill=fill, outline=edge, width=2 if colour == ESTIMATE else 1)
        draw.text((x + 15, y), name, fill="black", font=font, anchor="lm")
        x += 15 + round(font.getlength(name)) + 14
    draw.text((WIDTH_PX - 10, 10), f"{time_s:.0f} s", fill="black", font=font, anchor="rt")
    return whole


def draw(run: str) -> None:
    """Write `town.gif` beside this script from the recording of a run."""
    recording = open_recording(run)
    ground = background(Path(run))
    indices = range(FIRST_TICK, FIRST_TICK + FRAMES * TICKS_PER_FRAME, TICKS_PER_FRAME)
    frames = [frame(recording, index, ground) for index in indices]
    colours = palette()
    plain = [picture.quantize(palette=colours, dither=Image.Dither.NONE) for picture in frames]
    file = HERE / "town.gif"
    plain[0].save(file, save_all=True, append_images=plain[1:], duration=FRAME_MS, loop=0, optimize=True)
    recording.clear_cache()
    print(f"{file.name}: {len(plain)} frames, {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    {"record": record, "draw": draw}[sys.argv[1]](sys.argv[2])
