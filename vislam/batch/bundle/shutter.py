"""Rolling shutter in the batch: how images shear with the camera's velocity, and how long the readout takes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.batch.bundle.rays import Mask, Tracks
from vislam.core.messages import Array
from vislam.trajectory import Trajectory

_HALF_WINDOW_NS = 50_000_000  # velocity is the motion between this long before and after
_MIN_SEEN = 20  # observations of a keyframe that may show the readout: six go to its pose
_MAX_S = 0.05
_FIRST_GAIN = 0.5  # share of an error of the readout that residuals show, points having taken the rest
_MIN_GAIN = 0.2  # a smaller share would be extrapolated from noise


class ReadoutSearch:
    """Finds the readout that leaves no shear: points bend to hide most of it, so plain steps would take many rounds.

    What is left to see is a share of the true error; two rounds show which share, as in the secant method.
    """

    def __init__(self) -> None:
        """Start without experience."""
        self._last: tuple[float, float] | None = None

    def next_s(self, readout_s: float, left_s: float) -> float:
        """Return the next readout to try, given the one that was applied and the change that residuals ask for."""
        gain = _FIRST_GAIN
        if self._last is not None and abs(readout_s - self._last[0]) > 1e-6:
            gain = float(np.clip((self._last[1] - left_s) / (readout_s - self._last[0]), _MIN_GAIN, 1.0))
        self._last = readout_s, left_s
        return float(np.clip(readout_s + left_s / gain, 0.0, _MAX_S))


def camera_twists(frames: Trajectory, t_ns: NDArray[np.int64], T_body_cam: Array) -> Array:
    """Return the velocities [K, 6] of the camera in its own axes at times [K], rotation first, in 1/s and m/s.

    From the poses of all frames of a run; zero where they end within a quarter of the window.
    """
    out = np.zeros((len(t_ns), 6))
    if len(frames) < 2:
        return out
    first, last = int(frames.t_ns[0]), int(frames.t_ns[-1])
    before, after = np.clip(t_ns - _HALF_WINDOW_NS, first, last), np.clip(t_ns + _HALF_WINDOW_NS, first, last)
    good = after - before > _HALF_WINDOW_NS // 2
    if not good.any():
        return out
    A, B = frames.at(before[good]) @ T_body_cam, frames.at(after[good]) @ T_body_cam
    middle = frames.at(np.clip(t_ns[good], first, last)) @ T_body_cam
    dt = (after - before)[good, None] * 1e-9
    turn = Rotation.from_matrix(np.einsum("nji,njk->nik", A[:, :3, :3], B[:, :3, :3])).as_rotvec() / dt
    to_middle = np.einsum("nji,njk->nik", middle[:, :3, :3], A[:, :3, :3])
    out[good, :3] = np.einsum("nij,nj->ni", to_middle, turn)
    out[good, 3:] = np.einsum("nji,nj->ni", middle[:, :3, :3], (B[:, :3, 3] - A[:, :3, 3]) / dt)
    return out


def flow_basis(xy: Array, rho: Array) -> Array:
    """Return F [N, 2, 6]: the image motion of a still point for a camera twist, d(xy)/dt = F @ twist."""
    x, y = xy[:, 0], xy[:, 1]
    zero = np.zeros(len(x))
    return np.stack(
        [
            np.stack([x * y, -(1.0 + x * x), y, -rho, zero, rho * x], axis=1),
            np.stack([1.0 + y * y, -x * y, -x, zero, -rho, rho * y], axis=1),
        ],
        axis=1,
    )


def shear(tracks: Tracks, rho: Array, twists: Array) -> Array:
    """Return what a second of readout adds to the coordinates [N, 2] against the middle row's instant."""
    flow = np.einsum("nij,nj->ni", flow_basis(tracks.xy, rho), twists[tracks.keyframe])
    return np.asarray(flow * tracks.row[:, None])


def readout_change_s(tracks: Tracks, keep: Mask, error: Array, rho: Array, twists: Array) -> float:
    """Return how much longer the readout is than assumed, from errors [N, 2] of predicted minus observed coordinates.

    Least squares with the pose of every keyframe free, which takes what looks like motion out of the shear.
    """
    k = tracks.keyframe[keep]
    weight = 1.0 / tracks.sigma_per_px[keep]
    F = flow_basis(tracks.xy[keep], rho[keep]) * weight[:, None, None]
    s = np.einsum("nij,nj->ni", F, twists[k]) * tracks.row[keep][:, None]
    e = error[keep] * weight[:, None]
    bounds = np.searchsorted(k, np.arange(len(twists) + 1))
    information, moment = 0.0, 0.0
    for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        if b - a < _MIN_SEEN:
            continue
        J, slope, residual = F[a:b].reshape(-1, 6), s[a:b].ravel(), e[a:b].ravel()
        pose = np.linalg.lstsq(J, np.column_stack([slope, residual]), rcond=None)[0]
        left, rest = slope - J @ pose[:, 0], residual - J @ pose[:, 1]
        information += float(left @ left)
        moment += float(left @ rest)
    return -moment / information if information > 0.0 else 0.0
