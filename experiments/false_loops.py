"""Half of the loops false, on a pose-graph file: which survive the graph, and what they cost.

    python experiments/false_loops.py parking-garage.g2o [--keyframes 1500] [--drift 1.5] [--groups 1 10 15] [--seed 0]

Takes a sample of the loops between the file's first keyframes, in their order, through the graph that a run has, with
as many false ones among them. Truth is the optimum of all edges of the file. The gate is that of the graph which true
loops alone gave, at its end: a false loop within it says what a true one could. Many files state sigmas that their
residuals contradict; unless `--sigmas stated`, each component is scaled by what is left of it at the optimum, which
leaves those of an honest file as they are. A graph in the plane is lifted into space: everything stays in the plane,
odometry and loops know tilt as well as heading, and height as well as place. `--drift` adds noise to odometry (and says
so to the graph), in units of 0.01 rad and 0.05 m per step; `--claimed` makes odometry say less than is true.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from vislam.batch.posegraph.files import read_pose_graph
from vislam.batch.posegraph.optimize import optimize_pose_graph
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.config import GraphConfig, MachineConfig, WindowConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import align_points, invert, se3_adjoint, se3_exp, transform_points
from vislam.core.messages import (
    Array,
    Frame,
    Keyframe,
    KeyframePacket,
    LoopDecision,
    LoopEdge,
    Tracking,
    VoMeasurement,
    no_observations,
)
from vislam.factors import LoopModel, loop_record
from vislam.graph import PoseGraph
from vislam.loop import FalseLoops, is_injected

_DRIFT_SIGMAS = np.repeat([0.01, 0.05], 3)  # of a step of odometry, per unit of drift
_FALSE_SIGMAS = np.repeat([0.05, 0.3], 3)  # of the pose that a false loop claims: two places that look alike
_APART = 30  # keyframes; nearer edges are no loops
_IN_PLANE = np.array([2, 3, 4])  # where angle, x, y are in a tangent of space
_HEADER = """
| false loops in groups of | true kept | lost beyond the gate | false kept | false within the gate | of these kept \
| ATE [m] | CPU p50 [ms] | p95 | p99 |
|---|---|---:|---|---:|---:|---:|---:|---:|---:|"""
_RIG = Rig((Camera(640, 480, 500.0, 500.0, 320.0, 240.0),), (np.eye(4),))
_CONFIG = GraphConfig(coupling="loose", vo_inflation=1.0, vo_floor_deg=0.0, vo_floor_m=0.0)


class PoseGraphFile:
    """Odometry, a sample of the loops, and the truth of the first keyframes of a file; they are 0, 1, 2, ..."""

    def __init__(self, path: Path, options: argparse.Namespace) -> None:
        problem = read_pose_graph(path)
        best = optimize_pose_graph(problem).poses
        count = min(options.keyframes or len(best), len(best))
        rng = np.random.default_rng(options.seed)
        residuals, covariances = problem.residuals(best), np.linalg.inv(problem.information)
        self.chi2_per_degree = float(np.sum(problem.edge_chi2(best))) / self._degrees(problem)
        sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        squares = np.sum((residuals / sigmas) ** 2, axis=0) * problem.tangent / self._degrees(problem)
        self.factors = np.sqrt(squares) if options.sigmas == "measured" else np.ones(problem.tangent)
        covariances = covariances * np.outer(self.factors, self.factors)
        self.is_plane = problem.dimension == 2
        truth, measured = best, problem.measurements
        if self.is_plane:
            truth, measured, covariances = _lifted(truth), _lifted(measured), _lifted_covariances(covariances)
        self.truth = truth[:count]
        self.motions = [np.eye(4), *(invert(a) @ b for a, b in zip(self.truth[:-1], self.truth[1:], strict=True))]
        self.covariances = np.tile(np.median(covariances, axis=0), (count, 1, 1))
        found = []
        for edge in zip(problem.edges.tolist(), measured, covariances, strict=True):
            a, b, T, covariance = _forward(*edge)
            if b == a + 1 and b < count:
                self.motions[b], self.covariances[b] = T, covariance
            elif b - a > _APART and b < count:
                found.append((a, b, T, covariance))
        if options.drift:
            noise = self.in_plane(_DRIFT_SIGMAS) * options.drift
            self.motions[1:] = [T @ se3_exp(rng.normal(size=6) * noise) for T in self.motions[1:]]
            self.covariances += np.diag((_DRIFT_SIGMAS * options.drift) ** 2)
        self.loops: dict[int, list[LoopEdge]] = {}
        for n, i in enumerate(sorted(rng.permutation(len(found))[: options.loops])):
            a, b, T, covariance = found[i]
            edge = LoopEdge(n, a, b, T, 0.5 * (covariance + covariance.T), True, 50, 0.5)
            self.loops.setdefault(b, []).append(edge)

    def in_plane(self, sigmas: Array) -> Array:
        """Return the sigmas [6] of a motion, none out of the plane where the file has none."""
        return np.where(np.isin(np.arange(6), _IN_PLANE), sigmas, 0.0) if self.is_plane else sigmas

    def packet(self, k: int, claimed: float) -> KeyframePacket:
        """Return what came with a keyframe; `claimed` is what odometry says of its sigmas, over the truth."""
        t_ns = k * 10**9
        covariance = self.covariances[k] * claimed**2
        vo = VoMeasurement(t_ns, max(k - 1, 0), self.motions[k], covariance, True, Tracking.OK, 100)
        keyframe = Keyframe(k, t_ns, Frame(t_ns, k, ()), np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None)
        return KeyframePacket(keyframe, vo, no_observations(), None)

    def error_m(self, poses: Array) -> float:
        """Return the root mean square of position errors after alignment."""
        moved = transform_points(align_points(poses[:, :3, 3], self.truth[:, :3, 3]), poses[:, :3, 3])
        return float(np.sqrt(np.mean(np.sum((moved - self.truth[:, :3, 3]) ** 2, axis=1))))

    def odometry_error_m(self) -> float:
        """Return the error of odometry without any loop."""
        poses = [self.truth[0]]
        for T in self.motions[1:]:
            poses.append(poses[-1] @ T)
        return self.error_m(np.array(poses))

    @staticmethod
    def _degrees(problem: PoseGraphProblem) -> int:
        """Return the degrees of freedom that a problem's residuals have at its optimum."""
        return (len(problem.edges) - len(problem.ids) + 1) * problem.tangent


