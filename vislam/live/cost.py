"""What a live run costs: the sum over its processes, without those that play its sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vislam.runs.cost import per_frame


def whole_cost(metrics: Mapping[str, Any], notes: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the cost of a run of several processes, from its metrics and from what each process told.

    Memory is the sum of what each had at most; pages that they share count in each.
    """
    each = {role: told["cost"] for role, told in notes.items() if "cost" in told}
    sums = {name: sum(cost[name] for cost in each.values()) for name in ("cpu_s", "compile_cpu_s", "peak_memory_mb")}
    stages_s = {name: stage["cpu_s"] for name, stage in metrics["timing_ms"].items()}
    spent = per_frame(sums["cpu_s"], metrics["frames"], stages_s)
    apart = {"before_cpu_s": None, "first_pose_cpu_s": None}  # processes begin and see the first pose at their own time
    return {**metrics["cost"], **sums, **spent, **apart, "processes": each}
