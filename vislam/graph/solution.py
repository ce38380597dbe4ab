"""The solution of a graph by hand: its solver, its estimate, and which of its loops are believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.errors import DataError
from vislam.core.memory import EdgeReport
from vislam.core.messages import Array, LoopDecision
from vislam.factors.keys import X
from vislam.factors.loop import LOOP_MIN_WEIGHT, LoopModel, relative_covariance
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
from vislam.graph.measurements import ImuBetween, Measurement
from vislam.graph.settling import BATCH_ITERATIONS, let_in, short

_IMU_ROUNDS = 3  # of a batch, in which inertial data are integrated at the biases of the one before
_LADDER: tuple[Factorization, ...] = ("CHOLESKY", "QR")


class Solution:
    """Owns the solver, the estimate and the loops; a solver that failed is replaced and never asked again.

    A loop is tested against what the graph knows of its two poses without it, enters inside the gate, first without a
    kernel so that the estimate reaches it, then under a Cauchy kernel, and is taken out where the rest contradicts it.
    """

    def __init__(self, config: GraphConfig) -> None:
        """Start empty."""
        self._config = config
        self._measurements: list[Measurement] = []
        self._solver: Solver | None = None
        self._rung = 0  # of the ladder
        self._slots: dict[int, int] = {}  # of the loops in the solver, by id
        self._loops: dict[int, LoopModel] = {}  # in the graph, by id
        self._outside: dict[int, LoopModel] = {}
        self._reports: dict[int, EdgeReport] = {}
        self.values = gtsam.Values()

    @property
    def solver_name(self) -> str:
        """Return which solver is at work."""
        return "not solved" if self._solver is None else self._solver.name

    @property
    def cost(self) -> float:
        """Return half the squared sum of whitened errors at the estimate, as kernels count them."""
        return 0.0 if self._solver is None else self._solver.cost()

    def reports(self) -> list[EdgeReport]:
        """Return what became of each loop, by id, with the weight that it has now."""
        out = []
        for n, report in sorted(self._reports.items()):
            held = self._loops.get(n)
            out.append(replace(report, weight=0.0 if held is None else held.weight(*self._ends(held))))
        return out

    def covariance(self, keys: list[int]) -> Array | None:
        """Return the joint marginal covariance of variables, in their order; None where there is none."""
        assert self._solver is not None
        try:
            joint = self._solver.joint_covariance(keys)
        except FAILURES:
            return None
        return joint if np.all(np.isfinite(joint)) else None

    def take(self, fresh: Sequence[Measurement], new: gtsam.Values, incremental: bool) -> str:
        """Take measurements and the first guesses of new variables, and solve; return what went wrong, if anything.

        Raises DataError, and changes nothing, where no solver finds a solution.
        """
        values = gtsam.Values(self.values)
        values.insert(new)
        everything = [*self._measurements, *fresh]
        if not (incremental and isinstance(self._solver, IncrementalSolver)):
            return self._restart(everything, values, incremental)
        try:
            self._solver.update(graph_of([factor for one in fresh for factor in one.factors(values)]), new, [])
            self.values = self._solver.estimate()
        except FAILURES as error:
            return self._restart(everything, values, True, f"gtsam failed ({short(error)}); ")
        self._measurements = everything
        return ""

    def decide(self, fresh: Sequence[LoopModel]) -> str:
        """Test new loops and those that are outside, those first about which the graph knows most; return a note."""
        self._outside |= {loop.id: loop for loop in fresh}
        known = {n: self._known(loop) for n, loop in self._outside.items()}
        sure = {n: np.inf if P is None else float(np.linalg.slogdet(P)[1]) for n, P in known.items()}
        notes = [self._let_in(self._outside[n]) for n in sorted(sure, key=lambda n: (sure[n], n))]
        torn = [m for m in self._loops.values() if m.weight(*self._ends(m)) < LOOP_MIN_WEIGHT]
        for loop in torn:
            self._report(loop, LoopDecision.REJECTED, "contradicted by the rest of the graph")
            del self._loops[loop.id]
        if torn:
            notes.append(self._drop([self._slots.pop(loop.id) for loop in torn]))
            self._outside |= {loop.id: loop for loop in torn}
        return "; ".join(note for note in notes if note)

    def _let_in(self, loop: LoopModel) -> str:
        """Let a loop in if it is inside its gate; return what went wrong."""
        known = self._known(loop)
        if known is None:
            self._report(loop, LoopDecision.PENDING, "the graph cannot say how well it knows the two poses")
            return ""
        chi2 = loop.chi2(*self._ends(loop), known)
        inside, side = chi2 <= loop.threshold, "within" if chi2 <= loop.threshold else "beyond"
        decision = LoopDecision.ACCEPTED if inside else LoopDecision.REJECTED
        self._report(loop, decision, f"chi2 {chi2:.1f} {side} {loop.threshold:.1f}", chi2)
        if not inside:
            return ""
        assert self._solver is not None
        try:
            slots = let_in(self._solver, [loop])
            self.values = self._solver.estimate()
        except FAILURES as error:
            self._report(loop, LoopDecision.PENDING, "the solver refused it", chi2)
            return self._restart(self._measurements, self.values, True, f"gtsam failed ({short(error)}); ")
        self._loops[loop.id], self._slots[loop.id] = loop, slots[0]
        del self._outside[loop.id]
        return ""

    def _drop(self, slots: list[int]) -> str:
        assert self._solver is not None
        try:
            self._solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), slots)
            self._solver.iterate(LOOP_ITERATIONS)
            self.values = self._solver.estimate()
        except FAILURES as error:
            return self._restart(self._measurements, self.values, True, f"gtsam failed ({short(error)}); ")
        return ""

    def _restart(self, measurements: list[Measurement], values: gtsam.Values, incremental: bool, why: str = "") -> str:
        """Fill a new solver with everything, starting at `values`: incremental ones first where they are asked for."""
        before, self._measurements = self._measurements, measurements
        self._rung += bool(why)
        while incremental and self._rung < len(_LADDER):
            try:
                self._adopt(IncrementalSolver(self._config, _LADDER[self._rung]), values)
                return f"{why}rebuilt as {self.solver_name}" if why else ""
            except FAILURES as error:
                why, self._rung = why or f"gtsam failed ({short(error)}); ", self._rung + 1
        try:
            for _ in range(_IMU_ROUNDS if any(isinstance(one, ImuBetween) for one in measurements) else 1):
                values = optimize(self._whole(values)[0], values, BATCH_ITERATIONS)
            self._adopt(BatchSolver(), values)
        except FAILURES as error:
            self._measurements = before
            raise DataError(
                f"no solver finds a solution ({short(error)}); see if every pose is tied to others in all its six "
                "directions, and that no two sigmas lie more than a million apart"
            ) from error
        return f"{why}going on with batch Levenberg-Marquardt" if why else ""

    def _adopt(self, solver: Solver, values: gtsam.Values) -> None:
        graph, labels = self._whole(values)
        slots = solver.update(graph, values, [])
        solver.iterate(LOOP_ITERATIONS)
        self.values, self._solver = solver.estimate(), solver
        self._slots = {n: slot for n, slot in zip(labels, slots, strict=True) if n is not None}

    def _whole(self, values: gtsam.Values) -> tuple[gtsam.NonlinearFactorGraph, list[int | None]]:
        """Return all factors at an estimate, and of each the loop that it is of."""
        factors = [factor for one in self._measurements for factor in one.factors(values)]
        labels = [*[None] * len(factors), *self._loops]
        return graph_of([*factors, *(loop.factor(robust=True) for loop in self._loops.values())]), labels

    def _known(self, loop: LoopModel) -> Array | None:
        """Return the covariance [6, 6] of a loop's relative pose without it."""
        joint = self.covariance([X(loop.record.from_id), X(loop.record.to_id)])
        return None if joint is None else relative_covariance(*self._ends(loop), joint)

    def _ends(self, loop: LoopModel) -> tuple[Array, Array]:
        T_from, T_to = (self.values.atPose3(X(k)).matrix() for k in (loop.record.from_id, loop.record.to_id))
        return T_from, T_to

    def _report(self, loop: LoopModel, decision: LoopDecision, reason: str, chi2: float | None = None) -> None:
        record = loop.record
        if chi2 is None:
            chi2 = self._reports[loop.id].chi2 if loop.id in self._reports else float("nan")
        self._reports[loop.id] = EdgeReport(record.id, record.from_id, record.to_id, chi2, 0.0, decision, reason)
