"""Batch optimisation: a whole run at once, as the reference of accuracy."""

from vislam.batch.loops import LoopVerdict
from vislam.batch.optimize import BatchResult, optimize_run

__all__ = ["BatchResult", "LoopVerdict", "optimize_run"]
