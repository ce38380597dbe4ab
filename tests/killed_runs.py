"""Kills a run again and again with SIGKILL at random moments and resumes it; `python killed_runs.py FOLDER SEED KILLS`.

A moment is one at which a run opens, renames or removes a file or begins an SQL statement: there what is stored
changes, and counted in them, not in seconds, the same seed kills at the same places on any machine. Runs are forked
from one process that has compiled everything. Every line on stdout is a fact as JSON; a failed check ends it.
"""

import itertools
import json
import os
import random
import shutil
import signal
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

from vislam import slam
from vislam.cli import run_verb
from vislam.runs.session import Session

SOURCE = "points:corridor-loop,duration_s=12,camera_hz=10,tracks=100"
SETTINGS = ("--view.no-enabled", "--json")
DONE = (0, 2)  # 2: all but the report had been written, and there was nothing to resume
MOMENTS = 400  # a run sees at most so many before it is killed
CHANGES = ("open", "os.rename", "os.remove", "shutil.rmtree")


def run_until(moment: int, arguments: list[str], begun: int) -> None:
    """Run until killed at a moment; a byte is written to `begun` for each keyframe that reaches the back end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    add, connect, moments = slam.Back.add, sqlite3.connect, itertools.count()

    def pass_moment(*_: object) -> None:
        if next(moments) == moment:
            os.kill(os.getpid(), signal.SIGKILL)

    def traced(*arguments: Any, **settings: Any) -> sqlite3.Connection:
        db = connect(*arguments, **settings)
        db.set_trace_callback(pass_moment)
        return db

    slam.Back.add = lambda *arguments: (os.write(begun, b"."), add(*arguments))[1]
    sqlite3.connect = traced
    sys.addaudithook(lambda event, _: pass_moment() if event in CHANGES else None)
    os._exit(run_verb(arguments))


def committed(session: Path, scratch: Path) -> int:
    """Check a copy of what a killed run left, and return how many keyframes are in it."""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    for name in ("session.db", "session.db-wal"):
        if (session.parent / name).exists():
            shutil.copy(session.parent / name, scratch / name)
    copy = scratch / "session.db"
    if not copy.exists():
        return 0
    with closing(sqlite3.connect(copy)) as db:
        assert db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
        tables = db.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0]
        if tables == 0:
            return 0
        counts = {}
        for table in ("keyframes", "packets", "windows"):
            ids = [row[0] for row in db.execute(f"SELECT id FROM {table} ORDER BY id")]
            assert ids == list(range(len(ids))), f"{table}: {ids}"
            counts[table] = len(ids)
        assert len(set(counts.values())) == 1, counts
    with closing(Session(copy)) as session_copy:
        log = session_copy.factor_log()
        assert len(log.keyframes) == counts["keyframes"]
        assert not log.keyframes or log.keyframes[-1].packet.keyframe.t_ns in log.frames.t_ns
    return counts["keyframes"]


def killed(arguments: list[str], out: Path, before: int, moment: int) -> dict[str, object]:
    """Start or resume a run that is killed at a moment, and return what is left of it."""
    read, write = os.pipe()
    child = os.fork()
    if not child:
        run_until(moment, arguments, write)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        begun = len(pipe.read())
    _, status = os.waitpid(child, 0)
    ended = os.WIFEXITED(status)
    assert not ended or os.WEXITSTATUS(status) in DONE, f"{arguments} ended with {os.WEXITSTATUS(status)}"
    left = committed(out / "session.db", out.parent / "scratch")
    lost = 1 if before else begun  # those that waited for gravity come together
    assert left >= before + begun - lost, f"{before} + {begun} keyframes, {left} are left"
    return {"moment": moment, "begun": begun, "left": left, "ended": ended}


def main(folder: Path, seed: int, kills: int) -> None:
    rng = random.Random(seed)
    assert run_verb(["run", SOURCE, "--out", str(folder / "whole"), *SETTINGS]) == 0  # compiles, too
    number, done, left = 0, 0, 0
    out = folder / "killed0"
    while done < kills:
        begun = (out / "config.json").is_file()
        arguments = ["run", "--resume", str(out), "--json"] if begun else ["run", SOURCE, "--out", str(out), *SETTINGS]
        if not begun:
            shutil.rmtree(out, ignore_errors=True)
        fact = killed(arguments, out, left, rng.randint(0, MOMENTS))
        left = int(str(fact["left"]))
        if fact["ended"]:
            number, left = number + 1, 0
            out = folder / f"killed{number}"
        else:
            done += 1
        print(json.dumps({"kill": done, "run": number, **fact}), flush=True)
    if (out / "config.json").is_file():
        assert run_verb(["run", "--resume", str(out), "--json"]) in DONE
    print(json.dumps({"runs": number + 1}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
