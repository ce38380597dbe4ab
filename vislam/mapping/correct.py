"""An occupancy map that follows the graph's corrections.

Clamped updates cannot be taken back, so a correction means integrating again, in the order of time. That is done on a
second map, a bounded number of keyframes per call, while the first stays in use; then they are swapped. Most
corrections move only the newest part of the trajectory: copies of the map as it was some keyframes ago are kept, and
the second map begins with the last of them that no moved keyframe has touched. The result is bit for bit the map that
the same poses would have given from the start.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.mapping.depth import DepthView, scan_points
from vislam.mapping.occupancy import OccupancyMap
from vislam.mapping.store import KeyframeStore, Scan

Array = NDArray[np.float64]


@dataclass(slots=True, eq=False)
class _Integrated:
    """A map with the poses at which keyframes are in it, in their order, and some of its earlier states."""

    occupancy: OccupancyMap
    poses: dict[int, Array] = field(default_factory=dict)
    checkpoints: list[tuple[int, OccupancyMap]] = field(default_factory=list)  # number of keyframes, the map of those

    def before(self, count: int) -> _Integrated | None:
        """Return the latest earlier state that holds at most the first `count` keyframes."""
        kept = [checkpoint for checkpoint in self.checkpoints if checkpoint[0] <= count]
        if not kept:
            return None
        held, occupancy = kept[-1]
        return _Integrated(occupancy.copy(), dict(islice(self.poses.items(), held)), kept)


class CorrectedOccupancy:
    """Occupancy of all keyframes of a store, each at its newest pose as far as the rebuilding has come."""

    def __init__(self, config: MapConfig, store: KeyframeStore, view: DepthView) -> None:
        self._config = config
        self._store = store
        self._view = view
        self._poses: dict[int, Array] = {}  # newest T_map_body
        self._current = _Integrated(_new_map(config))
        self._next: _Integrated | None = None  # the map being rebuilt
        self.counters = {"rebuilds": 0, "keyframes_integrated_again": 0}

    @property
    def occupancy(self) -> OccupancyMap:
        """The map to ask; a rebuild replaces the object, and leaves the one that a reader still holds alone."""
        return self._current.occupancy

    @property
    def poses(self) -> dict[int, Array]:
        """Newest T_map_body of every keyframe."""
        return self._poses

    def add(self, keyframe_id: int, scan: Scan, T_map_body: Array) -> None:
        """Integrate a new keyframe, which is in the store already."""
        self._poses[keyframe_id] = T_map_body
        self._integrate(self._current, keyframe_id, scan, T_map_body)

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
            count = self._count_in_place(self._config.move_voxels * self._config.resolution_m, self._config.move_deg)
            if count == len(self._poses):
                return
            self._next = self._current.before(count) or _Integrated(_new_map(self._config))
        waiting = [i for i in self._poses if i not in self._next.poses][:max_keyframes]
        for keyframe_id in waiting:
            self._integrate(self._next, keyframe_id, self._store.geometry(keyframe_id), self._poses[keyframe_id])
        self.counters["keyframes_integrated_again"] += len(waiting)
        if len(self._next.poses) == len(self._poses):
            self._current, self._next = self._next, None
            self.counters["rebuilds"] += 1

    def finish(self) -> None:
        """Bring every keyframe to exactly its newest pose."""
        self._next = None
        count = self._count_in_place(0.0, 0.0)
        if count < len(self._poses):
            self._next = self._current.before(count) or _Integrated(_new_map(self._config))
            self.advance(len(self._poses))

    def _count_in_place(self, far_m: float, far_deg: float) -> int:
        """Return how many keyframes come before the first that is missing or too far from where it was integrated.

        With limits of zero, any change of a pose is too far.
        """
        there = self._current.poses
        count = next((n for n, i in enumerate(self._poses) if i not in there), len(self._poses))
        if count == 0:
            return 0
        old = np.array([there[i] for i in islice(self._poses, count)])
        new = np.array(list(islice(self._poses.values(), count)))
        if far_m > 0.0 or far_deg > 0.0:
            moved = np.linalg.norm(new[:, :3, 3] - old[:, :3, 3], axis=1) > far_m
            trace = np.einsum("nij,nij->n", old[:, :3, :3], new[:, :3, :3])  # 1 + 2 cos(angle) of the turn between
            moved |= trace < 1.0 + 2.0 * np.cos(np.deg2rad(far_deg))
        else:
            moved = (old != new).any(axis=(1, 2))
        return int(moved.argmax()) if moved.any() else count

    def _integrate(self, into: _Integrated, keyframe_id: int, scan: Scan, T_map_body: Array) -> None:
        config = self._config
        if scan.depth is not None:
            points, origin = scan_points(scan.depth, self._view, T_map_body, config.resolution_m)
            into.occupancy.insert(points, origin, self._view.max_range_m, config.insertion)
        elif scan.points_body_m is not None:
            ranges = np.linalg.norm(scan.points_body_m, axis=1)
            near = scan.points_body_m[ranges <= config.max_range_m].astype(np.float64)
            points_map = near @ T_map_body[:3, :3].T + T_map_body[:3, 3]
            camera = T_map_body @ self._view.T_body_view
            into.occupancy.insert(points_map, camera[:3, 3], -1.0, config.insertion)
        into.poses[keyframe_id] = T_map_body
        is_due = len(into.poses) % config.checkpoint_keyframes == 0
        if is_due and into.occupancy.nbytes <= 1e6 * config.checkpoint_max_mb:
            into.checkpoints = [*into.checkpoints, (len(into.poses), into.occupancy.copy())][-config.checkpoints :]


def _new_map(config: MapConfig) -> OccupancyMap:
    return OccupancyMap(
        config.resolution_m,
        config.hit_probability,
        config.miss_probability,
        config.clamp_min_probability,
        config.clamp_max_probability,
    )
