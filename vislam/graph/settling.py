"""How a solver comes to rest: with new loops, and from there in batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import gtsam

from vislam.factors.loop import LoopModel
from vislam.factors.sensed import Readings
from vislam.factors.solvers import FAILURES, LOOP_ITERATIONS, Solver, graph_of, optimize
from vislam.graph.records import Whole

BATCH_ITERATIONS = 50
_ROUNDS, _GAIN = 3, 1e-4  # in which readings are linearised again, at most; a smaller relative gain ends them


class Settled(NamedTuple):
    """A batch solution."""

    values: gtsam.Values
    cost_before: float
    cost: float
    failure: str  # empty: gtsam found one


def let_in(solver: Solver, loops: Sequence[LoopModel]) -> list[int]:
    """Add loops first without a kernel, so that the estimate reaches them, then under it; return their slots.

    A kernel from the start would leave a single loop after a long drift in the flat tail. Raises one of FAILURES.
    """
    plain = solver.update(graph_of([loop.factor(robust=False) for loop in loops]), gtsam.Values(), [])
    solver.iterate(LOOP_ITERATIONS)
    slots = solver.update(graph_of([loop.factor(robust=True) for loop in loops]), gtsam.Values(), plain)
    solver.iterate(1)
    return slots


def settled(whole: Callable[[gtsam.Values], Whole], values: gtsam.Values, readings: Readings) -> Settled:
    """Return the batch solution from `values`, at which `whole` builds all factors; it may cost more.

    Readings count as they are, not as linearised.
    """
    graph = whole(values)
    before = _cost(graph, values, readings)
    try:
        best = optimize(graph[0], values, BATCH_ITERATIONS)
        cost = _cost(graph, best, readings)
        for _ in range(_ROUNDS if len(readings) else 0):
            graph = whole(best)
            tried = optimize(graph[0], best, BATCH_ITERATIONS)
            last, tried_cost = cost, _cost(graph, tried, readings)
            if not tried_cost < last:
                break
            best, cost = tried, tried_cost
            if last - cost < _GAIN * last:
                break
    except FAILURES as error:
        return Settled(values, before, before, short(error))
    return Settled(best, before, cost, "")


def short(error: Exception) -> str:
    """Return the first line of what gtsam said."""
    lines = [line for line in str(error).strip().splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0][:80] if lines else ''}"


def _cost(whole: Whole, values: gtsam.Values, readings: Readings) -> float:
    graph, labels = whole
    numbers = [n for n, label in enumerate(labels) if label is not None and label[0] == "reading"]
    linear = sum(float(graph.at(n).error(values)) for n in numbers)
    return float(graph.error(values)) - linear + readings.loss(values)
