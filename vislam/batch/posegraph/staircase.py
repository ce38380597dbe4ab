"""The Riemannian staircase: out of a wrong minimum of SE-Sync's cost through more dimensions, and back.

Where the certificate matrix of a minimum has a negative eigenvalue, its eigenvector, as one more row of all matrices
[R t], is a direction in which the cost falls: poses in d dimensions become ones in d + 1 whose rotations are
orthonormal columns there (Stiefel matrices). From the minimum in that space one goes up again while its certificate
matrix has a negative eigenvalue; where it has none, the semidefinite relaxation is solved, and no poses cost less. The
d directions that most of it lies in then give poses again, from which Newton's method goes to their minimum (Boumal,
"A Riemannian low-rank method for optimization over semidefinite matrices with block-diagonal constraints", 2015;
Rosen, Carlone, Bandeira, Leonard: "SE-Sync", IJRR 2019, algorithms 1 and 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vislam.batch.posegraph.isotropic import IsotropicGraph
from vislam.batch.posegraph.problem import Ids
from vislam.batch.posegraph.symbolic import FACTOR_MAX_BYTES
from vislam.core.messages import Array

_LEVELS = 7  # dimensions added at most: one or two where measurements make sense, five where they are random
_STEPS = 200
_CONVERGED = 1e-13  # of the cost: what a step still promises
_NEAR = 1e-8  # of the cost: where a step promises less, the factor of the step before serves the next ones
_LEAST_DAMPING, _MAX_DAMPING = 1e-10, 1e8  # the least one is for turns that the cost does not see
_HALVINGS = 40  # of the step along an eigenvector


@dataclass(frozen=True, slots=True, eq=False)
class Climb:
    """Where the staircase ended."""

    X: Array  # [N, d, d + 1] at a minimum of the isotropic cost
    rank: int  # dimensions of the highest step
    solved: bool  # the relaxation has its minimum there
    bound: float  # no poses have a lower isotropic cost; 0 where nothing is known
    gradient: float  # of half the cost where the highest step ended


def climb(graph: IsotropicGraph, X: Array, labels: Ids, tolerance: float) -> Climb:
    """Return what the staircase finds from poses [R t], X [N, d, d + 1], whose certificate matrix is not positive.

    `labels` [N] numbers the connected parts. An eigenvalue down to minus `tolerance` counts as zero.
    """
    n, d = len(X), X.shape[1]
    spectrum, rank, gradient, bound, solved = graph.spectrum(X), d, np.inf, 0.0, False
    while not solved and rank < d + _LEVELS and np.isfinite(spectrum.proven):
        if graph.bytes_of(tangent(d, rank + 1)) > FACTOR_MAX_BYTES:
            break
        lifted = _lifted(graph, X, spectrum.direction)
        if lifted is None:
            break
        X, gradient = minimise(graph, lifted)
        rank += 1
        spectrum = graph.spectrum(X)
        bound = max(graph.value(X) - n * d * spectrum.proven, bound)
        solved = spectrum.proven <= max(tolerance, 10.0 * spectrum.rounding)
    return Climb(minimise(graph, _rounded(X, labels))[0], rank, solved, bound, gradient)


def tangent(d: int, r: int) -> int:
    """Return the dimension of tangents at [R t] in r dimensions: of R, which has d orthonormal columns, and of t."""
    return r * d - d * (d + 1) // 2 + r


def _lifted(graph: IsotropicGraph, X: Array, direction: Array) -> Array | None:
    """Return X [N, r, d + 1] with one more row along the direction [N, d + 1], as far as lowers the cost most."""
    n, r, columns = X.shape
    largest = float(np.abs(direction[:, :-1]).max())
    if largest == 0.0:  # the eigenvector was not found
        return None
    flat = np.concatenate([X, np.zeros((n, 1, columns))], axis=1)
    step = np.zeros_like(flat)
    step[:, r] = direction / largest
    best, best_cost, length = None, graph.value(X), 2.0
    for _ in range(_HALVINGS):
        moved = _retracted(flat + length * step)
        cost = graph.value(moved)
        if cost < best_cost:
            best, best_cost = moved, cost
        elif best is not None:
            break
        length *= 0.5
    return best


def minimise(graph: IsotropicGraph, X: Array) -> tuple[Array, float]:
    """Return the minimum that damped Newton steps reach from X [N, r, d + 1], and the norm of the gradient there."""
    r, d = X.shape[1], X.shape[2] - 1
    cost, damping, factor = graph.value(X), _LEAST_DAMPING, graph.factor(tangent(d, r))
    slope = promised = np.inf
    for _ in range(_STEPS):
        basis, force = _basis(X), graph.force(X)
        gradient = np.einsum("nkab,nab->nk", basis, force)
        slope = float(np.linalg.norm(gradient))
        is_ready = r == d and promised <= _NEAR * cost  # by the step before, whose basis turned with the poses
        if not is_ready:
            own, off, scale = graph.curvature(X, force, basis)
            diagonal = np.arange(own.shape[1])
        while True:
            damped = own.copy()
            damped[:, diagonal, diagonal] += damping * scale
            if is_ready or factor.factorise(damped, off):
                step = factor.solve(-gradient)
                promised = -float(np.vdot(gradient, step))
                moved = _retracted(X + np.einsum("nk,nkab->nab", step, basis))
                moved_cost = graph.value(moved)
                if moved_cost <= cost or promised < _CONVERGED * cost:
                    break
            damping, is_ready = 10.0 * damping, False
            if damping > _MAX_DAMPING:
                return X, slope
        if moved_cost <= cost:
            X, cost = moved, moved_cost
        if promised < _CONVERGED * cost:
            break
        damping = max(0.1 * damping, _LEAST_DAMPING)
    return X, slope


def _basis(X: Array) -> Array:
    """Return an orthogonal basis [N, k, r, d + 1] of the tangents at X [N, r, d + 1]."""
    n, r, columns = X.shape
    d = columns - 1
    Y = X[:, :, :d]
    beside = np.linalg.qr(Y, mode="complete")[0][:, :, d:] if r > d else Y[:, :, d:]
    out = np.zeros((n, tangent(d, r), r, columns))
    k = 0
    for a in range(d):
        for b in range(a):
            out[:, k, :, a], out[:, k, :, b] = Y[:, :, b], -Y[:, :, a]
            k += 1
    for a in range(d):
        for b in range(r - d):
            out[:, k, :, a] = beside[:, :, b]
            k += 1
    for a in range(r):
        out[:, k + a, a, d] = 1.0
    return out


def _retracted(X: Array) -> Array:
    """Return X [N, r, d + 1] with the nearest orthonormal columns for those of the rotations.

    Along a tangent, where r = d, rotations stay rotations: I + W has a positive determinant for any W = -W^T.
    """
    d = X.shape[2] - 1
    U, _, Vt = np.linalg.svd(X[:, :, :d], full_matrices=False)
    return np.concatenate([U @ Vt, X[:, :, d:]], axis=2)


def _rounded(X: Array, labels: Ids) -> Array:
    """Return the poses [N, d, d + 1] nearest to X [N, r, d + 1], of each part in the d dimensions it fills most."""
    n, _, columns = X.shape
    d = columns - 1
    out = np.empty((n, d, columns))
    for part in range(int(labels.max()) + 1):
        at = labels == part
        Y = X[at, :, :d]
        axes = np.linalg.eigh(np.einsum("nab,ncb->ac", Y, Y))[1][:, -d:]
        if np.sum(np.linalg.det(axes.T @ Y) < 0.0) > 0.5 * len(Y):
            axes[:, 0] *= -1.0
        U, _, Vt = np.linalg.svd(axes.T @ Y)
        U[:, :, -1] *= np.sign(np.linalg.det(U @ Vt))[:, None]
        out[at, :, :d], out[at, :, d] = U @ Vt, X[at, :, d] @ axes
    return out
