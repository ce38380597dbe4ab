"""Whether the image stands still: motion grows with time, noise does not.

From one frame to the next, slow motion shifts corners by less than their noise. Over half a second it does not: each
track's pixels are fitted by a straight line in time, and what the lines have in common (shift, turn, zoom) and how far
they differ beyond noise (parallax) tell motion from rest. Noise is that of the pixels about their lines.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from vislam.config import InitConfig
from vislam.messages import Array, Observations

_NS = 1_000_000_000
_WINDOW_NS = _NS // 2  # at 1 px over it, a wall 3 m away passes at 13 mm/s
_MAX_INTERVAL_NS = _NS  # tracks that bridge a longer pause say nothing about what was in it
_MIN_FRAMES = 3  # a line through two leaves no residual
_MIN_TRACKS = 10  # fewer say nothing about the motion of the camera
_SIGNIFICANT = 3.0  # standard deviations
_WIDEST = 4.0  # of the threshold: noise that hides more than this many of them excuses nothing
_ROBUST_STEPS = 4
_CAUCHY = 2.4  # standard deviations; 95 % efficient
_MEDIAN_SQUARE = 2.0 * np.log(2.0)  # median of a squared distance in two dimensions, in variances


class Stillness:
    """Owns the tracks of the last half second and answers for the newest frame.

    Attributes:
        moved_px: common motion over the window, median over the tracks; NaN where it could not be told.
        parallax_px: motion in which tracks differ, beyond noise; NaN where it could not be told.
        noise_px: standard deviation of one coordinate of a pixel about its line; NaN where it could not be told.
    """

    def __init__(self, config: InitConfig) -> None:
        """Start empty; `config.still_px` is the limit for motion over the window and from frame to frame."""
        self._limit_px = config.still_px
        self._frames: deque[tuple[int, NDArray[np.int64], Array]] = deque()  # time, ascending ids, pixels
        self.moved_px = self.parallax_px = self.noise_px = np.nan

    def add(self, t_ns: int, seen: Observations) -> bool:
        """Take a frame and return whether the image stood still up to it.

        False also where it cannot be told: fewer than three frames, or fewer than ten tracks in most of them.
        """
        frames = self._frames
        if frames and not 0 < t_ns - frames[-1][0] <= _MAX_INTERVAL_NS:
            frames.clear()
        order = np.argsort(seen.track_ids, kind="stable")
        frames.append((t_ns, seen.track_ids[order], seen.pixels_px[order]))
        while len(frames) > _MIN_FRAMES and t_ns - frames[0][0] > _WINDOW_NS + _WINDOW_NS // 16:
            frames.popleft()
        self.moved_px = self.parallax_px = self.noise_px = np.nan
        if len(frames) < _MIN_FRAMES:
            return False
        t_s = np.array([(at_ns - t_ns) / _NS for at_ns, _, _ in frames])
        pixels = self._pixels()
        if pixels.shape[1] < _MIN_TRACKS:
            return False
        return self._over_window(t_s, pixels) and self._in_last_step(pixels)

    def _pixels(self) -> Array:
        """Return pixels [frames, N, 2] of the newest frame's tracks that were seen in most frames; NaN: not seen."""
        wanted, places = self._frames[-1][1], []
        for _, ids, pixels in self._frames:
            at = np.minimum(np.searchsorted(ids, wanted), max(len(ids) - 1, 0))
            found = ids[at] == wanted if len(ids) else np.zeros(len(wanted), dtype=np.bool_)
            places.append(np.full((len(wanted), 2), np.nan))
            places[-1][found] = pixels[at[found]]
        stacked = np.array(places)
        often = np.isfinite(stacked[..., 0]).sum(axis=0) >= max(_MIN_FRAMES, 0.6 * len(places))
        return np.asarray(stacked[:, often])

    def _over_window(self, t_s: Array, pixels: Array) -> bool:
        """Judge the motion along the lines, over the length of the window."""
        here = np.isfinite(pixels[..., 0])
        count = here.sum(axis=0)
        middle = np.where(here, t_s[:, None], 0.0).sum(axis=0) / count
        tau = np.where(here, t_s[:, None] - middle, 0.0) / (t_s[-1] - t_s[0])
        filled = np.where(here[..., None], pixels, 0.0)
        centre = filled.sum(axis=0) / count[:, None]
        spread = (tau**2).sum(axis=0)
        flow = (tau[..., None] * (filled - centre)).sum(axis=0) / spread[:, None]
        rest = np.where(here[..., None], filled - centre - tau[..., None] * flow, 0.0)
        noise_px, steady = _noise((rest**2).sum(axis=(0, 2)), 2 * (count - 2))
        if steady.sum() < _MIN_TRACKS:
            return False
        centre, flow, spread = centre[steady], flow[steady], spread[steady]
        variance = noise_px**2 * float(np.median(1.0 / spread))  # of a coordinate of the flow
        common, differing = _common_motion(centre, flow)
        self.noise_px = noise_px
        self.moved_px = float(np.median(np.linalg.norm(common, axis=1)))
        excess = float(np.median((differing**2).sum(axis=1))) / _MEDIAN_SQUARE - variance
        self.parallax_px = float(np.sqrt(max(excess, 0.0)))
        chance = _SIGNIFICANT * variance / (np.log(2.0) * np.sqrt(len(flow)))  # of a median that is a variance
        return self._is_small(self.moved_px, 2.0 * np.sqrt(variance / len(flow))) and excess < min(
            max(self._limit_px**2, chance), (_WIDEST * self._limit_px) ** 2
        )

    def _in_last_step(self, pixels: Array) -> bool:
        """Judge the motion since the frame before: shaking comes back to where it was within the window."""
        step = pixels[-1] - pixels[-2]
        both = np.isfinite(step[:, 0])
        if both.sum() < _MIN_TRACKS:
            return False
        common, _ = _common_motion(pixels[-1][both], step[both])
        moved_px = float(np.median(np.linalg.norm(common, axis=1)))
        return self._is_small(moved_px, 2.0 * np.sqrt(2.0 / both.sum()) * self.noise_px)

    def _is_small(self, moved_px: float, sigma_px: float) -> bool:
        return moved_px < min(max(self._limit_px, _SIGNIFICANT * sigma_px), _WIDEST * self._limit_px)


