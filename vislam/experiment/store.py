"""The results of all comparisons in one SQLite file, by content hash: what is there is never computed again."""

import json
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from vislam.core.database import connect
from vislam.core.errors import DataError, StorageError

_SCHEMA_VERSION = 1
_BUSY_S = 30.0  # another comparison may be writing to the same file
_SCHEMA = """
CREATE TABLE results (
    key TEXT PRIMARY KEY,
    label TEXT NOT NULL,     -- of the job that asked first
    status TEXT NOT NULL,    -- ok | failed
    finished TEXT NOT NULL,  -- UTC
    spec TEXT NOT NULL,      -- JSON
    result TEXT NOT NULL     -- JSON
) WITHOUT ROWID;
"""


class ResultStore:
    """Results by key. Each is written in one transaction, once: a second result for a key is dropped."""

    def __init__(self, path: Path) -> None:
        """Open or make the file. Raises StorageError when it cannot be made, DataError when it is something else."""
        self._path = path
        with self._storage():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = connect(path, timeout=_BUSY_S, isolation_level=None)
            self._prepare()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def __len__(self) -> int:
        with self._storage():
            return int(self._db.execute("SELECT count(*) FROM results").fetchone()[0])

    def add(self, key: str, label: str, spec: dict[str, Any], result: dict[str, Any]) -> bool:
        """Keep a result; return False when there was one already."""
        row = (key, label, result["status"], datetime.now(UTC).isoformat(), json.dumps(spec), json.dumps(result))
        with self._storage():
            done = self._db.execute("INSERT OR IGNORE INTO results VALUES (?, ?, ?, ?, ?, ?)", row)
            return done.rowcount == 1

    def status(self, key: str) -> str | None:
        """Return "ok", "failed", or None when there is no result."""
        with self._storage():
            row = self._db.execute("SELECT status FROM results WHERE key = ?", (key,)).fetchone()
        return None if row is None else str(row[0])

    def get(self, key: str) -> dict[str, Any] | None:
        """Return a result, or None."""
        with self._storage():
            row = self._db.execute("SELECT result FROM results WHERE key = ?", (key,)).fetchone()
        return None if row is None else json.loads(row[0])

    def forget_failures(self, keys: Iterable[str]) -> int:
        """Remove the failed results among `keys`, so that they run again; return how many there were."""
        with self._storage():
            before = self._db.total_changes
            self._db.executemany("DELETE FROM results WHERE key = ? AND status = 'failed'", [(key,) for key in keys])
            return self._db.total_changes - before

    def _prepare(self) -> None:
        self._db.execute("BEGIN IMMEDIATE")  # another comparison may be making the same file
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        is_new = version == 0 and not self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if is_new:
            self._db.execute(_SCHEMA)
            self._db.execute(f"PRAGMA user_version={_SCHEMA_VERSION}")
        self._db.execute("COMMIT")
        if not is_new and version != _SCHEMA_VERSION:
            self._db.close()
            raise DataError(f"{self._path} holds no results of this version ({version}); give another --store")

    @contextmanager
    def _storage(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as error:
            if "not a database" in str(error) or "malformed" in str(error):
                raise DataError(
                    f"{self._path} is damaged or no store of results: {error}; give another --store"
                ) from error
            raise StorageError(
                f"{self._path} cannot be written: {error}; free space or give another --store"
            ) from error
        except OSError as error:
            raise StorageError(f"{self._path} cannot be made: {error}; give another --store") from error
