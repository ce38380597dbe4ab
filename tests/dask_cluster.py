"""A real Dask scheduler with workers on loopback, whose processes a test may kill."""

import json
import subprocess
import sys
from contextlib import contextmanager

import pytest

from waiting import HUNG_S, wait_for


@contextmanager
def dask_cluster(folder, names=("one", "two")):
    """Give the address of a scheduler and its workers by name: processes that end with their parent."""
    distributed = pytest.importorskip("distributed")
    file = folder / "scheduler.json"
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = _started("distributed.cli.dask_scheduler", options, folder / "scheduler.txt")
    processes = [scheduler]
    try:
        wait_for(lambda: file.is_file() and file.stat().st_size > 0)
        address = json.loads(file.read_text())["address"]
        workers = {name: _worker(address, name, folder) for name in names}
        processes += workers.values()
        if names:
            with distributed.Client(address, timeout=HUNG_S) as client:
                client.wait_for_workers(len(names), timeout=HUNG_S)
        yield address, workers
    finally:
        for process in processes:
            if process.poll() is None:
                process.kill()
            process.wait()


def _worker(address, name, folder):
    options = ["--name", name, "--local-directory", str(folder), "--no-dashboard", "--host", "127.0.0.1"]
    command = [address, "--nthreads", "1", "--no-nanny", *options]
    return _started("distributed.cli.dask_worker", command, folder / f"{name}.txt")


def _started(module, arguments, output):
    with output.open("wb") as said:
        return subprocess.Popen([sys.executable, "-m", module, *arguments], stdout=said, stderr=said)
