"""Watching a run: `open_viewer` gives a recorder for Rerun, or one that does nothing where Rerun is absent or off."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from vislam.config import ViewConfig
from vislam.core.camera import Rig
from vislam.core.errors import install_line

if TYPE_CHECKING:
    from vislam.runs.viewer.recording import RunViewer

__all__ = ["NullViewer", "open_viewer"]


class NullViewer:
    """The viewer of a run that is not watched: every method of RunViewer, doing nothing."""

    def __init__(self, missing: str | None = None) -> None:
        """Remember what is missing, so that a run can say it; None: nothing, it is off."""
        self._missing = missing

    def __getattr__(self, name: str) -> Callable[..., None]:
        """Return what takes anything and does nothing, for each method of RunViewer that has no answer."""
        if name.startswith("_"):
            raise AttributeError(name)
        return _ignore

    def wants_map(self, t_ns: int, is_last: bool = False) -> bool:
        """Return False."""
        return False

    def close(self) -> str | None:
        """Return what is missing, once; None: nothing is."""
        missing, self._missing = self._missing, None
        return missing

    def __enter__(self) -> NullViewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


def _ignore(*_: object, **__: object) -> None:
    """Do nothing."""


def open_viewer(
    path: Path, enabled: bool = True, rig: Rig | None = None, config: ViewConfig | None = None
) -> RunViewer | NullViewer:
    """Return a viewer that writes a Rerun recording to `path`, or a silent one when disabled or without rerun-sdk.

    Raises StorageError when the file cannot be created.
    """
    if not enabled:
        return NullViewer()
    try:
        from vislam.runs.viewer.recording import RunViewer
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in ("rerun", "rerun_bindings"):
            raise
        return NullViewer(f"run.rrd is left out: rerun-sdk is not installed; {install_line('view')}")
    return RunViewer(path, rig, config or ViewConfig())
