"""The tables of an MP4 or QuickTime file: which tracks it has, and when and where their samples are.

Only what is needed here of ISO/IEC 14496-12: `moov` with its tracks, their sample tables and edit lists. Every size and
every count is checked against what is there before memory is taken.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.reading import open_file, opened

Integers = NDArray[np.int64]

_MOST_HEADER_BYTES = 2**27  # of a moov: two days of video at 60 Hz
_MOST_SAMPLES = 2**23  # a day and a half at 60 Hz
_MOST_TRACKS = 64
_MOST_BOXES = 4096  # side by side
_SECOND_NS = 10**9


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One track: what it holds, and where and when each of its samples is."""

    handler: str  # vide, soun, meta, ...
    format: str  # of the first sample description: avc1, gpmd, ...
    timescale: int  # ticks a second
    offsets: Integers  # [N] in the file
    sizes: Integers  # [N] bytes
    decoded: Integers  # [N + 1] ticks at which each sample begins to be decoded, and where the last one ends
    shown: Integers  # [N] ticks at which each sample is shown, by its composition offset
    shift_s: float  # what the edit list adds to have the time of the film


@dataclass(frozen=True, slots=True)
class _Box:
    kind: bytes
    body: memoryview


def is_mp4(path: Path) -> bool:
    """Return whether a file begins as MP4 and QuickTime files do."""
    try:
        with open_file(path) as file:
            head = file.read(8)
    except OSError:
        return False
    return len(head) == 8 and head[4:] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


def read_tracks(path: Path) -> list[Track]:
    """Return the tracks of a file, those whose tables are damaged left out.

    Raises DataError when it cannot be read or has no sound `moov`.
    """
    moov = _read_moov(path)
    try:
        size = path.stat().st_size
        film_scale = _film_timescale(moov)
        boxes = [box for box in _boxes(moov) if box.kind == b"trak"][:_MOST_TRACKS]
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: its header is damaged: {error}; copy the file again") from error
    tracks = []
    for box in boxes:
        try:
            tracks.append(_track(box.body, film_scale, size))
        except ValueError:
            continue  # a track of timecode or sound that is odd does not matter here
    return tracks


def frame_times_ns(path: Path) -> Integers:
    """Return when each frame of the video track is shown [N], in order, in ns since the film's beginning.

    Frames that the edit list cuts off at the beginning are left out, as players do. Raises DataError when the file has
    no video track.
    """
    for track in read_tracks(path):
        if track.handler == "vide" and len(track.shown):
            shown = np.sort(track.shown)
            whole, rest = np.divmod(shown, track.timescale)
            t_ns = whole * _SECOND_NS + np.rint(rest * _SECOND_NS / track.timescale).astype(np.int64)
            t_ns += round(track.shift_s * _SECOND_NS)
            return t_ns[t_ns >= 0]
    raise DataError(f"{path} has no table of frame times that can be used; write the stamps into a CSV beside it")


def _read_moov(path: Path) -> memoryview:
    """Return the body of the file's `moov`."""
    with opened(path) as file:
        end = os.fstat(file.fileno()).st_size
        at = 0
        for _ in range(_MOST_BOXES):
            file.seek(at)
            head = file.read(16)
            if len(head) < 8:
                break
            length, begins = _length(head, end - at)
            if not begins <= length <= end - at:
                break
            if head[4:8] == b"moov":
                if length > _MOST_HEADER_BYTES:
                    raise DataError(f"{path}: a header of {length} bytes is larger than any sensible one")
                file.seek(at + begins)
                return memoryview(file.read(length - begins))
            at += length
    raise DataError(f"{path} has no MP4 header (moov): it is cut off or something else; copy the file again")


def _length(head: bytes | memoryview, left: int) -> tuple[int, int]:
    """Return the length of a box with its head, and that of the head."""
    length = int.from_bytes(head[:4], "big")
    if length == 0:
        return left, 8
    return (int.from_bytes(head[8:16], "big"), 16) if length == 1 else (length, 8)


def _boxes(body: memoryview) -> Iterator[_Box]:
    """Yield the boxes side by side in a body; raises ValueError where one is longer than what is left."""
    at = 0
    for _ in range(_MOST_BOXES):
        if len(body) - at < 8:
            return
        length, begins = _length(body[at : at + 16], len(body) - at)
        if not begins <= length <= len(body) - at:
            raise ValueError(f"a box of {length} bytes where {len(body) - at} are left")
        yield _Box(bytes(body[at + 4 : at + 8]), body[at + begins : at + length])
        at += length
    raise ValueError(f"more than {_MOST_BOXES} boxes side by side")


def _inside(body: memoryview, *kinds: bytes) -> memoryview:
    """Return the body of the first box of each kind inside the one before; raises ValueError where it is missing."""
    for kind in kinds:
        found = next((box.body for box in _boxes(body) if box.kind == kind), None)
        if found is None:
            raise ValueError(f"no {kind.decode('latin-1')}")
        body = found
    return body


def _perhaps(body: memoryview, *kinds: bytes) -> memoryview | None:
    try:
        return _inside(body, *kinds)
    except ValueError:
        return None


