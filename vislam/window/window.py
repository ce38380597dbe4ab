"""Fixed-lag smoother over keyframes: inertial links, landmarks, calibration, and a marginal prior of what left.

Leutenegger et al., "Keyframe-based visual-inertial odometry using nonlinear optimization", IJRR 2015; Usenko et al.,
"Visual-inertial mapping with non-linear factor recovery", RA-L 2020. Each observation is used once: when a keyframe
leaves, the tracks that it saw give their first observations to the prior and go on as new landmarks with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.config import MachineConfig, WindowConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array, ImuSpan, KeyframePacket, NavState
from vislam.core.readings import Motion
from vislam.imu import ImuNoise
from vislam.window import gate
from vislam.window.calibration import Calibration, optics_of
from vislam.window.doubt import Doubt
from vislam.window.equations import (
    AXES,
    STATE,
    Camera,
    Leaving,
    Prior,
    Problem,
    Room,
    Solution,
    first_pose_prior,
    first_prior,
    marginalise,
    optimise,
    touched,
    visual,
)
from vislam.window.keyframes import Keyframes
from vislam.window.leaving import broken_off, settled, split
from vislam.window.messages import WindowEdge, WindowGravity, WindowUpdate
from vislam.window.posterior import GAUGE_SIGMA_M, GAUGE_SIGMA_RAD, Posterior, edges, nav_state, pose, scale_sigma
from vislam.window.spans import LinkStore
from vislam.window.tracks import RHO_START, Selection, TrackTable, check_observations

_UNKNOWN_SPEED_M_S = 0.5  # a velocity less certain than this predicts worse than odometry does
_SURE_SPEED_M_S = 0.3  # until velocity is known so well, the window is still finding its feet:
_SURE_KEYFRAMES = 6  # nothing is rejected, calibration waits, and landmarks start afresh with each keyframe
_SPLIT_MIN = 3  # observations a track gives to the marginal prior at once; the rest starts a new landmark
_TOLERANCE = 5e-3  # relative decrease of the cost that ends Gauss-Newton steps; 1e-3 costs a step and gains nothing
_UNSURE_EFFORT = 5  # times the iterations


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The first state of a window: a full one, or where there is no IMU its pose alone."""

    state: NavState | None
    T_local_body: Array  # [4, 4]

    @classmethod
    def of(cls, state: NavState | None, T_local_body: Array | None, has_imu: bool) -> Start:
        """Return a start that was checked; DataError on numbers that cannot be used, UsageError on a missing state."""
        if has_imu and state is None:
            raise UsageError("a window with an IMU starts from a full state; initialise the inertial states first")
        if state is not None:
            _check_state(state)
        if T_local_body is not None and not np.isfinite(T_local_body).all():
            raise DataError("the first pose of the window is not finite; initialise again")
        if has_imu and state is not None:
            return cls(state, state.T_world_body)
        return cls(None, np.eye(4) if T_local_body is None else T_local_body.copy())

    def equations(self, calibration: Calibration) -> tuple[Array, Prior]:
        """Return the state [21] of the first keyframe and the prior on it."""
        x, start, gauge = np.zeros(STATE), self.state, (GAUGE_SIGMA_M, GAUGE_SIGMA_RAD)
        x[:9], x[9:12] = self.T_local_body[:3, :3].ravel(), self.T_local_body[:3, 3]
        if start is None:
            return x, first_pose_prior(*gauge, calibration.values, calibration.start_sigmas)
        x[12:15], x[15:18], x[18:21] = start.velocity_world_m_s, start.gyro_bias_rad_s, start.accel_bias_m_s2
        return x, first_prior(start, *gauge, calibration.values, calibration.start_sigmas)


def _check_state(state: NavState) -> None:
    """Raise DataError unless a first state is finite and its covariance positive semidefinite."""
    values = [state.T_world_body, state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2]
    if not all(np.isfinite(v).all() for v in values) or not np.isfinite(state.covariance).all():
        raise DataError("the first state of the window is not finite; initialise again")
    if float(np.linalg.eigvalsh(0.5 * (state.covariance + state.covariance.T))[0]) < -1e-9:
        raise DataError("the covariance of the window's first state has a negative eigenvalue; initialise again")


