"""Surfels: small discs that make up surfaces, each anchored to a keyframe and moving with it.

Point-based fusion as in Keller et al., "Real-time 3D reconstruction in dynamic scenes using point-based fusion", 3DV
2013, without a projected index map. A measurement merges into the nearest surfel whose centre is less than a spacing
away along the surface and less than a thickness across it, and that faces the same way: position, normal and colour
become averages weighted by confidence, the confidence is the sum, the radius is the smaller. Where there is none, it
becomes a surfel of its own, anchored to its keyframe.

Each keyframe's depth is merged on its own first, and these discs are kept in the keyframe's frame: they are rigid, so
a correction carries them along and costs nothing. What is asked for is all of them merged by the same rule, in the
order in which the keyframes came. So averages never mix measurements that later turn out to lie apart, and after a
correction the surfels are those made from scratch at the final poses, bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.mapping.cloud.cloud import voxel_key
from vislam.mapping.cloud.store import Scan
from vislam.mapping.depth.image import DepthView
from vislam.mapping.octree import find_slot
from vislam.mapping.semantic.votes import Votes, vote

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

_STENCIL_PX = 2  # normals from neighbours this far away: nearer ones show the noise of depth
_MIN_FACING = 0.2  # cosine to the ray; surfaces seen at a more grazing angle are measured badly
_SAME_FACING = 0.7  # cosine between normals of one surface
_THICKNESS = 1.5  # spacings across the surface, within which two measurements are one surface's
_COLUMNS = 12  # position, normal, colour, radius, confidence, label
_LABEL = 11


@dataclass(frozen=True, slots=True, eq=False)
class Surfels:
    """Discs in the map frame."""

    points_m: F32  # [N, 3]
    normals: F32  # [N, 3] unit, to where they were seen from
    colors: NDArray[np.uint8]  # [N, 3] RGB
    radius_m: F32  # [N]
    confidence: F32  # [N] sum of 1 / range^4, that is of 1 / variance of depth in the units of one metre's
    views: NDArray[np.int32]  # [N] keyframes that saw it
    anchors: I64  # [N] id of the keyframe that it moves with
    labels: NDArray[np.uint16]  # [N] that most keyframes saw there; 0: none saw any
    label_votes: NDArray[np.int32]  # [N] keyframes that did
    label_total: NDArray[np.int32]  # [N] keyframes that saw any label

    def __len__(self) -> int:
        return len(self.points_m)

    def select(self, chosen: NDArray[np.bool_]) -> Surfels:
        """Return those where `chosen` [N] is true."""
        return Surfels(
            self.points_m[chosen], self.normals[chosen], self.colors[chosen], self.radius_m[chosen],
            self.confidence[chosen], self.views[chosen], self.anchors[chosen],
            self.labels[chosen], self.label_votes[chosen], self.label_total[chosen],
        )  # fmt: skip


class SurfelMap:
    """The surfels of keyframes at their newest poses."""

    def __init__(self, spacing_m: float) -> None:
        self._spacing_m = spacing_m
        self._discs: dict[int, F32] = {}  # [M, 12] of each keyframe, in its body frame
        self._merged = _Discs()
        self._merged_poses: dict[int, Array] = {}  # at which keyframes are in what was merged last

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._discs

    @property
    def nbytes(self) -> int:
        """Memory of the keyframes' discs, in bytes."""
        return sum(discs.nbytes for discs in self._discs.values())

    def add(self, keyframe_id: int, scan: Scan, view: DepthView) -> None:
        """Take in a keyframe's depth; a scan without a depth image has no surfels."""
        discs = _Discs()
        if scan.depth is not None:
            colors = np.ascontiguousarray(scan.colors.reshape(*scan.depth.shape, 3))
            labels = np.zeros_like(scan.depth) if scan.labels is None else scan.labels
            measured = _discs_of(
                scan.depth, view.unit_m, view.rays_body, colors, labels, view.max_range_m, self._spacing_m
            )
            measured[:, :3] += view.T_body_view[:3, 3]
            discs.fuse(measured, keyframe_id, self._spacing_m, is_one_vote=False)
        values = discs.values[: discs.count]
        values[:, _LABEL] = discs.votes.winners()[0][: discs.count]  # its one vote
        self._discs[keyframe_id] = values.astype(np.float32)

    def surfels(self, T_map_body: dict[int, Array]) -> Surfels:
        """Return the surfels [N] of all keyframes at their poses; those without a pose are left out.

        When no keyframe moved since the last call, only new ones are merged.
        """
        poses = {i: np.array(T_map_body[i], dtype=np.float64) for i in self._discs if i in T_map_body}
        done = self._merged_poses
        if list(poses)[: len(done)] != list(done) or any(not np.array_equal(T, poses[i]) for i, T in done.items()):
            self._merged, self._merged_poses = _Discs(), {}
        for keyframe_id, T in list(poses.items())[len(self._merged_poses) :]:
            rows = self._discs[keyframe_id].astype(np.float64)
            rows[:, :3] = rows[:, :3] @ T[:3, :3].T + T[:3, 3]
            rows[:, 3:6] = rows[:, 3:6] @ T[:3, :3].T
            self._merged.fuse(rows, keyframe_id, self._spacing_m, is_one_vote=True)
            self._merged_poses[keyframe_id] = T
        return self._merged.surfels()


