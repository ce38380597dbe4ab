"""Half of the loops false, on a pose graph file: which survive the graph, and what they cost.

    python experiments/false_loops.py parking-garage.g2o [--drift 1.5] [--groups 0 1 10 15] [--seed 0]

Takes a sample of the file's loops, in the order of the keyframes, through the graph that a run has, with as many false
ones among them. Truth is the optimum of all loops of the file. `--drift` adds noise to odometry (and says so to the
graph), in units of 0.01 rad and 0.05 m per step; `--claimed` makes odometry say less than is true.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import gtsam
import numpy as np

from vislam.camera import Camera, Rig
from vislam.config import GraphConfig, WindowConfig
from vislam.geometry import align_points, invert, se3_exp, transform_points
from vislam.graph import PoseGraph
from vislam.loop.injection import FIRST_ID, FalseLoops
from vislam.messages import (
    Frame,
    Keyframe,
    KeyframePacket,
    LoopDecision,
    LoopEdge,
    Observations,
    Tracking,
    VoMeasurement,
)

_SIGMAS = np.repeat([0.01, 0.05], 3)  # of a step of odometry, and of a loop
_APART = 30  # keyframes; nearer edges are no loops
_RIG = Rig((Camera(640, 480, 500.0, 500.0, 320.0, 240.0),), (np.eye(4),))
_CONFIG = GraphConfig(coupling="loose", vo_inflation=1.0, vo_floor_deg=0.0, vo_floor_m=0.0)


class PoseGraphFile:
    """Odometry, a sample of the loops, and the truth of a g2o file in space; the keyframes are 0, 1, 2, ..."""

    def __init__(self, path: Path, loops: int, drift: float, seed: int) -> None:
        graph, values = gtsam.readG2o(str(path), True)
        count = values.size()
        rng = np.random.default_rng(seed)
        anchored = gtsam.NonlinearFactorGraph(graph)
        anchored.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
        best = gtsam.LevenbergMarquardtOptimizer(anchored, values).optimize()
        self.truth = np.array([best.atPose3(k).matrix() for k in range(count)])
        self.motions = [np.eye(4), *(invert(a) @ b for a, b in zip(self.truth[:-1], self.truth[1:], strict=True))]
        found = []
        for n in range(graph.size()):
            factor = graph.at(n)
            a, b = factor.keys()
            T = factor.measured().matrix()
            a, b, T = (a, b, T) if a < b else (b, a, invert(T))
            if b == a + 1:
                self.motions[b] = T
            elif b - a > _APART:
                found.append((a, b, T))
        if drift:
            self.motions[1:] = [T @ se3_exp(rng.normal(size=6) * _SIGMAS * drift) for T in self.motions[1:]]
        self.covariance = np.diag((_SIGMAS * np.hypot(1.0, drift)) ** 2)
        self.loops: dict[int, list[LoopEdge]] = {}
        for n, i in enumerate(sorted(rng.permutation(len(found))[:loops])):
            a, b, T = found[i]
            edge = LoopEdge(n, a, b, T, np.diag(_SIGMAS**2), True, 50, 0.5)
            self.loops.setdefault(b, []).append(edge)

    def packet(self, k: int, claimed: float) -> KeyframePacket:
        """Return what came with a keyframe; `claimed` is what odometry says of its sigmas, over the truth."""
        t_ns = k * 10**9
        covariance = self.covariance * claimed**2
        vo = VoMeasurement(t_ns, max(k - 1, 0), self.motions[k], covariance, True, Tracking.OK, 100)
        keyframe = Keyframe(k, t_ns, Frame(t_ns, k, ()), np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None)
        return KeyframePacket(keyframe, vo, Observations(np.zeros(0, np.int64), np.zeros((0, 2))), None)

    def error_m(self, poses: np.ndarray) -> float:
        """Return the root mean square of position errors after alignment."""
        moved = transform_points(align_points(poses[:, :3, 3], self.truth[:, :3, 3]), poses[:, :3, 3])
        return float(np.sqrt(np.mean(np.sum((moved - self.truth[:, :3, 3]) ** 2, axis=1))))

    def odometry_error_m(self) -> float:
        """Return the error of odometry without any loop."""
        poses = [self.truth[0]]
        for T in self.motions[1:]:
            poses.append(poses[-1] @ T)
        return self.error_m(np.array(poses))


def run(file: PoseGraphFile, group: int, claimed: float, seed: int) -> str:
    """Return a row of the table; group 0: no false loop."""
    graph = PoseGraph(_CONFIG, None, 9.81, _RIG, WindowConfig())
    graph.initialise(None, file.truth[0])
    false = FalseLoops(0.5, group, seed, turn_sigma_rad=0.05) if group else None
    offered, times_ms = [0, 0], []
    for k in range(len(file.truth)):
        true = file.loops.get(k, [])
        wrong = [] if false is None else false.add(file.truth[k], true)
        offered[0] += len(true)
        offered[1] += len(wrong)
        packet, start = file.packet(k, claimed), time.process_time()
        graph.add(packet, [*true, *wrong])
        times_ms.append(1e3 * (time.process_time() - start))
    graph.finish()
    kept = [r.loop_id < FIRST_ID for r in graph.edge_reports() if r.decision is LoopDecision.ACCEPTED]
    p50, p95, p99 = np.percentile(times_ms, (50, 95, 99))
    return (
        f"| {group or 'none'} | {sum(kept)} of {offered[0]} | {len(kept) - sum(kept)} of {offered[1]} "
        f"| {file.error_m(graph.poses()):.3f} | {p50:.1f} | {p95:.0f} | {p99:.0f} |"
    )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--loops", type=int, default=300)
    parser.add_argument("--drift", type=float, default=0.0)
    parser.add_argument("--claimed", type=float, default=1.0)
    parser.add_argument("--groups", type=int, nargs="+", default=[0, 1, 10, 15])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    file = PoseGraphFile(options.file, options.loops, options.drift, options.seed)
    print(f"{options.file.name}, drift {options.drift}, odometry alone errs {file.odometry_error_m():.2f} m")
    print("| false loops in groups of | true kept | false kept | ATE [m] | CPU p50 [ms] | p95 | p99 |")
    print("|---|---|---|---|---|---|---|")
    for group in options.groups:
        print(run(file, group, options.claimed, options.seed), flush=True)


if __name__ == "__main__":
    main()
