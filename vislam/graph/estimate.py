"""The estimate of a graph: the poses of all keyframes as numbers, each as it was last read back from a solver."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from vislam.config import GraphConfig
from vislam.core.messages import Array
from vislam.factors.keys import X, poses_of
from vislam.graph.segments import Stand

Ids = NDArray[np.int64]


class Estimate:
    """Owns the values of all variables and the poses among them as an array; what diverged never gets in."""

    def __init__(self, config: GraphConfig) -> None:
        """Start empty."""
        self._newest = config.read_newest
        self._block = config.read_block
        self.values = gtsam.Values()
        self.count = 0
        self._buffer: Array = np.zeros((64, 4, 4))  # poses, with room to grow
        self._reach_m: Array = np.zeros(64)
        self._next_old = 0  # where the next block of older poses begins
        self._read: list[Ids] = []  # ids since `take_read`

    @property
    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4] of all keyframes: a view that the next call may change."""
        return self._buffer[: self.count]

    @property
    def ids(self) -> Ids:
        """Return the ids [M] of all keyframes."""
        return np.arange(self.count)

    @property
    def is_long(self) -> bool:
        """Return whether there are too many keyframes to look at all of them with each."""
        return self.count > self._newest + self._block

    def begin(self, poses: Sequence[Array], reach_m: Sequence[float]) -> None:
        """Start with poses [4, 4]; each can be so far from the one before."""
        self.count = len(poses)
        self._buffer = np.array(poses)
        self._reach_m = np.array(reach_m)

    def extend(self, reach_m: float) -> int:
        """Make room for the next keyframe, which can be so far from the one before; return its id."""
        k = self.count
        if k == len(self._buffer):
            self._buffer = np.concatenate([self._buffer, np.zeros_like(self._buffer)])
            self._reach_m = np.concatenate([self._reach_m, np.zeros_like(self._reach_m)])
        self._reach_m[k] = reach_m
        self.count += 1
        return k

    def is_bounded(self, first: int, end: int) -> bool:
        """Return whether keyframes `first` to `end`, that excluded, are each tied to the one before."""
        return bool(np.all(np.isfinite(self._reach_m[first:end])))

    def next_block(self) -> Ids:
        """Return the newest ids and, in turn, a block of the older ones."""
        newest = np.arange(self.count - self._newest, self.count)
        begin = self._next_old if self._next_old < newest[0] else 0
        end = min(begin + self._block, int(newest[0]))
        self._next_old = end
        return np.concatenate([np.arange(begin, end), newest])

    def take_read(self) -> Ids:
        """Return the ids of the poses that were read back since the last call, ascending."""
        ids = np.unique(np.concatenate(self._read)) if self._read else np.zeros(0, np.int64)
        self._read = []
        return ids

    def adopt(self, values: gtsam.Values, ids: Ids, stands: Mapping[int, Stand]) -> None:
        """Adopt an estimate of keyframes, or of the hosts beside which they stand.

        RuntimeError when it is not complete, not finite or diverged.
        """
        beside = [n for n, k in enumerate(ids.tolist()) if k in stands]
        hosts = ids.copy()
        hosts[beside] = [stands[k].host for k in ids[beside].tolist()]
        solved, found = np.unique(hosts), poses_of(values)
        if len(found) != len(solved) or not np.all(np.isfinite(found)):
            raise RuntimeError("the solver's estimate is not finite or not complete")
        poses = found[np.searchsorted(solved, hosts)]
        if beside:
            poses[beside] = poses[beside] @ np.stack([stands[k].T_host_self for k in ids[beside].tolist()])
        steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        beyond = (steps_m > self._reach_m[ids[1:]]) & (np.diff(ids) == 1)
        if np.any(beyond):
            raise RuntimeError(f"the solver diverged: a step of {float(steps_m[beyond].max()):.3g} m")
        if len(ids) == self.count:
            self.values = values
        else:
            self.values.insert_or_assign(values)
        self._buffer[ids] = poses
        self._read.append(ids)

    def fall_back(self, values: gtsam.Values) -> None:
        """Take values as they are, where no solver has any that are better."""
        self.values = values
        self._buffer[: self.count] = poses_of(values)
        self._read.append(self.ids)

    def completed(self, values: gtsam.Values, ids: Iterable[int]) -> gtsam.Values:
        """Return a copy of values with the poses of keyframes that they lack."""
        out = gtsam.Values(values)
        for k in ids:
            if not out.exists(X(k)):
                out.insert(X(k), gtsam.Pose3(self._buffer[k]))
        return out
