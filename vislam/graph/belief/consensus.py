"""Which loops of a run to believe together: the most certain ones first, each tested against those believed before.

Where odometry is uncertain, a false loop passes any test against it, and whichever comes first wins. Loops are
therefore taken in the order of the evidence that odometry alone gives them: those over short stretches, which it can
test, tie the run together before those over long ones are tested, and few false ones pass. What is kept is scored by
its evidence: the likelihood of each witness's measurement over the uniform one of a false loop. Other hypotheses are
compared by it: refused loops that confirm one another taken first, or odometry with larger sigmas than stated.

Work comes in small steps (generators), so that a live run can spread it over keyframes.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Collection, Generator, Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.factors.keys import X, nearest_rigid
from vislam.factors.loop import LoopModel, relative_covariance
from vislam.factors.loop_evidence import APART, LADDER, SOUND, innovation, log_volume
from vislam.factors.motion import GAUGE_SIGMA
from vislam.factors.noise_models import gaussian
from vislam.factors.solvers import FAILURES, Factorization, IncrementalSolver, graph_of
from vislam.factors.visual import pose_factor
from vislam.graph.belief.witnesses import EXPECTED, Witnesses, confirming
from vislam.graph.travel import Chain, Travel

_REVIEW_LOOPS = 20  # loops after which all are weighed again, if any was kept out; ...
_REVIEW_DOUBTS = 3  # ... or loops kept out, after which they are
_REVIEW_STEPS = 4  # of a review's work per keyframe: joint marginals of a small graph, 1 to 3 ms each
_SCALES = (2.0, 4.0, 8.0)  # on the sigmas of odometry, tried where these seem to be too small
_NODES = 16  # keyframes of the small graph that count as one step of work
_RATIO_MAX = 1e9  # eigenvalues of a covariance summed along the run

Steps = Generator[None, None, "Belief | None"]


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """One hypothesis: which witnesses are kept, with their evidence in nats, and which refused."""

    kept: dict[int, float]
    refused: list[int]
    scale: float  # on the sigmas of odometry
    let_in: list[LoopModel]  # loops that were out and fit
    put_out: list[tuple[LoopModel, float]]  # loops that were in and do not, with their chi-square

    @property
    def score(self) -> float:
        """Return the evidence of all that is kept."""
        return sum(self.kept.values())


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What a review ended with."""

    let_in: list[LoopModel]
    put_out: list[tuple[LoopModel, float]]  # with the chi-square
    places: int  # witnesses kept
    scale: float  # on the sigmas of odometry


class Consensus:
    """Reviews all loops of a run now and then; `offer` each, `step` with every keyframe."""

    def __init__(self, config: GraphConfig) -> None:
        """Start empty."""
        self._config = config
        self._witnesses = Witnesses(config)
        self._trusted: dict[int, float] = {}  # witnesses that the last review kept, with their evidence
        self._lost: set[int] = set()  # group that confirmed itself and lost against the others
        self._fresh = 0
        self._doubts = 0
        self._doubted = False
        self._steps: Steps | None = None

    def offer(self, loop: LoopModel, in_doubt: bool, travel: Travel) -> None:
        """Take a loop, whether it is in the graph or not; `in_doubt`: it was not let in."""
        if loop.record.has_scale:
            self._witnesses.add(loop, travel)
            self._fresh += 1
            self._doubts += in_doubt
            self._doubted |= in_doubt

    def without(self, gone: Collection[int], held: Callable[[int], bool], travel: Travel) -> Consensus:
        """Return another that was offered all the loops of this one but those that are gone; `held` as for `step`."""
        other = Consensus(self._config)
        for loop in (m for loops in self._witnesses.loops() for m in loops if m.id not in gone):
            other.offer(loop, not held(loop.id), travel)
        return other

    @property
    def is_due(self) -> bool:
        """Return whether enough loops came for another review, if there is anything to doubt."""
        due = self._fresh >= _REVIEW_LOOPS or self._doubts >= _REVIEW_DOUBTS
        return due and self._steps is None

    def doubt(self) -> None:
        """Take note that the graph contradicts a loop that it holds."""
        self._doubts += 1
        self._doubted = True

    def step(self, travel: Travel, scale_left: float, held: Callable[[int], bool]) -> Verdict | None:
        """Do some work; return a verdict when a review has come to its end.

        `scale_left` is by how much the sigmas of odometry may still be inflated; `held` returns for the id of a loop
        whether the graph holds it. Without a loop in doubt there is nothing to review.
        """
        if self._steps is None:
            if not (self.is_due and self._doubts):
                self._fresh = 0 if self.is_due else self._fresh
                return None
            self._begin(travel, scale_left, held)
        return self._work(_REVIEW_STEPS)

    def finish(self, travel: Travel, scale_left: float, held: Callable[[int], bool]) -> Verdict | None:
        """Review everything there is, at once."""
        self._steps = None
        if not self._doubted:
            return None
        self._begin(travel, scale_left, held)
        return self._work(None)

    def _begin(self, travel: Travel, scale_left: float, held: Callable[[int], bool]) -> None:
        self._fresh = self._doubts = 0
        case = Case(self._witnesses.loops(), travel.chain(), self._config, held)
        scales = [s for s in _SCALES if s <= scale_left]
        self._steps = review(case, dict(self._trusted), set(self._lost), scales)

    def _work(self, steps: int | None) -> Verdict | None:
        assert self._steps is not None
        done = 0
        while steps is None or done < steps:
            try:
                next(self._steps)
            except StopIteration as end:
                self._steps = None
                return None if end.value is None else self._verdict(end.value)
            done += 1
        return None

    def _verdict(self, belief: Belief) -> Verdict:
        self._trusted = dict(belief.kept) if belief.scale == 1.0 else {}
        self._lost = set(belief.refused)
        return Verdict(belief.let_in, belief.put_out, len(belief.kept), belief.scale)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """What a review is about."""

    witnesses: list[list[LoopModel]]
    chain: Chain
    config: GraphConfig
    held: Callable[[int], bool]  # whether a loop is in the graph, by id

    @property
    def speakers(self) -> list[LoopModel]:
        """Return the loop that stands for each witness."""
        return [loops[0] for loops in self.witnesses]


