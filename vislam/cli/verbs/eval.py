"""`vislam eval`: a trajectory, or the loops of a run, judged by the truth."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.results import print_evaluation, print_truth
from vislam.cli.verbs.terminal import number, print_table
from vislam.config import LoopTruthConfig
from vislam.config.ranges import Positive, Share
from vislam.core.errors import DataError, TrackingLostError, UsageError, printable

if TYPE_CHECKING:
    from vislam.core.trajectory import Trajectory
    from vislam.trajectory import Recognised


@dataclass(frozen=True)
class EvalOptions:
    """Options of `vislam eval`."""

    estimate: Positional[Path]
    """A trajectory (TUM, EuRoC, KITTI, VINS, ORB-SLAM, evo: recognised), a bag with --topic, or a run folder"""
    reference: Path | None = None
    """True trajectory, as the estimate; a run folder brings its own"""
    topic: str = ""
    """Of a bag: topic of poses (Odometry, PoseStamped, Path, ...), or /tf:odom:base_link; default: its only one"""
    reference_topic: str = ""
    """Of a bag as --reference"""
    times: Path | None = None
    """Times of an estimate without any (KITTI); default: times.txt beside it"""
    reference_times: Path | None = None
    """Times of a reference without any; default: times.txt beside it, or --times"""
    align: Literal["se3", "sim3", "yaw", "first", "none"] | None = None
    """How the estimate is moved onto the reference before errors are taken; default: se3, of a run as in its report"""
    association: Literal["interpolate", "nearest"] = "interpolate"
    """Interpolate the reference at the estimate's times, or take the nearest pose"""
    max_gap_s: Positive | None = None
    """Longest gap to interpolate across; default: 0.1 s or two intervals; with nearest: largest difference in time,
    default: 10 ms or half an interval"""
    max_hole_s: Positive | None = None
    """Longer holes of the estimate are not covered; default: 1 s or 2.5 intervals"""
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
    results, taken_for = _evaluate(options)
    if options.json:
        print(json.dumps({name: entry | taken_for for name, entry in results.items()}))
    else:
        for role, words in taken_for.items():
            Console().print(f"{role}: {printable(words)}", soft_wrap=True, markup=False, highlight=False)
        print_evaluation(results)
        if options.reference is None:
            from vislam.runs.folder import read_metrics  # not before --help has answered

            print_truth(read_metrics(options.estimate))
    name, worst = min(results.items(), key=lambda item: item[1]["coverage"])
    if worst["coverage"] < options.min_coverage:
        raise TrackingLostError(
            f"{name} covers {worst['coverage']:.0%} of the reference's time, {options.min_coverage:.0%} asked; "
            f"{worst['spans']}; holes over {worst['max_hole_s']:.3g} s are not covered; --min-coverage sets the share"
        )
    return 0


def _evaluate(options: EvalOptions) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Return the errors of each trajectory by its name, and what estimate and reference were taken for."""
    from vislam.runs.offline.evaluated import is_run, read_evaluated
    from vislam.trajectory import are_misordered, evaluate, spans

    path, span_ns, align = options.estimate, None, options.align or "se3"
    truth: Trajectory | None = None
    taken_for = {}
    if not path.exists():
        raise UsageError(f"{path} does not exist; give a run folder, or a trajectory and --reference FILE")
    if is_run(path):
        run = read_evaluated(path)
        estimates, truth, span_ns, align = run.estimates, run.truth, run.span_ns, options.align or run.alignment
        taken_for["estimate"] = f"{path}, a run; aligned {'as asked' if options.align else 'as its report'}"
        taken_for["reference"] = f"{path}, its own truth"
        timed = True
    else:
        found = _read(path, options.topic, options.times)
        estimates, timed = {path.name: found.trajectory}, found.timed
        taken_for["estimate"] = f"{path.name}: {found.taken_for}"
    if options.reference is not None:
        found = _read(options.reference, options.reference_topic, options.reference_times, options.times)
        truth = found.trajectory
        taken_for["reference"] = f"{options.reference.name}: {found.taken_for}"
        _check_times(timed, found.timed, max(map(len, estimates.values())), len(truth))
        how = (options.association, options.max_gap_s)
        if any(are_misordered(estimate, truth, *how) for estimate in estimates.values()):
            raise DataError(
                f"the rotations of {path.name} and {options.reference.name} fit only if one of both has its "
                "quaternion's w at the other end; name the columns of that one in its first line: "
                "# t tx ty tz qw qx qy qz"
            )
    elif truth is None:
        raise UsageError(f"{path} brings no truth to be evaluated against; give --reference FILE")
    settings: dict[str, Any] = {"max_gap_s": options.max_gap_s, "max_hole_s": options.max_hole_s}
    return {
        name: evaluate(estimate, truth, align, association=options.association, span_ns=span_ns, **settings)
        | {"spans": spans(estimate, truth)}
        for name, estimate in estimates.items()
    }, taken_for


def _read(path: Path, topic: str, times: Path | None, or_times: Path | None = None) -> Recognised:
    """Return the trajectory in a file, or on a topic of a bag; times are as `recognise` takes them."""
    from vislam.datasets.bags import is_bag, trajectory_of_topic
    from vislam.trajectory import Recognised, recognise

    if not path.exists():
        raise UsageError(f"{path} does not exist; give a trajectory file, or a bag and its topic")
    if is_bag(path):
        return Recognised(*trajectory_of_topic(path, topic))
    if topic:
        raise UsageError(f"{path} is no bag, and has no topic {topic}; leave it out")
    return recognise(path, times, or_times)


def _check_times(estimate_timed: bool, reference_timed: bool, poses: int, true_poses: int) -> None:
    """Raise DataError where poses without times cannot be paired row by row."""
    if estimate_timed != reference_timed:
        which = ("reference", "--reference-times") if estimate_timed else ("estimate", "--times")
        raise DataError(f"the {which[0]} has no times; put times.txt beside it, or give {which[1]} FILE")
    if not estimate_timed and poses != true_poses:
        raise DataError(
            f"neither has times, and {poses} poses against {true_poses} cannot be paired; give --times FILE"
        )


def _eval_loops(options: EvalOptions) -> int:
    from vislam.runs.offline.loop_evaluation import evaluate_loops
    from vislam.runs.report import write_loop_plot, write_report

    answer = evaluate_loops(options.estimate, options.truth, options.reference)
    write_loop_plot(options.estimate / "loops_eval.svg", {options.estimate.resolve().name: answer})
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
    for source, counts in answer["proposals"].items():
        Console().print(f"{counts['near']} of {counts['verified']} candidates by {source} are truly near")
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
