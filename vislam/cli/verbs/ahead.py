"""Compiles what verbs need before anybody waits for it: at setup, and before the first run of a verb.

A verb that compiles for more than a second has its own jobs done first, where they never were. Small jobs run through
the verbs, two at a time, each in its own process. numba keeps each kernel as soon as it is compiled, and a job that
ended well leaves a stamp: what was interrupted goes on where it was.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from threading import Lock

from vislam.cli.verbs.terminal import progress_bar, progress_lines

_PACKAGE = Path(__file__).resolve().parents[2]
_AT_ONCE = 2
WITHIN = "VISLAM_COMPILING"  # in the environment of what must not compile ahead
_LOOPS = (  # so that a short run looks for loops, and trains its words
    "--loop.odometry-skip-keyframes=0", "--loop.appearance-skip-keyframes=0", "--loop.appearance-skip-s=0",
    "--loop.first-training=2", "--loop.min-training-lag=1", "--loop.min-inliers=6",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Job:
    """Verbs that are run one after another in a folder of their own."""

    kernels: int  # that it compiles where there are none, about; for the bar
    verbs: tuple[tuple[str, ...], ...]


JOBS = {  # in this order, for what two of them need at once is compiled twice
    "motion": Job(100, (("run", "points:workshop-cart,duration_s=3", "--out", "run", "--view.no-enabled"),)),
    "graphs": Job(
        60,
        (
            ("simulate", "--graph", "manhattan", "--poses", "200", "--out", "plane.g2o"),
            ("posegraph", "plane.g2o"),
            ("simulate", "--graph", "sphere", "--poses", "200", "--out", "space.g2o"),
            ("posegraph", "space.g2o"),
        ),
    ),
    "live": Job(  # by a name of its own, for a cart may be driving; its processes report no kernels
        0,
        (("live", "--source", "virtual-cart,rig=none", "--seconds", "1", "--out", "run", "--view.no-enabled",
          "--live.name", "vislam-setup"),),
    ),
    "cart": Job(
        150, (("run", "sim:workshop-cart,camera_hz=10,duration_s=10,image_width_px=320", "--out", "run", *_LOOPS),),
    ),
    "one camera": Job(
        35, (("run", "points:workshop-cart,rig=mono,duration_s=4", "--out", "run", "--view.no-enabled"),),
    ),
}  # fmt: skip


def compile_changed() -> None:
    """Do the jobs that were not done for this very source."""
    stamp = _stamp()
    if waiting := [name for name in JOBS if stamp not in _stamps(name)]:
        _compile(waiting, stamp)


def compile_ahead(jobs: Sequence[str], shown: bool = True) -> bool:
    """Compile the jobs that never were, each in a process that gives its memory back; return whether there were any.

    What became of older source is left to its first use: a developer waits for the kernels that changed only. With
    `shown` False the terminal has a bar already, and gets a line now and then.
    """
    waiting = [name for name in jobs if not _stamps(name)]
    if not waiting or WITHIN in os.environ:
        return False
    _compile(waiting, _stamp(), shown)
    return True


def _compile(jobs: Sequence[str], stamp: str, shown: bool = True) -> None:
    """Do jobs two at a time, say how far they are, and leave their stamps."""
    waiting = {name: JOBS[name] for name in jobs}
    total = sum(job.kernels for job in waiting.values())
    begun_s, done, lock = time.monotonic(), 0, Lock()
    running: list[subprocess.Popen[str]] = []
    title = "compiling for this processor, once"
    progress = progress_bar(title, "kernels") if shown else progress_lines(title, "kernels")
    with progress as bar, ThreadPoolExecutor(_AT_ONCE) as threads:

        def work(name: str) -> int:
            nonlocal done
            counted = 0
            with subprocess.Popen(
                [sys.executable, "-m", "vislam.cli.precompile", name], stdout=subprocess.PIPE, text=True
            ) as process:
                running.append(process)
                assert process.stdout is not None
                for line in process.stdout:
                    with lock:
                        counted += 1
                        done += counted <= waiting[name].kernels
                        bar(done, total, line.strip())
            with lock:
                done += max(0, waiting[name].kernels - counted)
            if process.returncode == 0:
                _leave(name, stamp)
            return process.returncode

        try:
            codes = list(threads.map(work, waiting))
        except BaseException:  # an interrupt: what is compiled by now is kept
            for process in running:
                process.terminate()
            raise
    if any(codes):
        print("vislam: not all could be compiled ahead; verbs compile the rest when they need it", file=sys.stderr)
    else:
        print(f"vislam: compiled in {time.monotonic() - begun_s:.0f} s", file=sys.stderr)


def _stamp() -> str:
    """Return what the compiled kernels depend on: the source, Python, numba and the processor's features."""
    import llvmlite.binding

    digest = hashlib.sha256(f"{sys.version} {version('numba')} {llvmlite.binding.get_host_cpu_name()}".encode())
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _places(name: str) -> list[Path]:
    """Return where the stamp of a job may be, the best place first: where numba keeps what it compiled."""
    if named := os.environ.get("NUMBA_CACHE_DIR"):
        folders = [Path(named)]
    else:
        home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        folders = [_PACKAGE / "__pycache__", Path(home, "numba")]
    return [folder / f"vislam-compiled-{name}" for folder in folders]


def _stamps(name: str) -> list[str]:
    """Return what the stamps of a job say; none where it never was done."""
    found = []
    for place in _places(name):
        with suppress(OSError):
            found.append(place.read_text(encoding="ascii"))
    return found


def _leave(name: str, stamp: str) -> None:
    for place in _places(name):
        with suppress(OSError):
            place.write_text(stamp, encoding="ascii")
            return
