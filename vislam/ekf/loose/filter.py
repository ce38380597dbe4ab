"""The error-state EKF: a continuous pose at IMU rate in `odom`, corrected by motion relative to a cloned keyframe.

The nominal state is that of Karpov et al. 2026, 16 numbers: position, velocity, quaternion, two biases; the error state
has the 15 degrees of freedom behind them, plus 6 of the clone. Unlike there, visual odometry enters as relative motion:
an accumulated visual pose taken as an absolute one makes the filter certain of its own drift. `vision = "accumulated"`
does that all the same, for comparison: motions are chained from the pose of the filter at the start, and again from its
pose after every loss of vision; where there is no observation the correction is skipped, as the paper has it.
Corrections are those of an invariant filter, which heading and position need to stay consistent (`kernels.correct`).
By default `odom` is continuous: a metric motion corrects where the body is against its keyframe, not where the keyframe
is. With `odom = "corrected"` all that is learned moves the past too: the best estimate, in larger steps. Directions do
so always, for without scale the past is as long as what is learned later makes it.
Measurements may come late and in any order: the filter goes back to their time and runs forward again, so the answer
depends only on the set of measurements, not on when they came.
"""

from __future__ import annotations

from collections.abc import Sequence

from vislam.config import EkfConfig, MachineConfig
from vislam.core.messages import Array, ImuSample, NavState, Observations, Tracking, VoMeasurement
from vislam.ekf.correction import Correction, Hint
from vislam.ekf.history import AtRest, Event
from vislam.ekf.loose.core import LooseCore, LooseMeasurement
from vislam.ekf.loose.measurements import NewKeyframe, OnWheels
from vislam.ekf.loose.state import LooseState
from vislam.ekf.loose.visual_motion import why_unusable
from vislam.ekf.sensed_timeline import SensedTimeline
from vislam.ekf.timeline import UpdateResult
from vislam.imu import ImuNoise, state_at_rest
from vislam.sensors import Suite


