"""The transactional estimate: measurements go in, a solver is tried, and when it fails the ladder gives a new one."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.messages import Array
from vislam.factors.builder import Guess, Label, Step, insert_guess, read_guess
from vislam.factors.keys import V, X, nearest_rigid
from vislam.factors.loop import LoopModel
from vislam.factors.odometry import Odometry
from vislam.factors.sensed import Readings
from vislam.factors.solvers import FAILURES, LOOP_ITERATIONS, graph_of
from vislam.graph.estimate import Ids
from vislam.graph.ladder import Ladder
from vislam.graph.records import Records
from vislam.graph.segments import Segment, SummedUp
from vislam.graph.settling import let_in, settled

_FINISH_ITERATIONS = 10  # most steps of the final convergence before batch has its try
_CONVERGED_M = 1e-5  # largest change of a step that finish takes for convergence; rad and m alike


class Estimator:
    """Owns the solver and what it holds; its estimate is never older than one failed attempt.

    On long runs a keyframe reads back the newest poses and, in turn, a block of the older ones; loops that moved the
    estimate read all.
    """

    def __init__(self, config: GraphConfig, odometry: Odometry, readings: Readings) -> None:
        """Start empty; `readings` are those of other sensors, a record for each keyframe of the odometry."""
        self._records = Records(config, odometry, readings)
        self._ladder = Ladder(config, self._records)
        self.spare: dict[int, LoopModel] = {}  # accepted without a factor, which only `converge` takes

    # ---- what it knows

    @property
    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4] of all keyframes: a view that the next call may change."""
        return self._ladder.estimate.poses

    @property
    def values(self) -> gtsam.Values:
        """Return the estimate of all variables, each as it was last read back."""
        return self._ladder.estimate.values

    @property
    def has_imu(self) -> bool:
        """Return whether velocities and biases are estimated."""
        return self._records.has_imu

    @property
    def vo_scale(self) -> float:
        """Return the factor on the sigma of visual odometry, learnt from loops that it contradicted."""
        return self._records.vo_scale

    @property
    def solver_name(self) -> str:
        """Return which solver is at work."""
        return self._ladder.solver.name

    @property
    def is_long(self) -> bool:
        """Return whether there are too many keyframes to look at all of them with each."""
        return self._ladder.is_long

    @property
    def loops(self) -> dict[int, LoopModel]:
        """Return the loops that have a factor, by id."""
        return self._ladder.loops

    @property
    def summed_up(self) -> SummedUp:
        """Return the keyframes that left the solver."""
        return self._ladder.summed_up

    def solved_loops(self) -> Iterator[LoopModel]:
        """Yield the loops whose factors are in the solver: those of summed up segments are not."""
        return (self.loops[n] for kind, n in self._ladder.slots if kind == "loop")

    def look_at(self, ids: list[int]) -> None:
        """Read back some poses now, where a long run may not have for a while."""
        if self.is_long and ids:
            self._ladder.read_back(np.unique(np.array(ids, dtype=np.int64)))

    def state(self, k: int) -> Guess:
        """Return the estimated state of keyframe k."""
        return read_guess(self.values, k, self.has_imu)

    def take_read(self) -> Ids:
        """Return the ids of the poses that were read back since the last call, ascending."""
        return self._ladder.estimate.take_read()

    def joint_covariance(self, keys: list[int]) -> Array | None:
        """Return the joint marginal covariance of variables, see `Ladder`; None when gtsam cannot give it."""
        return self._ladder.joint_covariance(keys)

    # ---- keyframes

    def begin(self) -> str:
        """Take the first keyframe; return what went wrong, normally nothing."""
        factors, guess = self._records.odometry.start()
        return self._extend(Step(factors, guess, 0.0, 0.0, ""), np.inf, {})

    def restore(
        self, guesses: list[Guess], loops: list[LoopModel], spare: list[LoopModel], vo_scale: float
    ) -> tuple[list[Step], str]:
        """Start with all keyframes of the odometry at their last estimates, and with loops that were accepted.

        Returns the steps between the keyframes and what went wrong, normally nothing.
        """
        records = self._records
        reach_m = [np.inf, *(records.odometry.reach_m(k) for k in range(1, len(guesses)))]
        self._ladder.estimate.begin([guess.T_map_body for guess in guesses], reach_m)
        records.vo_scale = vo_scale
        self._ladder.loops, self.spare = {loop.id: loop for loop in loops}, {loop.id: loop for loop in spare}
        values = gtsam.Values()
        for k, guess in enumerate(guesses):
            insert_guess(values, k, guess, self.has_imu)
        records.readings.complete(values)
        steps = records.steps(values)
        return steps, self._ladder.begin_again(values, [], steps=steps)

    def extend(self) -> tuple[Step, str]:
        """Take the next keyframe of the odometry; return its step and what went wrong, normally nothing."""
        k, records = self._ladder.estimate.count, self._records
        refreshed = records.readings.refreshed(self.values)
        step = records.step(k, self.values)
        reach_m = records.odometry.reach_m(k)
        return step, self._extend(step, reach_m, records.odometry.changed(self.vo_scale) | step.named | refreshed)

    def _extend(self, step: Step, reach_m: float, named: dict[Label, gtsam.NonlinearFactor]) -> str:
        """Add a keyframe with its factors and new own variables; factors whose name is known replace the older ones."""
        new = gtsam.Values()
        insert_guess(new, self._ladder.estimate.extend(reach_m), step.guess, self.has_imu)
        for key, value in step.own.items():
            new.insert(key, value)
        replaced = [self._ladder.slots[label] for label in named if label in self._ladder.slots]
        try:
            slots = self._ladder.solver.update(graph_of([*step.factors, *named.values()]), new, replaced)
            self._ladder.take_some()
        except FAILURES as error:
            values = gtsam.Values(self.values)
            values.insert_or_assign(new)
            return self._ladder.recover(values, [], error)
        self._ladder.slots.update(zip(named, slots[len(step.factors) :], strict=True))
        return ""

    def distrust_odometry(self, factor: float) -> None:
        """Multiply the sigma of visual odometry; past factors follow with the next `close` in batch."""
        self._records.vo_scale *= factor

    def move(self, ids: Ids, T: Array) -> str:
        """Move keyframes rigidly by T [4, 4] in map, and go on from there; return what went wrong.

        For what no factor holds back but weak ones: no step of Gauss-Newton would find so far a way.
        """
        values = self._ladder.completed(self.values)
        for k in ids.tolist():
            values.update(X(k), gtsam.Pose3(nearest_rigid(T @ values.atPose3(X(k)).matrix())))
            if self.has_imu:
                values.update(V(k), T[:3, :3] @ self.values.atVector(V(k)))
        return self._ladder.begin_again(values, [])

    def hold(self, ids: Ids) -> str:
        """Hold keyframes where they are, as firmly as the first; return what went wrong."""
        self._records.hold({k: self.poses[k].copy() for k in ids.tolist()})
        return self._ladder.begin_again(self.values, [])

    # ---- loops

    def close(self, fresh: list[LoopModel], batch: bool, gentle: bool = False) -> str:
        """Take loops: first without a kernel, so that the estimate reaches them, then under the Cauchy kernel.

        `batch` starts from a batch solution, for corrections too large for incremental steps. `gentle` takes one step
        under the kernel, for loops that fit already, so that work stays small on long runs. Returns what went wrong.
        """
        if batch:
            return self._ladder.begin_again(self.values, fresh, from_batch=True)
        try:
            if gentle:
                robust = graph_of([edge.factor(robust=True) for edge in fresh])
                slots = self._ladder.solver.update(robust, gtsam.Values(), [])
                self._ladder.take_some()
            else:
                slots = let_in(self._ladder.solver, fresh)
                self._ladder.take()
        except FAILURES as error:
            return self._ladder.recover(self.values, fresh, error)
        for edge, slot in zip(fresh, slots, strict=True):
            self.loops[edge.id], self._ladder.slots["loop", edge.id] = edge, slot
        return ""

    def drop(self, edges: list[LoopModel]) -> str:
        """Take loops out again; return what went wrong."""
        if any(("loop", edge.id) not in self._ladder.slots for edge in edges):
            return self.revise(edges, [])
        slots = [self._ladder.slots.pop(("loop", edge.id)) for edge in edges]
        for edge in edges:
            del self.loops[edge.id]
        try:
            self._ladder.solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), slots)
            self._ladder.solver.iterate(LOOP_ITERATIONS)
            self._ladder.take()
        except FAILURES as error:
            return self._ladder.recover(self.values, [], error)
        return ""

    def revise(self, out: list[LoopModel], fresh: list[LoopModel]) -> str:
        """Take loops out and others in, and begin again from a batch solution; return what went wrong."""
        for edge in out:
            self.loops.pop(edge.id, None)
        return self._ladder.begin_again(self.values, fresh, from_batch=True)

    def can_freeze(self, segment: Segment) -> bool:
        """Return whether loops and odometry alone tie these keyframes, which are of one submap and free to move."""
        if self._ladder.solver.reads_all or not self._records.ties_poses_alone(segment.first, segment.end):
            return False
        return self._ladder.estimate.is_bounded(segment.first, segment.end)

    def freeze(self, segment: Segment) -> str:
        """Let keyframes leave the solver, with their loops and odometry; return what went wrong."""
        return self._ladder.let_go(segment)

    # ---- convergence

    def converge(self) -> str:
        """Iterate to convergence, then keep the better of that and a batch solution; return which, with the costs.

        The batch integrates the IMU again at the final biases and has all loops as measured, so both are judged on that
        graph.
        """
        note = ""
        for _ in range(_FINISH_ITERATIONS):
            before = self.poses.copy()
            try:
                self._ladder.solver.iterate(1)
                self._ladder.take()
            except FAILURES as error:
                note = self._ladder.recover(self.values, [], error) + "; "
            if float(np.max(np.abs(self.poses - before))) < _CONVERGED_M:
                break
        now, loops = self._ladder.completed(self.values), self.loops | self.spare
        records = self._records
        found = settled(lambda v: records.whole(v, loops, as_measured=True), now, records.readings)
        if found.failure or not found.cost < found.cost_before:
            why = f"failed: {found.failure}" if found.failure else f"reached {found.cost:.6g}"
            return f"{note}kept {self.solver_name} at cost {found.cost_before:.6g}, batch {why}"
        try:
            self._ladder.restart(found.values, [], from_batch=False)
            self._ladder.estimate.adopt(found.values, self._ladder.estimate.ids, self.summed_up.stands)
        except FAILURES as error:
            note += self._ladder.recover(self.values, [], error) + "; "
        return f"{note}batch at cost {found.cost:.6g}, {self.solver_name} had {found.cost_before:.6g}"
