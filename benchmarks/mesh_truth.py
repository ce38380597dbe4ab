"""How complete and how exact meshes and clouds of runs are, against depth at true poses.

    .venv/bin/python benchmarks/mesh_truth.py RUN [--map FOLDER] [--world NAME]

The reference is the depth of every n-th frame, every 8th row and column of it, within the range and without the
borders of objects that maps leave out, put where the camera truly was when depth was taken: by its stamps, and
`--depth-delay-s` later, its rows one after the other within `--depth-readout-s`. With `--fit-camera` the truth's axes
are first turned and moved, one and the same for all images, to where depth images agree with each other best: markers
are put on cameras by hand. No map has a say in that. With `--world` it is the exact depth of that simulated world at
the times of the recording. A run is moved onto the truth by the rigid motion that fits its final trajectory best, and
a second time ("fitted") by the one that fits the reference to its mesh best: a trajectory of 1 m says little about a
turn of 1 degree, which is 4 cm at 2 m. Told are:

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
from typing import NamedTuple

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from vislam.config import MapConfig  # noqa: E402
from vislam.core.geometry import invert, se3_adjoint, se3_exp, se3_log  # noqa: E402
from vislam.core.messages import Array, Frame  # noqa: E402
from vislam.core.recording import Recording  # noqa: E402
from vislam.core.trajectory import Trajectory  # noqa: E402
from vislam.mapping._open3d import load_open3d  # noqa: E402
from vislam.mapping.dense.pairs import equations, seen_in  # noqa: E402
from vislam.mapping.dense.refine import overlapping  # noqa: E402
from vislam.mapping.depth.image import DepthView, filter_depth, rgbd_view  # noqa: E402
from vislam.mapping.depth.moment import DepthAtImage  # noqa: E402
from vislam.mapping.formats.ply import read_ply, read_ply_mesh  # noqa: E402
from vislam.runs.folder import read_setup  # noqa: E402
from vislam.runs.sources import open_source  # noqa: E402
from vislam.sim import Simulation, open_world  # noqa: E402
from vislam.trajectory import read_trajectory  # noqa: E402
from vislam.trajectory.evaluation import align, associate  # noqa: E402

Surface = tuple[NDArray[np.floating], NDArray[np.integer]]  # vertices [N, 3], triangles [M, 3]

NEAR_M = 0.03
PIXELS = 8  # every n-th row and column of a reference image
MESH_SPACING_M = 0.01  # between places on a mesh that are looked for in the reference
TRUE_VOXEL_M = 0.01
MOTION_NS = 15_000_000  # before and after, by which the truth's velocity is known
GRID_COLUMNS = 160  # of the surfaces by which the truth's axes are turned
CAMERA_GATES_M = (0.10, 0.08, 0.06, 0.05, 0.04, 0.03, 0.03)  # by step
CAMERA_SIGMA = np.array([0.1] * 3 + [0.1] * 3)  # rad, m: of how markers are put on
FIT_STEPS = 15
FIT_REACH_M = 0.1
FIT_SCALE_M = 0.015  # of errors that count half


class Sensing(NamedTuple):
    """How depth was taken."""

    delay_s: float  # later than its stamps say
    readout_s: float  # from the first to the last row
    T_true_body: Array  # [4, 4] the body, by depth, where the truth has it


def reference(
    recording: Recording, every: int, config: MapConfig, world: Simulation | None, sensing: Sensing
) -> NDArray[np.float64]:
    """Return the reference points [N, 3] in the truth's world."""
    view, parts = rgbd_view(recording.rig, config), []
    for frame, seen_m, T in frames_at_truth(recording, every, sensing):
        raw_m = seen_m if world is None else exact_depth(world, frame)
        # pixels at borders of objects lie on no surface; what is left out is what maps leave out
        kept = (slice(PIXELS // 2, None, PIXELS),) * 2
        depth_m = (view.unit_m * filter_depth(raw_m, 1, view, config))[kept]
        points = view.rays_body[kept].reshape(-1, 3) * depth_m.reshape(-1, 1)
        points = points[(depth_m.ravel() > 0.0) & (np.linalg.norm(points, axis=1) < view.max_range_m)]
        points = points.astype(np.float64) + view.T_body_view[:3, 3]
        parts.append(points @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(parts)


def exact_depth(world: Simulation, frame: Frame) -> NDArray[np.float32]:
    """Return the exact depth [H, W] of a simulated frame."""
    exact = world.render(frame.index)
    assert exact.t_ns == frame.t_ns, "the recording is not of this world, or other options"
    assert exact.depth_m is not None
    return exact.depth_m


def frames_at_truth(
    recording: Recording, every: int, sensing: Sensing
) -> Iterator[tuple[Frame, NDArray[np.float32], Array]]:
    """Yield every n-th frame that has depth, that depth as of one moment, and where the body was then."""
    truth = recording.truth()
    assert truth is not None, "the recording has no truth"
    at_once, T_body_cam = DepthAtImage(recording.rig.cameras[0]), recording.rig.T_body_cams[0]
    count = 0
    for frame in recording.events():
        if not isinstance(frame, Frame) or frame.depth_m is None:
            continue
        t_ns = frame.t_ns + round((frame.depth_lag_s + sensing.delay_s) * 1e9)
        if not (_covers(truth, t_ns - MOTION_NS) and _covers(truth, t_ns + MOTION_NS)):
            continue
        count += 1
        if (count - 1) % every == 0:
            before, now, after = (truth.at(t_ns + k * MOTION_NS) @ sensing.T_true_body for k in (-1, 0, 1))
            moved = se3_log(invert(before @ T_body_cam) @ after @ T_body_cam)
            sweep = sensing.readout_s / (2e-9 * MOTION_NS) * moved
            yield frame, at_once(frame.depth_m, np.eye(4), sweep) if sweep.any() else frame.depth_m, now


def by_depth(recording: Recording, every: int, config: MapConfig, sensing: Sensing) -> Array:
    """Return where the body is [4, 4] where the truth has it, as depth images that agree with each other best tell."""
    view = rgbd_view(recording.rig, config)
    seen, poses = [], []
    for _, depth_m, T in frames_at_truth(recording, every, sensing):
        step = max(1, round(depth_m.shape[1] / GRID_COLUMNS))
        seen.append(seen_in(np.nan_to_num(depth_m), view.K, step, view.max_range_m))
        poses.append(T @ view.T_body_view)
    pairs, B = overlapping(seen, np.array(poses)), np.eye(4)
    for gate_m in CAMERA_GATES_M:
        H, g = np.diag(CAMERA_SIGMA**-2), CAMERA_SIGMA**-2 * se3_log(B)
        for a, b in pairs:
            T_b_a = invert(poses[b] @ B) @ poses[a] @ B
            told, J = equations(seen[a], seen[b], T_b_a, gate_m, 2), np.eye(6) - se3_adjoint(invert(T_b_a))
            H, g = H + J.T @ told.H @ J, g + J.T @ told.g
        B = B @ se3_exp(np.linalg.solve(H, -g))
    return np.asarray(view.T_body_view @ B @ invert(view.T_body_view))


def mesh_at_truth(recording: Recording, view: DepthView, sensing: Sensing) -> Surface:
    """Return the mesh of the raw depth of all frames at true poses, by Open3D's own integration."""
    open3d, _ = load_open3d()
    core = open3d.core
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), TRUE_VOXEL_M, 8, 40000, core.Device("CPU:0"),
    )  # fmt: skip
    K = core.Tensor(np.ascontiguousarray(view.K))
    for _, depth_m, T in frames_at_truth(recording, 1, sensing):
        depth = np.nan_to_num(np.where(depth_m < view.max_range_m, depth_m, 0.0)).astype(np.float32)
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
        normals = np.nan_to_num(found["primitive_normals"].numpy().astype(np.float64))  # NaN of a triangle without area
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
    parser.add_argument("--depth-readout-s", type=float, default=0.0, help="from the first to the last row of depth")
    parser.add_argument("--fit-camera", action="store_true", help="turn the truth's axes to where depth has them")
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
        sensing = Sensing(arguments.depth_delay_s, arguments.depth_readout_s, np.eye(4))
        if arguments.fit_camera:
            sensing = sensing._replace(T_true_body=by_depth(recording, arguments.every, whole, sensing))
        points = reference(recording, arguments.every, whole, world, sensing)
        true_mesh = mesh_at_truth(recording, rgbd_view(recording.rig, whole), sensing)
        best = of_surface(true_mesh, points, "at true poses ")
        T = sensing.T_true_body
        best["truth turned deg"] = float(np.rad2deg(Rotation.from_matrix(T[:3, :3]).magnitude()))
        best["truth moved mm"] = 1e3 * float(np.linalg.norm(T[:3, 3]))
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