class Ekf(SensedTimeline[LooseState, LooseMeasurement]):
    """The timeline with the loose core, and the doors of its measurements.

    Attributes:
        counters: samples and measurements by what became of them, gaps, rewinds and soft resets.
    """

    def __init__(
        self, config: EkfConfig, noise: ImuNoise, machine: MachineConfig, T_body_camera: Array | None = None,
        suite: Suite | None = None,
    ) -> None:  # fmt: skip
        """Set up an uninitialised filter.

        Args:
            config: see `EkfConfig`.
            noise: of the IMU, until `follow_noise` gives what the samples show.
            machine: gravity is down in `odom`; slip, axle and floor are used by `update_nonholonomic`.
            T_body_camera: [4, 4]; its lever arm turns a direction seen by one camera into motion of the body.
                None: camera and IMU coincide. Not used for metric visual odometry.
            suite: sensors other than IMU and camera; None: there are none.
        """
        self._loose = LooseCore(config, noise, machine, T_body_camera, suite)
        super().__init__(self._loose, self._loose.blank(), config.history_s, machine)

    @classmethod
    def at_rest(
        cls, samples: Sequence[ImuSample], noise: ImuNoise, gravity_m_s2: float = 9.81, config: EkfConfig | None = None
    ) -> Ekf:
        """Return a filter that begins at the last of the samples of a body at rest, level and with heading zero.

        Raises DataError where they do not show rest; see `vislam.imu.state_at_rest`.
        """
        ekf = cls.from_state(state_at_rest(samples, noise, gravity_m_s2), noise, gravity_m_s2, config)
        ekf.predict(samples[-1])
        return ekf

    @classmethod
    def from_state(
        cls, state: NavState, noise: ImuNoise, gravity_m_s2: float = 9.81, config: EkfConfig | None = None
    ) -> Ekf:
        """Return a filter that begins in a state; `NavState.with_sigmas` makes one of a pose and sigmas."""
        ekf = cls(config or EkfConfig(), noise, MachineConfig(gravity_m_s2=gravity_m_s2))
        ekf.initialise(state)
        return ekf

    def __repr__(self) -> str:
        inside = self.state() if self.initialised else "not initialised"
        return f"Ekf({self.counters['imu_samples']} inertial samples; {inside})"

    @property
    def position_variance_m2(self) -> float:
        """Of the three axes together, as `state` has it."""
        return self._loose.position_variance_m2(self._state)

    def initialise(self, state: NavState, vo: VoMeasurement | None = None) -> None:
        """Set the state, at any time, and run it through the samples that are already here. Forgets the past.

        Args:
            state: pose in `odom`, with its covariance.
            vo: metric visual motion at the time of `state`. It places the keyframe it refers to, so that the motions
                that follow can be used before there is a new keyframe. Without it the filter waits for `add_keyframe`.

        Raises:
            ValueError: the state is not finite, or its covariance not positive semidefinite.
        """
        usable = vo is not None and vo.has_scale and vo.tracking.sees and not why_unusable(vo)
        self._begin(state.t_ns, self._loose.begin(state, vo if usable else None, self._state.ledger.noise))

    def resume(self, state: NavState, vo: VoMeasurement, camera: Array | None) -> None:
        """Start where an earlier run was; see `initialise`. What that learned of the camera is of no use here."""
        self.initialise(state, vo)

    @property
    def camera(self) -> Array | None:
        """What was learned of the camera: nothing."""
        return None

    def add_keyframe(self, keyframe_id: int, t_ns: int) -> UpdateResult:
        """Clone the pose at `t_ns`: visual motions at later times may refer to this keyframe."""
        return self._insert(Event(t_ns, NewKeyframe(keyframe_id)))

    def update_vo(self, vo: VoMeasurement) -> UpdateResult:
        """Correct the state at the time of a visual motion relative to the cloned keyframe.

        Metric motion corrects six degrees; without scale, rotation and direction; without parallax, rotation. A motion
        that is lost, that refers to another keyframe or that fails the gate is counted and changes nothing.
        """
        if vo.tracking is Tracking.BLIND:
            return UpdateResult(False, float("nan"), "there is no camera")
        if not vo.tracking.sees:
            return self._refuse("vo_lost", "tracking lost")
        reason = why_unusable(vo)
        if reason:
            return self._refuse("vo_invalid", reason)
        return self._insert(Event(vo.t_ns, vo))

    def update_vision(self, vo: VoMeasurement, observations: Observations) -> UpdateResult:
        """Take what vision made of a frame; loosely coupled, its motion counts and its tracks do not."""
        return self.update_vo(vo)

    def correct(self, seen: Correction) -> UpdateResult:
        """Take all of a frame at once; return the answer to its motion."""
        with self.replayed_once():
            answer = self.update_vo(seen.vo)
            if seen.at_rest:
                self.update_zero_velocity(seen.t_ns)
            elif seen.on_wheels:
                self.update_nonholonomic(seen.t_ns)
            if seen.keyframe_id is not None:
                self.add_keyframe(seen.keyframe_id, seen.t_ns)
            return answer

    def hold(self, hint: Hint) -> None:
        """Take what holds the body while the camera sees nothing."""
        (self.update_zero_velocity if hint.at_rest else self.update_nonholonomic)(hint.t_ns)

    def update_zero_velocity(self, t_ns: int) -> UpdateResult:
        """Assume that the body is at rest at `t_ns`: zero velocity, and the gyro shows its bias."""
        return self._insert(Event(t_ns, AtRest()))

    def update_nonholonomic(self, t_ns: int) -> UpdateResult:
        """Assume that a cart's axle goes neither sideways nor up at `t_ns`, and that its floor is level.

        See `machine.slip_sigma_m_s`, `machine.axle_m` and `machine.floor_sigma_m`. Ten times a second is enough: slip
        goes on for a while, and more of the same would be taken for new evidence.
        """
        return self._insert(Event(t_ns, OnWheels()))
