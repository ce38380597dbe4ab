"""How complete and how exact meshes and clouds of runs are, against depth at true poses.

    .venv/bin/python benchmarks/mesh_truth.py RUN [--map FOLDER] [--world NAME]

The reference is the depth of every n-th frame, every 8th row and column of it, within the range and without the
borders of objects that maps leave out, put where the camera truly was when depth was taken: by its stamps, and
`--depth-delay-s` later. With `--world` it is the exact depth of that simulated world at the times of the recording. A
run is moved onto the truth by the rigid motion that fits its final trajectory best, and a second time ("fitted") by the
one that fits the reference to its mesh best: a trajectory of 1 m says little about a turn of 1 degree, which is 4 cm at
2 m, and motion capture knows the camera's axes no better. Told are:

complete    share of reference points with the surface (mesh) or a point (cloud) within 3 cm
median      of the distances from reference points to the surface, in mm; of a mesh of all raw depth at true poses too
true        share of places on the mesh with a reference point within 3 cm
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from vislam.config import MapConfig  # noqa: E402
from vislam.core.geometry import invert  # noqa: E402
from vislam.core.messages import Array, Frame  # noqa: E402
from vislam.core.recording import Recording  # noqa: E402
from vislam.core.trajectory import Trajectory  # noqa: E402
from vislam.mapping._open3d import load_open3d  # noqa: E402
from vislam.mapping.depth.image import DepthView, filter_depth, rgbd_view  # noqa: E402
from vislam.mapping.formats.ply import read_ply, read_ply_mesh  # noqa: E402
from vislam.run.folder import read_setup  # noqa: E402
from vislam.run.sources import open_source  # noqa: E402
from vislam.sim import Simulation, open_world  # noqa: E402
from vislam.trajectory import read_trajectory  # noqa: E402
from vislam.trajectory.evaluation import align, associate  # noqa: E402

Surface = tuple[NDArray[np.floating], NDArray[np.integer]]  # vertices [N, 3], triangles [M, 3]

NEAR_M = 0.03
PIXELS = 8  # every n-th row and column of a reference image
MESH_SPACING_M = 0.01  # between places on a mesh that are looked for in the reference
TRUE_VOXEL_M = 0.01
FIT_STEPS = 15
FIT_REACH_M = 0.1
FIT_SCALE_M = 0.015  # of errors that count half


def reference(
    recording: Recording, every: int, config: MapConfig, world: Simulation | None, delay_s: float
) -> NDArray[np.float64]:
    """Return the reference points [N, 3] in the truth's world."""
    view, parts = rgbd_view(recording.rig, config), []
    for frame, T in frames_at_truth(recording, every, delay_s):
        depth_m = frame.depth_m
        if world is not None:
            exact = world.render(frame.index)
            assert exact.t_ns == frame.t_ns, "the recording is not of this world, or other options"
            depth_m = exact.depth_m
        assert depth_m is not None
        # pixels at borders of objects lie on no surface; what is left out is what maps leave out
        depth_m = view.unit_m * filter_depth(depth_m, 1, view, config)
        kept = (slice(PIXELS // 2, None, PIXELS),) * 2
        depth_m = depth_m[kept]
        points = view.rays_body[kept].reshape(-1, 3) * depth_m.reshape(-1, 1)
        points = points[(depth_m.ravel() > 0.0) & (np.linalg.norm(points, axis=1) < view.max_range_m)]
        points = points.astype(np.float64) + view.T_body_view[:3, 3]
        parts.append(points @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(parts)


def frames_at_truth(recording: Recording, every: int, delay_s: float) -> Iterator[tuple[Frame, Array]]:
    """Yield every n-th frame that has depth, and where its depth was taken: `delay_s` later than it is stamped."""
    truth = recording.truth()
    assert truth is not None, "the recording has no truth"
    count = 0
    for frame in recording.events():
        if not isinstance(frame, Frame) or frame.depth_m is None:
            continue
        t_ns = frame.t_ns + round((frame.depth_lag_s + delay_s) * 1e9)
        if not _covers(truth, t_ns):
            continue
        count += 1
        if (count - 1) % every == 0:
            yield frame, truth.at(t_ns)


def mesh_at_truth(recording: Recording, view: DepthView, delay_s: float) -> Surface:
    """Return the mesh of the raw depth of all frames at true poses, by Open3D's own integration."""
    open3d, _ = load_open3d()
    core = open3d.core
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), TRUE_VOXEL_M, 8, 40000, core.Device("CPU:0"),
    )  # fmt: skip
    K = core.Tensor(np.ascontiguousarray(view.K))
    for frame, T in frames_at_truth(recording, 1, delay_s):
        assert frame.depth_m is not None
        depth = np.nan_to_num(np.where(frame.depth_m < view.max_range_m, frame.depth_m, 0.0)).astype(np.float32)
        image = open3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(depth)))
        extrinsic = core.Tensor(np.ascontiguousarray(invert(T @ view.T_body_view)))
        blocks = grid.compute_unique_block_coordinates(image, K, extrinsic, 1.0, view.max_range_m, 4.0)
        grid.integrate(blocks, image, K, extrinsic, 1.0, view.max_range_m, 4.0)
    mesh = grid.extract_triangle_mesh(weight_threshold=1.0)
    return mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()


def to_surface(points: NDArray[np.float64], surface: Surface) -> NDArray[np.float64]:
    """Return the distance [N] of points to the nearest triangle."""
    open3d, _ = load_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(surface[0].astype(np.float32), surface[1].astype(np.uint32))
    return np.asarray(scene.compute_distance(points.astype(np.float32)).numpy(), np.float64)


