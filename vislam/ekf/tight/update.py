"""What a frame does to the tight filter. Settings only; the state comes and goes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vislam.config import EkfConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import invert, skew
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.ekf.filter_core import (
    RESET_REJECTS,
    RESET_S,
    REST_PAUSE_NS,
    reset_sigmas,
)
from vislam.ekf.history import Outcome
from vislam.ekf.loose.kernels import pose
from vislam.ekf.tight import features
from vislam.ekf.tight.kernels import from_nav_error
from vislam.ekf.tight.state import (
    CLONES,
    FOCAL,
    METRES,
    Window,
    cloned,
    compressed,
    depth_ratios,
    gain_step,
    moved,
    with_points,
    without_clone,
    without_points,
)
from vislam.ekf.tight.tracks import FrameTracks, image_motion_px, marked, ripe_tracks, seen_at

if TYPE_CHECKING:  # the fast path must not load OpenCV
    from vislam.core.camera import Rig

_CLONES = 11  # past poses that tracks tie together; half a second at 20 Hz
_MOST_POINTS = 25  # long tracks kept as points of the state; they stop the drift while little moves
_POINT_DEPTH_RATIO = 0.1  # sigma of its distance over it that such a point may have at first
_POINT_MISSES = 1  # frames in a row that may not see such a point before it is dropped
_MOST_ITERATIONS = 5  # of one update at most; more than one only while velocity is badly known
_MIN_OBSERVATIONS = 3  # of a track; two leave one equation
_STEREO_SIGMA_PX = 0.5  # right minus left pixel: matching, without the error of the corner
_DEPTH_SIGMA_RHO = 3e-3  # 1/m, of the inverse of a depth image
_OUTLIER_SIGMAS = 5.0  # one observation of a track; the test of the track follows
# sigma over inverse depth; above, a point's place is no base to linearise at
_MAX_DEPTH_RATIO = 0.3
_MIN_RANGE_M = 0.1
_MAX_RANGE_M = 200.0  # beyond, nothing but rotation is seen
# image motion between clones below which the older one is kept instead of the newer
_STILL_PX = 1.0
# between clones; a fast camera would leave a window too short for parallax
_MIN_INTERVAL_S = 0.03
_STATUS = {
    features.USED: "tracks_used",
    features.FEW: "tracks_few",
    features.PARALLAX: "tracks_no_parallax",
    features.RANGE: "tracks_range",
    features.OUTLIER: "tracks_outliers",
    features.GATED: "tracks_gated",
}
_CONTRADICTED = 0.25  # of the tested tracks agree at most: the state is wrong, not the tracks
_MIN_TESTED = 5
_FOLLOWED_SHARE = 0.1  # by which a frame moves the spread of rows towards its own
_RATIOS = 0.1, 10.0  # between which one frame counts
_LEAST_SPREAD = 0.05  # no tracker is better
_SMALL_SHARE = 0.05  # of the window's extent
_SHORT_M = 0.02
_SMALL_RAD = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """What a frame brings: whitened rows, the observations behind them, and tracks that may stay as points."""

    H: Array  # [m, n]
    r: Array  # [m] against the state before the frame
    at: NDArray[np.int64]  # [M] clone of each observation used
    row: NDArray[np.int64]  # [M]
    misses: NDArray[np.int64]  # [S]
    spread: Array  # [2] see `Window`
    ids: NDArray[np.int64]  # [K], best known depth first
    points: Array  # [K, 3]
    ratios: Array  # [K]
    fixing: Array  # [K, 3, 5 + 6 C + 1] see `with_points`
    H_points: Array  # [K, 3, 3]


class FrameUpdater:
    """Applies frames: the same one on the same state gives the same answer, however often it is replayed."""

    def __init__(self, config: EkfConfig, gravity_m_s2: float, rig: Rig) -> None:
        """Take the settings and the rig."""
        self._config = config
        self._gravity = gravity_m_s2
        self._p_body_cam = np.ascontiguousarray(rig.T_body_cams[0][:3, 3], dtype=np.float64)
        T_cams_cam0 = np.array([invert(T) for T in rig.T_cam0_cams])
        sigmas = np.array([config.tight_pixel_sigma_px, _STEREO_SIGMA_PX, _DEPTH_SIGMA_RHO])
        into_each = np.ascontiguousarray(T_cams_cam0[:, :3, :3]), np.ascontiguousarray(T_cams_cam0[:, :3, 3])
        self._sensor = features.Sensor(rig.lenses, sigmas, *into_each)
        self._point_sensor = self._sensor._replace(sigmas=sigmas * np.array([config.tight_point_inflation, 1.0, 1.0]))
        self._bounds = features.Bounds(
            min_rho=1.0 / _MAX_RANGE_M,
            max_rho=1.0 / _MIN_RANGE_M,
            max_ratio=float(_MAX_DEPTH_RATIO),
            outlier_sigmas=float(_OUTLIER_SIGMAS),
            min_views=float(_MIN_OBSERVATIONS),
        )
        # one metric observation and another fix a point and leave something over
        self._least = 2 if rig.is_stereo or rig.has_depth else _MIN_OBSERVATIONS
        most = features.ROWS_MAX * (_CLONES + 2)
        self._limits = np.array([chi_square_limit(config.gate_probability, max(k, 1)) for k in range(most)])
        self._reset_sigmas = reset_sigmas()

    def see(
        self, window: Window, x: Array, gyro_rad_s: Array, ago_s: float, frame: FrameTracks
    ) -> tuple[Window, Outcome]:
        """Clone the pose for a frame and use the points it sees and the tracks that became ripe with it.

        Iterated (Bell and Cathey, 1993): while velocity is badly known, poses in the window are wrong by as much as
        they are apart, and one linear step would take the wrong parallax for knowledge.
        """
        R = np.ascontiguousarray(pose(x, 0, 6)[:3, :3])
        if frame.t_ns - window.rested_t_ns > REST_PAUSE_NS:
            window = replace(window, rest=None)
        prior = cloned(window, x, R, gyro_rad_s, ago_s, self._gravity, frame)
        leaving = self._leaving(prior)
        before = x.copy()
        window, change, P = prior, np.zeros(len(prior.P)), prior.P
        for _ in range(_MOST_ITERATIONS):
            out = Outcome()
            rows = self._rows(window, leaving, change, out)
            if not len(rows.r):
                x[:], window, P = before, prior, prior.P
                break
            step, P, out.nis = gain_step(prior.P, rows.H, rows.r)
            x[:] = before
            later = moved(prior, x, step)
            rows.fixing[:, :, -1] -= rows.fixing[:, :, :-1] @ (step - change)[16 : prior.first_point]
            done = _is_small(window, later, step - change)
            window, change, out.accepted = later, step, True
            if done:
                break
        window = replace(
            window, P=P, misses=rows.misses, spread=rows.spread, frames=marked(prior.frames, rows.at, rows.row)
        )
        if out.accepted:
            window = replace(window, last_vision_t_ns=frame.t_ns, watch=window.watch.seen(frame.t_ns))
            window = self._keep_points(window, rows, out)
        if leaving is not None:
            window = without_clone(window, leaving)
        window = self._watch(window, x, frame.t_ns, out)
        out.count("vision_used" if out.accepted else "vision_idle")
        out.reason = out.reason or ("" if out.accepted else "no track was ripe or passed its test")
        return without_points(window, window.misses > _POINT_MISSES), out

    def _leaving(self, window: Window) -> int | None:
        """Return which clone goes: the oldest, unless the last but one is where the one before it was."""
        count = len(window.frames)
        if count <= _CLONES:
            return None
        kept, candidate = window.frames[-3], window.frames[-2]
        still = image_motion_px(kept, candidate) < _STILL_PX
        still = still or candidate.t_ns - kept.t_ns < _MIN_INTERVAL_S * 1e9
        rests = window.rest is not None and window.rested_t_ns >= candidate.t_ns
        began_t_ns = None if window.rest is None else window.rest.t_ns
        if (still or rests) and candidate.t_ns != began_t_ns:
            return count - 2
        return 0 if window.frames[0].t_ns != began_t_ns else 1

    def _rows(self, window: Window, leaving: int | None, change: Array, out: Outcome) -> _Rows:
        """Return what the newest frame shows of its points of the state, and the tracks that are ripe with it.

        The window is where to linearise; its covariance is that before the frame, `change` [n] what lies between.
        """
        newest = len(window.frames) - 1
        frame = window.frames[newest]
        row = np.minimum(np.searchsorted(frame.ids, window.point_ids), len(frame.ids) - 1)
        found = np.flatnonzero(frame.ids[row] == window.point_ids)
        row = row[found]
        at = np.full(len(found), newest, dtype=np.int64)
        views = self._views(window, at, frame.seen[row])
        prior = features.Prior(window.P, change)
        sensor = _as_found(self._point_sensor, window, 1)
        H_points, r_points, tests = _point_rows(
            found, window.points, views, sensor, prior, len(window.frames), self._limits
        )
        limits = self._limits[tests[:, 1].astype(np.int64)]
        good, gated = tests[:, 0] <= limits, tests[:, 2] > limits
        misses = window.misses + 1
        misses[found[good]] = 0
        out.count("points_used", int(good.sum()))
        out.count("points_outliers", int((~good & ~gated).sum()))
        out.count("points_gated", int(gated.sum()))
        out.test("points", int(good.sum()), float(tests[good, 2].sum()), int(tests[good, 1].sum()))
        unused = replace(window, frames=marked(window.frames, at, row))
        tracks = self._use_tracks(unused, leaving, change, out)
        return replace(
            tracks,
            H=np.vstack((H_points, tracks.H)),
            r=np.concatenate((r_points, tracks.r)),
            at=np.concatenate((at, tracks.at)),
            row=np.concatenate((row, tracks.row)),
            misses=misses,
            spread=np.array([tracks.spread[0], _followed(window.spread[1], tests)]),
        )

    def _use_tracks(self, window: Window, leaving: int | None, change: Array, out: Outcome) -> _Rows:
        """Return the projected rows of the ripe tracks; those still followed may become points of the state."""
        oldest = leaving if leaving is not None and leaving < len(window.frames) - 2 else None
        ripe = ripe_tracks(window.frames, oldest, self._least, self._config.tight_max_tracks)
        n, visible = len(window.P), slice(16, window.first_point)
        width = visible.stop - visible.start
        if not len(ripe.ids):
            nothing = np.zeros(0)
            no_ids = np.zeros(0, dtype=np.int64)
            return _Rows(
                np.zeros((0, n)), nothing, no_ids, no_ids, no_ids, window.spread, no_ids, np.zeros((0, 3)), nothing,
                np.zeros((0, 3, width + 1)), np.zeros((0, 3, 3)),
            )  # fmt: skip
        views = self._views(window, ripe.at, seen_at(window.frames, ripe.at, ripe.row))
        prior = features.Prior(np.ascontiguousarray(window.P[visible, visible]), np.ascontiguousarray(change[visible]))
        sensor = _as_found(self._sensor, window, 0)
        status, points, tests, fixing, H_points, stack = features.process(
            ripe.starts, views, sensor, prior, self._bounds, self._limits
        )
        for code, name in _STATUS.items():
            out.count(name, int((status == code).sum()))
        used = status == features.USED
        out.test("tracks", int(used.sum()), float(tests[used, 3].sum()), int(tests[used, 1].sum()))
        H_stack, r_stack = compressed(stack[:, :-1], stack[:, -1])
        H = np.zeros((len(r_stack), n))
        H[:, visible] = H_stack
        fit = np.flatnonzero(used & ripe.alive)
        fit = fit[np.argsort(tests[fit, 2], kind="stable")]
        return _Rows(
            H,
            r_stack,
            ripe.at,
            ripe.row,
            window.misses,
            np.array([_followed(window.spread[0], tests), window.spread[1]]),
            ripe.ids[fit],
            points[fit],
            tests[fit, 2],
            fixing[fit],
            H_points[fit],
        )

    def _keep_points(self, window: Window, rows: _Rows, out: Outcome) -> Window:
        """Take the tracks whose depth is known best into the state, as far as there is room.

        How well the poses are known counts too: as long as scale is not, a point in the state would be linearised at
        the wrong place for good. And where the motion does not show scale, the noise of one point after the other would
        be taken for it.
        """
        if not window.frames[-1].shows_scale:
            return window
        free = max(_MOST_POINTS - len(window.point_ids), 0)
        if not len(rows.ids) or not free:
            return window
        ratios = depth_ratios(window, rows.points, rows.fixing, rows.H_points)
        fit = np.flatnonzero(ratios < _POINT_DEPTH_RATIO)[:free]
        if not len(fit):
            return window
        out.count("points_started", len(fit))
        return with_points(window, rows.ids[fit], rows.points[fit], rows.fixing[fit], rows.H_points[fit])

    def _views(self, window: Window, at: NDArray[np.int64], seen: Array) -> features.Views:
        R_cam, centres = features.camera_poses(
            at,
            seen,
            window.R,
            window.p,
            window.rate,
            window.velocity,
            (np.ascontiguousarray(window.R_body_cam), self._p_body_cam),
            self._sensor,
        )
        return features.Views(at, seen, R_cam, centres)

    def _watch(self, window: Window, x: Array, t_ns: int, out: Outcome) -> Window:
        """Inflate the covariance when frame after frame contradicts the state."""
        good = sum(
            out.counts.get(f"{kind}_{what}", 0) for kind in ("tracks", "points") for what in ("used", "outliers")
        )
        bad = out.counts.get("tracks_gated", 0) + out.counts.get("points_gated", 0)
        if good + bad < _MIN_TESTED:
            return window
        if good > _CONTRADICTED * (good + bad):
            return replace(window, rejects=0)
        since = t_ns if window.rejects == 0 else window.rejects_since_ns
        rejects = window.rejects + 1
        if rejects < RESET_REJECTS or t_ns - since < RESET_S * 1e9:
            return replace(window, rejects=rejects, rejects_since_ns=since)
        out.count("soft_resets")
        out.reason = f"{rejects} frames in a row contradict the state, covariance inflated"
        M = from_nav_error(x) * self._reset_sigmas
        P = window.P.copy()
        P[:15, :15] += M @ M.T
        # points that no longer fit would only contradict again
        fresh = replace(window, P=P, rejects=0)
        return without_points(fresh, np.ones(len(window.point_ids), dtype=np.bool_))


def _as_found(sensor: features.Sensor, window: Window, which: int) -> features.Sensor:
    """Return a sensor as the window has it, with the spread of tracks (0) or points (1)."""
    focal, metres = window.scales.tolist()
    return sensor._replace(focal=focal, metres=metres, spread=float(window.spread[which]))


def _followed(spread: float, tests: Array) -> float:
    """Return how much rows scatter over their sigmas, after more tests [K, >= 2] of NIS by it and degrees of freedom.

    By the median, so that as many as half may be outliers.
    """
    tested = tests[tests[:, 1] > 0]
    if len(tested) < _MIN_TESTED:
        return spread
    degrees = tested[:, 1]
    usual = degrees * (1.0 - 2.0 / (9.0 * degrees)) ** 3  # median of chi-square (Wilson and Hilferty, 1931)
    step = float(np.clip(np.median(tested[:, 0] / usual), *_RATIOS)) ** (0.5 * _FOLLOWED_SHARE)
    return float(np.clip(spread * step, _LEAST_SPREAD, 1.0))


def _is_small(before: Window, after: Window, change: Array) -> bool:
    """Whether a step changed so little of the window's shape that linearising again would change nothing."""
    apart = np.abs(before.p - before.p[-1]).max()
    moved_m = np.abs((after.p - after.p[-1]) - (before.p - before.p[-1])).max()
    return bool(moved_m < _SMALL_SHARE * max(apart, _SHORT_M) and np.abs(change[:3]).max() < _SMALL_RAD)


