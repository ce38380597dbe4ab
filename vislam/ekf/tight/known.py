"""What a moment of rest and biases found elsewhere do to the tight filter. Settings only; the state comes and goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.config import EkfConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import skew, so3_log
from vislam.core.messages import Array
from vislam.ekf.filter_core import REST_SIGMA_DEG, REST_SIGMA_M, ZERO_RATE_SIGMA_RAD_S, ZERO_VELOCITY_SIGMA_M_S
from vislam.ekf.history import Outcome
from vislam.ekf.loose.kernels import pose
from vislam.ekf.tight.state import CLONES, Rest, Window, corrected, moved
from vislam.imu import ImuNoise

_MOST_ROWS = 6  # of one measurement


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
