"""Reading a session; it is never written here."""

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from vislam.config import Config, from_data, recorded
from vislam.core.camera import Rig
from vislam.core.database import connect
from vislam.core.errors import DataError, UsageError
from vislam.core.memory import FrameEntry, LoopPlace, LoopState, OfferedLoop, PackedScan, Tie, WordsMemory
from vislam.core.messages import (
    Array,
    KeyframePacket,
    Localisation,
    LoopCandidate,
    LoopDecision,
    LoopEdge,
    NavState,
    RetrievedKeyframe,
    Tracking,
)
from vislam.factors import FactorLog, LoggedEdge, LoggedKeyframe, rig_from, state_from
from vislam.runs.session.checks import check_records, check_sound, is_since
from vislam.runs.session.packets import LIGHT_COLUMNS, further_of, packet_of
from vislam.runs.session.reading_rows import readings_of, starts_of
from vislam.runs.session.schema import (
    DESCRIPTOR_BYTES,
    FIRST_WITH_FURTHER,
    FIRST_WITH_LABELS,
    FIRST_WITH_MOTIONS,
    FIRST_WITH_READINGS,
    from_bytes,
    maybe_numbers,
    noise_of,
    numbers,
    readable,
    state_of,
)
from vislam.trajectory.frames import LoggedFrames
from vislam.trajectory.motion_numbers import MOTION_NUMBERS


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


def has_begun(path: Path) -> bool:
    """Return whether a file is there with anything in it; a process that ended at once may have left an empty one."""
    if not path.is_file():
        return False
    with readable(path), closing(connect(path, read_only=True)) as db:
        return bool(db.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0])


def has_frames(path: Path) -> bool:
    """Return whether a session is there that came to its end or took a frame; True for one that cannot be read."""
    try:
        if not has_begun(path):
            return False
        with readable(path), closing(connect(path, read_only=True)) as db:
            finished = db.execute("SELECT value FROM info WHERE key = 'finished'").fetchone()
            return finished != ("false",) or bool(db.execute("SELECT COUNT(*) FROM frames").fetchone()[0])
    except DataError:
        return True


