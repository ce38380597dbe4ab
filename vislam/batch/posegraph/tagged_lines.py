"""Fast and strict reading of text files whose lines are a tag, ids and numbers, as those of pose graphs are.

A compiled scanner goes over the bytes twice, to count and to convert, so nothing is allocated that the file does not
fill. Numbers are converted as exactly as Python's float() does.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.native_calls import call_double, strtod_address
from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.core.reading import open_file

_MAX_BYTES = 2 * 2**30  # five million edges in space with all digits; ten times as much memory at worst
_MAX_TAG_BYTES = 32
_SHOWN = 40  # characters of what is wrong
_TOO_FEW, _TOO_MANY, _NOT_NUMBER, _NOT_ID, _NOT_FINITE = range(1, 6)
_OTHER = -1
_NO_EXPONENT = 1 << 40
_POWERS_OF_TEN = 10.0 ** np.arange(23)  # exact in double precision

_DATA = frozenset({  # of g2o's viewers and logs, and of iSAM: scans, labels, lenses, orders to the program, true values
    "ROBOTLASER1", "ROBOTLASER2", "RAWLASER1", "RAWLASER2", "VERTEX_TAG", "VERTEX_ELLIPSE", "PARAMS_CAMERACALIB",
    "PARAMS_CAMERAPARAMETERS", "SOLVE", "EDGE3_INIT", "EDGE3_TRUE", "POSE3D_TRUE",
})  # fmt: skip

Bytes = NDArray[np.uint8]


class _Arrays(NamedTuple):
    """What the text is read into."""

    ids: NDArray[np.int64]
    numbers: Array
    lines: NDArray[np.int64]  # of each row
    others: NDArray[np.int64]  # [M, 3] lines of other tags: line, begin, end


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The lines of one tag."""

    ids: NDArray[np.int64]  # [M, I] the whole numbers that come first
    numbers: Array  # [M, C] finite
    lines: NDArray[np.int64]  # [M] in the file, from 1


@dataclass(frozen=True, slots=True)
class TaggedLines:
    """A file's lines by their tags."""

    rows: dict[str, Rows]  # for every tag asked for, also when it has none
    others: list[tuple[int, str]]  # lines of other tags with their numbers, in the order of the file

    def without_data(self) -> tuple[TaggedLines, tuple[str, ...]]:
        """Return the lines without those of tags that constrain nothing, and a note of how many each had."""
        kept = [(line, text) for line, text in self.others if text.split()[0] not in _DATA]
        left = Counter(tag for _, text in self.others if (tag := text.split()[0]) in _DATA)
        notes = tuple(f"{count} lines of {tag} passed over: they measure no pose" for tag, count in left.items())
        return TaggedLines(self.rows, kept), notes


def read_tagged_lines(path: Path, columns: Mapping[str, tuple[int, int]]) -> TaggedLines:
    """Read a file of lines `TAG id ... number ...`; empty lines and those that begin with # are skipped.

    `columns` has for each tag how many ids (0 to 2^63 - 1) and how many numbers follow. Raises DataError with the line
    number where a line is cut short or has too much, on what is no number, on NaN and on infinity.
    """
    text = _read(path)
    names = list(columns)
    tags = np.zeros((len(names), _MAX_TAG_BYTES + 1), dtype=np.uint8)
    for row, name in zip(tags, names, strict=True):
        row[0] = len(name)
        row[1 : len(name) + 1] = np.frombuffer(name.encode(), dtype=np.uint8)
    counts = np.zeros(len(names) + 1, dtype=np.int64)
    _count(text, tags, counts)
    width = np.array([columns[name] for name in names], dtype=np.int64).reshape(-1, 2)
    id_begin = np.concatenate(([0], np.cumsum(counts[:-1] * width[:, 0])))
    number_begin = np.concatenate(([0], np.cumsum(counts[:-1] * width[:, 1])))
    line_begin = np.concatenate(([0], np.cumsum(counts[:-1])))
    ids = np.empty(id_begin[-1], dtype=np.int64)
    numbers = np.empty(number_begin[-1])
    lines = np.empty(line_begin[-1], dtype=np.int64)
    others = np.empty((counts[-1], 3), dtype=np.int64)
    begins = (id_begin[:-1].copy(), number_begin[:-1].copy(), line_begin[:-1].copy())
    fault = _convert(text, tags, width, begins, _Arrays(ids, numbers, lines, others), strtod_address())
    if fault[0]:
        _refuse(path, text, fault, names, width)
    rows = {}
    for k, name in enumerate(names):
        rows[name] = Rows(
            ids[id_begin[k] : id_begin[k + 1]].reshape(counts[k], width[k, 0]),
            numbers[number_begin[k] : number_begin[k + 1]].reshape(counts[k], width[k, 1]),
            lines[line_begin[k] : line_begin[k + 1]],
        )
    return TaggedLines(rows, [(int(n), _shown(text[a:b])) for n, a, b in others.tolist()])