def _noise(squares: Array, freedom: Array) -> tuple[float, NDArray[np.bool_]]:
    """Return the standard deviation behind sums of squares [N] of `freedom` [N], and which of them it explains.

    A track that jumped once or slipped onto another corner has a residual that noise does not explain.
    """
    typical = freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3  # median of chi-square
    variance = float(np.median(squares / typical))
    steady = squares <= variance * (freedom + _SIGNIFICANT * np.sqrt(2.0 * freedom))
    if steady.any():
        variance = float(squares[steady].sum() / freedom[steady].sum())
    return float(np.sqrt(variance)), np.asarray(steady)


def _common_motion(places: Array, flow: Array) -> tuple[Array, Array]:
    """Return shift, turn and zoom that fit a flow [N, 2] at places [N, 2] robustly, at each place, and the rest."""
    centred = places - np.median(places, axis=0)
    reach = max(float(np.median(np.linalg.norm(centred, axis=1))), 1.0)
    x, y = centred.T / reach
    one, zero = np.ones(len(x)), np.zeros(len(x))
    A = np.stack([np.column_stack([one, zero, x, -y]), np.column_stack([zero, one, y, x])], axis=1).reshape(-1, 4)
    common = np.broadcast_to(np.median(flow, axis=0), flow.shape)
    for _ in range(_ROBUST_STEPS):
        squares = ((flow - common) ** 2).sum(axis=1)
        scale = max(float(np.median(squares)) / _MEDIAN_SQUARE, 1e-12) * _CAUCHY**2
        weighted = A * np.repeat(1.0 / (1.0 + squares / scale), 2)[:, None]
        found = np.linalg.solve(weighted.T @ A + 1e-9 * np.eye(4), weighted.T @ flow.ravel())
        common = (A @ found).reshape(-1, 2)
    return np.asarray(common), np.asarray(flow - common)
