"""The filter of a run: how it starts, and when it hears of what was seen."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from vislam.config import EkfConfig, MachineConfig
from vislam.core.geometry import invert
from vislam.core.messages import (
    AS_MODELLED,
    Array,
    GraphUpdate,
    NavState,
    Observations,
    Tracking,
    VoMeasurement,
    no_observations,
)
from vislam.core.readings import OwnStart, Reading
from vislam.ekf import Ekf, make_ekf
from vislam.ekf.correction import AppliedReading, Correction
from vislam.ekf.tight import MsckfEkf
from vislam.ekf.timeline import UpdateResult
from vislam.imu import ImuNoise, SeenNoise
from vislam.sensors import Suite

if TYPE_CHECKING:  # the fast path must not load OpenCV
    from vislam.core.camera import Rig

_MOST_APPLIED = 4096  # readings of further sensors; only a live run asks for them, many times a second
_TORN = np.array([0.5, 5.0, 3.0, 0.0, 0.0])  # rad, m, m/s: what may have happened meanwhile; biases stay
_LEVEL_RAD = 0.15  # by a few samples of what hands and wheels accelerate
_STAMP_JITTER_NS = 1_000_000  # stamps are regular to less: a delay of two frame intervals is two frames


class Filtering:
    """Owns the filter and what is on its way to it.

    Attributes:
        ekf: the filter.
        coupling: "loose" takes motions of visual odometry, "tight" takes tracks.
    """

    def __init__(
        self, config: EkfConfig, noise: ImuNoise, machine: MachineConfig, rig: Rig, suite: Suite | None = None
    ) -> None:
        """Make the filter that `config.coupling` asks for; `suite`: sensors other than IMU and camera."""
        self.coupling = config.coupling
        self._config = config
        self._has_wheels = machine.slip_sigma_m_s is not None
        self.ekf: Ekf | MsckfEkf = make_ekf(config, noise, machine, rig, suite)
        self._seen: deque[Correction] = deque()  # on its way to the filter
        self._applied: list[Correction] = []  # since they were last taken
        self._torn_to: NavState | None = None  # likewise: where it began again
        self._applied_readings: deque[AppliedReading] = deque(maxlen=_MOST_APPLIED)  # since they were last taken
        self._since_ns = 0  # of when the filter may hear that noise changed
        self._noise_applied = AS_MODELLED

    @property
    def state(self) -> NavState | None:
        """The newest state; None before the first."""
        return self.ekf.state() if self.ekf.initialised else None

    def start(self, state: NavState, vo: VoMeasurement) -> None:
        """Start at a state in the past."""
        self._since_ns = state.t_ns
        self.ekf.initialise(state, vo)

    def tear(self, vo: VoMeasurement, T_odom_body: Array | None = None, known_m2: Array | None = None) -> None:
        """Give up what is known of the motion: before the frame of `vo`, which is lost, an unknown time has passed.

        The pose in `odom` stays, as nothing is known that would move it; or it is `T_odom_body` [4, 4], its place known
        to `known_m2` [3, 3] when it was last seen, of a body that may have any velocity now.
        """
        state = self.ekf.state_at(vo.t_ns)
        if state is None:
            return
        covariance = state.covariance + np.diag(np.repeat(_TORN, 3) ** 2)
        if T_odom_body is not None:  # predicted through a hole, the covariance ties tilt and velocity by nothing real
            R, sigmas = T_odom_body[:3, :3], np.array([_LEVEL_RAD, _LEVEL_RAD, _TORN[0]])
            turn, motion = R.T @ np.diag(sigmas**2) @ R, np.diag(np.repeat(_TORN[1:3], 3) ** 2)
            motion[:3, :3] += 0.0 if known_m2 is None else known_m2
            covariance = block_diag(turn, motion, state.covariance[9:, 9:])
            state = replace(state, T_world_body=T_odom_body, velocity_world_m_s=np.zeros(3))
        self._torn_to = replace(state, covariance=covariance)
        self.ekf.resume(self._torn_to, vo, self.ekf.camera)

    def take_torn(self) -> NavState | None:
        """Return the state from which the filter began again since the last call, None: it goes on."""
        state, self._torn_to = self._torn_to, None
        return state

    def resume(self, state: NavState, vo: VoMeasurement, camera: Array | None) -> None:
        """Start where an earlier run was; `camera` is what its filter had learned, see `camera`."""
        self._since_ns = state.t_ns
        self.ekf.resume(state, vo, camera)

    @property
    def camera(self) -> Array | None:
        """What a tight filter learned of the camera [8]: time offset, its sigma, rotation, its sigmas (s, rad)."""
        return self.ekf.camera

    def see(
        self, t_ns: int, vo: VoMeasurement, observations: Observations, at_rest: bool, keyframe_id: int | None,
        shows_scale: bool, noise: SeenNoise, imu_until_ns: int | None = None,
    ) -> None:  # fmt: skip
        """Take what was seen in a frame and what the IMU's noise is, and give the filter what it is to know by now.

        Inertial samples after `imu_until_ns` are no information.
        """
        if self._config.vision == "none":  # nor that the body rests: a camera has to agree to that
            vo = replace(vo, T_keyframe_body=None, tracking=Tracking.LOST)
            observations, at_rest, keyframe_id = no_observations(), False, None
        on_wheels = self._has_wheels and not at_rest
        is_new, self._noise_applied = noise.scale != self._noise_applied, noise.scale
        changed = replace(noise, t_ns=max(noise.t_ns, self._since_ns)) if is_new else None
        if self.coupling == "tight":  # going back through its tracks is a third of its time and brings nothing
            self._since_ns = t_ns
        others = at_rest, on_wheels, keyframe_id, shows_scale, changed, imu_until_ns
        self._seen.append(Correction(t_ns, vo, observations, *others))
        newest_ns = t_ns - round(self._config.vision_delay_s * 1e9) + _STAMP_JITTER_NS
        while self._seen and self._seen[0].t_ns <= newest_ns:
            correction = self._seen.popleft()
            correction.apply(self.ekf)
            self._applied.append(correction)

    def take_applied(self) -> list[Correction]:
        """Return what was applied to the filter since the last call."""
        applied, self._applied = self._applied, []
        return applied

    def add_reading(self, reading: Reading) -> UpdateResult:
        """Apply a reading of a sensor at once; stamps are by the IMU's clock, and may be late."""
        self._applied_readings.append(AppliedReading(reading.t_ns, reading))
        return self._applied_readings[-1].apply(self.ekf)

    def begin_sensor(self, t_ns: int, start: OwnStart) -> UpdateResult:
        """Give the filter first values of a sensor's own variables, which hold from `t_ns` on."""
        self._applied_readings.append(AppliedReading(t_ns, start))
        return self._applied_readings[-1].apply(self.ekf)

    def take_applied_readings(self) -> list[AppliedReading]:
        """Return what was applied of other sensors since the last call, in that order."""
        applied = list(self._applied_readings)
        self._applied_readings.clear()
        return applied

    def motion(self, from_t_ns: int, to_t_ns: int) -> Array | None:
        """Return T_from_to [4, 4] between two times of the filter's memory; None outside of it."""
        T_from, T_to = self.ekf.pose_at(from_t_ns), self.ekf.pose_at(to_t_ns)
        return None if T_from is None or T_to is None else invert(T_from) @ T_to

    def feed_back(self, update: GraphUpdate) -> None:
        """Let the graph's biases correct the filter's, if the configuration wants that; the pose does not move."""
        newest = update.newest
        if newest is None or not self.ekf.initialised or not self._config.graph_feedback:
            return
        sigmas = np.sqrt(np.diag(newest.covariance))
        self.ekf.feed_back(newest.gyro_bias_rad_s, newest.accel_bias_m_s2, sigmas[9:12], sigmas[12:15])
