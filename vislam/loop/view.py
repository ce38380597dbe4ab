"""What loop closing keeps of a keyframe: its features in normalised coordinates, never its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array, Keyframe
from vislam.vision.hamming import packed


@dataclass(frozen=True, eq=False)
class View:
    """The described features of a keyframe as cam0 saw them; about 60 bytes each."""

    id: int
    t_ns: int
    descriptors: NDArray[np.uint8]  # [N, 32]
    xy: NDArray[np.float32]  # [N, 2] undistorted, on the plane z = 1; float32 is 1e-4 px
    points_cam_m: NDArray[np.float32] | None  # [N, 3] in cam0, NaN where unknown; None: no depth at all

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Which features [N] have a point."""
        if self.points_cam_m is None:
            return np.zeros(len(self.xy), dtype=np.bool_)
        return np.isfinite(self.points_cam_m[:, 2])

    @cached_property
    def has_points(self) -> bool:
        """Whether any feature has a point."""
        return bool(np.any(self.known))

    @cached_property
    def by_x(self) -> tuple[NDArray[np.int64], Array]:
        """The features [N] from left to right, and their x, for searches."""
        order = np.argsort(self.xy[:, 0], kind="stable")
        return order, self.xy[order, 0].astype(np.float64)

    def points_or_nan(self) -> Array:
        """Return the points [N, 3] in cam0 as float64, NaN where unknown."""
        if self.points_cam_m is None:
            return np.full((len(self.xy), 3), np.nan)
        return self.points_cam_m.astype(np.float64)


def make_view(keyframe: Keyframe, rig: Rig) -> View:
    """Copy what loop closing needs of a keyframe; features that no ray explains are left out.

    Points behind the camera or not finite become unknown. Raises DataError when arrays disagree in length.
    """
    return make_views([keyframe], rig)[0]


def make_views(keyframes: Sequence[Keyframe], rig: Rig) -> list[View]:
    """Make the views of keyframes, at least one, as `make_view` does: at once, so that other threads go on beside."""
    counts = [_checked_count(keyframe) for keyframe in keyframes]
    xy = rig.cameras[0].normalise(np.concatenate([keyframe.keypoints_px for keyframe in keyframes]))
    points = [
        np.full((count, 3), np.nan) if keyframe.points_body_m is None else keyframe.points_body_m
        for keyframe, count in zip(keyframes, counts, strict=True)
    ]
    points_cam = _points_in_camera(np.concatenate(points, dtype=np.float64), invert(rig.T_body_cams[0]))
    descriptors = np.concatenate([keyframe.descriptors for keyframe in keyframes])
    seen = np.isfinite(xy[:, 0])
    ends = np.cumsum([0, *counts])
    if not seen.all():
        xy, points_cam, descriptors = xy[seen], points_cam[seen], descriptors[seen]
        ends = np.concatenate([[0], np.cumsum(seen)])[ends]
    xy_32 = xy.astype(np.float32)
    out = []
    for keyframe, begin, end in zip(keyframes, ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        own = None if keyframe.points_body_m is None else points_cam[begin:end]
        out.append(View(keyframe.id, keyframe.t_ns, descriptors[begin:end], xy_32[begin:end], own))
    return out


def _checked_count(keyframe: Keyframe) -> int:
    """Return how many features a keyframe has; raises DataError when its arrays do not fit together."""
    packed(keyframe.descriptors)  # refuses other descriptors
    count = len(keyframe.descriptors)
    points = keyframe.points_body_m
    if keyframe.keypoints_px.shape != (count, 2) or (points is not None and points.shape != (count, 3)):
        raise DataError(
            f"keyframe {keyframe.id}: {count} descriptors, but keypoints {list(keyframe.keypoints_px.shape)} "
            f"and points {None if points is None else list(points.shape)}; expected [{count}, 2] and [{count}, 3]"
        )
    return count


@njit(cache=True, nogil=True)
def _points_in_camera(points_body_m: Array, T_cam_body: Array) -> NDArray[np.float32]:
    """Return points [N, 3] in cam0, NaN where they are not finite or behind it; numpy takes 0.2 ms for 1,000."""
    out = np.full(points_body_m.shape, np.nan, np.float32)
    R, t = T_cam_body[:3, :3], T_cam_body[:3, 3]
    for i in range(len(points_body_m)):
        x, y, z = points_body_m[i]
        depth_m = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z) and depth_m > 0.0):
            continue
        out[i, 0] = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        out[i, 1] = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        out[i, 2] = depth_m
    return out