def _read(path: Path) -> Bytes:
    """Return the bytes of a file and a newline."""
    try:
        with open_file(path) as file:
            size = path.stat().st_size
            if size > _MAX_BYTES:
                raise DataError(f"{path} has {size / 2**20:.0f} MiB; at most {_MAX_BYTES >> 20} MiB are read")
            text = np.empty(size + 1, dtype=np.uint8)
            got = file.readinto(text[:size].data)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error
    text = text[: got + 1]
    text[-1] = ord("\n")
    return text


def _shown(raw: Bytes) -> str:
    return raw.tobytes().decode("utf-8", errors="replace").strip()


def _refuse(path: Path, text: Bytes, fault: NDArray[np.int64], names: list[str], width: NDArray[np.int64]) -> None:
    code, line, tag, begin, end = fault.tolist()
    ids, numbers = width[tag].tolist()
    what = _shown(text[begin:end])[:_SHOWN]
    fields = f"{names[tag]} has {ids} ids and {numbers} numbers"
    reason = {
        _TOO_FEW: f"the line ends too early, {fields}; is the file cut short?",
        _TOO_MANY: f"'{what}' is too much, {fields}",
        _NOT_NUMBER: f"'{what}' is not a number, {fields}; repair or remove the line",
        _NOT_ID: f"'{what}' is not an id (a whole number from 0 to 2^63 - 1), {fields}",
        _NOT_FINITE: f"'{what}' is not finite; repair or remove the line",
    }[code]
    raise DataError(f"{path}:{line}: {reason}")


@njit(cache=True)
def _skip_blanks(text: Bytes, at: int) -> int:
    """Return where the next token of this line begins, or where the line ends."""
    while text[at] == 32 or text[at] == 9 or text[at] == 13 or text[at] == 11 or text[at] == 12:
        at += 1
    return at


@njit(cache=True)
def _token_end(text: Bytes, at: int) -> int:
    while text[at] > 32 or text[at] < 9 or (text[at] > 13 and text[at] < 32):  # control characters belong to tokens
        at += 1
    return at


@njit(cache=True)
def _line_end(text: Bytes, at: int) -> int:
    while text[at] != 10:
        at += 1
    return at


@njit(cache=True)
def _which(text: Bytes, begin: int, end: int, tags: Bytes) -> int:
    for k in range(len(tags)):
        if tags[k, 0] == end - begin:
            same = True
            for i in range(end - begin):
                if tags[k, i + 1] != text[begin + i]:
                    same = False
                    break
            if same:
                return k
    return _OTHER


@njit(cache=True)
def _count(text: Bytes, tags: Bytes, counts: NDArray[np.int64]) -> None:
    """Count the lines of each tag, and in the last place those of other tags."""
    at = 0
    while at < len(text):
        at = _skip_blanks(text, at)
        if text[at] != 10 and text[at] != 35:
            counts[_which(text, at, _token_end(text, at), tags)] += 1
        at = _line_end(text, at) + 1


@njit(cache=True)
def _id(text: Bytes, begin: int, end: int) -> np.int64:
    """Return the id in text[begin:end], -1 where it is none."""
    if end == begin or end - begin > 19:
        return np.int64(-1)
    value = np.uint64(0)
    for i in range(begin, end):
        digit = text[i] - 48
        if digit < 0 or digit > 9:
            return np.int64(-1)
        value = value * np.uint64(10) + np.uint64(digit)
    return np.int64(value) if value <= np.uint64(2**63 - 1) else np.int64(-1)  # a mix of signs would be a float