@njit(cache=True, nogil=True)
def _point_rows(
    which: NDArray[np.int64],
    points: Array,
    views: features.Views,
    sensor: features.Sensor,
    prior: features.Prior,
    clones: int,
    limits: Array,
) -> tuple[Array, Array, Array]:
    """Return whitened rows H [m, n] and r [m] of points of the state seen from the newest clone, and tests [K, 3].

    A test is NIS by the spread, degrees of freedom, NIS as whitened; infinite, 0, infinite behind the camera.
    """
    _, seen, R_cam, centres = views
    P, change = prior
    n = len(P)
    H = np.zeros((features.ROWS_MAX * len(which), n))
    r_all = np.empty(features.ROWS_MAX * len(which))
    tests = np.zeros((len(which), 3))
    r = np.empty(features.ROWS_MAX)
    J, by_lens = np.empty((features.ROWS_MAX, 3)), np.empty((features.ROWS_MAX, 2))
    clone = CLONES + 6 * (clones - 1)
    columns = np.empty(17, dtype=np.int64)
    columns[15], columns[16] = FOCAL, METRES
    small = np.empty((17, 17))
    m = 0
    for k in range(len(which)):
        f = points[which[k]]
        y = R_cam[k] @ (f - centres[k])
        rows = features.observe(y, seen[k], sensor, r, J, by_lens)
        if rows == 0:
            tests[k, 0] = tests[k, 2] = np.inf
            continue
        by_point = J[:rows] @ R_cam[k]
        by_turn = by_point @ skew(f)
        h = np.zeros((rows, 17))
        h[:, 0:3] = -by_turn
        h[:, 3:6] = features.turned_with_cam0(J[:rows], y, int(seen[k, 11]), sensor)
        h[:, 6:9] = by_turn
        h[:, 9:12] = -by_point
        h[:, 12:15] = by_point
        h[:, 15:] = by_lens[:rows]
        for i in range(3):
            columns[i], columns[3 + i] = i, 16 + i
            columns[6 + i], columns[9 + i] = clone + i, clone + 3 + i
            columns[12 + i] = CLONES + 6 * clones + 3 * which[k] + i
        for i in range(17):
            for j in range(17):
                small[i, j] = P[columns[i], columns[j]]
        residual = r[:rows].copy()
        for i in range(rows):
            for j in range(17):
                residual[i] += h[i, j] * change[columns[j]]
        tests[k, 0], tests[k, 2] = features.gate(h, residual, small, sensor.spread)
        tests[k, 1] = rows
        if not tests[k, 0] <= limits[rows]:
            continue
        for i in range(rows):
            for j in range(17):
                H[m + i, columns[j]] = h[i, j]
            r_all[m + i] = residual[i]
        m += rows
    return H[:m], r_all[:m], tests
