"""The ladder of solvers: when one fails, another is built from the records, and the last one never fails.

gtsam 4.3.0 throws on some healthy systems and leaves the object that threw unusable, so the ladder after a failure is:
a fresh iSAM2 with QR factorisation, which does not have the pivot test that rejects healthy systems; the same without
the newest loops; the same from a Levenberg-Marquardt solution; and Levenberg-Marquardt alone. QR comes before giving up
loops because the usual cause is a long drift that a true loop ends.
"""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.messages import Array
from vislam.factors.builder import Label, Step
from vislam.factors.keys import B, V, X
from vislam.factors.loop import LoopModel
from vislam.factors.solvers import (
    FAILURES,
    LOOP_ITERATIONS,
    BatchSolver,
    Factorization,
    IncrementalSolver,
    Solver,
    graph_of,
    optimize,
)
from vislam.graph.estimate import Estimate, Ids
from vislam.graph.records import Records, Whole
from vislam.graph.segments import Segment, Summary, SummedUp, joint_beside, summarised
from vislam.graph.settling import BATCH_ITERATIONS, short


class Ladder:
    """Owns the solver at work, what is in it, and the estimate that was read back from it."""

    def __init__(self, config: GraphConfig, records: Records) -> None:
        """Start on the first rung, empty."""
        self._config = config
        self._records = records
        self._factorization: Factorization = "CHOLESKY"
        self.solver: Solver = IncrementalSolver(config, self._factorization)
        self.slots: dict[Label, int] = {}  # of factors that have a name
        self.loops: dict[int, LoopModel] = {}  # in the graph, by loop id
        self.summed_up = SummedUp()  # keyframes that left the solver
        self.estimate = Estimate(config)

    @property
    def is_long(self) -> bool:
        """Return whether there are too many keyframes to look at all of them with each."""
        return self.estimate.is_long and not self.solver.reads_all

    def joint_covariance(self, keys: list[int]) -> Array | None:
        """Return the joint marginal covariance of variables; None when gtsam cannot give it.

        That of poses alone has in it what their odometry is wrong by in common.
        """
        try:
            joint = joint_beside(self.summed_up.stands, keys, self.solver.joint_covariance)
        except FAILURES:
            return None
        shared = self._records.shared_error(keys, self.estimate.poses)
        joint = joint if shared is None else joint + shared @ shared.T
        return joint if np.all(np.isfinite(joint)) else None

    def take(self) -> None:
        """Read back the whole estimate."""
        self.estimate.adopt(self.solver.estimate(), self.estimate.ids, self.summed_up.stands)

    def take_some(self) -> None:
        """Read back the newest poses and the next block of older ones: all of them while they are few."""
        if self.is_long:
            self.read_back(self.estimate.next_block())
        else:
            self.take()

    def read_back(self, ids: Ids) -> None:
        """Read back some poses."""
        solved = sorted({self.summed_up.host(k) for k in ids.tolist()})
        keys = [X(k) for k in solved]
        if self._records.has_imu:
            keys += [key for k in solved for key in (V(k), B(k))]
        keys += self._records.readings.keys_of(solved)
        self.estimate.adopt(self.solver.estimate(keys), ids, self.summed_up.stands)

    def completed(self, values: gtsam.Values) -> gtsam.Values:
        """Return values with the poses of the keyframes, too, that left the solver, and own variables that it lacks."""
        out = self.estimate.completed(values, self.summed_up.stands)
        self._records.readings.complete(out)
        return out

    def begin_again(
        self, values: gtsam.Values, fresh: list[LoopModel], from_batch: bool = False, steps: list[Step] | None = None
    ) -> str:
        """Work with a new solver from `values` on, with new loops; return what went wrong, normally nothing."""
        try:
            self.restart(values, fresh, from_batch, steps)
        except FAILURES as error:
            return self.recover(values, fresh, error)
        return ""

    def recover(self, values: gtsam.Values, fresh: list[LoopModel], error: Exception) -> str:
        """Go down the ladder until a solver takes the records; always ends with a usable one."""
        cause = f"gtsam failed ({short(error)}); "
        self._factorization = "QR"
        values = self.completed(values)
        rungs = [(fresh, False), ([], False), ([], True)] if fresh else [([], False), ([], True)]
        for loops, from_batch in rungs:
            try:
                self.restart(values, loops, from_batch or bool(loops))
            except FAILURES:
                continue
            what = "rebuilt with QR" + (" from a batch solution" if from_batch else "")
            return cause + what + (" without the new loops" if fresh and not loops else "")
        solver = BatchSolver()
        whole = self._records.whole(values, self.loops)
        self._adopt(solver, whole, solver.update(whole[0], values, []))
        try:
            self.take()
        except FAILURES:  # nothing converges: keep what was there, with the guess of the newest keyframe
            self.estimate.fall_back(values)
        return cause + "going on with batch Levenberg-Marquardt"

    def restart(
        self, values: gtsam.Values, fresh: list[LoopModel], from_batch: bool, steps: list[Step] | None = None
    ) -> None:
        """Fill a new solver from the records, starting at `values`; nothing changes when it fails.

        `steps` are those between the keyframes where they are at hand.
        """
        solver: Solver = IncrementalSolver(self._config, self._factorization)
        loops = self.loops | {edge.id: edge for edge in fresh}
        values = self.completed(values)
        if from_batch:
            plain = {edge.id for edge in fresh}
            values = optimize(self._records.whole(values, loops, plain)[0], values, BATCH_ITERATIONS)
        whole = self._records.whole(values, loops, steps=steps)
        slots = solver.update(whole[0], values, [])
        solver.iterate(LOOP_ITERATIONS)
        self.estimate.adopt(solver.estimate(), self.estimate.ids, {})
        self.loops = loops
        self._adopt(solver, whole, slots)

    def let_go(self, segment: Segment) -> str:
        """Let keyframes leave the solver, with their loops and odometry; return what went wrong.

        What these say of the keyframes around goes into links between these, one for each pair of anchors however often
        it is seen; the keyframes stand from now on beside anchors as they do. Records stay as they are: a new start of
        the solver has all of it again.
        """
        self.summed_up.firsts.add(segment.first)
        slots = self.solver.around([X(k) for k in segment.keyframes])
        summary = self._summary(segment, slots)
        if summary is None:
            return ""
        links = self.summed_up.joined(summary)
        replaced, newest = [*slots, *self.summed_up.slots(links)], X(self.estimate.count - 1)
        try:
            graph = graph_of([link.factor(*pair) for pair, link in links.items()])
            fresh = self.solver.update(graph, gtsam.Values(), replaced, newest)
        except FAILURES as error:
            return self.recover(self.estimate.values, [], error)
        self.summed_up.take(segment, summary, links, fresh)
        for label in segment.labels:
            self.slots.pop(label, None)
        for k in segment.keyframes:
            self.estimate.values.erase(X(k))
        return ""

    def _summary(self, segment: Segment, slots: list[int]) -> Summary | None:
        """Return what factors, by their slots, say of a segment that they touch; None where that is too little."""
        factors, inside = self.solver.factors(slots), segment.keyframes
        touched = [factors.at(n).keys() for n in range(factors.size())]
        around = sorted({key - X(0) for own in touched for key in own}.difference(inside))
        if self.is_long:
            self.read_back(np.unique(np.array([*inside, *around], dtype=np.int64)))
        relative = [slot for slot, own in zip(slots, touched, strict=True) if len(own) > 1]
        poses = {k: self.estimate.poses[k] for k in (*inside, *around)}
        try:
            linear = self.solver.factors(relative).linearize(self.estimate.values)
            known = self.solver.joint_covariance([X(k) for k in around])
            return summarised(linear, segment, poses, around, known)
        except (*FAILURES, np.linalg.LinAlgError):
            return None

    def _adopt(self, solver: Solver, whole: Whole, slots: list[int]) -> None:
        """Work with a solver that has all factors."""
        self.solver = solver
        self.slots = {label: slot for label, slot in zip(whole[1], slots, strict=True) if label is not None}
        self.summed_up = SummedUp()