@njit(cache=True)
def _exponent(text: Bytes, at: int, end: int) -> int:
    """Return the exponent in text[at:end], which begins with e; _NO_EXPONENT where it is none."""
    if text[at] != 101 and text[at] != 69:
        return _NO_EXPONENT
    at += 1
    below = at < end and text[at] == 45
    if at < end and (text[at] == 45 or text[at] == 43):
        at += 1
    if at == end:
        return _NO_EXPONENT
    value = 0
    for i in range(at, end):
        if text[i] < 48 or text[i] > 57:
            return _NO_EXPONENT
        value = min(value * 10 + (text[i] - 48), 100_000)
    return -value if below else value


@njit(cache=True)
def _number(text: Bytes, begin: int, end: int, strtod: int, ending: NDArray[np.int64]) -> float:
    """Return the number in text[begin:end], NaN where it is none, infinity where it is too large."""
    negative = text[begin] == 45
    at = begin + 1 if negative or text[begin] == 43 else begin
    mantissa, exponent, digits, significant = np.uint64(0), 0, 0, 0
    dotted = False
    while at < end and ((text[at] >= 48 and text[at] <= 57) or (text[at] == 46 and not dotted)):
        if text[at] == 46:
            dotted = True
        else:
            digits += 1
            significant += significant > 0 or text[at] != 48
            if significant <= 19:
                mantissa = mantissa * np.uint64(10) + np.uint64(text[at] - 48)
            exponent -= dotted
        at += 1
    tail = _exponent(text, at, end) if at < end else 0
    if digits == 0 or tail == _NO_EXPONENT:
        return np.nan
    exponent += tail
    if significant <= 19 and mantissa <= np.uint64(2**53) and exponent >= -22 and exponent <= 22:
        value = float(mantissa)  # exact, and so is the power of ten: one correctly rounded operation
        value = value * _POWERS_OF_TEN[exponent] if exponent >= 0 else value / _POWERS_OF_TEN[-exponent]
        return -value if negative else value
    return call_double(strtod, (text.ctypes.data + begin, ending.ctypes.data, 0))


@njit(cache=True)
def _convert(  # type: ignore[no-untyped-def]
    text: Bytes, tags, width: NDArray[np.int64], begins, out: _Arrays, strtod: int
):
    """Fill the arrays; return [fault, line, tag, begin, end] of what is wrong, fault 0 if nothing.

    `begins` are where the rows of each tag begin in the three arrays.
    """
    ids, numbers, lines, others = out
    next_id, next_number, next_line = begins
    fault, ending = np.zeros(5, dtype=np.int64), np.zeros(1, dtype=np.int64)
    at, line, other = 0, 0, 0
    while at < len(text):
        line += 1
        at = _skip_blanks(text, at)
        if text[at] == 10 or text[at] == 35:
            at = _line_end(text, at) + 1
            continue
        begin, end = at, _token_end(text, at)
        tag = _which(text, begin, end, tags)
        if tag == _OTHER:
            at = _line_end(text, end)
            others[other, 0], others[other, 1], others[other, 2] = line, begin, at
            other += 1
            at += 1
            continue
        at = _skip_blanks(text, end)
        for i in range(width[tag, 0] + width[tag, 1]):
            if text[at] == 10:
                fault[0], fault[1], fault[2], fault[3], fault[4] = _TOO_FEW, line, tag, at, at
                return fault
            end = _token_end(text, at)
            if i < width[tag, 0]:
                value = _id(text, at, end)
                if value < 0:
                    fault[0], fault[1], fault[2], fault[3], fault[4] = _NOT_ID, line, tag, at, end
                    return fault
                ids[next_id[tag]] = value
                next_id[tag] += 1
            else:
                number = _number(text, at, end, strtod, ending)
                if not math.isfinite(number):
                    kind = _NOT_NUMBER if math.isnan(number) else _NOT_FINITE
                    fault[0], fault[1], fault[2], fault[3], fault[4] = kind, line, tag, at, end
                    return fault
                numbers[next_number[tag]] = number
                next_number[tag] += 1
            at = _skip_blanks(text, end)
        if text[at] != 10:
            fault[0], fault[1], fault[2], fault[3], fault[4] = _TOO_MANY, line, tag, at, _token_end(text, at)
            return fault
        lines[next_line[tag]] = line
        next_line[tag] += 1
        at += 1
    return fault
