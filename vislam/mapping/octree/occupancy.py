"""Occupancy map with OctoMap's semantics: log-odds, clamping, ray-cast free space, unknown apart from free."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError, UsageError
from vislam.core.files import replacing
from vislam.core.messages import Array
from vislam.mapping.octree.blocks import KEY_ORIGIN, BlockPool, keys_at
from vislam.mapping.octree.levels import fill_from_octree, largest_log_odds
from vislam.mapping.octree.octomap_io import encode_bt, encode_ot, read_octree
from vislam.mapping.octree.scan import (
    LogOdds,
    Rays,
    Voxels,
    apply_marks,
    cast_rays,
    end_voxels,
    finite_points,
    marked_blocks,
    pack_marks,
)
from vislam.mapping.octree.tree import TREE_LEVELS, OctreeLeaves, log_odds, octree_from_blocks

Insertion = Literal["discretised", "full"]

_MAX_SCAN_CELLS = 1 << 29  # 512 MiB for the box around one scan
_MARGIN_VOXELS = 3  # a ray's last step may round one cell past its end


class Occupancy(IntEnum):
    """What is known of a place."""

    UNKNOWN = -1
    FREE = 0
    OCCUPIED = 1


@dataclass(frozen=True, slots=True, eq=False)
class ScanMarks:
    """What one scan shows of voxels, wherever the map stands: which are free and which are hit."""

    points: int  # that were used
    blocks: NDArray[np.int64]  # [B] keys of blocks
    bits: NDArray[np.uint8]  # [B, 2, 64] see `pack_marks`


NO_MARKS = ScanMarks(0, np.zeros(0, np.int64), np.zeros((0, 2, 64), np.uint8))


class Octree:
    """Voxels of equal size with a clamped log-odds of being occupied; a voxel is occupied from probability 0.5 on.

    Each scan changes a voxel once: by `hit_probability` if a point lies in it, else by `miss_probability` if a ray
    passes it. For the same points, the octree it exports is OctoMap's byte for byte.

    Rays that graze a surface pass voxels which it goes through, and a few scans of that clear them. With a
    `miss_beside_probability` above `miss_probability` (None: the same, as OctoMap's), a miss counts so much less where
    the voxel is occupied and touches one that the same scan hit.

    A ray that is cut off at the maximum range leaves the voxel that it is cut off in as it was, as OctoMap's does: what
    was hit there stays for ever. With `clears_at_range` it is cleared, unless the ray's point lies in it.
    """

    def __init__(
        self,
        resolution_m: float,
        hit_probability: float = 0.7,
        miss_probability: float = 0.4,
        clamp_min_probability: float = 0.1192,
        clamp_max_probability: float = 0.971,
        miss_beside_probability: float | None = None,
        clears_at_range: bool = False,
    ) -> None:
        beside = miss_probability if miss_beside_probability is None else miss_beside_probability
        probabilities = (hit_probability, miss_probability, clamp_min_probability, clamp_max_probability, beside)
        if not (math.isfinite(resolution_m) and resolution_m > 0.0):
            raise DataError(f"the map's resolution must be a positive number of metres, got {resolution_m}")
        if not all(0.0 < p < 1.0 for p in probabilities) or clamp_min_probability >= clamp_max_probability:
            raise DataError(f"map probabilities must lie between 0 and 1 with min below max, got {probabilities}")
        self.resolution_m = float(resolution_m)
        self._hit, self._miss, self._low, self._high, self._beside = (log_odds(p) for p in probabilities)
        self.clears_at_range = clears_at_range
        self.pool = BlockPool()  # of log-odds
        self._words = np.zeros(1 << 12, np.uint64)  # the scan's grid, kept between scans, all zero

    def __repr__(self) -> str:
        known = self.pool.values[: self.pool.count]
        occupied, free = int(np.count_nonzero(known >= 0.0)), int(np.count_nonzero(known < 0.0))
        return f"Octree(voxels of {self.resolution_m:g} m: {occupied} occupied, {free} free)"

    @property
    def nbytes(self) -> int:
        """Memory of the voxels, in bytes."""
        return self.pool.nbytes

    def insert(
        self,
        points_map_m: NDArray[np.floating],
        origin_map_m: Array,
        max_range_m: float = -1.0,
        insertion: Insertion = "discretised",
    ) -> int:
        """Integrate one scan, as `trace` and `apply` do; return how many points were used."""
        marks = self.trace(points_map_m, origin_map_m, max_range_m, insertion)
        self.apply(marks)
        return marks.points

    def trace(
        self,
        points_map_m: NDArray[np.floating],
        origin_map_m: Array,
        max_range_m: float = -1.0,
        insertion: Insertion = "discretised",
    ) -> ScanMarks:
        """Return what one scan of points [N, 3] seen from `origin_map_m` [3] shows of voxels; the map stays as it is.

        Points beyond `max_range_m` (negative: no limit) only clear the way up to it; points that are not finite are
        left out. "discretised" casts one ray per end voxel, "full" one per point. Raises DataError when a point lies
        beyond the key range (32768 voxels from the origin) or the scan's bounding box is too large.
        """
        points, low, high = finite_points(np.ascontiguousarray(points_map_m, dtype=np.float32).reshape(-1, 3))
        origin = np.asarray(origin_map_m, dtype=np.float32).reshape(3)
        if not np.isfinite(origin).all():
            raise DataError(f"a scan's origin must be finite, got {origin.tolist()}")
        if len(points) == 0:
            return NO_MARKS
        # discretised insertion looks at the end voxels of all points, however far, before it shortens the rays
        reach_m = max_range_m if insertion == "full" and max_range_m >= 0.0 else np.inf
        low, high = np.maximum(low, origin - reach_m), np.minimum(high, origin + reach_m)
        base, blocks = self._scan_box(np.minimum(low, origin), np.maximum(high, origin))
        nx, nxy = int(blocks[0]) * 8, int(blocks[0] * blocks[1]) * 64
        size = int(blocks.prod()) * 64
        if size > len(self._words):
            self._words = np.zeros(size, np.uint64)
        words = self._words[:size]
        grid = words.view(np.uint8)
        ends = points
        if insertion == "discretised":
            ends = end_voxels(points, self.resolution_m, base, nx, nxy, grid)
        beside = bool(self._beside != self._miss)
        rays = Rays(max_range_m, self.resolution_m, self.clears_at_range, beside)
        cast_rays(ends, origin, rays, base, (nx, nxy), grid)
        keys, bits = pack_marks(marked_blocks(words, blocks), words, blocks, base)
        return ScanMarks(len(points), keys, bits)

    def apply(self, marks: ScanMarks, only_known: bool = False) -> None:
        """Update every voxel that a scan marks, or those in blocks that the map has.

        Raises DataError when the map would outgrow any machine.
        """
        pool = self.pool
        if not only_known:
            pool.reserve(len(marks.blocks))
        pool.count = apply_marks(
            marks.blocks, marks.bits, only_known, Voxels(pool.table, pool.rows, pool.keys, pool.values), pool.count,
            LogOdds(self._hit, self._miss, self._beside, self._low, self._high),
        )  # fmt: skip

    def with_pool(self, pool: BlockPool) -> Octree:
        """Return a map of the same sensor model with other voxels."""
        out = copy.copy(self)
        out.pool = pool
        out._words = np.zeros(1 << 12, np.uint64)
        return out

    def _scan_box(self, low: Array, high: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the lowest voxel key [3], a multiple of 8, and the size in blocks [3] of the box around a scan."""
        reach = (KEY_ORIGIN - 8) * self.resolution_m
        if low.min() < -reach or high.max() > reach:
            worst = max(-low.min(), high.max())
            raise DataError(
                f"a point {worst:.1f} m from the map's origin is beyond the {reach:.1f} m that 16-bit keys reach at "
                f"{self.resolution_m} m; use a coarser resolution or limit the range"
            )
        base = np.floor(low / self.resolution_m).astype(np.int64) + KEY_ORIGIN - _MARGIN_VOXELS
        base -= base % 8
        top = np.floor(high / self.resolution_m).astype(np.int64) + KEY_ORIGIN + _MARGIN_VOXELS
        blocks = (top - base) // 8 + 1
        if float(blocks.prod()) * 512 > _MAX_SCAN_CELLS:
            raise DataError(
                f"a scan spans {(high - low).round(1).tolist()} m, too many cells of {self.resolution_m} m for one "
                "scan; use a coarser resolution or limit the range"
            )
        return base, blocks

    @classmethod
    def from_leaves(cls, octree: OctreeLeaves) -> Octree:
        """Return the map that an octree describes, to ask or to go on with, with OctoMap's sensor model.

        Raises DataError when its leaves are more voxels than fit in memory.
        """
        grid = cls(octree.resolution_m)
        fill_from_octree(grid.pool, octree)
        return grid

    @classmethod
    def load(cls, path: Path | str) -> Octree:
        """Read OctoMap's file, `.bt` or `.ot`; raises DataError when it is damaged or no such file."""
        return cls.from_leaves(read_octree(Path(path)))

    def save(self, path: Path | str) -> None:
        """Write OctoMap's file: free and occupied for a name in `.bt`, log-odds for one in `.ot`.

        Raises UsageError for another name.
        """
        ending = Path(path).suffix
        if ending not in (".bt", ".ot"):
            raise UsageError(f"{path}: an octree is written as .bt or .ot, got '{ending}'; change the name")
        content = encode_ot(self.leaves()) if ending == ".ot" else encode_bt(self.max_likelihood_leaves())
        with replacing(Path(path)) as file:
            file.write(content)

    def copy(self) -> Octree:
        """Return a map of the same voxels that goes its own way from here on."""
        return self.with_pool(self.pool.copy())

    def log_odds_at(self, points_map_m: NDArray[np.floating], level: int = 0) -> NDArray[np.float32]:
        """Return the log-odds [N] at points [N, 3]; NaN where unknown, outside the key range or not finite.

        At level n it is that of OctoMap's cube of 2**n voxels around the point: the largest in it.
        """
        if not 0 <= level <= TREE_LEVELS:
            raise DataError(f"an octree has the levels 0 (voxels) to {TREE_LEVELS} (all), asked for {level}")
        return largest_log_odds(self.pool, keys_at(points_map_m, self.resolution_m)[0], level)

    def state_at(self, points_map_m: NDArray[np.floating], level: int = 0) -> NDArray[np.int8]:
        """Return the `Occupancy` [N] at points [N, 3], of voxels or of the cubes of a level: see `log_odds_at`."""
        return states(self.log_odds_at(points_map_m, level))

    def leaves(self) -> OctreeLeaves:
        """Return the map as a pruned octree: a copy that later scans do not change."""
        pool = self.pool
        return octree_from_blocks(self.resolution_m, pool.block_coordinates(), pool.values[: pool.count])

    def max_likelihood_leaves(self) -> OctreeLeaves:
        """Return the octree whose leaves are at the clamping thresholds, occupied or free: what a .bt file holds."""
        pool = self.pool
        values = pool.values[: pool.count]
        sure = np.where(values >= 0.0, self._high, np.where(values < 0.0, self._low, np.float32(np.nan)))
        return octree_from_blocks(self.resolution_m, pool.block_coordinates(), sure.astype(np.float32))


def states(values: NDArray[np.float32]) -> NDArray[np.int8]:
    """Return the `Occupancy` [N] of log-odds [N]."""
    out = np.full(len(values), Occupancy.UNKNOWN, np.int8)
    out[values < 0.0] = Occupancy.FREE
    out[values >= 0.0] = Occupancy.OCCUPIED
    return out
