"""`vislam export`: the results of a run for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.core.errors import printable


@dataclass(frozen=True)
class ExportOptions:
    """Options of `vislam export`."""

    run: Positional[Path]
    """Run folder"""
    mcap: Path
    """New file, NAME.mcap: poses, odometry, path, cloud, grids and tf as ROS 2 messages; needs the extra 'bags'"""


OPTIONS = (ExportOptions,)


def main(arguments: list[str]) -> int:
    """Write the results of a run into one file."""
    options = parse(ExportOptions, arguments, "export")
    from vislam.runs.offline.export_mcap import export_mcap

    exported = export_mcap(options.run, options.mcap)
    for topic, count in exported.messages.items():
        print(f"{topic}: {count}")
    for topic, reason in exported.left_out.items():
        print(f"left out {topic}: {printable(reason)}")
    print(exported.path)
    return 0
