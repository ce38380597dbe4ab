"""The trajectory value: poses of a body in a world frame over strictly increasing time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError
from vislam.core.geometry import are_rigid, sim3_parts
from vislam.core.messages import Array

_ORTHONORMAL_TOLERANCE = 1e-6  # far above the rounding of chained float64 products, far below any wrong matrix


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses `T_world_body` at strictly increasing times; an empty one is allowed (a run that never initialised).

    Raises DataError on wrong shapes, non-finite numbers, matrices that are not rigid, and times that do not increase.
    """

    t_ns: NDArray[np.int64]  # [N]
    T_world_body: Array  # [N, 4, 4]
    has_rotation: bool = True  # else only positions are known, and rotations are the identity

    def __post_init__(self) -> None:
        stamps, poses = np.array(self.t_ns), np.array(self.T_world_body, dtype=np.float64)
        if stamps.size and not np.issubdtype(stamps.dtype, np.integer):
            raise DataError(f"trajectory times must be integer nanoseconds, got {stamps.dtype}")
        if stamps.ndim != 1 or poses.shape != (len(stamps), 4, 4):
            raise DataError(f"trajectory needs times [N] and poses [N, 4, 4], got {stamps.shape} and {poses.shape}")
        backward = np.flatnonzero(np.diff(stamps) <= 0)
        if len(backward):
            i = int(backward[0]) + 1
            raise DataError(f"trajectory times must increase: pose {i} at {stamps[i]} ns follows {stamps[i - 1]} ns")
        bad = np.flatnonzero(~are_rigid(poses, _ORTHONORMAL_TOLERANCE))
        if len(bad):
            raise DataError(f"pose {bad[0]} at {stamps[bad[0]]} ns is not a finite rigid transform")
        object.__setattr__(self, "t_ns", stamps.astype(np.int64))
        object.__setattr__(self, "T_world_body", poses)

    def __len__(self) -> int:
        return len(self.t_ns)

    def __repr__(self) -> str:
        return f"Trajectory({len(self)} poses, {self.duration_s:.1f} s, {self.path_m:.1f} m)"

    @property
    def positions_m(self) -> Array:
        """Positions [N, 3] of the body in the world frame."""
        return self.T_world_body[:, :3, 3]

    @property
    def duration_s(self) -> float:
        """Time from the first to the last pose in seconds."""
        return float(self.t_ns[-1] - self.t_ns[0]) * 1e-9 if len(self) else 0.0

    @property
    def path_m(self) -> float:
        """Length of the travelled path in metres."""
        return float(np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1).sum())

    def at(self, t_ns: int | NDArray[np.int64]) -> Array:
        """Return the pose [4, 4] at a time, or poses [M, 4, 4] at times [M], interpolated between neighbours.

        Geodesic in rotation, straight in position. Raises DataError for a time outside the trajectory: poses are never
        extrapolated.
        """
        wanted = np.atleast_1d(np.asarray(t_ns, dtype=np.int64))
        if not len(self):
            raise DataError("an empty trajectory has no pose to interpolate")
        outside = np.flatnonzero((wanted < self.t_ns[0]) | (wanted > self.t_ns[-1]))
        if len(outside):
            raise DataError(
                f"no pose at {wanted[outside[0]]} ns: the trajectory covers {self.t_ns[0]} to {self.t_ns[-1]} ns"
            )
        after = np.clip(np.searchsorted(self.t_ns, wanted, side="left"), 1, max(len(self) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self) - 1)
        span = np.maximum(self.t_ns[after] - self.t_ns[before], 1)
        poses = _interpolate_many(
            self.T_world_body[before], self.T_world_body[after], (wanted - self.t_ns[before]) / span
        )
        return poses[0] if np.ndim(t_ns) == 0 else poses

    def transformed(self, S_new_world: Array) -> Trajectory:
        """Return the trajectory expressed in another world; the similarity [4, 4] may scale positions."""
        scale, R, t = sim3_parts(S_new_world)
        poses = self.T_world_body.copy()
        poses[:, :3, :3] = R @ self.T_world_body[:, :3, :3]
        poses[:, :3, 3] = scale * self.positions_m @ R.T + t
        return Trajectory(self.t_ns, poses, self.has_rotation)


def _interpolate_many(T_a: Array, T_b: Array, alpha: Array) -> Array:
    out = T_a.copy()
    relative = Rotation.from_matrix(T_a[:, :3, :3].transpose(0, 2, 1) @ T_b[:, :3, :3])
    out[:, :3, :3] = T_a[:, :3, :3] @ Rotation.from_rotvec(alpha[:, None] * relative.as_rotvec()).as_matrix()
    out[:, :3, 3] = (1.0 - alpha)[:, None] * T_a[:, :3, 3] + alpha[:, None] * T_b[:, :3, 3]
    return out
