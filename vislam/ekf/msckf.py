"""The tight filter: tracks of corners correct the inertial state directly, by the poses they were seen from.

A multi-state constraint Kalman filter: past poses are cloned into the state, a track that ends is triangulated over
them and its point projected out, so that its pixels constrain the poses alone (Mourikis and Roumeliotis, ICRA 2007).
Long tracks stay as points in the state (Li and Mourikis, RSS 2012; Geneva et al., "OpenVINS", ICRA 2020). Errors are
right-invariant, which keeps the unobservable directions unobservable (`msckf_kernels`). The time offset of the camera
and its rotation in the body are estimated with the rest (Li and Mourikis, "Online temporal calibration", IJRR 2014).
As in `Ekf`, measurements may come late and in any order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vislam.config import EkfConfig
from vislam.ekf import msckf_kernels as kernels
from vislam.ekf.filter import UpdateResult
from vislam.ekf.kernels import pose
from vislam.ekf.msckf_history import Checkpoint, Event, Kind, TightHistory
from vislam.ekf.msckf_state import MOUNT, TIME, Window, propagated
from vislam.ekf.msckf_tracks import prepare
from vislam.ekf.msckf_update import Outcome, Updater
from vislam.ekf.timeline import bias_measurement, keep_track, pose_between, stretch
from vislam.geometry import quaternion_wxyz, so3_exp, so3_log
from vislam.imu import ImuNoise, ImuSeries
from vislam.messages import Array, ImuSample, NavState, NoiseScale, Observations, Tracking, VoMeasurement

if TYPE_CHECKING:  # the fast path must not load OpenCV
    from vislam.camera import Rig

_NS = 1_000_000_000
_MAX_OFFSET_S = 0.2  # a larger estimate is not a delay but a filter that is lost
_WAITS = "waits for an inertial sample as new"
_COUNTERS = (
    "imu_samples",
    "imu_gaps",
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
    "tracks_gated",
    "points_started",
    "points_used",
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


class MsckfEkf:
    """Owns the state, its covariance and the last seconds of samples and measurements. One thread only.

    Offers what `Ekf` does; times of states are by the IMU's clock, those of frames by the camera's.
    """

    def __init__(self, config: EkfConfig, noise: ImuNoise, gravity_m_s2: float, rig: Rig) -> None:
        """Set up an uninitialised filter.

        Args:
            config: see `EkfConfig`.
            noise: of the IMU, until `follow_noise` tells what the samples show.
            gravity_m_s2: magnitude, down in `odom`.
            rig: cameras; observations may also hold right pixels (two cameras) or depth.
        """
        self._config = config
        self._rig = rig
        self._gravity = float(gravity_m_s2)
        white = [noise.gyro_noise_density, noise.accel_noise_density]
        walks = [noise.gyro_bias_walk, noise.accel_bias_walk]
        self._told_sigmas = np.array([*white, *walks, config.gap_gyro_rad_s, config.gap_accel_m_s2])
        self._updater = Updater(config, noise, self._gravity, rig)
        self._R_configured = np.ascontiguousarray(rig.T_body_cams[0][:3, :3], dtype=np.float64)
        self._checkpoint_ns = round(config.checkpoint_s * _NS)
        self._history_ns = round(config.tight_history_s * _NS)
        self._max_gap_ns = round(config.max_gap_s * _NS)
        self._series = ImuSeries(extra=10)  # beside each sample, x[:10] as of the last run through it
        self._history: TightHistory | None = None
        self._x = np.zeros(16)
        self._Phi = np.eye(kernels.INERTIAL)
        self._Q = np.zeros((kernels.INERTIAL, kernels.INERTIAL))
        self._window = Window(np.zeros((19, 19)), 0.0, self._R_configured)
        self._sigmas = self._told_sigmas  # with the noise that goes on now, see `follow_noise`
        self._t_ns = 0
        self._applied = 0
        self._counts = dict.fromkeys(_COUNTERS, 0)
        self._statistics: dict[str, tuple[int, float, int]] = {}

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
        """Accepted measurements by kind: how many, the sum of their NIS, the sum of their degrees of freedom."""
        return dict(self._statistics)

    @property
    def dead_reckoning_s(self) -> float:
        """Seconds since tracks last corrected the state, or since `initialise`; infinite before."""
        return (self._t_ns - self._window.last_vision_t_ns) / _NS if self.initialised else float("inf")

    @property
    def calibration(self) -> CameraCalibration:
        """The camera's time offset and rotation as estimated so far."""
        window = self._window
        sigmas = np.sqrt(np.maximum(np.diag(window.P), 0.0))
        turned = so3_log(np.ascontiguousarray(self._R_configured.T @ window.R_body_cam))
        return CameraCalibration(window.time_offset_s, float(sigmas[TIME]), turned, sigmas[MOUNT].copy())

    def initialise(
        self, state: NavState, vo: VoMeasurement | None = None, camera: CameraCalibration | None = None
    ) -> None:
        """Set the state, at any time, and run it through the samples that are already here. Forgets the past.

        Args:
            state: pose in `odom`, with its covariance.
            vo: not needed here; tracks begin with the frames that follow.
            camera: what an earlier run found out about the camera; None: what is configured.

        Raises:
            ValueError: the state is not finite.
        """
        parts = (state.T_world_body, state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2)
        if not all(np.isfinite(part).all() for part in (*parts, state.covariance)):
            raise ValueError(f"the filter cannot start from a state that is not finite (at {state.t_ns} ns)")
        x = self._x
        x[0:3], x[3:6] = state.T_world_body[:3, 3], state.velocity_world_m_s
        x[6:10] = quaternion_wxyz(state.T_world_body[:3, :3].copy())
        x[10:13], x[13:16] = state.accel_bias_m_s2, state.gyro_bias_rad_s
        config = self._config
        P = np.zeros((19, 19))
        M = kernels.from_nav_error(x)
        P[:15, :15] = M @ (0.5 * (state.covariance + state.covariance.T)) @ M.T
        if config.tight_time_offset:
            P[TIME, TIME] = config.tight_time_offset_sigma_s**2
        if config.tight_extrinsic_rotation:
            P[MOUNT, MOUNT] = np.eye(3) * np.deg2rad(config.tight_extrinsic_sigma_deg) ** 2
        time_offset_s, R_body_cam = 0.0, self._R_configured
        if camera is not None:
            P[TIME, TIME] = camera.time_offset_sigma_s**2
            P[MOUNT, MOUNT] = np.diag(camera.rotation_sigma_rad**2)
            time_offset_s, R_body_cam = camera.time_offset_s, R_body_cam @ so3_exp(camera.rotation_rad)
        noise = self._window.noise
        self._window = Window(P, time_offset_s, R_body_cam, last_vision_t_ns=state.t_ns, noise=noise)
        self._Phi, self._Q = np.eye(kernels.INERTIAL), np.zeros((kernels.INERTIAL, kernels.INERTIAL))
        self._t_ns, self._applied = state.t_ns, 0
        self._series.extra[:] = np.nan
        self._history = TightHistory(self._snapshot(True))
        self._run()

    def predict(self, sample: ImuSample) -> None:
        """Take a sample and bring the state to its time; one that `ImuSeries` refuses changes nothing but a counter."""
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
        kernels.step(
            self._x, self._Phi, self._Q, values[-2], values[-1], dt_ns * 1e-9, 0.0, self._sigmas, self._gravity,
            self._window.to_first,
        )  # fmt: skip
        self._series.extra[-1] = self._x[:10]
        self._t_ns = sample.t_ns
        if sample.t_ns - history.checkpoints[-1].t_ns >= self._checkpoint_ns:
            self._take_checkpoint()

    def add_keyframe(self, keyframe_id: int, t_ns: int) -> UpdateResult:
        """Count a keyframe; every frame is cloned anyway."""
        self._counts["keyframes"] += 1
        return UpdateResult(True, float("nan"), "")

    def update_vision(self, vo: VoMeasurement, observations: Observations, shows_scale: bool = True) -> UpdateResult:
        """Take the tracks of a frame; its motion only says when it was and whether vision is lost.

        `nis` of the result is that of all rows used, after compression. A frame may use nothing, since tracks are used
        when they end or have been followed through the whole window. No new point is kept in the state while the motion
        does not show scale.
        """
        if vo.tracking is Tracking.LOST:
            return self._refuse("vision_lost", "tracking lost")
        if self._history is not None and self._history.has_frame(vo.t_ns):
            return self._refuse("vision_duplicate", f"a frame of {vo.t_ns} ns is here already")
        frame = prepare(vo.t_ns, observations, self._rig, self._config.tight_readout_s or 0.0, shows_scale)
        if not len(frame.ids):
            return self._refuse("vision_invalid", "no track with finite pixels inside the camera model")
        return self._insert(Event(vo.t_ns, Kind.FRAME, frame=frame))

    def update_zero_velocity(self, t_ns: int) -> UpdateResult:
        """Tell the filter that the body is at rest at a frame: no velocity, and the pose where rest began."""
        return self._insert(Event(t_ns, Kind.REST))

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

        Only the biases move. The graph has used the same images, so give sigmas well above its own.
        """
        bias = bias_measurement(gyro_bias, accel_bias, gyro_sigma, accel_sigma)
        if bias is None:
            return self._refuse("bias_invalid", "biases must be finite and their sigmas positive")
        return self._insert(Event(self._t_ns, Kind.BIAS, bias=bias))

    def state(self) -> NavState:
        """Return the state at the newest sample. Raises ValueError before `initialise`."""
        if self._history is None:
            raise ValueError("the filter has no state yet; call initialise first")
        return self._nav_state(self._t_ns, self._x, self._Phi, self._Q, self._window)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the filtered state at a time within the history, None outside of it."""
        checkpoint = self._history.checkpoint_at(t_ns) if self._history is not None and t_ns <= self._t_ns else None
        if checkpoint is None:
            return None
        x, Phi, Q = checkpoint.x.copy(), checkpoint.Phi.copy(), checkpoint.Q.copy()
        self._integrate(x, Phi, Q, checkpoint.t_ns, t_ns, checkpoint.window)
        return self._nav_state(t_ns, x, Phi, Q, checkpoint.window)

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
        if history.is_too_old(event):
            late_s = (history.checkpoints[0].t_ns - event.t_ns) / _NS
            return self._refuse("too_late", f"{late_s:.3f} s older than the history")
        number = history.insert(event)
        if number < self._applied or event.effective_t_ns(self._window) < self._t_ns:
            self._counts["rewinds"] += 1
            self._restore(history.rewind(number))
        self._run()
        outcome = event.outcome
        if outcome is None:
            return UpdateResult(False, float("nan"), _WAITS)
        return UpdateResult(outcome.accepted, outcome.nis, outcome.reason)

    def _run(self) -> None:
        """Go on from the present state through every sample and event that is here."""
        history = self._history
        newest = self._series.newest_t_ns
        if history is None:
            return
        while (event := history.event(self._applied)) is not None:
            t_ns = event.effective_t_ns(self._window)
            if t_ns > max(newest or 0, self._t_ns):
                break
            self._advance(t_ns)
            self._apply(event, t_ns)
            self._applied += 1
            self._take_checkpoint(after_event=True)
        if newest is not None:
            self._advance(newest)

    def _advance(self, t_ns: int) -> None:
        while self._t_ns < t_ns:
            step_ns = min(t_ns, self._t_ns + self._checkpoint_ns)
            if step_ns < t_ns:  # stop on a sample: stopping between two would change the arithmetic
                step_ns = int(self._series.t_ns[np.searchsorted(self._series.t_ns, step_ns)])
                step_ns = min(step_ns, t_ns)
            self._integrate(self._x, self._Phi, self._Q, self._t_ns, step_ns, self._window, keep=True)
            self._t_ns = step_ns
            if self._history is not None and step_ns - self._history.checkpoints[-1].t_ns >= self._checkpoint_ns:
                self._take_checkpoint()

    def _sigmas_in(self, window: Window) -> Array:
        return self._told_sigmas * np.array([*window.noise, 1.0, 1.0, 1.0, 1.0])

    def _integrate(
        self, x: Array, Phi: Array, Q: Array, t0_ns: int, t1_ns: int, window: Window, keep: bool = False
    ) -> None:
        if t1_ns <= t0_ns:
            return
        piece = stretch(self._series, t0_ns, t1_ns, self._max_gap_ns)
        track = np.empty((len(piece.t_ns), 10))
        kernels.run(
            x, Phi, Q, piece.t_ns, piece.samples, piece.gaps_s, track, self._sigmas_in(window), self._gravity,
            window.to_first,
        )  # fmt: skip
        if keep:
            keep_track(self._series, piece, track)

    def _apply(self, event: Event, t_ns: int) -> None:
        rate = self._series.at(t_ns)[:3] if len(self._series) else np.zeros(3)
        if event.outcome is not None:  # a rerun: what it was counted as before no longer holds
            self._account(event.outcome, -1)
        window = propagated(self._window, self._Phi, self._Q)
        self._Phi, self._Q = np.eye(kernels.INERTIAL), np.zeros((kernels.INERTIAL, kernels.INERTIAL))
        if event.kind is Kind.FRAME:
            assert event.frame is not None
            ago_s = (self._t_ns - t_ns) * 1e-9
            window, outcome = self._updater.see(window, self._x, rate, ago_s, event.frame)
        elif event.kind is Kind.REST:
            window, outcome = self._updater.rest(window, self._x, rate, event.t_ns)
        elif event.kind is Kind.NOISE:
            window, outcome = replace(window, noise=event.noise), Outcome(True, counts={"noise_changes": 1})
            self._sigmas = self._sigmas_in(window)
        else:
            assert event.bias is not None
            window, outcome = self._updater.known_bias(window, self._x, event.bias)
        offset_s = min(max(window.time_offset_s, -_MAX_OFFSET_S), _MAX_OFFSET_S)
        self._window = replace(window, time_offset_s=offset_s)
        event.outcome = outcome
        self._account(outcome, 1)

    def _account(self, outcome: Outcome, sign: int) -> None:
        for name, number in outcome.counts.items():
            self._counts[name] += sign * number
        for kind, (number, nis, dof) in outcome.statistics.items():
            have = self._statistics.get(kind, (0, 0.0, 0))
            self._statistics[kind] = (have[0] + sign * number, have[1] + sign * nis, have[2] + sign * dof)

    def _snapshot(self, after_event: bool) -> Checkpoint:
        inertial = self._x.copy(), self._Phi.copy(), self._Q.copy()
        return Checkpoint(self._t_ns, self._applied, *inertial, self._window, after_event)

    def _take_checkpoint(self, after_event: bool = False) -> None:
        history = self._history
        assert history is not None
        history.checkpoints.append(self._snapshot(after_event))
        if self._t_ns - history.checkpoints[0].t_ns > self._history_ns + 8 * self._checkpoint_ns:
            history.forget_before(self._t_ns - self._history_ns)
            self._series.forget_before(history.checkpoints[0].t_ns)

    def _restore(self, checkpoint: Checkpoint) -> None:
        self._x[:] = checkpoint.x
        self._Phi[:], self._Q[:] = checkpoint.Phi, checkpoint.Q
        self._t_ns, self._applied, self._window = checkpoint.t_ns, checkpoint.applied, checkpoint.window
        self._sigmas = self._sigmas_in(checkpoint.window)

    def _nav_state(self, t_ns: int, x: Array, Phi: Array, Q: Array, window: Window) -> NavState:
        """Return a state with the error of scale that it cannot know, as `Ekf` does."""
        M = kernels.to_nav_error(x)
        P = M @ (Phi @ window.P[:15, :15] @ Phi.T + Q) @ M.T
        by_scale = self._config.scale_sigma * x[:6]
        P[3:9, 3:9] += np.outer(by_scale, by_scale)
        return NavState(
            t_ns=t_ns,
            T_world_body=pose(x, 0, 6),
            velocity_world_m_s=x[3:6].copy(),
            gyro_bias_rad_s=x[13:16].copy(),
            accel_bias_m_s2=x[10:13].copy(),
            covariance=0.5 * (P + P.T),
        )
