"""Whether the image stands still: motion grows with time, noise does not.

From one frame to the next, slow motion shifts corners by less than their noise. Over half a second it does not: each
track's pixels are fitted by a straight line in time, and what the lines have in common (shift, turn, zoom) and how far
they differ beyond noise (parallax) distinguish motion from rest. Noise is that of the pixels about their lines.

A rest that lasts is judged by where its tracks were all the time, too: their mean since it began is known far better
than a line through half a second. So it ends with a creep that is too slow for the line, and not with a noisy frame.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, Observations
from vislam.core.quantiles import median

_STILL_PX = 0.8  # median image motion over the window and from frame to frame, noise taken out: below, it may be rest
_NS = 1_000_000_000
_WINDOW_NS = _NS // 2  # at 1 px over it, a wall 3 m away passes at 13 mm/s
_MAX_INTERVAL_NS = _NS  # tracks that bridge a longer pause say nothing about what was in it
MIN_FRAMES = 3  # before a rest shows: a line through two leaves no residual
_MIN_TRACKS = 10  # fewer say nothing about the motion of the camera
_HOLD = 1.5  # times the limits over the window, as long as the tracks are where they were when rest began
_SIGNIFICANT = 3.0  # standard deviations
_WIDEST = 4.0  # of the threshold: noise that hides more than this many of them excuses nothing
_FAR = 20.0  # times the threshold that most tracks moved over the window: no noise, parallax or fit makes that a rest
_ROBUST_STEPS = 4
_CAUCHY = 2.4  # standard deviations; 95 % efficient
_MEDIAN_SQUARE = 2.0 * np.log(2.0)  # median of a squared distance in two dimensions, in variances


class Stillness:
    """Owns the tracks of the last half second and answers for the newest frame.

    Attributes:
        resting: whether a rest goes on, up to the newest frame; for those who already know their state. It bears a
            frame that noise moves a little beyond the limit, and ends when the tracks have left their places.
        moved_px: common motion over the window, median over the tracks; NaN where it is unknown or far.
        parallax_px: motion in which tracks differ, beyond noise; NaN where it is unknown.
        noise_px: standard deviation of one coordinate of a pixel about its line; NaN where it is unknown.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._frames: deque[tuple[int, NDArray[np.int64], Array]] = deque()  # time, ascending ids, pixels
        self.resting = False
        self._places = _Places()  # of frames of this rest that are older than the window
        self._unsteady = np.zeros(0, dtype=np.int64)  # tracks that jumped within the window
        self._left_t_ns: int | None = None  # when tracks were found elsewhere
        self.moved_px = self.parallax_px = self.noise_px = np.nan

    def add(self, t_ns: int, seen: Observations) -> bool:
        """Take a frame and return whether the image stood still up to it.

        False also where that is unknown: fewer than three frames, or fewer than ten tracks in most of them.
        """
        frames = self._frames
        if frames and not 0 < t_ns - frames[-1][0] <= _MAX_INTERVAL_NS:
            frames.clear()
            self.resting = False
        order = np.argsort(seen.track_ids, kind="stable")
        frames.append((t_ns, seen.track_ids[order], seen.pixels_px[order]))
        while len(frames) > MIN_FRAMES and t_ns - frames[0][0] > _WINDOW_NS + _WINDOW_NS // 16:
            _, ids, pixels = frames.popleft()
            if self.resting:
                steady = ~np.isin(ids, self._unsteady)
                self._places.add(ids[steady], pixels[steady], np.unique(np.concatenate([f[1] for f in frames])))
        self.moved_px = self.parallax_px = self.noise_px = np.nan
        times_limit = self._times_limit(t_ns)
        self._follow_rest(t_ns, times_limit)
        return times_limit < 1.0

    def _times_limit(self, t_ns: int) -> float:
        """Return the largest motion over the window in units of its limit; infinite where it is unknown."""
        if len(self._frames) < MIN_FRAMES:
            return np.inf
        if self._is_far():
            return np.inf
        t_s = np.array([(at_ns - t_ns) / _NS for at_ns, _, _ in self._frames])
        ids, pixels = self._pixels()
        if len(ids) < _MIN_TRACKS:
            return np.inf
        return float(max(self._over_window(t_s, ids, pixels), self._in_last_step(pixels)))

    def _is_far(self) -> bool:
        """Return whether most tracks are so far from where they were that nothing has to be fitted."""
        (_, old_ids, old), (_, ids, new) = self._frames[0], self._frames[-1]
        if len(old_ids) < _MIN_TRACKS or len(ids) < _MIN_TRACKS:
            return False
        at = np.minimum(np.searchsorted(old_ids, ids), len(old_ids) - 1)
        both = old_ids[at] == ids
        moved = np.hypot(*(new[both] - old[at[both]]).T)
        return len(moved) >= _MIN_TRACKS and median(moved) > _FAR * _STILL_PX

    def _follow_rest(self, t_ns: int, times_limit: float) -> None:
        """Begin a rest, go on with it or end it; one that ends by displacement begins again after a whole window."""
        if self._left_t_ns is not None and t_ns - self._left_t_ns < _WINDOW_NS:
            return
        begins = not self.resting
        self.resting = times_limit < (1.0 if begins else _HOLD)
        if begins:
            self._places = _Places()
        elif self.resting and self._since_rest_began() >= 1.0:
            self.resting, self._left_t_ns = False, t_ns

    def _pixels(self) -> tuple[NDArray[np.int64], Array]:
        """Return the newest frame's tracks [N] that were seen in most frames; pixels [frames, N, 2], NaN: not seen."""
        wanted, places = self._frames[-1][1], []
        for _, ids, pixels in self._frames:
            at = np.minimum(np.searchsorted(ids, wanted), max(len(ids) - 1, 0))
            found = ids[at] == wanted if len(ids) else np.zeros(len(wanted), dtype=np.bool_)
            places.append(np.full((len(wanted), 2), np.nan))
            places[-1][found] = pixels[at[found]]
        stacked = np.array(places)
        often = np.isfinite(stacked[..., 0]).sum(axis=0) >= max(MIN_FRAMES, 0.6 * len(places))
        return wanted[often], np.asarray(stacked[:, often])

    def _over_window(self, t_s: Array, ids: NDArray[np.int64], pixels: Array) -> float:
        """Return the motion along the lines, over the length of the window, in units of its limit."""
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
        self._unsteady = ids[~steady]
        if steady.sum() < _MIN_TRACKS:
            return np.inf
        variance = noise_px**2 * float(np.median(1.0 / spread[steady]))  # of a coordinate of the flow
        self.noise_px = noise_px
        times_limit, self.moved_px, self.parallax_px = self._judge(centre[steady], flow[steady], variance)
        return times_limit

    def _since_rest_began(self) -> float:
        """Return how far the tracks are from their places in units of the limit; 0 where it is unknown."""
        ids, pixels = self._pixels()
        places, count = self._places.of(ids)
        now = pixels[-MIN_FRAMES:]
        known = (count >= MIN_FRAMES) & np.isfinite(now[..., 0]).any(axis=0) & ~np.isin(ids, self._unsteady)
        if known.sum() < _MIN_TRACKS:
            return 0.0
        moved = np.nanmean(now[:, known], axis=0) - places[known]
        near = np.linalg.norm(moved - np.median(moved, axis=0), axis=1) < _WIDEST * _STILL_PX
        if near.mean() < 0.5:
            return np.inf
        self._places.forget(ids[known][~near])  # slipped onto other corners
        known[known] = near
        here = np.isfinite(now[:, known, 0]).sum(axis=0)
        variance = self.noise_px**2 * float(np.median(1.0 / here + 1.0 / count[known]))
        return self._judge(places[known], moved[near], variance)[0]

    def _judge(self, centre: Array, flow: Array, variance: float) -> tuple[float, float, float]:
        """Return a flow [N, 2] at places [N, 2] in units of its limit, its common motion and its parallax.

        `variance` is that of a coordinate of the flow.
        """
        common, differing = _common_motion(centre, flow)
        moved_px = float(np.median(np.linalg.norm(common, axis=1)))
        excess = float(np.median((differing**2).sum(axis=1))) / _MEDIAN_SQUARE - variance
        chance = _SIGNIFICANT * variance / (np.log(2.0) * np.sqrt(len(flow)))  # of a median that is a variance
        parallax_px = float(np.sqrt(max(excess, 0.0)))
        limit_px = min(max(_STILL_PX, float(np.sqrt(chance))), _WIDEST * _STILL_PX)
        moved = self._in_limits(moved_px, 2.0 * np.sqrt(variance / len(flow)))
        return max(moved, parallax_px / limit_px), moved_px, parallax_px

    def _in_last_step(self, pixels: Array) -> float:
        """Return the motion since the frame before, in units of its limit: shaking comes back within the window."""
        step = pixels[-1] - pixels[-2]
        both = np.isfinite(step[:, 0])
        if both.sum() < _MIN_TRACKS:
            return np.inf
        common, _ = _common_motion(pixels[-1][both], step[both])
        moved_px = float(np.median(np.linalg.norm(common, axis=1)))
        return self._in_limits(moved_px, 2.0 * np.sqrt(2.0 / both.sum()) * self.noise_px)

    def _in_limits(self, moved_px: float, sigma_px: float) -> float:
        return moved_px / min(max(_STILL_PX, _SIGNIFICANT * sigma_px), _WIDEST * _STILL_PX)


