"""Mutates files of every kind that vislam reads and looks for tracebacks, hangs and memory taken.

    python experiments/fuzz.py --minutes 10 --seed 1 [--only graph session] [--hostile FOLDER] [--keep FOLDER]

Cases run in a forked process whose parent notices when it hangs or dies. A case is named TARGET:NUMBER and is the same
for a seed, whatever ran before it: `--only TARGET --first NUMBER --cases 1` gives it again. What must hold: a reader
returns or raises a VislamError of one printable line within 10 seconds of
the processor's time, takes less than ten times the file and 300 MB,
and a session that is taken says what it said before it was damaged.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import select
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import bombs
import cv2
import numpy as np

from vislam.core.errors import VislamError, printable

_SECRET = b"CANARY" * 100
_TRACES = (b"CANARY", b"Q0FOQVJZ")  # as it is, and in base64
LIMIT_S = 10.0  # of the processor's time
FREE_BYTES, TIMES = 300 * 2**20, 10
_MOST_BYTES = 4 * 2**20  # of a mutated file
_SILENT_S = 90.0  # of the clock, until a case is killed: it waits for something, or takes no signal
TOKENS = (
    b"nan", b"-inf", b"1e159", b"-1e308", b"1e-320", b"0", b"-1", b"9223372036854775808", b"4294967296", b"1e12",
    b"9" * 5000, b"", b"\x1b[31m", b"\x00", "\u202e".encode(), b"\xff\xfe", b'"', b"[" * 100_000, b'{"a":' * 20_000,
    b"a." * 5_000, b"&a [*a,*a]", b"!!python/object:os.system x", b"\r", b",", b"#", b"1_0", b"0x10", b"true", b"null",
)  # fmt: skip


@dataclass(frozen=True)
class Target:
    """Something that reads files: sound ones by name, and how they are read from a folder."""

    name: str
    seeds: list[dict[str, bytes]]
    read: Callable[[Path], object]
    turns: int = 20  # in a round: fewer where a case takes long
    made: Callable[[np.random.Generator, dict[str, bytes]], dict[str, bytes]] | None = None  # a bomb, of sound files


@dataclass
class Tally:
    """What came of the cases of a target."""

    counts: Counter[str] = field(default_factory=Counter)
    finds: list[str] = field(default_factory=list)
    slowest_s: float = 0.0
    most_bytes: int = 0


class Answer(NamedTuple):
    """What came of a case."""

    what: str
    words: str
    took_s: float
    grown_bytes: int  # at most


class TooSlow(BaseException):
    """A case works too long; nothing that a reader catches."""


def mutated(data: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    """Return data with one to four changes; `other` is spliced in at times."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        a, b = sorted(rng.integers(0, len(out) + 1, 2).tolist())
        b = min(b, a + int(rng.integers(1, 200)))
        kind = int(rng.integers(0, 10))
        if kind == 0 and out:
            out[min(a, len(out) - 1)] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            out[a:b] = rng.bytes(b - a)
        elif kind == 2:
            del out[a:b]
        elif kind == 3:
            out[a:a] = out[a:b] * int(rng.integers(1, 50))
        elif kind == 4:
            del out[a:]
        elif kind == 5:
            out[a:b] = other[a : a + int(rng.integers(1, 200))]
        elif kind == 6:
            out[a:a] = TOKENS[int(rng.integers(0, len(TOKENS)))]
        elif kind == 7:
            lines = out.split(b"\n")
            i, j = rng.integers(0, len(lines), 2).tolist()
            lines[i] = lines[j] if rng.integers(0, 2) else lines[i] + b"\n" + lines[j]
            out = bytearray(b"\n".join(lines))
        else:  # a number or word replaced by a telling one
            begin = end = min(a, max(len(out) - 1, 0))
            while begin > 0 and out[begin - 1] not in b" ,\t\n:[]{}=()":
                begin -= 1
            while end < len(out) and out[end] not in b" ,\t\n:[]{}=()":
                end += 1
            out[begin:end] = TOKENS[int(rng.integers(0, len(TOKENS)))]
    return bytes(out[:_MOST_BYTES])


def case(target: Target, number: int, seed: int, folder: Path) -> int:
    """Write the files of a case; return how many bytes they have."""
    rng = np.random.default_rng([seed, zlib.crc32(target.name.encode()), number])
    files = dict(target.seeds[int(rng.integers(0, len(target.seeds)))])
    if target.made is not None:
        files = target.made(rng, files)
        if rng.random() < 0.7:
            write(folder, files)
            return sum(map(len, files.values()))
    changed = sorted(files)[int(rng.integers(0, len(files)))]
    other = target.seeds[int(rng.integers(0, len(target.seeds)))]
    files[changed] = mutated(files[changed], other[sorted(other)[int(rng.integers(0, len(other)))]], rng)
    write(folder, files)
    return sum(map(len, files.values()))


def write(folder: Path, files: dict[str, bytes]) -> None:
    """Make a folder hold these files and nothing else."""
    for path in list(folder.iterdir()):
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(data.decode()) if isinstance(data, bombs.Link) else path.write_bytes(data)


