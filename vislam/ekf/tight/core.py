"""The core of the tight filter: the inertial state and its error's transition since the last event, and the window."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vislam.config import EkfConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import skew, so3_exp, so3_log, so3_right_jacobian
from vislam.core.messages import Array, NavState, NoiseScale
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.filter_core import (
    REST_SIGMA_DEG,
    REST_SIGMA_M,
    ZERO_RATE_SIGMA_RAD_S,
    ZERO_VELOCITY_SIGMA_M_S,
    imu_sigmas,
    nominal,
    scaled,
)
from vislam.ekf.history import AtRest, Event, KnownBias, Outcome
from vislam.ekf.loose.kernels import Step, pose
from vislam.ekf.regain import Regain, Watch, grown
from vislam.ekf.sensor_rows import OwnVariables, Sensing, body_of
from vislam.ekf.stretch import Stretch
from vislam.ekf.tight import kernels
from vislam.ekf.tight.kernels import INERTIAL, Inertial, from_nav_error, to_nav_error
from vislam.ekf.tight.state import CLONES, FOCAL, METRES, MOUNT, TIME, Rest, Window, corrected, moved, propagated
from vislam.ekf.tight.tracks import FrameTracks
from vislam.ekf.tight.update import FrameUpdater
from vislam.imu import ImuNoise
from vislam.sensors import BodyState, Suite

if TYPE_CHECKING:
    from vislam.core.camera import Rig

TightEvent = Event[FrameTracks]
_MAX_OFFSET_S = 0.2  # a larger estimate is not a delay but a filter that is lost
_COUNTERS = (
    "keyframes",
    "vision_used",
    "vision_idle",  # no track was ripe, or none passed its test
    "vision_lost",
    "vision_invalid",
    "vision_duplicate",
    "tracks_used",
    "tracks_few",
    "tracks_no_parallax",
    "tracks_range",
    "tracks_outliers",  # for what tracks usually scatter; gated: for the stated noise
    "tracks_gated",
    "points_started",
    "points_used",
    "points_outliers",
    "points_gated",
    "zero_velocity_accepted",
    "zero_velocity_gated",
    "hold_accepted",
    "hold_gated",
    "bias_accepted",
    "bias_gated",
    "bias_invalid",
    "noise_changes",
    "noise_invalid",
    "before_start",
    "too_late",
    "too_early",
    "rewinds",
    "soft_resets",
)
_MOST_ROWS = 6  # of one measurement


def begun(sensing: Sensing, window: Window, start: OwnStart, t_ns: int) -> tuple[Window, Outcome]:
    """Return the window with a sensor's own variables set."""
    out, own, P = Outcome(), window.own.copy(), window.P.copy()
    out.accept(f"{start.sensor}_begun")
    sensing.begin(start, own, P)
    since_ns, watch = {**window.own_since_ns, start.sensor: t_ns}, window.watch.begun(start.sensor, t_ns)
    return replace(window, own=own, P=P, own_since_ns=since_ns, watch=watch), out


def corrected_by_reading(
    sensing: Sensing, window: Window, x: Array, reading: Reading, gyro_rad_s: Array, ago_s: float
) -> tuple[Window, Outcome]:
    """Return the window after a reading that was taken `ago_s` before x [16], which moves in place.

    `ago_s` is 0 unless a frame came between whose stamp is older, by a clock that is behind.
    """
    out, name = Outcome(), reading.sensor
    body = body_of(reading.t_ns, x, gyro_rad_s)
    P, values, at = window.P.copy(), window.own.copy(), sensing.suite.own(name)
    sensing.grow(name, reading.t_ns, window.own_since_ns, values, P)
    own = OwnVariables(values, P, window.own_since_ns)
    rows = sensing.rows(reading, body if ago_s == 0.0 else body.later(-ago_s), own, out)
    if rows is None:
        return window, out
    free = replace(window, own=values, P=P)
    H = np.zeros((len(rows.residual), len(P)))
    H[:, :INERTIAL] = rows.H @ by_now(body, ago_s) @ to_nav_error(x)
    H[:, window.first_own :][:, at] = rows.H_own
    S = H @ P @ H.T + np.eye(len(H))
    nis = float(rows.residual @ np.linalg.solve(S, rows.residual))
    since_ns = {**window.own_since_ns, name: reading.t_ns}
    if sensing.judge(reading, rows, S, nis, out):
        window = corrected(free, x, H, rows.residual)
        return replace(window, own_since_ns=since_ns, watch=window.watch.accepted(name, reading.t_ns, rows.H)), out
    watch, regain = sensing.refuse(window.watch, reading, rows, body, out)
    if regain is None:
        return replace(window, watch=watch), out
    sensing.regained(name, regain, out)
    window = _regained(free, x, body, regain)
    return replace(window, own_since_ns=since_ns, watch=watch.accepted(name, reading.t_ns, rows.H)), out


