"""A signal ends whatever runs, at any moment; nothing hangs, and nothing left behind is in the way of the next try."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from vislam.core.interrupts import EXIT_CODE, SIGNALS
from vislam.runs.folder import prepare
from vislam.runs.session import Session, has_frames
from waiting import HUNG_S, is_gone, wait_for

SEED = 9
LOOK_S = 0.03  # between looks at all processes, which cost CPU themselves


@dataclass(frozen=True)
class Ended:
    code: int
    said: str


def cpu_s(process: psutil.Process) -> float:
    """Return the CPU that a process and its descendants have taken, which moves on as their work does."""
    spent = 0.0
    for one in (process, *process.children(recursive=True)):
        with suppress(psutil.Error):
            spent += one.cpu_times().user + one.cpu_times().system
    return spent


def started(arguments: list[str]) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "vislam", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        # children of a background job ignore the signal unless told otherwise
        preexec_fn=lambda: [signal.signal(n, signal.SIG_DFL) for n in SIGNALS],  # noqa: PLW1509
        start_new_session=True,
    )  # fmt: skip


def interrupted(
    arguments: list[str], when: Callable[[psutil.Process], bool], number: signal.Signals, to_group=True, late_ok=False
) -> Ended:
    """Start vislam, signal it when something is so as a terminal does, and wait for its end."""
    process = started(arguments)
    watched = psutil.Process(process.pid)
    while process.poll() is None and not when(watched):
        time.sleep(LOOK_S)
    assert late_ok or process.poll() is None, f"it had ended before the signal: {process.communicate()}"
    with suppress(ProcessLookupError):
        (os.killpg if to_group else os.kill)(process.pid, number)
    try:
        _, said = process.communicate(timeout=HUNG_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        pytest.fail(f"{' '.join(arguments)} hung after {number.name}")
    return Ended(process.returncode, said)


def processes_of(name: str) -> list[int]:
    """Return what runs with a word in its arguments, after those that end had a moment for it."""
    deadline = time.monotonic() + HUNG_S
    while True:
        found = [p.pid for p in psutil.process_iter() if p.pid != os.getpid() and name in " ".join(_words(p))]
        if not found or time.monotonic() > deadline:
            return found
        time.sleep(0.2)


def _words(process: psutil.Process) -> list[str]:
    try:
        return [] if process.status() == psutil.STATUS_ZOMBIE else process.cmdline()
    except psutil.Error:
        return []


def check(ended: Ended, number: signal.Signals, moment: str) -> None:
    """130, or killed by the signal: before anything was set up, or where Python says so to its parent."""
    print(moment, number.name, ended.code)
    assert ended.code in (EXIT_CODE, -number), f"{moment}: {ended.code}\n{ended.said}"
    if ended.code == EXIT_CODE:
        assert "Traceback" not in ended.said and "interrupted" in ended.said, f"{moment}:\n{ended.said}"


def test_a_verb_ends_at_random_moments_and_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    """Moments are shares of the CPU that it takes from its start to its last file, whatever the machine."""
    rng, out, interrupts = random.Random(SEED), tmp_path / "room", 0
    print("seed", SEED)
    arguments = ["simulate", "handheld-room", "--duration-s", "1", "--image-width-px", "160", "--out"]
    for whole in (tmp_path / "first", tmp_path / "second"):
        whole_s, process = 0.0, started([*arguments, str(whole)])
        while process.poll() is None:
            whole_s = max(whole_s, cpu_s(psutil.Process(process.pid)))
            time.sleep(LOOK_S)
        assert process.returncode == 0 and (whole / "mav0").exists() and process.stderr is not None
        if "compiling" not in process.stderr.read():
            break  # else it took longer than any later one
    for k in range(6):
        number, share = SIGNALS[k % 3], rng.uniform(0.1, 0.9)
        reached = lambda process, spent_s=share * whole_s: cpu_s(process) >= spent_s  # noqa: E731
        ended = interrupted([*arguments, str(out)], reached, number, to_group=k % 2 == 0, late_ok=True)
        if ended.code != 0:
            check(ended, number, f"moment {k}, {share:.2f} of {whole_s:.2f} s of CPU")
            interrupts += 1
        made, wanted = ({p.relative_to(at) for p in (at / "mav0").rglob("*")} for at in (out, whole))
        assert made == wanted or (made == set() and ended.code != 0)  # whole, or not at all
        if made:
            shutil.rmtree(out)  # a try that failed is in no other one's way
    assert interrupts >= 3


def test_a_live_run_ends_at_random_moments_and_can_be_started_again(tmp_path: Path) -> None:
    rng = random.Random(SEED + 1)
    print("seed", SEED + 1)
    name, spent_s = f"vislam-test-int-{os.getpid()}", 0.0
    arguments = ["live", "--source", "virtual-cart,rig=none", "--out", str(tmp_path / "run"), "--live.name", name]

    def publishes(process: psutil.Process) -> bool:
        nonlocal spent_s
        spent_s = cpu_s(process)
        return any(name in path.name for path in Path("/dev/shm").iterdir())

    def once(when: Callable[[psutil.Process], bool], number: signal.Signals, moment: str) -> None:
        ended = interrupted([*arguments, "--view.no-enabled"], when, number)
        if ended.code != 0:  # 0: it was going, and this is how it ends
            check(ended, number, moment)
        assert [*processes_of(name), *(p.name for p in Path("/dev/shm").iterdir() if name in p.name)] == []
        # where the end took longer than a signal leaves it, 130 comes with what was recorded, which is not to be lost
        if has_recorded := has_frames(tmp_path / "run" / "session.db"):
            Session(tmp_path / "run" / "session.db").close()  # raises where it is not sound
        prepare(tmp_path / "run", overwrite=has_recorded)

    once(publishes, SIGNALS[0], "once it publishes")
    for k in range(1, 4):
        share = rng.uniform(0.05, 1.1)
        reached = lambda process, till_s=share * spent_s: cpu_s(process) >= till_s  # noqa: E731
        once(reached, SIGNALS[k % 3], f"moment {k}, {share:.2f} of {spent_s:.2f} s of CPU")


def test_workers_of_a_cluster_end_with_their_parent(tmp_path: Path) -> None:
    graph = tmp_path / f"vislam-test-int-{os.getpid()}.g2o"
    assert started(["simulate", "--graph", "torus", "--poses", "30000", "--out", str(graph)]).wait(HUNG_S) == 0
    arguments = ["posegraph", str(graph), "--engine", "dask", "--out", str(tmp_path / "out")]
    workers: list[psutil.Process] = []

    def works(process: psutil.Process) -> bool:
        workers[:] = [p for p in process.children(recursive=True) if "spawn_main" in " ".join(_words(p))]
        return len(workers) == 2 and all(cpu_s(worker) > 3.0 for worker in workers)

    check(interrupted(arguments, works, signal.SIGINT), signal.SIGINT, "while workers solve")
    wait_for(lambda: all(map(is_gone, workers)))
    assert not (tmp_path / "out" / "optimized.g2o").exists()


STUCK = """
import os, signal, sys, threading, time
from vislam.core import interrupts
with interrupts.bounded():
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
    {what}
