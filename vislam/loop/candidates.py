"""Which old keyframes are worth verifying: those that look alike, and those that should see the same by the map."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import UsageError
from vislam.core.jit import njit
from vislam.core.kinds import Kinds
from vislam.core.messages import Array
from vislam.loop.verification import Likeness
from vislam.loop.view import View

_MAX_VIEW_ANGLE_RAD = np.deg2rad(45.0)  # between the rays to one point; ORB matches little beyond
_MAX_DISTANCE_RATIO = 2.5  # of a point from both cameras; ORB's octaves span 3.6
_NEAR_Z_M = 0.1


class Propose(Protocol):
    """What a proposer that a package brings does: `CLASS(config, rig)` makes one for each run."""

    def __call__(self, view: View, known: Mapping[int, View], /) -> Sequence[int]:
        """Return ids of known keyframes that may show the place of the newest one, best first; deterministic."""
        ...


PROPOSERS = Kinds[Callable[[LoopConfig, Rig], Propose]]("vislam.loop_proposers", {})


def proposer(name: str) -> Callable[[LoopConfig, Rig], Propose]:
    """Return what makes a proposer; raises UsageError for one that no package brings."""
    if name not in PROPOSERS:
        raise UsageError(
            f"no loop proposer '{name}' is installed; loop.proposers takes {', '.join(PROPOSERS) or 'none'}"
        )
    return PROPOSERS[name]


@dataclass(frozen=True, slots=True)
class Candidate:
    """An old keyframe that may show the same place."""

    id: int
    source: str  # "appearance", "odometry", "tag", "depth" or a proposer of `loop.proposers`
    score: float  # similarity of an island of keyframes, or share of what should be visible in both
    consistency: int = 0  # how many keyframes before this one pointed at the same place in a row


@dataclass(frozen=True, slots=True)
class Island:
    """Retrieved keyframes that follow each other in time: one place."""

    best_id: int
    first_id: int
    last_id: int
    score: float  # sum over its members
    consistency: int = 0


def islands(ids: Sequence[int], scores: Sequence[float], max_gap: int) -> list[Island]:
    """Group retrieved keyframes whose ids differ by at most `max_gap`, best first (Galvez-Lopez 2012)."""
    found: list[Island] = []
    for identifier, score in sorted(zip(ids, scores, strict=True)):
        last = found[-1] if found else None
        if last is None or identifier - last.last_id > max_gap:
            found.append(Island(identifier, identifier, identifier, score))
            continue
        best = identifier if score > scores[ids.index(last.best_id)] else last.best_id
        found[-1] = Island(best, last.first_id, identifier, last.score + score)
    return sorted(found, key=lambda island: (-island.score, island.best_id))


class AppearanceCandidates:
    """Turns retrieved keyframes into candidates; remembers the last islands, to see which places persist."""

    def __init__(self, max_gap: int) -> None:
        self._max_gap = max_gap
        self._last: list[Island] = []

    def select(self, ids: Sequence[int], scores: Sequence[float], likeness: Mapping[int, Likeness]) -> list[Candidate]:
        """Return the retrieved keyframes that are alike: the surest of each island, then the second of each, ..."""
        self._last = [self._with_history(island) for island in islands(ids, scores, self._max_gap)]
        turns: dict[int, int] = {}  # how many of an island, by its first keyframe, came already
        order: list[tuple[int, int]] = []
        for i in sorted((i for i in ids if likeness[i].is_alike), key=lambda i: likeness[i].rank, reverse=True):
            place = self.island_of(i).first_id
            order.append((turns.get(place, 0), i))
            turns[place] = turns.get(place, 0) + 1
        return [self._candidate(i) for _, i in sorted(order, key=lambda entry: entry[0])]

    def _candidate(self, keyframe_id: int) -> Candidate:
        place = self.island_of(keyframe_id)
        return Candidate(keyframe_id, "appearance", place.score, place.consistency)

    def island_of(self, keyframe_id: int) -> Island:
        """Return the island of the last selection that holds a retrieved keyframe."""
        return next(island for island in self._last if island.first_id <= keyframe_id <= island.last_id)

    def _with_history(self, island: Island) -> Island:
        reach = self._max_gap
        before = [
            old.consistency + 1
            for old in self._last
            if old.first_id - reach <= island.last_id and island.first_id <= old.last_id + reach
        ]
        return Island(island.best_id, island.first_id, island.last_id, island.score, max(before, default=0))


def view_bounds(camera: Camera) -> Array:
    """Return [min x, min y, max x, max y] of a camera's image on the plane z = 1, measured along its middle lines."""
    cx, cy = min(max(camera.cx, 0.0), camera.width - 1.0), min(max(camera.cy, 0.0), camera.height - 1.0)
    middles = np.array([[0.0, cy], [cx, 0.0], [camera.width - 1.0, cy], [cx, camera.height - 1.0]])
    xy = camera.normalise(middles)
    limit = np.array([-1.0, -1.0, 1.0, 1.0])  # a lens so wide that its border has no ray
    bounds = np.array([xy[0, 0], xy[1, 1], xy[2, 0], xy[3, 1]])
    return np.where(np.isfinite(bounds), bounds, limit)


