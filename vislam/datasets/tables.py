"""Text tables of recordings: read line by line in bounded memory, tolerant of damage, and counting what was skipped.

A row is a time stamp, then numbers or a file name. Rows that cannot be used are skipped and counted with the line of
the first one; a file of which most rows cannot be used is an error. `in_time_order` makes stamps rise strictly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import IO, TypeVar

from vislam.core.errors import DataError
from vislam.core.reading import open_file, opened, readable
from vislam.core.recording import Problems
from vislam.core.streams import Happening, StreamJudge
from vislam.trajectory.formats import is_number

T = TypeVar("T")
Row = tuple[int, T]  # stamp in ns, and what the row holds

MAX_LINE_BYTES = 4096  # the longest line of any supported table is far shorter; a longer one is not such a table
MAX_FILE_BYTES = 2**30  # of tables that are indexed in memory: 4 days of images at 30 Hz
_MAX_STAMP_NS = 2**62
_HEADER_LINES = 20  # a header stands among the first ones
_ENOUGH_ROWS = 20  # below this many rows, one bad line in two is not yet "mostly unusable"
_MANY_ROWS = 1000  # bad rows, and more than good ones, settle it
_NAMED_GAPS = 5  # of a stream, one by one
_STREAMS = {"imu": "imu0", "mag": "mag0"}  # as events name them
_LEAP_NS = 1_000_000_000  # a stamp that leaps further ahead than this, and back in the next row, is the wrong one


def parse_ns(text: str) -> int:
    """Return a stamp in ns from an integer of nanoseconds; raises ValueError."""
    t_ns = int(text)
    if abs(t_ns) > _MAX_STAMP_NS:
        raise ValueError(text)
    return t_ns


def parse_seconds(text: str) -> int:
    """Return a stamp in ns from decimal seconds, exactly as written (a float would lose 100 ns); raises ValueError."""
    try:
        seconds = Decimal(text.strip())
        if not seconds.is_finite() or abs(seconds) > _MAX_STAMP_NS // 10**9:
            raise ValueError(text)
        return int((seconds * 10**9).to_integral_value())
    except ArithmeticError as error:
        raise ValueError(text) from error


def read_rows(
    path: Path,
    parse: Callable[[list[str]], Row[T]],
    problems: Problems,
    separator: str | None,
    needs_line_end: bool,
) -> Iterator[Row[T]]:
    """Yield what `parse` makes of the fields of each row; it raises ValueError or ArithmeticError for unusable ones.

    Where a row ends in a number, `needs_line_end` drops a last line without line end. Raises DataError as
    `read_numbers` does.
    """
    good, bad, first_bad = 0, 0, ""
    place = f"{path.parent.name}/{path.name}"
    for number, line, ended in _lines(path, problems):
        where = f"line {number}"
        if needs_line_end and not ended:
            problems.count(f"{place}: last line cut short", where)
            break
        try:
            row = parse(line.split(separator))
        except ArithmeticError:
            kind = "rows with NaN or infinity"
        except ValueError:
            kind = "rows that cannot be read" if ended else "last line cut short"
            if number == 1 and ended:
                continue  # a header without the comment sign
        else:
            good += 1
            yield row
            continue
        problems.count(f"{place}: {kind}", where)
        if ended:
            bad += 1
            first_bad = first_bad or f"{path}:{number}: {line[:60]!r}"
            if bad > good and bad >= _MANY_ROWS:
                break  # no need to wade through the rest of something that is no table
    if bad > good and (good + bad >= _ENOUGH_ROWS or good == 0):
        raise DataError(
            f"{first_bad} cannot be used, like {bad} of the {good + bad} rows read; repair or export it again"
        )


def read_numbers(
    path: Path,
    columns: int,
    problems: Problems,
    parse_stamp: Callable[[str], int] = parse_ns,
    separator: str | None = ",",
) -> Iterator[Row[list[float]]]:
    """Yield stamp and the next `columns` finite numbers of each row; further columns are ignored.

    A last line without line end is dropped: a number that was cut short still reads as a number.

    Raises:
        DataError: the file cannot be read, is no text table, or most of its rows are unusable.
    """

    def parse(fields: list[str]) -> Row[list[float]]:
        if len(fields) <= columns:
            raise ValueError
        t_ns = parse_stamp(fields[0])
        values = [float(field) for field in fields[1 : columns + 1]]
        if not all(map(math.isfinite, values)):
            raise ArithmeticError
        return t_ns, values

    return read_rows(path, parse, problems, separator, needs_line_end=True)


def read_names(
    path: Path, problems: Problems, parse_stamp: Callable[[str], int] = parse_ns, separator: str | None = ","
) -> Iterator[Row[str]]:
    """Yield stamp and file name of each row; names that lead out of the recording are unusable rows.

    Raises:
        DataError: the file cannot be read, is too large to index, is no text table, or most of its rows are unusable.
    """

    def parse(fields: list[str]) -> Row[str]:
        name = fields[1].strip() if len(fields) > 1 else ""
        parts = name.split("/")
        if not name or name.startswith("/") or ".." in parts or "\0" in name:
            raise ValueError
        return parse_stamp(fields[0]), name

    check_size(path, MAX_FILE_BYTES)
    return read_rows(path, parse, problems, separator, needs_line_end=False)


def film_stamps(film: Path) -> Path:
    """Return the file of the stamps of a film's frames, also as OpenCamera Sensors names it; `ride.csv` if none is."""
    named = [film.with_name(film.stem + end) for end in (".csv", "_timestamps.csv", "_imu_timestamps.csv")]
    return next((file for file in named if file.is_file()), named[0])