def review(case: Case, trusted: dict[int, float], lost: set[int], scales: Iterable[float]) -> Steps:
    """Find the best hypothesis about the loops of a case; None when no solver can.

    Args:
        case: the loops and the odometry.
        trusted: evidence of the witnesses that are not asked again unless another hypothesis makes that necessary.
        lost: a group within these was compared before, and is not again.
        scales: on the sigmas of odometry, to be tried.
    """
    best = yield from _believe(case, 1.0, trusted=trusted)
    if best is None:
        return None
    speakers = case.speakers
    found = confirming([speakers[n] for n in best.refused], case.chain)
    group = [best.refused[n] for n in found]
    yield
    if not group or lost.issuperset(group):
        return best
    rivals = [(1.0, group), *((scale, []) for scale in scales)]
    for scale, first in rivals:
        rival = yield from _believe(case, scale, first=first)
        if rival is not None and rival.score > best.score + APART:
            best = rival
    return best


def _believe(case: Case, scale: float, trusted: dict[int, float] | None = None, first: Sequence[int] = ()) -> Steps:
    """Take witnesses by the ladder; `first` are taken before all others, at the price that odometry puts on them."""
    for factorization in ("CHOLESKY", "QR"):
        graph = _SmallGraph(case.chain, case.config, scale, factorization)
        try:
            return (yield from _climb(case, graph, scale, trusted or {}, first))
        except FAILURES:
            continue
    return None


def _climb(case: Case, graph: _SmallGraph, scale: float, trusted: dict[int, float], first: Sequence[int]) -> Steps:
    speakers, volume = case.speakers, log_volume(case.chain.poses[:, :3, 3])
    yield from graph.build({k for m in speakers for k in _ends(m)})
    kept, refused = dict(trusted), dict[int, float]()
    graph.take([speakers[n] for n in trusted])
    for n in first:
        chi2, log_density = graph.test(speakers[n])
        graph.take([speakers[n]])
        kept[n] = volume + log_density - 0.5 * chi2
        yield
    waiting = [n for n in range(len(speakers)) if n not in kept]
    alone = {n: _density(speakers[n], *case.chain.motion(*_ends(speakers[n])), scale) for n in waiting}
    waiting.sort(key=lambda n: 0.5 * alone[n][0] - alone[n][1])
    rung, rungs = 0, [least for least in LADDER if least >= SOUND]
    while waiting and rung < len(rungs):
        later, before = [], len(kept)
        for n in waiting:
            chi2, log_density = graph.test(speakers[n])
            yield
            if volume + log_density - EXPECTED < rungs[rung]:  # what it could say is too little yet
                later.append(n)
            elif chi2 <= speakers[n].threshold:
                graph.take([speakers[n]])
                kept[n] = volume + log_density - 0.5 * chi2
            else:
                refused[n] = chi2
        waiting = later
        rung = rung + 1 if len(kept) == before else 0
    while kept:  # what all that came after it contradicts, each alone not enough, shows in what is left at the optimum
        left = {n: graph.left(speakers[n]) for n in kept}
        yield
        worst = max(left, key=lambda n: left[n] / speakers[n].threshold)
        if left[worst] <= speakers[worst].threshold:
            break
        graph.drop(speakers[worst])
        refused[worst] = left[worst]
        del kept[worst]
    let_in, put_out = yield from _consequences(case, graph, kept, refused)
    return Belief(kept, sorted(refused), scale, let_in, put_out)


