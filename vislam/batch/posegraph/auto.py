"""Which loops of a pose graph to believe, without a given method: several are tried, evidence decides.

All edges, a robust kernel, graduated non-convexity, and odometry alone lead to solutions in different places. Each is
settled by `Judge`, which lets loops in and takes them back until all agree, and they are compared by their marginal
likelihood. Loops within the noise stated, which only the smaller noise of the others speaks against, are kept as its
tails. Where two solutions contradict each other and are hardly less likely than each other, or where a cluster of loops
is confirmed by nothing else and hardly likelier true than false, nothing is decided: such loops stay out, and are
named.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from vislam.batch.posegraph.gnc import reject_false_edges, trusted_edges
from vislam.batch.posegraph.judge import Judge, Judgement
from vislam.batch.posegraph.problem import Decision, PoseGraphProblem
from vislam.batch.posegraph.solver import Kernel, Progress, kernel_route, levenberg_marquardt
from vislam.batch.posegraph.starts import chordal_start, odometry_start
from vislam.batch.posegraph.structure import Structure
from vislam.config import PoseGraphConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.messages import Array
from vislam.factors.loop_evidence import APART, PLACE, SOUND, extent

Mask = NDArray[np.bool_]

_IN = 0.25  # weight under a kernel from which on a loop is among those that are judged first
_QUANTILE = 0.2  # of the loops' chi2 at odometry: a kernel's first scale
_KERNEL_QUANTILE = 0.05  # where one kernel alone is asked for
_BEYOND_SHARE = 0.01  # of loops beyond what noise allows, up to which all may be true
_TAILS = 16.0  # times the limit of a loop within the noise stated, with the noise that others show
_MORE_OFTEN = 1.5  # loops of the place seen most often, over those of any that is lost
_ITERATIONS, _TOLERANCE = 20, 1e-5
_NEARLY_ALL = 0.97  # of the loops kept, from which on nothing else is tried
_OVERSTATED = 0.1  # of the stated variances: where loops show less, all are rescaled before judging
_NUMBERS_MIN = 30  # redundant ones, to show it
_SAME_PLACE = 0.02  # of the extent: solutions that differ by less, rms, are one
_GAIN_MIN = 6.0  # of the objective: what a solution must explain beyond odometry alone, if all others contradict it
_ALONE = 0.5  # leverage from which on nothing else confirms a loop
_NAMED = 5  # clusters in a message


def decide(
    problem: PoseGraphProblem, config: PoseGraphConfig, progress: Progress | None = None, doubtful: Mask | None = None
) -> Decision:
    """Return what evidence decides about the loops, or about edges `doubtful` [E].

    Variances that are stated far too large hide all evidence. So where loops that graduated non-convexity believes fit
    much better than stated, all is judged with their scale. Raises UsageError where the factor does not fit into
    memory.
    """
    structure = Structure(problem, config.equations)
    trusted = trusted_edges(problem, doubtful)
    weights, poses = reject_false_edges(structure, trusted, config.inlier_probability, progress)
    numbers = (int(weights.sum()) - len(structure.free)) * problem.tangent
    scale = problem.chi2(poses, weights) / max(numbers, 1)
    reason = ""
    if numbers >= _NUMBERS_MIN and 0.0 < scale < _OVERSTATED:
        problem = replace(problem, information=problem.information / scale)
        reason = f"; these on top of all variances times {scale:.3g}, which loops show"
    gnc = Decision(poses, weights, "graduated non-convexity")
    decision = _decide(structure, problem, trusted, gnc, config)
    return replace(decision, reason=decision.reason + reason)


def _decide(
    structure: Structure, problem: PoseGraphProblem, trusted: Mask, gnc: Decision, config: PoseGraphConfig
) -> Decision:
    """Return what evidence decides about the loops of `problem`, the structure's with noise that fits."""
    chain = problem.with_edges(trusted)
    odometry = odometry_start(chain, chain.anchors())
    if trusted.all():
        return Decision(None, np.ones(len(trusted)), "there are no loops to doubt")
    judge = Judge(problem, trusted, odometry, config.inlier_probability)
    assert gnc.poses is not None
    plain = _plain(structure.problem, trusted, gnc.poses, config.inlier_probability)
    alone = judge.objective(odometry, trusted)
    found = _solutions(problem, judge, trusted, _routes(problem, trusted, odometry, plain, gnc), alone)
    loops = np.flatnonzero(~trusted)
    (best_name, best), others = found[0], [(name, j) for name, j in found[1:] if np.any(j.kept & ~trusted)]
    rivals = [(name, j) for name, j in others if j.is_likelier(alone)]
    gain = alone - best.objective
    held, lost = best.kept & ~trusted, ~best.kept
    if not held.any() or not _is_enough(problem, judge, gain, held, lost):
        warning = (
            f"it is undecided which of the {len(loops)} loops are true: {_contest(problem, judge, held, lost)}; none "
            "is believed, odometry alone is the answer"
        )
        return Decision(odometry, trusted.astype(np.float64), "odometry alone", loops, warning)
    tails = lost & _tails(structure.problem, problem, best, plain, config)
    kept, poses = best.kept | tails, best.poses
    disputed = _disputed(best, [rival for _, rival in rivals if not _same(problem, rival.poses, best.poses)])
    thin = _thin(problem, best, trusted) & bool(np.any(lost & ~tails))
    undecided = np.flatnonzero(disputed | thin)
    kept[undecided] = False
    if np.any(disputed | thin | tails):
        poses = judge.optimum(poses, kept)
    reason = (
        f"{best_name}: {(kept & ~trusted).sum()} of {len(loops)} loops agree with odometry and each other"
        f" (log-likelihood {0.5 * gain:.4g} above odometry alone"
        + "".join(f"; {name} {0.5 * (j.objective - best.objective):.4g} below" for name, j in rivals[:2])
        + f"); variances of odometry {best.odometry_scale:.3g}, of loops {best.loop_scale:.3g} times those stated"
    )
    chance = f"chance may explain {best.supposed} of the loops kept, which agree with each other and few others"
    warning = "; ".join(filter(None, (_warning(problem, disputed, thin), chance if best.supposed else "")))
    return Decision(poses, kept.astype(np.float64), reason, undecided, warning)


