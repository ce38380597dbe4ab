"""Judging loops one by one against the others: noise calibrated on those that agree, loops let in and taken back.

Every loop is tested by its innovation, the error that it has against a solution without it: for a loop that is in, the
solution's own residual and covariance give that (studentised residuals; Foerstner and Wrobel 2016, section 4.6). What
speaks for it is a Bayes factor: the density of the innovation if the loop is true, against that of a false one, which
may say anything in the space of the trajectory, times the share of true loops. Directions of which a loop knows
nothing, as the heading of one from places that only look alike, neither speak for it nor against it.

Loops between the same two places err together: what looked alike once looks alike in the next image, too. So however
many they are, they weigh as one, and a place that was seen often does not outweigh several that were seen once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.batch.posegraph.noise import covariances_of_edges, spread_out
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.solver import levenberg_marquardt
from vislam.batch.posegraph.structure import Structure
from vislam.core.chi_square import chi_square_limits
from vislam.core.messages import Array
from vislam.factors.loop_evidence import PLACE, SOUND, entering, extent, spread

Mask = NDArray[np.bool_]

_ROUNDS_MAX = 40
_KNOWN = 10.0  # information times the square of the space's spread: below, a direction is not known
_TAILS = 4.0  # times the chi-square limit: errors of real loops have heavier tails than a Gaussian
_WORST = 0.3  # of the worst score: the loops that leave with it; a bad one makes its neighbours look bad
_ODDS = math.log(3.0)  # a loop is believed that is three times likelier true than false: a false one harms more
_SUPPOSED_MAX = 6  # loops, one at a time, that are supposed true, the likeliest first, ...
_HARDLY = -3.0  # ... down to these log-odds
_CLEARLY = 16.0  # of the objective: what shows that one is true
_BACK = 2.0  # log-odds more for every time that it was taken back
_BORDER = 1.0  # log-odds: covariances of loops nearer to a decision are computed in every round
_CHANGED = 0.05  # of the loops kept: as many changes, and those of all are
_SAMPLE = 150  # edges of each kind whose covariances show the scales
_CALIBRATIONS = 4
_SETTLED = 0.2  # of the logarithm of a scale
_SCALE_MIN, _ODOMETRY_SCALE_MAX, _LOOP_SCALE_MAX = 1e-10, 4.0, 1.0
_LOOPS_BETTER = 0.1  # of odometry's scale: less shows loops that were made of odometry, or agree by chance
_SHARE_MIN = 0.1  # redundancy of odometry over its numbers: below, loops say little about its noise
_REDUNDANCY_MIN = 30.0  # numbers, to show the scale of odometry
_JUDGED_MIN = 5  # loops, to show theirs
_LEVERAGE_MAX = 1.0 - 1e-9
_ITERATIONS, _TOLERANCE = 10, 1e-5
_PLACE_WAY = 0.05  # of the extent: as far along the way a place reaches


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Loops and poses that agree with each other, and what speaks for each loop."""

    poses: Array  # [N, d + 1, d + 1]
    kept: Mask  # [E]
    odometry_scale: float  # factors on the stated variances
    loop_scale: float
    objective: float  # minus twice the logarithm of the marginal likelihood: lower explains more
    evidence: Array  # [E] log-odds that an edge is true; inf of those trusted
    leverage: Array  # [E] share of a kept loop in its own estimate: near 1 nothing else confirms it; 0: left out
    strain: float  # mean square of odometry's errors in its standard deviations: above 1, loops contradict it
    supposed: int = 0  # loops that were let in before anything spoke for them

    @property
    def is_complete(self) -> bool:
        """Whether no loop that was left out might be true."""
        return bool(np.all(self.kept | (self.evidence < _HARDLY)))

    def is_likelier(self, objective: float) -> bool:
        """Return whether it explains more than what has this objective, and does not contradict odometry."""
        return self.strain <= 1.0 and self.objective < objective


