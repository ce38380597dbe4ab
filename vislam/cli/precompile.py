"""`./run setup` compiles what the verbs need before anybody waits for it: `python -m vislam.cli.precompile`.

Small jobs run through the verbs, two at a time, each in its own process. numba keeps each kernel as soon as it is
compiled, and a job that ended well leaves a stamp: what was interrupted goes on where it was.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from threading import Lock

_PACKAGE = Path(__file__).resolve().parent.parent
_AT_ONCE = 2
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
    "motion": Job(
        135,
        (
            ("run", "points:workshop-cart,duration_s=3", "--out", "run", "--view.no-enabled"),
            ("run", "points:workshop-cart,rig=mono,duration_s=4", "--out", "tight", "--view.no-enabled"),
        ),
    ),
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
}  # fmt: skip


def main(arguments: list[str]) -> int:
    """Compile what has no stamp yet, with a bar; or, given a job's name, do that one. Return the exit code."""
    if arguments:
        return _do(JOBS[arguments[0]])
    stamp = _stamp()
    waiting = {name: job for name, job in JOBS.items() if not _is_done(name, stamp)}
    if not waiting:
        return 0
    from vislam.cli.verbs.terminal import progress_bar

    total = sum(job.kernels for job in waiting.values())
    begun_s, done, lock = time.monotonic(), 0, Lock()
    with progress_bar("compiling, once", "kernels") as bar, ThreadPoolExecutor(_AT_ONCE) as threads:

        def work(name: str) -> int:
            nonlocal done
            counted = 0
            with subprocess.Popen(
                [sys.executable, "-m", "vislam.cli.precompile", name], stdout=subprocess.PIPE, text=True
            ) as process:
                assert process.stdout is not None
                for line in process.stdout:
                    with lock:
                        counted += 1
                        done += counted <= waiting[name].kernels
                        bar(done, total, line.strip())
            with lock:
                done += max(0, waiting[name].kernels - counted)
            if process.returncode == 0:
                with suppress(OSError):
                    _place(name).write_text(stamp, encoding="ascii")
            return process.returncode

        codes = list(threads.map(work, waiting))
    if any(codes):
        print("vislam: not all could be compiled ahead; verbs compile the rest when they need it", file=sys.stderr)
    else:
        print(f"vislam: compiled in {time.monotonic() - begun_s:.0f} s", file=sys.stderr)
    return 0


def _do(job: Job) -> int:
    """Run the verbs of a job; a line on stdout for each kernel that is compiled, and nothing else."""
    from vislam.cli import run_verb
    from vislam.core.compiling import on_each_kernel

    out = os.fdopen(os.dup(1), "w", buffering=1)
    with tempfile.TemporaryDirectory(prefix="vislam-precompile-") as folder:
        os.chdir(folder)
        with open(os.devnull, "w", encoding="utf-8") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
        on_each_kernel(lambda name: print(name, file=out))
        return max(run_verb(list(verb)) for verb in job.verbs)


def _stamp() -> str:
    """Return what the compiled kernels depend on: the source, Python, numba and the processor's features."""
    import llvmlite.binding

    digest = hashlib.sha256(f"{sys.version} {version('numba')} {llvmlite.binding.get_host_cpu_name()}".encode())
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _place(name: str) -> Path:
    """Return the stamp of a job: beside what was compiled, so that it goes where that goes."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or _PACKAGE / "__pycache__") / f"vislam-compiled-{name}"


def _is_done(name: str, stamp: str) -> bool:
    with suppress(OSError):
        return _place(name).read_text(encoding="ascii") == stamp
    return False


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
