"""Pose graph files as edges in key order, and their cost as their own residuals have it."""

from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from vislam.core.messages import Array
from vislam.graph import Graph

# chi-square (2 x gtsam's error) of the best known solution
BEST_CHI2 = {
    "tinyGrid3D": None,
    "smallGrid3D": 1035.8507,
    "intel": 45.0042,
    "MIT": 41.2069,
    "M3500": 137.9149,
    "manhattan": 3549.041,  # the graph of M3500 with another noise
    "parking-garage": 1.268385,
    "sphere2500": 1351.4019,
}


@dataclass(frozen=True)
class Edge:
    """A relative pose [4, 4] with its covariance [6, 6]."""

    from_id: int
    to_id: int
    T_from_to: Array
    covariance: Array


class EdgeFile:
    """A g2o file; planar ones lie in the z = 0 plane of space, where their in-plane cost is unchanged."""

    def __init__(self, path: Path) -> None:
        with path.open(encoding="ascii") as lines:
            self.planar = "SE2" in next(lines)
        self.graph, self.values = gtsam.readG2o(str(path), not self.planar)
        self.count = self.values.size()
        self._odometry: list[Edge | None] = [None] * self.count
        self._loops: list[list[Edge]] = [[] for _ in range(self.count)]
        for n in range(self.graph.size()):
            edge = self._between(n)
            newer = max(edge.from_id, edge.to_id)
            if abs(edge.from_id - edge.to_id) == 1 and self._odometry[newer] is None:
                self._odometry[newer] = edge
            else:
                self._loops[newer].append(edge)

    def _between(self, n: int) -> Edge:
        factor = self.graph.at(n)
        a, b = factor.keys()
        measured = factor.measured()
        own = np.asarray(factor.noiseModel().covariance())
        if not self.planar:
            return Edge(a, b, np.asarray(measured.matrix()), own)
        T = np.eye(4)
        T[:2, :2], T[:2, 3] = measured.matrix()[:2, :2], measured.matrix()[:2, 2]
        covariance = np.eye(6) * np.trace(own) / 3.0
        plane = [3, 4, 2]  # x, y, yaw
        covariance[np.ix_(plane, plane)] = own
        return Edge(a, b, T, covariance)

    def replay(self, graph: Graph, meter=None) -> list[str]:
        """Add all keyframes with their edges, one at a time; return the notes."""
        notes = []
        graph.prior(graph.add_pose(), np.eye(4), (1e-3, 1e-3))
        for k in range(1, self.count):
            odometry = self._odometry[k]
            assert odometry is not None
            if meter is not None:
                meter.start()
            graph.add_pose()
            for edge in (odometry, *self._loops[k]):
                graph.between(edge.from_id, edge.to_id, edge.T_from_to, edge.covariance)
            note = graph.optimise(incremental=True).note
            if meter is not None:
                meter.stop(note)
            notes += [f"{k}: {note}"] * bool(note)
        return notes

    def chi2(self, poses: Array) -> float:
        """Return the cost of poses under the file's own factors."""
        values = gtsam.Values()
        for k, T in enumerate(poses):
            if self.planar:
                values.insert(k, gtsam.Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])))
            else:
                values.insert(k, gtsam.Pose3(T))
        return 2.0 * self.graph.error(values)

    def optimum_from(self, poses: Array) -> float:
        """Return the chi-square that batch Levenberg-Marquardt reaches from poses."""
        values = gtsam.Values()
        for k, T in enumerate(poses):
            values.insert(
                k, gtsam.Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])) if self.planar else gtsam.Pose3(T)
            )
        prior = (
            gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))
            if self.planar
            else (gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
        )
        graph = gtsam.NonlinearFactorGraph(self.graph)
        graph.add(prior)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(200)
        params.setRelativeErrorTol(1e-10)
        return 2.0 * self.graph.error(gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize())
