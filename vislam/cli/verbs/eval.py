"""`vislam eval`: a trajectory, or the loops of a run, judged by the truth."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.results import print_evaluation, print_truth
from vislam.cli.verbs.terminal import number, print_table
from vislam.config import LoopTruthConfig
from vislam.config.ranges import Share
from vislam.core.errors import DataError, TrackingLostError, UsageError


@dataclass(frozen=True)
class EvalOptions:
    """Options of `vislam eval`."""

    estimate: Positional[Path]
    """A trajectory file (TUM, EuRoC csv) or a run folder"""
    reference: Path | None = None
    """True trajectory; a run folder brings its own"""
    align: Literal["se3", "sim3", "yaw", "first", "none"] = "se3"
    """How the estimate is moved onto the reference before errors are taken"""
    association: Literal["interpolate", "nearest"] = "interpolate"
    """Interpolate the reference at the estimate's times, or take the nearest pose within 10 ms"""
    min_coverage: Share = 0.8
    """Below this share of the reference's time the evaluation fails with exit code 4"""
    loops: bool = False
    """Judge the loops of a run folder instead of its trajectories; writes loops_eval.json into it"""
    truth: LoopTruthConfig = field(default_factory=LoopTruthConfig)
    json: bool = False
    """Print JSON instead of the table"""


OPTIONS = (EvalOptions,)


def main(arguments: list[str]) -> int:
    """Evaluate a trajectory, those of a run folder, or its loops."""
    options = parse(EvalOptions, arguments, "eval")
    if options.loops:
        return _eval_loops(options)
    results = _evaluate(options)
    if options.json:
        print(json.dumps(results))
    else:
        print_evaluation(results)
        if options.reference is None:
            from vislam.runs.folder import read_metrics  # not before --help has answered

            print_truth(read_metrics(options.estimate))
    covered = min(entry["coverage"] for entry in results.values())
    if covered < options.min_coverage:
        raise TrackingLostError(
            f"the estimate covers {covered:.0%} of the reference, {options.min_coverage:.0%} asked; "
            "check that both use the same clock, or lower --min-coverage"
        )
    return 0


def _evaluate(options: EvalOptions) -> dict[str, dict[str, Any]]:
    """Return the errors of each trajectory by its name."""
    from vislam.trajectory import evaluate, read_trajectory

    estimate, reference = options.estimate, options.reference
    paths = {estimate.name: estimate}
    if estimate.is_dir():
        paths = {p.stem.removeprefix("trajectory_"): p for p in sorted(estimate.glob("trajectory_*.tum"))}
        truth = paths.pop("truth", None)
        reference = reference or truth
    if not estimate.exists():
        raise UsageError(f"{estimate} does not exist; give a run folder, or a trajectory file and --reference FILE")
    if reference is None:
        raise UsageError(f"{estimate} brings no truth to be evaluated against; give --reference FILE")
    if not paths:
        raise DataError(f"{estimate} holds no trajectory_*.tum; give a run folder or a trajectory file")
    true = read_trajectory(reference)
    return {
        name: evaluate(read_trajectory(path), true, options.align, association=options.association)
        for name, path in paths.items()
    }


def _eval_loops(options: EvalOptions) -> int:
    from vislam.runs.offline.loop_evaluation import evaluate_loops
    from vislam.runs.report import write_loop_plot, write_report

    answer = evaluate_loops(options.estimate, options.truth, options.reference)
    write_loop_plot(options.estimate / "loops_eval.png", {options.estimate.resolve().name: answer})
    write_report(options.estimate)
    if options.json:
        print(json.dumps(answer))
    else:
        _print_loops(answer)
    return 0


def _print_loops(answer: dict[str, Any]) -> None:
    columns = ("stage", "answers", "wrong", "precision", "recall", "recall at full precision", "interval")
    rows = []
    for name, stage in answer["stages"].items():
        numbers = [number(stage[key], 3) for key in ("precision", "recall", "recall_at_full_precision")]
        low, high = stage["interval"]
        interval = f"{number(low, 2)} to {number(high, 2)}" if answer["revisits"] else "-"
        rows.append((name, str(stage["answers"]), str(stage["wrong"]), *numbers, interval))
    print_table(columns, rows, f"{answer['revisits']} of {answer['keyframes']} keyframes revisit a place")
    edges, rule, found = answer["edges"], answer["rule"], answer["found"]
    for source, told in answer["proposals"].items():
        Console().print(f"{told['near']} of {told['verified']} candidates by {source} are truly near")
    Console().print(
        f"{found['near']} keyframes have a truly near one long before; it was retrieved at {found['retrieved']}, "
        f"proposed at {found['proposed']}, given a right pose at {found['posed']}, accepted at {found['accepted']}"
    )
    errors = [number(edges[part][key], 3) for part in ("error_m", "error_deg") for key in ("median", "max")]
    Console().print(
        f"{edges['accepted']} edges in the graph, {edges['apart']} of them loops; off by {errors[0]} m and "
        f"{errors[2]} deg in the median, {errors[1]} m and {errors[3]} deg at most; {edges['gross']} gross "
        f"(over {rule['gross_m']:g} m or {rule['gross_deg']:g} deg)"
    )