def read_frame_stamps(
    path: Path, problems: Problems, parse_stamp: Callable[[str], int] = parse_ns
) -> Iterator[Row[str]]:
    """Yield stamp and frame number of each row of a video's stamp file: the nth row belongs to the nth frame.

    Rows that cannot be used are skipped but keep their frame. Raises DataError as `read_names` does.
    """
    frame = -1

    def parse(fields: list[str]) -> Row[str]:
        nonlocal frame
        if any(map(str.isdigit, fields[0])):  # else it is a header
            frame += 1
        return parse_stamp(fields[0]), str(frame)

    check_size(path, MAX_FILE_BYTES)
    return read_rows(path, parse, problems, ",", needs_line_end=True)


def header(
    path: Path, separator: str | None = ",", fits: Callable[[tuple[str, ...]], bool] | None = None
) -> tuple[str, ...]:
    """Return the names of a table's columns; empty where there is no such table, or none in its first lines.

    Those of a line that `fits`; by default of one with four columns or more and without a number.
    """
    if not path.is_file():
        return ()
    try:
        with open_file(path) as file:
            for _ in range(_HEADER_LINES):
                line = file.readline(MAX_LINE_BYTES).decode("utf-8-sig", errors="replace").strip(" #\r\n")
                names = tuple(name.strip(' #\t"') for name in line.split(separator))
                if fits(names) if fits else len(names) >= 4 and not any(map(is_number, names)):
                    return names
    except OSError:  # which reading reports
        return ()
    return ()


def check_size(path: Path, limit_bytes: int) -> None:
    """Raise DataError when the file is missing or larger than a file of its kind can sensibly be."""
    with readable(path):
        size = path.stat().st_size
    if size > limit_bytes:
        raise DataError(f"{path} has {size} bytes, more than the {limit_bytes} allowed; split the recording")


def in_time_order(
    rows: Iterable[Row[T]], problems: Problems, what: str, keep_equal: bool = False, hole_s: float = 0.0,
    rate_hz: float = 0.0,
) -> Iterator[Row[T]]:  # fmt: skip
    """Yield rows with strictly rising stamps, or with `keep_equal` stamps that do not fall; drop and count the others.

    A stamp that goes back is dropped, unless the stamp before it had leapt ahead: then that one is the wrong one, and
    dropping it saves everything behind it. Holes longer than `hole_s` are counted, if given; `rate_hz` is the stated
    rate, if any.
    """
    judge = problems.judges[what] = StreamJudge(_STREAMS.get(what, what), hole_s=hole_s, rate_hz=rate_hz, recorded=True)
    last_ns: int | None = None
    held: Row[T] | None = None
    for row in rows:
        t_ns, numbers = row[0], row[1] if isinstance(row[1], list) else ()
        if held is None or t_ns > held[0] or (keep_equal and t_ns == held[0]):
            if held is not None:
                yield held
                last_ns = held[0]
            held = row
            judge.takes(t_ns, numbers)
        elif t_ns == held[0]:
            judge.takes(t_ns, numbers)
            problems.count(f"{what}: duplicate stamp", f"{t_ns} ns")
        elif (last_ns is None or t_ns > last_ns) and held[0] - t_ns > _LEAP_NS:
            problems.count(f"{what}: stamp that leaps ahead", f"{held[0]} ns")
            held = row
            judge.correct(t_ns)
        else:
            judge.takes(t_ns, numbers)
            problems.count(f"{what}: backward stamp", f"{t_ns} ns")
    if held is not None:
        yield held
    holes = [event for event in judge.events if hole_s and event.happening is Happening.HOLE]
    for k, hole in enumerate(holes):
        gap = f"gap of {(hole.to_ns - hole.from_ns) * 1e-9:.2f} s at t={hole.from_ns * 1e-9:.3f} s"
        problems.count(f"{judge.stream}: {gap if k < _NAMED_GAPS else 'further gaps'}")


def _lines(path: Path, problems: Problems) -> Iterator[tuple[int, str, bool]]:
    """Yield number, text and whether it was ended, of each line that is neither blank nor a comment."""
    with opened(path) as file:
        yield from _bounded_lines(file, path, problems)


def _bounded_lines(file: IO[bytes], path: Path, problems: Problems) -> Iterator[tuple[int, str, bool]]:
    number = 1
    while raw := file.readline(MAX_LINE_BYTES):
        ended = raw.endswith(b"\n")
        body = raw.strip(b"\0 \t\r\n")
        if b"\0" in raw and not body:  # what a crash leaves of blocks that were never written
            problems.count(f"{path.parent.name}/{path.name}: zero bytes", f"line {number}")
        elif not ended and len(raw) == MAX_LINE_BYTES:
            raise DataError(f"{path}:{number}: a line of {MAX_LINE_BYTES} bytes or more; this is not a text table")
        elif body and not body.startswith((b"#", b"\xef\xbb\xbf#")):
            yield number, body.removeprefix(b"\xef\xbb\xbf").decode("utf-8", errors="replace"), ended
        number += ended