class _Cells(NamedTuple):
    """A hash table of cells and the surfels that were made in each."""

    table: I64
    heads: I64  # of a slot: the surfel made last
    following: I64  # of a surfel: the one made before in the same cell, -1: none
    keys: I64  # of a surfel's cell


class _Kept(NamedTuple):
    """Surfels, and where each came from."""

    values: Array  # [N, 12]
    anchors: I64
    last: I64  # keyframe that saw it last
    views: I64  # keyframes that saw it
    votes: Votes


class _Discs:
    """Growing arrays of surfels with a hash table of the cells that they were made in."""

    def __init__(self) -> None:
        self.count = 0
        self.values = np.empty((1 << 12, _COLUMNS))
        self.anchors, self._last, self._views = (np.empty(1 << 12, np.int64) for _ in range(3))
        self.votes = Votes.none(1 << 12)
        self._table = np.full(1 << 14, -1, np.int64)
        self._heads = np.zeros(1 << 14, np.int64)
        self._next = np.empty(1 << 12, np.int64)  # surfel made before in the same cell; -1: none
        self._keys = np.empty(1 << 12, np.int64)

    def fuse(self, values: Array, keyframe_id: int, spacing_m: float, is_one_vote: bool) -> None:
        """Merge measurements [M, 12] of a keyframe in; with `is_one_vote` it has one vote for the label of a surfel."""
        need = self.count + len(values)
        if need > len(self.anchors):
            size = max(need, 2 * len(self.anchors))
            self.values = np.concatenate([self.values, np.empty((size - len(self.values), _COLUMNS))])
            self.anchors, self._last, self._views, self._next, self._keys = (
                np.concatenate([part, np.empty(size - len(part), np.int64)])
                for part in (self.anchors, self._last, self._views, self._next, self._keys)
            )
            self.votes = self.votes.grown(size)
        if 2 * need > len(self._table):
            size = 1 << int(np.ceil(np.log2(4 * need)))
            self._table, self._heads = np.full(size, -1, np.int64), np.zeros(size, np.int64)
            _link(self._table, self._heads, self._next, self._keys, self.count)
        self.count = _fuse(
            values, keyframe_id, spacing_m, _Cells(self._table, self._heads, self._next, self._keys),
            _Kept(self.values, self.anchors, self._last, self._views, self.votes), self.count,
            is_one_vote,
        )  # fmt: skip

    def surfels(self) -> Surfels:
        """Return all of them, in the order in which they were made."""
        values = self.values[: self.count]
        votes = self.votes.select(np.arange(self.count))
        labels, label_votes = votes.winners()
        return Surfels(
            values[:, :3].astype(np.float32),
            values[:, 3:6].astype(np.float32),
            np.clip(np.round(values[:, 6:9]), 0, 255).astype(np.uint8),
            values[:, 9].astype(np.float32),
            values[:, 10].astype(np.float32),
            self._views[: self.count].astype(np.int32),
            self.anchors[: self.count].copy(),
            labels,
            label_votes,
            votes.total,
        )


