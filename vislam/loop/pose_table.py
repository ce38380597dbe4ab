"""The map's current poses of the keyframes that loop closing knows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, GraphUpdate


class PoseTable:
    """Keyframe ids, ascending, and their poses T_map_body; grows by doubling, follows graph updates."""

    def __init__(self) -> None:
        self._ids = np.empty(64, np.int64)
        self._poses = np.empty((64, 4, 4))
        self._slots: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._slots)

    def __getitem__(self, keyframe_id: int) -> Array:
        """Return T_map_body [4, 4] of a keyframe."""
        pose: Array = self._poses[self._slots[keyframe_id]]
        return pose

    @property
    def ids(self) -> NDArray[np.int64]:
        """The ids [N]."""
        return self._ids[: len(self)]

    @property
    def poses(self) -> Array:
        """The poses T_map_body [N, 4, 4]."""
        return self._poses[: len(self)]

    def add(self, keyframe_id: int, T_map_body: Array) -> None:
        """Add a keyframe. Raises ValueError unless ids ascend and the pose is finite: the caller is at fault."""
        count = len(self)
        if count and keyframe_id <= self._ids[count - 1]:
            raise ValueError(f"keyframe {keyframe_id} came after keyframe {self._ids[count - 1]}")
        if T_map_body.shape != (4, 4) or not np.all(np.isfinite(T_map_body)):
            raise ValueError(f"keyframe {keyframe_id} has no finite pose: {T_map_body.tolist()}")
        if count == len(self._ids):
            self._ids = np.resize(self._ids, 2 * count)
            self._poses = np.resize(self._poses, (2 * count, 4, 4))
        self._ids[count], self._poses[count] = keyframe_id, T_map_body
        self._slots[keyframe_id] = count

    def move(self, update: GraphUpdate) -> None:
        """Take over the poses that moved; keyframes that are not known here are ignored."""
        for keyframe_id, pose in zip(update.ids.tolist(), update.T_map_body, strict=True):
            slot = self._slots.get(keyframe_id)
            if slot is not None:
                self._poses[slot] = pose
