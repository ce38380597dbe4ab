"""The door to a Dask cluster: one that is there, or processes of this machine for as long as they are needed."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from vislam.core.errors import UsageError, install_line
from vislam.core.interrupts import ignore

if TYPE_CHECKING:
    from distributed import Client

_ANSWER_S = 20.0  # a scheduler that is there answers much sooner, and workers come
_EMPTY = 4  # looks within that time, none of which finds a worker
# tasks are given whole domains: Dask's warning of their size is of no use here
_SETTINGS = {"distributed.admin.large-graph-warning-threshold": "1 TB"}


@contextmanager
def dask_client(scheduler: str | None, workers: int) -> Iterator[Client]:
    """Connect to the scheduler at an address, or start `workers` of one thread each, which hear loopback alone.

    Raises UsageError without Dask, or without a scheduler at that address.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise UsageError(f"--engine dask needs the extra 'cluster': {install_line('cluster')}") from error
    with dask.config.set(_SETTINGS):
        if scheduler is None:
            # of processes that Python looks after, whose end an interrupted parent does not wait for
            os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker:UserWarning")
            with (
                distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, host="127.0.0.1", dashboard_address=None,
                    silence_logs=logging.CRITICAL, preload=[__name__],
                ) as cluster,
                distributed.Client(cluster) as client,
            ):  # fmt: skip
                yield client
            return
        try:
            client = distributed.Client(scheduler, timeout=_ANSWER_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise UsageError(
                f"no Dask scheduler answers at '{scheduler}': {error}; start one: dask scheduler"
            ) from error
        with client:
            yield client


def dask_setup(_: object) -> None:
    """Leave interrupts to the parent, with which a worker ends; Dask calls this in each that `dask_client` starts."""
    ignore()


class DaskTeam:
    """Workers of a Dask cluster, who keep what they made.

    What is lost with a worker is made again by another: the scheduler has what it was made of.
    """

    def __init__(self, client: Client) -> None:
        """Take the connection; it stays the caller's to close."""
        self._client = client

    def keep(self, make: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return what stands for make(*arguments), once for each, which stays with the worker that made it."""
        return [self._client.submit(make, *a, pure=False) for a in arguments]

    def each(self, task: Callable[..., Any], kept: Sequence[Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return task(kept, *arguments) for each that is kept, in their order.

        Raises UsageError where several workers ended at one of them, or no worker or scheduler is there for long.
        """
        from distributed import CancelledError, KilledWorker
        from distributed.comm import CommClosedError

        futures = [self._client.submit(task, k, *a, pure=False) for k, a in zip(kept, arguments, strict=True)]
        try:
            self._wait(futures)
            return list(self._client.gather(futures))
        except (CancelledError, KilledWorker, CommClosedError) as error:
            raise UsageError(
                f"the Dask cluster lost its workers or its scheduler ({type(error).__name__}); give workers more memory"
            ) from error

    def _wait(self, futures: list[Any]) -> None:
        """Wait until all are done; tasks wait for ever where no worker comes."""
        from distributed import wait

        empty = 0
        while empty < _EMPTY:
            try:
                wait(futures, timeout=_ANSWER_S / _EMPTY)
                return
            except TimeoutError:
                empty = 0 if self._client.scheduler_info()["workers"] else empty + 1
        raise UsageError("the Dask scheduler has no workers, or lost them; do they have this version of vislam?")