def outcome(target: Target, folder: Path, size: int) -> Answer:
    """Read a folder whose files have `size` bytes; return what came of it."""
    Path("/proc/self/clear_refs").write_text("5")
    before, begun = _memory("VmRSS"), time.process_time()
    signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
    what, words = "read", ""
    try:
        target.read(folder)
    except VislamError as error:
        what, words = "refused", str(error)
        if words != printable(words) or not words:
            what = "UNPRINTABLE"
    except TooSlow:
        what, words = "SLOW", traceback.format_exc(limit=-3)
    except BaseException as error:
        what, words = "TRACEBACK", f"{type(error).__name__} {error}\n" + traceback.format_exc(limit=-4)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    took_s, grown = time.process_time() - begun, _memory("VmHWM") - before
    if what in ("read", "refused") and grown > TIMES * size + FREE_BYTES:
        what, words = "MEMORY", f"{grown / 2**20:.0f} MiB for {size} bytes"
    return Answer(what, words[:20_000], took_s, grown)


def refused_seeds(targets: list[Target]) -> list[str]:
    """Read every sound file, which also compiles and imports what cases need; return what was refused."""
    refused = []
    with tempfile.TemporaryDirectory() as scratch, open(os.devnull, "w", encoding="utf-8") as null:
        for target in targets:
            for files in target.seeds:
                write(Path(scratch), files)
                try:
                    with redirect_stdout(null), redirect_stderr(null):
                        target.read(Path(scratch))
                except VislamError as error:
                    refused.append(f"{target.name}: {error}")
    return refused


def run_cases(
    targets: list[Target], seed: int, first: int, cases: int, until: float, keep: Path | None = None
) -> dict[str, Tally]:
    """Run cases of the targets in turns and return what came of each; finds are kept in a folder."""
    tallies = {target.name: Tally() for target in targets}
    at, end = 0, cases * len(targets)
    round_of = [(target, turn) for turn in range(20) for target in targets if turn < target.turns]

    def named(at: int) -> tuple[Target, int]:
        target, turn = round_of[at % len(round_of)]
        return target, first + at // len(round_of) * target.turns + turn

    with tempfile.TemporaryDirectory() as scratch:
        while at < end and time.monotonic() < until:
            reader, writer = os.pipe()
            child = os.fork()
            if not child:
                os.close(reader)
                _work(map(named, range(at, end)), seed, Path(scratch), writer, until)
            os.close(writer)
            answer: Answer | None = Answer("read", "", 0.0, 0)
            for answer in _answers(reader):
                _count(tallies, *named(at), answer or Answer("HANG", "killed", LIMIT_S, 0), seed, keep)
                at += 1
                if answer is None:
                    os.kill(child, signal.SIGKILL)
                    break
            os.close(reader)
            _, status = os.waitpid(child, 0)
            if status and answer is not None and at < end:  # and was not killed here
                how = f"ended with {os.waitstatus_to_exitcode(status)}"
                _count(tallies, *named(at), Answer("CRASH", how, 0.0, 0), seed, keep)
                at += 1
    return tallies


def _work(order: Iterable[tuple[Target, int]], seed: int, scratch: Path, writer: int, until: float) -> None:
    """Answer case after case, a line of JSON each, and leave the process."""
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 1)
    os.dup2(null, 2)
    signal.signal(signal.SIGPROF, _too_slow)
    taken = _memory("VmSize")
    resource.setrlimit(resource.RLIMIT_AS, (taken + 8 * FREE_BYTES, resource.RLIM_INFINITY))
    for target, number in order:
        if time.monotonic() > until:
            break
        size = case(target, number, seed, scratch)
        os.write(writer, json.dumps(outcome(target, scratch, size)).encode() + b"\n")
    os._exit(0)


def _too_slow(*_: object) -> None:
    raise TooSlow


def _answers(reader: int) -> Iterator[Answer | None]:
    """Yield a worker's lines, None where it hangs; ends when the worker does."""
    rest = b""
    while True:
        if not select.select([reader], [], [], _SILENT_S)[0]:
            yield None
            return
        got = os.read(reader, 1 << 16)
        if not got:
            return
        *lines, rest = (rest + got).split(b"\n")
        for line in lines:
            yield Answer(*json.loads(line))


def _count(
    tallies: dict[str, Tally], target: Target, number: int, answer: Answer, seed: int, keep: Path | None
) -> None:
    tally, (what, words, took_s, grown) = tallies[target.name], answer
    tally.counts[what] += 1
    tally.slowest_s, tally.most_bytes = max(tally.slowest_s, took_s), max(tally.most_bytes, grown)
    if what in ("read", "refused"):
        return
    tally.finds.append(f"{target.name}:{number} {what} {words}")
    if keep is not None:
        folder = keep / f"{target.name}-{number}"
        folder.mkdir(parents=True, exist_ok=True)
        case(target, number, seed, folder)


def _memory(name: str) -> int:
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith(name + ":"))


def hostile_target(folder: Path) -> Target:
    """Return the target whose sound files are hostile ones."""
    return Target("hostile", [{p.name: p.read_bytes()} for p in sorted(folder.iterdir()) if p.is_file()], _optimize, 5)


