"""A job in a fresh process, so that a crash is its own, its memory is its own, and it can be stopped."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

_POLL_S = 0.1
_SAID = 400  # characters of what a crashed process last said


def run_isolated(
    spec: dict[str, Any], cache: str, keep: str | None = None, stop: threading.Event | None = None
) -> dict[str, Any]:
    """Run one job (see `Job.spec`) in a process of its own and return its result as plain data. Never raises for a job.

    A crash, and a job that takes longer than its timeout, have status "failed" and a reason; a job that `stop` ended
    has status "stopped", which is no result. With `keep`, the run folder is moved to `keep`/KEY.
    """
    folder = Path(tempfile.mkdtemp(prefix="vislam-job-"))
    try:
        result = _supervise(spec, cache, folder, stop)
        if keep is not None and (folder / "run").is_dir():
            kept = Path(keep) / spec["key"][:24]
            kept.parent.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(kept, ignore_errors=True)
            shutil.move(folder / "run", kept)
        return result
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _supervise(spec: dict[str, Any], cache: str, folder: Path, stop: threading.Event | None) -> dict[str, Any]:
    """Start the process, wait for it, and turn how it ended into a result."""
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, "-m", "vislam.experiment.worker", str(folder)]
    (folder / "request.json").write_text(json.dumps({"spec": spec, "cache": cache}), encoding="utf-8")
    with (folder / "said.txt").open("wb") as said:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE,  # stays open: its end shows the worker that its parent is gone
            stdout=said, stderr=said, env={**os.environ, **threads},
            start_new_session=True,  # an interrupt is for the process that asked, which then ends this one
        )  # fmt: skip
    start_s = time.monotonic()
    try:
        while process.poll() is None:
            if stop is not None and stop.is_set():
                return {"status": "stopped", "reason": "stopped"}
            if time.monotonic() - start_s > spec["timeout_s"]:
                return _failed(f"timeout: not done after {spec['timeout_s']:g} s")
            _wait(process, _POLL_S)
    finally:
        _end(process)
    answer = folder / "result.json"
    if process.returncode == 0 and answer.is_file():
        return dict(json.loads(answer.read_text(encoding="utf-8")))
    last = (folder / "said.txt").read_text(encoding="utf-8", errors="replace").strip()[-_SAID:]
    return _failed(f"crash: {_ending(process.returncode)}" + (f"; last said: {last}" if last else ""))


def _wait(process: subprocess.Popen[bytes], seconds: float) -> None:
    """Wait for a process, but not longer."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _failed(reason: str) -> dict[str, Any]:
    return {"status": "failed", "reason": reason, "run": {}, "outputs": {}}


def _ending(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
