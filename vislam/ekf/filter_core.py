"""What the timeline asks of a filter's core, and what both cores are made of."""

from typing import Protocol, Self, TypeVar

import numpy as np

from vislam.core.geometry import quaternion_wxyz
from vislam.core.messages import Array, NavState, NoiseScale
from vislam.ekf.history import Event, M, Outcome
from vislam.ekf.sensor_rows import OwnVariables, Sensing
from vislam.ekf.stretch import Stretch
from vislam.imu import ImuNoise

RESET_REJECTS = 5  # this many rejections in a row ...
RESET_S = 1.0  # ... over this long mean that the filter is wrong, not vision: P is inflated, counted
# what such a soft reset adds to the sigmas of the state; the state itself stays
_RESET_ROTATION_DEG = 3.0
_RESET_POSITION_M = 0.3
_RESET_VELOCITY_M_S = 1.0
_RESET_GYRO_BIAS_RAD_S = 0.02
_RESET_ACCEL_BIAS_M_S2 = 0.2
ZERO_VELOCITY_SIGMA_M_S = 0.02  # a vehicle "at rest" still sways
ZERO_RATE_SIGMA_RAD_S = 0.005  # one gyro sample at rest against the bias
REST_SIGMA_M = 0.002  # sway against the pose at which rest began
REST_SIGMA_DEG = 0.05
# what rate and force may have been inside a hole longer than machine.max_gap_s, against their interpolation
_HOLE_GYRO_RAD_S, _HOLE_ACCEL_M_S2 = 0.5, 2.0
REST_PAUSE_NS = 300_000_000  # frames at rest this far apart are of one rest: either looked back on all that is between


class CoreState(Protocol):
    """All that a core estimates."""

    @property
    def x(self) -> Array:
        """Nominal; position, velocity, quaternion, accel bias and gyro bias come first [16]."""
        ...

    @property
    def last_vision_t_ns(self) -> int:
        """When vision last corrected it; the start, before."""
        ...

    @property
    def own(self) -> OwnVariables:
        """What it knows of the sensors' own variables; views."""
        ...

    def copy(self) -> Self:
        """Return a copy that further steps leave alone."""
        ...


S = TypeVar("S", bound=CoreState)
State_contra = TypeVar("State_contra", bound=CoreState, contravariant=True)


class Core(Protocol[State_contra, M]):
    """Steps and corrections of a state. Holds settings only: the same event on the same state gives the same answer."""

    @property
    def counters(self) -> tuple[str, ...]:
        """Every counter that a measurement can end in."""
        ...

    @property
    def sensing(self) -> Sensing:
        """What it does with readings of sensors other than IMU and camera."""
        ...

    def time_of(self, event: Event[M], state: State_contra) -> int:
        """Return when an event happened by the IMU's clock, as far as is known before it is applied."""
        ...

    def step(self, state: State_contra, before: Array, after: Array, dt_s: float) -> None:
        """Move a state in place by one step between two samples [6]."""
        ...

    def run(self, state: State_contra, piece: Stretch, track: Array) -> None:
        """Move a state in place through a stretch of samples; write x[:10] at each into `track` [N, 10]."""
        ...

    def apply(self, state: State_contra, event: Event[M], gyro_rad_s: Array, ago_s: float) -> Outcome:
        """Correct a state in place by an event that happened `ago_s` before it, while the gyro [3] showed a rate."""
        ...

    def covariance(self, state: State_contra) -> Array:
        """Return [15, 15] of a state in the error of `NavState`."""
        ...


def nominal(state: NavState) -> Array:
    """Return x [16] of a state. Raises ValueError where it is not finite."""
    parts = (state.T_world_body, state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2)
    if not all(np.isfinite(part).all() for part in (*parts, state.covariance)):
        raise ValueError(f"the filter cannot start from a state that is not finite (at {state.t_ns} ns)")
    quaternion = quaternion_wxyz(state.T_world_body[:3, :3].copy())
    return np.concatenate([
        state.T_world_body[:3, 3], state.velocity_world_m_s, quaternion, state.accel_bias_m_s2, state.gyro_bias_rad_s
    ])  # fmt: skip


def imu_sigmas(noise: ImuNoise) -> Array:
    """Return what a step takes [6]: densities of gyro and accel, their bias walks, rate and force unseen in a hole."""
    white = [noise.gyroscope_noise_density, noise.accelerometer_noise_density]
    walks = [noise.gyroscope_random_walk, noise.accelerometer_random_walk]
    return np.array([*white, *walks, _HOLE_GYRO_RAD_S, _HOLE_ACCEL_M_S2])


def scaled(sigmas: Array, noise: NoiseScale) -> Array:
    """Return `imu_sigmas` [6] with white noise scaled by `noise`."""
    return sigmas * np.array([*noise, 1.0, 1.0, 1.0, 1.0])


def reset_sigmas() -> Array:
    """Return what a soft reset adds to the sigmas of the state [15]."""
    return np.repeat(
        [
            np.deg2rad(_RESET_ROTATION_DEG),
            _RESET_POSITION_M,
            _RESET_VELOCITY_M_S,
            _RESET_GYRO_BIAS_RAD_S,
            _RESET_ACCEL_BIAS_M_S2,
        ],
        3,
    )
