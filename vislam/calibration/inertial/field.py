"""Hard and soft iron of a magnetometer: an ellipse in the levelled plane, or an ellipsoid.

A cart that only turns about its vertical shows nothing of the vertical offset: the ellipsoid is then not determined at
all, the ellipse is. Points `m` obey `|A (m - c)| = r`; A is symmetric (a rotation in front of it leaves the length as
it is) with determinant one, so that the field keeps its strength.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from vislam.core.messages import Array

_MAX_LAG = 400  # samples over which residuals are looked at for belonging together


@dataclass(frozen=True, slots=True, eq=False)
class IronFit:
    """Centre [D], shape [D, D] of determinant one and radius in µT of D = 2 or 3 dimensions."""

    centre: Array
    shape: Array
    radius: float
    covariance: Array  # of the upper triangle of shape / radius by row, then the centre
    residual_ut: Array  # [N] of the length
    joined: float  # samples that belong together and count as one

    @property
    def centre_sigma(self) -> Array:
        """Standard deviations [D] of the centre in µT."""
        dimension = len(self.centre)
        return np.sqrt(np.diag(self.covariance)[-dimension:])

    @property
    def direction_sigma_rad(self) -> float:
        """Sigma of a calibrated direction, rms over all of them."""
        dimension = len(self.centre)
        triangle = np.triu_indices(dimension)
        angles = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
        if dimension == 2:
            ways = np.column_stack([np.cos(angles), np.sin(angles)])
        else:
            ways = np.random.default_rng(0).normal(size=(200, 3))
            ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        M = self.shape / self.radius
        total = 0.0
        for way in ways:
            raw = np.linalg.solve(M, way)
            J = np.zeros((dimension, len(triangle[0]) + dimension))
            for k, (i, j) in enumerate(zip(*triangle, strict=True)):
                J[i, k] += raw[j]
                if i != j:
                    J[j, k] += raw[i]
            J[:, len(triangle[0]) :] = -M
            across = (np.eye(dimension) - np.outer(way, way)) @ J
            total += float(np.trace(across @ self.covariance @ across.T)) / (dimension - 1)
        return float(np.sqrt(total / len(ways)))


def fit_iron(points: Array) -> IronFit | None:
    """Fit an ellipse [N, 2] or ellipsoid [N, 3]; None when the points do not lie on one."""
    dimension = points.shape[1]
    triangle = np.triu_indices(dimension)
    start = _algebraic(points)
    if start is None:
        return None
    count = len(triangle[0])

    def unpacked(x: Array) -> tuple[Array, Array]:
        M = np.zeros((dimension, dimension))
        M[triangle] = x[:count]
        return np.triu(M) + np.triu(M, 1).T, x[count:]

    def residual(x: Array) -> Array:
        M, centre = unpacked(x)
        return np.asarray(np.linalg.norm((points - centre) @ M, axis=1) - 1.0)

    found = least_squares(residual, start, x_scale="jac")
    M, centre = unpacked(found.x)
    size = float(np.abs(np.linalg.det(M))) ** (1.0 / dimension)
    if not np.isfinite(found.x).all() or np.linalg.eigvalsh(M).min() <= 0.0:
        return None
    r = residual(found.x)
    J = np.asarray(found.jac, dtype=np.float64)
    if np.linalg.matrix_rank(J) < J.shape[1]:
        return None
    joined = joined_samples(r)
    variance = float(np.sum(r**2)) / max(len(r) / joined - len(found.x), 1.0)
    covariance = np.asarray(np.linalg.inv(J.T @ J) * variance)
    return IronFit(centre, M / size, 1.0 / size, covariance, r / size, joined)


def joined_samples(residual: Array) -> float:
    """Return how many samples in a row belong together, one for white noise, from the autocorrelation."""
    r = residual - residual.mean()
    power = float(r @ r)
    if power == 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, min(_MAX_LAG, len(r) // 4)):
        rho = float(r[lag:] @ r[:-lag]) / power
        if rho < 2.0 / np.sqrt(len(r)):
            break
        total += 2.0 * rho
    return total


def _algebraic(points: Array) -> Array | None:
    """Return a start from the quadric that fits best in the linear sense, None when it is no ellipsoid."""
    dimension = points.shape[1]
    middle, spread = points.mean(axis=0), float(points.std())
    if spread == 0.0:
        return None
    p = (points - middle) / spread
    rows, columns = np.triu_indices(dimension)
    D = np.column_stack([p[:, rows] * p[:, columns] * np.where(rows == columns, 1.0, 2.0), 2.0 * p])
    x = np.linalg.lstsq(D, np.ones(len(p)), rcond=None)[0]
    Q = np.zeros((dimension, dimension))
    Q[rows, columns] = x[: len(rows)]
    Q = np.triu(Q) + np.triu(Q, 1).T
    try:
        centre = -np.linalg.solve(Q, x[len(rows) :])
    except np.linalg.LinAlgError:
        return None
    values, vectors = np.linalg.eigh(Q / (1.0 + centre @ Q @ centre))
    if values.min() <= 0.0:
        return None
    M = vectors @ np.diag(np.sqrt(values)) @ vectors.T / spread
    return np.concatenate([M[rows, columns], centre * spread + middle])
