"""The crash-safe store of a run: every keyframe with all that was measured, every edge and the newest poses, in SQLite.

A keyframe is committed in one transaction, so whatever ends the process leaves the last committed keyframe readable.
Arrays are stored as raw little-endian bytes with fixed types; nothing is pickled. What is stored is also the factor
log: `Session.factor_log` gives everything that a batch estimate needs, without an image.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.camera import Rig
from vislam.errors import DataError, StorageError
from vislam.factor_log import (
    FactorLog,
    LoggedEdge,
    LoggedKeyframe,
    rig_data,
    rig_from,
    state_data,
    state_from,
)
from vislam.frames import LoggedFrames
from vislam.imu import ImuNoise
from vislam.messages import (
    Array,
    Frame,
    GraphUpdate,
    ImuSpan,
    Keyframe,
    KeyframePacket,
    LoopEdge,
    MagSample,
    NavState,
    Observations,
    Tracking,
    VoMeasurement,
)

_APPLICATION_ID = 0x5649534C  # "VISL": tells our files from other SQLite files
_SCHEMA_VERSION = 2
_MAX_BLOB_BYTES = 64 * 2**20  # no keyframe of ours comes near; a larger one is damage
_DESCRIPTOR_BYTES = 32

_SCHEMA = """
CREATE TABLE info (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE keyframes (
    id INTEGER PRIMARY KEY, t_ns INTEGER NOT NULL,
    T_map_body BLOB NOT NULL, T_odom_body BLOB NOT NULL,
    keypoints_px BLOB NOT NULL, descriptors BLOB NOT NULL, points_body_m BLOB
);
CREATE TABLE packets (
    id INTEGER PRIMARY KEY,
    vo_t_ns INTEGER NOT NULL, vo_keyframe_id INTEGER NOT NULL, vo_T BLOB, vo_covariance BLOB NOT NULL,
    vo_has_scale INTEGER NOT NULL, vo_tracking TEXT NOT NULL, vo_inliers INTEGER NOT NULL,
    track_ids BLOB NOT NULL, pixels_px BLOB NOT NULL, right_px BLOB, depth_m BLOB,
    imu_t_ns BLOB, imu_gyro BLOB, imu_accel BLOB, mag_t_ns INTEGER, mag_field BLOB,
    at_rest INTEGER NOT NULL, time_offset_s REAL NOT NULL, state BLOB
);
CREATE TABLE edges (
    id INTEGER PRIMARY KEY, from_id INTEGER NOT NULL, to_id INTEGER NOT NULL,
    T_from_to BLOB NOT NULL, covariance BLOB NOT NULL, has_scale INTEGER NOT NULL, inliers INTEGER NOT NULL,
    score REAL NOT NULL, accepted INTEGER NOT NULL
);
CREATE TABLE frames (t_ns INTEGER PRIMARY KEY, keyframe_id INTEGER NOT NULL, T_keyframe_body BLOB);
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

    def __init__(self, path: Path, info: dict[str, Any], rig: Rig, noise: ImuNoise | None, gravity_m_s2: float) -> None:
        """Create the file; `info` (config, source) is stored as JSON. Raises StorageError when it cannot be.

        `noise` is None where there is no IMU.
        """
        self.path = path
        self._frames: list[tuple[int, int, bytes | None]] = []
        self._begun = False
        sensors = {"rig": rig_data(rig), "imu_noise": None if noise is None else asdict(noise)}
        entries = {**info, **sensors, "gravity_m_s2": gravity_m_s2}
        with _storage(path):
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.execute(f"PRAGMA application_id={_APPLICATION_ID}")
            self._db.execute(f"PRAGMA user_version={_SCHEMA_VERSION}")
            self._db.executescript(_SCHEMA)
            rows = [(key, json.dumps(value)) for key, value in entries.items()]
            self._db.executemany("INSERT INTO info VALUES (?, ?)", rows)

    def add_frame(self, t_ns: int, keyframe_id: int, T_keyframe_body: Array | None) -> None:
        """Remember where a frame is relative to its keyframe; it is committed with the next keyframe, or by `close`."""
        blob = None if T_keyframe_body is None else _to_bytes(T_keyframe_body, "<f8")
        self._frames.append((t_ns, keyframe_id, blob))

    def add(
        self,
        packet: KeyframePacket,
        T_odom_body: Array,
        update: GraphUpdate,
        edges: Sequence[LoopEdge],
        first_state: NavState | None = None,
    ) -> None:
        """Commit a keyframe, the loop edges offered with it, the frames since the last, and what its update changed.

        `first_state` is that of the first keyframe (None: vision alone) and is taken with that one only.
        """
        keyframe = packet.keyframe
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
        packet_row = _packet_row(packet, update.newest)
        with _storage(self.path), self._transaction():
            if not self._begun:
                data = json.dumps(None if first_state is None else state_data(first_state))
                self._db.execute("INSERT INTO info VALUES (?, ?)", ("first_state", data))
            self._db.execute("INSERT INTO keyframes VALUES (?, ?, ?, ?, ?, ?, ?)", row)
            self._db.execute(f"INSERT INTO packets VALUES ({', '.join('?' * len(packet_row))})", packet_row)
            # an id that was used before is refused by the graph; the first edge of that id stays
            self._db.executemany(
                "INSERT OR IGNORE INTO edges VALUES (?, ?, ?, ?, ?, ?, ?, ?, 0)", [_edge_row(edge) for edge in edges]
            )
            self._write_frames()
            self._move(update)
        self._begun = True

    def move(self, update: GraphUpdate) -> None:
        """Commit the poses that an update moved."""
        with _storage(self.path), self._transaction():
            self._move(update)

    def close(self) -> None:
        """Fold the write-ahead log into the file, which is then all there is, and close it."""
        with _storage(self.path):
            with self._transaction():
                self._write_frames()
            self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._db.execute("PRAGMA journal_mode=DELETE")  # so that readers leave no files beside it
            self._db.close()

    def _move(self, update: GraphUpdate) -> None:
        rows = [(_to_bytes(T, "<f8"), int(i)) for i, T in zip(update.ids, update.T_map_body, strict=True)]
        self._db.executemany("UPDATE keyframes SET T_map_body = ? WHERE id = ?", rows)
        decided = [(1, i) for i in update.accepted_loop_ids] + [(0, i) for i in update.rejected_loop_ids]
        self._db.executemany("UPDATE edges SET accepted = ? WHERE id = ?", decided)

    def _write_frames(self) -> None:
        self._db.executemany("INSERT OR REPLACE INTO frames VALUES (?, ?, ?)", self._frames)
        self._frames = []

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
            step = "update vislam" if version > _SCHEMA_VERSION else "run the recording again"
            raise DataError(f"{path} has session format {version}, this vislam reads {_SCHEMA_VERSION}; {step}")

    def info(self) -> dict[str, Any]:
        """Return what the writer stored about the run."""
        with _readable(self.path):
            rows = self._db.execute("SELECT key, value FROM info").fetchall()
        try:
            return {key: json.loads(value) for key, value in rows}
        except ValueError as error:
            raise DataError(f"{self.path} is damaged ({error}); run the recording again") from error

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
        for logged in self._edges():
            edge = logged.edge
            if logged.accepted:
                yield StoredEdge(
                    edge.id, edge.from_id, edge.to_id, edge.T_from_to, edge.covariance, edge.has_scale, edge.inliers
                )

    def factor_log(self) -> FactorLog:
        """Return all that was measured up to the last committed keyframe; raises DataError when it is damaged."""
        info = self.info()
        try:
            noise, first = info["imu_noise"], info.get("first_state")
            return FactorLog(
                rig=rig_from(info["rig"]),
                noise=None if noise is None else ImuNoise(**noise),
                gravity_m_s2=float(info["gravity_m_s2"]),
                first_state=None if first is None else state_from(first),
                keyframes=self._logged_keyframes(),
                edges=list(self._edges()),
                frames=self._logged_frames(),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            reason = f"{type(error).__name__}: {error}"
            raise DataError(f"{self.path} is damaged ({reason}); run the recording again") from error

    def _edges(self) -> Iterator[LoggedEdge]:
        with _readable(self.path):
            for row in self._db.execute("SELECT * FROM edges ORDER BY id"):
                T, covariance = self._numbers(row[3], "<f8", (4, 4)), self._numbers(row[4], "<f8", (6, 6))
                edge = LoopEdge(row[0], row[1], row[2], T, covariance, bool(row[5]), row[6], row[7])
                yield LoggedEdge(edge, bool(row[8]))

    def _logged_keyframes(self) -> list[LoggedKeyframe]:
        query = "SELECT k.t_ns, k.T_map_body, k.T_odom_body, p.* FROM keyframes k JOIN packets p USING (id) ORDER BY id"
        out: list[LoggedKeyframe] = []
        with _readable(self.path):
            count = self._db.execute("SELECT COUNT(*) FROM keyframes").fetchone()[0]
            for t_ns, T_map_body, T_odom_body, *row in self._db.execute(query):
                if row[0] != len(out):
                    raise ValueError(f"keyframe {len(out)} is missing")
                state = None if row[19] is None else self._numbers(row[19], "<f8", (3, 3))
                out.append(
                    LoggedKeyframe(
                        self._packet(t_ns, row),
                        T_odom_body=self._numbers(T_odom_body, "<f8", (4, 4)),
                        T_map_body=self._numbers(T_map_body, "<f8", (4, 4)),
                        velocity_map_m_s=None if state is None else state[0],
                        gyro_bias_rad_s=None if state is None else state[1],
                        accel_bias_m_s2=None if state is None else state[2],
                    )
                )
        if len(out) != count:
            raise ValueError(f"{count} keyframes but {len(out)} packets")
        return out

    def _packet(self, t_ns: int, row: list[Any]) -> KeyframePacket:
        number = self._numbers
        T = None if row[3] is None else number(row[3], "<f8", (4, 4))
        vo = VoMeasurement(row[1], row[2], T, number(row[4], "<f8", (6, 6)), bool(row[5]), Tracking(row[6]), row[7])
        ids = _integers(row[8], self.path)
        n = len(ids)
        right = None if row[10] is None else number(row[10], "<f4", (n, 2))
        depth = None if row[11] is None else number(row[11], "<f4", (n,))
        imu = None
        if row[12] is not None:
            stamps = _integers(row[12], self.path)
            shape = (len(stamps), 3)
            imu = ImuSpan(stamps, number(row[13], "<f8", shape), number(row[14], "<f8", shape))
        mag = None if row[15] is None else MagSample(row[15], number(row[16], "<f8", (3,)))
        keyframe = Keyframe(
            row[0], t_ns, Frame(t_ns, row[0], ()), np.zeros((0, 2)), np.zeros((0, _DESCRIPTOR_BYTES), np.uint8), None
        )
        observations = Observations(ids, number(row[9], "<f4", (n, 2)), right, depth)
        return KeyframePacket(keyframe, vo, observations, imu, mag, bool(row[17]), float(row[18]))

    def _logged_frames(self) -> LoggedFrames:
        with _readable(self.path):
            rows = self._db.execute("SELECT * FROM frames ORDER BY t_ns").fetchall()
        poses = [None if blob is None else self._numbers(blob, "<f8", (4, 4)) for _, _, blob in rows]
        return LoggedFrames(
            np.array([row[0] for row in rows], np.int64), np.array([row[1] for row in rows], np.int64), poses
        )

    def _numbers(self, blob: bytes, dtype: str, shape: tuple[int, ...]) -> Array:
        return _from_bytes(blob, dtype, shape, self.path)

    def close(self) -> None:
        """Close the file."""
        self._db.close()


def _edge_row(edge: LoopEdge) -> tuple[Any, ...]:
    T, covariance = _to_bytes(edge.T_from_to, "<f8"), _to_bytes(edge.covariance, "<f8")
    return (edge.id, edge.from_id, edge.to_id, T, covariance, int(edge.has_scale), edge.inliers, float(edge.score))


def _packet_row(packet: KeyframePacket, newest: NavState | None) -> tuple[Any, ...]:
    vo, seen, imu, mag = packet.vo, packet.observations, packet.imu, packet.mag
    state = None
    if newest is not None and newest.t_ns == packet.keyframe.t_ns:
        rows = np.stack([newest.velocity_world_m_s, newest.gyro_bias_rad_s, newest.accel_bias_m_s2])
        state = _to_bytes(rows, "<f8")

    def maybe(values: NDArray[Any] | None, dtype: str) -> bytes | None:
        return None if values is None else _to_bytes(values, dtype)

    return (
        packet.keyframe.id, vo.t_ns, vo.keyframe_id, maybe(vo.T_keyframe_body, "<f8"), _to_bytes(vo.covariance, "<f8"),
        int(vo.has_scale), str(vo.tracking), int(vo.inliers), _to_bytes(seen.track_ids, "<i8"),
        _to_bytes(seen.pixels_px, "<f4"), maybe(seen.right_px, "<f4"), maybe(seen.depth_m, "<f4"),
        None if imu is None else _to_bytes(imu.t_ns, "<i8"), None if imu is None else _to_bytes(imu.gyro_rad_s, "<f8"),
        None if imu is None else _to_bytes(imu.accel_m_s2, "<f8"), None if mag is None else mag.t_ns,
        None if mag is None else _to_bytes(mag.field_ut, "<f8"), int(packet.at_rest), packet.time_offset_s, state,
    )  # fmt: skip


def _integers(blob: bytes, path: Path) -> NDArray[np.int64]:
    if len(blob) > _MAX_BLOB_BYTES or len(blob) % 8:
        raise DataError(f"{path} is damaged (a field of {len(blob)} bytes); run the recording again")
    return np.frombuffer(blob, dtype="<i8").astype(np.int64)


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