def _plain(problem: PoseGraphProblem, trusted: Mask, poses: Array, probability: float) -> Array | None:
    """Return the optimum of all edges, if loops are off by no more than what is stated of their noise allows."""
    poses = _lowest(problem, poses, np.ones_like(trusted))
    beyond = problem.edge_chi2(poses)[~trusted] > chi_square_limit(probability, problem.tangent)
    return poses if beyond.mean() <= _BEYOND_SHARE else None


def _tails(
    stated: PoseGraphProblem, problem: PoseGraphProblem, best: Judgement, plain: Array | None, config: PoseGraphConfig
) -> Mask:
    """Return edges [E] that only noise smaller than stated, as others show it, speaks against.

    Where all edges lead to the same place as the best of them, those within the noise stated are its tails. Otherwise
    those that also are not too far off for what others show.
    """
    limit = chi_square_limit(config.inlier_probability, problem.tangent)
    if plain is not None and _same(problem, plain, best.poses):
        return stated.edge_chi2(plain) <= limit
    shown = problem.edge_chi2(best.poses) / best.loop_scale
    return (stated.edge_chi2(best.poses) <= limit) & (shown > limit) & (shown <= _TAILS * limit)


def _is_enough(problem: PoseGraphProblem, judge: Judge, gain: float, held: Mask, lost: Mask) -> bool:
    """Return whether the loops held [E] are to be believed, given their gain and those that contradict them.

    Chance makes single loops agree with odometry, so the more are lost, the more the others must explain. But it does
    not make a place seen so much more often than any that is lost.
    """
    true, false = judge.witnesses(held), judge.witnesses(lost)
    seen_more = _largest(problem, held) >= _MORE_OFTEN * _largest(problem, lost)
    return seen_more or gain >= _GAIN_MIN * false / (true + false)


def _largest(problem: PoseGraphProblem, edges: Mask) -> int:
    """Return how many loops the largest cluster of edges [E] has."""
    return int(np.bincount(_clusters(problem, np.flatnonzero(edges)), minlength=1).max())


