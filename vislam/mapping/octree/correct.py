"""An occupancy map that follows the graph's corrections.

Clamped updates cannot be taken back, so a correction means integrating again, in the order of time. What each keyframe
said of voxels is kept, a bit each, compressed. So only keyframes that moved cast their rays again; the blocks that they
touched, before or now, are rebuilt from what all keyframes said of them. That is done beside the map, a bounded
number of keyframes per call, and put in its place at once. The result is bit for bit the map that the same poses would
have given from the start.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.mapping.cloud.store import KeyframeStore, Scan
from vislam.mapping.depth.image import DepthView, scan_points
from vislam.mapping.octree.blocks import BLOCK_VOXELS, BlockPool
from vislam.mapping.octree.occupancy import NO_MARKS, Octree, ScanMarks

_REPLAYS = 24  # keyframes whose marks are applied again in about the time in which one casts its rays


@dataclass(frozen=True, slots=True, eq=False)
class _Said:
    """What a keyframe said of voxels, and from where."""

    T_map_body: Array
    points: int
    blocks: NDArray[np.int64]
    packed: bytes  # the marks' bits, compressed

    @classmethod
    def of(cls, T_map_body: Array, marks: ScanMarks) -> _Said:
        return cls(T_map_body, marks.points, marks.blocks, zlib.compress(marks.bits.tobytes(), 1))

    @property
    def nbytes(self) -> int:
        return self.blocks.nbytes + len(self.packed)

    def marks(self) -> ScanMarks:
        bits = np.frombuffer(zlib.decompress(self.packed), np.uint8)
        return ScanMarks(self.points, self.blocks, bits.reshape(-1, 2, 64))


@dataclass(slots=True, eq=False)
class _Patch:
    """A correction under way: first keyframes that moved cast their rays, then blocks are rebuilt."""

    waiting: list[int]  # keyframes that have yet to cast their rays
    gone: list[int]  # keyframes that are in the map and are not to be
    moved: dict[int, _Said] = field(default_factory=dict)
    blocks: Octree | None = None  # those that are rebuilt
    replayed: int = 0  # keyframes of which they hold what was said


class CorrectedOccupancy:
    """Occupancy of all keyframes of a store, each at its newest pose as far as correcting has come."""

    def __init__(self, config: MapConfig, store: KeyframeStore, view: DepthView) -> None:
        self._config = config
        self._store = store
        self._view = view
        self._poses: dict[int, Array] = {}  # newest T_map_body, in the order in which keyframes are integrated
        self._said: dict[int, _Said] = {}  # by the keyframes that are in the map
        self._occupancy = _new_map(config)
        self._patch: _Patch | None = None
        self.left_out: dict[int, str] = {}  # keyframes whose scan no octree can hold where they are, and why
        self.counters = {"rebuilds": 0, "keyframes_integrated_again": 0, "marks_bytes": 0}

    @property
    def occupancy(self) -> Octree:
        """The map to ask; a correction replaces the object, and leaves the one that a reader still holds alone."""
        return self._occupancy

    @property
    def poses(self) -> dict[int, Array]:
        """Newest T_map_body of every keyframe."""
        return self._poses

    def add(self, keyframe_id: int, scan: Scan, T_map_body: Array) -> None:
        """Integrate a new keyframe, which is in the store already."""
        self._poses[keyframe_id] = T_map_body
        marks = self._trace(keyframe_id, scan, T_map_body)
        self._occupancy.apply(marks)
        self._remember(keyframe_id, _Said.of(T_map_body, marks))

    def enter(self, T_map_body: dict[int, Array]) -> None:
        """Note keyframes that are in the store; `advance` and `finish` integrate them, in the order of ids."""
        self._poses = dict(sorted((self._poses | T_map_body).items()))
        self._patch = None  # its order is another now

    def leave(self, keyframe_ids: Iterable[int]) -> None:
        """Let keyframes go; `advance` and `finish` make the map as if they had never been in it."""
        for keyframe_id in keyframe_ids:
            del self._poses[keyframe_id]
        self._patch = None

    def move(self, keyframe_ids: NDArray[np.int64], T_map_body: Array) -> None:
        """Note new poses [M, 4, 4] of keyframes; those that are not in the map are ignored."""
        for keyframe_id, T in zip(keyframe_ids.tolist(), T_map_body, strict=True):
            if keyframe_id in self._poses:
                self._poses[keyframe_id] = np.array(T, dtype=np.float64)

    def advance(self, max_keyframes: int) -> None:
        """Do one slice of a correction: begin when keyframes have moved by more than the limits, swap when complete."""
        if self._patch is None:
            moved = self._misplaced(self._config.move_voxels * self._config.resolution_m, self._config.move_deg)
            gone = self._gone()
            if not moved and not gone:
                return
            self._patch = _Patch(moved, gone)
        self._correct(self._patch, max_keyframes)

    def finish(self) -> None:
        """Bring every keyframe to exactly its newest pose."""
        moved, gone = self._misplaced(0.0, 0.0), self._gone()
        begun = {} if self._patch is None else self._patch.moved
        done = {i: said for i, said in begun.items() if (said.T_map_body == self._poses[i]).all()}
        self._patch = _Patch([i for i in moved if i not in done], gone, done) if moved or gone else None
        while self._patch is not None:
            self._correct(self._patch, len(self._poses))

    def _misplaced(self, far_m: float, far_deg: float) -> list[int]:
        """Return the keyframes that are missing, or too far from where they were integrated.

        With limits of zero, any change of a pose is too far.
        """
        there = [i for i in self._poses if i in self._said]
        if not there:
            return list(self._poses)
        old = np.array([self._said[i].T_map_body for i in there])
        new = np.array([self._poses[i] for i in there])
        if far_m > 0.0 or far_deg > 0.0:
            moved = np.linalg.norm(new[:, :3, 3] - old[:, :3, 3], axis=1) > far_m
            trace = np.einsum("nij,nij->n", old[:, :3, :3], new[:, :3, :3])  # 1 + 2 cos(angle) of the turn between
            moved |= trace < 1.0 + 2.0 * np.cos(np.deg2rad(far_deg))
        else:
            moved = (old != new).any(axis=(1, 2))
        in_place = {i for i, is_moved in zip(there, moved.tolist(), strict=True) if not is_moved}
        return [i for i in self._poses if i not in in_place]

    def _gone(self) -> list[int]:
        """Return the keyframes that are in the map and are not to be."""
        return [i for i in self._said if i not in self._poses]

    def _correct(self, patch: _Patch, max_keyframes: int) -> None:
        """Do the work of `max_keyframes` that cast rays, or of that many times `_REPLAYS` that do not."""
        now = patch.waiting[:max_keyframes]
        for keyframe_id in now:
            T = self._poses[keyframe_id]
            patch.moved[keyframe_id] = _Said.of(T, self._trace(keyframe_id, self._store.geometry(keyframe_id), T))
        patch.waiting = patch.waiting[len(now) :]
        self.counters["keyframes_integrated_again"] += len(now)
        if patch.waiting:
            return
        if patch.blocks is None:
            patch.blocks = self._dirty_blocks(patch)
        budget = (max_keyframes - len(now)) * _REPLAYS
        order = list(self._poses)
        while budget > 0 and patch.replayed < len(order):
            keyframe_id = order[patch.replayed]
            said = patch.moved.get(keyframe_id) or self._said[keyframe_id]
            if patch.blocks.pool.holds_any(said.blocks):
                patch.blocks.apply(said.marks(), only_known=True)
                budget -= 1
            patch.replayed += 1
        if patch.replayed == len(order):
            self._occupancy = self._occupancy.with_pool(self._occupancy.pool.replaced(patch.blocks.pool))
            for keyframe_id, said in patch.moved.items():
                self._remember(keyframe_id, said)
            for keyframe_id in patch.gone:
                said = self._said.pop(keyframe_id)
                self.counters["marks_bytes"] -= said.nbytes
            self._patch = None
            self.counters["rebuilds"] += 1

    def _dirty_blocks(self, patch: _Patch) -> Octree:
        """Return a map that knows nothing of the blocks that moved or gone keyframes touched, before or now."""
        touched = [said.blocks for said in patch.moved.values()]
        touched += [self._said[i].blocks for i in (*patch.moved, *patch.gone) if i in self._said]
        keys = np.unique(np.concatenate(touched))
        unknown = np.full((len(keys), BLOCK_VOXELS), np.nan, np.float32)
        return self._occupancy.with_pool(BlockPool.of(keys, unknown))

    def _remember(self, keyframe_id: int, said: _Said) -> None:
        old = self._said.get(keyframe_id)
        self.counters["marks_bytes"] += said.nbytes - (0 if old is None else old.nbytes)
        self._said[keyframe_id] = said

    def _trace(self, keyframe_id: int, scan: Scan, T_map_body: Array) -> ScanMarks:
        """Return the marks of a scan; nothing where no octree can hold it: a wild pose must not cost the whole map."""
        self.left_out.pop(keyframe_id, None)
        try:
            return self._marks(scan, T_map_body)
        except DataError as error:
            self.left_out[keyframe_id] = str(error)
            return NO_MARKS

    def _marks(self, scan: Scan, T_map_body: Array) -> ScanMarks:
        config = self._config
        if scan.depth is not None:
            points, origin = scan_points(scan.depth, self._view, T_map_body, config.resolution_m)
            return self._occupancy.trace(points, origin, self._view.max_range_m, config.insertion)
        if scan.points_body_m is not None:
            ranges = np.linalg.norm(scan.points_body_m, axis=1)
            near = scan.points_body_m[ranges <= config.max_range_m].astype(np.float64)
            points_map = near @ T_map_body[:3, :3].T + T_map_body[:3, 3]
            camera = T_map_body @ self._view.T_body_view
            return self._occupancy.trace(points_map, camera[:3, 3], -1.0, config.insertion)
        return NO_MARKS


def _new_map(config: MapConfig) -> Octree:
    return Octree(
        config.resolution_m,
        config.hit_probability,
        config.miss_probability,
        config.clamp_min_probability,
        config.clamp_max_probability,
        config.miss_beside_probability,
        config.clears_at_range,
    )
