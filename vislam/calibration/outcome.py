"""What every kind of calibration ends with: a file that the config takes, a picture, and what is known how well."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from vislam.errors import DataError, UsageError
from vislam.report.style import light
from vislam.runfolder import storage, write_json
from vislam.trajectory.files import write_text

Draw = Callable[[Figure, Mapping[str, str]], None]  # onto a figure, with the report's colours by name

_PNG_DPI = 110


@dataclass(frozen=True, slots=True)
class Outcome:
    """A finished calibration."""

    report: dict[str, Any]  # what --json prints and KIND.json holds
    lines: tuple[str, ...]  # the same for people
    files: tuple[Path, ...]


class Folder:
    """The folder that calibrations are written to; each kind owns the files named after it."""

    def __init__(self, out: Path, names: tuple[str, ...], overwrite: bool) -> None:
        """Take a folder in which none of the files `names` exists yet, unless they may be overwritten.

        Raises:
            UsageError: one of them exists.
            StorageError: the folder cannot be made.
        """
        self._out = out
        taken = [name for name in names if (out / name).exists()]
        if taken and not overwrite:
            raise UsageError(f"{out} already holds {', '.join(taken)}; choose another --out or give --overwrite")
        with storage(out):
            out.mkdir(parents=True, exist_ok=True)
        self.files: list[Path] = []

    def write_text(self, name: str, text: str) -> Path:
        """Write a text file, atomically."""
        path = self._out / name
        write_text(path, text)
        self.files.append(path)
        return path

    def write_report(self, name: str, report: Mapping[str, Any]) -> Path:
        """Write the report as JSON."""
        path = self._out / name
        write_json(path, dict(report))
        self.files.append(path)
        return path

    def write_picture(self, name: str, size_inch: tuple[float, float], draw: Draw) -> Path:
        """Write what `draw` puts on an empty figure as PNG, in the style of the reports; same data, same bytes."""
        path = self._out / name
        colors, settings = light()
        with storage(path), mpl.rc_context(settings):
            figure = Figure(figsize=size_inch, layout="constrained")
            draw(figure, colors)
            figure.savefig(path, dpi=_PNG_DPI, facecolor=colors["paper"], metadata={"Software": None})
        self.files.append(path)
        return path


def refuse(what: str, reasons: list[str]) -> None:
    """Raise DataError that names everything that is missing, if anything is."""
    if reasons:
        raise DataError(f"{what} cannot be determined: {'; '.join(reasons)}")