def decide_by_kernel(problem: PoseGraphProblem, kernel: Kernel, progress: Progress | None = None) -> Decision:
    """Return the loops that one kernel leaves at least a quarter of their weight, from odometry."""
    trusted = trusted_edges(problem)
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
    problem: PoseGraphProblem, judge: Judge, trusted: Mask, routes: Iterable[tuple[str, Array, Mask]], alone: float
) -> list[tuple[str, Judgement]]:
    """Return settled solutions, the likeliest first, with the names of what led to them.

    One route after the other is followed, till two lead to the same place or one keeps nearly all loops. From odometry
    alone, whose objective is `alone`, the few that enter first may be too few for the others, so that some of these are
    supposed true, unless what is likelier leaves none in doubt.
    """
    settled: list[tuple[str, Judgement]] = []
    for name, poses, kept in routes:
        believed = [j for _, j in settled if j.is_likelier(alone)]
        if any(_same(problem, poses, j.poses) for j in believed):
            break
        found = judge.settle(poses, kept)
        if kept is trusted and not any(j.is_likelier(found.objective) and j.is_complete for j in believed):
            found = judge.supposing(found)
        settled.append((name, found))
        nearly_all = found.strain <= 1.0 and found.kept[~trusted].mean() >= _NEARLY_ALL
        if nearly_all or any(_same(problem, found.poses, j.poses) for j in believed):
            break

    def rank(of: tuple[str, Judgement]) -> tuple[bool, bool, float]:
        is_alone = not np.any(of[1].kept & ~trusted)  # what keeps no loop is likelier than odometry by rounding alone
        return is_alone or not of[1].is_likelier(alone), is_alone, of[1].objective

    return sorted(settled, key=rank)


def _routes(
    problem: PoseGraphProblem, trusted: Mask, odometry: Array, plain: Array | None, gnc: Decision
) -> Iterator[tuple[str, Array, Mask]]:
    """Yield names, poses and edges kept of what one route after the other leads to."""
    if plain is not None:
        yield "all edges", plain, np.ones_like(trusted)
    scale = float(np.quantile(problem.edge_chi2(odometry)[~trusted], _QUANTILE))
    led_to = kernel_route(problem, trusted, odometry, "dcs", scale, True)
    if led_to is not None:
        kept = trusted | (led_to[1] >= _IN)
        yield "dcs", _lowest(problem, led_to[0], kept), kept
    assert gnc.poses is not None
    yield gnc.reason, _lowest(problem, gnc.poses, gnc.weights > 0.0), gnc.weights > 0.0
    yield "odometry", odometry, trusted


def _lowest(problem: PoseGraphProblem, poses: Array, kept: Mask) -> Array:
    """Return the optimum of lower cost of the edges kept: that near poses, or that near the chordal relaxation.

    A route that ends with true loops alone may still have gone into another valley than theirs.
    """
    structure, ones = Structure(problem.with_edges(kept)), np.ones(int(kept.sum()))
    ends = [
        levenberg_marquardt(structure, start, ones, iterations=_ITERATIONS, tolerance=_TOLERANCE)
        for start in (poses, chordal_start(structure, ones))
    ]
    return min(ends, key=lambda end: end.costs[-1]).poses


def _same(problem: PoseGraphProblem, one: Array, other: Array) -> bool:
    d = problem.dimension
    apart = float(np.sqrt(np.mean(np.sum((one - other)[:, :d, d] ** 2, axis=1))))
    return apart <= _SAME_PLACE * extent(one[:, :d, d])


def _disputed(best: Judgement, rivals: list[Judgement]) -> Mask:
    """Return edges [E] over which a rival contradicts the best solution and is hardly less likely."""
    out = np.zeros(len(best.kept), dtype=np.bool_)
    for rival in rivals:
        ours, theirs = best.kept & ~rival.kept, rival.kept & ~best.kept
        if theirs.any() and 0.5 * (rival.objective - best.objective) < APART:
            out |= ours | theirs
    return out


def _thin(problem: PoseGraphProblem, best: Judgement, trusted: Mask) -> Mask:
    """Return kept loops [E] of clusters that nothing else confirms and that are hardly likelier true than false."""
    at = np.flatnonzero(best.kept & ~trusted)
    cluster = _clusters(problem, at)
    out = np.zeros(len(trusted), dtype=np.bool_)
    count = np.bincount(cluster)
    alone = np.bincount(cluster, best.leverage[at]) >= _ALONE * count
    weak = np.bincount(cluster, best.evidence[at]) < SOUND
    out[at] = (alone & weak)[cluster]
    return out


def _clusters(problem: PoseGraphProblem, at: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the cluster of each of the edges `at`: chains of loops whose ends are near each other in time."""
    ends = np.sort(problem.edges[at], axis=1)
    pairs = cKDTree(ends).query_pairs(PLACE, p=np.inf, output_type="ndarray") if len(at) else ends
    joined = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(at), len(at)))
    return connected_components(joined, directed=False)[1].astype(np.int64)


def _contest(problem: PoseGraphProblem, judge: Judge, held: Mask, lost: Mask) -> str:
    """Return between what it is undecided."""
    if not held.any():
        return f"none of {judge.witnesses(lost)} places agrees with odometry"
    agree, others = judge.witnesses(held), judge.witnesses(lost)
    return f"loops of {agree} places agree with odometry and each other, those of {others} with neither"


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
