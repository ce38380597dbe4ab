"""How many points of surfaces lie in voxels that the octree takes for free, why, and what sparing them costs.

    .venv/bin/python experiments/free_voxels.py --run runs/desk
    .venv/bin/python experiments/free_voxels.py --world handheld-room --seconds 20

With `--run` the depth that the session kept goes into octrees of several sensor models, at the poses of the graph. With
`--world` a room is rendered, and the depth is exact, or noisy, or noisy at poses that are a little off, to tell these
causes apart. `in free` is the share of all depth points within range that lie in free voxels at the end, `touching` the
part of them with an occupied voxel at most one voxel away. Against the rendered truth: `recall` is the share of the
voxels that true surfaces go through in three frames or more that are occupied, `excess` that of the occupied voxels
that no true surface goes through nor touches, `open` that of the truly free voxels (no surface goes through or touches
them, and OctoMap's own model has them free) that are still free.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import numpy as np  # noqa: E402
from moving_person import View, views  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from vislam.config import MapConfig  # noqa: E402
from vislam.core.geometry import so3_exp, transform  # noqa: E402
from vislam.core.memory import PackedScan  # noqa: E402
from vislam.core.messages import Array  # noqa: E402
from vislam.factors import rig_from  # noqa: E402
from vislam.mapping.cloud.store import KeyframeStore  # noqa: E402
from vislam.mapping.depth.extract import ScanExtractor  # noqa: E402
from vislam.mapping.depth.image import DepthView, filter_depth, scan_points, surface_points  # noqa: E402
from vislam.mapping.octree.occupancy import Occupancy, Octree  # noqa: E402
from vislam.mapping.octree.query import nearest_obstacle  # noqa: E402
from vislam.sim import open_world  # noqa: E402

DEFAULTS = MapConfig()
MODELS = {  # of a hit or a miss: miss, miss beside a hit, clamp
    "OctoMap's": (0.4, 0.4, 0.971),
    "miss 0.32, clamp 0.9": (0.32, 0.32, 0.9),
    **{f"the same, beside {p:g}": (0.32, p, 0.9) for p in (0.4, 0.45, 0.46, 0.47, 0.48, 0.499)},
}
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.01, 0.005
Scans = list[tuple[NDArray[np.uint16], Array]]  # depth, T_map_body


def scans_of_run(run: Path) -> tuple[MapConfig, DepthView, Scans]:
    """Return settings, rays, and the depth with its pose of every keyframe of a run."""
    from vislam.runs.session import Session

    session = Session(run / "session.db")
    config = session.config().map
    view = ScanExtractor(config, rig_from(session.info()["rig"])).view
    poses = {k.id: k.T_map_body for k in session.keyframes()}
    store = KeyframeStore(view.size)
    for i, *row in session.rows("SELECT id, t_ns, depth_png, points, colors FROM scans ORDER BY id"):
        store.put(i, PackedScan(*row))
    session.close()
    depths = ((store.geometry(i).depth, poses[i]) for i in store.ids)
    return config, view, [(depth, T) for depth, T in depths if depth is not None]


def build(scans: Scans, view: DepthView, config: MapConfig, model: tuple[float, float, float]) -> Octree:
    """Return the map of scans under a sensor model."""
    miss, beside, clamp = model
    grid = Octree(
        config.resolution_m, config.hit_probability, miss, config.clamp_min_probability, clamp, beside
    )  # fmt: skip
    for depth, T in scans:
        points, origin = scan_points(depth, view, T, config.resolution_m)
        grid.insert(points, origin, view.max_range_m, config.insertion)
    return grid


def in_free(grid: Octree, scans: Scans, view: DepthView) -> tuple[float, float]:
    """Return the share of depth points in free voxels, and the part of them that touches an occupied one."""
    free: list[Array] = []
    count = 0
    for depth, T in scans:
        points, _ = surface_points(depth, view, T)
        free.append(points[grid.state_at(points) == Occupancy.FREE].astype(np.float64))
        count += len(points)
    lost = np.vstack(free)
    touching = nearest_obstacle(grid, lost[::7], grid.resolution_m).distance_m < np.inf
    return len(lost) / max(count, 1), float(touching.mean()) if len(touching) else 0.0


def against_truth(grid: Octree, octomaps: Octree, frames: list[View]) -> tuple[float, float, float]:
    """Return recall, excess and open, see above."""
    surface, seen = np.unique(np.vstack([f.surface for f in frames]), axis=0, return_counts=True)
    tree = cKDTree(surface)
    recall = (states_of(grid, surface[seen >= 3]) == Occupancy.OCCUPIED).mean()
    excess = away(tree, grid.max_likelihood_leaves().occupied_voxels()).mean()
    octree = octomaps.max_likelihood_leaves()
    free = replace(octree, log_odds=-octree.log_odds).occupied_voxels()
    stays = states_of(grid, free[away(tree, free)]) == Occupancy.FREE
    return float(recall), float(excess), float(stays.mean())


def states_of(grid: Octree, voxels: NDArray[np.int64]) -> NDArray[np.int8]:
    """Return the states [N] of voxels [N, 3]."""
    return grid.state_at((voxels + 0.5) * grid.resolution_m)


def away(surface: cKDTree, voxels: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether each voxel [N, 3] is none of the surface's, and touches none."""
    return np.asarray(surface.query(voxels, p=np.inf, distance_upper_bound=1.5)[0] > 1.5)