"""


@pytest.mark.parametrize(
    "what",
    [
        # a lock that is never given back: the system does not break such a call off, as it would a sleep
        "import ctypes; lock = (ctypes.c_char * 64)(); [ctypes.CDLL(None).pthread_mutex_lock(lock) for _ in 'ab']",
        "\n    while True:\n        try: time.sleep(100)\n        except KeyboardInterrupt: pass",
    ],
    ids=["in a call", "swallowed"],
)
def test_what_does_not_end_is_ended(what: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", STUCK.format(what=what)], timeout=HUNG_S, capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGTERM, signal.SIG_DFL),
    )  # fmt: skip
    assert done.returncode == EXIT_CODE
    assert done.stderr.split("\n") == ["", "vislam: interrupted; what was written by then is kept", ""]


def test_what_is_ignored_stays_ignored() -> None:
    script = """
import os, signal
from vislam.core import interrupts
signal.signal(signal.SIGHUP, signal.SIG_IGN)
with interrupts.bounded():
    os.kill(os.getpid(), signal.SIGHUP)
    with interrupts.counted() as asked:
        os.kill(os.getpid(), signal.SIGHUP)
    print(asked.count)
"""
    done = subprocess.run([sys.executable, "-c", script], timeout=HUNG_S, capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"


def test_a_closed_terminal_is_an_interrupt_like_any_other(tmp_path: Path) -> None:
    pid, master = os.forkpty()
    if pid == 0:
        os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
        for number in SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        command = [sys.executable, "-m", "vislam", "simulate", "corridor-loop", "--out", str(tmp_path / "world")]
        os.execv(sys.executable, command)
    assert os.read(master, 1)  # it reports how far it is
    os.close(master)
    deadline = time.monotonic() + HUNG_S
    while (status := os.waitpid(pid, os.WNOHANG))[0] == 0:
        if time.monotonic() > deadline:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            pytest.fail("it hung")
        time.sleep(0.1)
    assert os.waitstatus_to_exitcode(status[1]) in (EXIT_CODE, -signal.SIGHUP)
