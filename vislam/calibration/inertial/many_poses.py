"""Scale, axes and bias of accelerometer and gyroscope from rests in many poses and the turns between them.

After Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for IMU calibration without external
equipments", ICRA 2014: at rest the calibrated force has the length of gravity whichever way is up; between two rests
the gyroscope must turn one direction of gravity into the other. The length alone leaves a rotation of all axes open;
it is fixed by an upper triangular matrix: the calibrated z axis is the chip's own, y lies in the plane of its y and z.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from vislam.calibration.inertial.tables import Table
from vislam.core.angles import directions
from vislam.core.geometry import tangent_basis
from vislam.core.messages import Array
from vislam.imu.gyro_turns import integrate_gyro

_BLOCK_S = 0.25  # means over so long are independent: longer than what a sensor filters, shorter than a rest
_TRIANGLE = np.triu_indices(3)
_CHI2_PER_DOF = 2.0  # sigmas are widened by misfits that noise hardly explains
_SPHERE = 200  # directions over which the tilt error is averaged


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """One pose held still: means of rate and force, and the sigma of each mean (rms over the axes)."""

    span: slice
    gyro: Array  # [3] rad/s, raw
    accel: Array  # [3] m/s^2, raw
    gyro_sigma: float
    accel_sigma: float
    gyro_density: float  # rad/s/sqrt(Hz), of the white noise seen in it


@dataclass(frozen=True, slots=True, eq=False)
class AccelFit:
    """Accelerometer: `calibrated = matrix @ (raw - bias)`, and how well that is known."""

    matrix: Array  # [3, 3] upper triangular
    bias: Array  # [3] m/s^2
    covariance: Array  # [9, 9] of the triangle by row, then the bias
    residual_m_s2: Array  # [M] length of the calibrated mean minus gravity
    misfit: float  # chi-square per degree of freedom
    tilt_sigma_rad: float  # of the direction of gravity, rms over all directions

    def directions(self, rests: list[Rest]) -> Array:
        """Return the direction of up [M, 3] in calibrated axes at every rest."""
        up = (np.array([rest.accel for rest in rests]) - self.bias) @ self.matrix.T
        return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


@dataclass(frozen=True, slots=True, eq=False)
class GyroFit:
    """Gyroscope, in the axes of the accelerometer: `calibrated = matrix @ (raw - bias)`."""

    matrix: Array  # [3, 3]
    bias: Array  # [3] rad/s
    covariance: Array  # [12, 12] of the matrix by row, then the bias
    residual_rad: Array  # [P] angle between both directions of gravity after each turn
    misfit: float
    turned_rad: Array  # [3] about each raw axis, in all


def rest_of(table: Table, span: slice) -> Rest:
    """Return the means of a pose held still, with sigmas from the scatter of quarter seconds."""
    values = table.values[span]
    length = max(2, round(_BLOCK_S / table.period_s))
    blocks = values[: len(values) // length * length].reshape(-1, length, 6).mean(axis=1)
    variance = blocks.var(axis=0, ddof=1)
    gyro, accel = np.sqrt(variance[:3].mean()), np.sqrt(variance[3:].mean())
    root = np.sqrt(len(values) / length)
    mean = values.mean(axis=0)
    density = float(gyro * np.sqrt(length * table.period_s))
    return Rest(span, mean[:3], mean[3:], float(gyro / root), float(accel / root), density)


def sphere_through(points: Array) -> tuple[Array, float]:
    """Return centre [3] and radius of the sphere that fits points [M, 3] best in the squares of their distances."""
    A = np.column_stack([2.0 * points, np.ones(len(points))])
    found = np.linalg.lstsq(A, np.sum(points**2, axis=1), rcond=None)[0]
    return found[:3], float(np.sqrt(max(found[3] + found[:3] @ found[:3], 0.0)))


def fit_accelerometer(rests: list[Rest], gravity_m_s2: float, scale_only: bool) -> AccelFit:
    """Fit the accelerometer to rests in general directions; `scale_only` leaves the axes as they are."""
    means = np.array([rest.accel for rest in rests])
    sigmas = np.array([rest.accel_sigma for rest in rests])
    sigmas = np.maximum(sigmas, 1e-6 * gravity_m_s2)
    centre, radius = sphere_through(means)
    free = [0, 3, 5] if scale_only else list(range(6))  # of the triangle: its diagonal
    columns = [*free, 6, 7, 8]

    def unpacked(x: Array) -> tuple[Array, Array]:
        matrix = np.zeros((3, 3))
        full = np.zeros(6)
        full[free] = x[:-3]
        matrix[_TRIANGLE] = full
        return matrix, x[-3:]

    def residual(x: Array) -> Array:
        matrix, bias = unpacked(x)
        return np.asarray((np.linalg.norm((means - bias) @ matrix.T, axis=1) - gravity_m_s2) / sigmas)

    def jacobian(x: Array) -> Array:
        matrix, bias = unpacked(x)
        raw = means - bias
        force = raw @ matrix.T
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        by_matrix = up[:, _TRIANGLE[0]] * raw[:, _TRIANGLE[1]]
        return np.asarray(np.hstack([by_matrix[:, free], -up @ matrix]) / sigmas[:, None])

    start = np.concatenate([np.eye(3)[_TRIANGLE][free] * gravity_m_s2 / max(radius, 1e-9), centre])
    found = least_squares(residual, start, jacobian, method="lm")
    freedom = max(len(rests) - len(columns), 1)
    misfit = float(2.0 * found.cost / freedom)
    widened = misfit if misfit > _CHI2_PER_DOF else 1.0
    covariance = np.zeros((9, 9))
    covariance[np.ix_(columns, columns)] = _inverse_information(found.jac) * widened
    matrix, bias = unpacked(found.x)
    tilt = _tilt_sigma(matrix, covariance, gravity_m_s2)
    return AccelFit(matrix, bias, covariance, residual(found.x) * sigmas, misfit, tilt)


def fit_gyroscope(table: Table, rests: list[Rest], accel: AccelFit, gravity_m_s2: float) -> GyroFit | None:
    """Fit the gyroscope to the turns between rests; None when fewer than six turns are free of holes."""
    holes = [piece.stop for piece in table.pieces()]
    pairs = [
        (i, i + 1)
        for i in range(len(rests) - 1)
        if not any(rests[i].span.stop <= hole < rests[i + 1].span.start for hole in holes)
    ]
    if len(pairs) < 6:
        return None
    up = accel.directions(rests)
    first, last = np.array(pairs).T
    begins = np.array([rests[i].span.stop - 1 for i in first])
    ends = np.array([rests[i].span.start for i in last])
    t_s, raw = table.t_s, table.values[:, :3]
    tilt = np.hypot(np.array([rest.accel_sigma for rest in rests]) / gravity_m_s2, accel.tilt_sigma_rad)
    density = float(np.sqrt(np.mean([rest.gyro_density**2 for rest in rests])))
    turn_s = t_s[ends] - t_s[begins]
    sigma = np.sqrt(tilt[first] ** 2 + tilt[last] ** 2 + density**2 * turn_s)
    bases = np.array([tangent_basis(u) for u in up[last]])
    means, mean_sigmas = _bias_of_rests(rests)

    def residual(x: Array) -> Array:
        R = integrate_gyro(t_s, (raw - x[9:]) @ x[:9].reshape(3, 3).T)
        turned = np.einsum("pji,pj->pi", R[begins].transpose(0, 2, 1) @ R[ends], up[first])
        angle = np.einsum("pik,pi->pk", bases, turned - up[last]) / sigma[:, None]
        return np.concatenate([angle.ravel(), (x[9:] - means) / mean_sigmas])

    start = min(
        (np.concatenate([signed.ravel(), means]) for signed in _AXIS_ROTATIONS),
        key=lambda x: float(np.sum(residual(x) ** 2)),
    )
    found = least_squares(residual, start, loss="linear", x_scale="jac")
    freedom = max(2 * len(pairs) - 9, 1)
    angles = residual(found.x)[:-3].reshape(-1, 2)
    misfit = float(np.sum(angles**2) / freedom)
    widened = misfit if misfit > _CHI2_PER_DOF else 1.0
    turned_rad = np.sum([np.abs(np.trapezoid(raw[b : e + 1] - means, t_s[b : e + 1], axis=0)) for b, e in
                         zip(begins, ends, strict=True)], axis=0)  # fmt: skip
    return GyroFit(
        matrix=found.x[:9].reshape(3, 3),
        bias=found.x[9:],
        covariance=_inverse_information(found.jac) * widened,
        residual_rad=np.linalg.norm(angles, axis=1) * sigma,
        misfit=misfit,
        turned_rad=turned_rad,
    )


def _inverse_information(jacobian: Any) -> Array:
    """Return the covariance of a least-squares solution, infinite where the residuals do not determine it."""
    J = np.asarray(jacobian, dtype=np.float64)
    if np.linalg.matrix_rank(J) < J.shape[1]:
        return np.full((J.shape[1], J.shape[1]), np.inf)
    return np.asarray(np.linalg.inv(J.T @ J))


def _bias_of_rests(rests: list[Rest]) -> tuple[Array, Array]:
    """Return mean rate [3] of all rests and its sigma [3], from how the rests differ."""
    rates = np.array([rest.gyro for rest in rests])
    weights = np.array([rest.gyro_sigma for rest in rests])
    weights = 1.0 / np.maximum(weights, 1e-9) ** 2
    mean = weights @ rates / weights.sum()
    misfit = np.maximum(weights @ (rates - mean) ** 2 / (len(rests) - 1), 1.0)
    return mean, np.sqrt(misfit / weights.sum())


def _tilt_sigma(matrix: Array, covariance: Array, gravity_m_s2: float) -> float:
    """Return the sigma of the calibrated direction of gravity, rms over all directions and both axes of tilt."""
    up = directions(_SPHERE)
    raw = up * gravity_m_s2 @ np.linalg.inv(matrix).T
    total = 0.0
    for u, r in zip(up, raw, strict=True):
        J = np.zeros((3, 9))
        J[_TRIANGLE[0], np.arange(6)] = r[_TRIANGLE[1]]
        J[:, 6:] = -matrix
        across = tangent_basis(u).T @ J / gravity_m_s2
        total += float(np.trace(across @ covariance @ across.T))
    return float(np.sqrt(0.5 * total / _SPHERE))


def _axis_rotations() -> list[Array]:
    """Return the 24 ways in which two chips may be soldered to each other."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0.0:
                found.append(R)
    return found


_AXIS_ROTATIONS = _axis_rotations()
