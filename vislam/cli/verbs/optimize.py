"""`vislam optimize`: the best estimate of a run, or of several runs joined."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from vislam.cli.verbs import posegraph
from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.results import print_evaluation
from vislam.cli.verbs.terminal import progress_bar
from vislam.config import BatchConfig
from vislam.core.errors import TrackingLostError, printable
from vislam.core.log import log_in_run, log_to


@dataclass(frozen=True)
class OptimizeOptions:
    """Options of `vislam optimize RUN`; several RUNs have their own."""

    run: Positional[Path]
    """Run folder, whether its run came to the end or not; give several before --help for their options"""
    settings: Annotated[BatchConfig, tyro.conf.arg(name="")] = field(default_factory=BatchConfig)
    out_name: str = "batch"
    """Names the files: trajectory_NAME.tum, states_NAME.csv"""
    json: bool = False
    """Print the entry of metrics.json instead of the summary"""


@dataclass(frozen=True)
class JoinOptions:
    """Options of `vislam optimize RUN RUN [...]`: sessions joined into one pose graph by loops between them."""

    out: Path
    """Folder for trajectory_NAME.tum of each session, joined.g2o, loops.csv, summary.json and report.html"""
    sessions: Positional[tuple[Path, ...]] = ()
    """Run folders or session.db files, two or more, which are only read; the map is that of the first"""
    report: bool = True
    """Write report.html, with pictures of before and after"""
    json: bool = False
    """Print summary.json instead of the summary"""


OPTIONS = (OptimizeOptions, JoinOptions)


def main(arguments: list[str]) -> int:
    """Optimise what the arguments name: a run or several; a pose-graph file is handed on to its own verb."""
    command = ["vislam", "optimize", *arguments]
    folders = [a for a in takewhile(lambda a: not a.startswith("-"), arguments) if Path(a).is_dir()]
    sessions = [a for a in arguments if (Path(a) / "session.db").is_file() or Path(a).name == "session.db"]
    has_out = any(a.partition("=")[0] == "--out" for a in arguments)
    if len(folders) > 1 or len(sessions) > 1 or ((folders or sessions) and has_out):
        join = parse(JoinOptions, arguments, "optimize")
        with log_to(join.out, command):
            return _join_sessions(join)
    if any(_is_graph(Path(argument)) for argument in arguments):
        return posegraph.main(arguments)
    options = parse(OptimizeOptions, arguments, "optimize")
    with log_in_run(options.run, command):
        return _optimize_run(options)


def _is_graph(path: Path) -> bool:
    return path.suffix in (".g2o", ".toro", ".isam") or (path.exists() and not path.is_dir())


def _optimize_run(options: OptimizeOptions) -> int:
    from vislam.runs.offline.optimize_run import optimize
    from vislam.runs.report import write_report

    entry = optimize(options.run, options.settings, options.out_name)
    write_report(options.run)
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
    print(f"trajectory: {options.run / f'trajectory_{options.out_name}.tum'}")
    return 0


def _join_sessions(options: JoinOptions) -> int:
    from vislam.runs.folder import check_writable
    from vislam.runs.offline.join_sessions import join_sessions, write_joined
    from vislam.runs.report.graph_page import write_graph_report

    check_writable(options.out)  # before the work, which may take minutes
    with progress_bar("loops between sessions", "keyframes") as bar:
        joined = join_sessions(options.sessions, progress=bar)
    write_joined(joined, options.out)
    if options.report:
        write_graph_report(joined.problem, joined.solution, " + ".join(joined.names), options.out / "report.html")
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
        print(f"results: {options.out}")
    return 0 if summary["converged"] else TrackingLostError.exit_code