def _regained(window: Window, x: Array, body: BodyState, regain: Regain) -> Window:
    """Return a window moved by what its body, clones and points are off by; x [16] moves in place.

    As an invariant error has the place turned by the error of rotation in it, the covariance of that moves, too.
    """
    clones, points = range(CLONES, window.first_point, 6), range(window.first_point, window.first_own, 3)
    T, by_turn = np.eye(len(window.P)), skew(regain.place_m)
    T[3:6, 0:3], T[6:9, 0:3] = by_turn, skew(regain.velocity_m_s)
    for at in clones:
        T[at + 3 : at + 6, at : at + 3] = by_turn
    for at in points:
        T[at : at + 3, 0:3] = by_turn
    places = (3, *(at + 3 for at in clones), *points)
    P = T @ grown(window.P, regain, from_nav_error(x), places, body.R_world_body[2]) @ T.T
    x[0:3] += regain.place_m
    x[3:6] += regain.velocity_m_s
    return replace(
        window, P=0.5 * (P + P.T), p=window.p + regain.place_m, velocity=window.velocity + regain.velocity_m_s,
        points=window.points + regain.place_m,
    )  # fmt: skip


def by_now(body: BodyState, ago_s: float) -> Array:
    """Return how the error [15] of the body a moment ago, `body.later(-ago_s)`, hangs on that of now."""
    M = np.eye(INERTIAL)
    M[0:3, 0:3] = so3_exp(body.rate_rad_s * ago_s)
    M[0:3, 9:12] = ago_s * so3_right_jacobian(-body.rate_rad_s * ago_s)
    M[3:6, 6:9] = -ago_s * np.eye(3)
    return M


class KnownUpdater:
    """Applies what is known without an image; the same on the same state gives the same answer."""

    def __init__(self, config: EkfConfig, noise: ImuNoise) -> None:
        """Take the settings, and the noise by which the gyroscope shows rest."""
        self._limits = [chi_square_limit(config.gate_probability, max(k, 1)) for k in range(_MOST_ROWS + 1)]
        self._white_rate_sigma = float(noise.gyroscope_noise_density * np.sqrt(noise.rate_hz))

    def rest(self, window: Window, x: Array, gyro_rad_s: Array, t_ns: int) -> tuple[Window, Outcome]:
        """Use that the body is at rest: no velocity, the gyro shows its bias, the pose is that where rest began."""
        out = Outcome()
        R = pose(x, 0, 6)[:3, :3]
        H = np.zeros((6, len(window.P)))
        H[:3, 6:9] = R.T / ZERO_VELOCITY_SIGMA_M_S
        rate_sigma = max(ZERO_RATE_SIGMA_RAD_S, self._white_rate_sigma * window.noise.gyro)
        H[3:, 9:12] = np.eye(3) / rate_sigma
        r = np.concatenate((-R.T @ x[3:6] / ZERO_VELOCITY_SIGMA_M_S, (gyro_rad_s - x[13:16]) / rate_sigma))
        if not self._passes("zero_velocity", window, H, r, out):
            return replace(window, rest=None), out
        window = replace(corrected(window, x, H, r), rested_t_ns=t_ns, watch=window.watch.seen(t_ns))
        stamps = [frame.t_ns for frame in window.frames]
        if window.rest is not None and window.rest.t_ns in stamps:
            window = self._hold(window, x, stamps.index(window.rest.t_ns), out)
        elif t_ns in stamps:
            R = pose(x, 0, 6)[:3, :3]
            window = replace(window, rest=Rest(t_ns, R, np.eye(3)))
        if window.rest is not None:
            to_first = np.ascontiguousarray(window.rest.R @ pose(x, 0, 6)[:3, :3].T)
            window = replace(window, rest=replace(window.rest, to_first=to_first))
        return window, out

    def _hold(self, window: Window, x: Array, index: int, out: Outcome) -> Window:
        sigmas = np.repeat([np.deg2rad(REST_SIGMA_DEG), REST_SIGMA_M], 3)
        T = pose(x, 0, 6)
        H = np.zeros((6, len(window.P)))
        at = CLONES + 6 * index
        here = np.eye(6)
        here[3:, :3] = -skew(window.p[index])
        H[:, :6] = here / sigmas[:, None]
        H[:, at : at + 6] = -here / sigmas[:, None]
        turned = so3_log(window.R[index] @ np.ascontiguousarray(T[:3, :3].T))
        r = np.concatenate((turned, window.p[index] - T[:3, 3])) / sigmas
        if not self._passes("hold", window, H, r, out):
            return replace(window, rest=None)
        return corrected(window, x, H, r)

    def _passes(self, kind: str, window: Window, H: Array, r: Array, out: Outcome) -> bool:
        S = H @ window.P @ H.T + np.eye(len(r))
        nis = float(r @ np.linalg.solve(S, r))
        accepted = nis <= self._limits[len(r)]
        out.count(f"{kind}_{'accepted' if accepted else 'gated'}")
        if np.isnan(out.nis):
            out.accepted, out.nis = accepted, nis
        if accepted:
            out.test(kind, 1, nis, len(r))
        else:
            out.reason = f"innovation {nis:.1f} of at most {self._limits[len(r)]:.1f}"
        return accepted

    def known_bias(self, window: Window, x: Array, bias: Array) -> tuple[Window, Outcome]:
        """Take biases [12] (gyro, accel, their sigmas) found elsewhere; only the biases move (Schmidt-Kalman)."""
        out = Outcome()
        H = np.zeros((6, len(window.P)))
        H[:, 9:15] = np.diag(1.0 / bias[6:])
        r = np.concatenate((bias[:3] - x[13:16], bias[3:6] - x[10:13])) / bias[6:]
        if not self._passes("bias", window, H, r, out):
            return window, out
        HP = H @ window.P
        S = HP @ H.T + np.eye(6)
        K = np.zeros((len(window.P), 6))
        K[9:15] = np.linalg.solve(S, HP[:, 9:15]).T
        KHP = K @ HP
        P = window.P - KHP - KHP.T + K @ S @ K.T
        return moved(replace(window, P=0.5 * (P + P.T)), x, K @ r), out


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """What the filter found out about the camera; sigmas are 0 where it was not asked to."""

    time_offset_s: float  # to add to a frame's stamp to get the IMU's time
    time_offset_sigma_s: float
    rotation_rad: Array  # [3] rotation vector on the camera side: R_body_cam = R_configured Exp(rotation)
    rotation_sigma_rad: Array  # [3]


