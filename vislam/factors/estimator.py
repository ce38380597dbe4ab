"""The transactional estimate: records go in, a solver is tried, and when it fails a new one is built from the records.

gtsam 4.3.0 throws on some healthy systems and leaves the object that threw unusable, so the ladder after a failure is:
a fresh iSAM2 with QR factorisation, which does not have the pivot test that rejects healthy systems; the same without
the newest loops; the same from a Levenberg-Marquardt solution; and Levenberg-Marquardt alone. QR comes before giving up
loops because the usual cause is a long drift that a true loop ends.
"""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.factors.builder import Builder, Guess, Step, insert_guess, read_guess
from vislam.factors.journal import SPEED_MAX_M_S, KeyframeRecord, StartRecord
from vislam.factors.keys import X, nearest_rigid, poses_of
from vislam.factors.loop import LoopModel
from vislam.factors.solver import FAILURES, BatchSolver, Factorization, IncrementalSolver, Solver, optimize
from vislam.geometry import invert
from vislam.messages import Array

_BATCH_ITERATIONS = 50
_CONVERGED_M = 1e-5  # largest change of a step that finish takes for convergence; rad and m alike


class Estimator:
    """Owns the solver and the last good estimate; `poses` is never older than one failed attempt."""

    def __init__(self, config: GraphConfig, builder: Builder) -> None:
        """Start empty."""
        self._config = config
        self._builder = builder
        self._start: StartRecord | None = None
        self._records: list[KeyframeRecord] = []
        self._factorization: Factorization = "CHOLESKY"
        self._solver: Solver = IncrementalSolver(config, self._factorization)
        self._slots: dict[int, int] = {}
        self._values = gtsam.Values()
        self.loops: dict[int, LoopModel] = {}  # in the graph, by loop id
        self.poses: Array = np.zeros((0, 4, 4))
        self.vo_scale = 1.0  # on the sigma of visual odometry, learnt from loops that it contradicted

    @property
    def has_imu(self) -> bool:
        """Return whether velocities and biases are estimated."""
        return self._start is not None and self._start.has_imu

    @property
    def solver_name(self) -> str:
        """Return which solver is at work."""
        return self._solver.name

    def state(self, k: int) -> Guess:
        """Return the estimated state of keyframe k."""
        return read_guess(self._values, k, self.has_imu)

    def joint_covariance(self, keys: list[int]) -> Array | None:
        """Return the joint marginal covariance of variables; None when gtsam cannot give it."""
        try:
            joint = self._solver.joint_covariance(keys)
        except FAILURES:
            return None
        return joint if np.all(np.isfinite(joint)) else None

    def begin(self, start: StartRecord, record: KeyframeRecord) -> str:
        """Take the first state and keyframe; return what went wrong, normally nothing."""
        self._start = start
        self._records.append(record)
        factors, guess = self._builder.start(start)
        return self._extend(factors, 0, guess)

    def extend(self, record: KeyframeRecord) -> tuple[Step, str]:
        """Take the next keyframe; return its step and what went wrong, normally nothing."""
        previous = self._records[-1]
        step = self._step(record, previous, self._values)
        self._records.append(record)
        return step, self._extend(step.factors, record.id, step.guess)

    def distrust_odometry(self, factor: float) -> None:
        """Multiply the sigma of visual odometry; past factors follow with the next `close` in batch."""
        self.vo_scale *= factor

    def close(self, fresh: list[LoopModel], batch: bool) -> str:
        """Take loops: first without a kernel, so that the estimate reaches them, then under the Cauchy kernel.

        A kernel from the start would leave a single loop after a long drift in the flat tail. `batch` starts from a
        batch solution, for corrections too large for incremental steps. Returns what went wrong.
        """
        if batch:
            try:
                self._restart(self._values, fresh, self._new_solver(), from_batch=True)
            except FAILURES as error:
                return self._recover(self._values, fresh, error)
            return ""
        try:
            plain = self._solver.update(_graph([edge.factor(robust=False) for edge in fresh]), gtsam.Values(), [])
            self._solver.iterate(self._config.loop_iterations)
            robust = _graph([edge.factor(robust=True) for edge in fresh])
            slots = self._solver.update(robust, gtsam.Values(), plain)
            self._solver.iterate(1)
            self._take(self._solver.estimate())
        except FAILURES as error:
            return self._recover(self._values, fresh, error)
        for edge, slot in zip(fresh, slots, strict=True):
            self.loops[edge.record.id], self._slots[edge.record.id] = edge, slot
        return ""

    def drop(self, edges: list[LoopModel]) -> str:
        """Take loops out again; return what went wrong."""
        slots = [self._slots.pop(edge.record.id) for edge in edges]
        for edge in edges:
            del self.loops[edge.record.id]
        try:
            self._solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), slots)
            self._solver.iterate(self._config.loop_iterations)
            self._take(self._solver.estimate())
        except FAILURES as error:
            return self._recover(self._values, [], error)
        return ""

    def snapshot(self) -> tuple[gtsam.Values, float]:
        """Return the current estimate, for `revert`."""
        return self._values, self.vo_scale

    def revert(self, snapshot: tuple[gtsam.Values, float], edges: list[LoopModel]) -> str:
        """Go back to an earlier estimate of the same keyframes, without some loops."""
        values, self.vo_scale = snapshot
        for edge in edges:
            self.loops.pop(edge.record.id, None)
        try:
            self._restart(values, [], self._new_solver(), from_batch=False)
        except FAILURES as error:
            return self._recover(values, [], error)
        return ""

    def converge(self) -> str:
        """Iterate to convergence, then keep the better of that and a batch solution; return which, with the costs.

        The batch integrates the IMU anew at the final biases, so both are judged on that graph.
        """
        note = ""
        for _ in range(self._config.finish_iterations):
            before = self.poses
            try:
                self._solver.iterate(1)
                self._take(self._solver.estimate())
            except FAILURES as error:
                note = self._recover(self._values, [], error) + "; "
            if float(np.max(np.abs(self.poses - before))) < _CONVERGED_M:
                break
        graph = self._whole(self._values, self.loops)
        cost = float(graph.error(self._values))
        try:
            values = optimize(graph, self._values, _BATCH_ITERATIONS)
            batch_cost = float(graph.error(values))
            if not batch_cost < cost:
                return f"{note}kept {self.solver_name} at cost {cost:.6g}, batch reached {batch_cost:.6g}"
        except FAILURES as error:
            return f"{note}kept {self.solver_name} at cost {cost:.6g}, batch failed: {_short(error)}"
        try:
            self._restart(values, [], self._new_solver(), from_batch=False)
            self._take(values)
        except FAILURES as error:
            note += self._recover(self._values, [], error) + "; "
        return f"{note}batch at cost {batch_cost:.6g}, {self.solver_name} had {cost:.6g}"

    def _step(self, record: KeyframeRecord, previous: KeyframeRecord, values: gtsam.Values) -> Step:
        before = read_guess(values, previous.id, self.has_imu)
        motion = np.eye(4)
        if previous.id > 0:
            motion = nearest_rigid(invert(values.atPose3(X(previous.id - 1)).matrix()) @ before.T_map_body)
        return self._builder.keyframe(
            record, previous, before, last_motion=motion, has_imu=self.has_imu, vo_scale=self.vo_scale
        )

    def _extend(self, factors: list[gtsam.NonlinearFactor], k: int, guess: Guess) -> str:
        new = gtsam.Values()
        insert_guess(new, k, guess, self.has_imu)
        try:
            self._solver.update(_graph(factors), new, [])
            self._take(self._solver.estimate())
        except FAILURES as error:
            values = gtsam.Values(self._values)
            values.insert(new)
            return self._recover(values, [], error)
        return ""

    def _take(self, values: gtsam.Values) -> None:
        """Adopt an estimate; RuntimeError when it is not complete, not finite or diverged."""
        poses = poses_of(values)
        if len(poses) != len(self._records) or not np.all(np.isfinite(poses)):
            raise RuntimeError("the solver's estimate is not finite or not complete")
        durations_s = np.diff([record.t_ns for record in self._records]) * 1e-9
        speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / durations_s
        if np.any(speeds > SPEED_MAX_M_S):
            raise RuntimeError(f"the solver diverged: a speed of {float(speeds.max()):.3g} m/s")
        self._values, self.poses = values, poses

    def _recover(self, values: gtsam.Values, fresh: list[LoopModel], error: Exception) -> str:
        """Go down the ladder until a solver takes the records; always ends with a usable one."""
        cause = f"gtsam failed ({_short(error)}); "
        self._factorization = "QR"
        rungs = [(fresh, False), ([], False), ([], True)] if fresh else [([], False), ([], True)]
        for loops, from_batch in rungs:
            try:
                self._restart(values, loops, self._new_solver(), from_batch or bool(loops))
            except FAILURES:
                continue
            what = "rebuilt with QR" + (" from a batch solution" if from_batch else "")
            return cause + what + (" without the new loops" if fresh and not loops else "")
        solver = BatchSolver()
        graph = self._whole(values, self.loops)
        slots = solver.update(graph, values, [])
        self._solver = solver
        self._number(slots, self.loops)
        try:
            self._take(solver.estimate())
        except FAILURES:  # nothing converges: keep what was there, with the guess of the newest keyframe
            self._values, self.poses = values, poses_of(values)
        return cause + "going on with batch Levenberg-Marquardt"

    def _new_solver(self) -> Solver:
        return IncrementalSolver(self._config, self._factorization)

    def _restart(self, values: gtsam.Values, fresh: list[LoopModel], solver: Solver, from_batch: bool) -> None:
        """Fill a new solver from the records, starting at `values`; nothing changes when it fails."""
        loops = self.loops | {edge.record.id: edge for edge in fresh}
        if from_batch:
            plain = {edge.record.id for edge in fresh}
            values = optimize(self._whole(values, loops, plain), values, _BATCH_ITERATIONS)
        slots = solver.update(self._whole(values, loops), values, [])
        solver.iterate(self._config.loop_iterations)
        self._take(solver.estimate())
        self._solver, self.loops = solver, loops
        self._number(slots, loops)

    def _number(self, slots: list[int], loops: dict[int, LoopModel]) -> None:
        """Note the slots of loops, which stand at the end of the whole graph."""
        self._slots = dict(zip(loops, slots[len(slots) - len(loops) :], strict=True))

    def _whole(
        self, values: gtsam.Values, loops: dict[int, LoopModel], plain: set[int] | None = None
    ) -> gtsam.NonlinearFactorGraph:
        """Build all factors from the records at the biases of `values`; loops in `plain` without a kernel."""
        assert self._start is not None
        factors, _ = self._builder.start(self._start)
        for previous, record in zip(self._records, self._records[1:], strict=False):
            factors += self._step(record, previous, values).factors
        factors += [edge.factor(robust=loop_id not in (plain or set())) for loop_id, edge in loops.items()]
        return _graph(factors)


def _graph(factors: list[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def _short(error: Exception) -> str:
    lines = [line for line in str(error).strip().splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0][:80] if lines else ''}"
