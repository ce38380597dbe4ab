"""Which sightings of landmarks are false, and which landmarks nothing places.

A sighting that was put down to another landmark is what a false loop is among poses. The poses grow from the first one
under Cauchy's kernel, so that what most sightings agree on places a landmark, and graduated non-convexity decides from
there over each edge (`graduated_non_convexity`): growing alone, or deciding from what all sightings together made of
the poses, ends elsewhere where a twentieth of them is false.
"""

from __future__ import annotations

import numpy as np

from vislam.batch.posegraph.gnc import TAILS, graduated_non_convexity
from vislam.batch.posegraph.plain import grown_start
from vislam.batch.posegraph.problem import Decision, Ids, Mask, PoseGraphProblem
from vislam.batch.posegraph.solver import KERNEL_CHI2, Progress, kernel_weights
from vislam.batch.posegraph.structure import Structure
from vislam.config import PoseGraphConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import UsageError
from vislam.core.messages import Array

_CONSENSUS_MIN = 3  # sightings; of two it is undecidable which one is false
_TRIED = 64  # of a landmark's sightings, spread evenly over time
_UNKNOWN = 1e-9  # of the largest eigenvalue of what is known of a landmark: a direction that nothing measures


def reject_false_sightings(
    problem: PoseGraphProblem, config: PoseGraphConfig, progress: Progress | None = None
) -> Decision:
    """Return which edges of a graph with landmarks or priors to believe: never doubted are odometry and priors.

    Raises UsageError for a kernel that is not meant for them.
    """
    if config.robust not in ("auto", "gnc", "cauchy"):
        raise UsageError(f"--robust {config.robust} is for graphs of poses alone; with landmarks auto, gnc or cauchy")
    doubted = doubtful_sightings(problem)
    if not doubted.any():
        return Decision(None, np.ones(len(doubted)), "nothing but odometry and priors, which are believed")

    def reweigh(part: PoseGraphProblem, poses: Array, edges: Ids) -> tuple[Array, Array]:
        poses = with_landmarks_by_consensus(part, poses)
        return poses, np.where(doubted[edges], kernel_weights("cauchy", part.edge_chi2(poses), KERNEL_CHI2), 1.0)

    poses = with_landmarks_by_consensus(problem, grown_start(problem, reweigh))
    degrees = np.where(problem.is_position, problem.dimension, problem.tangent)
    limits = {int(k): TAILS * chi_square_limit(config.inlier_probability, int(k)) for k in np.unique(degrees)}
    limit = np.array([limits[k] for k in degrees.tolist()])
    weights, _ = graduated_non_convexity(Structure(problem), poses, ~doubted, limit, progress)
    return Decision(
        poses, weights, f"grown under Cauchy's kernel, then {config.robust}", warning=_lost(problem, weights)
    )


def with_landmarks_by_consensus(problem: PoseGraphProblem, poses: Array) -> Array:
    """Return poses [N, d + 1, d + 1] with landmarks where one of their sightings puts them, if others agree more there.

    Cauchy's cost weighs their agreement. Without it a landmark whose first sighting is false stays with that one: the
    true ones, far away, hardly pull.
    """
    d = problem.dimension
    at = np.flatnonzero(problem.is_position & problem.is_point[problem.edges[:, 1]] & (problem.edges[:, 0] >= 0))
    at = at[np.argsort(problem.edges[at, 1], kind="stable")]
    if not len(at):
        return poses
    seen = poses[problem.edges[at, 0]] @ problem.measurements[at]
    R = seen[:, :d, :d]
    W = R @ problem.information[at][:, -d:, -d:] @ R.transpose(0, 2, 1)
    out = poses.copy()
    begins = np.flatnonzero(np.diff(problem.edges[at, 1], prepend=-1))
    for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(at)], strict=True):
        landmark = int(problem.edges[at[begin], 1])
        if problem.fixed[landmark] or end - begin < _CONSENSUS_MIN:
            continue
        tried = begin + np.unique(np.linspace(0, end - begin - 1, _TRIED).astype(np.int64))
        candidates = np.concatenate([poses[landmark, None, :d, d], seen[tried, :d, d]])
        apart = candidates[:, None] - seen[None, begin:end, :d, d]
        chi2 = np.einsum("cea,eab,ceb->ce", apart, W[begin:end], apart, optimize=True)
        cost = np.log1p(chi2 / KERNEL_CHI2).sum(axis=1)
        if cost.min() < cost[0] - 1.0:  # a settled one is better than any single sighting by less
            out[landmark, :d, d] = candidates[int(np.argmin(cost))]
    return out


def doubtful_sightings(problem: PoseGraphProblem) -> Mask:
    """Return which edges [E] may be false: sightings of landmarks, and those between poses that are not successive."""
    rank = np.cumsum(problem.is_pose)
    odometry = problem.is_pose[problem.edges].all(axis=1) & (np.abs(np.diff(rank[problem.edges])[:, 0]) == 1)
    return ~odometry & (problem.edges != problem.world).all(axis=1)


def undetermined_landmarks(problem: PoseGraphProblem, poses: Array, weights: Array) -> Ids:
    """Return ids of landmarks that edges with `weights` [E] leave free along a direction, the poses [N] given."""
    d = problem.dimension
    at = np.flatnonzero(problem.is_position & (weights != 0.0) & problem.is_point[problem.edges[:, 1]])
    observer, landmark = problem.edges[at].T
    R = poses[observer, :d, :d] @ problem.measurements[at, :d, :d]
    known = np.zeros((len(problem.ids), d, d))
    np.add.at(known, landmark, R @ problem.information[at][:, -d:, -d:] @ R.transpose(0, 2, 1))
    seen = np.zeros(len(problem.ids), dtype=np.bool_)
    seen[landmark] = True
    values = np.linalg.eigvalsh(known)
    free = seen & ~problem.fixed & (values[:, 0] <= _UNKNOWN * values[:, -1])
    return np.asarray(problem.ids[free])


def undetermined_message(ids: Ids) -> str:
    """Return a sentence on landmarks that are undetermined."""
    return (
        f"{len(ids)} landmarks are seen along one direction only, as by range or bearing alone from one place (the "
        f"first: {ids[0]}); where they are across it is undetermined; see them from elsewhere or remove their lines"
    )


def _lost(problem: PoseGraphProblem, weights: Array) -> str:
    """Return a sentence on landmarks all of whose sightings were found false, empty where there are none."""
    seen = problem.is_position & problem.is_point[problem.edges[:, 1]]
    before, after = (np.unique(problem.edges[seen & kept, 1]) for kept in (True, weights != 0.0))
    lost = problem.ids[np.setdiff1d(before, after)]
    if not len(lost):
        return ""
    return (
        f"{len(lost)} landmarks lost all their sightings (the first: {lost[0]}), each a part of the graph by itself "
        "now; where they are means nothing"
    )
