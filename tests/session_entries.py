"""What a session is given with a keyframe, for tests that make one by hand."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from vislam.core.memory import LoopPlace, LoopState, StartFacts
from vislam.core.messages import LoopDecision, NavState
from vislam.imu import ImuNoise
from vislam.runs.session.checks import checksums


@contextmanager
def editing(path: Path) -> Iterator[sqlite3.Connection]:
    """Change what a session says, and give it checksums that fit: damage that only its meaning gives away."""
    with closing(sqlite3.connect(path)) as db:
        yield db
        for (table,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
            crcs = [row[1] for row in db.execute(f"PRAGMA table_info({table})") if row[1].startswith("crc")]
            columns = ", ".join(f"{name} = ?" for name in crcs)
            for rowid, *row in db.execute(f"SELECT rowid, * FROM {table}").fetchall():
                sound = checksums(table, tuple(row[: -len(crcs)]))
                db.execute(f"UPDATE {table} SET {columns} WHERE rowid = ?", (*sound, rowid))
        db.commit()


def decided(loop_id: int, accepted: bool) -> LoopState:
    """Return a loop that was accepted, or rejected."""
    decision = LoopDecision.ACCEPTED if accepted else LoopDecision.REJECTED
    return LoopState(loop_id, decision, "", 1.5, LoopPlace.GRAPH if accepted else LoopPlace.OUT, None)


def start_facts(state: NavState, noise: ImuNoise) -> StartFacts:
    """Return a start at rest with a first state."""
    return StartFacts("static", "at rest", state, 0.0, 0.0, noise, state)
