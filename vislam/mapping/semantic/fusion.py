"""The labels of keyframes fused at their newest poses.

What each keyframe said is kept on its own rays, as its depth is. So a correction carries labels along: when a keyframe
that was counted has moved, votes are counted again, and the result is that of the same poses from scratch.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from vislam.config import LabelConfig
from vislam.core.messages import Array
from vislam.mapping.cloud.store import KeyframeStore
from vislam.mapping.depth.image import DepthView, surface_points
from vislam.mapping.octree import Occupancy, Octree
from vislam.mapping.semantic.classes import LabelClasses
from vislam.mapping.semantic.layer import LabelLayer
from vislam.mapping.semantic.votes import VoxelVotes, voxel_centres

_MAX_VOXELS = 1_000_000  # that have labels, 40 MB; what is seen after that has none
_MOST_WAITING = 16  # keyframes whose depth comes late


class LabelFusion:
    """Votes of keyframes for the labels of voxels."""

    def __init__(self, resolution_m: float, config: LabelConfig, classes: LabelClasses) -> None:
        self.classes = classes
        self._resolution_m = resolution_m
        self._config = config
        self._waiting: dict[int, NDArray[np.uint16]] = {}  # labels of keyframes whose depth is not known yet
        self._poses: dict[int, Array] = {}  # at which keyframes were counted
        self._votes = VoxelVotes(resolution_m, _MAX_VOXELS)

    @property
    def notes(self) -> dict[str, str]:
        """What was left out, and why."""
        refused = self._votes.refused
        why = "there was no room for more voxels; raise labels.max_voxels"
        return {f"labels of {refused} votes": why} if refused else {}

    def wait(self, keyframe_id: int, labels: NDArray[np.uint16]) -> None:
        """Keep the labels [h, w] of a keyframe until its depth comes; those that waited longest are given up."""
        self._waiting[keyframe_id] = labels
        while len(self._waiting) > _MOST_WAITING:
            del self._waiting[next(iter(self._waiting))]

    def waited_for(self, keyframe_id: int) -> NDArray[np.uint16] | None:
        """Return labels that were kept until now."""
        return self._waiting.pop(keyframe_id, None)

    def layer(
        self, T_map_body: Mapping[int, Array], store: KeyframeStore, view: DepthView, occupancy: Octree
    ) -> LabelLayer:
        """Return the labels of the occupied voxels, as keyframes at their poses [4, 4] saw them, in this order."""
        done = self._poses
        is_prefix = list(T_map_body)[: len(done)] == list(done)
        if not is_prefix or any(not np.array_equal(T, T_map_body[i]) for i, T in done.items()):
            self._poses, self._votes = {}, VoxelVotes(self._resolution_m, _MAX_VOXELS)
        for keyframe_id in list(T_map_body)[len(self._poses) :]:
            T = T_map_body[keyframe_id]
            self._count(keyframe_id, T, store, view)
            self._poses[keyframe_id] = T.copy()
        keys, votes = self._votes.voxels()
        there = occupancy.state_at(voxel_centres(keys, self._resolution_m)) == Occupancy.OCCUPIED
        keys, votes = keys[there], votes.select(there)
        labels, counts = votes.winners()
        chosen = counts > 0  # all four counters may have been used up
        return LabelLayer(
            self._resolution_m, self.classes, keys[chosen], labels[chosen], counts[chosen], votes.total[chosen],
            self._config.thing_voxels,
        )  # fmt: skip

    def _count(self, keyframe_id: int, T_map_body: Array, store: KeyframeStore, view: DepthView) -> None:
        labels = store.labels(keyframe_id)
        if labels is None:
            return
        scan = store.geometry(keyframe_id)
        if scan.depth is not None:
            points, pixels = surface_points(scan.depth, view, T_map_body)
            self._votes.add(points, labels.reshape(-1)[pixels])
        elif scan.points_body_m is not None:
            points_body = scan.points_body_m.astype(np.float64)
            self._votes.add((points_body @ T_map_body[:3, :3].T + T_map_body[:3, 3]).astype(np.float32), labels)
