"""Which loops speak against a run: those that the graph tested, not those that wait."""

import math

from vislam.core.memory import EdgeReport
from vislam.core.messages import LoopDecision
from vislam.runs.evidence import contradicting


def test_a_loop_that_waits_for_its_submap_contradicts_nothing():
    told = [
        (LoopDecision.ACCEPTED, 3.0),
        (LoopDecision.ACCEPTED, math.nan),  # joined two submaps
        (LoopDecision.PENDING, 80.0),  # beyond the gate
        (LoopDecision.PENDING, math.nan),  # between submaps that are not joined
        (LoopDecision.REJECTED, math.nan),  # though it was to join two
        (LoopDecision.REJECTED, 5.0),  # taken out again
    ]
    reports = [EdgeReport(n, 0, n + 1, chi2, 0.0, decision, "") for n, (decision, chi2) in enumerate(told)]
    assert contradicting(reports) == 3
