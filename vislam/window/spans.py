"""What lies between keyframes: inertial spans made into links, with honest sigmas where data is missing."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vislam.config import MachineConfig, WindowConfig
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Array, ImuSpan, KeyframePacket, Tracking
from vislam.core.readings import Motion
from vislam.imu import ImuNoise, Preintegrated, preintegrate
from vislam.window.equations import STATE, Links

_REINTEGRATE_GYRO_RAD_S = 0.005  # bias change after which first-order correction is not enough
_REINTEGRATE_ACCEL_M_S2 = 0.05
_ROTATION, _VELOCITY, _POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
_POSES = 12  # errors of two poses
_HEAR_AGAIN_RAD, _HEAR_AGAIN_M = 0.002, 0.01  # a link's change within which its readings stay linear: mm at 1 m/s
_ANY_SPEED_M_S = 10.0  # sigma where vision was lost: among holes, tilt would make it hundreds of metres a second
_DAMP = 1e-18  # on the covariance of a span of one short step, whose position part is nearly singular


class LinkStore:
    """Owns the links of the window, and the spans they came from so that they can be integrated again."""

    def __init__(self, config: WindowConfig, noise: ImuNoise | None, machine: MachineConfig) -> None:
        """Start empty; without `noise` there is no IMU."""
        self._machine = machine
        self._noise = noise
        self._max_gap_s = machine.max_gap_s if noise is None else noise.gap_s(machine.max_gap_s)
        self.gravity_m_s2 = machine.gravity_m_s2
        self._spans: list[ImuSpan | None] = []
        self._motions: list[Sequence[Motion]] = []
        size = config.keyframes + 2
        self._links = Links(
            inertial=np.zeros(size, dtype=np.bool_),
            dt=np.zeros(size),
            dR=np.tile(np.eye(3), (size, 1, 1)),
            dv=np.zeros((size, 3)),
            dp=np.zeros((size, 3)),
            by_imu=np.zeros((size, 9, 12)),
            information=np.zeros((size, 9, 9)),
            bias=np.zeros((size, 6)),
            walk_information=np.zeros((size, 6)),
            guess=np.tile(np.eye(4), (size, 1, 1)),
            guess_weight=np.zeros((size, 2)),
            velocity_weight=np.zeros(size),
            extra=np.zeros(size, dtype=np.bool_),
            extra_H=np.zeros((size, _POSES, _POSES)),
            extra_b=np.zeros((size, _POSES)),
            extra_at=np.zeros((size, 2, STATE)),
            rest_weight=np.zeros(size),
        )

    def __len__(self) -> int:
        """Return the number of links: one less than keyframes."""
        return len(self._spans)

    @property
    def arrays(self) -> Links:
        """The links [n] and rest weights [n + 1] as the kernels take them: views, valid until the next change."""
        n = len(self._spans)
        return Links(*(a[: n + 1] if name == "rest_weight" else a[:n] for name, a in self._links._asdict().items()))

    def usable(self, span: ImuSpan | None) -> bool:
        """Return whether a span can be integrated: there, and without too long an outage."""
        if span is None or len(span.t_ns) < 2 or self._noise is None:
            return False
        return float(self._holes_s(span).sum()) <= self._machine.max_outage_s

    def push(self, packet: KeyframePacket, dt_s: float, bias: Array, guess: Array, motions: Sequence[Motion]) -> bool:
        """Append the link to a new keyframe `dt_s` later; return whether it is inertial.

        `guess` [4, 4] is the motion that is assumed, loosely, where there is no inertial data; `bias` [6] is taken off.
        `motions` is what further sensors say of it, see `hear`.
        """
        k, links, machine = len(self._spans), self._links, self._machine
        inertial = self.usable(packet.imu)
        self._spans.append(packet.imu if inertial else None)
        self._motions.append(motions)
        links.inertial[k], links.dt[k], links.extra[k] = inertial, dt_s, False
        links.guess_weight[k], links.velocity_weight[k], links.rest_weight[k + 1] = 0.0, 0.0, 0.0
        if self._noise is not None:
            walk = np.repeat([self._noise.gyroscope_random_walk, self._noise.accelerometer_random_walk], 3)
            links.walk_information[k] = 1.0 / (np.maximum(walk, 1e-9) ** 2 * dt_s)
        if inertial:
            self.integrate(k, bias)
        else:
            links.guess[k] = guess
            links.guess_weight[k, 0] = 1.0 / (np.deg2rad(machine.lost_rate_sigma_deg_s) * dt_s)
            links.guess_weight[k, 1] = 1.0 / (machine.lost_speed_sigma_m_s * dt_s)
            links.velocity_weight[k] = 1.0 / machine.lost_speed_sigma_m_s
        if packet.at_rest and self._noise is not None:
            links.guess[k] = np.eye(4)
            links.guess_weight[k] = 1.0 / np.deg2rad(machine.rest_sigma_deg), 1.0 / machine.rest_sigma_m
            links.rest_weight[k + 1] = 1.0 / machine.rest_speed_sigma_m_s
        elif packet.vo.tracking is Tracking.LOST and not motions:
            links.rest_weight[k + 1] = 1.0 / _ANY_SPEED_M_S
        return inertial

    def carried(self, x: Array, axes: Array) -> Array:
        """Return the state [21] that the newest link, an inertial one, predicts from the state x [21] before it.

        `axes` [6] are the relative errors of the axes.
        """
        links, k = self.arrays, len(self) - 1
        out, R, dt_s = x.copy(), x[:9].reshape(3, 3), float(links.dt[k])
        fall = np.array([0.0, 0.0, -self.gravity_m_s2])
        turn, dv, dp = np.split(links.by_imu[k, :, 6:] @ axes, 3)
        out[:9] = (R @ links.dR[k] @ so3_exp(turn)).ravel()
        out[9:12] += dt_s * x[12:15] + 0.5 * dt_s**2 * fall + R @ (links.dp[k] + dp)
        out[12:15] += dt_s * fall + R @ (links.dv[k] + dv)
        return out

    def integrate(self, k: int, bias: Array) -> None:
        """Integrate link k at a bias [6]."""
        span = self._spans[k]
        assert span is not None
        result = preintegrate(span, bias[:3], bias[3:], self._noise)
        links = self._links
        links.dR[k], links.dv[k], links.dp[k], links.bias[k] = result.dR, result.dv_m_s, result.dp_m, bias
        links.by_imu[k] = jacobian_by_imu(result)
        links.information[k] = information(result, self._outage(span, result.dt_s))

    def refresh(self, biases: Array) -> None:
        """Integrate again where the biases [n + 1, 6] of the keyframes moved too far for first-order correction."""
        n = len(self._spans)
        moved = np.abs(biases[:n] - self._links.bias[:n])
        far = (moved[:, :3].max(axis=1, initial=0.0) > _REINTEGRATE_GYRO_RAD_S) | (
            moved[:, 3:].max(axis=1, initial=0.0) > _REINTEGRATE_ACCEL_M_S2
        )
        for k in np.flatnonzero(far & self._links.inertial[:n]).tolist():
            self.integrate(k, biases[k])

    def hear(self, X: Array, held: NDArray[np.bool_]) -> None:
        """Linearise motions by further sensors at X [n + 1, 21], unless they are linearised near to it.

        Where the prior holds a state they stay as they were. They are relative, so that both states may move together.

        Own variables are not the window's: they are eliminated link by link, with the sigmas that they came with.
        """
        links = self._links
        for k, motions in enumerate(self._motions):
            if not motions or (links.extra[k] and (held[k : k + 2].any() or _is_near(X[k : k + 2], links.extra_at[k]))):
                continue
            H, b = np.zeros((_POSES, _POSES)), np.zeros(_POSES)
            R_a, R_b = X[k, :9].reshape(3, 3), X[k + 1, :9].reshape(3, 3)
            T_a, T_b = transform(R_a, X[k, 9:12]), transform(R_b, X[k + 1, 9:12])
            for motion in motions:
                r, by_a, by_b, J_own = motion(T_a, T_b)
                J = np.hstack([by_a[:, :3], by_a[:, 3:] @ R_a.T, by_b[:, :3], by_b[:, 3:] @ R_b.T])
                own = np.linalg.solve(np.eye(J_own.shape[1]) + J_own.T @ J_own, J_own.T)
                H += J.T @ (J - J_own @ (own @ J))
                b += J.T @ (r - J_own @ (own @ r))
            links.extra[k], links.extra_H[k], links.extra_b[k] = True, 0.5 * (H + H.T), b
            links.extra_at[k, 0], links.extra_at[k, 1] = X[k], X[k + 1]

    def pop_front(self) -> None:
        """Forget the oldest link, and whether the oldest keyframe was at rest."""
        del self._spans[0], self._motions[0]
        for array in self._links:
            array[:-1] = array[1:].copy()

    def clear(self) -> None:
        """Forget everything."""
        self._spans.clear()
        self._motions.clear()
        self._links.rest_weight[:] = 0.0

    def _holes_s(self, span: ImuSpan) -> Array:
        """Return the lengths [N - 1] of steps that are outages, 0 for the others."""
        steps = np.diff(span.t_ns) * 1e-9
        return np.where(steps > self._max_gap_s, steps, 0.0)

    def _outage(self, span: ImuSpan, duration_s: float) -> Array:
        """Return the covariance [9, 9] that holes add: an unknown constant rate and force inside of each."""
        out = np.zeros((9, 9))
        holes = self._holes_s(span)
        for i in np.flatnonzero(holes).tolist():
            hole = float(holes[i])
            after = duration_s - float(span.t_ns[i + 1] - span.t_ns[0]) * 1e-9
            turned = self._machine.outage_gyro_sigma_rad_s * hole
            pushed = self._machine.outage_accel_sigma_m_s2 * hole
            by_push = np.zeros((9, 3))
            by_push[_VELOCITY], by_push[_POSITION] = np.eye(3), np.eye(3) * (0.5 * hole + after)
            out += pushed**2 * (by_push @ by_push.T)
            # a wrong attitude turns gravity into acceleration from then on; taken in all directions, to be safe
            leak = self.gravity_m_s2 * turned
            out[_ROTATION, _ROTATION] += np.eye(3) * turned**2
            out[_VELOCITY, _VELOCITY] += np.eye(3) * (leak * (0.5 * hole + after)) ** 2
            out[_POSITION, _POSITION] += np.eye(3) * (0.5 * leak * (0.5 * hole + after) ** 2) ** 2
        return out


def _is_near(X: Array, extra_at: Array) -> bool:
    """Return whether two states [2, 21] are turned, and apart, as they were; wherever they are."""
    changed = np.abs(X - extra_at)
    apart = np.abs(np.diff(X[:, 9:12] - extra_at[:, 9:12], axis=0))
    return bool(changed[:, :9].max() < _HEAR_AGAIN_RAD and apart.max() < _HEAR_AGAIN_M)


def jacobian_by_imu(span: Preintegrated) -> Array:
    """Return d(rotation, velocity, position) by gyro and accel bias and by errors of their axes [9, 12]."""
    out = np.zeros((9, 12))
    out[_ROTATION, :3] = span.dR_dgyro
    out[_VELOCITY, :3], out[_VELOCITY, 3:6] = span.dv_dgyro, span.dv_daccel
    out[_POSITION, :3], out[_POSITION, 3:6] = span.dp_dgyro, span.dp_daccel
    out[:, 6:] = span.by_axes
    return out


def information(span: Preintegrated, outage: Array | None = None) -> Array:
    """Return the inverse [9, 9] of a span's covariance, with what an outage [9, 9] adds."""
    P = span.covariance if outage is None else span.covariance + outage
    scale = 1.0 / np.sqrt(np.diag(P) + _DAMP)
    scaled = np.linalg.inv(P * np.outer(scale, scale) + 1e-9 * np.eye(9))
    return 0.5 * (scaled + scaled.T) * np.outer(scale, scale)
