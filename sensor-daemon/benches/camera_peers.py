"""General renderers on the triangles and cameras that the camera benchmark has written: one core, a line for each name.

`camera_peers.py DIRECTORY`. The directory holds little-endian files, and `image.json` with the last fields of `Frame`:

- `vertices.f32` `[N, 3]`: corners in the world, z up (m).
- `faces.u32` `[M, 3]`: corners of each triangle, counter-clockwise from outside.
- `owner.u32` `[M]`: the object of each triangle; 0 is the ground.
- `cameras.f32` `[K, 12]`: position in the world (m), then `world_from_camera` row by row; its columns are forward, left
  and up.

The first line of output names the peers. Each line of input names one. That peer renders every camera once and answers
with seconds, images, the share of pixels that hit something within the range, and the mean depth of these pixels along
the optical axis (m). The last two prove that all sides see the same picture. Ask each name once before measuring: the
first round compiles shaders.

- `open3d`, `mujoco`: depth (f32), instance (u32) and semantic (u8).
- `mujoco_rgb`: colours (3 x u8) alone: ambient light and the sun, without shadows, sky and fog.

Times are processor time of all threads, as in the camera benchmark. Open3D's tree and rays and MuJoCo's scene are made
beforehand, which helps the peers: none of their vehicles moves between two images. Open3D sees walls from inside as
well, so a vehicle that carries a camera must not be among the triangles.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Mesa's software renderer in the calling thread, even where there is a graphics card.
os.environ.update(LIBGL_ALWAYS_SOFTWARE="1", GALLIUM_DRIVER="llvmpipe", LP_NUM_THREADS="0", OMP_NUM_THREADS="1")
os.environ.setdefault("MUJOCO_GL", "egl")  # "osmesa" is as fast

import numpy as np
from numpy.typing import NDArray

SKY = np.uint32(0xFFFF_FFFF)
NEAR_M = 0.1

Image = tuple[float, NDArray[np.float32]]
"""Seconds of processor time, and the depths of the pixels that hit something `[hits]` (m)."""
Render = Callable[[], Iterator[Image]]
"""Renders an image for each camera."""


@dataclass(frozen=True)
class Frame:
    """What the directory holds; shapes and units as in the module's text."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    owner: NDArray[np.uint32]
    cameras: NDArray[np.float32]
    width: int
    height: int
    horizontal_fov_deg: float
    range_m: float

    @classmethod
    def read(cls, directory: Path) -> "Frame":
        return cls(
            np.fromfile(directory / "vertices.f32", np.float32).reshape(-1, 3),
            np.fromfile(directory / "faces.u32", np.uint32).reshape(-1, 3),
            np.fromfile(directory / "owner.u32", np.uint32),
            np.fromfile(directory / "cameras.f32", np.float32).reshape(-1, 12),
            **json.loads((directory / "image.json").read_text()),
        )

    def slopes(self) -> tuple[float, float]:
        """Slopes of the rays through the left and the upper border; pixels are square."""
        left = float(np.tan(np.radians(self.horizontal_fov_deg) / 2))
        return left, left * self.height / self.width

    def rays(self) -> NDArray[np.float32]:
        """Origins and directions `[K, H, W, 6]`; directions are 1 long along the axis, so distances are depths."""
        left, up = self.slopes()
        columns = left * (1 - (2 * np.arange(self.width) + 1) / self.width)
        rows = up * (1 - (2 * np.arange(self.height) + 1) / self.height)
        grid = np.stack(np.broadcast_arrays(1.0, columns, rows[:, None]), axis=-1)
        directions = np.einsum("kij,hwj->khwi", self.cameras[:, 3:].reshape(-1, 3, 3), grid)
        origins = np.broadcast_to(self.cameras[:, None, None, :3], directions.shape)
        return np.concatenate([origins, directions], axis=-1, dtype=np.float32)

    def labels(self) -> NDArray[np.uint8]:
        """CityScapes' label of each owner, and the sky's. All but the ground are buildings here: not compared."""
        return np.array([7, *[11] * int(self.owner.max()), 23], np.uint8)


def open3d_peer(frame: Frame) -> dict[str, Render]:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(frame.vertices), o3d.core.Tensor(frame.faces))
    images = [o3d.core.Tensor(rays) for rays in frame.rays()]
    # A ray without a hit has the greatest possible triangle, which `clip` turns into the last place.
    owner, labels = np.append(frame.owner, SKY), frame.labels()

    def render() -> Iterator[Image]:
        for rays in images:
            begin = time.process_time()
            hits = scene.cast_rays(rays, nthreads=1)
            depth_m = hits["t_hit"].numpy()
            instance = owner.take(hits["primitive_ids"].numpy(), mode="clip")
            is_sky = depth_m > frame.range_m
            depth_m[is_sky], instance[is_sky] = frame.range_m, SKY
            labels.take(instance, mode="clip")
            seconds = time.process_time() - begin
            yield seconds, depth_m[~is_sky]

    return {"open3d": render}


