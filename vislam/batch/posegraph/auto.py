"""Which loops of a pose graph to believe, without a given method: several are tried, evidence decides.

Robust kernels of several shapes and scales, and gates that let loops in one by one, lead from odometry to solutions in
different places. Each is settled by `Judge`, which lets loops in and takes them back until all agree, and they are
compared by their marginal likelihood. Where two solutions contradict each other and the places that speak for one are
not clearly more than those that speak for the other, or where a cluster of loops is confirmed by nothing else and
hardly likelier true than false, nothing is decided: such loops stay out, and are named.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vislam.batch.posegraph.gnc import doubtful_edges, joining_edges, reject_false_edges
from vislam.batch.posegraph.judge import PLACE, Judge, Judgement, extent
from vislam.batch.posegraph.problem import Decision, PoseGraphProblem
from vislam.batch.posegraph.robust import Kernel, kernel_route
from vislam.batch.posegraph.solver import Progress, levenberg_marquardt
from vislam.batch.posegraph.starts import odometry_start
from vislam.batch.posegraph.structure import Structure
from vislam.config import PoseGraphConfig
from vislam.core.messages import Array

Mask = NDArray[np.bool_]

# the loops' chi2 at odometry of which quantile is the first scale: from the few that odometry can judge, or from many
_ROUTES: tuple[tuple[Kernel, float], ...] = (
    ("geman-mcclure", 0.05), ("dcs", 0.2), ("dcs", 0.05), ("geman-mcclure", 0.2), ("geman-mcclure", 0.02),
)  # fmt: skip
_IN = 0.25  # weight under a kernel from which on a loop is among those that are judged first
_KERNEL_QUANTILE = 0.05  # where one kernel alone is asked for
_SETTLED_MAX = 2  # solutions in different places that are followed to their end
_OVERSTATED = 0.1  # of the stated variances: where loops show less, all are rescaled before judging
_SAME_PLACE = 0.02  # of the extent: solutions that differ by less, rms, are one
_CLEAR = 1.5  # witnesses of a solution over those of its rival
_APART = 8.0  # log-likelihood between them, below which witnesses do not matter
_GAIN_MIN = 16.0  # of the objective, per number of a pose: what a solution must explain beyond odometry alone
_ALONE = 0.5  # leverage from which on nothing else confirms a loop
_THIN = 4.0  # log-odds of a cluster that stands alone, below which it is not believed
_NAMED = 5  # clusters in a message


def decide(problem: PoseGraphProblem, config: PoseGraphConfig, progress: Progress | None = None) -> Decision:
    """Return what evidence decides about the loops. Raises UsageError where the factor does not fit into memory.

    Variances that are stated far too large hide all evidence. So where nothing is decided, and loops that the gates of
    `reject_false_edges` take fit much better than stated, it is asked again with their scale.
    """
    decision = _decide(problem, config, progress)
    loops = doubtful_edges(problem)
    if not loops.any() or decision.weights[loops].any():
        return decision
    weights = reject_false_edges(Structure(problem), config, progress)
    kept = problem.with_edges(weights > 0.0)
    structure = Structure(kept)
    numbers = (len(kept.edges) - len(structure.free)) * problem.tangent
    if numbers <= 0:
        return decision
    ones = np.ones(len(kept.edges))
    fitted = levenberg_marquardt(
        structure, odometry_start(problem, structure.anchors), ones, iterations=20, tolerance=1e-6
    )
    scale = fitted.costs[-1] / numbers
    if not 0.0 < scale < _OVERSTATED:
        return decision
    again = _decide(replace(problem, information=problem.information / scale), config, progress)
    reason = f"{again.reason}; these on top of all variances times {scale:.3g}, which loops near odometry show"
    return replace(again, reason=reason) if again.weights[loops].any() else decision


def _decide(problem: PoseGraphProblem, config: PoseGraphConfig, progress: Progress | None) -> Decision:
    trusted = ~doubtful_edges(problem)
    trusted |= joining_edges(problem, trusted)
    chain = problem.with_edges(trusted)
    odometry = odometry_start(chain, chain.anchors())
    if trusted.all():
        return Decision(None, np.ones(len(trusted)), "there are no loops to doubt")
    judge = Judge(problem, trusted, odometry, config.inlier_probability)
    found = _solutions(problem, judge, trusted, odometry, progress)
    (best_name, best), rivals = found[0], found[1:]
    alone, _ = judge.objective(odometry, trusted)
    gain = alone - best.objective
    loops = np.flatnonzero(~trusted)
    held = int(best.kept[loops].sum())
    if held == 0 or gain < _GAIN_MIN:
        warning = (
            f"it is undecided which of the {len(loops)} loops are true: none is believed, odometry alone is the answer"
        )
        return Decision(odometry, trusted.astype(np.float64), "odometry alone", loops, warning)
    kept, poses = best.kept.copy(), best.poses
    disputed = _disputed(problem, best, rivals)
    thin = _thin(problem, best, trusted)
    undecided = np.flatnonzero(disputed | thin)
    kept[undecided] = False
    if np.any(disputed | thin):
        _, poses = judge.objective(poses, kept)
    reason = (
        f"{best_name}: {held} of {len(loops)} loops agree with odometry and each other"
        f" (log-likelihood {0.5 * gain:.4g} above odometry alone"
        + "".join(f"; {name} {0.5 * (j.objective - best.objective):.4g} below" for name, j in rivals[:2])
        + f"); variances of odometry {best.odometry_scale:.3g}, of loops {best.loop_scale:.3g} times those stated"
    )
    return Decision(poses, kept.astype(np.float64), reason, undecided, _warning(problem, disputed, thin))


def decide_by_kernel(problem: PoseGraphProblem, kernel: Kernel, progress: Progress | None = None) -> Decision:
    """Return the loops that one kernel leaves at least a quarter of their weight, from odometry."""
    trusted = ~doubtful_edges(problem)
    trusted |= joining_edges(problem, trusted)
    if trusted.all():
        return Decision(None, np.ones(len(trusted)), "there are no loops to doubt")
    chain = problem.with_edges(trusted)
    odometry = odometry_start(chain, chain.anchors())
    scale = float(np.quantile(problem.edge_chi2(odometry)[~trusted], _KERNEL_QUANTILE))
    led_to = kernel_route(problem, trusted, odometry, kernel, scale, False, progress)
    assert led_to is not None  # it does not give up
    poses, weights = led_to
    return Decision(poses, (weights >= _IN).astype(np.float64), f"the {kernel} kernel, as asked for")


def _solutions(
    problem: PoseGraphProblem, judge: Judge, trusted: Mask, odometry: Array, progress: Progress | None
) -> list[tuple[str, Judgement]]:
    """Return settled solutions in different places, the likeliest first, with the names of what led to them."""
    errors = problem.edge_chi2(odometry)[~trusted]
    first: list[tuple[float, str, Array, Mask]] = []
    for kernel, quantile in _ROUTES:
        scale = float(np.quantile(errors, quantile))
        led_to = kernel_route(problem, trusted, odometry, kernel, scale, len(first) > 0, progress)
        if led_to is None:
            continue
        poses, weights = led_to
        kept = trusted | (weights >= _IN)
        objective, poses = judge.objective(poses, kept)
        first.append((objective, f"{kernel} from the nearest {quantile:.0%}", poses, kept))
        if len(first) == 2 and _same(problem, first[0][2], poses):
            break
    first.sort(key=lambda entry: entry[0])
    settled: list[tuple[str, Judgement]] = []
    tried: list[Array] = []
    for _, name, poses, kept in first:
        if len(tried) == _SETTLED_MAX:
            break
        if any(_same(problem, poses, other) for other in tried):
            continue
        tried.append(poses)
        _add(problem, settled, name, judge.settle(poses, kept))
    if len(tried) > 1:  # kernels disagree: ask the gates too
        _add(problem, settled, "gates from odometry", judge.settle(odometry, trusted))
    return sorted(settled, key=lambda entry: entry[1].objective)


def _add(problem: PoseGraphProblem, settled: list[tuple[str, Judgement]], name: str, judgement: Judgement) -> None:
    """Add a solution, or put it in the place of a less likely one that is the same."""
    for i, (_, other) in enumerate(settled):
        if _same(problem, other.poses, judgement.poses):
            if judgement.objective < other.objective:
                settled[i] = (name, judgement)
            return
    settled.append((name, judgement))


def _same(problem: PoseGraphProblem, one: Array, other: Array) -> bool:
    d = problem.dimension
    apart = float(np.sqrt(np.mean(np.sum((one - other)[:, :d, d] ** 2, axis=1))))
    return apart <= _SAME_PLACE * extent(problem, one)


def _disputed(problem: PoseGraphProblem, best: Judgement, rivals: list[tuple[str, Judgement]]) -> Mask:
    """Return edges [E] over which a rival contradicts the best solution, where the places do not clearly decide."""
    out = np.zeros(len(best.kept), dtype=np.bool_)
    for _, rival in rivals:
        ours, theirs = best.kept & ~rival.kept, rival.kept & ~best.kept
        apart = 0.5 * (rival.objective - best.objective)
        if apart < _APART or _witnesses(problem, ours) < _CLEAR * _witnesses(problem, theirs):
            out |= ours | theirs
    return out


def _thin(problem: PoseGraphProblem, best: Judgement, trusted: Mask) -> Mask:
    """Return kept loops [E] of clusters that nothing else confirms and that are hardly likelier true than false."""
    at = np.flatnonzero(best.kept & ~trusted)
    cluster = _clusters(problem, at)
    out = np.zeros(len(trusted), dtype=np.bool_)
    count = np.bincount(cluster)
    alone = np.bincount(cluster, best.leverage[at]) >= _ALONE * count
    weak = np.bincount(cluster, best.evidence[at]) < _THIN
    out[at] = (alone & weak)[cluster]
    return out


def _clusters(problem: PoseGraphProblem, at: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the cluster of each of the edges `at`: chains of loops whose ends are near each other in time."""
    ends = np.sort(problem.edges[at], axis=1)
    pairs = cKDTree(ends).query_pairs(PLACE / 2, p=np.inf, output_type="ndarray") if len(at) else ends
    joined = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(at), len(at)))
    return connected_components(joined, directed=False)[1].astype(np.int64)