def _forward(ends: list[int], T: Array, covariance: Array) -> tuple[int, int, Array, Array]:
    """Return ends, pose and covariance of an edge from the older to the newer keyframe."""
    a, b = ends
    if a < b:
        return a, b, T, covariance
    carry = se3_adjoint(T)
    return b, a, invert(T), carry @ covariance @ carry.T


def _lifted(poses: Array) -> Array:
    """Return poses [N, 4, 4] in space from those in the plane [N, 3, 3]."""
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :2, :2], T[:, :2, 3] = poses[:, :2, :2], poses[:, :2, 2]
    return T


def _lifted_covariances(covariances: Array) -> Array:
    """Return covariances [N, 6, 6] from those of angle, x and y."""
    out = np.zeros((len(covariances), 6, 6))
    out[:, 0, 0] = out[:, 1, 1] = covariances[:, 0, 0]
    out[:, 5, 5] = 0.5 * (covariances[:, 1, 1] + covariances[:, 2, 2])
    out[:, _IN_PLANE[:, None], _IN_PLANE] = covariances
    return out


class Outcome:
    """The file's keyframes through the graph, with false loops in groups; group 0: without."""

    def __init__(self, file: PoseGraphFile, group: int, claimed: float, seed: int) -> None:
        self.graph = PoseGraph(_CONFIG, None, MachineConfig(), _RIG, WindowConfig())
        self.graph.initialise(None, file.truth[0])
        false = FalseLoops(0.5, group, seed, file.in_plane(_FALSE_SIGMAS)) if group else None
        self.offered: dict[int, LoopEdge] = {}
        times_ms = []
        for k in range(len(file.truth)):
            true = file.loops.get(k, [])
            edges = [*true, *([] if false is None else false.add(file.truth[k], true))]
            self.offered |= {edge.id: edge for edge in edges}
            packet, start = file.packet(k, claimed), time.process_time()
            self.graph.add(packet, edges)
            times_ms.append(1e3 * (time.process_time() - start))
        self.graph.finish()
        self.kept = [r.loop_id for r in self.graph.edge_reports() if r.decision is LoopDecision.ACCEPTED]
        self.times_ms = np.percentile(times_ms, (50, 95, 99))

    def outside(self, clean: Outcome, ids: list[int]) -> int:
        """Return how many of these loops the graph of all true ones tells from true ones, by its gate."""
        count, poses = 0, clean.graph.poses()
        for edge in (self.offered[n] for n in ids):
            model = LoopModel(loop_record(edge, len(poses) - 1), _CONFIG, np.zeros(3))
            known = clean.graph.relative_covariance(edge.from_id, edge.to_id)
            count += model.chi2(poses[edge.from_id], poses[edge.to_id], known) > model.threshold
        return count

    def row(self, file: PoseGraphFile, group: int, clean: Outcome) -> str:
        """Return a line of the table."""
        true, false = ([n for n in self.offered if is_injected(n) == wrong] for wrong in (False, True))
        lost = [n for n in true if n not in self.kept]
        kept = [n for n in false if n in self.kept]
        inside = len(false) - self.outside(clean, false)
        p50, p95, p99 = self.times_ms
        return (
            f"| {group or 'none'} | {len(true) - len(lost)} of {len(true)} | {self.outside(clean, lost)} "
            f"| {len(kept)} of {len(false)} | {inside} | {len(kept) - self.outside(clean, kept)} "
            f"| {file.error_m(self.graph.poses()):.3f} | {p50:.1f} | {p95:.0f} | {p99:.0f} |"
        )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--keyframes", type=int, default=0, help="only the first so many; 0: all")
    parser.add_argument("--loops", type=int, default=300)
    parser.add_argument("--drift", type=float, default=0.0)
    parser.add_argument("--claimed", type=float, default=1.0)
    parser.add_argument("--sigmas", choices=["measured", "stated"], default="measured")
    parser.add_argument("--groups", type=int, nargs="+", default=[1, 10, 15])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    file = PoseGraphFile(options.file, options)
    print(f"{options.file.name}, {len(file.truth)} keyframes, chi2 per degree of freedom {file.chi2_per_degree:.2g}")
    print(f"sigmas: those stated times {np.array2string(file.factors, precision=3)}")
    print(f"drift {options.drift}, odometry alone errs {file.odometry_error_m():.2f} m")
    print(_HEADER)
    clean = Outcome(file, 0, options.claimed, options.seed)
    print(clean.row(file, 0, clean), flush=True)
    for group in options.groups:
        print(Outcome(file, group, options.claimed, options.seed).row(file, group, clean), flush=True)


if __name__ == "__main__":
    main()
