"""Applies one measurement to the state: linearise, gate, correct; and what to do when the gate keeps saying no."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vislam.chi_square import chi_square_limit
from vislam.config import EkfConfig
from vislam.ekf import kernels, visual_motion
from vislam.ekf.history import Event, Kind, Ledger
from vislam.ekf.measurements import (
    LinearMeasurement,
    absolute_pose,
    biases,
    on_wheels,
    where_rest_began,
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
        self._white_rate_sigma = float(noise.gyro_noise_density * np.sqrt(noise.rate_hz))
        self._limits = np.array([0.0] + [chi_square_limit(config.gate_probability, dof) for dof in range(1, 13)])
        self._axle = np.array(config.axle_m, dtype=np.float64)
        self._floor_sigma = float(config.floor_sigma_m or 0.0)
        self._vo_variance = float(config.vo_inflation) ** 2
        self._fraction = float(config.vo_shared_fraction)
        self._nothing = np.zeros((6, 6))
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
        if event.kind is Kind.NOISE:
            event.outcome, event.accepted = "noise_changes", True
            return replace(ledger, noise=event.noise)
        if event.kind is Kind.KEYFRAME:
            event.outcome, event.accepted = "keyframes", True
            return self._begin_keyframe(event, x, P, ledger)
        if event.kind is Kind.VO:
            return self._apply_vo(event, x, P, ledger)
        if event.kind is Kind.ZERO_VELOCITY:
            return self._apply_rest(event, x, P, ledger, gyro_rad_s)
        if event.kind is Kind.NONHOLONOMIC:
            sigma_m_s = float(self._config.nonholonomic_sigma_m_s)
            known = on_wheels(x, gyro_rad_s, self._axle, sigma_m_s, ledger.floor_z_m, self._floor_sigma)
            self._correct(event, known, x, P, "nonholonomic")
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
        rate_sigma = max(config.zero_rate_sigma_rad_s, self._white_rate_sigma * ledger.noise.gyro)
        at_rest = zero_velocity(x, gyro_rad_s, float(config.zero_velocity_sigma_m_s), rate_sigma)
        if holds:
            at_rest = where_rest_began(x, at_rest, math.radians(config.rest_sigma_deg), float(config.rest_sigma_m))
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
        assert event.vo.T_keyframe_body is not None
        # a clone that several keyframes share has their errors already
        fraction, already = (0.0, self._nothing) if ledger.shared is None else (self._fraction, ledger.shared)
        event.nis, event.degrees, opposed_m, more = visual_motion.correct(
            x,
            P,
            visual_motion.numbers(event.vo.T_keyframe_body),
            self._vo_variance * visual_motion.numbers(event.vo.covariance),
            event.vo.has_scale,
            self._lever,
            fraction,
            already,
            self._limits,
            self._moves(event),
        )
        self._judge(event, "vo", opposed_m)
        return self._after_vo(event, P, ledger, None if ledger.shared is None else ledger.shared + more)

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
        ledger = replace(ledger, T_odom_vo=T_odom_vo, vo_t_ns=event.t_ns)
        return self._after_vo(event, P, ledger, ledger.shared)

    def _after_vo(self, event: Event, P: Array, ledger: Ledger, shared: Array | None) -> Ledger:
        """Count rejections in a row; too many for too long widen the covariance. `shared`: if it was accepted."""
        if event.accepted:
            return replace(ledger, rejects=0, last_vo_t_ns=event.t_ns, shared=shared)
        config = self._config
        since = event.t_ns if ledger.rejects == 0 else ledger.rejects_since_ns
        rejects = ledger.rejects + 1
        if rejects >= config.reset_rejects and event.t_ns - since >= config.reset_s * 1e9:
            P[np.arange(15), np.arange(15)] += self._reset_sigmas**2
            event.was_reset = True
            event.reason += f"; {rejects} in a row, covariance inflated"
            rejects = 0
        return replace(ledger, rejects=rejects, rejects_since_ns=since)

    def _moves(self, event: Event) -> Array:
        """Return [21, 21] what becomes of the optimal gain: not all that it would move may move (Schmidt-Kalman).

        Biases that the graph knows move biases only. And a continuous odom: tilt that is learned metres away from the
        origin would swing the body about it. With the gain of the clone's position at zero the past stays where it is,
        and P keeps the uncertainty of it.
        """
        if event.kind is Kind.BIAS:
            return self._only_biases
        is_held = event.vo is not None and event.vo.has_scale and self._config.odom == "continuous"
        return self._not_the_past if is_held else self._all

    def _correct(self, event: Event, measurement: LinearMeasurement, x: Array, P: Array, name: str) -> None:
        """Gate and apply a measurement."""
        residual, H, noise = measurement
        event.degrees = len(residual)
        event.nis = kernels.update(x, P, H, noise, residual, self._limits[event.degrees], self._moves(event))
        self._judge(event, name)

    def _judge(self, event: Event, name: str, opposed_m: float = 0.0) -> None:
        """Write down what the gate said."""
        limit = self._limits[event.degrees]
        if opposed_m > 0.0:
            event.outcome, event.reason = f"{name}_opposed", f"moved {opposed_m:.2f} m against the direction seen"
        elif not event.nis <= limit:
            event.outcome, event.reason = f"{name}_gated", f"innovation {event.nis:.1f} of at most {limit:.1f}"
        else:
            event.outcome, event.accepted = f"{name}_accepted", True