def small_targets() -> list[Target]:
    """Return the targets whose sound files are made at once."""
    return [
        Target("graph", _graphs(), _optimize),
        Target("trajectory", _trajectories(), _read_trajectories),
        Target("recording", [_asl(), _tum(), _kitti()], _survey),
        Target("bag", _bags(), _read_bags),
        Target("calibration", _calibrations(), _read_calibrations),
        Target("settings", _settings(), _read_settings),
        Target("tracks", [{"tracks.csv": _TRACKS}], _read_tracks),
        Target("map", _maps(), _read_maps),
        Target("vocabulary", _vocabularies(), _read_vocabularies),
        Target("bridge", [{"bytes": _bridge()}], _read_bridge),
        *bomb_targets(),
        Target("tables", [{"loops.csv": _loops_csv(), "retrieved.csv": _RETRIEVED}], _read_tables),
    ]


def bomb_targets() -> list[Target]:
    """Return the targets whose files are built to ask for much, and sometimes mutated then."""

    def recording(rng: np.random.Generator, sound: dict[str, bytes]) -> dict[str, bytes]:
        images = [name for name in sound if name.endswith(".png")]
        return sound | {str(rng.choice(images)): bombs.forged_image(rng, _IMAGE)}

    def calibration(rng: np.random.Generator, sound: dict[str, bytes]) -> dict[str, bytes]:
        return {"c.yaml": bombs.yaml_bomb(rng, sound["c.yaml"])}

    def settings(rng: np.random.Generator, sound: dict[str, bytes]) -> dict[str, bytes]:
        return {name: bombs.toml_bomb(rng, data) for name, data in sound.items()}

    def bag(rng: np.random.Generator, sound: dict[str, bytes]) -> dict[str, bytes]:
        return {"a.bag": bombs.bag_bomb(rng)} if rng.random() < 0.5 else {"a.mcap": bombs.mcap_bomb(rng)}

    def stored(rng: np.random.Generator, sound: dict[str, bytes]) -> dict[str, bytes]:
        if "drive.db3" in sound and rng.random() < 0.5:
            return {"drive.db3": bombs.database_bomb(rng, sound["drive.db3"])}
        return {"a.mcap": bombs.message_bomb(rng, messages)}

    def numbers(rng: np.random.Generator, sound: dict[str, bytes]) -> dict[str, bytes]:
        return {
            name: bombs.archive_bomb(rng, data) if name.endswith(".npz") else bombs.forged_numbers(rng, data, 400)
            for name, data in sound.items()
        }

    def film(rng: np.random.Generator, sound: dict[str, bytes]) -> dict[str, bytes]:
        return sound | {"a.mp4": bombs.forged_numbers(rng, sound["a.mp4"][::-1], 2000)[::-1]}

    def text(rng: np.random.Generator, sound: dict[str, bytes]) -> dict[str, bytes]:
        return {name: bombs.long_text(rng, data) for name, data in sound.items()}

    messages = _messages()
    return [
        Target("message bomb", [bag for bag in _bags() if "drive.db3" in bag], _read_bags, made=stored),
        Target("map bomb", _maps(), _read_maps, made=numbers),
        Target("vocabulary bomb", _vocabularies(), _read_vocabularies, made=numbers),
        Target("film bomb", [_film()], _survey_film, made=film),
        Target("text bomb", [*_trajectories(), *_graphs()], _read_texts, made=text),
        Target("calibration bomb", _calibrations()[:4], _read_calibrations, made=calibration),
        Target("settings bomb", _settings(), _read_settings, made=settings),
        Target("image bomb", [_asl(), _tum(), _kitti()], _survey, made=recording),
        Target("bag bomb", _bags()[:1], _read_bags, made=bag),
    ]


def run_targets(folder: Path) -> list[Target]:
    """Return the targets that need run folders, which are made here: of points, and of a room with a map."""
    from vislam.runs.session import SessionWriter

    tracks = "points:corridor-loop,duration_s=8,camera_hz=10,tracks=60"
    _made(folder / "points", tracks, "--map.products")
    _made(folder / "room", "sim:handheld-room,rig=rgbd,duration_s=4,camera_hz=6,image_width_px=160")
    SessionWriter.reopen(folder / "points" / "session.db").close()  # which drops frames behind the last keyframe
    points, room = _files(folder / "points"), _files(folder / "room")
    outside = folder / "outside"
    outside.mkdir()
    (outside / "secret.txt").write_bytes(_SECRET)
    for name in ("session.db", "trajectory_graph.tum", "config.json"):
        (outside / name).write_bytes(points[name])
    whole = _dump(folder / "points" / "session.db")
    short = tracks.replace("duration_s=8", "duration_s=2")
    verbs: dict[str, list[list[str]]] = {
        "read": [["eval", "RUN"], ["eval", "RUN", "--loops"], ["loops", "RUN"], ["report", "RUN"]],
        "optimize": [["optimize", "RUN", "--no-report", "--rounds", "1"], ["loops", "RUN", "--undo", "0"]],
        "join": [["optimize", "RUN", str(folder / "points"), "--out", "OUT", "--no-report"]],
        "export": [["export", "RUN", "--mcap", "OUT.mcap", "--colmap", "OUT", "--splats", "OUT.ply"]],
        "rebuild": [["map", "RUN", "--products", "cloud", "octomap"], ["map", "RUN", "--out", "OUT", "--poses", "ekf"]],
        "resume": [["run", "--resume", "RUN"]],
        "begin in": [["run", short, "--map", "RUN", "--out", "OUT", "--view.no-enabled", "--map.no-enabled"]],
    }
    return [
        Target("run folder", [points], _read_run, 1),
        Target("stored bomb", [points, room], _read_stored, made=partial(bombs.run_bomb, outside=outside)),
        Target("session", [{"session.db": points["session.db"]}], lambda at: _read_session(at, whole)),
        *(
            Target(
                f"{name} bomb", [room if name in ("export", "rebuild") else points],
                partial(_work_on, lines, outside, _files(outside)), 2,
                made=partial(bombs.run_bomb, outside=outside),
            )
            for name, lines in verbs.items()
        ),
    ]  # fmt: skip


