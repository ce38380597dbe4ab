"""Watching a run: `open_viewer` gives a recorder for Rerun, or one that does nothing where Rerun is absent or off."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vislam.config import ViewConfig
from vislam.core.camera import Rig
from vislam.core.errors import install_line
from vislam.core.messages import (
    Array,
    Frame,
    GraphUpdate,
    ImageU8,
    Keyframe,
    LoopCandidate,
    LoopDecision,
    Observations,
    Tracking,
)

if TYPE_CHECKING:
    from vislam.runs.viewer.recording import RunViewer

__all__ = ["NullViewer", "open_viewer"]


class NullViewer:
    """The viewer of a run that is not watched: every method of RunViewer, doing nothing."""

    def __init__(self, missing: str | None = None) -> None:
        """Remember what is missing, so that a run can say it; None: nothing, it is off."""
        self._missing = missing

    def go_on(self, zero_ns: int, T_map_body: Mapping[int, Array]) -> None:
        """Ignore where an earlier recording ended."""

    def log_frame(self, frame: Frame, observations: Observations, tracking: Tracking) -> None:
        """Ignore a frame."""

    def log_pose(self, name: str, t_ns: int, T_world_body: Array) -> None:
        """Ignore a pose."""

    def log_keyframe(self, keyframe: Keyframe, T_map_body: Array) -> None:
        """Ignore a keyframe."""

    def move(self, update: GraphUpdate) -> None:
        """Ignore a graph update."""

    def log_cloud(self, keyframe_id: int, points_body_m: NDArray[np.floating], colors: ImageU8) -> None:
        """Ignore a keyframe's points."""

    def wants_map(self, t_ns: int, is_last: bool = False) -> bool:
        """Return False."""
        return False

    def log_octree(self, t_ns: int, voxels: NDArray[np.int64], resolution_m: float) -> None:
        """Ignore an octree."""

    def log_grid(
        self, t_ns: int, cells: NDArray[np.int8], resolution_m: float, origin_m: tuple[float, float], floor_m: float
    ) -> None:
        """Ignore a grid."""

    def log_loop(self, candidate: LoopCandidate) -> None:
        """Ignore a loop candidate."""

    def log_loop_picture(self, t_ns: int, jpeg: bytes, text: str) -> None:
        """Ignore a picture of a loop candidate."""

    def settle_loops(self, t_ns: int, decided: Mapping[tuple[int, int], LoopDecision]) -> None:
        """Ignore what became of loop candidates."""

    def log_scalars(self, t_ns: int, values: Mapping[str, float]) -> None:
        """Ignore numbers."""

    def log_path(self, name: str, positions_m: Array) -> None:
        """Ignore a path."""

    def log_note(self, t_ns: int, text: str) -> None:
        """Ignore a note."""

    def close(self) -> str | None:
        """Return what is missing, once; None: nothing is."""
        missing, self._missing = self._missing, None
        return missing

    def __enter__(self) -> NullViewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


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
