"""The transactional estimate: measurements go in, a solver is tried, and when it fails a new one is built from them.

gtsam 4.3.0 throws on some healthy systems and leaves the object that threw unusable, so the ladder after a failure is:
a fresh iSAM2 with QR factorisation, which does not have the pivot test that rejects healthy systems; the same without
the newest loops; the same from a Levenberg-Marquardt solution; and Levenberg-Marquardt alone. QR comes before giving up
loops because the usual cause is a long drift that a true loop ends.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Generic, Protocol, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from vislam.config import GraphConfig
from vislam.core.messages import Array
from vislam.factors.builder import Guess, Label, Step, insert_guess, read_guess
from vislam.factors.keys import B, V, X, nearest_rigid, poses_of
from vislam.factors.odometry import Odometry
from vislam.factors.priors import held_pose
from vislam.factors.sensed import Readings
from vislam.factors.solvers import (
    FAILURES,
    LOOP_ITERATIONS,
    BatchSolver,
    Factorization,
    IncrementalSolver,
    Solver,
    optimize,
)
from vislam.graph.segments import Link, Segment, Stand, joint_beside, summarised
from vislam.graph.settling import BATCH_ITERATIONS, settled, short
from vislam.sensors import Suite

_FINISH_ITERATIONS = 10  # most steps of the final convergence before batch has its try
_CONVERGED_M = 1e-5  # largest change of a step that finish takes for convergence; rad and m alike


class Loop(Protocol):
    """What the estimator needs of a loop edge."""

    @property
    def id(self) -> int:
        """Return its number, unique in a run."""

    def factor(self, robust: bool, as_measured: bool = False) -> gtsam.NonlinearFactor:
        """Return the factor, under a kernel when `robust`, between the loop's own ends when `as_measured`."""


L = TypeVar("L", bound=Loop)


