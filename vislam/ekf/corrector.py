"""Applies one measurement to the state: linearise, gate, correct; and what to do when the gate keeps saying no."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.config import EkfConfig
from vislam.ekf import kernels
from vislam.ekf.history import Event, Kind, Ledger
from vislam.ekf.measurements import (
    LinearMeasurement,
    absolute_pose,
    biases,
    chi_square_limit,
    on_wheels,
    relative_motion,
    where_rest_began,
    with_shared_error,
    zero_velocity,
)
from vislam.ekf.timeline import REST_PAUSE_NS, reset_sigmas
from vislam.imu import ImuNoise
from vislam.messages import Array, VoMeasurement


class Corrector:
    """Holds settings only: the same event on the same state gives the same answer, however often it is replayed."""

    def __init__(self, config: EkfConfig, noise: ImuNoise, T_body_camera: Array | None) -> None:
        self._config = config
        self._lever = np.zeros(3) if T_body_camera is None else T_body_camera[:3, 3].copy()
        per_sample = config.imu_inflation * noise.gyro_noise_density * np.sqrt(noise.rate_hz)
        self._zero_rate_sigma = max(config.zero_rate_sigma_rad_s, float(per_sample))
        self._limits = [0.0] + [chi_square_limit(config.gate_probability, dof) for dof in range(1, 13)]
        self._axle = np.array(config.axle_m, dtype=np.float64)
        self._reset_sigmas = reset_sigmas(config)
        self._all = np.eye(kernels.ERRORS)
        self._only_biases = np.diag(np.repeat([0.0, 1.0, 0.0], [9, 6, 6]))
        self._not_the_past = np.eye(kernels.ERRORS)  # the body moves as much as its place against the clone
        self._not_the_past[3:6, 18:21] = -np.eye(3)
        self._not_the_past[18:21] = 0.0

    def apply(self, event: Event, x: Array, P: Array, ledger: Ledger, gyro_rad_s: Array) -> Ledger:
        """Apply an event to x [23] and P [21, 21] in place, write its outcome into it, and return the new ledger."""
        event.was_reset, event.accepted, event.nis, event.reason = False, False, float("nan"), ""
        event.degrees = 0
        if event.kind is Kind.KEYFRAME:
            event.outcome, event.accepted = "keyframes", True
            return self._begin_keyframe(event, x, P, ledger)
        if event.kind is Kind.VO:
            return self._apply_vo(event, x, P, ledger)
        if event.kind is Kind.ZERO_VELOCITY:
            return self._apply_rest(event, x, P, ledger, gyro_rad_s)
        if event.kind is Kind.NONHOLONOMIC:
            config = self._config
            floor = None if config.floor_sigma_m is None else (ledger.floor_z_m, config.floor_sigma_m)
            sigma_m_s = config.nonholonomic_sigma_m_s
            self._correct(event, on_wheels(x, gyro_rad_s, self._axle, sigma_m_s, floor), x, P, "nonholonomic")
            return ledger
        assert event.bias is not None
        known = biases(x, event.bias[:3], event.bias[3:6], event.bias[6:])
        self._correct(event, known, x, P, "bias")
        return ledger

    def _begin_keyframe(self, event: Event, x: Array, P: Array, ledger: Ledger) -> Ledger:
        if self._config.vision == "relative":
            rests = ledger.rested_t_ns == event.t_ns
            if rests and ledger.clone_rests:  # it stands where the clone does; a new clone would add its own error
                return replace(ledger, clone_id=event.keyframe_id, shared=None)
            kernels.clone(x, P)
            return replace(ledger, clone_id=event.keyframe_id, shared=np.zeros((6, 6)), clone_rests=rests)
        chained = ledger.T_odom_vo if ledger.vo_t_ns == event.t_ns else None  # vision was lost there: start over
        T_odom_keyframe = kernels.pose(x, 0, 6) if chained is None else chained
        return replace(ledger, clone_id=event.keyframe_id, T_odom_keyframe=T_odom_keyframe)

    def _apply_rest(self, event: Event, x: Array, P: Array, ledger: Ledger, gyro_rad_s: Array) -> Ledger:
        """Use that the body is at rest; once a keyframe was taken at rest, the body is where that one is."""
        config = self._config
        goes_on = ledger.rested_t_ns is not None and event.t_ns - ledger.rested_t_ns <= REST_PAUSE_NS
        holds = ledger.clone_rests and goes_on
        at_rest = zero_velocity(x, gyro_rad_s, config.zero_velocity_sigma_m_s, self._zero_rate_sigma)
        if holds:
            at_rest = where_rest_began(x, at_rest, np.deg2rad(config.rest_sigma_deg), config.rest_sigma_m)
        self._correct(event, at_rest, x, P, "zero_velocity")
        if not event.accepted:
            return replace(ledger, clone_rests=False, rested_t_ns=None)
        return replace(ledger, clone_rests=holds, rested_t_ns=event.t_ns)

    def _apply_vo(self, event: Event, x: Array, P: Array, ledger: Ledger) -> Ledger:
        assert event.vo is not None
        if event.keyframe_id != ledger.clone_id:
            have = "none" if ledger.clone_id is None else f"keyframe {ledger.clone_id}"
            event.outcome = "vo_no_keyframe"
            event.reason = f"relative to keyframe {event.keyframe_id}, but the filter holds {have}"
            return ledger
        config = self._config
        if config.vision == "accumulated":
            return self._apply_accumulated(event, event.vo, x, P, ledger)
        measurement = relative_motion(x, P, event.vo, self._lever, config.vo_inflation)
        if ledger.shared is None:
            self._correct(event, measurement, x, P, "vo")
            return self._after_vo(event, P, ledger)
        white, more, shared = with_shared_error(measurement, config.vo_shared_fraction, ledger.shared)
        widened = P.copy()
        widened[15:, 15:] += more
        self._correct(event, white, x, widened, "vo")
        if event.accepted:
            P[:] = widened
            ledger = replace(ledger, shared=shared)
        return self._after_vo(event, P, ledger)

    def _apply_accumulated(self, event: Event, vo: VoMeasurement, x: Array, P: Array, ledger: Ledger) -> Ledger:
        """Chain the motion to the keyframe's pose, and take the sum for a measured pose in `odom`."""
        if not vo.has_scale or vo.T_keyframe_body is None or ledger.T_odom_keyframe is None:
            event.outcome = "vo_no_scale"
            event.reason = "accumulated vision needs metric motion; use ekf.vision relative, a second camera or depth"
            return ledger
        config = self._config
        T_odom_vo = ledger.T_odom_keyframe @ vo.T_keyframe_body
        chained = absolute_pose(x, T_odom_vo, np.deg2rad(config.accumulated_sigma_deg), config.accumulated_sigma_m)
        self._correct(event, chained, x, P, "vo")
        return self._after_vo(event, P, replace(ledger, T_odom_vo=T_odom_vo, vo_t_ns=event.t_ns))

    def _after_vo(self, event: Event, P: Array, ledger: Ledger) -> Ledger:
        """Count rejections in a row; too many for too long widen the covariance."""
        if event.accepted:
            return replace(ledger, rejects=0, last_vo_t_ns=event.t_ns)
        config = self._config
        since = event.t_ns if ledger.rejects == 0 else ledger.rejects_since_ns
        rejects = ledger.rejects + 1
        if rejects >= config.reset_rejects and event.t_ns - since >= config.reset_s * 1e9:
            P[np.arange(15), np.arange(15)] += self._reset_sigmas**2
            event.was_reset = True
            event.reason += f"; {rejects} in a row, covariance inflated"
            rejects = 0
        return replace(ledger, rejects=rejects, rejects_since_ns=since)

    def _correct(self, event: Event, measurement: LinearMeasurement, x: Array, P: Array, name: str) -> None:
        """Gate and apply. Not everything that the optimal gain would move may move (Schmidt-Kalman).

        Biases that the graph knows move biases only. And a continuous odom: tilt that is learned metres away from the
        origin would swing the body about it. With the gain of the clone's position at zero the past stays where it is,
        and P keeps the uncertainty of it.
        """
        limit, moves = self._limits[len(measurement.residual)], self._all
        if event.kind is Kind.BIAS:
            moves = self._only_biases
        elif event.vo is not None and event.vo.has_scale and self._config.odom == "continuous":
            moves = self._not_the_past
        gate = -1.0 if measurement.impossible else limit
        event.nis = kernels.update(x, P, measurement.H, measurement.noise, measurement.residual, gate, moves)
        event.degrees = len(measurement.residual)
        if measurement.impossible:
            event.outcome, event.reason = f"{name}_opposed", measurement.impossible
        elif not event.nis <= limit:
            event.outcome, event.reason = f"{name}_gated", f"innovation {event.nis:.1f} of at most {limit:.1f}"
        else:
            event.outcome, event.accepted = f"{name}_accepted", True