def check_packet(packet: KeyframePacket, T_odom_body: Array | None, newest: tuple[int, int] | None) -> None:
    """Raise DataError unless a keyframe is finite and follows the newest one, of which id and time are given."""
    where = f"keyframe {packet.keyframe.id} at {packet.keyframe.t_ns} ns"
    check_observations(packet.observations, where)
    if not np.isfinite(packet.time_offset_s):
        raise DataError(f"{where}: its time offset is {packet.time_offset_s}; it must be a number of seconds")
    if T_odom_body is not None and not np.isfinite(T_odom_body).all():
        raise DataError(f"{where}: its pose by odometry is not finite; leave it out")
    T_vo = packet.vo.T_keyframe_body
    if T_vo is not None and not np.isfinite(T_vo).all():
        raise DataError(f"{where}: its motion by visual odometry is not finite; report it as lost instead")
    if newest is None:
        return
    newest_id, newest_t_ns = newest
    if packet.keyframe.t_ns <= newest_t_ns or packet.keyframe.id <= newest_id:
        raise DataError(
            f"{where} does not follow keyframe {newest_id} at {newest_t_ns} ns; add keyframes in time order"
        )
    if packet.imu is not None:
        _check_span(packet.imu, newest_t_ns, packet.keyframe.t_ns, where)


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


