"""`vislam report`: report.html of a run again."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse


@dataclass(frozen=True)
class ReportOptions:
    """Options of `vislam report`."""

    run: Positional[Path]
    """Run folder"""

    figures: Path | None = None
    """Folder for the report's drawings as SVG files, for a paper"""


OPTIONS = (ReportOptions,)


def main(arguments: list[str]) -> int:
    """Write the report of a run again."""
    options = parse(ReportOptions, arguments, "report")
    from vislam.runs.report import write_figures, write_report

    print(write_report(options.run))
    for path in [] if options.figures is None else write_figures(options.run, options.figures):
        print(path)
    return 0
