"""Writing a session, one transaction per keyframe."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, astuple
from pathlib import Path
from typing import Any

from vislam.core.camera import Rig
from vislam.core.database import connect
from vislam.core.errors import DataError
from vislam.core.memory import (
    FrameEntry,
    GraphRecord,
    KeyframeEntry,
    Learned,
    LoopPlace,
    LoopState,
    StartFacts,
    TagSighting,
)
from vislam.core.messages import Array, GraphUpdate, LoopCandidate, LoopDecision, LoopEdge, NavState
from vislam.core.up import Up
from vislam.factors import rig_data, state_data
from vislam.imu import ImuNoise
from vislam.runs.session.checks import check_records, check_sound, checksum, checksums
from vislam.runs.session.packets import further_rows, packet_row
from vislam.runs.session.reader import Session
from vislam.runs.session.reading_rows import own_data, reading_rows, start_rows
from vislam.runs.session.schema import (
    APPLICATION_ID,
    SCHEMA_VERSION,
    maybe_bytes,
    numbers,
    readable,
    schema,
    state_bytes,
    storage,
    to_bytes,
    window_bytes,
)

_ROWS_OF_PACKETS = {"further": further_rows, "readings": reading_rows, "own_starts": start_rows}


class SessionWriter:
    """Owns a session file while a run writes it."""

    def __init__(self, path: Path, db: sqlite3.Connection) -> None:
        """Write through an open database; `create`, `reopen` and `in_map` return a writer, `amend` uses one."""
        self.path, self._db = path, db
        self._frames: list[FrameEntry] = []
        self._edges = 0
        self._first_id = 0  # of the keyframes of this recording

    @classmethod
    def create(
        cls, path: Path, info: dict[str, Any], rig: Rig, noise: ImuNoise | None, gravity_m_s2: float
    ) -> SessionWriter:
        """Create the file; `info` (config, source) is stored as JSON. Raises StorageError when it cannot be.

        `noise` is None where there is no IMU.
        """
        writer = cls(path, _opened(path))
        sensors = {"rig": rig_data(rig), "imu_noise": None if noise is None else asdict(noise)}
        with storage(path), writer._transaction():  # half of the tables would be a file that cannot be opened again
            writer._db.execute(f"PRAGMA application_id={APPLICATION_ID}")
            for statement in schema(SCHEMA_VERSION).split(";"):
                writer._db.execute(statement)
            writer._set_info({**info, **sensors, "gravity_m_s2": gravity_m_s2, "finished": False})
            writer._db.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
        return writer

    @classmethod
    def reopen(cls, path: Path) -> SessionWriter:
        """Open the file of a run that was ended by whatever, to go on after its last keyframe.

        Raises DataError when it is missing, not ours or damaged, StorageError when it cannot be written.
        """
        if not path.is_file():
            raise DataError(f"no session at {path}; a run leaves one as session.db")
        with readable(path), closing(connect(path)) as probe:  # what a write-ahead log holds is taken in
            check_sound(probe, path)
            check_records(probe, path)
        writer = cls(path, db := _opened(path))
        with storage(path), writer._transaction():
            writer._bring_up()
            newest_id, newest_t_ns = db.execute("SELECT id, t_ns FROM keyframes ORDER BY id DESC").fetchone() or (-1, 0)
            db.execute("DELETE FROM frames WHERE t_ns > ? OR keyframe_id > ?", (newest_t_ns, newest_id))
            db.execute("DELETE FROM motions WHERE t_ns NOT IN (SELECT t_ns FROM frames)")
            base = writer.base()
            writer._first_id = 0 if base is None else int(base["keyframes"])
            writer._edges = db.execute("SELECT COALESCE(MAX(number) + 1, 0) FROM edges").fetchone()[0]
        return writer

    @classmethod
    def in_map(
        cls, path: Path, base: Session, info: dict[str, Any], noise: ImuNoise | None, localize_only: bool,
        with_scans: bool, up: Up | None,
    ) -> SessionWriter:  # fmt: skip
        """Create the file of a run that begins in the map of another session, of which it holds a copy.

        Without `with_scans` it holds no clouds of it: those of another shape could not be read with its own settings.
        `up` is that of the map, if it was made without gravity: the copy is turned so that it is +z.
        Raises StorageError when it cannot be written.
        """
        part = path.with_name(path.name + ".part")  # the file appears whole or not at all
        with storage(path):
            part.unlink(missing_ok=True)
            writer = cls(part, db := connect(part, isolation_level=None))
            base.copy_to(db)
            with writer._transaction():
                writer._bring_up()
                foreign = ("frames", "motions", "candidates", "retrieved", *(() if with_scans else ("scans", "labels")))
                for table in foreign:
                    db.execute(f"DELETE FROM {table}")
                db.execute("DELETE FROM states WHERE whose = 'filter'")
                db.execute("DELETE FROM info WHERE key NOT IN ('rig', 'first_state', 'gravity_m_s2', 'labels')")
                count = db.execute("SELECT COUNT(*) FROM keyframes").fetchone()[0]
                origin = {"path": str(base.path), "keyframes": count, "localize_only": localize_only}
                if up is not None:
                    writer._turn(up.T_level_map)
                    origin["up"] = up.levelled.entry()
                sensors = {"imu_noise": None if noise is None else asdict(noise)}
                writer._set_info({**info, **sensors, "map": origin, "finished": False})
            db.close()
            os.replace(part, path)
        return cls.reopen(path)

    @classmethod
    def amend(cls, path: Path, update: GraphUpdate, record: GraphRecord) -> None:
        """Store in one transaction what was decided otherwise about a run that was ended, and what that moved.

        Raises DataError when the file is missing, not ours or damaged, StorageError when it cannot be written.
        """
        with storage(path):
            writer = cls(path, db := connect(path, isolation_level=None))
        try:
            with readable(path):
                check_sound(db, path)
                newest = json.loads(db.execute("SELECT value FROM newest").fetchone()[0])
            with storage(path), writer._transaction():
                writer._move(update, record)
                changed = {**newest, "revision": update.revision, "vo_scale": record.vo_scale, **_own_record(record)}
                writer._replace("newest", [(1, json.dumps(changed))])
        finally:
            db.close()

    def _bring_up(self) -> None:
        """Give a session of an older format the tables that it lacks."""
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if lacking := schema(SCHEMA_VERSION).removeprefix(schema(version)):
            for statement in lacking.split(";"):
                self._db.execute(statement)
            self._db.execute(f"PRAGMA user_version={SCHEMA_VERSION}")

    def _turn(self, T: Array) -> None:
        """Move `map` and `odom` of all keyframes by T [4, 4]; without gravity nothing else is stored in their axes."""
        for (k,) in self._db.execute("SELECT id FROM keyframes").fetchall():
            row = self._db.execute("SELECT * FROM keyframes WHERE id = ?", (k,)).fetchone()
            poses = (to_bytes(T @ numbers(blob, "<f8", (4, 4)), "<f8") for blob in row[2:4])
            self._replace("keyframes", [(*row[:2], *poses, *row[4:7])])

    def base(self) -> dict[str, Any] | None:
        """Return the map in which the run began, if it did: its path, its number of keyframes, whether it is held."""
        row = self._db.execute("SELECT value FROM info WHERE key = 'map'").fetchone()
        return None if row is None else dict(json.loads(row[0]))

    def set_info(self, entries: dict[str, Any]) -> None:
        """Commit entries of the info table."""
        with storage(self.path), self._transaction():
            self._set_info(entries)

    def add_frame(self, frame: FrameEntry) -> None:
        """Remember a frame; it is committed with the next keyframe, or by `close`."""
        self._frames.append(frame)

    def add(self, entry: KeyframeEntry) -> None:
        """Commit a keyframe with all that came of it, the frames since the last, and what its update changed."""
        packet, update, record = entry.packet, entry.update, entry.record
        keyframe = packet.keyframe
        poses = dict(zip(update.ids.tolist(), update.T_map_body, strict=True))
        T_map_body = poses.get(keyframe.id, update.T_map_odom @ entry.T_odom_body)
        row = (
            keyframe.id, keyframe.t_ns, to_bytes(T_map_body, "<f8"), to_bytes(entry.T_odom_body, "<f8"),
            to_bytes(keyframe.keypoints_px, "<f4"), to_bytes(keyframe.descriptors, "u1"),
            maybe_bytes(keyframe.points_body_m, "<f4"),
        )  # fmt: skip
        with storage(self.path), self._transaction():
            if keyframe.id == 0:
                self._set_info({"first_state": None if entry.start is None else state_data(entry.start.first_state)})
            if keyframe.id == self._first_id and entry.start is not None:
                self._set_info({"start": _start_data(entry.start)})
            self._insert("keyframes", [row])
            self._insert("packets", [packet_row(packet, update.newest)])
            for table, rows in _ROWS_OF_PACKETS.items():
                self._insert(table, rows(packet))
            if entry.filter_state is not None:
                self._put_states("filter", [(keyframe.id, entry.filter_state)])
            scans = entry.scans.items()
            self._insert("scans", [(i, scan.t_ns, scan.depth_png, scan.points, scan.colors) for i, scan in scans])
            self._insert("labels", [(i, scan.labels_png) for i, scan in scans if scan.labels_png])
            if entry.words is not None:
                words = entry.words
                self._replace("vocabulary", [(1, words.data, words.trained_at, words.trainings)])
            self._insert("tags", [(keyframe.id, *_tag_row(tag)) for tag in entry.tags])
            self._add_edges(entry.edges, keyframe.id)
            self._insert("candidates", [(None, *_candidate_row(c)) for c in entry.candidates])
            self._insert("retrieved", [(None, *astuple(found)) for found in entry.retrieved])
            self._write_frames()
            self._move(update, record)
            moved = [(*shift, checksum((edge_id, *shift)), edge_id) for edge_id, shift in entry.shifts.items()]
            self._db.executemany("UPDATE edges SET moved_rms_m = ?, moved_max_m = ?, crc_moved = ? WHERE id = ?", moved)
            newest = {"revision": update.revision, "vo_scale": record.vo_scale, "front": _front_data(entry.front)}
            self._replace("newest", [(1, json.dumps({**newest, **_own_record(record)}))])

    def move(self, update: GraphUpdate, record: GraphRecord) -> None:
        """Commit what an update without a new keyframe changed."""
        with storage(self.path), self._transaction():
            self._move(update, record)

    def close(self, finished: bool = False) -> None:
        """Fold the write-ahead log into the file, which is then all there is, and close it.

        `finished`: the run came to its end and is not to be resumed.
        """
        with storage(self.path):
            with self._transaction():
                self._write_frames()
                self._set_info({"finished": finished})
            with suppress(sqlite3.OperationalError):  # a reader has it open: all is committed, and the log stays beside
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                self._db.execute("PRAGMA journal_mode=DELETE")  # so that readers leave no files beside it
            self._db.close()

    def _move(self, update: GraphUpdate, record: GraphRecord) -> None:
        placed = [(int(i), to_bytes(T, "<f8")) for i, T in zip(update.ids, update.T_map_body, strict=True)]
        rows = [(T, checksum((i, T)), i) for i, T in placed]
        self._db.executemany("UPDATE keyframes SET T_map_body = ?, crc_pose = ? WHERE id = ?", rows)
        states = [(state.id, _state_row(state)) for state in record.loops]
        decided = [(*row, checksum((i, *row)), i) for i, row in states]
        columns = (
            "decision = ?, reason = ?, chi2 = ?, place = ?, tie_id = ?, tie_T = ?, tie_covariance = ?, crc_decided = ?"
        )
        self._db.executemany(f"UPDATE edges SET {columns} WHERE id = ?", decided)
        if record.window is not None:
            said = record.window
            self._replace("windows", [(said.id, *window_bytes(said), said.note, said.rest_from)])
        self._put_states("graph", record.states)
        self._replace("ties", [(tied.id, tied.anchor_id, to_bytes(tied.covariance, "<f8")) for tied in record.ties])

    def _add_edges(self, edges: Iterable[LoopEdge], offered_with: int) -> None:
        """Add offered edges; an id that was used before is refused by the graph, and the first edge of it stays."""
        rows = []
        undecided = LoopState(0, LoopDecision.REJECTED, "", float("nan"), LoopPlace.OUT, None)
        for edge in edges:
            T, covariance = to_bytes(edge.T_from_to, "<f8"), to_bytes(edge.covariance, "<f8")
            row = (edge.id, edge.from_id, edge.to_id, T, covariance, int(edge.has_scale), edge.inliers, edge.score)
            rows.append((*row, offered_with, self._edges, *_state_row(undecided), None, None))
            self._edges += 1
        self._insert("edges", rows, or_else="OR IGNORE")

    def _put_states(self, whose: str, states: Iterable[tuple[int, NavState]]) -> None:
        self._replace("states", [(int(i), whose, state.t_ns, state_bytes(state)) for i, state in states])

    def _write_frames(self) -> None:
        self._replace("frames", [_frame_row(frame) for frame in self._frames])
        self._replace("motions", [(f.t_ns, to_bytes(f.motion, "<f8")) for f in self._frames if f.motion is not None])
        self._frames = []

    def _set_info(self, entries: dict[str, Any]) -> None:
        self._replace("info", [(key, json.dumps(value)) for key, value in entries.items()])

    def _replace(self, table: str, rows: list[tuple[Any, ...]]) -> None:
        self._insert(table, rows, or_else="OR REPLACE")

    def _insert(self, table: str, rows: list[tuple[Any, ...]], or_else: str = "") -> None:
        if rows:
            checked = [(*row, *checksums(table, row)) for row in rows]
            self._db.executemany(f"INSERT {or_else} INTO {table} VALUES ({', '.join('?' * len(checked[0]))})", checked)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._db.execute("COMMIT")
        except BaseException:
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            raise


def _opened(path: Path) -> sqlite3.Connection:
    with storage(path):
        db = connect(path, isolation_level=None)
        db.execute("PRAGMA journal_mode=WAL")
        db.execute("PRAGMA synchronous=NORMAL")
    return db


def _start_data(start: StartFacts) -> dict[str, Any]:
    return {**asdict(start), "last": state_data(start.last), "first_state": state_data(start.first_state)}


def _front_data(front: Learned | None) -> dict[str, Any]:
    front = front or Learned()
    arrays = {"filter_camera": front.filter_camera, "tilt": front.tilt, "habits": front.habits}
    return {**asdict(front), **{name: None if array is None else array.tolist() for name, array in arrays.items()}}


def _own_record(record: GraphRecord) -> dict[str, Any]:
    """Return the own variables of sensors as an entry of `newest`; nothing where there are none."""
    return {"own": own_data(record.own)} if record.own else {}


def _state_row(state: LoopState) -> tuple[Any, ...]:
    tie = state.tie
    tied: tuple[Any, ...] = (None, None, None)
    if tie is not None:
        tied = (tie.from_id, to_bytes(tie.T_from_to, "<f8"), to_bytes(tie.covariance, "<f8"))
    return (str(state.decision), state.reason, float(state.chi2), str(state.place), *tied)


def _tag_row(tag: TagSighting) -> tuple[Any, ...]:
    return (tag.tag_id, tag.side_px, maybe_bytes(tag.T_cam_tag, "<f8"), maybe_bytes(tag.covariance, "<f8"))


def _candidate_row(c: LoopCandidate) -> tuple[Any, ...]:
    return (
        c.from_id, c.to_id, c.source, float(c.score), int(c.inliers), str(c.decision), c.reason, float(c.sigma_m),
        int(c.consistency), int(c.supporters), maybe_bytes(c.T_from_to, "<f8"),
    )  # fmt: skip


def _frame_row(f: FrameEntry) -> tuple[Any, ...]:
    poses = (maybe_bytes(T, "<f8") for T in (f.T_keyframe_body, f.T_odom_body, f.T_map_body))
    seen = str(f.tracking), int(f.inliers), f.vo_keyframe_id, f.reason
    return (f.t_ns, f.keyframe_id, *poses, *seen, str(f.localisation), f.submap)
