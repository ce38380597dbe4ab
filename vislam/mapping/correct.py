"""An occupancy map that follows the graph's corrections.

Clamped updates cannot be taken back, so a correction means integrating again, in the order of time. That is done on a
second map, a bounded number of keyframes per call, while the first stays in use; then they are swapped. The result is
bit for bit the map that the same poses would have given from the start.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.mapping.depth import DepthView, scan_points
from vislam.mapping.occupancy import OccupancyMap
from vislam.mapping.store import KeyframeStore, Scan

Array = NDArray[np.float64]


class CorrectedOccupancy:
    """Occupancy of all keyframes of a store, each at its newest pose as far as the rebuilding has come."""

    def __init__(self, config: MapConfig, store: KeyframeStore, view: DepthView) -> None:
        self._config = config
        self._store = store
        self._view = view
        self._poses: dict[int, Array] = {}  # newest T_map_body
        self._current = _new_map(config)
        self._current_poses: dict[int, Array] = {}  # at which each keyframe is in the current map
        self._next: OccupancyMap | None = None  # the map being rebuilt
        self._next_poses: dict[int, Array] = {}
        self.counters = {"rebuilds": 0, "keyframes_integrated_again": 0}

    @property
    def occupancy(self) -> OccupancyMap:
        """The map to ask; a rebuild replaces the object, and leaves the one that a reader still holds alone."""
        return self._current

    @property
    def poses(self) -> dict[int, Array]:
        """Newest T_map_body of every keyframe."""
        return self._poses

    def add(self, keyframe_id: int, scan: Scan, T_map_body: Array) -> None:
        """Integrate a new keyframe, which is in the store already."""
        self._poses[keyframe_id] = T_map_body
        self._integrate(self._current, scan, T_map_body)
        self._current_poses[keyframe_id] = T_map_body

    def restore(self, keyframe_id: int, T_map_body: Array) -> None:
        """Note a keyframe of an earlier run, which is in the store already; `advance` and `finish` integrate it."""
        self._poses[keyframe_id] = T_map_body

    def move(self, keyframe_ids: NDArray[np.int64], T_map_body: Array) -> None:
        """Note new poses [M, 4, 4] of keyframes; those that are not in the map are ignored."""
        for keyframe_id, T in zip(keyframe_ids.tolist(), T_map_body, strict=True):
            if keyframe_id in self._poses:
                self._poses[keyframe_id] = np.array(T, dtype=np.float64)

    def advance(self, max_keyframes: int) -> None:
        """Do one slice of rebuilding: start when keyframes have moved by more than the limits, swap when complete."""
        if self._next is None:
            if not self._any_moved():
                return
            self._next, self._next_poses = _new_map(self._config), {}
        waiting = [i for i in self._poses if i not in self._next_poses][:max_keyframes]
        for keyframe_id in waiting:
            T = self._poses[keyframe_id]
            self._integrate(self._next, self._store.geometry(keyframe_id), T)
            self._next_poses[keyframe_id] = T
        self.counters["keyframes_integrated_again"] += len(waiting)
        if len(self._next_poses) == len(self._poses):
            self._current, self._current_poses = self._next, self._next_poses
            self._next = None
            self.counters["rebuilds"] += 1

    def finish(self) -> None:
        """Bring every keyframe to exactly its newest pose."""
        if self._is_complete() and all(np.array_equal(self._poses[i], self._current_poses[i]) for i in self._poses):
            self._next = None
            return
        self._next, self._next_poses = _new_map(self._config), {}
        self.advance(len(self._poses))

    def _any_moved(self) -> bool:
        """Return whether a keyframe is farther from where it was integrated than the limits allow."""
        if not self._poses:
            return False
        if not self._is_complete():
            return True
        old = np.array([self._current_poses[i] for i in self._poses])
        new = np.array(list(self._poses.values()))
        far_m = self._config.move_voxels * self._config.resolution_m
        moved = np.linalg.norm(new[:, :3, 3] - old[:, :3, 3], axis=1) > far_m
        trace = np.einsum("nij,nij->n", old[:, :3, :3], new[:, :3, :3])  # 1 + 2 cos(angle) of the turn between them
        return bool((moved | (trace < 1.0 + 2.0 * np.cos(np.deg2rad(self._config.move_deg)))).any())

    def _is_complete(self) -> bool:
        return len(self._current_poses) == len(self._poses)

    def _integrate(self, occupancy: OccupancyMap, scan: Scan, T_map_body: Array) -> None:
        config = self._config
        if scan.depth is not None:
            points, origin = scan_points(scan.depth, self._view, T_map_body, config.resolution_m)
            occupancy.insert(points, origin, self._view.max_range_m, config.insertion)
        elif scan.points_body_m is not None:
            ranges = np.linalg.norm(scan.points_body_m, axis=1)
            near = scan.points_body_m[ranges <= config.max_range_m].astype(np.float64)
            points_map = near @ T_map_body[:3, :3].T + T_map_body[:3, 3]
            camera = T_map_body @ self._view.T_body_view
            occupancy.insert(points_map, camera[:3, 3], -1.0, config.insertion)


def _new_map(config: MapConfig) -> OccupancyMap:
    return OccupancyMap(
        config.resolution_m,
        config.hit_probability,
        config.miss_probability,
        config.clamp_min_probability,
        config.clamp_max_probability,
    )
