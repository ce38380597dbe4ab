"""Fixed-lag smoother over keyframes: inertial links, landmarks, calibration, and a marginal prior of what left.

Leutenegger et al., "Keyframe-based visual-inertial odometry using nonlinear optimization", IJRR 2015; Usenko et al.,
"Visual-inertial mapping with non-linear factor recovery", RA-L 2020. Each observation is used once: when a keyframe
leaves, the tracks that it saw give their first observations to the prior and go on as new landmarks with the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from vislam.camera import Rig
from vislam.config import WindowConfig
from vislam.errors import DataError, UsageError
from vislam.geometry import interpolate, invert
from vislam.imu import ImuNoise
from vislam.messages import Array, ImuSpan, KeyframePacket, NavState, Tracking
from vislam.window import gate, visual
from vislam.window.layout import CALIBRATION, STATE, Camera, Ints, Prior
from vislam.window.leaving import split
from vislam.window.linear import joint_covariance, trailing_covariance
from vislam.window.marginal import Leaving, first_pose_prior, first_prior, marginalise, touched
from vislam.window.messages import CalibrationEstimate, WindowEdge, WindowTilt, WindowUpdate
from vislam.window.posterior import edges, nav_state, pose, scale_sigma, tilt
from vislam.window.solver import Problem, Room, Solution, optimise
from vislam.window.spans import LinkStore
from vislam.window.tracks import Selection, TrackTable, check_observations

_RHO_START = 0.2  # 1/m: 5 m, where nothing is known
_UNKNOWN_SPEED_M_S = 0.5  # a velocity less certain than this predicts worse than odometry does
_SURE_SPEED_M_S = 0.3  # until velocity is known so well, the window is still finding its feet:
_SURE_KEYFRAMES = 6  # nothing is rejected, calibration waits, and landmarks start afresh with each keyframe
_CONTRADICTED = 0.25  # of the tested views are as expected at most: a crowd of wrong tracks, ...
_STUBBORN_KEYFRAMES = 4  # ... or after so many keyframes in a row, a wrong expectation
_MAX_SPEED_M_S = 300.0  # a prediction that is faster is nonsense to restart from
_UNSURE_EFFORT = 5  # times the iterations
_MAX_OFFSET_S = 0.1  # a residual time offset beyond this is a wrong clock, not a late camera


@dataclass(frozen=True, slots=True, eq=False)
class _Posterior:
    """Covariance of what is eliminated last, and where it lies: newest velocity and biases, poses, calibration."""

    covariance: Array
    poses: Array  # [6 M, 6 M]
    calibration: Array  # [5, 5]


class SlidingWindow:
    """Owns the states, observations, links and prior of the newest keyframes."""

    def __init__(self, config: WindowConfig, rig: Rig, noise: ImuNoise | None, gravity_m_s2: float) -> None:
        """Start empty; without `noise` there is no IMU and the window holds poses alone."""
        if config.keyframes < 3:
            raise UsageError(f"a window needs at least 3 keyframes, got --window.keyframes {config.keyframes}")
        if noise is None and not rig.is_stereo and not rig.has_depth:
            raise UsageError(
                "one camera without an IMU cannot see scale; a window needs an IMU, a second camera or depth"
            )
        self._config = config
        self._rig = rig
        self._noise = noise
        self._gravity_m_s2 = gravity_m_s2
        self._measures_scale = rig.is_stereo or rig.has_depth
        self._gate = float(chi2.ppf(config.gate_probability, 2))
        self._T_cam0_cams = np.array([invert(rig.T_body_cams[0]) @ T for T in rig.T_body_cams[:2]])
        self._full = False
        self._tracks = TrackTable(config, rig)
        self._links = LinkStore(config, noise, gravity_m_s2)
        self._room = Room()
        self._last_edges: list[WindowEdge] = []
        self._sure: bool = False
        self._at_rest: bool = False
        self._start_variances: Array = np.zeros(CALIBRATION)
        self._start: NavState | None = None
        self._T_start: Array | None = None
        self._initialised = False
        self._scale_sigma = 0.0 if self._measures_scale else float("inf")
        self._known: Array | None = None  # covariance of newest velocity and biases, poses, calibration
        self._clear()

    def initialise(self, state: NavState | None, T_local_body: Array | None = None) -> None:
        """Set the state of the first keyframe to come: a full one, or its pose [4, 4] where there is no IMU.

        Raises:
            DataError: it is not finite, or its covariance is not positive semidefinite.
            UsageError: an IMU without a state.
        """
        if self._noise is not None and state is None:
            raise UsageError("a window with an IMU starts from a full state; initialise the inertial states first")
        if state is not None:
            _check_state(state)
        if T_local_body is not None and not np.isfinite(T_local_body).all():
            raise DataError("the first pose of the window is not finite; initialise again")
        self._full = state is not None and self._noise is not None
        self._start = state
        self._T_start = np.eye(4) if T_local_body is None else T_local_body.copy()
        self._initialised = True
        self._clear()

    def add(self, packet: KeyframePacket, T_odom_body: Array | None = None) -> WindowUpdate:
        """Take a keyframe, optimise, let the oldest go if the window is full, and say what changed.

        Args:
            packet: the keyframe with its observations and the inertial span since the one before.
            T_odom_body: its pose [4, 4] by odometry, a start value where the IMU cannot give one.

        Raises:
            DataError: something in it is not finite, not in time order, or does not fit; the window is as before.
            UsageError: `initialise` has not been called.
        """
        self._check(packet, T_odom_body)
        self._push(packet, T_odom_body)
        doubted = self._doubt_newest()
        selection = self._select()
        solution = self._optimise(selection)
        if not solution.ok:
            return self._restart(packet)
        self._take(selection, solution)
        posterior = self._posterior(solution)
        rejected = self._reject(selection, solution)
        T_edges, P_edges = edges(self._X, posterior.poses)
        if not self._measures_scale:
            sigma = scale_sigma(self._X, posterior.poses)
            self._scale_sigma = sigma if np.isfinite(sigma) else self._scale_sigma
        newest = self._newest(posterior)
        calibration = self._calibration_estimate(posterior)
        self._sure = self._sure or not self._full or self._found_its_feet()
        settled: list[WindowEdge] = []
        tilts: list[WindowTilt] = []
        states: list[tuple[int, NavState]] = []
        if len(self._ids) > self._config.keyframes:
            settled, tilts, states = self._settle(solution, posterior, T_edges[0], P_edges[0])
            self._let_go()
            T_edges, P_edges = T_edges[1:], P_edges[1:]
        self._known = self._still_known(posterior)
        provisional = [
            WindowEdge(int(a), int(b), T, P, False)
            for a, b, T, P in zip(self._ids[:-1], self._ids[1:], T_edges, P_edges, strict=True)
        ]
        self._last_edges = provisional
        return WindowUpdate(
            ids=self._ids.copy(),
            T_local_body=np.array([pose(x) for x in self._X]),
            newest=newest,
            odometry=(*settled, *provisional),
            tilts=tuple(tilts),
            states=tuple(states),
            calibration=calibration,
            scale_sigma=self._scale_sigma,
            rejected_tracks=rejected + doubted,
        )

    def _clear(self) -> None:
        self._ids: Ints = np.zeros(0, dtype=np.int64)
        self._t_ns: Ints = np.zeros(0, dtype=np.int64)
        self._X: Array = np.zeros((0, STATE))
        self._X_first: Array = np.zeros((0, STATE))
        self._held = np.zeros(0, dtype=np.bool_)
        self._gyro: Array = np.zeros((0, 3))  # measured at each keyframe; zero at rest
        self._applied: Array = np.zeros(0)
        self._T_odom: list[Array | None] = []
        self._calibration = np.zeros(CALIBRATION)
        self._prior: Prior | None = None
        self._contradictions = 0  # keyframes in a row that saw hardly anything as expected
        self._known = None
        self._speed_sigma_m_s = 0.0
        self._last_edges = []
        self._sure = False
        self._at_rest = False
        self._start_variances = np.zeros(CALIBRATION)
        self._tracks = TrackTable(self._config, self._rig)
        self._links.clear()

    # ---- what comes in

    def _check(self, packet: KeyframePacket, T_odom_body: Array | None) -> None:
        where = f"keyframe {packet.keyframe.id} at {packet.keyframe.t_ns} ns"
        if not self._initialised:
            raise UsageError("the window has no first state yet; call initialise before add")
        check_observations(packet.observations, where)
        if not np.isfinite(packet.time_offset_s):
            raise DataError(f"{where}: its time offset is {packet.time_offset_s}; it must be a number of seconds")
        if T_odom_body is not None and not np.isfinite(T_odom_body).all():
            raise DataError(f"{where}: its pose by odometry is not finite; leave it out")
        T_vo = packet.vo.T_keyframe_body
        if T_vo is not None and not np.isfinite(T_vo).all():
            raise DataError(f"{where}: its motion by visual odometry is not finite; report it as lost instead")
        if len(self._ids) == 0:
            return
        if packet.keyframe.t_ns <= self._t_ns[-1] or packet.keyframe.id <= self._ids[-1]:
            raise DataError(
                f"{where} does not follow keyframe {self._ids[-1]} at {self._t_ns[-1]} ns; add keyframes in time order"
            )
        if packet.imu is not None:
            _check_span(packet.imu, int(self._t_ns[-1]), packet.keyframe.t_ns, where)

    def _push(self, packet: KeyframePacket, T_odom_body: Array | None) -> None:
        """Append the keyframe with a first guess of its state."""
        first = len(self._ids) == 0
        x = self._first_state(packet) if first else self._predicted(packet, T_odom_body)
        gyro = np.zeros(3)
        if packet.imu is not None and len(packet.imu.t_ns) > 0 and not packet.at_rest:
            gyro = packet.imu.gyro_rad_s[-1]
            if len(self._ids) == 1 and self._links.usable(packet.imu):
                self._gyro[0] = packet.imu.gyro_rad_s[0]
        self._ids = np.append(self._ids, packet.keyframe.id)
        self._t_ns = np.append(self._t_ns, packet.keyframe.t_ns)
        self._X = np.vstack([self._X, x])
        self._X_first = np.vstack([self._X_first, x])
        self._held = np.append(self._held, False)
        self._gyro = np.vstack([self._gyro, gyro])
        self._applied = np.append(self._applied, packet.time_offset_s)
        self._T_odom.append(None if T_odom_body is None else T_odom_body.copy())
        if packet.at_rest and self._at_rest:
            # rest says that nothing moved; what else the pixels say is noise, and minutes of it would add up to drift
            self._tracks.remove(self._tracks.keyframe == self._ids[-2])
        self._at_rest = packet.at_rest
        self._tracks.add(packet.keyframe.id, packet.observations)

    def _first_state(self, packet: KeyframePacket) -> Array:
        """Return the state of the first keyframe, and set the prior on it."""
        config, x = self._config, np.zeros(STATE)
        self._calibration[0] = packet.time_offset_s
        self._calibration[4] = config.readout_s or 0.0
        sigmas = np.array(
            [config.time_offset_sigma_s, *[np.deg2rad(config.rotation_sigma_deg)] * 3, config.readout_sigma_s]
        )
        sigmas *= self._wanted()
        self._start_variances = sigmas**2
        if self._full:
            assert self._start is not None
            T = self._start.T_world_body
            x[12:15], x[15:18] = self._start.velocity_world_m_s, self._start.gyro_bias_rad_s
            x[18:21] = self._start.accel_bias_m_s2
            gauge = config.gauge_sigma_m, config.gauge_sigma_rad
            self._prior = first_prior(self._start, *gauge, self._calibration, sigmas)
            self._speed_sigma_m_s = float(np.sqrt(np.diag(self._start.covariance)[6:9].max()))
        else:
            assert self._T_start is not None
            T = self._T_start
            self._prior = first_pose_prior(config.gauge_sigma_m, config.gauge_sigma_rad, self._calibration, sigmas)
        x[:9], x[9:12] = T[:3, :3].ravel(), T[:3, 3]
        return x

    def _predicted(self, packet: KeyframePacket, T_odom_body: Array | None) -> Array:
        """Return a first guess of the new keyframe's state, and append its link."""
        last, dt_s = self._X[-1], float(packet.keyframe.t_ns - self._t_ns[-1]) * 1e-9
        span = packet.imu if self._full else None
        motion = self._guess(packet, T_odom_body, dt_s)
        inertial = self._links.push(span, dt_s, last[15:].copy(), motion, packet.at_rest and self._full)
        x = last.copy()
        R = last[:9].reshape(3, 3)
        by_odometry = T_odom_body is not None and self._T_odom[-1] is not None
        if inertial and not (by_odometry and self._speed_sigma_m_s > _UNKNOWN_SPEED_M_S):
            links, k = self._links.arrays, len(self._links) - 1
            fall = np.array([0.0, 0.0, -self._gravity_m_s2])
            x[:9] = (R @ links.dR[k]).ravel()
            x[9:12] += dt_s * last[12:15] + 0.5 * dt_s**2 * fall + R @ links.dp[k]
            x[12:15] += dt_s * fall + R @ links.dv[k]
            return x
        x[:9] = (R @ motion[:3, :3]).ravel()
        x[9:12] += R @ motion[:3, 3]
        if self._full:
            x[12:15] = R @ motion[:3, 3] / dt_s
        return x

    def _guess(self, packet: KeyframePacket, T_odom_body: Array | None, dt_s: float) -> Array:
        """Return the motion since the last keyframe as odometry, vision or habit have it."""
        if T_odom_body is not None and self._T_odom[-1] is not None:
            return invert(self._T_odom[-1]) @ T_odom_body
        vo = packet.vo
        if vo.T_keyframe_body is not None and vo.has_scale and vo.tracking != Tracking.LOST:
            return vo.T_keyframe_body
        if self._full:
            motion = np.eye(4)
            motion[:3, 3] = self._X[-1, :9].reshape(3, 3).T @ self._X[-1, 12:15] * dt_s
            return motion
        if len(self._ids) < 2:
            return np.eye(4)
        before_s = float(self._t_ns[-1] - self._t_ns[-2]) * 1e-9
        last = invert(pose(self._X[-2])) @ pose(self._X[-1])
        return interpolate(np.eye(4), last, dt_s / before_s)

    # ---- the solution

    def _active(self) -> NDArray[np.bool_]:
        """Return which calibration the solver may move now."""
        return self._wanted() & self._sure

    def _wanted(self) -> NDArray[np.bool_]:
        """Return which calibration is to be estimated."""
        config = self._config
        return np.array(
            [
                config.estimate_time_offset and self._full,
                *[config.estimate_rotation and self._full] * 3,
                config.estimate_readout and self._full,
            ]
        )

    def _camera(self) -> Camera:
        active = self._active()
        rate = np.where(self._gyro.any(axis=1, keepdims=True), self._gyro - self._X[:, 15:18], 0.0)
        return Camera(
            T_body_cam=self._rig.T_body_cams[0],
            T_cam0_cams=self._T_cam0_cams,
            rate=rate,
            applied_offset_s=self._applied if active[0] else np.full(len(self._ids), self._calibration[0]),
            active=active,
            huber_k=self._config.huber_k,
            rho_information=self._config.rho_sigma_1_m**-2,
        )

    def _select(self) -> Selection:
        """Return the views, with a start value for every landmark that has none."""
        selection = self._tracks.select(self._ids)
        hosts = self._ids[selection.views.host]
        fresh = self._tracks.host[selection.slots] != hosts
        if not self._sure:
            fresh[:] = True
        if fresh.any():
            points = self._tracks.points[selection.slots]
            visual.start(self._X, self._calibration, selection.views, self._camera(), fresh, _RHO_START, points)
            self._tracks.points[selection.slots] = points
            self._tracks.host[selection.slots] = hosts
        return selection

    def _doubt_newest(self) -> int:
        """Take out what the newest keyframe saw and the window did not expect; return of how many tracks.

        If hardly anything is as expected, again and again, it is the expectation that is wrong, and all of it stays.
        """
        if self._known is None or not self._sure or self._at_rest or not self._links.arrays.inertial[-1]:
            return 0
        covariance = gate.predicted_covariance(self._known, self._X, self._links.arrays, self._gravity_m_s2)
        rows = self._tracks.continued(self._ids)
        if covariance is None or len(rows) == 0:
            return 0
        views = self._tracks.arrange(rows, self._ids)
        points = self._tracks.points[views.slots]
        fresh = self._tracks.host[views.slots] != self._ids[views.views.host]
        camera = self._camera()
        if fresh.any():
            older = self._tracks.arrange(rows[self._tracks.keyframe[rows] != self._ids[-1]], self._ids)
            visual.start(self._X, self._calibration, older.views, camera, fresh, _RHO_START, points)
        squares = np.empty(len(views.rows))
        gate.innovations(self._X, points, self._calibration, views.views, camera, covariance, squares)
        tested, bad = ~np.isnan(squares), squares > self._gate
        contradicted = bad.sum() > (1.0 - _CONTRADICTED) * tested.sum()
        self._contradictions = self._contradictions + 1 if contradicted else 0
        if self._contradictions > _STUBBORN_KEYFRAMES:
            return 0
        gone = np.zeros(len(self._tracks), dtype=bool)
        gone[views.rows[bad]] = True
        self._tracks.remove(gone)
        return int(bad.sum())

    def _optimise(self, selection: Selection) -> Solution:
        assert self._prior is not None
        self._links.refresh(self._X[:, 15:])
        problem = Problem(
            self._X, self._X_first, self._held, self._tracks.points[selection.slots], self._calibration,
            selection.views, self._camera(), self._links.arrays, self._prior, self._gravity_m_s2, self._full,
        )  # fmt: skip
        iterations = self._config.iterations if self._sure else _UNSURE_EFFORT * self._config.iterations
        return optimise(problem, iterations, self._config.tolerance, self._room)

    def _take(self, selection: Selection, solution: Solution) -> None:
        self._X = solution.X
        self._tracks.points[selection.slots] = solution.points
        self._calibration = solution.calibration
        offset_s = self._calibration[0] - self._applied[-1]
        self._calibration[0] -= offset_s - float(np.clip(offset_s, -_MAX_OFFSET_S, _MAX_OFFSET_S))

    def _reject(self, selection: Selection, solution: Solution) -> int:
        """Take out observations beyond the gate, and tracks with too many of them; return how many tracks."""
        bad = solution.squares.max(axis=1, initial=0.0) > self._gate
        if not self._sure or not bad.any():
            return 0
        first = selection.views.first
        counts = np.add.reduceat(bad.astype(np.int64), first[:-1])
        hopeless = counts > self._config.gate_track_fraction * np.diff(first)
        hopeless |= bad[first[:-1]]  # the host's own view: without it the landmark has no bearing
        out = bad | np.repeat(hopeless, np.diff(first))
        gone = np.zeros(len(self._tracks), dtype=bool)
        gone[selection.rows[out]] = True
        self._tracks.remove(gone)
        return int(hopeless.sum())

    def _posterior(self, solution: Solution) -> _Posterior:
        count = len(self._ids)
        newest = 9 if self._full else 0
        covariance = trailing_covariance(solution.U, 9 * (count - 1) if self._full else 0)
        calibration_at = newest + 6 * count
        return _Posterior(
            covariance,
            np.ascontiguousarray(covariance[newest:calibration_at, newest:calibration_at]),
            covariance[calibration_at:, calibration_at:],
        )

    def _still_known(self, posterior: _Posterior) -> Array | None:
        """Return the covariance of newest velocity and biases, poses that are still held, and calibration."""
        if not self._full:
            return None
        gone = 6 * (len(posterior.poses) // 6 - len(self._ids))
        kept = np.concatenate([np.arange(9), np.arange(9 + gone, len(posterior.covariance))])
        return np.ascontiguousarray(posterior.covariance[np.ix_(kept, kept)])

    def _newest(self, posterior: _Posterior) -> NavState | None:
        if not self._full:
            return None
        at = 9 + 6 * (len(self._ids) - 1)
        index = np.concatenate([np.arange(at, at + 6), np.arange(9)])
        covariance = posterior.covariance[np.ix_(index, index)]
        self._speed_sigma_m_s = float(np.sqrt(np.diag(covariance)[6:9].max()))
        return nav_state(int(self._t_ns[-1]), self._X[-1], covariance)

    def _calibration_estimate(self, posterior: _Posterior) -> CalibrationEstimate:
        sigmas = np.sqrt(np.diag(posterior.calibration) if self._active().any() else self._start_variances)
        sigmas = sigmas * self._wanted()
        c = self._calibration
        applied = float(self._applied[-1])
        offset_s = float(c[0]) if self._wanted()[0] else applied
        return CalibrationEstimate(
            offset_s, float(sigmas[0]), c[1:4].copy(), sigmas[1:4], float(c[4]), float(sigmas[4])
        )  # fmt: skip

    def _found_its_feet(self) -> bool:
        return len(self._ids) >= _SURE_KEYFRAMES and self._speed_sigma_m_s < _SURE_SPEED_M_S

    # ---- what leaves

    def _settle(
        self, solution: Solution, posterior: _Posterior, T: Array, P: Array
    ) -> tuple[list[WindowEdge], list[WindowTilt], list[tuple[int, NavState]]]:
        """Return what is final about the oldest keyframe."""
        oldest, after = int(self._ids[0]), int(self._ids[1])
        settled = [WindowEdge(oldest, after, T, P, True)]
        if not self._full:
            return settled, [], []
        index = np.concatenate([9 * len(self._ids) + np.arange(6), np.arange(9)])
        covariance = joint_covariance(solution.U, index)
        state = nav_state(int(self._t_ns[0]), self._X[0], covariance)
        return settled, [tilt(oldest, self._X[0], covariance[:3, :3])], [(oldest, state)]

    def _let_go(self) -> None:
        """Marginalise the oldest keyframe with what only it explains."""
        assert self._prior is not None
        given, dropped = split(self._tracks, self._ids, self._config.split_min)
        selection = self._tracks.arrange(given, self._ids)
        leaving = Leaving(selection.views, self._tracks.points[selection.slots])
        self._prior = marginalise(
            self._X, self._X_first, self._held, self._calibration, leaving, self._camera(), self._links.arrays,
            self._prior, self._gravity_m_s2, self._full, self._room,
        )  # fmt: skip
        gone = np.zeros(len(self._tracks), dtype=bool)
        gone[given] = gone[dropped] = True
        self._tracks.remove(gone)
        self._X_first = np.where(self._held[:, None], self._X_first, self._X)[1:]
        self._held = touched(self._prior, len(self._ids) - 1, self._full)
        self._ids, self._t_ns, self._X = self._ids[1:], self._t_ns[1:], self._X[1:]
        self._gyro, self._applied, self._T_odom = self._gyro[1:], self._applied[1:], self._T_odom[1:]
        self._links.pop_front()

    def _restart(self, packet: KeyframePacket) -> WindowUpdate:
        """Begin again at the newest keyframe, as the last good solution predicts it, and let all others go.

        Their edges leave with the covariance of that solution; the last one is as wide as the new start.
        """
        config, ids = self._config, self._ids
        wide = np.repeat(
            [
                config.restart_sigma_rad,
                config.restart_sigma_m,
                config.restart_speed_sigma_m_s,
                config.restart_gyro_bias_sigma_rad_s,
                config.restart_accel_bias_sigma_m_s2,
            ],
            3,
        )
        covariance = np.diag(wide**2)
        known = {(e.from_id, e.to_id): e.covariance for e in self._last_edges}
        dt_s = float(self._t_ns[-1] - self._t_ns[-2]) * 1e-9 if len(ids) > 1 else 0.0
        x = self._X[-1]
        if len(ids) > 1 and not np.abs(x[9:12] - self._X[-2, 9:12]).max() < _MAX_SPEED_M_S * dt_s:  # NaN too
            x = self._X[-1] = self._X[-2]
        settled = tuple(
            WindowEdge(a, b, invert(pose(xa)) @ pose(xb), known.get((a, b), covariance[:6, :6]), True)
            for a, b, xa, xb in zip(ids[:-1].tolist(), ids[1:].tolist(), self._X[:-1], self._X[1:], strict=True)
        )
        state = nav_state(packet.keyframe.t_ns, x, covariance)
        self.initialise(state if self._full else None, state.T_world_body)
        self._push(packet, None)
        return WindowUpdate(
            ids=self._ids.copy(),
            T_local_body=state.T_world_body[None],
            newest=state if self._full else None,
            odometry=settled,
            tilts=(),
            states=(),
            calibration=CalibrationEstimate(
                packet.time_offset_s, config.time_offset_sigma_s, np.zeros(3), np.zeros(3), config.readout_s or 0.0, 0.0
            ),
            scale_sigma=self._scale_sigma,
            rejected_tracks=0,
            note=f"the window restarted at keyframe {packet.keyframe.id}: its equations had no solution",
        )


def _check_state(state: NavState) -> None:
    values = [state.T_world_body, state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2]
    if not all(np.isfinite(v).all() for v in values) or not np.isfinite(state.covariance).all():
        raise DataError("the first state of the window is not finite; initialise again")
    if float(np.linalg.eigvalsh(0.5 * (state.covariance + state.covariance.T))[0]) < -1e-9:
        raise DataError("the covariance of the window's first state has a negative eigenvalue; initialise again")


def _check_span(span: ImuSpan, t0_ns: int, t1_ns: int, where: str) -> None:
    if len(span.t_ns) == 0:
        return
    if not (np.isfinite(span.gyro_rad_s).all() and np.isfinite(span.accel_m_s2).all()):
        raise DataError(f"{where}: its inertial span has values that are not finite; leave such samples out")
    if len(span.t_ns) > 1 and int(np.diff(span.t_ns).min()) <= 0:
        raise DataError(f"{where}: its inertial span goes back in time; sort the samples and drop duplicates")
    if int(span.t_ns[0]) != t0_ns or int(span.t_ns[-1]) != t1_ns:
        raise DataError(
            f"{where}: its inertial span covers [{span.t_ns[0]}, {span.t_ns[-1]}] ns instead of [{t0_ns}, {t1_ns}]; "
            "cut it with ImuBuffer.span"
        )