class Session:
    """A stored session, read only. What is damaged raises DataError where it is read."""

    def __init__(self, path: Path) -> None:
        """Open a session file; raises DataError when it is missing, not ours, damaged or of another version."""
        self.path = path
        if not path.is_file():
            raise DataError(f"no session at {path}; a run leaves one as session.db")
        with readable(path):
            self._db = connect(path, read_only=True)
        try:
            check_sound(self._db, path)
            check_records(self._db, path)
        except DataError:
            self._db.close()
            raise

    def info(self) -> dict[str, Any]:
        """Return what the writer stored about the run."""
        with readable(self.path):
            rows = self._db.execute("SELECT key, value FROM info").fetchall()
            return {key: json.loads(value) for key, value in rows}

    def rig(self) -> Rig:
        """Return the cameras of the run."""
        info = self.info()
        with readable(self.path):
            return rig_from(info["rig"])

    def config(self) -> Config:
        """Return the settings of the run; raises DataError when they are damaged, or of another version."""
        try:
            return from_data(recorded(self.info()["config"], str(self.path)), str(self.path))
        except (KeyError, TypeError, AttributeError, UsageError) as error:
            raise DataError(
                f"{error}; the settings stored with the run are of another version, run it again"
            ) from error

    @property
    def first_id(self) -> int:
        """The first keyframe of the run's own recording; those before are of the map in which it began."""
        base = self.info().get("map")
        with readable(self.path):
            return 0 if base is None else int(base["keyframes"])

    def newest(self) -> dict[str, Any]:
        """Return the small facts of the last commit; empty before the first."""
        with readable(self.path):
            row = self._db.execute("SELECT value FROM newest").fetchone()
            if row is None and self._db.execute("SELECT COUNT(*) FROM keyframes").fetchone()[0] == 0:
                return {}
            newest: dict[str, Any] = json.loads(row[0])
            if not newest:
                raise ValueError("the last commit is empty")
            return newest

    def rows(self, query: str) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query."""
        with readable(self.path):
            yield from self._db.execute(query)

    def keyframes(self) -> Iterator[StoredKeyframe]:
        """Yield the keyframes in order of their ids."""
        with readable(self.path):
            for row in self._db.execute("SELECT * FROM keyframes ORDER BY id"):
                descriptors = from_bytes(row[5], "u1", (-1, DESCRIPTOR_BYTES)).copy()
                n = len(descriptors)
                yield StoredKeyframe(
                    id=row[0],
                    t_ns=row[1],
                    T_map_body=numbers(row[2], "<f8", (4, 4)),
                    T_odom_body=numbers(row[3], "<f8", (4, 4)),
                    keypoints_px=numbers(row[4], "<f4", (n, 2)),
                    descriptors=descriptors,
                    points_body_m=maybe_numbers(row[6], "<f4", (n, 3)),
                )

    def loops(self) -> list[OfferedLoop]:
        """Return all loop edges, in the order in which they were offered, with what became of them."""
        out = []
        with readable(self.path):
            for row in self._db.execute("SELECT * FROM edges ORDER BY number"):
                T, covariance = numbers(row[3], "<f8", (4, 4)), numbers(row[4], "<f8", (6, 6))
                edge = LoopEdge(row[0], row[1], row[2], T, covariance, bool(row[5]), row[6], row[7])
                tie = None
                if row[14] is not None:
                    tie = Tie(row[14], numbers(row[15], "<f8", (4, 4)), numbers(row[16], "<f8", (6, 6)))
                chi2 = float("nan") if row[12] is None else float(row[12])
                state = LoopState(row[0], LoopDecision(row[10]), row[11], chi2, LoopPlace(row[13]), tie)
                out.append(OfferedLoop(edge, row[8], state))
        return out

    def candidates(self) -> list[LoopCandidate]:
        """Return all loop candidates in the order in which they were looked at."""
        nan = float("nan")
        with readable(self.path):
            return [
                LoopCandidate(
                    row[1], row[2], row[3], nan if row[4] is None else row[4], row[5], LoopDecision(row[6]), row[7],
                    nan if row[8] is None else row[8], row[9], row[10], maybe_numbers(row[11], "<f8", (4, 4)),
                )
                for row in self._db.execute("SELECT * FROM candidates ORDER BY number")
            ]  # fmt: skip

    def retrieved(self) -> list[RetrievedKeyframe]:
        """Return what the index found, in order."""
        rows, nan = self.rows("SELECT * FROM retrieved ORDER BY number"), float("nan")
        return [
            RetrievedKeyframe(a, b, nan if s is None else s, nan if i is None else i, n) for _, a, b, s, i, n, _ in rows
        ]

    def words(self) -> WordsMemory | None:
        """Return the words that the run trained last; None: it trained none."""
        rows = self.rows("SELECT data, trained_at, trainings FROM vocabulary")
        return next((WordsMemory(*row) for row in rows), None)

    def scans(self) -> dict[int, PackedScan]:
        """Return what the map keeps of keyframes, by their ids."""
        rows = self.rows("SELECT id, t_ns, depth_png, points, colors FROM scans ORDER BY id")
        scans = {i: PackedScan(*row) for i, *row in rows}
        if not is_since(self._db, FIRST_WITH_LABELS):
            return scans
        labels = dict(self.rows("SELECT id, png FROM labels"))
        return {i: replace(scan, labels_png=labels[i]) if i in labels else scan for i, scan in scans.items()}

    def shifts(self) -> dict[int, tuple[float, float]]:
        """Return the rms and largest shift in metres of the update that took in each loop edge."""
        rows = self.rows(
            "SELECT id, moved_rms_m, moved_max_m FROM edges WHERE moved_rms_m + moved_max_m IS NOT NULL ORDER BY id"
        )
        return {i: (rms_m, max_m) for i, rms_m, max_m in rows}

    def frames(self) -> list[FrameEntry]:
        """Return all frames in order of time."""

        def pose(blob: bytes | None) -> Array | None:
            return maybe_numbers(blob, "<f8", (4, 4))

        with readable(self.path):
            has_motions = is_since(self._db, FIRST_WITH_MOTIONS)
            rows = self._db.execute("SELECT t_ns, numbers FROM motions") if has_motions else ()
            motions = {t: numbers(blob, "<f8", (MOTION_NUMBERS,)) for t, blob in rows}
            return [
                FrameEntry(
                    row[0],
                    row[1],
                    pose(row[2]),
                    pose(row[3]),
                    pose(row[4]),
                    Tracking(row[5]),
                    row[6],
                    row[7],
                    row[8],
                    Localisation(row[9]),
                    row[10],
                    motions.get(row[0]),
                )
                for row in self._db.execute("SELECT * FROM frames ORDER BY t_ns")
            ]

    def states(self, whose: str) -> dict[int, NavState]:
        """Return the stored states of keyframes: of the "filter" in odom, or of the "graph"."""
        query = "SELECT id, t_ns, state FROM states WHERE whose = ? ORDER BY id"
        with readable(self.path):
            return {i: state_of(t_ns, blob) for i, t_ns, blob in self._db.execute(query, (whose,))}

    def packets(self, light: bool = False) -> list[KeyframePacket]:
        """Return the packets, ids 0, 1, 2, ...; `light`: without observations."""
        columns = LIGHT_COLUMNS if light else "p.*"
        query = f"SELECT k.t_ns, {columns} FROM keyframes k JOIN packets p USING (id) ORDER BY id"
        out: list[KeyframePacket] = []
        with readable(self.path):
            count = self._db.execute("SELECT COUNT(*) FROM keyframes").fetchone()[0]
            for t_ns, *row in self._db.execute(query):
                if row[0] != len(out):
                    raise ValueError(f"keyframe {len(out)} is missing")
                out.append(packet_of(t_ns, tuple(row)))
            if len(out) != count:
                raise ValueError(f"{count} keyframes but {len(out)} packets")
            return self._with_readings(out if light else self._with_further(out))

    def _with_further(self, packets: list[KeyframePacket]) -> list[KeyframePacket]:
        """Return the packets with what cameras beyond the first pair saw, of which older formats know nothing."""
        if not is_since(self._db, FIRST_WITH_FURTHER):
            return packets
        for k, seen in further_of(self._db).items():
            if k not in range(len(packets)):
                raise ValueError(f"tracks of keyframe {k}, which is not there")
            packets[k] = replace(packets[k], observations=replace(packets[k].observations, further=seen))
        return packets

    def _with_readings(self, packets: list[KeyframePacket]) -> list[KeyframePacket]:
        """Return the packets with what other sensors said; a session of an older format knows nothing of it."""
        if not is_since(self._db, FIRST_WITH_READINGS):
            return packets
        readings, starts = readings_of(self._db), starts_of(self._db)
        for k in readings.keys() | starts.keys():
            if k not in range(len(packets)):
                raise ValueError(f"readings with keyframe {k}, which is not there")
            packets[k] = replace(packets[k], readings=readings.get(k, ()), own_starts=starts.get(k, ()))
        return packets

    def factor_log(self) -> FactorLog:
        """Return all that was measured up to the last committed keyframe."""
        info = self.info()
        with readable(self.path):
            noise, first = info["imu_noise"], info.get("first_state")
            return FactorLog(
                rig=self.rig(),
                noise=None if noise is None else noise_of(noise),
                gravity_m_s2=float(info["gravity_m_s2"]),
                first_state=None if first is None else state_from(first),
                keyframes=self._logged_keyframes(),
                edges=sorted(
                    (LoggedEdge(loop.edge, loop.state.decision is LoopDecision.ACCEPTED) for loop in self.loops()),
                    key=lambda logged: logged.edge.id,
                ),
                frames=self._logged_frames(),
            )

    def _logged_keyframes(self) -> list[LoggedKeyframe]:
        query = "SELECT k.T_map_body, k.T_odom_body, p.state FROM keyframes k JOIN packets p USING (id) ORDER BY id"
        out = []
        for packet, (T_map_body, T_odom_body, blob) in zip(self.packets(), self._db.execute(query), strict=True):
            state: Any = (None, None, None) if blob is None else numbers(blob, "<f8", (3, 3))
            poses = numbers(T_odom_body, "<f8", (4, 4)), numbers(T_map_body, "<f8", (4, 4))
            out.append(LoggedKeyframe(packet, *poses, *state))
        return out

    def _logged_frames(self) -> LoggedFrames:
        frames = self.frames()
        return LoggedFrames(
            np.array([f.t_ns for f in frames], np.int64),
            np.array([f.keyframe_id for f in frames], np.int64),
            [f.T_keyframe_body for f in frames],
        )

    def copy_to(self, other: sqlite3.Connection) -> None:
        """Copy the whole session into an empty database."""
        self._db.backup(other)

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
