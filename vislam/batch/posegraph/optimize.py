"""A pose graph optimised: where to start, and which edges to believe."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.auto import decide, decide_by_kernel
from vislam.batch.posegraph.domains import Team, solve_by_domains
from vislam.batch.posegraph.gnc import reject_false_edges, trusted_edges
from vislam.batch.posegraph.plain import Plain, descend, solve
from vislam.batch.posegraph.problem import Decision, Ids, PoseGraphProblem
from vislam.batch.posegraph.sightings import reject_false_sightings, undetermined_landmarks, undetermined_message
from vislam.batch.posegraph.solver import Progress
from vislam.batch.posegraph.starts import file_start
from vislam.batch.posegraph.structure import Structure
from vislam.config import PoseGraphConfig
from vislam.core.blas import on_one_blas_thread
from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import UsageError
from vislam.core.messages import Array

_BEYOND_MIN, _BEYOND_SHARE = 2, 0.01  # loops beyond what noise allows, which one in a thousand is, to be warned of


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
    robust_reason: str = ""  # why these edges were kept
    undecided: tuple[int, ...] = ()  # edges left out because it is undecided whether they are true

    def __repr__(self) -> str:
        end = "converged" if self.converged else "not converged"
        costs = f"chi2 {self.costs[0]:.6g} to {self.costs[-1]:.6g}" if self.costs else "no cost"
        left_out = f", {len(self.rejected)} of {len(self.weights)} edges rejected" if len(self.rejected) else ""
        return (
            f"PoseGraphSolution({len(self.poses)} poses, {costs} in {len(self.costs) - 1} iterations, {end}{left_out})"
        )

    @property
    def rejected(self) -> NDArray[np.int64]:
        """Indices of the edges that were found false."""
        return np.flatnonzero(self.weights == 0.0)


@on_one_blas_thread
def optimize_pose_graph(
    problem: PoseGraphProblem,
    config: PoseGraphConfig | None = None,
    progress: Progress | None = None,
    team: Team | None = None,
) -> PoseGraphSolution:
    """Return the poses of lowest chi2 (see `PoseGraphProblem`) found from the chosen start.

    One pose of each connected part keeps its value, fixed poses all do. Deterministic. Raises DataError when the graph
    has no finite cost anywhere, UsageError for a start that the graph cannot have, and where the
    search for false edges needs a factor that does not fit. `team`: who solves the graph by overlapping domains; None:
    it is solved as a whole.
    """
    config = config or PoseGraphConfig()
    begun = time.process_time()
    weights, decision, kept = np.ones(len(problem.edges)), None, problem
    if config.robust != "none":
        decision = _decision(Structure(problem, config.equations), config, progress)
        weights = decision.weights
        kept = problem.with_edges(weights != 0.0)
    decided = None if decision is None or config.start != "auto" else decision.poses
    plain = (
        _as_a_whole(kept, decided, config, progress)
        if team is None
        else _by_domains(kept, decided, config, progress, team)
    )
    labels, descent = kept.components(), plain.descent
    parts = int(labels.max(initial=-1)) + 1
    free = undetermined_landmarks(problem, descent.poses, weights) if problem.is_point.any() else problem.ids[:0]
    notes = [*problem.notes, *([undetermined_message(free)] if len(free) else [])]
    if config.robust != "auto":
        notes += _of_loops(problem, descent.poses, weights, config.inlier_probability)
    if decision is not None and decision.warning:
        notes.append(decision.warning)
    if plain.note:
        notes.append(plain.note)
    if parts > 1:
        notes.append(f"{parts} parts that no edge joins, each with a pose of its own that keeps its value")
    if not descent.converged:
        notes.append("not converged: give more --iterations or another --start")
    return PoseGraphSolution(
        descent.poses, plain.start, plain.start_name, plain.start_costs, descent.costs, descent.converged, weights,
        kept.anchors_of(labels), parts, tuple(notes), time.process_time() - begun,
        "" if decision is None else decision.reason, () if decision is None else tuple(decision.undecided.tolist()),
    )  # fmt: skip


def _as_a_whole(
    problem: PoseGraphProblem, decided: Array | None, config: PoseGraphConfig, progress: Progress | None
) -> Plain:
    """Return the answer that believes all edges, from the poses [N, d + 1, d + 1] that were `decided` if they serve."""
    structure = Structure(problem, config.equations)
    if decided is None:
        return solve(structure, config, progress)
    descent = descend(structure, decided, config, progress)
    robust = Plain("robust", decided, {"robust": descent.costs[0]}, descent, "")
    if descent.converged:
        return robust
    return min(solve(structure, config, progress), robust, key=lambda answer: answer.descent.costs[-1])


def _by_domains(
    problem: PoseGraphProblem, decided: Array | None, config: PoseGraphConfig, progress: Progress | None, team: Team
) -> Plain:
    """Return the same, solved by domains. Raises UsageError for what they cannot."""
    if not problem.of_poses:
        raise UsageError("domains are of poses alone, but this graph has landmarks or priors: solve it as a whole")
    if config.start not in ("auto", "file"):
        raise UsageError("domains are solved with --start auto or file, or else the graph as a whole")
    name, start = ("domains", None) if decided is None else ("robust", decided)
    if config.start == "file":
        name, start = "file", file_start(problem)
    start, descent = solve_by_domains(
        problem, team, iterations=config.iterations, tolerance=config.tolerance, start=start, progress=progress
    )
    return Plain(name, start, {name: descent.costs[0]}, descent, "")


def as_stated(problem: PoseGraphProblem, weights: NDArray[np.float64]) -> tuple[Array, float] | None:
    """Return the poses [N, d + 1, d + 1] that a file states, missing ones chained to them, and their cost.

    The cost counts `weights` [E], so that it can be held against that of a solution; None where the file states no
    poses, or these have no finite cost.
    """
    if not problem.has_pose.any():
        return None
    poses = file_start(problem)
    cost = problem.chi2(poses, weights)
    return (poses, cost) if np.isfinite(cost) else None


def _decision(structure: Structure, config: PoseGraphConfig, progress: Progress | None) -> Decision:
    """Return what the route that was asked for finds of the edges."""
    if not structure.problem.of_poses:
        return reject_false_sightings(structure.problem, config, progress)
    if config.robust == "auto":
        return decide(structure.problem, config, progress)
    if config.robust in ("cauchy", "geman-mcclure", "dcs"):
        return decide_by_kernel(structure.problem, config.robust, progress)
    trusted = trusted_edges(structure.problem)
    weights, _ = reject_false_edges(structure, trusted, config.inlier_probability, progress)
    return Decision(None, weights, "graduated non-convexity, as asked for")


def _of_loops(problem: PoseGraphProblem, poses: Array, weights: Array, probability: float) -> list[str]:
    """Return what to warn of where loops contradict each other or odometry, and nothing has judged them."""
    loops = np.abs(np.diff(problem.edges, axis=1)[:, 0]) != 1
    kept = loops & (weights != 0.0)
    beyond = int((problem.edge_chi2(poses)[kept] > chi_square_limit(probability, problem.tangent)).sum())
    notes = []
    if beyond >= max(_BEYOND_MIN, _BEYOND_SHARE * kept.sum()):
        notes.append(
            f"{beyond} of {kept.sum()} edges beside odometry are off by more than their noise allows: some are false, "
            "which --robust auto finds, or the noise is stated too small, which --rescale-noise corrects"
        )
    if 2 * kept.sum() < loops.sum():
        notes.append(
            f"{kept.sum()} of {loops.sum()} edges beside odometry are kept: the few may agree by chance and end worse "
            "than odometry; --robust auto judges this"
        )
    return notes
