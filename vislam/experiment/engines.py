"""Where jobs run: processes of this machine, or a Dask cluster. Both are given the same function of plain data."""

import threading
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from vislam.core.cluster import dask_client
from vislam.experiment.isolated import run_isolated

Spec = dict[str, Any]
Result = dict[str, Any]
Finished = Generator[tuple[Spec, Result], None, None]


def run_locally(specs: Sequence[Spec], workers: int, cache: Path, keep: Path | None) -> Finished:
    """Yield each job with its result as it is done, in any order; closing the iterator stops what still runs.

    The threads only wait: every job is a process of its own.
    """
    stop = threading.Event()
    kept = None if keep is None else str(keep)
    with ThreadPoolExecutor(workers, thread_name_prefix="job") as pool:
        try:
            futures = {pool.submit(run_isolated, spec, str(cache), kept, stop): spec for spec in specs}
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


def run_on_dask(specs: Sequence[Spec], scheduler: str, cache: Path, keep: Path | None) -> Finished:
    """Yield each job with its result as a Dask worker finishes it; Dask gives the jobs of a lost worker to others.

    Workers need this very version of vislam and the same paths to the recordings. A job that took several workers
    down with it is a failed result. Raises UsageError without Dask or without a scheduler at that address.
    """
    with dask_client(scheduler, 0) as client:
        from distributed import as_completed as finished_first

        kept = None if keep is None else str(keep)
        futures = {
            client.submit(run_isolated, spec, str(cache), kept, key=f"vislam-{spec['key']}", pure=False): spec
            for spec in specs
        }
        try:
            for future in finished_first(list(futures), raise_errors=False):
                yield futures[future], _outcome(future)
        finally:
            client.cancel(list(futures))


def _outcome(future: Any) -> Result:
    if future.status == "finished":
        return dict(future.result())
    if future.status == "cancelled":
        return {"status": "stopped", "reason": "cancelled on the scheduler"}
    return {"status": "failed", "reason": f"crash: {future.exception()!r}", "run": {}, "outputs": {}}
