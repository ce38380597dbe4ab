"""Databases of rosbag 2 (`.db3`), read in the order of their rows as far as the file goes."""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from vislam.core.errors import DataError
from vislam.core.reading import check_file, open_file
from vislam.core.recording import Problems
from vislam.datasets.bags.stored import (
    HEAD_BYTES,
    MOST_MESSAGE_BYTES,
    MOST_TOPICS,
    DamagedError,
    Found,
    Place,
    Topic,
    message_type,
)

MAGIC = b"SQLite format 3\0"
_ERRORS = (sqlite3.Error, ValueError, OverflowError, MemoryError)  # ValueError: of its own message that is no text
_SMALL_BYTES = 2**12  # a message whose beginning is read with its row; of larger ones that alone is fetched
_STEP_ROWS = 1000  # of one question; a row that cannot be read costs no more than those behind it


class Database:
    """One database of rosbag 2."""

    def __init__(self, path: Path, file: int) -> None:
        """Open it for reading. Raises OSError, and DataError when it is no database."""
        check_file(path)
        self._path = path
        self._file = file
        self._lock = threading.Lock()
        journal = path.with_name(f"{path.name}-wal")
        mode = "mode=ro" if journal.exists() else "immutable=1"
        try:
            self._base = sqlite3.connect(f"file:{quote(str(path.resolve()))}?{mode}", uri=True, check_same_thread=False)
            self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_MESSAGE_BYTES)
            self._base.execute("PRAGMA trusted_schema=OFF")
            if _is_cut_off(path):  # else sqlite refuses it altogether
                self._base.execute("PRAGMA writable_schema=ON")
            self._base.execute("PRAGMA cache_size=-8192")
            self._base.text_factory = lambda data: data.decode("utf-8", "replace")
        except _ERRORS as error:
            raise DataError(f"{path} cannot be read as a database: {error}") from error

    def close(self) -> None:
        """Close the database."""
        self._base.close()

    def read(self, place: Place) -> bytes:
        """Return the bytes of a message; raises DamagedError."""
        try:
            with self._lock:
                row = self._base.execute("SELECT data FROM messages WHERE rowid = ?", (place.at,)).fetchone()
        except _ERRORS as error:
            raise DamagedError(f"message that cannot be read: {error}") from error
        if row is None or not isinstance(row[0], bytes):
            raise DamagedError("message that is gone")
        return row[0]

    def scan(self, problems: Problems) -> Iterator[Found]:
        """Yield the messages in the order of their rows; raises DataError when it is no database of rosbag 2."""
        topics = self._topics()
        problems.count(f"{self._path.name}: cut off", times=int(_is_cut_off(self._path)))
        last = -(2**63)
        while rows := self._rows(last, problems):
            for row, topic_id, log_ns, length, data in rows:
                if not isinstance(row, int) or row <= last:
                    problems.count(f"{self._path.name}: rows out of order")
                    return
                last = row
                if isinstance(log_ns, int) and isinstance(length, int) and isinstance(data, bytes):
                    if (topic := topics.get(topic_id)) is None:
                        problems.count(f"{self._path.name}: message on an unknown topic", f"row {row}")
                        continue
                    place = Place(self._file, -1, row, length)
                    yield Found(topic, log_ns, place, data)
                else:
                    problems.count(f"{self._path.name}: row that is no message", f"row {row}")

    def _rows(self, last: int, problems: Problems) -> list[tuple[object, int, object, object, object]]:
        """Return the next rows, none at the end or where the rest cannot be read."""
        found: list[tuple[object, int, object, object, object]] = []
        asked = (
            "SELECT rowid, topic_id, timestamp, length(data), CASE WHEN typeof(data) = 'blob' AND length(data) > ? "
            "THEN NULL ELSE substr(data, 1, ?) END FROM messages WHERE rowid > ? ORDER BY rowid LIMIT ?"
        )
        try:
            with self._lock:
                for row in self._base.execute(asked, (_SMALL_BYTES, HEAD_BYTES, last, _STEP_ROWS)):
                    # those before a row that cannot be read stay
                    found.append(row if row[4] is not None or row[3] is None else (*row[:4], self._beginning(row[0])))
        except _ERRORS as error:
            if not found:
                problems.count(f"{self._path.name}: cut off or damaged: {error}", f"behind row {last}")
        return found

    def _beginning(self, row: int) -> bytes:
        """Return the first bytes of a large message; `substr` would read all of it. Raises sqlite3.Error."""
        with self._base.blobopen("messages", "data", row, readonly=True) as blob:
            return blob.read(HEAD_BYTES)

    def _topics(self) -> dict[int, Topic]:
        kinds = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND rootpage > 0 AND name = ?"
        try:
            with self._lock:
                for table in ("topics", "messages"):
                    if self._base.execute(kinds, (table,)).fetchone()[0] != 1:
                        raise DataError(f"{self._path} is no database of rosbag 2: no table {table}")
                asked = f"SELECT id, name, type, serialization_format FROM topics LIMIT {MOST_TOPICS}"
                rows = self._base.execute(asked).fetchall()
        except _ERRORS as error:
            raise DataError(f"{self._path} cannot be read as a database of rosbag 2: {error}") from error
        return {row[0]: Topic(str(row[1]), message_type(str(row[2])), str(row[3])) for row in rows}


def _is_cut_off(path: Path) -> bool:
    """Return whether a database is shorter than its first page states."""
    with open_file(path) as file:
        head = file.read(32)
        size = os.fstat(file.fileno()).st_size
    page = int.from_bytes(head[16:18], "big")
    return size < (2**16 if page == 1 else page) * int.from_bytes(head[28:32], "big")