@njit(cache=True, nogil=True)
def overlaps(points_map: Array, centre: Array, T_cam_maps: Array, bounds: Array) -> Array:
    """Return for each old camera which share of the points [P, 3] it sees, weighted by how alike they look there."""
    out = np.zeros(len(T_cam_maps))
    cos_limit = np.cos(_MAX_VIEW_ANGLE_RAD)
    for k in range(len(T_cam_maps)):
        T = T_cam_maps[k]
        own = np.zeros(3)  # where the new camera is, seen from the old one
        for r in range(3):
            own[r] = T[r, 0] * centre[0] + T[r, 1] * centre[1] + T[r, 2] * centre[2] + T[r, 3]
        for i in range(len(points_map)):
            z = T[2, 0] * points_map[i, 0] + T[2, 1] * points_map[i, 1] + T[2, 2] * points_map[i, 2] + T[2, 3]
            if not z > _NEAR_Z_M:
                continue
            x = T[0, 0] * points_map[i, 0] + T[0, 1] * points_map[i, 1] + T[0, 2] * points_map[i, 2] + T[0, 3]
            y = T[1, 0] * points_map[i, 0] + T[1, 1] * points_map[i, 1] + T[1, 2] * points_map[i, 2] + T[1, 3]
            if not (bounds[0] < x / z < bounds[2] and bounds[1] < y / z < bounds[3]):
                continue
            old = np.sqrt(x * x + y * y + z * z)
            dx, dy, dz = x - own[0], y - own[1], z - own[2]
            new = np.sqrt(dx * dx + dy * dy + dz * dz)
            if old > _MAX_DISTANCE_RATIO * new or new > _MAX_DISTANCE_RATIO * old:
                continue
            cosine = (x * dx + y * dy + z * dz) / (old * new + 1e-12)
            out[k] += max(0.0, (cosine - cos_limit) / (1.0 - cos_limit))
    return out / max(1, len(points_map))


def odometry_candidates(
    points_map_m: Array, centre_map_m: Array, ids: NDArray[np.int64], T_cam_maps: Array, bounds: Array,
    count: int, min_overlap: float, min_apart: int,
) -> list[Candidate]:  # fmt: skip
    """Return the old keyframes that should see most of the same by the current map, best first.

    Args:
        points_map_m: some points [P, 3] that the new camera sees, in the map.
        centre_map_m: the new camera's position [3] in the map.
        ids: old keyframes [N], ascending.
        T_cam_maps: map to old cameras [N, 4, 4].
        bounds: of an image on z = 1, from `view_bounds`.
        count: at most this many.
        min_overlap: least weighted share of the points that must be visible, 0..1.
        min_apart: ids of two candidates differ by at least this, so that they tie different stretches.
    """
    overlap = overlaps(np.ascontiguousarray(points_map_m), centre_map_m, np.ascontiguousarray(T_cam_maps), bounds)
    chosen: list[Candidate] = []
    for k in np.argsort(-overlap, kind="stable").tolist():
        if overlap[k] < min_overlap or len(chosen) == count:
            break
        if all(abs(int(ids[k]) - other.id) >= min_apart for other in chosen):
            chosen.append(Candidate(int(ids[k]), "odometry", float(overlap[k])))
    return chosen