def _witnesses(problem: PoseGraphProblem, edges: Mask) -> int:
    """Return how many clusters edges [E] form, each counted once per place: witnesses independent of each other."""
    at = np.flatnonzero(edges)
    cluster, first = _clusters(problem, at), problem.edges[at].min(axis=1, initial=len(problem.ids))
    return int(sum(1 + np.ptp(first[cluster == c]) // PLACE for c in range(int(cluster.max(initial=-1)) + 1)))


def _warning(problem: PoseGraphProblem, disputed: Mask, thin: Mask) -> str:
    if not np.any(disputed | thin):
        return ""
    at = np.flatnonzero(disputed | thin)
    cluster = _clusters(problem, at)
    names = []
    for c in range(min(int(cluster.max()) + 1, _NAMED)):
        ids = problem.ids[np.sort(problem.edges[at[cluster == c]], axis=1)]
        (a, b), (e, f) = ids.min(axis=0).tolist(), ids.max(axis=0).tolist()
        names.append(f"{a}..{e} with {b}..{f} ({len(ids)})")
    more = int(cluster.max()) + 1 - len(names)
    why = "other loops contradict them as well as they agree" if disputed.any() else "nothing else confirms them"
    return (
        f"it is undecided whether {len(at)} loops are true, {why}; left out, poses "
        + ", ".join(names)
        + (f" and {more} more" if more > 0 else "")
        + "; loops between these places seen at other times, or smaller stated noise of odometry, would decide"
    )
