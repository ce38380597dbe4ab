"""`vislam optimize`: the best estimate of a run, or of several runs joined."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from vislam.cli.verbs import posegraph
from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.results import print_evaluation
from vislam.cli.verbs.solving import SolvingOptions
from vislam.cli.verbs.terminal import progress_bar
from vislam.config import BatchConfig
from vislam.core.errors import TrackingLostError, UsageError, printable
from vislam.core.log import log_in_run, log_to


@dataclass(frozen=True)
class OptimizeOptions:
    """Options of `vislam optimize RUN`, and of several RUNs, joined into one pose graph by loops between them."""

    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN [RUN ...]")]
    """Run folder, whether its run came to the end or not; several, or session.db files, are joined, only read, and the
    map is that of the first"""
    settings: Annotated[BatchConfig, tyro.conf.arg(name="")] = field(default_factory=BatchConfig)
    solving: Annotated[SolvingOptions, tyro.conf.arg(name="")] = field(default_factory=SolvingOptions)
    out: Path | None = None
    """Of several: folder for trajectory_NAME.tum of each, joined.g2o, loops.csv, summary.json and report.html"""
    out_name: str = "batch"
    """Of one: names the files trajectory_NAME.tum, states_NAME.csv"""
    report: bool = True
    """Write report.html, with pictures of before and after"""
    json: bool = False
    """Print what is written, the entry of metrics.json or summary.json, instead of the summary"""


OPTIONS = (OptimizeOptions,)


def main(arguments: list[str]) -> int:
    """Optimise what the arguments name: a run or several; a pose-graph file is handed on to its own verb."""
    command = ["vislam", "optimize", *arguments]
    if _name_a_graph([Path(argument) for argument in arguments]):
        return posegraph.main(arguments)
    options = parse(OptimizeOptions, arguments, "optimize")
    if options.out is None:
        if len(options.runs) != 1:
            raise UsageError("give one RUN, or several and the folder that they are joined in: --out FOLDER")
        if options.solving != SolvingOptions():
            raise UsageError("--engine, --workers and --scheduler are for several runs, which --out FOLDER joins")
        with log_in_run(options.runs[0], command):
            return _optimize_run(options, options.runs[0])
    if (options.settings, options.out_name) != (BatchConfig(), "batch"):
        raise UsageError(
            "with --out runs are joined, and options of a single run's batch change nothing; leave them off"
        )
    with log_to(options.out, command):
        return _join_sessions(options, options.out)


def _name_a_graph(paths: list[Path]) -> bool:
    """Return whether a pose-graph file was typed: by its ending, or as what comes first of all that exists."""
    first = next((path for path in paths if path.exists()), None)
    is_file = first is not None and first.is_file() and first.name != "session.db"
    return is_file or any(path.suffix in (".g2o", ".toro", ".isam") for path in paths)


def _optimize_run(options: OptimizeOptions, run: Path) -> int:
    from vislam.runs.offline.optimize_run import optimize
    from vislam.runs.report import write_report

    entry = optimize(run, options.settings, options.out_name)
    if options.report:
        write_report(run)
    if options.json:
        print(json.dumps(entry))
        return 0
    loops = entry["loops"]
    print(
        f"{entry['keyframes']} keyframes, {entry['landmarks']} landmarks, {entry['observations']} observations "
        f"({entry['rejected_observations']} refused), {loops['kept']} of {loops['offered']} loops; "
        f"cost {entry['cost_before']:.6g} -> {entry['cost_after']:.6g} in {entry['iterations']} steps, "
        f"{entry['wall_s']:.1f} s"
    )
    for warning in entry["warnings"]:
        print(f"warning: {printable(warning)}")
    if entry["accuracy"]:
        print_evaluation({f"{options.out_name} ({mode})": entry["accuracy"][mode] for mode in entry["accuracy"]})
    print(f"trajectory: {run / f'trajectory_{options.out_name}.tum'}")
    return 0


def _join_sessions(options: OptimizeOptions, out: Path) -> int:
    from vislam.core.files import check_writable
    from vislam.runs.offline.join_sessions import join_sessions, write_joined
    from vislam.runs.report.graph_page import write_graph_report

    check_writable(out)  # before the work, which may take minutes
    with options.solving.team() as team, progress_bar("loops between sessions", "keyframes") as bar:
        joined = join_sessions(options.runs, bar, team)
    write_joined(joined, out)
    if options.report:
        write_graph_report(joined.problem, joined.solution, " + ".join(joined.names), out / "report.html")
    summary = joined.summary
    if options.json:
        print(json.dumps(summary))
    else:
        print(
            f"{len(joined.names)} sessions, {summary['poses']} keyframes; {summary['loops_kept']} of "
            f"{summary['loops_between']} loops between them kept; chi2 {summary['chi2_after']:.6g}"
        )
        for warning in summary["warnings"]:
            print(f"warning: {printable(warning)}")
        print(f"results: {out}")
    return 0 if summary["converged"] else TrackingLostError.exit_code