def _made(folder: Path, source: str, *more: str) -> None:
    from vislam.cli import run_verb

    with open(os.devnull, "w", encoding="utf-8") as null, redirect_stdout(null):
        code = run_verb(["run", source, "--out", str(folder), "--view.no-enabled", "--json", *more])
    if code:
        raise SystemExit(f"no run folder could be made: exit code {code}")


def _files(folder: Path) -> dict[str, bytes]:
    large = (".html", ".png", ".rrd")
    names = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix not in large]
    return {str(path.relative_to(folder)): path.read_bytes() for path in names}


def _work_on(lines: list[list[str]], outside: Path, held: dict[str, bytes], folder: Path) -> None:
    """Run command lines on a run folder, which must leave what lies elsewhere as it is and to itself."""
    out = folder.parent / f"{folder.name}-out"
    for line in lines:
        for path in folder.parent.glob(f"{out.name}*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        _verb(*(word.replace("RUN", str(folder)).replace("OUT", str(out)) for word in line))
    if _files(outside) != held:
        write(outside, held)
        raise AssertionError("what lies outside of the folder was written to")
    for path in (*folder.rglob("*"), *out.rglob("*")):
        if path.is_file() and not path.is_symlink() and any(part in path.read_bytes() for part in _TRACES):
            raise AssertionError(f"{path.name} holds what lies outside of the folder")


def _verb(*arguments: str) -> None:
    from vislam.cli import run_verb

    if (code := run_verb(list(arguments))) not in (0, 2, 3, 4):
        raise RuntimeError(f"exit code {code}")


def _optimize(folder: Path) -> None:
    out = folder / "out"
    for path in sorted(folder.iterdir()):
        _verb("optimize", str(path), "--out", str(out), "--no-report", "--iterations", "30")


def _graphs() -> list[dict[str, bytes]]:
    rng = np.random.default_rng(0)
    plane, space, toro, isam = [], [], [], []
    for i in range(12):
        plane.append(f"VERTEX_SE2 {i} {i} {rng.normal():.3f} 0.1")
        space.append(f"VERTEX_SE3:QUAT {i} {i} 0.5 {rng.normal():.3f} 0 0 0 1")
        toro.append(f"VERTEX2 {i} {i} 0 0.1")
    for i, j in [(i, i + 1) for i in range(11)] + [(0, 6), (2, 9), (11, 0)]:
        plane.append(f"EDGE_SE2 {i} {j} {j - i} 0.02 0.01 100 0 0 100 0 400")
        upper = " ".join("100" if a == b else "0" for a in range(6) for b in range(a, 6))
        space.append(f"EDGE_SE3:QUAT {i} {j} {j - i} 0.01 0.02 0 0 0 1 {upper}")
        toro.append(f"EDGE2 {i} {j} {j - i} 0.1 0.02 100 0 100 400 0 0")
        isam.append(f"EDGE2 {i} {j} {j - i} 0.1 0.02 10 0 0 10 0 20")
    plane += ["FIX 0", "VERTEX_XY 100 3 2", "EDGE_SE2_XY 2 100 1 2 100 0 100", "EDGE_SE2_XY 4 100 -1 2 100 0 100"]
    texts = {"a.g2o": plane, "b.g2o": space, "c.toro": toro, "d.isam": isam}
    return [{name: "\n".join(lines).encode() + b"\n"} for name, lines in texts.items()]


def _trajectories() -> list[dict[str, bytes]]:
    tum = "".join(f"{1.4e9 + i / 10:.6f} {i} 0 1 0 0 0 1\n" for i in range(30))
    euroc = "#timestamp,x,y,z,qw,qx,qy,qz\n" + "".join(f"{14 * 10**17 + i},{i},0,1,1,0,0,0\n" for i in range(30))
    kitti = "1 0 0 1 0 1 0 2 0 0 1 3\n" * 20
    times = "".join(f"{i / 10:.6e}\n" for i in range(20))
    angles = "t_s,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n" + "".join(f"{i},{i},0,1,0,9,{i}\n" for i in range(30))
    texts = {"a.tum": tum}, {"a.csv": euroc}, {"a.csv": angles}, {"a.txt": kitti, "times.txt": times}
    return [{name: text.encode() for name, text in files.items()} for files in texts]


def _read_trajectories(folder: Path) -> None:
    from vislam.trajectory import evaluate, read_trajectory

    for path in folder.glob("a.*"):
        trajectory = read_trajectory(path)
        evaluate(trajectory, trajectory, "se3")


_IMAGE = cv2.imencode(".png", np.arange(48, dtype=np.uint8).reshape(6, 8))[1].tobytes()
_SENSOR = (
    b"T_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\nrate_hz: 20\n"
    b"resolution: [8, 6]\ncamera_model: pinhole\nintrinsics: [5.0, 5.0, 4.0, 3.0]\n"
    b"distortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.01, 1e-4, 2e-4]\n"
)
_IMU = (
    b"rate_hz: 200\ngyroscope_noise_density: 1.7e-04\ngyroscope_random_walk: 2e-5\n"
    b"accelerometer_noise_density: 2e-3\naccelerometer_random_walk: 3e-3\n"
)


def _asl() -> dict[str, bytes]:
    begin, files = 14 * 10**17, {}
    stamps = [begin + i * 50_000_000 for i in range(4)]
    files["mav0/cam0/sensor.yaml"], files["mav0/imu0/sensor.yaml"] = _SENSOR, _IMU
    files["mav0/cam0/data.csv"] = b"#timestamp [ns],filename\n" + b"".join(b"%d,%d.png\n" % (t, t) for t in stamps)
    files |= {f"mav0/cam0/data/{t}.png": _IMAGE for t in stamps}
    rows = b"".join(b"%d,0,0,0,0,0,9.81\n" % (begin + i * 5_000_000) for i in range(31))
    files["mav0/imu0/data.csv"] = b"#timestamp [ns],wx,wy,wz,ax,ay,az\n" + rows
    truth = b"".join(b"%d,0,0,0,1,0,0,0\n" % t for t in stamps)
    return files | {"mav0/mocap0/data.csv": b"#timestamp [ns],x,y,z,qw,qx,qy,qz\n" + truth}


def _tum() -> dict[str, bytes]:
    rows = b"".join(b"%d.5 rgb/%d.png\n" % (i, i) for i in range(1, 5))
    files = {f"rgb/{i}.png": _IMAGE for i in range(1, 5)}
    accelerations = b"".join(b"%d.25 0 0 9.81\n" % i for i in range(1, 5))
    truth = b"".join(b"%d.5 0 0 0 0 0 0 1\n" % i for i in range(1, 5))
    named = {"rgb.txt": rows, "accelerometer.txt": accelerations, "groundtruth.txt": truth, "sensor.yaml": _SENSOR}
    return files | named | {"depth.txt": rows.replace(b"rgb/", b"depth/")}


def _kitti() -> dict[str, bytes]:
    files = {f"image_0/{i:06d}.png": _IMAGE for i in range(4)}
    return files | {
        "calib.txt": b"P0: 5 0 4 0 0 5 3 0 0 0 1 0\nP1: 5 0 4 -2 0 5 3 0 0 0 1 0\n",
        "times.txt": b"0\n1e-1\n2e-1\n3e-1\n",
    }


def _bags() -> list[dict[str, bytes]]:
    """Return one bag of each storage and packing, with a camera, its calibration and an IMU."""
    from rosbags.rosbag1 import Writer as Rosbag1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Rosbag2
    from rosbags.typesys import Stores, get_typestore

    out: list[dict[str, bytes]] = []
    with tempfile.TemporaryDirectory() as name:
        for packing in (None, *Rosbag1.CompressionFormat):
            one = Rosbag1(Path(name) / f"{packing}.bag")
            if packing is not None:
                one.set_compression(packing)
            _write_bag(one, get_typestore(Stores.ROS1_NOETIC))
            out.append({"drive.bag": one.path.read_bytes()})
        for storage, ending in ((StoragePlugin.MCAP, ".mcap"), (StoragePlugin.SQLITE3, ".db3")):
            for mode in (CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.STORAGE):
                if (storage, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
                    continue
                two = Rosbag2(Path(name) / f"{storage}{mode}", version=9, storage_plugin=storage)
                two.set_compression(mode, CompressionFormat.ZSTD)
                _write_bag(two, get_typestore(Stores.ROS2_HUMBLE))
                out.append({"drive" + ending: next(two.path.glob(f"*{ending}")).read_bytes()})
    return out


def _write_bag(writer: Any, store: Any) -> None:
    types, ros1 = store.types, "seq" in str(store.fielddefs["std_msgs/msg/Header"])
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr

    def header(t_ns: int) -> Any:
        time_ = types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        return types["std_msgs/msg/Header"](**({"seq": 0} if ros1 else {}), stamp=time_, frame_id="cam")

    def vector(z: float) -> Any:
        return types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=z)

    begin, name = 14 * 10**17, str.upper if ros1 else str
    lens = {"d": np.zeros(5), "k": np.array([5.0, 0, 4, 0, 5, 3, 0, 0, 1]), "r": np.eye(3).ravel(), "p": np.zeros(12)}
    roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    nine = {f"{what}_covariance": np.zeros(9) for what in ("orientation", "angular_velocity", "linear_acceleration")}
    rows = [(begin, "/cam/camera_info", types["sensor_msgs/msg/CameraInfo"](
        header=header(begin), height=6, width=8, distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi,
        **{name(key): value for key, value in lens.items()}))]  # fmt: skip
    for i in range(4):
        t_ns = begin + i * 50_000_000
        rows.append((t_ns, "/cam/image_raw", types["sensor_msgs/msg/Image"](
            header=header(t_ns), height=6, width=8, encoding="mono8", is_bigendian=0, step=8,
            data=np.arange(48, dtype=np.uint8))))  # fmt: skip
        rows.append((t_ns, "/imu", types["sensor_msgs/msg/Imu"](
            header=header(t_ns), orientation=turn, angular_velocity=vector(0.0), linear_acceleration=vector(9.81),
            **nine)))  # fmt: skip
    with writer:
        connections: dict[str, Any] = {}
        for t_ns, topic, message in rows:
            type_ = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_, typestore=store)
            writer.write(connections[topic], t_ns, serialize(message, type_))


