"""Kills a run again and again with SIGKILL at random moments and resumes it; `python killed_runs.py FOLDER SEED KILLS`.

Runs are forked from one process that has compiled everything, so that each starts within milliseconds and moments of
the pipeline are hit, not those of importing. Every line on stdout is a fact as JSON; a failed check ends it.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sqlite3
import sys
import time
from contextlib import closing
from pathlib import Path

from vislam import slam
from vislam.cli import run_verb
from vislam.runs.session import Session

SOURCE = "points:corridor-loop,duration_s=12,camera_hz=10,tracks=100"
SETTINGS = ("--view.no-enabled", "--json")
DONE = (0, 2)  # 2: all but the report had been written, and there was nothing to resume
MOST = 4  # keyframes that a run sees before it is killed; the longest wait after the last of them:
WITHIN_S = 0.2


def start(arguments: list[str], begun: int) -> int:
    """Fork a run; it writes a byte to the pipe `begun` for each keyframe that reaches its back end."""
    child = os.fork()
    if child:
        return child
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    add = slam.Back.add

    def told(self: slam.Back, *arguments: object) -> object:
        os.write(begun, b".")
        return add(self, *arguments)

    slam.Back.add = told
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
        newest = log.keyframes[-1].packet.keyframe.t_ns if log.keyframes else 0
        assert not log.keyframes or newest in log.frames.t_ns
    return counts["keyframes"]


def killed(arguments: list[str], out: Path, before: int, keyframes: int, delay_s: float) -> dict[str, object]:
    """Start or resume a run, kill it a while after some keyframes, and return what is left of it."""
    read, write = os.pipe()
    child = start(arguments, write)
    os.close(write)
    with os.fdopen(read, "rb", buffering=0) as pipe:
        begun = sum(len(pipe.read(1)) for _ in range(keyframes))  # nothing comes of a run that has ended
        time.sleep(delay_s)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        begun += len(pipe.read())
    ended = os.WIFEXITED(status)
    assert not ended or os.WEXITSTATUS(status) in DONE, f"{arguments} ended with {os.WEXITSTATUS(status)}"
    left = committed(out / "session.db", out.parent / "scratch")
    first_group = before == 0  # keyframes that waited for gravity come together
    assert left >= (before if first_group else before + begun - 1), f"{before} + {begun} keyframes, {left} are left"
    return {"keyframes": keyframes, "delay_s": delay_s, "begun": begun, "left": left, "ended": ended}


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
        fact = killed(arguments, out, left, rng.randint(0, MOST), rng.uniform(0.0, WITHIN_S))
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
