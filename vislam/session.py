"""The crash-safe store of a run: every keyframe, edge and the newest poses in one SQLite file.

A keyframe is committed in one transaction, so whatever ends the process leaves the last committed keyframe readable.
Arrays are stored as raw little-endian bytes with fixed types; nothing is pickled.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.errors import DataError, StorageError
from vislam.messages import Array, GraphUpdate, Keyframe, LoopEdge

_APPLICATION_ID = 0x5649534C  # "VISL": tells our files from other SQLite files
_SCHEMA_VERSION = 1
_MAX_BLOB_BYTES = 64 * 2**20  # no keyframe of ours comes near; a larger one is damage
_DESCRIPTOR_BYTES = 32

_SCHEMA = """
CREATE TABLE info (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE keyframes (
    id INTEGER PRIMARY KEY, t_ns INTEGER NOT NULL,
    T_map_body BLOB NOT NULL, T_odom_body BLOB NOT NULL,
    keypoints_px BLOB NOT NULL, descriptors BLOB NOT NULL, points_body_m BLOB
);
CREATE TABLE edges (
    id INTEGER PRIMARY KEY, from_id INTEGER NOT NULL, to_id INTEGER NOT NULL,
    T_from_to BLOB NOT NULL, covariance BLOB NOT NULL, has_scale INTEGER NOT NULL, inliers INTEGER NOT NULL
);
"""


@dataclass(frozen=True, slots=True, eq=False)
class StoredKeyframe:
    """A keyframe as a session keeps it: features and geometry, no image."""

    id: int
    t_ns: int
    T_map_body: Array  # [4, 4]
    T_odom_body: Array  # [4, 4]
    keypoints_px: Array  # [N, 2]
    descriptors: NDArray[np.uint8]  # [N, 32]
    points_body_m: Array | None  # [N, 3]


@dataclass(frozen=True, slots=True, eq=False)
class StoredEdge:
    """An accepted loop edge as a session keeps it."""

    id: int
    from_id: int
    to_id: int
    T_from_to: Array  # [4, 4]
    covariance: Array  # [6, 6]
    has_scale: bool
    inliers: int


class SessionWriter:
    """Writes a new session file, one transaction per keyframe."""

    def __init__(self, path: Path, info: dict[str, Any]) -> None:
        """Create the file; `info` (rig, config, source) is stored as JSON. Raises StorageError when it cannot be."""
        self.path = path
        with _storage(path):
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.execute(f"PRAGMA application_id={_APPLICATION_ID}")
            self._db.execute(f"PRAGMA user_version={_SCHEMA_VERSION}")
            self._db.executescript(_SCHEMA)
            rows = [(key, json.dumps(value)) for key, value in info.items()]
            self._db.executemany("INSERT INTO info VALUES (?, ?)", rows)

    def add(self, keyframe: Keyframe, T_odom_body: Array, update: GraphUpdate, edges: Sequence[LoopEdge]) -> None:
        """Commit a keyframe, the loop edges accepted with it and the poses that its update moved."""
        poses = dict(zip(update.ids.tolist(), update.T_map_body, strict=True))
        T_map_body = poses.get(keyframe.id, update.T_map_odom @ T_odom_body)
        points = keyframe.points_body_m
        row = (
            keyframe.id,
            keyframe.t_ns,
            _to_bytes(T_map_body, "<f8"),
            _to_bytes(T_odom_body, "<f8"),
            _to_bytes(keyframe.keypoints_px, "<f4"),
            _to_bytes(keyframe.descriptors, "u1"),
            None if points is None else _to_bytes(points, "<f4"),
        )
        accepted = [edge for edge in edges if edge.id in update.accepted_loop_ids]
        with _storage(self.path), self._transaction():
            self._db.execute("INSERT INTO keyframes VALUES (?, ?, ?, ?, ?, ?, ?)", row)
            self._db.executemany("INSERT INTO edges VALUES (?, ?, ?, ?, ?, ?, ?)", [_edge_row(e) for e in accepted])
            self._move(update)

    def move(self, update: GraphUpdate) -> None:
        """Commit the poses that an update moved."""
        with _storage(self.path), self._transaction():
            self._move(update)

    def close(self) -> None:
        """Fold the write-ahead log into the file and close it."""
        with _storage(self.path):
            self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._db.close()

    def _move(self, update: GraphUpdate) -> None:
        rows = [(_to_bytes(T, "<f8"), int(i)) for i, T in zip(update.ids, update.T_map_body, strict=True)]
        self._db.executemany("UPDATE keyframes SET T_map_body = ? WHERE id = ?", rows)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN")
        try:
            yield
            self._db.execute("COMMIT")
        except BaseException:
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            raise


class Session:
    """A stored session, read only."""

    def __init__(self, path: Path) -> None:
        """Open a session file; raises DataError when it is missing, not ours, damaged or of a newer version."""
        self.path = path
        if not path.is_file():
            raise DataError(f"no session at {path}; a run leaves one as session.db")
        with _readable(path):
            self._db = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
            application = self._db.execute("PRAGMA application_id").fetchone()[0]
            version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if application != _APPLICATION_ID:
            raise DataError(f"{path} is not a vislam session")
        if version != _SCHEMA_VERSION:
            raise DataError(f"{path} has session format {version}, this vislam reads {_SCHEMA_VERSION}; update vislam")

    def info(self) -> dict[str, Any]:
        """Return what the writer stored about the run."""
        with _readable(self.path):
            return {key: json.loads(value) for key, value in self._db.execute("SELECT key, value FROM info")}

    def keyframes(self) -> Iterator[StoredKeyframe]:
        """Yield the keyframes in order of their ids."""
        with _readable(self.path):
            for row in self._db.execute("SELECT * FROM keyframes ORDER BY id"):
                descriptors = _from_bytes(row[5], "u1", (-1, _DESCRIPTOR_BYTES), self.path).astype(np.uint8)
                shape = (len(descriptors), 3)
                points = None if row[6] is None else _from_bytes(row[6], "<f4", shape, self.path)
                yield StoredKeyframe(
                    id=row[0],
                    t_ns=row[1],
                    T_map_body=_from_bytes(row[2], "<f8", (4, 4), self.path),
                    T_odom_body=_from_bytes(row[3], "<f8", (4, 4), self.path),
                    keypoints_px=_from_bytes(row[4], "<f4", (len(descriptors), 2), self.path),
                    descriptors=descriptors,
                    points_body_m=points,
                )

    def edges(self) -> Iterator[StoredEdge]:
        """Yield the accepted loop edges in order of their ids."""
        with _readable(self.path):
            for row in self._db.execute("SELECT * FROM edges ORDER BY id"):
                yield StoredEdge(
                    id=row[0],
                    from_id=row[1],
                    to_id=row[2],
                    T_from_to=_from_bytes(row[3], "<f8", (4, 4), self.path),
                    covariance=_from_bytes(row[4], "<f8", (6, 6), self.path),
                    has_scale=bool(row[5]),
                    inliers=row[6],
                )

    def close(self) -> None:
        """Close the file."""
        self._db.close()


def _edge_row(edge: LoopEdge) -> tuple[Any, ...]:
    T, covariance = _to_bytes(edge.T_from_to, "<f8"), _to_bytes(edge.covariance, "<f8")
    return (edge.id, edge.from_id, edge.to_id, T, covariance, int(edge.has_scale), edge.inliers)


def _to_bytes(values: NDArray[Any], dtype: str) -> bytes:
    return np.ascontiguousarray(values, dtype=dtype).tobytes()


def _from_bytes(blob: bytes, dtype: str, shape: tuple[int, ...], path: Path) -> Array:
    try:
        if len(blob) > _MAX_BLOB_BYTES:
            raise ValueError(f"a field of {len(blob)} bytes")
        return np.frombuffer(blob, dtype=dtype).reshape(shape).astype(np.float64)
    except ValueError as error:
        raise DataError(f"{path} is damaged ({error}); run the recording again") from error


@contextmanager
def _storage(path: Path) -> Iterator[None]:
    try:
        yield
    except (sqlite3.Error, OSError) as error:
        raise StorageError(
            f"session {path} cannot be written: {error}; free disk space or choose another --out"
        ) from error


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise DataError(f"session {path} cannot be read: {error}; run the recording again") from error