def _messages() -> list[tuple[str, str, bytes]]:
    """Return topic, type and bytes of the messages of such a bag."""
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    with tempfile.TemporaryDirectory() as name:
        writer = Writer(Path(name) / "a", version=9, storage_plugin=StoragePlugin.MCAP)
        _write_bag(writer, get_typestore(Stores.ROS2_HUMBLE))
        with Reader(Path(name) / "a") as reader:
            return [(one.topic, one.msgtype, bytes(data)) for one, _, data in reader.messages()]


def _film() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "a.mp4"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 20, (16, 16))
        for i in range(6):
            writer.write(np.full((16, 16, 3), i, np.uint8))
        writer.release()
        return {"a.mp4": path.read_bytes(), "a.yaml": _SENSOR.replace(b"[8, 6]", b"[16, 16]")}


def _survey_film(folder: Path) -> None:
    from vislam.datasets import open_dataset
    from vislam.datasets.inspect import inspect

    inspect(f"video:{folder / 'a.mp4'}")
    for _ in zip(range(50), open_dataset(f"video:{folder / 'a.mp4'}").events(), strict=False):
        pass


def _read_texts(folder: Path) -> None:
    if any(path.suffix in (".g2o", ".toro", ".isam") for path in folder.iterdir()):
        _optimize(folder)
    else:
        _read_trajectories(folder)


def _read_bags(folder: Path) -> None:
    from vislam.config import CalibrationConfig
    from vislam.datasets import open_dataset
    from vislam.datasets.inspect import inspect

    noise = folder.parent / f"{folder.name}.yaml"
    noise.write_bytes(_IMU)
    path = next(path for path in folder.iterdir())
    inspect(f"bag:{path}")
    for _ in zip(
        range(50), open_dataset(f"bag:{path}", CalibrationConfig(imu_noise=str(noise))).events(), strict=False
    ):
        pass


def _survey(folder: Path) -> None:
    from vislam.datasets import open_dataset

    recording = open_dataset(str(folder))
    for _ in zip(range(50), recording.events(), strict=False):
        pass


def _calibrations() -> list[dict[str, bytes]]:
    chain = (
        b"cam0:\n  camera_model: pinhole\n  intrinsics: [5.0, 5.0, 4.0, 3.0]\n  distortion_model: radtan\n"
        b"  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  resolution: [8, 6]\n"
        b"  T_cam_imu:\n  - [1, 0, 0, 0]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n"
    )
    info = (
        b"image_width: 8\nimage_height: 6\ndistortion_model: plumb_bob\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        b"  data: [5, 0, 4, 0, 5, 3, 0, 0, 1]\n"
        b"distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
    )
    memory = b'{"gyro_biases": [{"temperature_c": 20.0, "gyro_bias_rad_s": [0.01, 0.0, 0.0]}]}'
    lens = b"fx: 5.0\n%sfy: 5.0\n%scx: 4.0\n%scy: 3.0\n"
    orb = b'%YAML:1.0\nCamera.type: "PinHole"\nCamera.width: 8\nCamera.height: 6\nCamera1.' + lens % (
        (b"Camera1.",) * 3
    )
    vins = (
        b"%YAML:1.0\n---\nmodel_type: PINHOLE\nimage_width: 8\nimage_height: 6\ndistortion_parameters:\n   k1: 0.0\n"
        b"projection_parameters:\n   "
        + lens % ((b"   ",) * 3)
        + b"td: 0.01\nextrinsicTranslation: [0, 0, 1]\n"
        + b"extrinsicRotation: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
    )
    basalt = (
        b'{"value0": {"T_imu_cam": [{"px": 0, "py": 0, "pz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}],'
        b' "resolution": [[8, 6]], "intrinsics": [{"camera_type": "pinhole", "intrinsics": {"fx": 5,'
        b' "fy": 5, "cx": 4, "cy": 3}}]}}'
    )
    xml = (
        b"<?xml version='1.0'?>\n<opencv_storage><image_width>8</image_width><image_height>6</image_height>\n"
        b"<camera_matrix><data>5 0 4 0 5 3 0 0 1</data></camera_matrix>\n"
        b"<distortion_coefficients><data>0 0 0 0</data></distortion_coefficients></opencv_storage>"
    )
    rows = b"[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
    okvis = (
        b"cameras:\n  - {T_SC: " + rows + b", image_dimension: [8, 6], distortion_coefficients: [0, 0, 0, 0],\n"
        b"     distortion_type: radialtangential, focal_length: [5, 5], principal_point: [4, 3]}\nimageDelay: 0.1\n"
        b"imu_params:\n  sigma_g_c: 1e-3\n  sigma_a_c: 1e-2\n  sigma_gw_c: 1e-5\n  sigma_aw_c: 1e-4\n  s_a: [1, 1, 1]\n"
    )
    maplab = (
        b"cameras:\n- camera:\n    image_height: 6\n    image_width: 8\n    line-delay-nanoseconds: 9\n"
        b"    type: pinhole\n    intrinsics: {data: [5, 5, 4, 3]}\n"
        b"    distortion: {type: equidistant, parameters: {data: [0, 0, 0, 0]}}\n"
        b"  T_B_C: {data: " + rows + b"}\n"
    )
    pair = b"image_width: 8\nimage_height: 6\nT: [0.1, 0, 0]\nR: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n" + b"".join(
        b"M%d: [5, 0, 4, 0, 5, 3, 0, 0, 1]\nD%d: [0, 0, 0, 0, 0]\n" % (k, k) for k in (1, 2)
    )
    result = b"imu0:\n  T_i_b: " + rows + b"\n  time_offset: 0.0\n  rostopic: /imu0\n  " + _IMU.replace(b"\n", b"\n  ")
    all_ = (chain, info, _SENSOR, _IMU, memory, orb, vins, basalt, xml, okvis, maplab, pair, result)
    return [{"c.yaml": text} for text in all_]