class Judge:
    """Judges sets of loops of one problem, with one idea of how large its space is."""

    def __init__(self, problem: PoseGraphProblem, trusted: Mask, poses: Array, probability: float) -> None:
        """Take the extent of `poses` [N, d + 1, d + 1] as the space in which a false loop may put a pose."""
        self._problem, self._trusted = problem, trusted
        self._loops = np.flatnonzero(~trusted)
        self._space_m, self._spread = extent(poses[:, :-1, -1]), spread(poses[:, :-1, -1])
        self._at = _along(problem, poses, _PLACE_WAY * self._space_m)
        values, self._axes = np.linalg.eigh(problem.information * np.outer(self._spread, self._spread))
        self._known = values > _KNOWN
        self._values = np.where(self._known, values, 1.0)
        self._dof = self._known.sum(axis=1)
        self._limit = _TAILS * chi_square_limits(probability, np.maximum(self._dof, 1))
        self._medians = chi_square_limits(0.5, np.maximum(self._dof, 1))
        self._tree = cKDTree(self._ends(self._loops)) if len(self._loops) else None
        # how many of the loops kept join the same two places as each loop, itself among them, and which these are
        self._alike, self._counted = np.zeros(len(self._loops)), np.zeros(len(self._loops), dtype=np.bool_)
        self._newest: tuple[Mask, Structure, Array] | None = None  # of the edges kept that were asked for last

    def supposing(self, found: Judgement) -> Judgement:
        """Return what a settled solution grows to where loops are supposed true that nothing decides about.

        Several may agree with each other, and what is kept on as little evidence may be what contradicts them. So that
        is taken out, and the likeliest of those left out are let in, each on its own.
        """
        first, best = found, None
        while best is not found:
            best, core = found, found
            if best.evidence[best.kept].min() < SOUND:  # it may have to go before others can come
                core = self.settle(best.poses, best.kept & (best.evidence >= SOUND), 0)
            evidence = np.where(best.kept, -np.inf, core.evidence)
            for e in np.argsort(-evidence, kind="stable")[:_SUPPOSED_MAX].tolist():
                if evidence[e] < _HARDLY or best.objective - found.objective > _CLEARLY:
                    break
                kept = core.kept.copy()
                kept[e] = True
                settled = self.settle(core.poses, kept)
                if settled.objective < found.objective - _BORDER:
                    found = settled
        return replace(found, supposed=int(np.count_nonzero(found.kept & ~first.kept)))

    def settle(self, poses: Array, kept: Mask, rounds: int = _ROUNDS_MAX) -> Judgement:
        """Return what letting in and taking back ends with, from poses [N, d + 1, d + 1] and edges kept [E].

        After no rounds that is the edges kept, judged.
        """
        scales, level, changed, at = (1.0, 1.0), 0, 0, self._loops
        values, judged_with = np.zeros((len(at), len(self._spread))), scales
        axes = np.zeros((*values.shape, len(self._spread)))
        stale, score, share = np.ones(len(at), dtype=np.bool_), np.zeros(len(at)), np.zeros(len(at))
        times_out = np.zeros(len(at))
        for left in range(rounds, -1, -1):
            poses, scales = self._calibrated(poses, kept, scales)
            if _apart(scales, judged_with) > _SETTLED or changed > _CHANGED * kept[at].sum():
                stale[:], changed, judged_with = True, 0, scales
            S = self._covariances(poses, kept, scales, at[stale])
            values[stale], axes[stale] = np.linalg.eigh(self._in_sigmas(S, np.ones(len(kept)), at[stale]))
            score, share = self._scores(poses, kept, scales, values, axes)
            inside, was_fresh = kept[at], stale.all()
            leaves = _leaving(inside, score)
            enters = np.zeros(len(at), dtype=np.bool_)
            if leaves.sum() <= max(1, 0.01 * inside.sum()):
                enters, level = entering(np.where(inside, -np.inf, score - _BACK * times_out), level)
            if left == 0 or not np.any(leaves | enters):
                if left == 0 or was_fresh or changed == 0:
                    break
                changed, stale[:] = 0, True
                continue
            times_out[leaves] += 1.0
            kept = kept.copy()
            kept[at[leaves]], kept[at[enters]] = False, True
            changed += int(np.sum(leaves | enters))
            stale = leaves | enters | (np.abs(score) < _BORDER)
        poses, scales = self._calibrated(poses, kept, scales)
        evidence, leverage = np.full(len(kept), np.inf), np.zeros(len(kept))
        evidence[at], leverage[at] = score + _ODDS, np.where(kept[at], share, 0.0)
        trusted = np.flatnonzero(self._trusted)
        strain = float(np.sum(self._errors(poses, self._variances(scales), trusted) ** 2) / self._dof[trusted].sum())
        return Judgement(poses, kept, *scales, self._likelihood(poses, kept, scales), evidence, leverage, strain)

    def objective(self, poses: Array, kept: Mask) -> float:
        """Return the objective (see `Judgement`) of edges kept [E] at their optimum near poses."""
        poses, scales = self._calibrated(poses, kept, (1.0, 1.0))
        return self._likelihood(poses, kept, scales)

    def optimum(self, poses: Array, kept: Mask) -> Array:
        """Return the optimum of edges kept [E] near poses."""
        return self._calibrated(poses, kept, (1.0, 1.0))[0]

    def witnesses(self, edges: Mask) -> int:
        """Return how many loops among edges [E] are witnesses independent of each other: one per pair of places."""
        return len(self._one_per_place(self._loops[edges[self._loops]]))

    def _variances(self, scales: tuple[float, float]) -> Array:
        return np.where(self._trusted, scales[0], scales[1])

    def _counts_for(self, kept: Mask) -> Array:
        """Return what share of itself each edge [E] counts for: kept loops between the same two places make one."""
        return self._of(kept)[1]

    def _of(self, kept: Mask) -> tuple[Structure, Array]:
        """Return the structure of the edges kept [E], and for what share of itself each edge counts."""
        if self._newest is None or self._newest[0] is not kept:
            self._count(kept[self._loops])
            counts_for = np.ones(len(kept))
            counts_for[self._loops] = 1.0 / np.maximum(self._alike, 1)
            self._newest = kept, Structure(self._problem.with_edges(kept)), counts_for
        return self._newest[1:]

    def _weights(self, kept: Mask, scales: tuple[float, float]) -> Array:
        """Return the weights of the edges kept."""
        return (self._counts_for(kept) / self._variances(scales))[kept]

    def _optimum(self, poses: Array, kept: Mask, scales: tuple[float, float]) -> Array:
        """Return the poses near these that the edges kept lead to."""
        structure, weights = self._of(kept)[0], self._weights(kept, scales)
        return levenberg_marquardt(structure, poses, weights, iterations=_ITERATIONS, tolerance=_TOLERANCE).poses

    def _covariances(self, poses: Array, kept: Mask, scales: tuple[float, float], at: NDArray[np.int64]) -> Array:
        """Return the covariances [M, k, k] of edges `at` at the optimum of those kept, see `covariances_of_edges`."""
        structure, weights = self._of(kept)[0], self._weights(kept, scales)
        return covariances_of_edges(structure, self._problem, poses, weights, at, kept[at])[0]

    def _count(self, kept: Mask) -> None:
        """Count again, for the loops kept [L], those alike; of few that changed, around these alone."""
        changed = np.flatnonzero(kept != self._counted)
        if self._tree is None or not len(changed):
            return
        ends, self._counted = np.asarray(self._tree.data), kept
        if len(changed) > _CHANGED * len(kept):
            held = cKDTree(ends[kept]) if kept.any() else None
            self._alike = np.zeros(len(kept)) if held is None else _counted_within(held, ends)
            return
        for loop, near in zip(changed, self._tree.query_ball_point(ends[changed], 1.0, p=np.inf), strict=True):
            self._alike[near] += 1.0 if kept[loop] else -1.0

    def _calibrated(self, poses: Array, kept: Mask, scales: tuple[float, float]) -> tuple[Array, tuple[float, float]]:
        """Return the optimum of the edges kept, with variances scaled by what residuals of a sample of them show."""
        edges = np.flatnonzero(kept)
        trusted, counts_for = self._trusted[edges], self._counts_for(kept)
        sample = np.concatenate([spread_out(edges[trusted], _SAMPLE), spread_out(edges[~trusted], _SAMPLE)])
        for _ in range(_CALIBRATIONS):
            poses = self._optimum(poses, kept, scales)
            S = self._covariances(poses, kept, scales, sample)
            variances = self._variances(scales)
            z, L = self._errors(poses, variances, sample), self._in_sigmas(S, variances, sample)
            before, scales = scales, self._scales(z, L, counts_for[sample], sample, scales)
            if _apart(scales, before) < _SETTLED:
                break
        return poses, scales

    def _likelihood(self, poses: Array, kept: Mask, scales: tuple[float, float]) -> float:
        """Return the objective (see `Judgement`), near poses, of odometry and one kept loop of each two places."""
        rest = self._one_per_place(self._loops[~kept[self._loops]])
        held = self._one_per_place(self._loops[kept[self._loops]])
        edges, variances = np.sort(np.concatenate([np.flatnonzero(self._trusted), held])), self._variances(scales)
        structure, weights = Structure(self._problem.with_edges(edges)), 1.0 / variances[edges]
        poses = levenberg_marquardt(structure, poses, weights, iterations=_ITERATIONS, tolerance=_TOLERANCE).poses
        none = edges[:0]
        _, log_determinant = covariances_of_edges(structure, self._problem, poses, weights, none, self._trusted[none])
        terms = np.sum(self._errors(poses, variances, edges) ** 2, axis=1)
        terms += self._dof[edges] * np.log(variances[edges]) - np.log(self._values[edges]).sum(axis=1)
        share = (len(held) + 1.0) / (len(held) + len(rest) + 2.0)
        rate = -2.0 * (len(held) * math.log(share) + len(rest) * math.log(1.0 - share))
        return float(terms.sum()) + log_determinant + rate

    def _one_per_place(self, loops: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return some of the loops (indices of edges), the first of each two places that none before it joins."""
        ends = self._ends(loops)
        tree, open_, chosen = cKDTree(ends), np.ones(len(loops), dtype=np.bool_), []
        for i in range(len(loops)):
            if open_[i]:
                chosen.append(i)
                open_[tree.query_ball_point(ends[i], 1.0, p=np.inf)] = False
        return loops[chosen]

    def _ends(self, loops: NDArray[np.int64]) -> Array:
        """Return where both ends of loops [M] are, in places [M, 4]."""
        return self._at[np.sort(self._problem.edges[loops], axis=1)].reshape(-1, 4)

    def _scales(
        self, z: Array, L: Array, counts_for: Array, edges: NDArray[np.int64], scales: tuple[float, float]
    ) -> tuple[float, float]:
        """Return new factors on variances: of odometry by chi2 over redundancy, of loops by the median."""
        odometry, loops = scales
        trusted, dof = self._trusted[edges], self._dof[edges]
        free = dof - counts_for * np.einsum("eaa->e", L)
        if float(free[trusted].sum()) > max(_REDUNDANCY_MIN, _SHARE_MIN * float(dof[trusted].sum())):
            odometry *= float(np.sum(z[trusted] ** 2)) / float(free[trusted].sum())
        judged = ~trusted & (free >= 0.5 * dof)
        if judged.sum() > _JUDGED_MIN:
            studentised = _studentised(z[judged], *np.linalg.eigh(L[judged]), counts_for[judged])[0]
            loops *= float(np.median(studentised / self._medians[edges][judged]))
        return (
            min(max(odometry, _SCALE_MIN), _ODOMETRY_SCALE_MAX),
            min(max(loops, _LOOPS_BETTER * min(odometry, 1.0), _SCALE_MIN), _LOOP_SCALE_MAX),
        )

    def _scores(
        self, poses: Array, kept: Mask, scales: tuple[float, float], values: Array, axes: Array
    ) -> tuple[Array, Array]:
        """Return log-odds of all loops above those asked for, and leverages.

        values [L, k] and axes [L, k, k] are the eigenvalues and eigenvectors of the loops' covariances by the solution,
        in the standard deviations that they state.
        """
        at, variances, values = self._loops, self._variances(scales), values / scales[1]
        taken = np.where(kept, self._counts_for(kept), 0.0)[at]
        distance, spread = _studentised(self._errors(poses, variances, at), values, axes, taken)
        stated = np.log(self._values[at]).sum(axis=1) - self._dof[at] * np.log(variances[at])
        # the space as it is now: that of odometry may be many times too large
        smaller = math.log(extent(poses[:, :-1, -1]) / self._space_m)
        share = self._share(kept)
        evidence = 0.5 * (stated - spread - distance) + math.log(share / (1.0 - share))
        evidence += np.minimum(self._dof[at], self._problem.dimension) * min(smaller, 0.0)
        leverage = taken * values.sum(axis=1) / np.maximum(self._dof[at], 1)
        return np.minimum(evidence, 0.5 * (self._limit[at] - distance)) - _ODDS, leverage

    def _share(self, kept: Mask) -> float:
        count, held = len(self._loops), int(kept[self._loops].sum())
        return min(max((held + 1.0) / (count + 2.0), 0.02), 0.98)

    def _in_sigmas(self, S: Array, variances: Array, at: NDArray[np.int64]) -> Array:
        """Return covariances S [M, k, k] in standard deviations of the edges `at` along known axes."""
        V = self._axes[at]
        root = np.sqrt(self._values[at] / variances[at][:, None]) * self._known[at]
        inner = V.transpose(0, 2, 1) @ (S / np.outer(self._spread, self._spread)) @ V
        return np.asarray(inner * root[:, :, None] * root[:, None, :])

    def _errors(self, poses: Array, variances: Array, at: NDArray[np.int64]) -> Array:
        """Return errors [M, k] of the edges `at` in their standard deviations along known axes."""
        r = self._problem.residuals(poses)[at] / self._spread
        root = np.sqrt(self._values[at] / variances[at][:, None]) * self._known[at]
        return np.einsum("eab,ea->eb", self._axes[at], r) * root


def _counted_within(tree: cKDTree, ends: Array) -> Array:
    """Return how many points of a tree are at the same two places as each of the ends [M, 4]."""
    return np.asarray(tree.query_ball_point(ends, 1.0, p=np.inf, return_length=True), dtype=np.float64)


def _along(problem: PoseGraphProblem, poses: Array, place_m: float) -> Array:
    """Return where poses are in the sequence and along the way [N, 2], in places."""
    d = problem.dimension
    steps = np.linalg.norm(np.diff(poses[:, :d, d], axis=0, prepend=poses[:1, :d, d]), axis=1)
    return np.column_stack([np.arange(len(poses)) / PLACE, np.cumsum(steps) / place_m])


def _studentised(z: Array, values: Array, axes: Array, taken: Array) -> tuple[Array, Array]:
    """Return the squared length of innovations [M] in their standard deviations, and log det of their covariance.

    z [M, k] are errors, values [M, k] and axes [M, k, k] eigenvalues and eigenvectors of covariances of the solution,
    in the loop's standard deviations; the solution has taken the loop with the weight `taken` [M] (0: not at all),
    which is undone.
    """
    values = np.maximum(values, 0.0)
    without = np.maximum(1.0 - taken[:, None] * values, 1.0 - _LEVERAGE_MAX)
    variances = 1.0 + values / without
    innovations = np.einsum("eab,ea->eb", axes, z) / without
    return np.sum(innovations**2 / variances, axis=1), np.log(variances).sum(axis=1)


def _leaving(inside: Mask, score: Array) -> Mask:
    """Return the worst of the loops that are in and should not be."""
    bad = inside & (score < 0.0)
    return bad & (score <= _WORST * score[bad].min(initial=0.0))


def _apart(scales: tuple[float, float], others: tuple[float, float]) -> float:
    return max(abs(math.log(a / b)) for a, b in zip(scales, others, strict=True))