class Estimator(Generic[L]):
    """Owns the solver and the last good estimate; `poses` is never older than one failed attempt.

    On long runs a keyframe reads back the newest poses and, in turn, a block of the older ones; loops that moved the
    estimate read all.
    """

    def __init__(self, config: GraphConfig, odometry: Odometry, readings: Readings | None = None) -> None:
        """Start empty; `readings` are those of other sensors, a record for each keyframe of the odometry."""
        self._config = config
        self._odometry = odometry
        self._readings = Readings(Suite(), config) if readings is None else readings
        self._factorization: Factorization = "CHOLESKY"
        self._solver: Solver = IncrementalSolver(config, self._factorization)
        self._slots: dict[Label, int] = {}
        self._values = gtsam.Values()
        self._count = 0
        self._buffer: Array = np.zeros((64, 4, 4))  # poses, with room to grow
        self._reach_m: Array = np.zeros(64)
        self._next_old = 0  # where the next block of older poses begins
        self._read: list[NDArray[np.int64]] = []  # ids since `take_read`
        self._held: dict[int, Array] = {}  # poses that stay, by keyframe id
        self._stands: dict[int, Stand] = {}  # keyframes that left the solver; none after a new start
        self._links: dict[tuple[int, int], tuple[Link, int]] = {}  # between anchors, with their slots
        self.frozen: set[int] = set()  # first keyframes of summed up segments
        self.pinned: set[int] = set()  # keyframes on which hangs what summed up segments know
        self.loops: dict[int, L] = {}  # in the graph, by loop id
        self.spare: dict[int, L] = {}  # accepted without a factor, which only `converge` takes
        self.vo_scale = 1.0  # on the sigma of visual odometry, learnt from loops that it contradicted

    @property
    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4] of all keyframes: a view that the next call may change."""
        return self._buffer[: self._count]

    @property
    def values(self) -> gtsam.Values:
        """Return the estimate of all variables, each as it was last read back."""
        return self._values

    @property
    def has_imu(self) -> bool:
        """Return whether velocities and biases are estimated."""
        return self._odometry.has_imu

    @property
    def solver_name(self) -> str:
        """Return which solver is at work."""
        return self._solver.name

    @property
    def is_long(self) -> bool:
        """Return whether there are too many keyframes to look at all of them with each."""
        return self._count > self._config.read_newest + self._config.read_block and not self._solver.reads_all

    def host(self, k: int) -> int:
        """Return the keyframe beside which keyframe k stands; k itself where the solver has it."""
        stand = self._stands.get(k)
        return k if stand is None else stand.host

    def solved_loops(self) -> Iterator[L]:
        """Yield the loops whose factors are in the solver: those of summed up segments are not."""
        return (self.loops[n] for kind, n in self._slots if kind == "loop")

    def look_at(self, ids: list[int]) -> None:
        """Read back some poses now, where a long run may not have for a while."""
        if self.is_long and ids:
            self._read_back(np.unique(np.array(ids, dtype=np.int64)))

    def state(self, k: int) -> Guess:
        """Return the estimated state of keyframe k."""
        return read_guess(self._values, k, self.has_imu)

    def take_read(self) -> NDArray[np.int64]:
        """Return the ids of the poses that were read back since the last call, ascending."""
        ids = np.unique(np.concatenate(self._read)) if self._read else np.zeros(0, np.int64)
        self._read = []
        return ids

    def joint_covariance(self, keys: list[int]) -> Array | None:
        """Return the joint marginal covariance of variables; None when gtsam cannot give it.

        That of poses alone has in it what their odometry is wrong by in common.
        """
        try:
            joint = joint_beside(self._stands, keys, self._solver.joint_covariance)
        except FAILURES:
            return None
        ids = [key - X(0) for key in keys]
        if all(0 <= k < self._count for k in ids):
            shared = self._odometry.shared_error(ids, self.poses)
            joint = joint if shared is None else joint + shared @ shared.T
        return joint if np.all(np.isfinite(joint)) else None

    def begin(self) -> str:
        """Take the first keyframe; return what went wrong, normally nothing."""
        factors, guess = self._odometry.start()
        self._reach_m[0] = np.inf
        return self._extend(factors, {}, guess, {})

    def restore(self, guesses: list[Guess], loops: list[L], spare: list[L], vo_scale: float) -> tuple[list[Step], str]:
        """Start with all keyframes of the odometry at their last estimates, and with loops that were accepted.

        Returns the steps between the keyframes and what went wrong, normally nothing.
        """
        self._count = len(guesses)
        self._buffer = np.array([guess.T_map_body for guess in guesses])
        self._reach_m = np.array([np.inf, *(self._odometry.reach_m(k) for k in range(1, len(guesses)))])
        self.vo_scale = vo_scale
        self.loops, self.spare = {loop.id: loop for loop in loops}, {loop.id: loop for loop in spare}
        values = gtsam.Values()
        for k, guess in enumerate(guesses):
            insert_guess(values, k, guess, self.has_imu)
        self._readings.complete(values)
        steps = [self._step(k, values) for k in range(1, len(guesses))]
        try:
            self._restart(values, [], self._new_solver(), from_batch=False, steps=steps)
        except FAILURES as error:
            return steps, self._recover(values, [], error)
        return steps, ""

    def extend(self) -> tuple[Step, str]:
        """Take the next keyframe of the odometry; return its step and what went wrong, normally nothing."""
        k = self._count
        refreshed = self._readings.refreshed(self._values)
        step = self._step(k, self._values)
        if k == len(self._buffer):
            self._buffer = np.concatenate([self._buffer, np.zeros_like(self._buffer)])
            self._reach_m = np.concatenate([self._reach_m, np.zeros_like(self._reach_m)])
        self._reach_m[k] = self._odometry.reach_m(k)
        named = self._odometry.changed(self.vo_scale) | step.named | refreshed
        return step, self._extend(step.factors, named, step.guess, step.own)

    def distrust_odometry(self, factor: float) -> None:
        """Multiply the sigma of visual odometry; past factors follow with the next `close` in batch."""
        self.vo_scale *= factor

    def close(self, fresh: list[L], batch: bool, gentle: bool = False) -> str:
        """Take loops: first without a kernel, so that the estimate reaches them, then under the Cauchy kernel.

        A kernel from the start would leave a single loop after a long drift in the flat tail. `batch` starts from a
        batch solution, for corrections too large for incremental steps. `gentle` takes one step under the kernel, for
        loops that fit already, so that work stays small on long runs. Returns what went wrong.
        """
        if batch:
            try:
                self._restart(self._values, fresh, self._new_solver(), from_batch=True)
            except FAILURES as error:
                return self._recover(self._values, fresh, error)
            return ""
        try:
            if gentle:
                slots = self._solver.update(_graph([edge.factor(robust=True) for edge in fresh]), gtsam.Values(), [])
                self._take_some()
                self._enter(fresh, slots)
                return ""
            plain = self._solver.update(_graph([edge.factor(robust=False) for edge in fresh]), gtsam.Values(), [])
            self._solver.iterate(LOOP_ITERATIONS)
            robust = _graph([edge.factor(robust=True) for edge in fresh])
            slots = self._solver.update(robust, gtsam.Values(), plain)
            self._solver.iterate(1)
            self._take()
        except FAILURES as error:
            return self._recover(self._values, fresh, error)
        self._enter(fresh, slots)
        return ""

    def _enter(self, fresh: list[L], slots: list[int]) -> None:
        for edge, slot in zip(fresh, slots, strict=True):
            self.loops[edge.id], self._slots["loop", edge.id] = edge, slot

    def move(self, ids: NDArray[np.int64], T: Array) -> str:
        """Move keyframes rigidly by T [4, 4] in map, and go on from there; return what went wrong.

        For what no factor holds back but weak ones: no step of Gauss-Newton would find so far a way.
        """
        values = self._completed(self._values)
        for k in ids.tolist():
            values.update(X(k), gtsam.Pose3(nearest_rigid(T @ values.atPose3(X(k)).matrix())))
            if self.has_imu:
                values.update(V(k), T[:3, :3] @ self._values.atVector(V(k)))
        try:
            self._restart(values, [], self._new_solver(), from_batch=False)
        except FAILURES as error:
            return self._recover(values, [], error)
        return ""

    def hold(self, ids: NDArray[np.int64]) -> str:
        """Hold keyframes where they are, as firmly as the first; return what went wrong."""
        self._held |= {k: self._buffer[k].copy() for k in ids.tolist()}
        try:
            self._restart(self._values, [], self._new_solver(), from_batch=False)
        except FAILURES as error:
            return self._recover(self._values, [], error)
        return ""

    def can_freeze(self, segment: Segment) -> bool:
        """Return whether loops and odometry alone tie these keyframes, which are of one submap and free to move.

        A segment with readings of other sensors is never summed up, for what they say hangs on more than relative
        poses; nor is one with velocities and biases, which a summary of poses would lose.
        """
        inside = segment.keyframes
        if any(map(self._readings.has, range(segment.first, segment.end + 1))):
            return False
        if self._solver.reads_all or self.has_imu or any(k in self._held for k in inside):
            return False
        return bool(np.all(np.isfinite(self._reach_m[segment.first : segment.end])))

    def freeze(self, segment: Segment) -> str:
        """Let keyframes leave the solver, with their loops and odometry; return what went wrong.

        What these say of the keyframes around goes into links between these, one for each pair of anchors however often
        it is seen; the keyframes stand from now on beside anchors as they do. Records stay as they are: a new start of
        the solver has all of it again.
        """
        self.frozen.add(segment.first)
        inside, keys = segment.keyframes, [X(k) for k in segment.keyframes]
        slots = self._solver.around(keys)
        factors = self._solver.factors(slots)
        touched = [factors.at(n).keys() for n in range(factors.size())]
        around = sorted({key - X(0) for own in touched for key in own}.difference(inside))
        self.look_at([*inside, *around])
        relative = [slot for slot, own in zip(slots, touched, strict=True) if len(own) > 1]
        poses = {k: self.poses[k] for k in (*inside, *around)}
        try:
            linear = self._solver.factors(relative).linearize(self._values)
            known = self._solver.joint_covariance([X(k) for k in around])
            summary = summarised(linear, segment, poses, around, known)
        except (*FAILURES, np.linalg.LinAlgError):
            return ""
        links = {pair: self._with_older(pair, link) for pair, link in summary.links.items()}
        slots += [self._links[pair][1] for pair in links if pair in self._links]
        try:
            graph = _graph([link.factor(*pair) for pair, link in links.items()])
            fresh = self._solver.update(graph, gtsam.Values(), slots, X(self._count - 1))
        except FAILURES as error:
            return self._recover(self._values, [], error)
        self._links = {pair: own for pair, own in self._links.items() if not {*pair} & {*inside}}
        self._links |= {pair: (link, slot) for (pair, link), slot in zip(links.items(), fresh, strict=True)}
        self._stands |= summary.stands
        self.pinned |= {*segment.anchors}
        for label in [("edge", segment.end), *(("loop", n) for n in segment.loops)]:
            self._slots.pop(label, None)
        for k in inside:
            self._slots.pop(("edge", k), None)
            self._slots.pop(("tilt", k), None)
            self._values.erase(X(k))
        return ""

    def _with_older(self, pair: tuple[int, int], link: Link) -> Link:
        """Return what a link says together with those of earlier segments between the same anchors."""
        return self._links[pair][0].with_another(link) if pair in self._links else link

    def drop(self, edges: list[L]) -> str:
        """Take loops out again; return what went wrong."""
        if any(("loop", edge.id) not in self._slots for edge in edges):
            return self.revise(edges, [])
        slots = [self._slots.pop(("loop", edge.id)) for edge in edges]
        for edge in edges:
            del self.loops[edge.id]
        try:
            self._solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), slots)
            self._solver.iterate(LOOP_ITERATIONS)
            self._take()
        except FAILURES as error:
            return self._recover(self._values, [], error)
        return ""

    def revise(self, out: list[L], fresh: list[L]) -> str:
        """Take loops out and others in, and begin again from a batch solution; return what went wrong."""
        for edge in out:
            self.loops.pop(edge.id, None)
        try:
            self._restart(self._values, fresh, self._new_solver(), from_batch=True)
        except FAILURES as error:
            return self._recover(self._values, fresh, error)
        return ""

    def converge(self) -> str:
        """Iterate to convergence, then keep the better of that and a batch solution; return which, with the costs.

        The batch integrates the IMU anew at the final biases and has all loops as measured, so both are judged on that
        graph.
        """
        note = ""
        for _ in range(_FINISH_ITERATIONS):
            before = self.poses.copy()
            try:
                self._solver.iterate(1)
                self._take()
            except FAILURES as error:
                note = self._recover(self._values, [], error) + "; "
            if float(np.max(np.abs(self.poses - before))) < _CONVERGED_M:
                break
        now = self._completed(self._values)
        loops = self.loops | self.spare
        found = settled(lambda values: self._whole(values, loops, as_measured=True), now, self._readings, optimize)
        if found.failure or not found.cost < found.cost_before:
            why = f"failed: {found.failure}" if found.failure else f"reached {found.cost:.6g}"
            return f"{note}kept {self.solver_name} at cost {found.cost_before:.6g}, batch {why}"
        try:
            self._restart(found.values, [], self._new_solver(), from_batch=False)
            self._adopt(found.values, np.arange(self._count), self._stands)
        except FAILURES as error:
            note += self._recover(self._values, [], error) + "; "
        return f"{note}batch at cost {found.cost:.6g}, {self.solver_name} had {found.cost_before:.6g}"

    def _step(self, k: int, values: gtsam.Values) -> Step:
        before = read_guess(values, k - 1, self.has_imu)
        earlier = values.atPose3(X(k - 2)).matrix() if k > 1 else None
        step = self._odometry.step(k, before, earlier, self.vo_scale)
        return self._readings.joined(step, k, before.T_map_body, values)

    def _extend(
        self,
        factors: list[gtsam.NonlinearFactor],
        named: dict[Label, gtsam.NonlinearFactor],
        guess: Guess,
        own: dict[int, float],
    ) -> str:
        """Add a keyframe with its factors and new own variables; factors whose name is known replace the older ones."""
        new = gtsam.Values()
        insert_guess(new, self._count, guess, self.has_imu)
        for key, value in own.items():
            new.insert(key, value)
        self._count += 1
        replaced = [self._slots[label] for label in named if label in self._slots]
        try:
            slots = self._solver.update(_graph([*factors, *named.values()]), new, replaced)
            self._take_some()
        except FAILURES as error:
            values = gtsam.Values(self._values)
            values.insert_or_assign(new)
            return self._recover(values, [], error)
        self._slots.update(zip(named, slots[len(factors) :], strict=True))
        return ""

    def _take(self) -> None:
        """Read back the whole estimate."""
        self._adopt(self._solver.estimate(), np.arange(self._count), self._stands)

    def _take_some(self) -> None:
        """Read back the newest poses and the next block of older ones: all of them while they are few."""
        config, count = self._config, self._count
        if not self.is_long:
            self._take()
            return
        newest = np.arange(count - config.read_newest, count)
        begin = self._next_old if self._next_old < newest[0] else 0
        end = min(begin + config.read_block, int(newest[0]))
        self._read_back(np.concatenate([np.arange(begin, end), newest]))
        self._next_old = end

    def _read_back(self, ids: NDArray[np.int64]) -> None:
        solved = sorted({self.host(k) for k in ids.tolist()})
        keys = [X(k) for k in solved]
        if self.has_imu:
            keys += [key for k in solved for key in (V(k), B(k))]
        keys += self._readings.keys_of(solved)
        self._adopt(self._solver.estimate(keys), ids, self._stands)

    def _adopt(self, values: gtsam.Values, ids: NDArray[np.int64], stands: Mapping[int, Stand]) -> None:
        """Adopt an estimate of keyframes, or of the hosts beside which they stand.

        RuntimeError when it is not complete, not finite or diverged.
        """
        beside = [n for n, k in enumerate(ids.tolist()) if k in stands]
        hosts = ids.copy()
        hosts[beside] = [stands[k].host for k in ids[beside].tolist()]
        solved, found = np.unique(hosts), poses_of(values)
        if len(found) != len(solved) or not np.all(np.isfinite(found)):
            raise RuntimeError("the solver's estimate is not finite or not complete")
        poses = found[np.searchsorted(solved, hosts)]
        if beside:
            poses[beside] = poses[beside] @ np.stack([stands[k].T_host_self for k in ids[beside].tolist()])
        steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        beyond = (steps_m > self._reach_m[ids[1:]]) & (np.diff(ids) == 1)
        if np.any(beyond):
            raise RuntimeError(f"the solver diverged: a step of {float(steps_m[beyond].max()):.3g} m")
        if len(ids) == self._count:
            self._values = values
        else:
            self._values.insert_or_assign(values)
        self._buffer[ids] = poses
        self._read.append(ids)

    def _completed(self, values: gtsam.Values) -> gtsam.Values:
        """Return values with the poses of the keyframes, too, that left the solver, and own variables that it lacks."""
        out = gtsam.Values(values)
        for k in self._stands:
            if not out.exists(X(k)):
                out.insert(X(k), gtsam.Pose3(self._buffer[k]))
        self._readings.complete(out)
        return out

    def _begin_anew(self, solver: Solver, labels: list[Label | None], slots: list[int]) -> None:
        """Work with a solver that has all factors."""
        self._solver, self._slots = solver, _named(labels, slots)
        self._stands, self._links, self.frozen, self.pinned = {}, {}, set(), set()

    def _recover(self, values: gtsam.Values, fresh: list[L], error: Exception) -> str:
        """Go down the ladder until a solver takes the records; always ends with a usable one."""
        cause = f"gtsam failed ({short(error)}); "
        self._factorization = "QR"
        values = self._completed(values)
        rungs = [(fresh, False), ([], False), ([], True)] if fresh else [([], False), ([], True)]
        for loops, from_batch in rungs:
            try:
                self._restart(values, loops, self._new_solver(), from_batch or bool(loops))
            except FAILURES:
                continue
            what = "rebuilt with QR" + (" from a batch solution" if from_batch else "")
            return cause + what + (" without the new loops" if fresh and not loops else "")
        solver = BatchSolver()
        graph, labels = self._whole(values, self.loops)
        self._begin_anew(solver, labels, solver.update(graph, values, []))
        try:
            self._take()
        except FAILURES:  # nothing converges: keep what was there, with the guess of the newest keyframe
            self._values = values
            self._buffer[: self._count] = poses_of(values)
            self._read.append(np.arange(self._count))
        return cause + "going on with batch Levenberg-Marquardt"

    def _new_solver(self) -> Solver:
        return IncrementalSolver(self._config, self._factorization)

    def _restart(
        self, values: gtsam.Values, fresh: list[L], solver: Solver, from_batch: bool, steps: list[Step] | None = None
    ) -> None:
        """Fill a new solver from the records, starting at `values`; nothing changes when it fails.

        `steps` are those between the keyframes where they are at hand.
        """
        loops = self.loops | {edge.id: edge for edge in fresh}
        values = self._completed(values)
        if from_batch:
            plain = {edge.id for edge in fresh}
            values = optimize(self._whole(values, loops, plain)[0], values, BATCH_ITERATIONS)
        graph, labels = self._whole(values, loops, steps=steps)
        slots = solver.update(graph, values, [])
        solver.iterate(LOOP_ITERATIONS)
        self._adopt(solver.estimate(), np.arange(self._count), {})
        self.loops = loops
        self._begin_anew(solver, labels, slots)

    def _whole(
        self,
        values: gtsam.Values,
        loops: dict[int, L],
        plain: set[int] | None = None,
        as_measured: bool = False,
        steps: list[Step] | None = None,
    ) -> tuple[gtsam.NonlinearFactorGraph, list[Label | None]]:
        """Build all factors at the biases of `values`, with their names; loops in `plain` without a kernel.

        `as_measured` leaves out what keeps the work of an update small: each loop is between its own ends.
        """
        factors, _ = self._odometry.start()
        factors += [held_pose(k, T, self._config) for k, T in self._held.items()]
        labels: list[Label | None] = [None] * len(factors)
        for step in steps or (self._step(k, values) for k in range(1, self._count)):
            factors += [*step.factors, *step.named.values()]
            labels += [*[None] * len(step.factors), *step.named]
        robust = {loop_id: loop_id not in (plain or set()) for loop_id in loops}
        factors += [edge.factor(robust[loop_id], as_measured) for loop_id, edge in loops.items()]
        labels += [("loop", loop_id) for loop_id in loops]
        return _graph(factors), labels


def _named(labels: list[Label | None], slots: list[int]) -> dict[Label, int]:
    """Return the slots of factors that have a name."""
    return {label: slot for label, slot in zip(labels, slots, strict=True) if label is not None}


def _graph(factors: list[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph
