"""Runs every verb where something fails: a full disk, a folder or device without rights, an absent board, bad files.

    python experiments/failures.py [--only PART OF A NAME] [--short]

What must hold of each case: it ends within 10 s with the right exit code and one line on stderr, never a traceback, and
the same command succeeds, or is at least not refused for what the first left, once the failure is mended.
A full disk is a small tmpfs for root, a limit of the size of files for others. Needs about ten minutes; root keeps no
right that a user has not, so that missing rights can be missed.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from vislam.hw.emulator.bridge import BridgeEmulator, at_rest

HUNG_S = 120.0
SLOW_S = 10.0
_ROOT = os.geteuid() == 0
_MOUNTS = _ROOT  # a container's root may not
_DROPPED_CAPABILITIES = (1, 2)  # linux/capability.h: DAC_OVERRIDE, DAC_READ_SEARCH
_PR_CAPBSET_DROP = 24  # linux/prctl.h
_CAPABILITIES_V3 = 0x20080522  # linux/capability.h
_WORLD = "points:corridor-loop,duration_s=5,camera_hz=10,tracks=100"
SIMULATE = "simulate handheld-room --duration-s 1 --image-width-px 160 --out"  # the world that is painted soonest
_MEND_KB = 400_000
# CPython 3.11 keeps a byte code file of which it could write a part only, and never starts again
_ENVIRONMENT = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
_ENVIRONMENT.pop("PYTHONUNBUFFERED", None)  # users have it not, and what stdout still holds at the end fails late
_CAMERA = """\
cam0:
  camera_model: pinhole
  intrinsics: [400.0, 400.0, 319.5, 239.5]
  distortion_model: radtan
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  resolution: [640, 480]
  T_cam_imu: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
"""


Here = Callable[[list[str]], tuple[int, float, str]]  # runs a verb's words; exit code, seconds and stderr


@dataclass(frozen=True)
class Case:
    """A command in a place where something fails. `{place}` is a folder there, `{data}` holds what is sound."""

    name: str
    command: str
    codes: tuple[int, ...]
    fault: Literal["none", "full", "read-only", "unplugged"] = "none"
    free_kb: int = 0
    copies: tuple[str, ...] = ()  # from {data} into {place}, before it fails
    is_short: bool = False
    is_tried_again: bool = True
    is_refused_again: bool = False  # a second try has to be told to go on or to replace


@dataclass(frozen=True)
class Outcome:
    """What came of a case; no faults: all is well."""

    code: int
    took_s: float
    said: str
    faults: tuple[str, ...]


def cases() -> Iterator[Case]:
    """Yield all cases."""
    yield from _full_disk()
    yield from _read_only()
    yield from _devices()
    yield from _bad_files()


def _writers(run_out: str) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Yield name, command and copies of every verb that writes."""
    yield "run", f"run {_WORLD} --out {{place}}/{run_out}", ()
    yield "demo", "demo --out {place}/demo", ()
    yield "simulate", f"{SIMULATE} {{place}}/world", ()
    yield "simulate graph", "simulate --graph grid3d --out {place}/world.g2o", ()
    yield "optimize", "optimize {place}/run", ("run",)
    yield "join", "optimize {data}/run {data}/other --out {place}/both", ()
    yield "posegraph", "posegraph {data}/graph.g2o --out {place}/graph", ()
    yield "map", "map {place}/run", ("run",)
    yield "report", "report {place}/run", ("run",)
    yield "export", "export {data}/run --mcap {place}/run.mcap", ()
    yield "vocabulary", "vocabulary {data}/world --features 200 --out {place}/words.npz", ()
    yield "board", "calibrate board --out {place}/board", ()
    yield "record", "record --imu serial:{data}/tty --camera none --seconds 1 --min-free-gb 0 --out {place}/ride", ()
    yield "compare", "compare {data}/plan.toml --out {place}/out --store {place}/r.db --cache {place}/cache", ()
    yield "live", "live --source virtual-cart,rig=none --seconds 2 --out {place}/live --live.name vislam-failures", ()


def _full_disk() -> Iterator[Case]:
    free = {
        "run": (0, 30, 200, 600, 1500, 3000),
        "record": (0, 40),
        "live": (0, 30, 200),
        "report": (0, 200),
        "join": (0, 200),
    }
    short = {"simulate", "simulate graph", "posegraph", "report", "board", "record"}
    for name, command, copies in _writers("run"):
        for free_kb in free.get(name, (0, 30)):
            codes = (3,) if free_kb == 0 else (0, 3)
            goes_on = name in ("run", "demo", "record", "live") and free_kb > 0
            yield Case(
                f"full disk, {free_kb} kB free: {name}", command, codes, "full", free_kb, copies,
                is_short=name in short and free_kb == 0, is_tried_again=name != "demo",
                is_refused_again=goes_on,
            )  # fmt: skip
    for verb in ("completion bash", "doctor {data}/world", "eval {data}/run", "loops {data}/run", "--help"):
        yield Case(
            f"full disk: {verb} to a file", f"{verb} > /dev/full", (3,), is_short=verb in ("completion bash", "--help")
        )


def _read_only() -> Iterator[Case]:
    for name, command, copies in _writers("run"):
        short = name in ("run", "simulate", "report", "record")
        yield Case(f"read-only folder: {name}", command, (3,), "read-only", copies=copies, is_short=short,
                   is_tried_again=name != "demo")  # fmt: skip


def _devices() -> Iterator[Case]:
    here = "--out {place}/out"
    camera = "--calibration.camera {data}/camera.yaml"
    for device, source in (("i2c", "gy85+none"), ("serial", "serial:/dev/nothing+none")):
        yield Case(f"absent {device}: live", f"live --source {source} {here}", (5,), is_short=True)
    yield Case("absent camera: live", f"live --source serial:{{data}}/tty+/dev/video77 {camera} {here}", (5,))
    for sensor in ("--imu gy85 --camera none", "--imu serial:/dev/nothing --camera none", "--imu none --camera 77"):
        yield Case(f"absent: record {sensor}", f"record {sensor} {here} --min-free-gb 0", (5,), is_short=True)
    for sensor in ("--i2c /dev/i2c-77", "--serial /dev/nothing", "--camera 77"):
        yield Case(f"absent: doctor {sensor}", f"doctor {sensor}", (5,), is_short=True)
    yield Case("absent camera: calibrate", "calibrate camera webcam:77 --out {place}/c", (3, 5))
    for device in ("gy85", "serial"):
        yield Case(f"no right to {device}: live", f"live --source {device}:{{data}}/secret+none {here}", (5,))
        command = f"record --imu {device}:{{data}}/secret --camera none {here} --min-free-gb 0"
        yield Case(f"no right to {device}: record", command, (5,))
    yield Case("no right to camera: record", f"record --imu none --camera /dev/secret {here} --min-free-gb 0", (5,))
    board = "--imu serial:{data}/tty --camera none --seconds 10 --min-free-gb 0"
    yield Case("unplugged: record", f"record {board} {here}", (0,), "unplugged", is_refused_again=True)
    outage = "virtual-cart,rig=none,imu_out=1:2"
    yield Case("unplugged: live", f"live --source {outage} --seconds 4 {here}", (0,), is_refused_again=True)


def _bad_files() -> Iterator[Case]:
    here = "--out {place}/out"
    yield Case("a seed among the options of a world: run", f"run {_WORLD},seed=1 {here}", (2,), is_short=True)
    for what in ("nothing", "folder", "noise.bin", "secret"):
        path = f"{{data}}/{what}"
        yield Case(f"one of two sessions is {what}: join", f"optimize {{data}}/run {path} {here}", (2, 3),
                   is_short=True)  # fmt: skip
        yield Case(f"calibration is {what}: run", f"run {{data}}/world --calibration.camera {path} {here}", (2, 3),
                   is_short=True)  # fmt: skip
        yield Case(f"calibration is {what}: live",
                   f"live --source serial:{{data}}/tty+0 --calibration.camera {path} {here}", (2, 3))  # fmt: skip
        yield Case(f"noise is {what}: live",
                   f"live --source serial:{{data}}/tty+none --calibration.imu-noise {path} {here}", (2, 3))  # fmt: skip
        yield Case(f"settings are {what}: run", f"run {_WORLD} --config {path} {here}", (2, 3), is_short=True)
        yield Case(f"sensors are {what}: live", f"live --sensors {path} --source gy85+none {here}", (2, 3))
        for verb in ("run {} {here}", "doctor {}", "eval {}", "optimize {}", "posegraph {}", "map {}", "loops {}",
                     "report {}", "export {} --mcap {place}/run.mcap", "compare {}",
                     "vocabulary {} --out {place}/w.npz", "run --resume {}",
                     "live --resume {}", "calibrate noise {} --out {place}/c"):  # fmt: skip
            command = verb.replace("{here}", here).replace("{}", path)
            yield Case(f"input is {what}: {verb.split(' {')[0]}", command, (2, 3))


def make_data(data: Path) -> None:
    """Make what cases read: runs, a world, a graph, a plan, and files that are of no use."""
    data.mkdir(parents=True, exist_ok=True)
    for command in (
        f"run {_WORLD} --out {data}/run --view.no-enabled",
        f"run {_WORLD} --out {data}/other --view.no-enabled",
        f"{SIMULATE} {data}/world",
        f"simulate --graph grid3d --out {data}/graph.g2o",
    ):
        subprocess.run([sys.executable, "-m", "vislam", *command.split()], check=True, stdout=subprocess.DEVNULL)
    (data / "plan.toml").write_text(
        'name = "one"\nseeds = [0]\nmembers = 1\nconfig = {"loop.enabled" = false}\n[[sequences]]\nname = "laps"\n'
        'source = "points:laps"\noptions = {duration_s = 3.0, tracks = 40, camera_hz = 10.0, descriptors = false}\n'
        '[[estimators]]\nname = "loose"\noutputs = ["ekf"]\n'
    )
    make_small_files(data)


def make_small_files(data: Path) -> None:
    """Make the calibration of a camera, and files that are of no use."""
    data.mkdir(parents=True, exist_ok=True)
    (data / "camera.yaml").write_text(_CAMERA)
    (data / "folder").mkdir()
    (data / "noise.bin").write_bytes(np.random.default_rng(0).bytes(2000))
    (data / "secret").write_text("nobody reads this")
    (data / "secret").chmod(0)


def run_case(case: Case, data: Path, scratch: Path, here: Here | None = None) -> Outcome:
    """Run a case, and once more when what failed is mended; `here` runs what needs no process of its own."""
    with _place(case, data, scratch) as (place, mend):
        code, took_s, said = _run(case, data, place, here)
        faults = [f"exit code {code}, expected {case.codes}"] if code not in case.codes else []
        if took_s > HUNG_S:
            faults.append("it hung")
        if "Traceback" in said or "bug" in said:
            faults.append("a traceback")
        is_told_elsewhere = case.command.startswith("doctor")  # its findings are what it prints
        if code in (2, 3, 5) and len(_lines(said)) != 1 and not is_told_elsewhere:
            faults.append(f"{len(_lines(said))} lines")
        if case.fault in ("full", "read-only") and not faults and code == 3 and case.is_tried_again:
            mend()
            again, _, words = _run(case, data, place, here, is_mended=True)
            is_begun = (
                case.fault == "full" and not _MOUNTS
            )  # a file may hold a little, so there is something to replace
            allowed = (0, 2, 4) if case.is_refused_again or is_begun else (0, 4)
            if again not in allowed or (again == 2 and "--overwrite" not in words and "new folder" not in words):
                faults.append(f"the second try ended with {again}: {words[-200:]}")
    return Outcome(code, took_s, said, tuple(faults))


def _lines(said: str) -> list[str]:
    """Return what is said of the failure; progress is none of it."""
    passing = (
        "getting ready",
        "vislam: simulating",
        "vislam: compiling",
        "x ",
        "no pose yet",
        "ending",
        "corridor-loop: ",
        "handheld-room: ",
    )
    return [line for line in said.splitlines() if line.strip() and not line.startswith(passing)]


@contextmanager
def _place(case: Case, data: Path, scratch: Path) -> Iterator[tuple[Path, object]]:
    """Give the folder of a case, and what mends it."""
    place = scratch / "place"
    place.mkdir()
    is_mounted = case.fault == "full" and _MOUNTS
    if is_mounted:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_MEND_KB}k", "tmpfs", str(place)], check=True)
    try:
        for name in case.copies:
            shutil.copytree(data / name, place / name)
        mend = lambda: None  # noqa: E731
        if is_mounted:
            status = os.statvfs(place)
            used_kb = (status.f_blocks - status.f_bfree) * status.f_frsize // 1024
            _resize(place, max(used_kb + case.free_kb, 4))
            if case.free_kb == 0:
                _fill(place)
            mend = lambda: (_resize(place, _MEND_KB), (place / "filled").unlink(missing_ok=True))  # noqa: E731
        elif case.fault == "read-only":
            _allow(place, 0o500)
            mend = lambda: _allow(place, 0o700)  # noqa: E731
        yield place, mend
    finally:
        _allow(place, 0o700)
        if is_mounted:
            subprocess.run(["umount", "-l", str(place)], check=True)
        shutil.rmtree(place, ignore_errors=True)


def _resize(place: Path, size_kb: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size_kb}k", str(place)], check=True)


def _fill(place: Path) -> None:
    with suppress(OSError), (place / "filled").open("wb", buffering=0) as file:
        while True:
            file.write(b"\0" * 4096)


def _allow(folder: Path, mode: int) -> None:
    for path in [folder, *folder.rglob("*")]:
        if path.is_dir():
            path.chmod(mode)


def _run(case: Case, data: Path, place: Path, here: Here | None, is_mended: bool = False) -> tuple[int, float, str]:
    """Run the command of a case; return exit code, seconds (of an unplugged sensor: since then) and stderr."""
    command, _, into = case.command.replace("{place}", str(place)).replace("{data}", str(data)).partition(" > ")
    words = [sys.executable, "-m", "vislam", *command.split()]
    if here is not None and not into and (case.fault != "full" or _MOUNTS or is_mended):
        with _board(data, is_unplugged=False), nullcontext() if is_mended else _fewer_rights():
            return here(command.split())
    with _board(data, case.fault == "unplugged"), open(into or os.devnull, "w") as out:
        begun = time.monotonic()
        process = subprocess.Popen(
            words, stdout=out, stderr=subprocess.PIPE, text=True, cwd=data, start_new_session=True, env=_ENVIRONMENT,
            preexec_fn=lambda: _without_rights(case, is_mended),  # noqa: PLW1509 it calls the system only
        )  # fmt: skip
        try:
            _, said = process.communicate(timeout=HUNG_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            _, said = process.communicate()
            return -9, HUNG_S + 1.0, said
        return process.returncode, time.monotonic() - begun, said


def _without_rights(case: Case, is_mended: bool) -> None:
    """In the child: root may write and read everything unless it gives that up."""
    if _ROOT:
        libc = ctypes.CDLL(None)
        for capability in _DROPPED_CAPABILITIES:
            libc.prctl(_PR_CAPBSET_DROP, capability)
    if case.fault == "full" and not _MOUNTS and not is_mended:
        size = max(case.free_kb, 1) * 1024
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


@contextmanager
def _fewer_rights() -> Iterator[None]:
    """In this thread, and in those that it starts meanwhile: what `_without_rights` takes from a child for good."""
    libc, header, rights = ctypes.CDLL(None), (ctypes.c_uint32 * 2)(_CAPABILITIES_V3, 0), (ctypes.c_uint32 * 6)()
    if libc.capget(header, rights) != 0:
        raise OSError("capget")
    held = rights[0]  # those in effect; they stay permitted
    for capability in _DROPPED_CAPABILITIES:
        rights[0] &= ~(1 << capability)
    try:
        if libc.capset(header, rights) != 0:
            raise OSError("capset")
        yield
    finally:
        rights[0] = held
        libc.capset(header, rights)


@contextmanager
def _board(data: Path, is_unplugged: bool) -> Iterator[None]:
    """Have a board on `{data}/tty`, which is unplugged after a while if asked for."""
    with BridgeEmulator(data / "tty", at_rest) as board:
        timer = threading.Timer(8.0, board.unplug)
        if is_unplugged:
            timer.start()
        try:
            yield
        finally:
            timer.cancel()


def main() -> int:
    """Run the cases that are asked for; exit code 1 when one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cases whose names hold this")
    parser.add_argument("--after", default="", help="cases after the one of this name")
    parser.add_argument("--short", action="store_true", help="those that the tests run")
    parser.add_argument("--data", type=Path, help="keep what the cases read here, and use it again")
    asked = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data" if asked.data is None else asked.data.resolve()
        if not (data / "secret").exists():
            make_data(data)
        found = list(cases())
        names = [case.name for case in found]
        for case in found[names.index(asked.after) + 1 if asked.after else 0 :]:
            if asked.only not in case.name or (asked.short and not case.is_short):
                continue
            outcome = run_case(case, data, Path(folder))
            failed += bool(outcome.faults)
            late = " SLOW" if outcome.took_s > SLOW_S else ""
            word = "FAILED" if outcome.faults else "ok"
            print(f"{word:7}{outcome.code:4} {outcome.took_s:6.1f} s{late}  {case.name}", flush=True)
            if outcome.faults:
                print("\n        ".join(["", "; ".join(outcome.faults), *outcome.said[-1500:].splitlines()])[1:])
    print(f"{failed} failed")
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