def _read_calibrations(folder: Path) -> None:
    from vislam.datasets.calibration import read_camera
    from vislam.datasets.camera_files import read_cameras
    from vislam.datasets.imu_files import read_imu_calibration, read_mag_calibration, read_noise
    from vislam.imu.power_up import BiasMemory

    readers: tuple[Callable[[Path], object], ...] = (
        read_cameras, read_camera, read_noise, read_imu_calibration, read_mag_calibration,
        lambda path: BiasMemory.read(path, 100),
    )  # fmt: skip
    refusals = []
    for read in readers:
        try:
            read(folder / "c.yaml")
        except VislamError as error:
            refusals.append(error)
    if len(refusals) == len(readers):
        raise refusals[0]


def _settings() -> list[dict[str, bytes]]:
    text = (
        b'seed = 3\n[loop]\nmin_inliers = 20\n[graph]\ncoupling = "tight"\nhuber_k = 1.3\n[imu]\ngravity_m_s2 = 9.81\n'
    )
    plan = Path(__file__).with_name("ekf_vs_graph.toml").read_bytes()
    sensors = b'hfov_deg = 60.0\n[gy85]\nbus = "1"\n'
    return [{"c.toml": text}, {"sensors.toml": sensors}, {"plan.toml": plan}]


def _read_settings(folder: Path) -> None:
    from vislam.config import load, load_sensors
    from vislam.experiment.plan import load_plan

    if (folder / "plan.toml").exists():
        load_plan(folder / "plan.toml", {"VISLAM_DATA": "/data"})
        return
    if (folder / "c.toml").exists():
        load(folder / "c.toml")
        return
    load_sensors(folder / "sensors.toml")