class SlidingWindow:
    """Owns the states, observations, links and prior of the newest keyframes."""

    def __init__(self, config: WindowConfig, rig: Rig, noise: ImuNoise | None, machine: MachineConfig) -> None:
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
        self._measures_scale = rig.is_stereo or rig.has_depth
        self._optics = optics_of(rig)
        self._links = LinkStore(config, noise, machine)
        self._room = Room()
        self._start: Start | None = None
        self._scale_sigma = 0.0 if self._measures_scale else float("inf")
        self._clear()

    def initialise(self, state: NavState | None, T_local_body: Array | None = None) -> None:
        """Set the state of the first keyframe to come: a full one, or its pose [4, 4] where there is no IMU.

        Raises:
            DataError: it is not finite, or its covariance is not positive semidefinite.
            UsageError: an IMU without a state.
        """
        self._start = Start.of(state, T_local_body, self._noise is not None)
        self._clear()

    def add(
        self, packet: KeyframePacket, T_odom_body: Array | None = None, motions: Sequence[Motion] = ()
    ) -> WindowUpdate:
        """Take a keyframe, optimise, let the oldest go if the window is full, and say what changed.

        Args:
            packet: the keyframe with its observations and the inertial span since the one before.
            T_odom_body: its pose [4, 4] by odometry, a start value where the IMU cannot give one.
            motions: what further sensors say of the motion since the keyframe before.

        Raises:
            DataError: something in it is not finite, not in time order, or does not fit; the window is as before.
            UsageError: `initialise` has not been called.
        """
        if self._start is None:
            raise UsageError("the window has no first state yet; call initialise before add")
        check_packet(packet, T_odom_body, self._keyframes.newest)
        self._push(packet, T_odom_body, motions)
        doubted = self._doubt_newest()
        selection = self._select()
        solution = self._optimise(selection)
        if not solution.ok:
            return self._restart(packet)
        self._keyframes.X, self._tracks.points[selection.slots] = solution.X, solution.points
        self._calibration.take(solution.calibration, packet.time_offset_s)
        posterior = Posterior.of(solution.U, len(self._keyframes), self._full)
        rejected = self._doubt.solved(self._tracks, selection, solution) if self._sure else 0
        return self._let_out(solution, posterior, rejected + doubted)

    def _clear(self) -> None:
        self._full = self._start is not None and self._start.state is not None  # with velocities and biases
        self._keyframes = Keyframes()
        self._calibration = Calibration(self._config, self._rig, self._noise if self._full else None, 0.0)
        self._doubt = Doubt(len(self._rig.cameras))
        self._tracks = TrackTable(self._config, self._rig)
        self._links.clear()
        self._prior: Prior | None = None
        self._known: Array | None = None  # covariance of newest velocity and biases, poses, calibration
        self._speed_sigma_m_s = 0.0
        self._last_edges: list[WindowEdge] = []
        self._sure = self._at_rest = False

    # ---- what comes in

    def _push(self, packet: KeyframePacket, T_odom_body: Array | None, motions: Sequence[Motion] = ()) -> None:
        """Append the keyframe with a first guess of its state."""
        keyframes = self._keyframes
        x = self._first_state(packet) if len(keyframes) == 0 else self._predicted(packet, T_odom_body, motions)
        keyframes.push(packet, x, T_odom_body, self._links.usable(packet.imu))
        if packet.at_rest and self._at_rest:
            # at rest nothing moved: any motion of pixels is noise, and minutes of it would add up to drift
            self._tracks.remove(self._tracks.keyframe == keyframes.ids[-2])
        self._at_rest = packet.at_rest
        self._tracks.add(packet.keyframe.id, packet.observations)
        self._calibration.see(packet.observations)

    def _first_state(self, packet: KeyframePacket) -> Array:
        """Return the state of the first keyframe, and set the prior on it."""
        assert self._start is not None
        noise = self._noise if self._full else None
        self._calibration = Calibration(self._config, self._rig, noise, packet.time_offset_s)
        x, self._prior = self._start.equations(self._calibration)
        if self._start.state is not None:
            self._speed_sigma_m_s = float(np.sqrt(np.diag(self._start.state.covariance)[6:9].max()))
        return x

    def _predicted(self, packet: KeyframePacket, T_odom_body: Array | None, motions: Sequence[Motion]) -> Array:
        """Return a first guess of the new keyframe's state, and append its link."""
        last, dt_s = self._keyframes.X[-1], float(packet.keyframe.t_ns - self._keyframes.t_ns[-1]) * 1e-9
        by_odometry = self._keyframes.odometry_to(T_odom_body)
        motion = by_odometry
        if motion is None:
            motion = self._keyframes.assumed_motion(packet, dt_s, self._full)
        inertial = self._links.push(packet, dt_s, last[15:].copy(), motion, motions)
        if inertial and (by_odometry is None or self._speed_sigma_m_s <= _UNKNOWN_SPEED_M_S):
            return self._links.carried(last, self._calibration.values[AXES:])
        x, R = last.copy(), last[:9].reshape(3, 3)
        x[:9] = (R @ motion[:3, :3]).ravel()
        x[9:12] += R @ motion[:3, 3]
        if self._full:
            x[12:15] = R @ motion[:3, 3] / dt_s
        return x

    # ---- the solution

    def _camera(self) -> Camera:
        active, keyframes = self._calibration.wanted & self._sure, self._keyframes
        still = np.full(len(keyframes), self._calibration.values[0])  # the offset is then taken as applied
        return Camera(
            self._rig.T_body_cams[0],
            *self._optics,
            rate=keyframes.rate_rad_s,
            applied_offset_s=keyframes.applied_offset_s if active[0] else still,
            active=active,
            huber_k=self._config.huber_k * self._doubt.spreads,
            rho_information=self._config.rho_sigma_1_m**-2,
        )

    def _doubt_newest(self) -> int:
        """Take out what the newest keyframe saw and the window did not expect; return of how many tracks."""
        links, keyframes = self._links.arrays, self._keyframes
        if self._known is None or not self._sure or self._at_rest or not links.inertial[-1]:
            return 0
        covariance = gate.predicted_covariance(
            self._known, keyframes.X, self._calibration.values, links, self._links.gravity_m_s2
        )
        if covariance is None:
            return 0
        return self._doubt.newest(self._tracks, keyframes, covariance, self._calibration.values, self._camera())

    def _select(self) -> Selection:
        """Return the views, with a start value for every landmark that has none."""
        tracks, ids = self._tracks, self._keyframes.ids
        selection = tracks.select(ids)
        hosts = ids[selection.views.host]
        fresh = (tracks.host[selection.slots] != hosts) | (not self._sure)
        if fresh.any():
            points = tracks.points[selection.slots]
            visual.start(
                self._keyframes.X, self._calibration.values, selection.views, self._camera(), fresh, RHO_START, points
            )
            tracks.points[selection.slots], tracks.host[selection.slots] = points, hosts
        return selection

    def _optimise(self, selection: Selection) -> Solution:
        assert self._prior is not None
        keyframes = self._keyframes
        self._links.refresh(keyframes.X[:, 15:])
        self._links.hear(keyframes.X, keyframes.held)
        problem = Problem(
            keyframes.X, *keyframes.linearised(), self._tracks.points[selection.slots],
            self._calibration.values, selection.views, self._camera(), self._links.arrays, self._prior,
            self._links.gravity_m_s2, self._full,
        )  # fmt: skip
        iterations = self._config.iterations if self._sure else _UNSURE_EFFORT * self._config.iterations
        return optimise(problem, iterations, _TOLERANCE, self._room)

    def _let_out(self, solution: Solution, posterior: Posterior, rejected: int) -> WindowUpdate:
        """Say what changed, and let the oldest keyframe go if the window is full."""
        keyframes = self._keyframes
        T_edges, P_edges = edges(keyframes.X, posterior.poses)
        if not self._measures_scale:
            sigma = scale_sigma(keyframes.X, posterior.poses)
            self._scale_sigma = sigma if np.isfinite(sigma) else self._scale_sigma
        newest = self._newest(posterior)
        moved = (self._calibration.wanted & self._sure).any()
        calibration = self._calibration.estimate(
            posterior.calibration if moved else None, float(keyframes.applied_offset_s[-1])
        )
        found_its_feet = len(keyframes) >= _SURE_KEYFRAMES and self._speed_sigma_m_s < _SURE_SPEED_M_S
        self._sure = self._sure or not self._full or found_its_feet
        final: list[WindowEdge] = []
        tilts: list[WindowGravity] = []
        states: list[tuple[int, NavState]] = []
        if len(keyframes) > self._config.keyframes:
            final, tilts, states = settled(keyframes, solution, T_edges[0], P_edges[0], self._full)
            self._let_go()
            T_edges, P_edges = T_edges[1:], P_edges[1:]
        self._known = posterior.of_newest(len(keyframes)) if self._full else None
        self._last_edges = [
            WindowEdge(int(a), int(b), T, P, False)
            for a, b, T, P in zip(keyframes.ids[:-1], keyframes.ids[1:], T_edges, P_edges, strict=True)
        ]
        return WindowUpdate(
            ids=keyframes.ids.copy(),
            T_local_body=np.array([pose(x) for x in keyframes.X]),
            newest=newest,
            odometry=(*final, *self._last_edges),
            tilts=tuple(tilts),
            states=tuple(states),
            calibration=calibration,
            scale_sigma=self._scale_sigma,
            rejected_tracks=rejected,
        )

    def _newest(self, posterior: Posterior) -> NavState | None:
        if not self._full:
            return None
        covariance = posterior.newest_state
        self._speed_sigma_m_s = float(np.sqrt(np.diag(covariance)[6:9].max()))
        return nav_state(int(self._keyframes.t_ns[-1]), self._keyframes.X[-1], covariance)

    def _let_go(self) -> None:
        """Marginalise the oldest keyframe with what only it explains."""
        assert self._prior is not None
        keyframes, tracks = self._keyframes, self._tracks
        given, dropped = split(tracks, keyframes.ids, _SPLIT_MIN)
        selection = tracks.arrange(given, keyframes.ids)
        leaving = Leaving(selection.views, tracks.points[selection.slots])
        first, is_fixed = keyframes.linearised()
        X_linear = np.where(is_fixed[:, None], first, keyframes.X)
        self._prior = marginalise(
            keyframes.X, first, X_linear, self._calibration.values, leaving, self._camera(), self._links.arrays,
            self._prior, self._links.gravity_m_s2, self._full, self._room,
        )  # fmt: skip
        tracks.remove_rows(np.concatenate([given, dropped]))
        keyframes.pop_front(touched(self._prior, len(keyframes) - 1, self._full), X_linear)
        self._links.pop_front()

    def _restart(self, packet: KeyframePacket) -> WindowUpdate:
        """Begin again at the newest keyframe, as the last good solution predicts it, and let all others go."""
        state, final = broken_off(self._keyframes, self._last_edges)
        newest = state if self._full else None
        self.initialise(newest, state.T_world_body)
        self._push(packet, None)
        return WindowUpdate(
            ids=self._keyframes.ids.copy(),
            T_local_body=state.T_world_body[None],
            newest=newest,
            odometry=final,
            tilts=(),
            states=(),
            calibration=self._calibration.estimate(None, packet.time_offset_s),
            scale_sigma=self._scale_sigma,
            rejected_tracks=0,
            note=f"the window restarted at keyframe {packet.keyframe.id}: its equations had no solution",
        )
