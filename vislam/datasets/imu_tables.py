"""Tables of inertial samples as apps and loggers write them: rates and forces in one, or each in a file of its own.

Of two files the one whose name holds `gyr` has the rates, `acc` the forces. Columns are found by their names, else the
stamp is first, or last where only the last column rises; the unit of stamps is named, or the one in which the
sensor has a rate that sensors have.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.messages import Array
from vislam.core.reading import opened
from vislam.core.recording import Problems
from vislam.datasets.imu_pairs import Rows, paired
from vislam.datasets.tables import MAX_LINE_BYTES, Row, header, in_time_order, parse_ns, parse_seconds, read_rows
from vislam.trajectory.formats import is_number
from vislam.trajectory.named_columns import STAMP_UNITS

STANDARD_GRAVITY_M_S2 = 9.80665
_LOOKED_AT = 100  # rows, for order and unit of stamps
_OTHERS = ("lin", "uncal", "user", "bias", "temp")  # forces without gravity, raw samples, what is no sample
_LEAST_STEPS = ((0.2, "s", 1e9), (200.0, "ms", 1e6), (2e5, "us", 1e3))  # of 5 Hz; 5 kHz is a step in the unit below
_AXES = {axis: {of + axis for of in ("", "g", "a", "w", "r", "acc", "accel", "gyr", "gyro", "omega")} for axis in "xyz"}
_FACTORS = ((r"deg|°|dps", math.pi / 180.0, "deg/s"), (r"[\[(_ ](milli-?g|mg)\b", STANDARD_GRAVITY_M_S2 * 1e-3, "mg"),
            (r"[\[(_ ]g\b", STANDARD_GRAVITY_M_S2, "g"))  # fmt: skip


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of a table: stamps and numbers, which are multiplied by `factor`."""

    path: Path
    columns: tuple[int, ...]
    stamp_column: int = 0
    parse_stamp: Callable[[str], int] = parse_ns
    factor: float = 1.0
    separator: str | None = ","

    def rows(self, problems: Problems) -> Rows:
        """Yield stamp and numbers in time order; raises DataError when most rows cannot be used."""

        def parse(fields: list[str]) -> Row[list[float]]:
            if len(fields) <= max(self.stamp_column, *self.columns):
                raise ValueError
            numbers = [self.factor * float(fields[k]) for k in self.columns]
            if not all(map(math.isfinite, numbers)):
                raise ArithmeticError
            return self.parse_stamp(fields[self.stamp_column].strip()), numbers

        found = read_rows(self.path, parse, problems, self.separator, needs_line_end=True)
        return in_time_order(found, problems, self.path.name)

    imu_rows = rows  # of rates and forces in one table


@dataclass(frozen=True, slots=True)
class Pair:
    """Rates and forces that were sampled apart; `gravity` is to be added to forces that are without it."""

    rates: Table
    forces: Table
    gravity: Table | None = None

    def imu_rows(self, problems: Problems) -> Rows:
        """Yield stamp, rates and forces, forces interpolated at the stamps of the rates."""
        forces = self.forces.rows(problems)
        if self.gravity is not None:
            both = paired(forces, self.gravity.rows(problems), problems, f"{self.forces.path.name} with gravity")
            forces = ((t_ns, [a + g for a, g in zip(row[:3], row[3:], strict=True)]) for t_ns, row in both)
        return paired(self.rates.rows(problems), forces, problems, self.rates.path.parent.name)


def pair_in(folder: Path, beginning: str = "") -> tuple[Pair, Finding] | None:
    """Return the files of rates and forces in a folder and what was made of them; None where neither is there.

    Args:
        folder: holds `gyro.csv` and `accel.csv` or the like, or `gyro0/data.csv` and `accel0/data.csv`.
        beginning: of the names, as of a film beside them.

    Raises:
        DataError: one of both is missing, there are several, or their columns are not known.
    """
    files = [*(_files(folder, "gyr", "acc", beginning)), *(_files(folder, "acc", "gyr", beginning))]
    kinds = ["gyr" in _name(file).removeprefix(beginning.lower()) for file in files]
    if not files:
        return None
    named = ", ".join(str(file.relative_to(folder)) for file in files[:6])
    if kinds == [True, False]:
        (rates, rates_as), (forces, forces_as) = (_columns(file) for file in files)
        what = f"{named}: the forces ({forces_as}) are interpolated at the stamps of the rates ({rates_as})"
        return Pair(rates, forces), Finding("ok", what, folder.name)
    if len(files) == 1:
        lacks = "accelerometer (accel.csv)" if kinds[0] else "gyroscope (gyro.csv)"
        raise DataError(f"{folder} holds {named}, but no table of the {lacks}; add it, or remove the one that is there")
    raise DataError(f"{folder} holds {named}: which are the gyroscope's and the accelerometer's? Leave one of each")


