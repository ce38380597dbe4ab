"""loops.csv and retrieved.csv of a run: every loop candidate with its decision, and what the index had answered."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.errors import DataError
from vislam.core.files import csv_text
from vislam.core.geometry import quaternion_xyzw_from_rotation, rotation_from_quaternion_xyzw
from vislam.core.messages import Array, RetrievedKeyframe
from vislam.core.reading import open_file

_POSE = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
LOOPS_HEADER = (
    "from_id", "to_id", "from_t_ns", "to_t_ns", "source", "score", "inliers", "supporters", "sigma_m", "consistency",
    "chi2", "weight", "moved_rms_m", "moved_max_m", *_POSE, "decision", "reason",
)  # fmt: skip
_WHOLE = LOOPS_HEADER[:4]
_REAL = LOOPS_HEADER[5:14]
RETRIEVED_HEADER = tuple(field.name for field in fields(RetrievedKeyframe))
_UNIT_SLACK = 1e-3  # by which the length of a stored quaternion may differ from 1


@dataclass(frozen=True, slots=True, eq=False)
class LoopRow:
    """One line of loops.csv; numbers that do not apply are NaN, an unknown time is -1."""

    from_id: int
    to_id: int
    from_t_ns: int
    to_t_ns: int
    source: str
    score: float
    inliers: float
    supporters: float  # matches that agree with the refined pose
    sigma_m: float
    consistency: float
    chi2: float  # at the graph's gate
    weight: float  # in the graph at the end; NaN: never offered to it
    moved_rms_m: float  # its share of the shift of the map's keyframes by the update that took it in
    moved_max_m: float
    T_from_to: Array | None  # [4, 4] that verification found; a unit direction without scale
    decision: str
    reason: str

    @property
    def was_offered(self) -> bool:
        """Whether the detector accepted it and the graph had to decide."""
        return math.isfinite(self.weight)


def loops_text(rows: Sequence[LoopRow]) -> str:
    """Return the text of loops.csv."""
    return csv_text(LOOPS_HEADER, [_fields(row) for row in rows])


def _fields(row: LoopRow) -> list[Any]:
    T = row.T_from_to
    pose = [math.nan] * 7 if T is None else [*T[:3, 3], *quaternion_xyzw_from_rotation(T[:3, :3])]
    whole = ["" if name.endswith("t_ns") and getattr(row, name) < 0 else getattr(row, name) for name in _WHOLE]
    real = [_text(getattr(row, name), 6) for name in _REAL]
    return [*whole, row.source, *real, *(_text(value, 9) for value in pose), row.decision, row.reason]


def _text(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}g}"


def read_loops(path: Path) -> list[LoopRow]:
    """Read loops.csv. Raises DataError for another header, a cut line or a field that is no number."""
    out = []
    for line, row in read_rows(path, LOOPS_HEADER):
        try:
            whole = {name: int(row[name] or -1) for name in _WHOLE}
            real = {name: _number(row[name]) for name in _REAL}
            T = _pose([_number(row[name]) for name in _POSE])
        except ValueError as error:
            raise DataError(f"{path}:{line}: {error}") from error
        text = {"source": row["source"], "decision": row["decision"], "reason": row["reason"]}
        out.append(LoopRow(**whole, **real, **text, T_from_to=T))  # type: ignore[arg-type]
    return out


def _pose(values: list[float]) -> Array | None:
    if all(math.isnan(value) for value in values):
        return None
    quaternion = np.array(values[3:])
    if not np.all(np.isfinite(values)) or abs(float(np.linalg.norm(quaternion)) - 1.0) > _UNIT_SLACK:
        raise ValueError(f"{values} is no pose")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_quaternion_xyzw(quaternion), values[:3]
    return T


def retrieved_text(found: Sequence[RetrievedKeyframe]) -> str:
    """Return the text of retrieved.csv."""
    rows = [[r.from_id, r.to_id, f"{r.score:.6g}", f"{r.island_score:.6g}", r.consistency] for r in found]
    return csv_text(RETRIEVED_HEADER, rows)


def read_retrieved(path: Path) -> list[RetrievedKeyframe]:
    """Read retrieved.csv. Raises DataError as `read_loops`."""
    out = []
    for line, row in read_rows(path, RETRIEVED_HEADER):
        try:
            ids = int(row["from_id"]), int(row["to_id"])
            scores = float(row["score"]), float(row["island_score"])
            out.append(RetrievedKeyframe(*ids, *scores, int(row["consistency"])))
        except ValueError as error:
            raise DataError(f"{path}:{line}: {error}") from error
    return out


def caption(row: LoopRow) -> str:
    """Return what is known about a candidate in one line; the reason holds inliers, sigma and chi-square."""
    parts = [f"{row.from_id} – {row.to_id} {row.decision}: {row.reason}"]
    for text, value, factor in (
        ("weight {:.2f}", row.weight, 1.0),
        ("moved the map by {:.1f} cm rms", row.moved_rms_m, 100.0),
        ("{:.1f} cm at most", row.moved_max_m, 100.0),
    ):
        if math.isfinite(value):
            parts.append(text.format(factor * value))
    return ", ".join(parts)


def read_rows(path: Path, columns: tuple[str, ...]) -> list[tuple[int, dict[str, str]]]:
    """Return (line, fields) of a CSV file with this header; a line cut short is an error."""
    try:
        with TextIOWrapper(open_file(path), encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file, restkey="", restval="")
            if tuple(reader.fieldnames or ()) != columns:
                raise DataError(f"{path}:1: expected the columns {','.join(columns)}, got {reader.fieldnames}")
            rows = []
            for row in reader:
                if "" in row or row[columns[-2]] == "":
                    raise DataError(f"{path}:{reader.line_num}: wrong number of columns; is the line cut short?")
                rows.append((reader.line_num, row))
            return rows
    except (csv.Error, UnicodeDecodeError) as error:
        raise DataError(f"{path} is not a CSV file: {error}") from error
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error


def _number(text: str) -> float:
    return float(text) if text else math.nan