_TRACKS = (
    b"row_type,t,a,b,frame,landmark,wx,wy,wz,ax,ay,az,m,n,o,p,q,r,u,v,key,value\n"
    + b"".join(b"meta,,,,,,,,,,,,,,,,,,,,camera_%s,400\n" % name for name in (b"fx", b"fy"))
    + b"".join(b"meta,,,,,,,,,,,,,,,,,,,,T_ci_%s,%d\n" % (n, n == b"qw") for n in
               (b"tx", b"ty", b"tz", b"qx", b"qy", b"qz", b"qw"))
    + b"".join(b"imu,%d.%02d,,,,,0,0,0,0,0,9.81,,,,,,,,,,\n" % (i // 20, i % 20 * 5) for i in range(40))
    + b"".join(b"vision_feature,%d.%d,,,%d,%d,,,,,,,,,,,,,0.1,0.2,,\n" % (i // 10, i % 10, i, i % 5) for i in range(15))
)  # fmt: skip


def _read_tracks(folder: Path) -> None:
    from vislam.datasets.formats.eqvio import read_track_table

    read_track_table(folder / "tracks.csv", {})


def _maps() -> list[dict[str, bytes]]:
    from vislam.mapping.formats.ply import write_ply
    from vislam.mapping.octree.octomap_io import encode_bt, encode_ot
    from vislam.mapping.octree.tree import OctreeLeaves

    starts = np.arange(32, dtype=np.int64) * 9 + (1 << 45)
    values = np.where(np.arange(32) % 2, 2.0, -2.0).astype(np.float32)
    octree = OctreeLeaves(0.05, starts, np.zeros(32, np.uint8), values)
    rng = np.random.default_rng(1)
    points, colors = rng.normal(size=(40, 3)).astype(np.float32), rng.integers(0, 255, (40, 3), np.uint8)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_ply(folder / "a.ply", points, colors)
        written = [{path.name: path.read_bytes()} for path in sorted(folder.iterdir())]
    return [{"a.bt": encode_bt(octree)}, {"a.ot": encode_ot(octree)}, *written]


def _read_maps(folder: Path) -> None:
    from vislam.mapping.formats.ply import read_ply
    from vislam.mapping.octree.octomap_io import read_octree

    for path in folder.iterdir():
        read: Callable[[Path], object] = read_ply if path.suffix == ".ply" else read_octree
        read(path)


def _vocabularies() -> list[dict[str, bytes]]:
    from vislam.loop import train

    rng = np.random.default_rng(2)
    small = train([rng.integers(0, 256, (60, 32), np.uint8) for _ in range(3)], 3, 2, 0, 1000)
    text = "3 1 0 0\n" + "".join(f"0 1 {' '.join(str(7 * i + j) for j in range(32))} 0.5\n" for i in range(3))
    return [{"v.npz": small.to_bytes()}, {"v.txt": text.encode()}]


def _read_vocabularies(folder: Path) -> None:
    from vislam.loop import Vocabulary, read_orbslam

    for path in folder.iterdir():
        vocabulary = Vocabulary.load(path) if path.suffix == ".npz" else read_orbslam(path)
        vocabulary.words(np.random.default_rng(3).integers(0, 256, (20, 32), np.uint8))


def _bridge() -> bytes:
    from vislam.hw.bridge.protocol import Chips, Hello, RawSample, Status, encode

    hello = Hello(0, 1000, Chips(7), 0xE5, 0x68, b"H43", 200, 38, 1213, 92, 1, 35000, 4000, 30000, 2000)
    samples = [RawSample(i, 1000 * i, Status(0), (0, 0, 256), (1, 2, 3), (4, 5, 6), 100) for i in range(20)]
    return encode(hello) + b"".join(map(encode, samples))


def _read_bridge(folder: Path) -> None:
    from vislam.hw.bridge.protocol import FrameDecoder

    data, decoder = (folder / "bytes").read_bytes(), FrameDecoder()
    for at in range(0, len(data), 61):
        decoder.feed(data[at : at + 61])


_RETRIEVED = b"from_id,to_id,score,island_score,consistency\n" + b"".join(b"%d,1,0.5,0.6,2\n" % i for i in range(9))


def _loops_csv() -> bytes:
    from vislam.loop import LoopRow, loops_text

    told = ("words", 0.5, 40, 3, 0.1, 2, 1.5, 1.0, float("nan"), float("nan"), np.eye(4), "accepted", "")
    rows = [LoopRow(i, i + 5, 10 * i, 10 * i + 50, *told) for i in range(9)]
    return loops_text(rows).encode()


def _read_tables(folder: Path) -> None:
    from vislam.loop import read_loops, read_retrieved

    read_loops(folder / "loops.csv")
    read_retrieved(folder / "retrieved.csv")


def _read_run(folder: Path) -> None:
    from vislam.runs.folder import read_metrics, read_setup

    for arguments in (("report", str(folder)), ("loops", str(folder)), ("eval", str(folder))):
        _verb(*arguments)
    read_metrics(folder)
    read_setup(folder)


def _read_stored(folder: Path) -> None:
    """Read what a run left by the functions that verbs call, each for itself."""
    from vislam.runs.folder import read_setup
    from vislam.runs.loaded import load_run
    from vislam.runs.offline.evaluated import read_evaluated
    from vislam.runs.report.run_files import read_run
    from vislam.runs.session import Session, recall

    def session(folder: Path) -> None:
        with closing(Session(folder / "session.db")) as stored:
            recall(stored)
            stored.factor_log()
            stored.config()
            for many in (stored.keyframes(), stored.loops(), stored.scans(), stored.shifts(), stored.retrieved()):
                for _ in many:
                    pass

    readers: tuple[Callable[[Path], object], ...] = (load_run, read_setup, read_evaluated, read_run, session)
    for read in readers:
        with suppress(VislamError):
            read(folder)


def _read_session(folder: Path, whole: list[str]) -> None:
    from vislam.runs.session import Session, SessionWriter, has_begun, recall

    path = folder / "session.db"
    has_begun(path)
    SessionWriter.reopen(path).close()
    session = Session(path)
    try:
        recall(session)
        session.factor_log()
        session.config()
    finally:
        session.close()
    if _dump(path) != whole:
        raise AssertionError("a damaged session was taken, and says something else than before")


def _dump(path: Path) -> list[str]:
    with closing(sqlite3.connect(path)) as database:
        return list(database.iterdump())


def main() -> int:
    """Fuzz for the time given; exit code 1 where something was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", type=int, default=10**7, help="of each target, at most")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--only", nargs="*", default=[], help="targets")
    parser.add_argument("--hostile", type=Path, help="folder of pose graphs to mutate as well")
    parser.add_argument("--keep", type=Path, help="folder for the files of what was found")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        targets = small_targets()
        if options.hostile is not None:
            targets.append(hostile_target(options.hostile))
        if not options.only or not {target.name for target in targets} >= set(options.only):
            targets += run_targets(Path(name))
        targets = [target for target in targets if not options.only or target.name in options.only]
        refused = refused_seeds(targets)
        until = time.monotonic() + 60.0 * options.minutes
        tallies = run_cases(targets, options.seed, options.first, options.cases, until, options.keep)
    print(*(f"not sound at the outset: {told}" for told in refused), sep="\n")
    for name, tally in tallies.items():
        counts = ", ".join(f"{count} {what}" for what, count in sorted(tally.counts.items()))
        print(f"{name}: {counts}; slowest {tally.slowest_s:.2f} s, {tally.most_bytes / 2**20:.0f} MiB at most")
    finds = [find for tally in tallies.values() for find in tally.finds]
    print(*finds[:100], sep="\n")
    print(f"{sum(t.counts.total() for t in tallies.values())} cases, {len(finds)} finds")
    return 1 if finds else 0


if __name__ == "__main__":
    sys.exit(main())