@njit(cache=True, nogil=True)
def _discs_of(depth: NDArray[np.uint16], unit: float, rays: F32, colors: NDArray[np.uint8],
              labels: NDArray[np.uint16], max_range: float, spacing: float) -> Array:  # fmt: skip
    """Return the discs [M, 12] of a depth image, in the body frame's directions from the camera's centre."""
    rows, columns = depth.shape
    out = np.empty((rows * columns, _COLUMNS))
    count, gap = 0, _STENCIL_PX
    right, down = np.empty(3), np.empty(3)
    for i in range(gap, rows - gap):
        for j in range(gap, columns - gap):
            if depth[i, j] == 0 or depth[i, j - gap] == 0 or depth[i, j + gap] == 0:
                continue
            if depth[i - gap, j] == 0 or depth[i + gap, j] == 0:
                continue
            for k in range(3):
                right[k] = (rays[i, j + gap, k] * depth[i, j + gap] - rays[i, j - gap, k] * depth[i, j - gap]) * unit
                down[k] = (rays[i + gap, j, k] * depth[i + gap, j] - rays[i - gap, j, k] * depth[i - gap, j]) * unit
            n0, n1 = right[1] * down[2] - right[2] * down[1], right[2] * down[0] - right[0] * down[2]
            n2 = right[0] * down[1] - right[1] * down[0]
            z = depth[i, j] * unit
            p0, p1, p2 = rays[i, j, 0] * z, rays[i, j, 1] * z, rays[i, j, 2] * z
            area, distance = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2), np.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
            if not (0.0 < distance <= max_range and area > 0.0):  # NaN, where the camera model ends, is neither
                continue
            facing = (n0 * p0 + n1 * p1 + n2 * p2) / (area * distance)
            if abs(facing) < _MIN_FACING:
                continue
            flip = -1.0 if facing > 0.0 else 1.0
            row = out[count]
            row[0], row[1], row[2] = p0, p1, p2
            row[3], row[4], row[5] = flip * n0 / area, flip * n1 / area, flip * n2 / area
            row[6], row[7], row[8] = colors[i, j, 0], colors[i, j, 1], colors[i, j, 2]
            row[9] = max(np.sqrt(area) / (2.0 * gap), spacing) * np.sqrt(0.5)  # half the diagonal of what it stands for
            row[10] = abs(facing) / distance**4
            row[11] = labels[i, j]
            count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def _link(table: I64, heads: I64, following: I64, keys: I64, count: int) -> None:
    for i in range(count):
        slot = find_slot(table, keys[i])
        following[i] = heads[slot] if table[slot] >= 0 else -1
        table[slot], heads[slot] = keys[i], i


@njit(cache=True, nogil=True)
def _nearest(row: Array, spacing: float, table: I64, heads: I64, following: I64, out: Array) -> int:
    """Return the surfel that a measurement belongs to, -1 for none."""
    best, best_distance = -1, spacing * spacing
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                key = voxel_key(row[0] + dx * spacing, row[1] + dy * spacing, row[2] + dz * spacing, spacing)
                slot = find_slot(table, key)
                other = heads[slot] if key >= 0 and table[slot] >= 0 else -1
                while other >= 0:
                    there = out[other]
                    d0, d1, d2 = row[0] - there[0], row[1] - there[1], row[2] - there[2]
                    across = d0 * there[3] + d1 * there[4] + d2 * there[5]
                    along = d0 * d0 + d1 * d1 + d2 * d2 - across * across
                    facing = row[3] * there[3] + row[4] * there[4] + row[5] * there[5]
                    if along < best_distance and abs(across) < _THICKNESS * spacing and facing > _SAME_FACING:
                        best, best_distance = other, along
                    other = following[other]
    return best


@njit(cache=True, nogil=True)
def _fuse(values: Array, keyframe_id: int, spacing: float, cells: _Cells, kept: _Kept, count: int,
          is_one_vote: bool) -> int:  # fmt: skip
    table, heads, following, keys = cells
    out, out_anchors, out_last, out_views, votes = kept
    for i in range(len(values)):
        row = values[i]
        key = voxel_key(row[0], row[1], row[2], spacing)
        if key < 0:
            continue
        k = _nearest(row, spacing, table, heads, following, out)
        if k < 0:
            slot = find_slot(table, key)
            following[count] = heads[slot] if table[slot] >= 0 else -1
            table[slot], heads[slot], keys[count] = key, count, key
            out[count] = row
            out_anchors[count], out_last[count], out_views[count] = keyframe_id, keyframe_id, 1
            if row[11] > 0.0:
                vote(votes, count, int(row[11]))
            count += 1
            continue
        if row[11] > 0.0 and not (is_one_vote and out_last[k] == keyframe_id):
            vote(votes, k, int(row[11]))
        there = out[k]
        share = row[10] / (row[10] + there[10])
        for c in range(9):
            there[c] += share * (row[c] - there[c])
        there[3:6] /= np.sqrt(there[3] ** 2 + there[4] ** 2 + there[5] ** 2)
        there[9] = min(there[9], row[9])
        there[10] += row[10]
        if out_last[k] != keyframe_id:
            out_last[k] = keyframe_id
            out_views[k] += 1
    return count
