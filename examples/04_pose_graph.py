"""4. A pose-graph file: read, find the false loops, optimise, write.

    python examples/04_pose_graph.py

Every back end of the field speaks g2o. The file here is made with known truth, 2 % of its loops false, so that the
answer can be checked; `read_pose_graph` takes any g2o, TORO or iSAM file.
"""

import tempfile
from pathlib import Path

import numpy as np

from vislam.batch import optimize_pose_graph, read_pose_graph, simulate_graph, write_pose_graph, write_simulated
from vislam.config import GraphWorldConfig, PoseGraphConfig
from vislam.core import align_points, sim3_parts

made = simulate_graph("manhattan", GraphWorldConfig(poses=600, outlier_fraction=0.02, seed=7))


def error_m(poses: np.ndarray) -> float:
    """Return the rms distance to the truth after the best rigid alignment (nothing in a graph says where it lies)."""
    d = made.problem.dimension
    ours, true = (np.pad(p[:, :d, d], ((0, 0), (0, 3 - d))) for p in (poses, made.truth))
    _, R, t = sim3_parts(align_points(ours, true, with_scale=False))
    return float(np.sqrt(np.mean(np.sum((ours @ R.T + t - true) ** 2, axis=1))))


with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "city.g2o"
    write_simulated(made, path)
    problem = read_pose_graph(path)

    # every edge believed: one false loop bends the whole map
    naive = optimize_pose_graph(problem, PoseGraphConfig(robust="none"))
    # "auto" decides from the residuals which edges to keep, and says why
    robust = optimize_pose_graph(problem, PoseGraphConfig(robust="auto"))
    write_pose_graph(problem, Path(folder) / "city-optimised.g2o", robust.poses)

false = set(np.flatnonzero(made.outlier).tolist())
found = set(robust.rejected.tolist())
print(f"{len(problem.ids)} poses, {len(problem.edges)} edges, {len(false)} of them false")
print(f"error of the start {error_m(problem.poses):.2f} m, all edges believed {error_m(naive.poses):.2f} m")
print(f"robust: {error_m(robust.poses):.2f} m; {len(found)} edges rejected, {len(found & false)} of them truly false")
print(f"because: {robust.robust_reason}")

assert found >= false
assert error_m(robust.poses) < error_m(naive.poses)