def mujoco_model(frame: Frame, numbers: NDArray[np.uint32]) -> Any:
    """A geom for each of these objects, made of its own triangles: MuJoCo cuts the faces of its boxes into more."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = NEAR_M, frame.range_m
    spec.visual.quality.offsamples = 0
    spec.visual.global_.offwidth, spec.visual.global_.offheight = frame.width, frame.height
    lamp = spec.visual.headlight
    lamp.ambient, lamp.diffuse, lamp.specular = [0.4] * 3, [0.0] * 3, [0.0] * 3
    sun = spec.worldbody.add_light(type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=[0.4, 0.2, -0.9], castshadow=False)
    sun.diffuse, sun.specular = [0.6] * 3, [0.0] * 3
    for number in numbers:
        corners, faces = np.unique(frame.faces[frame.owner == number], return_inverse=True)
        # A shell may be flat, like the ground.
        mesh = spec.add_mesh(name=f"{number}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        mesh.uservert, mesh.userface = frame.vertices[corners].ravel(), faces.ravel()
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{number}", rgba=[0.7, 0.6, 0.5, 1.0])
        geom.contype = geom.conaffinity = 0
    return spec.compile()


def mujoco_peer(frame: Frame) -> dict[str, Render]:
    """The classic renderer through the calls below `mujoco.Renderer`, which needs two passes and twice the time."""
    import mujoco
    from mujoco.gl_context import GLContext
    from OpenGL import GL

    numbers = np.unique(frame.owner)
    model = mujoco_model(frame, numbers)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom)
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, scene)
    gl_context = GLContext(frame.width, frame.height)
    gl_context.make_current()
    if b"llvmpipe" not in GL.glGetString(GL.GL_RENDERER):
        raise OSError(f"{GL.glGetString(GL.GL_RENDERER)} is not llvmpipe")
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    view = mujoco.MjrRect(0, 0, frame.width, frame.height)
    rgb = np.empty((frame.height, frame.width, 3), np.uint8)
    inverse = np.empty((frame.height, frame.width), np.float32)
    # The colour of a geom is one more than its segment; that of the sky is 0.
    instance_of = np.full(scene.ngeom + 1, SKY)
    for geom in scene.geoms[: scene.ngeom]:
        instance_of[geom.segid + 1] = numbers[geom.objid]
    labels = frame.labels()
    left, up = (NEAR_M * slope for slope in frame.slopes())

    def draw(camera: NDArray[np.float32], is_label: int) -> None:
        gl_context.make_current()
        scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = is_label
        for eye in scene.camera:
            eye.pos, eye.forward, eye.up = camera[:3], camera[3::3], camera[5::3]
            eye.frustum_center, eye.frustum_width = 0.0, left
            eye.frustum_bottom, eye.frustum_top = -up, up
            eye.frustum_near, eye.frustum_far = NEAR_M, frame.range_m
        mujoco.mjr_render(view, scene, context)

    def depth_m() -> NDArray[np.float32]:
        """From the buffer's values, 1 at the near plane and 0 at the range."""
        return np.float32(frame.range_m) / (1 + np.float32(frame.range_m / NEAR_M - 1) * inverse)

    # Images stay upside down, as OpenGL gives them: turning them is a view in numpy.
    def render() -> Iterator[Image]:
        for camera in frame.cameras:
            begin = time.process_time()
            draw(camera, is_label=1)
            mujoco.mjr_readPixels(rgb, inverse, view, context)
            depths_m = depth_m()
            red, green, blue = np.moveaxis(rgb, -1, 0).astype(np.uint32)
            instance = instance_of.take(red | green << 8 | blue << 16)
            labels.take(instance, mode="clip")
            seconds = time.process_time() - begin
            yield seconds, depths_m[instance != SKY]

    def render_rgb() -> Iterator[Image]:
        for camera in frame.cameras:
            begin = time.process_time()
            draw(camera, is_label=0)
            mujoco.mjr_readPixels(rgb, None, view, context)
            seconds = time.process_time() - begin
            mujoco.mjr_readPixels(None, inverse, view, context)
            yield seconds, depth_m()[inverse > 0.0]

    return {"mujoco": render, "mujoco_rgb": render_rgb}


def main() -> None:
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    frame = Frame.read(Path(sys.argv[1]))
    peers: dict[str, Render] = {}
    for name, make in (("open3d", open3d_peer), ("mujoco", mujoco_peer)):
        try:
            peers |= make(frame)
        # PyOpenGL answers with an AttributeError where there is no EGL.
        except (ImportError, OSError, AttributeError) as error:
            cure = "pip install open3d-cpu mujoco; Debian: libgl1 libusb-1.0-0 libgomp1 libegl1 libgl1-mesa-dri"
            print(f"{name} is left out: {error} ({cure})", file=sys.stderr)
    print(*peers, flush=True)
    for line in sys.stdin:
        seconds, depths_m = zip(*peers[line.strip()](), strict=True)
        seen_m = np.concatenate(depths_m)
        share = len(seen_m) / (len(depths_m) * frame.width * frame.height)
        print(sum(seconds), len(depths_m), share, seen_m.mean(dtype=np.float64), flush=True)


main()
