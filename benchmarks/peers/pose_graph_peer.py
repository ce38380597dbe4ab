"""One optimiser of pose graphs on one g2o file, in a process of its own: reads, solves, writes, prints its times.

    python pose_graph_peer.py NAME FILE RESULT

Every peer is called as its users write it; NAME is one of the functions below. RESULT.npy gets the poses as they are in
memory, [N, d + 1, d + 1] in the order of the ids: what a peer writes may have six digits. That is in none of its times.
"""

import json
import resource
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np


def cpu_s() -> float:
    """Return the CPU seconds of this process."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def in_space(path: str) -> bool:
    """Return whether a g2o file begins with a pose or edge of space."""
    with open(path) as file:
        return "SE3" in file.readline()


class Laps:
    """CPU seconds of the parts of a job, the version of what did it, and the poses it ended with."""

    def __init__(self, package: str) -> None:
        self.version, self.poses = version(package), np.empty(0)
        self.evaluation = 0.0  # share of the solution's time that was spent in cost functions written in Python
        self.at = self.begun = cpu_s()
        self.wall = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """End a part."""
        now = cpu_s()
        self.seconds[name] = now - self.at
        self.at = now


def vislam(path: str, result: str) -> Laps:
    """Ours, as `vislam optimize` calls it."""
    from vislam.batch.posegraph.files import read_pose_graph
    from vislam.batch.posegraph.g2o import write_g2o
    from vislam.batch.posegraph.optimize import optimize_pose_graph

    for _ in range(2):  # the first round loads compiled code
        laps = Laps("vislam")
        problem = read_pose_graph(Path(path))
        laps.lap("load")
        solution = optimize_pose_graph(problem)
        laps.lap("solve")
        write_g2o(problem, Path(result), solution.poses)
        laps.lap("write")
        laps.poses = solution.poses
        if laps.at - laps.begun > 60.0:
            break
    return laps


def _gtsam(path: str, result: str, initialise: bool) -> Laps:
    import gtsam

    laps = Laps("gtsam")
    space = in_space(path)
    graph, values = gtsam.readG2o(path, space)
    laps.lap("load")
    first = min(values.keys())
    if space:
        prior = gtsam.PriorFactorPose3(first, values.atPose3(first), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3))
    else:
        prior = gtsam.PriorFactorPose2(first, values.atPose2(first), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))
    anchored = gtsam.NonlinearFactorGraph(graph)
    anchored.add(prior)
    if initialise:
        values = gtsam.InitializePose3.initialize(anchored) if space else gtsam.lago.initialize(anchored)
    values = gtsam.LevenbergMarquardtOptimizer(anchored, values).optimize()
    laps.lap("solve")
    gtsam.writeG2o(graph, values, result)
    laps.lap("write")
    at = values.atPose3 if space else values.atPose2
    laps.poses = np.array([at(key).matrix() for key in sorted(values.keys())])
    return laps


def gtsam_lm(path: str, result: str) -> Laps:
    """The gtsam example: Levenberg-Marquardt from the poses of the file."""
    return _gtsam(path, result, False)


def gtsam_chordal_lm(path: str, result: str) -> Laps:
    """The best route of gtsam that works as a rule: chordal start (in the plane lago), then LM."""
    return _gtsam(path, result, True)


def g2o_lm(path: str, result: str) -> Laps:
    """The wheel g2opy: Levenberg-Marquardt, block ordering, the pose of find_gauge() fixed."""
    import g2opy

    laps = Laps("g2opy")
    optimizer = g2opy.SparseOptimizer()
    if in_space(path):
        linear, block = g2opy.LinearSolverEigenSE3(), g2opy.BlockSolverSE3
    else:
        linear, block = g2opy.LinearSolverEigenSE2(), g2opy.BlockSolverSE2
    linear.set_block_ordering(True)
    optimizer.set_algorithm(g2opy.OptimizationAlgorithmLevenberg(block(linear)))
    if not optimizer.load(path):
        raise RuntimeError("load() said no")
    optimizer.find_gauge().set_fixed(True)
    laps.lap("load")
    optimizer.initialize_optimization()
    optimizer.optimize(100)
    laps.lap("solve")
    if not optimizer.save(result):
        raise RuntimeError("save() said no")
    laps.lap("write")
    vertices = optimizer.vertices()
    laps.poses = np.array([g2o_matrix(vertices[key].estimate()) for key in sorted(vertices)])
    return laps


def g2o_matrix(estimate: object) -> np.ndarray:
    """Return g2o's SE2 or Isometry3d as a matrix."""
    if hasattr(estimate, "matrix"):
        return np.asarray(estimate.matrix())
    x, y, angle = estimate.to_vector()
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def ceres_lm(path: str, result: str) -> Laps:
    """The wheel pyceres: Levenberg-Marquardt and sparse Cholesky as Ceres' pose-graph examples call them."""
    import ceres_pose_graph  # beside this file

    from vislam.batch.posegraph.files import read_pose_graph
    from vislam.batch.posegraph.g2o import write_g2o

    ceres_pose_graph.compile_costs()
    laps = Laps("pyceres")
    problem = read_pose_graph(Path(path))  # Ceres reads no files
    laps.lap("load")
    laps.poses, laps.evaluation = ceres_pose_graph.solve(problem)
    laps.lap("solve")
    write_g2o(problem, Path(result), laps.poses)
    laps.lap("write")
    return laps


if __name__ == "__main__":
    name, source, target = sys.argv[1:]
    peers = (vislam, gtsam_lm, gtsam_chordal_lm, g2o_lm, ceres_lm)
    done = {f.__name__: f for f in peers}[name](source, target)
    wall_s, total_s = time.perf_counter() - done.wall, done.at - done.begun
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    np.save(target + ".npy", done.poses)
    told = {"total": total_s, "wall": wall_s, "peak_mb": peak_mb, "version": done.version}
    print(json.dumps({**done.seconds, **told, "evaluation": done.evaluation}))
