"""What every kind of calibration ends with: a file that the config takes, a picture, and what is known how well."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import matplotlib as mpl
from matplotlib.figure import Figure

from vislam.core.errors import DataError, StorageError, UsageError
from vislam.core.files import replacing, storage, write_json, write_text
from vislam.runs.report.style import light

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
        with self._added(name) as path:
            write_text(path, text)
        return path

    def write_report(self, name: str, report: Mapping[str, Any]) -> Path:
        """Write the report as JSON."""
        with self._added(name) as path:
            write_json(path, dict(report))
        return path

    def write_picture(self, name: str, size_inch: tuple[float, float], draw: Draw) -> Path:
        """Write what `draw` puts on an empty figure as PNG, in the style of the reports; same data, same bytes."""
        colors, settings = light()
        with mpl.rc_context(settings):
            figure = Figure(figsize=size_inch, layout="constrained")
            draw(figure, colors)
            how: dict[str, Any] = {"dpi": _PNG_DPI, "facecolor": colors["paper"], "metadata": {"Software": None}}
            return self.write_with(name, lambda file: figure.savefig(file, format="png", **how))

    def write_with(self, name: str, write: Callable[[BinaryIO], None]) -> Path:
        """Write a file by a function that is given it open, atomically."""
        with self._added(name) as path, replacing(path) as file:
            write(file)
        return path

    @contextmanager
    def _added(self, name: str) -> Iterator[Path]:
        """Count a file among those written; where it cannot be, remove those: they would be in the next try's way."""
        path = self._out / name
        try:
            yield path
        except StorageError:
            for written in self.files:
                written.unlink(missing_ok=True)
            raise
        self.files.append(path)


def refuse(what: str, reasons: list[str]) -> None:
    """Raise DataError that names everything that is missing, if anything is."""
    if reasons:
        raise DataError(f"{what} cannot be determined: {'; '.join(reasons)}")
