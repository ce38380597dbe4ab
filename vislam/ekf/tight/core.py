"""The core of the tight filter: the inertial state and its error's transition since the last event, and the window."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vislam.config import EkfConfig
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, NavState, NoiseScale
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.filter_core import imu_sigmas, nominal, scaled
from vislam.ekf.history import AtRest, Event, KnownBias, Outcome
from vislam.ekf.loose.kernels import Step
from vislam.ekf.regain import Watch
from vislam.ekf.sensor_rows import OwnVariables, Sensing
from vislam.ekf.stretch import Stretch
from vislam.ekf.tight import kernels
from vislam.ekf.tight.kernels import INERTIAL, Inertial
from vislam.ekf.tight.known import KnownUpdater
from vislam.ekf.tight.own_variables import begun, corrected_by_reading
from vislam.ekf.tight.state import CLONES, FOCAL, METRES, MOUNT, TIME, Window, propagated
from vislam.ekf.tight.tracks import FrameTracks
from vislam.ekf.tight.update import FrameUpdater
from vislam.imu import ImuNoise
from vislam.sensors import Suite

if TYPE_CHECKING:  # the fast path must not load OpenCV
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
        self._told_sigmas = imu_sigmas(config, noise)
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
        if config.tight_time_offset:
            P[TIME, TIME] = config.tight_time_offset_sigma_s**2
        if config.tight_extrinsic_rotation:
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
        return TightState(_since_now(x), window, scaled(self._told_sigmas, window.noise))

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
            state.sigmas = scaled(self._told_sigmas, what)
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