def check_names(path: Path) -> None:
    """Raise DataError where the header of a table of rates (rad/s), then forces (m/s^2), names others."""
    names = header(path)
    if len(names) < 7:
        return
    rates, forces = names[1].lower(), names[4].lower()
    is_swapped = re.search(r"^a[_xyz]|acc|force|linear", rates) and re.search(r"^w|gyr|omega|angular", forces)
    if is_swapped or any(re.search(pattern, rates) or re.search(pattern, forces) for pattern, _, _ in _FACTORS):
        raise DataError(
            f"{path}: its header names {names[1]}, then {names[4]}; write rates x, y, z in rad/s, then forces x, y, z "
            "in m/s^2"
        )


def holds_pair(folder: Path) -> bool:
    """Return whether a folder has a file of rates and one of forces."""
    return all(next(_files(folder, *kinds), None) for kinds in (("gyr", "acc"), ("acc", "gyr")))


def _files(folder: Path, kind: str, not_kind: str, beginning: str = "") -> Iterator[Path]:
    """Yield the tables in a folder whose names hold one kind and not the other."""
    if not folder.is_dir():
        return
    there = [file for file in folder.iterdir() if file.suffix.lower() in (".csv", ".txt") and not file.is_dir()]
    inner = [inside for inside in folder.iterdir() if not beginning and inside.is_dir()]
    for file in sorted([*there, *(data for one in inner if (data := one / "data.csv").is_file())]):
        name = _name(file).removeprefix(beginning.lower())
        fits = kind in name and not_kind not in name and not any(word in name for word in _OTHERS)
        if fits and file.name.startswith(beginning):
            yield file


def _name(file: Path) -> str:
    return (file.parent.name if file.name == "data.csv" else file.stem).lower()


def _separator(line: str) -> str | None:
    return next((sign for sign in (",", ";", "\t") if sign in line), None)


def _columns(path: Path) -> tuple[Table, str]:
    """Return the table of a file and in words how its stamps and units are taken."""
    with opened(path) as file:
        lines = [file.readline(MAX_LINE_BYTES).decode("utf-8", errors="replace") for _ in range(_LOOKED_AT)]
    separator = next((_separator(line) for line in reversed(lines[:-1]) if line.strip()), None)
    names = header(path, separator)
    split = [line.split(separator) for line in lines if line.endswith("\n")]
    sample = np.array([row[:4] for row in split if len(row) >= 4 and all(map(is_number, row[:4]))], dtype=float)
    sample = sample[np.isfinite(sample).all(axis=-1)]
    if len(sample) < 2:
        raise DataError(f"{path}: no rows of a stamp and x, y, z are found in its first {_LOOKED_AT}; export it again")
    stamp, axes, factor, unit = 0, (1, 2, 3), 1.0, ""
    if names:
        words = [re.findall(r"[a-z]+", re.sub(r"[\[(].*", "", name.lower())) for name in names]
        stamps = [k for k, name in enumerate(names) if re.search(r"time|stamp|elapsed|^t\b|^t_", name.lower())]
        found = [[k for k, of in enumerate(words) if of and of[-1] in _AXES[axis]] for axis in "xyz"]
        if not stamps or [len(columns) for columns in found] != [1, 1, 1]:
            raise DataError(f"{path}: which columns are the stamp and x, y, z? It names {', '.join(names)[:120]}")
        stamp, axes = stamps[0], (found[0][0], found[1][0], found[2][0])
        for pattern, of, named in _FACTORS:
            if re.search(pattern, names[axes[0]].lower()):
                factor, unit = of, f", from {named}"
                break
    elif _rises(sample[:, 3]) and not (_rises(sample[:, 0]) and sample[-1, 0] > sample[-1, 3]):
        stamp, axes = 3, (0, 1, 2)
    inside = [float(row[stamp]) for row in split if len(row) > stamp and is_number(row[stamp])]
    inside = [number for number in inside if math.isfinite(number)]
    name, unit_ns = _stamp_unit(names[stamp] if names else "", np.array(inside))
    return Table(path, axes, stamp, _parser(unit_ns), factor, separator), f"stamps in {name}{unit}"


def _rises(column: Array) -> bool:
    return bool((np.diff(column) >= 0.0).all() and column[-1] > column[0])


def _stamp_unit(name: str, stamps: Array) -> tuple[str, float]:
    """Return the unit of stamps in words and ns: as the column's name has it, else by the steps."""
    for word in re.findall(r"[a-z]+", name.lower()):
        if word in STAMP_UNITS:
            return word, STAMP_UNITS[word]
    steps = np.diff(stamps)
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    return next(((of, unit_ns) for least, of, unit_ns in _LEAST_STEPS if step < least), ("ns", 1.0))


def _parser(unit_ns: float) -> Callable[[str], int]:
    shift = round(math.log10(unit_ns)) - 9

    def parse(text: str) -> int:
        digits, _, exponent = text.lower().partition("e")
        return parse_seconds(f"{digits}e{int(exponent or 0) + shift}")

    return parse
