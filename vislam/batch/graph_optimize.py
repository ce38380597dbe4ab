"""A pose graph optimised: where to start, by which method, and which edges to believe."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.batch.graph_problem import Ids, PoseGraphProblem
from vislam.batch.graph_solver import Descent, Progress, dogleg, levenberg_marquardt
from vislam.batch.graph_starts import angles_start, chordal_start, file_start, odometry_start, tree_start
from vislam.batch.graph_structure import Structure
from vislam.config import PoseGraphConfig
from vislam.errors import DataError, UsageError
from vislam.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraphSolution:
    """What the optimisation of a pose graph came to."""

    poses: Array  # [N, d + 1, d + 1]
    start: Array  # [N, d + 1, d + 1] from which it went
    start_name: str
    start_costs: dict[str, float]  # of each start that was tried
    costs: tuple[float, ...]  # chi2 at the start and after each iteration, of the edges kept
    converged: bool
    weights: Array  # [E] 1 kept, 0 rejected
    anchors: Ids  # poses (indices) that kept their value
    parts: int  # connected parts, each with an anchor
    notes: tuple[str, ...]
    solve_s: float  # process time

    @property
    def rejected(self) -> NDArray[np.int64]:
        """Indices of the edges that were found false."""
        return np.flatnonzero(self.weights == 0.0)


def optimize_pose_graph(
    problem: PoseGraphProblem, config: PoseGraphConfig | None = None, progress: Progress | None = None
) -> PoseGraphSolution:
    """Return the poses of lowest chi2 (see `PoseGraphProblem`) that the method finds from the chosen start.

    One pose of each connected part keeps its value, fixed poses all do. Deterministic. Raises DataError when the graph
    has no finite cost anywhere or the method fails, UsageError for a start that the graph cannot have, and where the
    search for false edges needs a factor that does not fit.
    """
    config = config or PoseGraphConfig()
    begun = time.process_time()
    structure = Structure(problem, config.equations)
    weights = np.ones(len(problem.edges))
    if config.robust == "gnc":
        from vislam.batch.graph_gnc import reject_false_edges

        weights = reject_false_edges(structure, config, progress)
        structure = Structure(without_edges(problem, weights == 0.0), config.equations)
    start_name, start, start_costs = _start(structure, config)
    descent = _descend(structure, start, config, progress)
    parts = structure.parts
    notes = list(problem.notes)
    if parts > 1:
        notes.append(f"{parts} parts that no edge joins, each with a pose of its own that keeps its value")
    if not descent.converged:
        notes.append("not converged: give more --iterations, another --start or --method")
    return PoseGraphSolution(
        descent.poses, start, start_name, start_costs, descent.costs, descent.converged, weights, structure.anchors,
        parts, tuple(notes), time.process_time() - begun,
    )  # fmt: skip


def without_edges(problem: PoseGraphProblem, left_out: NDArray[np.bool_]) -> PoseGraphProblem:
    """Return the problem without some edges [E]."""
    if not left_out.any():
        return problem
    keep = ~left_out
    return PoseGraphProblem(
        problem.dimension, problem.ids, problem.poses, problem.fixed, problem.edges[keep], problem.measurements[keep],
        problem.information[keep], problem.passed_lines, problem.notes,
    )  # fmt: skip


def _start(structure: Structure, config: PoseGraphConfig) -> tuple[str, Array, dict[str, float]]:
    """Return the name, the poses and the costs of the starts asked for; of several the one of lowest cost."""
    problem = structure.problem
    ones = np.ones(len(problem.edges))
    makers: dict[str, Callable[[], Array]] = {
        "chordal": lambda: chordal_start(structure, ones),
        "angles": lambda: angles_start(structure, ones),
        "tree": lambda: tree_start(problem, structure.anchors),
        "odometry": lambda: odometry_start(problem, structure.anchors),
        "file": lambda: file_start(problem),
    }
    if problem.dimension == 3:
        del makers["angles"]
    if config.start != "auto" and config.start not in makers:
        raise UsageError(f"start '{config.start}' is for graphs in the plane; for this one: {', '.join(makers)}")
    if config.start != "auto":
        makers = {config.start: makers[config.start]}
    elif not problem.has_pose.any():
        del makers["file"]
    best: tuple[float, str, Array] | None = None
    costs: dict[str, float] = {}
    for name, make in makers.items():
        poses = make()
        costs[name] = problem.chi2(poses)
        if np.isfinite(costs[name]) and (best is None or costs[name] < best[0]):
            best = (costs[name], name, poses)
    if best is None:
        raise DataError("the graph has no finite cost at any start; are its measurements too large?")
    return best[1], best[2], costs


def _descend(structure: Structure, start: Array, config: PoseGraphConfig, progress: Progress | None) -> Descent:
    problem, weights = structure.problem, np.ones(len(structure.problem.edges))
    if config.method in ("lm", "dogleg"):
        native = levenberg_marquardt if config.method == "lm" else dogleg
        return native(
            structure, start, weights, iterations=config.iterations, tolerance=config.tolerance, progress=progress
        )  # fmt: skip
    from vislam.batch.graph_gtsam import gtsam_levenberg_marquardt, isam2_replay

    if config.method == "isam2":
        return isam2_replay(problem, start, weights, progress=progress)
    return gtsam_levenberg_marquardt(
        problem, start, weights, iterations=config.iterations, tolerance=config.tolerance, progress=progress
    )  # fmt: skip
