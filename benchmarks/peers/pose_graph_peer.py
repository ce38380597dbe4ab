"""One optimiser of pose graphs on one g2o file, in a process of its own: reads, solves, writes, prints its times.

    python pose_graph_peer.py NAME FILE RESULT

Every peer is called as its users write it; NAME is one of the functions below. Needs nothing but the peer itself.
"""

import json
import resource
import sys
import time


def cpu_s() -> float:
    """Return the CPU seconds of this process."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def in_space(path: str) -> bool:
    """Return whether a g2o file begins with a pose or edge of space."""
    with open(path) as file:
        return "SE3" in file.readline()


class Laps:
    """CPU seconds of the parts of a job."""

    def __init__(self) -> None:
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
    from pathlib import Path

    from vislam.batch.graph_files import read_pose_graph
    from vislam.batch.graph_g2o import write_g2o
    from vislam.batch.graph_optimize import optimize_pose_graph

    for _ in range(2):  # the first round loads compiled code
        laps = Laps()
        problem = read_pose_graph(Path(path))
        laps.lap("load")
        solution = optimize_pose_graph(problem)
        laps.lap("solve")
        write_g2o(problem, Path(result), solution.poses)
        laps.lap("write")
        if laps.at - laps.begun > 60.0:
            break
    return laps


def _gtsam(path: str, result: str, initialise: bool) -> Laps:
    import gtsam

    laps = Laps()
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

    laps = Laps()
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
    return laps


if __name__ == "__main__":
    name, source, target = sys.argv[1:]
    done = {f.__name__: f for f in (vislam, gtsam_lm, gtsam_chordal_lm, g2o_lm)}[name](source, target)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    wall_s = time.perf_counter() - done.wall
    print(json.dumps({**done.seconds, "total": done.at - done.begun, "wall": wall_s, "peak_mb": peak_mb}))
