"""SQLite files that may come from anywhere, opened so that nothing stored in them is ever executed."""

import sqlite3
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from vislam.core.reading import check_file


def connect(path: Path, read_only: bool = False, **options: Any) -> sqlite3.Connection:
    """Return a connection on which triggers and views of the file are refused; `options` are those of sqlite3.

    Without `read_only` the file is made where there is none. Raises sqlite3.Error, and OSError for what is no file.
    """
    if read_only or path.exists():
        check_file(path)
    if read_only and Path(f"{path}-journal").exists():
        with suppress(sqlite3.Error, OSError):  # a place that cannot be written
            _roll_back(path)
    name = f"file:{quote(str(path))}?mode={'ro' if read_only else 'rwc'}"
    db = sqlite3.connect(name, uri=True, **options)
    try:
        db.execute("PRAGMA trusted_schema=OFF")  # no function with effects in defaults, checks and indexes
        if sys.version_info >= (3, 12):
            db.setconfig(sqlite3.SQLITE_DBCONFIG_DEFENSIVE, True)
            db.setconfig(sqlite3.SQLITE_DBCONFIG_ENABLE_TRIGGER, False)
            db.setconfig(sqlite3.SQLITE_DBCONFIG_ENABLE_VIEW, False)
        db.set_authorizer(_allowed)
    except BaseException:
        db.close()
        raise
    return db


def _roll_back(path: Path) -> None:
    """Undo what a process had begun that was killed; its journal stops everybody who may only read."""
    db = connect(path)
    try:
        db.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()
    finally:
        db.close()


def _allowed(action: int, first: str | None, second: str | None, database: str | None, by: str | None) -> int:
    """Refuse whatever a trigger or a view of the file asks for; `by` names it."""
    return sqlite3.SQLITE_OK if by is None else sqlite3.SQLITE_DENY
