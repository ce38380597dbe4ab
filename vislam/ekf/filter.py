"""The error-state EKF: a continuous pose at IMU rate in `odom`, corrected by motion relative to a cloned keyframe.

The nominal state is that of Karpov et al. 2026, 16 numbers: position, velocity, quaternion, two biases; the error state
has the 15 degrees of freedom behind them, plus 6 of the clone. Unlike there, visual odometry enters as relative motion:
an accumulated visual pose taken as an absolute one makes the filter certain of its own drift. `vision = "accumulated"`
does that all the same, for comparison: motions are chained from the pose of the filter at the start, and again from its
pose after every loss of vision; where there is no observation the correction is skipped, as the paper has it.
Corrections are those of an invariant filter, which heading and position need to stay consistent (`kernels.correct`).
By default `odom` is continuous: a metric motion corrects where the body is against its keyframe, not where the keyframe
is. With `odom = "corrected"` all that is learned moves the past too: the best estimate, in larger steps. Directions do
so always, for without scale the past is as long as what is learned later says.
Measurements may come late and in any order: the filter goes back to their time and runs forward again, so the answer
depends only on the set of measurements, not on when they came.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from vislam.config import EkfConfig
from vislam.ekf import kernels
from vislam.ekf.corrector import Corrector
from vislam.ekf.history import OUTCOMES, Checkpoint, Event, History, Kind, Ledger, add_nis
from vislam.ekf.timeline import bias_measurement, keep_track, pose_between, stretch
from vislam.ekf.visual_motion import why_unusable
from vislam.geometry import invert, quaternion_wxyz, skew
from vislam.imu import ImuNoise, ImuSeries
from vislam.messages import Array, ImuSample, NavState, NoiseScale, Observations, Tracking, VoMeasurement

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """What the filter did with a measurement; `nis` is NaN where none was computed."""

    accepted: bool
    nis: float
    reason: str


class Ekf:
    """Owns the state, its covariance and the last seconds of samples and measurements. One thread only.

    Until `initialise`, samples are only kept; a state in the past is then brought to the present through them.

    Attributes:
        counters: samples and measurements by what became of them, gaps, rewinds and soft resets.
    """

    def __init__(
        self, config: EkfConfig, noise: ImuNoise, gravity_m_s2: float, T_body_camera: Array | None = None
    ) -> None:
        """Set up an uninitialised filter.

        Args:
            config: see `EkfConfig`.
            noise: of the IMU, until `follow_noise` tells what the samples show.
            gravity_m_s2: magnitude, down in `odom`.
            T_body_camera: [4, 4]; its lever arm turns a direction seen by one camera into motion of the body.
                None: camera and IMU coincide. Not used for metric visual odometry.
        """
        self._config = config
        self._gravity = float(gravity_m_s2)
        white = [noise.gyro_noise_density, noise.accel_noise_density]
        walks = [noise.gyro_bias_walk, noise.accel_bias_walk]
        self._told_sigmas = np.array([*white, *walks, config.gap_gyro_rad_s, config.gap_accel_m_s2])
        self._sigmas = self._told_sigmas  # with the noise that goes on now, see `follow_noise`
        self._corrector = Corrector(config, noise, T_body_camera)
        self._checkpoint_ns = round(config.checkpoint_s * _NS)
        self._history_ns = round(config.history_s * _NS)
        self._max_gap_ns = round(config.max_gap_s * _NS)
        self._series = ImuSeries(extra=10)  # beside each sample, x[:10] as of the last run through it
        self._history: History | None = None
        self._x = np.zeros(kernels.NOMINAL)
        self._P = np.zeros((kernels.ERRORS, kernels.ERRORS))
        self._t_ns = 0
        self._applied = 0
        self._ledger = Ledger()
        self._stops_at_event = False  # see `replayed_once`
        self._counts: dict[str, int] = dict.fromkeys(("imu_samples", "imu_gaps", *OUTCOMES), 0)
        self._nis: dict[str, tuple[int, float, int]] = {}  # of events that the history has forgotten

    @property
    def initialised(self) -> bool:
        """Whether there is a state."""
        return self._history is not None

    @property
    def counters(self) -> dict[str, int]:
        """What came in and what became of it."""
        return {**self._counts, **{f"imu_{reason}": n for reason, n in self._series.refused.items()}}

    @property
    def nis_statistics(self) -> dict[str, tuple[int, float, int]]:
        """Return count, sum of the normalised innovation squared and sum of its degrees of freedom, by measurement.

        Of the measurements that were accepted, each as of the last time it was applied; what the gate refused is in
        `counters`. The second over the third is 1 where the noise that the filter assumes is the true one.
        """
        return add_nis(self._nis, [] if self._history is None else self._history.events)

    @property
    def dead_reckoning_s(self) -> float:
        """Seconds since visual odometry last corrected the state, or since `initialise`; infinite before."""
        return (self._t_ns - self._ledger.last_vo_t_ns) / _NS if self.initialised else float("inf")

    @property
    def position_variance_m2(self) -> float:
        """Of the three axes together, as `state` has it."""
        x, P = self._x, self._P
        far = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
        return float(P[3, 3] + P[4, 4] + P[5, 5] + self._config.scale_sigma**2 * far)

    def initialise(self, state: NavState, vo: VoMeasurement | None = None) -> None:
        """Set the state, at any time, and run it through the samples that are already here. Forgets the past.

        Args:
            state: pose in `odom`, with its covariance.
            vo: metric visual motion at the time of `state`. It places the keyframe it refers to, so that the motions
                that follow can be used before there is a new keyframe. Without it the filter waits for `add_keyframe`.

        Raises:
            ValueError: the state is not finite, or its covariance not positive semidefinite.
        """
        parts = (state.T_world_body, state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2)
        if not all(np.isfinite(part).all() for part in (*parts, state.covariance)):
            raise ValueError(f"the filter cannot start from a state that is not finite (at {state.t_ns} ns)")
        covariance = 0.5 * (state.covariance + state.covariance.T)
        if np.linalg.eigvalsh(covariance)[0] < -1e-6 * np.trace(covariance):
            raise ValueError(f"the filter cannot start from an indefinite covariance (at {state.t_ns} ns)")
        x = self._x
        x[0:3], x[3:6] = state.T_world_body[:3, 3], state.velocity_world_m_s
        x[6:10] = quaternion_wxyz(state.T_world_body[:3, :3].copy())
        x[10:13], x[13:16] = state.accel_bias_m_s2, state.gyro_bias_rad_s
        self._P[:] = 0.0
        self._P[:15, :15] = covariance
        kernels.clone(x, self._P)
        if self._config.vision == "accumulated":
            self._P[15:] = self._P[:, 15:] = 0.0  # no clone: the 16 numbers of the paper
        self._t_ns = state.t_ns
        self._applied = 0
        self._ledger = Ledger(last_vo_t_ns=state.t_ns, floor_z_m=float(x[2]), noise=self._ledger.noise)
        if vo is not None and vo.has_scale and vo.tracking is not Tracking.LOST and not why_unusable(vo):
            self._place_keyframe(vo)
        self._series.extra[:] = np.nan
        self._history = History(self._snapshot())
        self._run()

    def predict(self, sample: ImuSample) -> None:
        """Take a sample and bring the state to its time.

        Samples that are not finite, beyond any sensor, duplicate or backward are counted and change nothing.
        """
        before = self._series.newest_t_ns
        if not self._series.append(sample):
            return
        self._counts["imu_samples"] += 1
        dt_ns = 0 if before is None else sample.t_ns - before
        if dt_ns > self._max_gap_ns:
            self._counts["imu_gaps"] += 1
        history = self._history
        if history is None:
            if sample.t_ns - int(self._series.t_ns[0]) > 2 * self._history_ns:
                self._series.forget_before(sample.t_ns - self._history_ns)
            return
        if before != self._t_ns or dt_ns > self._max_gap_ns or history.event(self._applied) is not None:
            self._run()
            return
        values = self._series.values  # the way of nearly every sample: one step, no measurement on it
        kernels.predict(self._x, self._P, values[-2], values[-1], dt_ns * 1e-9, 0.0, self._sigmas, self._gravity)
        self._series.extra[-1] = self._x[:10]
        self._t_ns = sample.t_ns
        if sample.t_ns - history.checkpoints[-1].t_ns >= self._checkpoint_ns:
            self._take_checkpoint()

    @contextmanager
    def replayed_once(self) -> Iterator[None]:
        """Inside, go no farther than each measurement; what came after them is replayed at the end, once for all."""
        self._stops_at_event = True
        try:
            yield
        finally:
            self._stops_at_event = False
            self._run()

    def add_keyframe(self, keyframe_id: int, t_ns: int) -> UpdateResult:
        """Clone the pose at `t_ns`: visual motions at later times may refer to this keyframe."""
        return self._insert(Event(t_ns, Kind.KEYFRAME, keyframe_id=keyframe_id))

    def update_vo(self, vo: VoMeasurement) -> UpdateResult:
        """Correct the state at the time of a visual motion relative to the cloned keyframe.

        Metric motion corrects six degrees; without scale, rotation and direction; without parallax, rotation. A motion
        that is lost, that refers to another keyframe or that fails the gate is counted and changes nothing.
        """
        if vo.tracking is Tracking.LOST:
            return self._refuse("vo_lost", "tracking lost")
        reason = why_unusable(vo)
        if reason:
            return self._refuse("vo_invalid", reason)
        return self._insert(Event(vo.t_ns, Kind.VO, keyframe_id=vo.keyframe_id, vo=vo))

    def update_vision(self, vo: VoMeasurement, observations: Observations) -> UpdateResult:
        """Take what vision made of a frame; loosely coupled, its motion counts and its tracks do not."""
        return self.update_vo(vo)

    def update_zero_velocity(self, t_ns: int) -> UpdateResult:
        """Tell the filter that the body is at rest at `t_ns`: zero velocity, and the gyro shows its bias."""
        return self._insert(Event(t_ns, Kind.ZERO_VELOCITY))

    def update_nonholonomic(self, t_ns: int) -> UpdateResult:
        """Tell the filter that a cart's axle goes neither sideways nor up at `t_ns`, and that its floor is level.

        See `ekf.nonholonomic_sigma_m_s`, `ekf.axle_m` and `ekf.floor_sigma_m`. Ten times a second is enough: slip goes
        on for a while, and more of the same would be taken for news.
        """
        return self._insert(Event(t_ns, Kind.NONHOLONOMIC))

    def follow_noise(self, t_ns: int, scale: NoiseScale) -> UpdateResult:
        """Take it that white noise is so many times that of the model from `t_ns` on: a ride shakes, a rest not."""
        if not (np.isfinite(scale).all() and min(scale) > 0.0):
            return self._refuse("noise_invalid", "factors on noise must be finite and positive")
        return self._insert(Event(t_ns, Kind.NOISE, noise=scale))

    def feed_back(
        self,
        gyro_bias: Array,
        accel_bias: Array,
        gyro_sigma: float | Array,
        accel_sigma: float | Array,
    ) -> UpdateResult:
        """Take biases [3] (rad/s, m/s^2) that the graph found, as soft measurements at the present time.

        Only the biases move: pose and velocity stay, now and when late measurements are replayed. The graph has used
        the same images, so give sigmas well above its own.
        """
        bias = bias_measurement(gyro_bias, accel_bias, gyro_sigma, accel_sigma)
        if bias is None:
            return self._refuse("bias_invalid", "biases must be finite and their sigmas positive")
        return self._insert(Event(self._t_ns, Kind.BIAS, bias=bias))

    def state(self) -> NavState:
        """Return the state at the newest sample. Raises ValueError before `initialise`."""
        if self._history is None:
            raise ValueError("the filter has no state yet; call initialise first")
        return self._nav_state(self._t_ns, self._x, self._P)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the filtered state at a time within the history, None outside of it."""
        checkpoint = self._history.checkpoint_at(t_ns) if self._history is not None and t_ns <= self._t_ns else None
        if checkpoint is None:
            return None
        x, P = checkpoint.x.copy(), checkpoint.P.copy()
        self._integrate(x, P, checkpoint.t_ns, t_ns, self._sigmas_in(checkpoint.ledger))
        return self._nav_state(t_ns, x, P)

    def pose_at(self, t_ns: int) -> Array | None:
        """Return T_odom_body [4, 4] at a time within the history, interpolated; None outside of it."""
        if self._history is None or t_ns > self._t_ns:
            return None
        checkpoint = self._history.checkpoint_at(t_ns)
        return None if checkpoint is None else pose_between(self._series, self._x, checkpoint, t_ns)

    def _refuse(self, counter: str, reason: str) -> UpdateResult:
        self._counts[counter] += 1
        return UpdateResult(False, float("nan"), reason)

    def _insert(self, event: Event) -> UpdateResult:
        history = self._history
        if history is None:
            return self._refuse("before_start", "the filter has no state yet")
        oldest = history.checkpoints[0].t_ns
        if event.t_ns < oldest:
            return self._refuse("too_late", f"{(oldest - event.t_ns) / _NS:.3f} s older than the history")
        newest = max(self._series.newest_t_ns or oldest, self._t_ns)
        if event.t_ns - newest > self._history_ns:
            return self._refuse("too_early", f"{(event.t_ns - newest) / _NS:.3f} s ahead of the newest inertial sample")
        number = history.insert(event)
        if event.t_ns > self._t_ns:  # a sample as new has to come first
            return UpdateResult(False, event.nis, event.reason)
        if event.t_ns < self._t_ns or number < self._applied:
            self._counts["rewinds"] += 1
            self._restore(history.rewind(number, event.t_ns))
        self._run(event.t_ns if self._stops_at_event else None)
        return UpdateResult(event.accepted, event.nis, event.reason)

    def _run(self, until_ns: int | None = None) -> None:
        """Go on from the present state through every sample and event that is here, or until a time."""
        history = self._history
        newest = self._series.newest_t_ns if until_ns is None else until_ns
        if history is None:
            return
        while (event := history.event(self._applied)) is not None and event.t_ns <= max(newest or 0, self._t_ns):
            self._advance(event.t_ns)
            self._apply(event)
            self._applied += 1
            self._take_checkpoint()
        if newest is not None:
            self._advance(newest)

    def _advance(self, t_ns: int) -> None:
        while self._t_ns < t_ns:
            step_ns = min(t_ns, self._t_ns + self._checkpoint_ns)
            if step_ns < t_ns:  # stop on a sample: stopping between two would change the arithmetic
                step_ns = int(self._series.t_ns[np.searchsorted(self._series.t_ns, step_ns)])
                step_ns = min(step_ns, t_ns)
            self._integrate(self._x, self._P, self._t_ns, step_ns, self._sigmas, keep=True)
            self._t_ns = step_ns
            if self._history is not None and step_ns - self._history.checkpoints[-1].t_ns >= self._checkpoint_ns:
                self._take_checkpoint()

    def _sigmas_in(self, ledger: Ledger) -> Array:
        return self._told_sigmas * np.array([*ledger.noise, 1.0, 1.0, 1.0, 1.0])

    def _integrate(self, x: Array, P: Array, t0_ns: int, t1_ns: int, sigmas: Array, keep: bool = False) -> None:
        if t1_ns <= t0_ns:
            return
        piece = stretch(self._series, t0_ns, t1_ns, self._max_gap_ns)
        track = np.empty((len(piece.t_ns), 10))
        kernels.predict_run(x, P, piece.t_ns, piece.samples, piece.gaps_s, track, sigmas, self._gravity)
        if keep:
            keep_track(self._series, piece, track)

    def _apply(self, event: Event) -> None:
        rate = self._series.at(event.t_ns)[:3] if len(self._series) else np.zeros(3)
        if event.outcome:  # a rerun: what it was counted as before no longer holds
            self._counts[event.outcome] -= 1
            self._counts["soft_resets"] -= event.was_reset
        self._ledger = self._corrector.apply(event, self._x, self._P, self._ledger, rate)
        if event.kind is Kind.NOISE:
            self._sigmas = self._sigmas_in(self._ledger)
        self._counts[event.outcome] += 1
        self._counts["soft_resets"] += event.was_reset

    def _place_keyframe(self, vo: VoMeasurement) -> None:
        """Put the clone where `vo` says its keyframe is, with the uncertainty of the body and of `vo`."""
        assert vo.T_keyframe_body is not None
        T_body = kernels.pose(self._x, 0, 6)
        T_body_keyframe = invert(vo.T_keyframe_body)
        T_keyframe = T_body @ T_body_keyframe
        self._ledger = replace(self._ledger, clone_id=vo.keyframe_id, T_odom_keyframe=T_keyframe)
        if self._config.vision == "accumulated":
            return
        R_body = T_body[:3, :3]
        J = np.eye(6)
        J[:3, :3] = vo.T_keyframe_body[:3, :3]
        J[3:, :3] = -R_body @ skew(T_body_keyframe[:3, 3].copy())
        to_world = np.eye(6)
        to_world[3:, 3:] = R_body
        JM = J @ to_world
        noise = self._config.vo_inflation**2 * (JM @ vo.covariance @ JM.T)
        self._x[16:19] = T_keyframe[:3, 3]
        self._x[19:23] = quaternion_wxyz(T_keyframe[:3, :3].copy())
        P = self._P
        P[15:, :15] = J @ P[0:6, :15]
        P[:15, 15:] = P[15:, :15].T
        P[15:, 15:] = J @ P[0:6, 0:6] @ J.T + noise
        kernels.symmetrise(P)

    def _snapshot(self) -> Checkpoint:
        return Checkpoint(self._t_ns, self._applied, self._x.copy(), self._P.copy(), self._ledger)

    def _take_checkpoint(self) -> None:
        history = self._history
        assert history is not None
        history.checkpoints.append(self._snapshot())
        if self._t_ns - history.checkpoints[0].t_ns > self._history_ns + 8 * self._checkpoint_ns:
            self._nis = add_nis(self._nis, history.forget_before(self._t_ns - self._history_ns))
            self._series.forget_before(history.checkpoints[0].t_ns)

    def _restore(self, checkpoint: Checkpoint) -> None:
        self._x[:] = checkpoint.x
        self._P[:] = checkpoint.P
        self._t_ns, self._applied, self._ledger = checkpoint.t_ns, checkpoint.applied, checkpoint.ledger
        self._sigmas = self._sigmas_in(checkpoint.ledger)

    def _nav_state(self, t_ns: int, x: Array, P: Array) -> NavState:
        """Return a state with the error of scale that vision cannot see: it stretches the whole way from the origin.

        That is what a considered (Schmidt) parameter without gain adds to P. Its influence need not be propagated:
        positions and velocities are as much too long as vision's metres are, rotations and biases are not touched.
        """
        covariance = P[:15, :15].copy()
        if self._config.scale_sigma > 0.0:  # asked at the rate of the IMU
            by_scale = self._config.scale_sigma * x[:6]
            covariance[3:9, 3:9] += np.outer(by_scale, by_scale)
        return NavState(
            t_ns=t_ns,
            T_world_body=kernels.pose(x, 0, 6),
            velocity_world_m_s=x[3:6].copy(),
            gyro_bias_rad_s=x[13:16].copy(),
            accel_bias_m_s2=x[10:13].copy(),
            covariance=covariance,
        )
