"""Checksums of a session's records, and its soundness: SQLite itself notices no flipped bit in what it stores."""

import math
import sqlite3
import struct
import zlib
from collections.abc import Iterable
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

from vislam.core.errors import DataError
from vislam.runs.session.schema import (
    APPLICATION_ID,
    FIRST_WITH_FURTHER,
    FIRST_WITH_LABELS,
    FIRST_WITH_MOTIONS,
    FIRST_WITH_READINGS,
    OLDEST_VERSION,
    SCHEMA_VERSION,
    readable,
    schema,
)

# tables: which columns each of the checksums at the end of a row covers; what is changed alone has its own
_COVERED: dict[str, tuple[tuple[int, ...], ...]] = {
    "info": ((0, 1),),
    "keyframes": ((0, 1, 3, 4, 5, 6), (0, 2)),
    "packets": (tuple(range(23)),),
    "windows": (tuple(range(5)),),
    "states": (tuple(range(4)),),
    "edges": (tuple(range(10)), (0, *range(10, 17)), (0, 17, 18)),
    "ties": (tuple(range(3)),),
    "candidates": (tuple(range(1, 12)),),  # the number is SQLite's to give
    "retrieved": (tuple(range(1, 6)),),
    "frames": (tuple(range(11)),),
    "scans": (tuple(range(5)),),
    "tags": (tuple(range(5)),),
    "vocabulary": (tuple(range(4)),),
    "newest": ((0, 1),),
}
_COVERED_LATER: dict[int, dict[str, tuple[tuple[int, ...], ...]]] = {  # by the format that has the tables first
    FIRST_WITH_READINGS: {"readings": (tuple(range(7)),), "own_starts": (tuple(range(5)),)},
    FIRST_WITH_LABELS: {"labels": (tuple(range(2)),)},
    FIRST_WITH_MOTIONS: {"motions": (tuple(range(2)),)},
    FIRST_WITH_FURTHER: {"further": (tuple(range(4)),)},
}
_COVERED_ALL = _COVERED | {table: columns for tables in _COVERED_LATER.values() for table, columns in tables.items()}
_KINDS: dict[str, tuple[type, ...]] = {"INTEGER": (int,), "REAL": (float,), "TEXT": (str,), "BLOB": (bytes,)}
_EXACT = 2**53  # whole numbers below are the same to SQLite, whether they were given as int or as float


def checksum(values: Iterable[Any]) -> int:
    """Return the CRC-32 of values as SQLite gives them back: None, int, float, str or bytes."""
    crc = 0
    for value in values:
        if isinstance(value, bytes):
            crc = zlib.crc32(value, zlib.crc32(b"b%d:" % len(value), crc))  # not joined: clouds have megabytes
        else:
            crc = zlib.crc32(_bytes(value), crc)
    return crc


def checksums(table: str, row: tuple[Any, ...]) -> tuple[int, ...]:
    """Return the checksums that end a row [columns, without checksums] of a table."""
    return tuple(checksum(row[i] for i in columns) for columns in _COVERED_ALL[table])


def check_sound(db: sqlite3.Connection, path: Path) -> None:
    """Raise DataError unless a file is a session of the format read here, with our tables alone, whole in itself."""
    version = check_version(db, path)
    with readable(path):
        if _objects(db) != _known_objects(version):
            raise DataError(
                f"session {path} holds other tables, triggers or views than a run makes; run the recording again"
            )
        fault = db.execute("PRAGMA integrity_check(1)").fetchone()[0]
    if fault != "ok":
        raise DataError(f"session {path} is damaged ({fault}); run the recording again")


def check_records(db: sqlite3.Connection, path: Path) -> None:
    """Raise DataError unless every record is what was written."""
    with readable(path):
        later = [tables for first, tables in _COVERED_LATER.items() if is_since(db, first)]
        for table, covered in [pair for tables in (_COVERED, *later) for pair in tables.items()]:
            stated = [_KINDS[kind] for _, _, kind, *_ in db.execute(f"PRAGMA table_info({table})")]
            for number, row in enumerate(db.execute(f"SELECT * FROM {table}")):
                if not all(value is None or isinstance(value, kinds) for value, kinds in zip(row, stated, strict=True)):
                    raise DataError(
                        f"session {path} is damaged: record {number} of {table} has values of other types; run the "
                        "recording again"
                    )
                count = len(row) - len(covered)
                if checksums(table, row[:count]) != row[count:]:
                    raise DataError(
                        f"session {path} is damaged: record {number} of {table} has another checksum than when it was "
                        "written; run the recording again"
                    )


def is_since(db: sqlite3.Connection, first: int) -> bool:
    """Return whether a session has the tables that format `first` brought: it is not of an older one."""
    return bool(db.execute("PRAGMA user_version").fetchone()[0] >= first)


def check_version(db: sqlite3.Connection, path: Path) -> int:
    """Return the format of a session; raises DataError unless it is one that is read here."""
    with readable(path):
        application = db.execute("PRAGMA application_id").fetchone()[0]
        version = db.execute("PRAGMA user_version").fetchone()[0]
    if application != APPLICATION_ID:
        raise DataError(f"{path} is not a vislam session")
    if version > SCHEMA_VERSION:
        raise DataError(f"{path} has session format {version}, this vislam reads {SCHEMA_VERSION}; update vislam")
    if version < OLDEST_VERSION:
        raise DataError(
            f"{path} has session format {version}, this vislam reads {OLDEST_VERSION}; run the recording again"
        )
    return int(version)


def _bytes(value: Any) -> bytes:
    if value is None or (isinstance(value, float) and math.isnan(value)):  # SQLite keeps NaN as NULL
        return b"n"
    if isinstance(value, str):
        text = value.encode("utf-8", errors="surrogatepass")
        return b"t%d:" % len(text) + text
    if isinstance(value, float) and not (value.is_integer() and abs(value) < _EXACT):
        return b"f" + struct.pack("<d", value)
    return b"i%d" % int(value) if isinstance(value, int | float) else b""  # SQLite takes nothing else


def _objects(db: sqlite3.Connection) -> set[tuple[Any, ...]]:
    return set(db.execute("SELECT type, name, tbl_name, sql FROM sqlite_master"))


@cache
def _known_objects(version: int) -> set[tuple[Any, ...]]:
    with closing(sqlite3.connect(":memory:")) as db:
        for statement in schema(version).split(";"):
            db.execute(statement)
        return _objects(db)