def causes(args: argparse.Namespace) -> dict[str, tuple[MapConfig, DepthView, Scans, list[View]]]:
    """Return what goes into the octrees, by the name of what is wrong with it."""
    if args.run is not None:
        return {str(args.run): (*scans_of_run(args.run), [])}
    config = replace(DEFAULTS, pixel_step=1, edge_px=1)  # of images half as wide: the same rays as of 640 px
    world = open_world(args.world, rig="rgbd", image_width_px=320)
    frames, view = views(world, min(args.seconds, world.duration_s - 0.2), config, False)
    frames = frames[:: args.stride]
    rng = np.random.default_rng(3)
    off = [
        transform(so3_exp(POSE_SIGMA_RAD * a), POSE_SIGMA_M * b) for a, b in rng.standard_normal((len(frames), 2, 3))
    ]
    exact = [filter_depth(f.exact, 1, view, config) for f in frames]
    poses = [f.T_world_body for f in frames]
    noisy = [f.depth_without for f in frames]
    moved = [T @ error for T, error in zip(poses, off, strict=True)]
    inputs = {"exact depth": (exact, poses), "noisy depth": (noisy, poses), "noisy, poses off": (noisy, moved)}
    return {name: (config, view, list(zip(*pair, strict=True)), frames) for name, pair in inputs.items()}


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="folder of a run")
    parser.add_argument("--world", default="handheld-room")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--stride", type=int, default=3, help="take every n-th of 10 frames a second")
    print("| input | model | scans | in free | touching | occupied | CPU | recall | excess | open |")
    for cause, (config, view, scans, frames) in causes(parser.parse_args()).items():
        octomaps = build(scans, view, config, MODELS["OctoMap's"])
        for name, model in MODELS.items():
            begun = time.process_time()
            grid = build(scans, view, config, model)
            cpu_ms = 1e3 * (time.process_time() - begun) / len(scans)
            lost, touching = in_free(grid, scans, view)
            occupied = len(grid.max_likelihood_leaves().occupied_voxels())
            truth = [f"{share:.2%}" for share in against_truth(grid, octomaps, frames)] if frames else ["-"] * 3
            print(
                f"| {cause} | {name} | {len(scans)} | {lost:.2%} | {touching:.1%} | {occupied} | {cpu_ms:.2f} ms | "
                f"{' | '.join(truth)} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