def _number(body: memoryview, at: int, size: int = 4, signed: bool = False) -> int:
    if len(body) < at + size:
        raise ValueError(f"a box of {len(body)} bytes is too short")
    return int.from_bytes(body[at : at + size], "big", signed=signed)


def _film_timescale(moov: memoryview) -> int:
    header = _inside(moov, b"mvhd")
    return _number(header, 20 if _number(header, 0, 1) else 12) or 1


def _table(body: memoryview, at: int, columns: int, size: int = 4) -> Integers:
    """Return the rows [N, columns] of a table whose count stands at `at`, before it."""
    count = _number(body, at)
    begins = at + 4
    if count > _MOST_SAMPLES or begins + count * columns * size > len(body):
        raise ValueError(f"a table of {count} rows in a box of {len(body)} bytes")
    rows = np.frombuffer(body, f">u{size}", count * columns, begins)
    return rows.astype(np.int64).reshape(count, columns)


def _track(trak: memoryview, film_scale: int, file_bytes: int) -> Track:
    media = _inside(trak, b"mdia")
    header = _inside(media, b"mdhd")
    timescale = _number(header, 20 if _number(header, 0, 1) else 12)
    if timescale == 0:
        raise ValueError("a time scale of zero")
    handler = bytes(_inside(media, b"hdlr")[8:12])
    tables = _inside(media, b"minf", b"stbl")
    described = _inside(tables, b"stsd")
    format_ = bytes(described[12:16])
    sizes = _sizes(_inside(tables, b"stsz"), file_bytes)
    decoded = _expanded(_table(_inside(tables, b"stts"), 4, 2), len(sizes))
    begins = np.concatenate(([0], np.cumsum(decoded)))
    shown = begins[:-1] + _composition(_perhaps(tables, b"ctts"), len(sizes))
    offsets = _offsets(tables, sizes, file_bytes)
    shift_s = _edit_shift_s(_perhaps(trak, b"edts", b"elst"), timescale, film_scale)
    name = handler.decode("latin-1")
    return Track(name, format_.decode("latin-1"), timescale, offsets, sizes, begins, shown, shift_s)


def _sizes(box: memoryview, file_bytes: int) -> Integers:
    every, count = _number(box, 4), _number(box, 8)
    if count > _MOST_SAMPLES:
        raise ValueError(f"{count} samples")
    sizes = np.full(count, every, np.int64) if every else _table(box, 8, 1).ravel()
    if sizes.sum() > file_bytes:
        raise ValueError("samples larger than the file")
    return sizes


def _expanded(runs: Integers, count: int) -> Integers:
    """Return the second column repeated as the first one counts, for `count` samples."""
    repeats = np.minimum(runs[:, 0], count)
    if repeats.sum() < count:
        raise ValueError("a table of fewer samples than there are")
    ends = np.minimum(np.cumsum(repeats), count)  # no more memory than there are samples
    return np.repeat(runs[:, 1], np.diff(ends, prepend=0))


def _composition(box: memoryview | None, count: int) -> Integers:
    if box is None:
        return np.zeros(count, np.int64)
    runs = _table(box, 4, 2)
    runs[:, 1] = runs[:, 1].astype(np.uint32).astype(np.int32)  # of version 0, too, files hold negative ones
    return _expanded(runs, count)


def _offsets(tables: memoryview, sizes: Integers, file_bytes: int) -> Integers:
    """Return where each sample is, from the places of chunks and how many samples each holds."""
    narrow = _perhaps(tables, b"stco")
    chunks = (_table(_inside(tables, b"co64"), 4, 1, 8) if narrow is None else _table(narrow, 4, 1)).ravel()
    runs = _table(_inside(tables, b"stsc"), 4, 3)
    if not len(sizes):
        return sizes
    firsts = runs[:, 0] - 1
    if not len(runs) or firsts[0] != 0 or (np.diff(firsts) <= 0).any() or firsts[-1] >= len(chunks):
        raise ValueError("chunks that do not follow each other")
    per_chunk = np.repeat(np.minimum(runs[:, 1], len(sizes)), np.diff(firsts, append=len(chunks)))
    ends = np.minimum(np.cumsum(per_chunk), len(sizes))
    if ends[-1] < len(sizes):
        raise ValueError("chunks of fewer samples than there are")
    counts = np.diff(ends, prepend=0)
    before = np.concatenate(([0], np.cumsum(sizes)))
    within = before[:-1] - np.repeat(before[ends - counts], counts)
    offsets = np.repeat(chunks, counts) + within
    if (chunks < 0).any() or (offsets + sizes > file_bytes).any():
        raise ValueError("samples beyond the end of the file")
    return offsets


def _edit_shift_s(box: memoryview | None, timescale: int, film_scale: int) -> float:
    """Return what an edit list adds to a track's times: pauses before it, less what is cut off its beginning."""
    if box is None:
        return 0.0
    size = 8 if _number(box, 0, 1) else 4
    shift_s = 0.0
    for k in range(min(_number(box, 4), 16)):
        at = 8 + k * (2 * size + 4)
        duration, begins = _number(box, at, size), _number(box, at + size, size, signed=True)
        if begins >= 0:
            return shift_s - begins / timescale
        shift_s += duration / film_scale
    return shift_s
