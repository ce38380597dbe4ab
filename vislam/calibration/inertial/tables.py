"""Inertial and magnetic tables of a recording as arrays, in the units and axes of the file."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.core.recording import Problems
from vislam.datasets import survey
from vislam.datasets.bags import is_bag
from vislam.datasets.tables import MAX_FILE_BYTES, Row, check_size, in_time_order, read_numbers
from vislam.datasets.telemetry import open_telemetry

_NS = 1e-9
_MIN_ROWS = 100  # fewer are no recording
_BROKEN_STEP = 2.5  # in usual periods: samples are missing in between


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Samples [N, C] of one sensor with strictly rising stamps [N]."""

    path: Path
    t_ns: NDArray[np.int64]
    values: Array
    problems: dict[str, int]

    @property
    def t_s(self) -> Array:
        """Seconds [N] since the first sample."""
        return np.asarray((self.t_ns - self.t_ns[0]) * _NS)

    @property
    def period_s(self) -> float:
        """The usual time between two samples."""
        return float(np.median(np.diff(self.t_ns))) * _NS

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return float(self.t_ns[-1] - self.t_ns[0]) * _NS

    def between(self, first: int, end: int) -> Table:
        """Return the samples `first` to before `end`."""
        return Table(self.path, self.t_ns[first:end], self.values[first:end], self.problems)

    def pieces(self) -> list[slice]:
        """Return the stretches without missing samples, in time order."""
        steps = np.diff(self.t_ns) * _NS
        ends = np.flatnonzero(steps > _BROKEN_STEP * self.period_s) + 1
        return [slice(a, b) for a, b in zip([0, *ends], [*ends, len(self.t_ns)], strict=True)]


def read_inertial(source: Path) -> Table:
    """Return rates (rad/s) and forces (m/s^2) [N, 6] of a recording, a GoPro's film or a csv file as `imu0/data.csv`.

    The recording's own calibration is not applied. Raises DataError when there is no such table or it is
    too short.
    """
    return _read(source, "imu_file", "imu0/data.csv", 6)


def read_field(source: Path) -> Table:
    """Return the magnetic field [N, 3] of a recording, or of a csv file like `mag0/data.csv`; as `read_inertial`."""
    return _read(source, "mag_file", "mag0/data.csv", 3)


def _read(source: Path, kind: str, usual: str, columns: int) -> Table:
    path, problems = source, Problems()
    rows = _rows(source, kind, problems)
    if rows is None:
        if not source.is_file():
            found = getattr(survey(str(source)), kind)
            if found is None:
                raise DataError(f"{source} has no {usual}; record one with `vislam record`, see docs/formats.md")
            path = found
        check_size(path, MAX_FILE_BYTES)
        rows = read_numbers(path, columns, problems)
    stamps, numbers = array("q"), array("d")  # a list of lists would take ten times the memory
    for t_ns, row in in_time_order(rows, problems, path.parent.name):
        stamps.append(t_ns)
        numbers.extend(row)
    if len(stamps) < _MIN_ROWS:
        raise DataError(f"{path} has {len(stamps)} usable rows, {_MIN_ROWS} are the least that can be used")
    t = np.array(stamps, dtype=np.int64)
    return Table(path, t, np.array(numbers, dtype=np.float64).reshape(-1, columns), dict(problems))


def _rows(source: Path, kind: str, problems: Problems) -> Iterator[Row[list[float]]] | None:
    """Return the rows of a bag, a film or a phone's folder, which have no table of their own; None of others."""
    if source.is_file() and not is_bag(source):
        telemetry = open_telemetry(source) if kind == "imu_file" else None
        return telemetry.imu_rows(problems) if telemetry is not None and telemetry.has_imu else None
    found = survey(str(source))
    if found.streams is not None:
        return found.imu_rows(problems) if kind == "imu_file" else found.mag_rows(problems)
    return found.imu_rows(problems) if kind == "imu_file" and found.samples is not None else None
