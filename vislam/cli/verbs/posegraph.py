"""`vislam posegraph`: the best estimate of a pose graph from a file."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.solving import SolvingOptions
from vislam.cli.verbs.terminal import progress_bar
from vislam.config import PoseGraphConfig
from vislam.core.errors import TrackingLostError, printable
from vislam.core.log import log_to


@dataclass(frozen=True)
class PoseGraphOptions:
    """Options of `vislam posegraph FILE`: a pose graph in g2o, TORO or iSAM format."""

    file: Positional[Path]
    """Pose graph; a file that does not end in .g2o, .toro or .isam is recognised by its contents"""
    settings: Annotated[PoseGraphConfig, tyro.conf.arg(name="")] = field(default_factory=PoseGraphConfig)
    solving: Annotated[SolvingOptions, tyro.conf.arg(name="")] = field(default_factory=SolvingOptions)
    out: Path | None = None
    """Folder for optimized.g2o, trajectory.tum, trajectory_kitti.txt, poses.csv, edges.csv, summary.json and
    report.html; None: NAME_optimized in the working folder"""
    report: bool = True
    """Write report.html, with pictures of before and after"""
    json: bool = False
    """Print summary.json instead of the summary"""


OPTIONS = (PoseGraphOptions,)


def main(arguments: list[str]) -> int:
    """Optimise a pose-graph file."""
    options = parse(PoseGraphOptions, arguments, "posegraph")
    out = options.out or Path(f"{options.file.stem}_optimized")
    with log_to(out, ["vislam", "posegraph", *arguments]):
        return _optimize(options, out)


def _optimize(options: PoseGraphOptions, out: Path) -> int:
    from vislam.batch.posegraph.optimize import as_stated
    from vislam.core.files import check_writable
    from vislam.runs.offline.optimize_graph import optimize_graph_file
    from vislam.runs.report.graph_page import write_graph_report

    check_writable(out)  # before the work, which may take minutes
    limit = options.settings.iterations
    with options.solving.team() as team, progress_bar(options.file.stem, "iterations") as bar:
        result = optimize_graph_file(
            options.file, out, options.settings, lambda done, chi2: bar(done, limit, f"chi2 {chi2:.6g}"), team
        )
    if options.report:
        write_graph_report(
            result.problem, result.solution, options.file.stem, out / "report.html", result.certificate,
            as_stated(result.problem, result.solution.weights), result.uncertainty,
        )  # fmt: skip
    summary = result.summary
    if options.json:
        print(json.dumps(summary))
    else:
        landmarks = f"{summary['landmarks']} landmarks, " if summary["landmarks"] else ""
        stated = "" if summary["chi2_file"] is None else f"{summary['chi2_file']:.9g} (the file's poses), "
        print(
            f"{summary['poses']} poses, {landmarks}{summary['edges']} edges ({len(summary['rejected'])} found false); "
            f"chi2 {stated}{summary['chi2_before']:.9g} ({summary['start']} start) -> {summary['chi2_after']:.9g} in "
            f"{summary['iterations']} iterations, {summary['solve_s']:.3f} s"
        )
        if summary["robust"]:
            print(f"robust: {summary['robust']}")
        for kind in result.noise:
            print(f"noise of {kind.text}")
        if result.certificate is not None:
            print(result.certificate.text)
        for warning in summary["warnings"]:
            print(f"warning: {printable(warning)}")
        print(f"results: {out}")
    return 0 if summary["converged"] else TrackingLostError.exit_code
