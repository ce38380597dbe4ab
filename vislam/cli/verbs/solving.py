"""The options of verbs that solve large pose graphs: where to do it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from vislam.config.ranges import Few
from vislam.core.errors import UsageError

if TYPE_CHECKING:
    from vislam.core.cluster import DaskTeam


@dataclass(frozen=True)
class SolvingOptions:
    """Where a pose graph is solved."""

    engine: Literal["local", "dask"] = "local"
    """As a whole in this process, or in overlapping domains by the workers of a Dask cluster"""
    workers: Few = 2
    """Of --engine dask on this machine; each takes one core"""
    scheduler: str | None = None
    """Address of the Dask scheduler whose workers are to solve instead, as tcp://127.0.0.1:8786"""

    @contextmanager
    def team(self) -> Iterator[DaskTeam | None]:
        """Give who solves domains; None: the graph is solved as a whole.

        Raises UsageError for options that contradict each other.
        """
        if self.engine == "local":
            if self != SolvingOptions():
                raise UsageError("--workers and --scheduler are of --engine dask")
            yield None
            return
        if self.scheduler is not None and self.workers != SolvingOptions.workers:
            raise UsageError("a --scheduler has workers of its own; leave --workers away")
        from vislam.core.cluster import DaskTeam, dask_client

        with dask_client(self.scheduler, self.workers) as client:
            yield DaskTeam(client)