def _consequences(
    case: Case, graph: _SmallGraph, kept: dict[int, float], refused: dict[int, float]
) -> Generator[None, None, tuple[list[LoopModel], list[tuple[LoopModel, float]]]]:
    """Return which loops are to be let in and which put out; of a witness, each one answers for itself."""
    let_in: list[LoopModel] = []
    put_out: list[tuple[LoopModel, float]] = []
    for n in sorted(kept):
        for loop in (m for m in case.witnesses[n] if not case.held(m.id)):
            if graph.test(loop)[0] <= loop.threshold:
                let_in.append(loop)
            yield
    for n in sorted(refused):
        for loop in (m for m in case.witnesses[n] if case.held(m.id)):
            chi2, _ = graph.test(loop)
            if chi2 > loop.threshold:
                put_out.append((loop, chi2))
            yield
    return let_in, put_out


def _ends(loop: LoopModel) -> tuple[int, int]:
    return loop.record.from_id, loop.record.to_id


def _density(loop: LoopModel, T_from_to: Array, covariance: Array, scale: float = 1.0) -> tuple[float, float]:
    """Return the chi-square of a loop's innovation, for a relative pose so well known, and its log density at zero."""
    S = loop.covariance + scale**2 * covariance
    chi2, log_density = innovation(loop.residual(np.eye(4), T_from_to)[0], S)
    return float(chi2), float(log_density)


class _SmallGraph:
    """Only keyframes that loops touch, with the odometry between them summed up.

    It begins with those of the loops that stand for witnesses. Others, of which a long run has ever more, come when
    they are asked for, and hang on the nearest that is there.
    """

    def __init__(self, chain: Chain, config: GraphConfig, scale: float, factorization: Factorization) -> None:
        self._chain, self._config, self._scale = chain, config, scale
        self._solver = IncrementalSolver(config, factorization)
        self._slots: dict[int, int] = {}  # of loops, by id
        self._nodes: list[int] = []  # keyframes in the graph, ascending

    def build(self, touched: set[int]) -> Generator[None]:
        """Put keyframes into the graph."""
        factors, values = list[gtsam.NonlinearFactor](), gtsam.Values()
        before = -1
        for count, k in enumerate(sorted(touched)):
            values.insert(X(k), gtsam.Pose3(self._chain.poses[k]))
            if before < 0:
                gauge = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)
                factors.append(gtsam.PriorFactorPose3(X(k), gtsam.Pose3(self._chain.poses[k]), gauge))
            else:
                factors.append(self._odometry(before, k, *self._chain.motion(before, k)))
            before = k
            if count % _NODES == _NODES - 1:
                yield
        self._solver.update(graph_of(factors), values, [])
        self._nodes = sorted(touched)

    def _odometry(self, a: int, b: int, T_a_b: Array, covariance: Array) -> gtsam.BetweenFactorPose3:
        """Return the factor of odometry summed up from keyframe a to b."""
        return pose_factor(X(a), X(b), T_a_b, gaussian(self._scale**2 * covariance, _RATIO_MAX))

    def _reach(self, loops: Sequence[LoopModel]) -> None:
        """Put the ends of loops into the graph where they are not."""
        for k in sorted({k for loop in loops for k in _ends(loop)}.difference(self._nodes)):
            nearest = min(self._nodes, key=lambda n: abs(n - k))
            a, b = min(nearest, k), max(nearest, k)
            T, covariance = self._chain.motion(a, b)
            factor, values = self._odometry(a, b, T, covariance), gtsam.Values()
            T_map_nearest = self._solver.estimate([X(nearest)]).atPose3(X(nearest)).matrix()
            values.insert(X(k), gtsam.Pose3(nearest_rigid(T_map_nearest @ (T if k == b else invert(T)))))
            self._solver.update(graph_of([factor]), values, [])
            insort(self._nodes, k)

    def test(self, loop: LoopModel) -> tuple[float, float]:
        """Return the chi-square of a loop's innovation and the logarithm of its density at zero."""
        self._reach([loop])
        a, b = _ends(loop)
        values = self._solver.estimate([X(a), X(b)])
        T_a, T_b = values.atPose3(X(a)).matrix(), values.atPose3(X(b)).matrix()
        known = relative_covariance(T_a, T_b, self._solver.joint_covariance([X(a), X(b)]))
        return _density(loop, invert(T_a) @ T_b, known)

    def take(self, loops: Sequence[LoopModel]) -> None:
        """Put loops into the graph."""
        if not loops:
            return
        factors = [loop.factor(robust=False, as_measured=True) for loop in loops]
        slots = self._solver.update(graph_of(factors), gtsam.Values(), [])
        self._slots |= {loop.id: slot for loop, slot in zip(loops, slots, strict=True)}
        self._solver.iterate(1)

    def drop(self, loop: LoopModel) -> None:
        """Take a loop out again."""
        self._solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [self._slots.pop(loop.id)])
        self._solver.iterate(1)

    def left(self, loop: LoopModel) -> float:
        """Return the chi-square that is left of a loop that was taken."""
        a, b = _ends(loop)
        values = self._solver.estimate([X(a), X(b)])
        return loop.chi2(values.atPose3(X(a)).matrix(), values.atPose3(X(b)).matrix())