@dataclass(slots=True, eq=False)
class TightState:
    """The filter at one instant; the inertial part is changed in place, the window is replaced."""

    inertial: Inertial  # since the last event
    window: Window
    sigmas: Array  # [6] of the IMU, with the noise that goes on now, see `MsckfEkf.follow_noise`

    @property
    def x(self) -> Array:
        """Nominal state [16]."""
        return self.inertial.x

    @property
    def last_vision_t_ns(self) -> int:
        """When tracks last corrected it; the start, before."""
        return self.window.last_vision_t_ns

    @property
    def own(self) -> OwnVariables:
        """The sensors' own variables; views."""
        window, first = self.window, self.window.first_own
        return OwnVariables(window.own, window.P[first:, first:], window.own_since_ns)

    def copy(self) -> TightState:
        """Return a copy that further steps leave alone."""
        return TightState(Inertial(*(part.copy() for part in self.inertial)), self.window, self.sigmas)


class TightCore:
    """Moves and corrects a `TightState`, as `ekf.core.Core` has it."""

    def __init__(self, config: EkfConfig, noise: ImuNoise, gravity_m_s2: float, rig: Rig, suite: Suite | None) -> None:
        self.sensing = Sensing(suite, _COUNTERS)
        self.counters = (*_COUNTERS, *self.sensing.counters)
        self._config = config
        self._gravity = gravity_m_s2
        self._stated_sigmas = imu_sigmas(noise)
        self._frames, self._known = FrameUpdater(config, gravity_m_s2, rig), KnownUpdater(config, noise)
        self._scale_sigmas = rig.cameras[0].sigmas.focal, rig.metres_sigma
        self.R_configured = np.ascontiguousarray(rig.T_body_cams[0][:3, :3], dtype=np.float64)

    def blank(self) -> TightState:
        """Return a state of nothing, before there is one."""
        n, own = CLONES + self.sensing.suite.size, self.sensing.suite.starts
        return self._at(np.zeros(16), Window(np.zeros((n, n)), 0.0, self.R_configured, own=own))

    def begin(self, start: NavState, camera: CameraCalibration | None, noise: NoiseScale) -> TightState:
        """Return the filter at a state. Raises ValueError where that is not finite."""
        config = self._config
        x = nominal(start)
        n, own = CLONES + self.sensing.suite.size, self.sensing.suite.starts
        P = np.zeros((n, n))
        M = kernels.from_nav_error(x)
        P[:15, :15] = M @ (0.5 * (start.covariance + start.covariance.T)) @ M.T
        P[TIME, TIME] = config.tight_time_offset_sigma_s**2
        P[MOUNT, MOUNT] = np.eye(3) * np.deg2rad(config.tight_extrinsic_sigma_deg) ** 2
        P[FOCAL, FOCAL], P[METRES, METRES] = np.square(self._scale_sigmas)
        time_offset_s, R_body_cam = 0.0, self.R_configured
        if camera is not None:
            P[TIME, TIME] = camera.time_offset_sigma_s**2
            P[MOUNT, MOUNT] = np.diag(camera.rotation_sigma_rad**2)
            time_offset_s, R_body_cam = camera.time_offset_s, R_body_cam @ so3_exp(camera.rotation_rad)
        return self._at(
            x,
            Window(
                P,
                time_offset_s,
                R_body_cam,
                last_vision_t_ns=start.t_ns,
                noise=noise,
                own=own,
                watch=Watch(start.t_ns, start.t_ns),
            ),
        )

    def _at(self, x: Array, window: Window) -> TightState:
        return TightState(_since_now(x), window, scaled(self._stated_sigmas, window.noise))

    def time_of(self, event: TightEvent, state: TightState) -> int:
        """Return when an event happened: the stamps of frames and of rest are by the camera's clock."""
        if isinstance(event.measurement, KnownBias | NoiseScale | Reading | OwnStart):
            return event.t_ns
        return event.t_ns + round(state.window.time_offset_s * 1e9)

    def step(self, state: TightState, before: Array, after: Array, dt_s: float) -> None:
        """Move a state by one step between two samples [6]."""
        sample = Step(before, after, dt_s, 0.0)
        kernels.step(state.inertial, sample, state.sigmas, self._gravity, state.window.to_first)

    def run(self, state: TightState, piece: Stretch, track: Array) -> None:
        """Move a state through a stretch; write x[:10] at each sample into `track` [N, 10]."""
        kernels.run(state.inertial, piece, track, state.sigmas, self._gravity, state.window.to_first)

    def covariance(self, state: TightState) -> Array:
        """Return [15, 15] with the error of scale that it cannot know, as `LooseCore` does."""
        x, Phi, Q = state.inertial
        M = kernels.to_nav_error(x)
        P = M @ (Phi @ state.window.P[:15, :15] @ Phi.T + Q) @ M.T
        by_scale = self._config.scale_sigma * x[:6]
        P[3:9, 3:9] += np.outer(by_scale, by_scale)
        return 0.5 * (P + P.T)

    def apply(self, state: TightState, event: TightEvent, gyro_rad_s: Array, ago_s: float) -> Outcome:
        """Correct a state in place by an event that happened `ago_s` before it, while the gyro [3] showed a rate."""
        what = event.measurement
        window = propagated(state.window, state.inertial.Phi, state.inertial.Q)
        state.inertial = _since_now(state.x)
        if isinstance(what, FrameTracks):
            window, outcome = self._frames.see(window, state.x, gyro_rad_s, ago_s, what)
        elif isinstance(what, AtRest):
            window, outcome = self._known.rest(window, state.x, gyro_rad_s, event.t_ns)
        elif isinstance(what, NoiseScale):
            window, outcome = replace(window, noise=what), Outcome(True, counts={"noise_changes": 1})
            state.sigmas = scaled(self._stated_sigmas, what)
        elif isinstance(what, Reading):
            window, outcome = corrected_by_reading(self.sensing, window, state.x, what, gyro_rad_s, ago_s)
        elif isinstance(what, OwnStart):
            window, outcome = begun(self.sensing, window, what, event.t_ns)
        else:
            window, outcome = self._known.known_bias(window, state.x, what.values)
        offset_s = min(max(window.time_offset_s, -_MAX_OFFSET_S), _MAX_OFFSET_S)
        state.window = replace(window, time_offset_s=offset_s)
        return outcome


def _since_now(x: Array) -> Inertial:
    """Return a state to which nothing has happened yet."""
    return Inertial(x, np.eye(INERTIAL), np.zeros((INERTIAL, INERTIAL)))
