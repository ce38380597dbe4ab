"""What a run costs: CPU, memory, and the way to the first pose; compilation stands apart."""

from collections.abc import Mapping
from typing import Any

from vislam.core.cpu import ahead_cpu_s, compile_cpu_s, cpu_s, peak_memory_mb
from vislam.pipeline.steps import Step


class CostMeter:
    """Measures this process from where the meter is made to where it is asked; see docs/run-folder.md."""

    def __init__(self) -> None:
        """Begin."""
        self._before_s, self._compile_s, self._ahead_s = cpu_s(), compile_cpu_s(), ahead_cpu_s()
        self._frames = 0
        self._first_t_ns = 0
        self._first_pose: dict[str, float | None] = {"first_pose_s": None, "first_pose_cpu_s": None}

    def take(self, step: Step) -> None:
        """Count the frame of a step."""
        self.count(step.front.frame.t_ns, step.front.T_odom_body is not None)

    def count(self, t_ns: int, has_pose: bool) -> None:
        """Count a frame, and note the first one with a pose that is published."""
        if self._frames == 0:
            self._first_t_ns = t_ns
        self._frames += 1
        if self._first_pose["first_pose_s"] is None and has_pose:
            taken_s = cpu_s() - self._before_s
            self._first_pose = {"first_pose_s": (t_ns - self._first_t_ns) * 1e-9, "first_pose_cpu_s": taken_s}

    def entry(self, timing_ms: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
        """Return what the run cost so far, as metrics.json has it; `timing_ms` is the summary of its stage clock."""
        stages_s = {name: s - self._ahead_s.get(name, 0.0) for name, s in ahead_cpu_s().items()}
        stages_s |= {name: stage["cpu_s"] for name, stage in timing_ms.items()}
        return {
            **per_frame(cpu_s() - self._before_s, self._frames, stages_s),
            "compile_cpu_s": compile_cpu_s() - self._compile_s,
            "before_cpu_s": self._before_s,
            "peak_memory_mb": peak_memory_mb(),
            **self._first_pose,
        }


def per_frame(whole_s: float, frames: int, stages_s: Mapping[str, float]) -> dict[str, Any]:
    """Return the CPU time of a run in all and per frame: of each stage, and of what is in none of them."""
    parts_s = {**stages_s, "other": whole_s - sum(stages_s.values())}
    return {
        "cpu_s": whole_s,
        "cpu_ms_per_frame": 1e3 * whole_s / frames if frames else None,
        "stages_cpu_ms_per_frame": {name: 1e3 * part_s / frames for name, part_s in parts_s.items()} if frames else {},
    }


def whole_cost(metrics: Mapping[str, Any], notes: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the cost of a live run: the sum of its processes, without those that play its sensors.

    Memory is the sum of what each had at most; pages that they share count in each.
    """
    each = {role: values["cost"] for role, values in notes.items() if "cost" in values}
    sums = {name: sum(cost[name] for cost in each.values()) for name in ("cpu_s", "compile_cpu_s", "peak_memory_mb")}
    stages_s = {name: stage["cpu_s"] for name, stage in metrics["timing_ms"].items()}
    spent = per_frame(sums["cpu_s"], metrics["frames"], stages_s)
    apart = {"before_cpu_s": None, "first_pose_cpu_s": None}  # processes begin and see the first pose at their own time
    return {**metrics["cost"], **sums, **spent, **apart, "processes": each}