def places_on(surface: Surface) -> NDArray[np.float64]:
    """Return places [N, 3] all over a mesh, at random with a fixed seed, one per `MESH_SPACING_M` squared."""
    corners = surface[0].astype(np.float64)[surface[1]]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), int(area.sum() / MESH_SPACING_M**2), p=area / area.sum())
    a, b = rng.random((2, len(chosen), 1))
    a, b = np.where(a + b > 1.0, 1.0 - a, a), np.where(a + b > 1.0, 1.0 - b, b)
    first, second, third = corners[chosen].transpose(1, 0, 2)
    return np.asarray(first + a * (second - first) + b * (third - first))


def judged(folder: Path, points: NDArray[np.float64], T_truth_map: Array) -> dict[str, float]:
    """Return what there is to say of the mesh and the cloud in a folder."""
    out: dict[str, float] = {}
    vertices, _, triangles = read_ply_mesh(folder / "mesh.ply")
    surface = (moved(vertices, T_truth_map), triangles)
    fitted = moved(points, fit(points, surface))
    out |= {**of_surface(surface, points, ""), **of_surface(surface, fitted, "fitted ")}
    if (folder / "cloud.ply").is_file():
        tree = cKDTree(moved(read_ply(folder / "cloud.ply")[0], T_truth_map))
        for name, wanted in (("cloud complete", points), ("fitted cloud complete", fitted)):
            out[name] = float(np.mean(tree.query(wanted, distance_upper_bound=NEAR_M)[0] < NEAR_M))
    return {**out, "triangles": len(triangles)}


def fit(points: NDArray[np.float64], surface: Surface) -> Array:
    """Return the rigid motion [4, 4] that brings points onto a surface: point to plane, far ones counting less."""
    open3d, _ = load_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(surface[0].astype(np.float32), surface[1].astype(np.uint32))
    few, T = points[::5], np.eye(4)
    for _ in range(FIT_STEPS):
        here = moved(few, T)
        found = scene.compute_closest_points(here.astype(np.float32))
        normals = found["primitive_normals"].numpy().astype(np.float64)
        apart = found["points"].numpy() - here
        error = np.einsum("ij,ij->i", apart, normals)
        weight = (np.linalg.norm(apart, axis=1) < FIT_REACH_M) / (1.0 + (error / FIT_SCALE_M) ** 2)
        J = np.hstack([np.cross(here, normals), normals])
        x = np.linalg.solve((J * weight[:, None]).T @ J, (J * weight[:, None]).T @ error)
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
        T = step @ T
    return T


def of_surface(surface: Surface, points: NDArray[np.float64], name: str) -> dict[str, float]:
    """Return how complete, near and true a surface is."""
    distance = to_surface(points, surface)
    on_it = cKDTree(points).query(places_on(surface), distance_upper_bound=NEAR_M)[0]
    return {
        f"{name}complete": float(np.mean(distance < NEAR_M)),
        f"{name}median mm": 1e3 * float(np.median(distance)),
        f"{name}true": float(np.mean(on_it < NEAR_M)),
    }


def moved(points: NDArray[np.floating], T: Array) -> NDArray[np.float64]:
    """Return points [N, 3] in another frame."""
    return points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]


def _covers(trajectory: Trajectory, t_ns: int) -> bool:
    return bool(trajectory.t_ns[0] <= t_ns <= trajectory.t_ns[-1])


def main() -> None:
    """Print one line of JSON per folder of maps."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--map", type=Path, nargs="*", help="folders of maps of the run; its own unless given")
    parser.add_argument("--world", help="name of the simulated world that was recorded, for exact depth")
    parser.add_argument("--duration-s", type=float, help="as the world was recorded")
    parser.add_argument("--camera-hz", type=float, help="as the world was recorded")
    parser.add_argument("--every", type=int, default=5, help="every n-th frame is reference")
    parser.add_argument("--depth-delay-s", type=float, default=0.0, help="how much later than stamped depth was taken")
    parser.add_argument("--cache", type=Path, help="file for the reference and the mesh at true poses")
    arguments = parser.parse_args()
    source, config, _ = read_setup(arguments.run)
    recording = open_source(source, config.seed, config.calibration)
    if arguments.cache is not None and arguments.cache.is_file():
        kept = np.load(arguments.cache)
        points, best = kept["points"], json.loads(str(kept["best"]))
    else:
        whole = replace(config.map, pixel_step=1)
        options = {"duration_s": arguments.duration_s, "camera_hz": arguments.camera_hz}
        world = None
        if arguments.world is not None:
            world = open_world(arguments.world, rig="rgbd", depth_noise=False, image_noise=False, **options)
        delay_s = arguments.depth_delay_s
        points = reference(recording, arguments.every, whole, world, delay_s)
        true_mesh = mesh_at_truth(recording, rgbd_view(recording.rig, whole), delay_s)
        best = of_surface(true_mesh, points, "at true poses ")
        if arguments.cache is not None:
            np.savez(arguments.cache, points=points, best=json.dumps(best))
    truth = recording.truth()
    assert truth is not None
    final = read_trajectory(arguments.run / "trajectory_graph.tum")
    T_truth_map = align(associate(final, truth), "se3")
    for folder in arguments.map or [arguments.run / "map"]:
        result = {"map": str(folder), "points": len(points), **best, **judged(folder, points, T_truth_map)}
        print(json.dumps({name: round(v, 4) if isinstance(v, float) else v for name, v in result.items()}), flush=True)


if __name__ == "__main__":
    main()
