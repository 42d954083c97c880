"""General ray tracers on the rays and triangles that `lidar-bench` has written: one thread, a line for each name.

Times are processor time, as in `lidar-bench`, because other work may run on the machine.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

Cast = Callable[[], NDArray[np.float32]]
"""Casts all rays; the distance of each, infinite where it hits nothing (m)."""


def open3d_peer(vertices: NDArray[np.float32], faces: NDArray[np.uint32], rays: NDArray[np.float32]) -> Cast:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))
    tensor = o3d.core.Tensor(rays)

    def cast() -> NDArray[np.float32]:
        distances: NDArray[np.float32] = scene.cast_rays(tensor, nthreads=1)["t_hit"].numpy()
        return distances

    return cast


def embreex_peer(vertices: NDArray[np.float32], faces: NDArray[np.uint32], rays: NDArray[np.float32]) -> Cast:
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices[faces])
    origins, directions = rays[:, :3].copy(), rays[:, 3:].copy()

    def cast() -> NDArray[np.float32]:
        distances = scene.run(origins, directions, query="DISTANCE")
        return np.where(distances > 1e30, np.float32(np.inf), distances)

    return cast


def main() -> None:
    directory = Path(sys.argv[1])
    vertices = np.fromfile(directory / "vertices.f32", np.float32).reshape(-1, 3)
    faces = np.fromfile(directory / "faces.u32", np.uint32).reshape(-1, 3)
    rays = np.fromfile(directory / "rays.f32", np.float32).reshape(-1, 6)
    peers: dict[str, Cast] = {}
    for name, make in (("open3d", open3d_peer), ("embreex", embreex_peer)):
        try:
            peers[name] = make(vertices, faces, rays)
        except (ImportError, OSError) as error:
            cure = "pip install open3d-cpu embreex; Debian: libgl1 libusb-1.0-0 libgomp1"
            print(f"{name} is left out: {error} ({cure})", file=sys.stderr)
    print(*peers, flush=True)
    for line in sys.stdin:
        cast = peers[line.strip()]
        begin = time.process_time()
        distances = cast()
        seconds = time.process_time() - begin
        seen = distances < 100.0
        print(len(rays) / seconds, seen.mean(), distances[seen].mean(), flush=True)


main()
