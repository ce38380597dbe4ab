"""How far a rendered room's cloud lies from its true surfaces, as averaged and after moving least squares.

    .venv/bin/python experiments/cloud_smoothing.py
    .venv/bin/python experiments/cloud_smoothing.py --world workshop-cart --seconds 20

The cloud is that of frames at exact poses with a depth sensor's noise. A point's error is its distance to the plane
through the nearest points of the true depth of the same frames. `edges` are the points within 3 cm of a place where
the truth bends. Where --open3d is said, `smooth_mls` of Open3D is shown beside it (0.20 and newer have it).
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
from moving_person import DEFAULTS, views  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from vislam.core.messages import Array  # noqa: E402
from vislam.mapping.cloud.cloud import Cloud, VoxelAverage, without_outliers  # noqa: E402
from vislam.mapping.cloud.smooth import smoothed  # noqa: E402
from vislam.mapping.depth.image import surface_points  # noqa: E402
from vislam.sim import open_world  # noqa: E402

FLAT_SHARE = 1e-3  # least over middle variance of true points around; more is a place where the truth bends
EDGE_M = 0.03


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="handheld-room")
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--open3d", action="store_true")
    args = parser.parse_args()
    config = replace(DEFAULTS, pixel_step=1)
    world = open_world(args.world, rig="rgbd", image_width_px=320)
    frames, view = views(world, min(args.seconds, world.duration_s - 0.2), config, False)
    noisy, exact = VoxelAverage(config.cloud_voxel_m), VoxelAverage(0.005)
    for frame in frames[::5]:
        points, _ = surface_points(frame.depth_without, view, frame.T_world_body)
        noisy.add(Cloud(points, np.zeros((len(points), 3), np.uint8)))
        true = np.where(np.isfinite(frame.exact), frame.exact / view.unit_m, 0.0).clip(0, 65535).astype(np.uint16)
        points, _ = surface_points(true, view, frame.T_world_body)
        exact.add(Cloud(points, np.zeros((len(points), 3), np.uint8)))
    fused = noisy.cloud(config.cloud_min_points, config.resolution_m)
    cloud = without_outliers(fused, config.cloud_outlier_sigma, config.resolution_m)
    truth = exact.cloud().points_m.astype(np.float64)
    tree = cKDTree(truth)
    error_m, at_edge = compared(tree, truth, cloud.points_m)
    print(f"{args.world}: {len(cloud)} points of {config.cloud_voxel_m} m, {at_edge.mean():.0%} at edges")
    show("as averaged", error_m, at_edge, 0.0)
    for radius_m in (0.03, 0.06, 0.1):
        begun = time.process_time()
        points = smoothed(cloud, radius_m).points_m
        cpu_s = time.process_time() - begun
        show(f"radius {radius_m}", compared(tree, truth, points)[0], at_edge, cpu_s)
        if args.open3d:
            import open3d as o3d

            theirs = o3d.t.geometry.PointCloud(o3d.core.Tensor(cloud.points_m)).smooth_mls(radius=radius_m)
            points = theirs.point.positions.numpy()
            show(f"Open3D {radius_m}", compared(tree, truth, points)[0], at_edge, 0.0)


def compared(tree: cKDTree, truth: Array, points: Array) -> tuple[Array, Array]:
    """Return the distance [N] of points from the true surface, and whether [N] the truth bends near them."""
    error_m, bends = np.empty(len(points)), np.empty(len(points), bool)
    for start in range(0, len(points), 8192):
        chunk = slice(start, start + 8192)
        distances_m, index = tree.query(points[chunk], k=12)
        around = truth[index]
        middle = around.mean(axis=1)
        offsets = around - middle[:, None]
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
        bends[chunk] = values[:, 0] > FLAT_SHARE * values[:, 1]
        across_m = np.abs(np.einsum("ni,ni->n", points[chunk] - middle, vectors[:, :, 0]))
        # where the truth bends, the plane through it means nothing, but its points are 5 mm apart
        error_m[chunk] = np.where(bends[chunk], distances_m[:, 0], across_m)
    bent = points[bends]
    near = np.zeros(len(points), bool)
    if len(bent):
        near = cKDTree(bent).query(points, distance_upper_bound=EDGE_M)[0] < EDGE_M
    return error_m, near


def show(name: str, error_m: Array, at_edge: Array, cpu_s: float) -> None:
    """Print median and 95th percentile on surfaces and at edges."""
    flat, edge = 1e3 * error_m[~at_edge], 1e3 * error_m[at_edge]
    texts = [f"{np.median(e):.2f} / {np.percentile(e, 95):.2f}" if len(e) else "-" for e in (flat, edge)]
    print(f"{name}: surfaces {texts[0]} mm, edges {texts[1]} mm (median / 95 %), CPU {cpu_s:.1f} s", flush=True)


if __name__ == "__main__":
    main()
