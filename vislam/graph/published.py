"""What the back end has published, so that only what moved since goes out again."""

from __future__ import annotations

import numpy as np

from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.graph.estimate import Ids

_MOVED_M = 0.001  # poses that moved less are not published again
_MOVED_DEG = 0.05


class Published:
    """Owns the poses as they were last published, where odom is in map, and the number of the last update."""

    def __init__(self) -> None:
        """Start with nothing published."""
        self._poses: Array = np.zeros((0, 4, 4))
        self.T_map_odom: Array = np.eye(4)
        self.revision = 0

    def place_odom(self, T_map_body: Array, T_odom_body: Array) -> None:
        """Take where the newest keyframe is in both."""
        self.T_map_odom = T_map_body @ invert(np.ascontiguousarray(T_odom_body, dtype=np.float64))

    def take(self, poses: Array, read: Ids, everything: bool) -> Ids:
        """Return which of the poses [M, 4, 4] that were read back have moved, or all; they count as published now."""
        known = self._poses
        ids = np.arange(len(poses), dtype=np.int64) if everything else read
        if (grown := len(poses) - len(known)) > 0:
            known = np.concatenate([known, np.full((grown + len(poses) // 2, 4, 4), np.inf)])
        fresh, old = poses[ids], known[ids]
        shift = np.linalg.norm(fresh[:, :3, 3] - old[:, :3, 3], axis=1)
        limit = 2.0 * np.sqrt(2.0) * np.sin(0.5 * np.deg2rad(_MOVED_DEG))  # the chord of that angle
        chord = np.linalg.norm(fresh[:, :3, :3] - old[:, :3, :3], axis=(1, 2))
        moved = ids[(shift > _MOVED_M) | (chord > limit) | everything]
        known[moved] = poses[moved]
        self._poses = known
        self.revision += 1
        return moved