class _Places:
    """Where tracks were on average."""

    def __init__(self) -> None:
        self._ids = np.zeros(0, dtype=np.int64)  # ascending
        self._sums = np.zeros((0, 3))  # of the pixels, and how many

    def add(self, ids: NDArray[np.int64], pixels: Array, alive: NDArray[np.int64]) -> None:
        """Take pixels [N, 2] of tracks [N]; tracks that are not among those alive [M] (ascending) are forgotten."""
        sums = np.zeros((len(alive), 3))
        for tracks, values in ((self._ids, self._sums), (ids, np.column_stack((pixels, np.ones(len(ids)))))):
            _, at, row = np.intersect1d(alive, tracks, return_indices=True)
            sums[at] += values[row]
        self._ids, self._sums = alive, sums

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Drop tracks [N]."""
        kept = ~np.isin(self._ids, ids)
        self._ids, self._sums = self._ids[kept], self._sums[kept]

    def of(self, ids: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the mean pixels [N, 2] of tracks [N] and of how many frames [N]; NaN and 0 where unknown."""
        sums = np.zeros((len(ids), 3))
        _, at, row = np.intersect1d(ids, self._ids, return_indices=True)
        sums[at] = self._sums[row]
        with np.errstate(invalid="ignore"):
            return sums[:, :2] / sums[:, 2:], sums[:, 2]


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
    reach = max(median(np.linalg.norm(centred, axis=1)), 1.0)
    x, y = centred.T / reach
    one, zero = np.ones(len(x)), np.zeros(len(x))
    A = np.stack([np.column_stack([one, zero, x, -y]), np.column_stack([zero, one, y, x])], axis=1).reshape(-1, 4)
    common = np.broadcast_to(np.median(flow, axis=0), flow.shape)
    for _ in range(_ROBUST_STEPS):
        squares = ((flow - common) ** 2).sum(axis=1)
        scale = max(median(squares) / _MEDIAN_SQUARE, 1e-12) * _CAUCHY**2
        weighted = A * np.repeat(1.0 / (1.0 + squares / scale), 2)[:, None]
        found = np.linalg.solve(weighted.T @ A + 1e-9 * np.eye(4), weighted.T @ flow.ravel())
        common = (A @ found).reshape(-1, 2)
    return np.asarray(common), np.asarray(flow - common)
