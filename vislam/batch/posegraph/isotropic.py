"""SE-Sync's cost of a pose graph, its derivatives, and the eigenvalue that proves a minimum to be the global one.

With X_i = [R_i t_i] and a measurement Z, the cost is f(X) = sum over edges of |(X_j - X_i Z) D^(1/2)|^2_F, where D is
kappa for the columns of the rotation and tau for the translation: a quadratic form tr(X M X^T) of the poses' matrices.
Lagrange's multipliers of the rotations are symmetric blocks L_i = sym(R_i^T (X M)_i). If S = M - diag(L_i, 0) is
positive semidefinite, then for any other poses Y f(Y) = tr(Y S Y^T) + tr(L) >= tr(L) = f(X), so X is the global
minimum (Rosen, Carlone, Bandeira, Leonard: "SE-Sync", IJRR 2019, theorem 4). With S >= -eta on the rotations, which
the Cholesky factorisation of S + eta decides, no n poses in d dimensions cost less than f(X) - n d eta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

from vislam.batch.posegraph.cholesky import Factor
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.symbolic import analyse
from vislam.core.messages import Array

_ROUNDING = 1e-13  # of the largest entry: below, a pivot of the factorisation may be negative by rounding alone
_LANCZOS_TOLERANCE = 1e-6
_SPECTRUM = 2  # eigenvalues beyond those that are zero at a minimum


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """The low end of the spectrum of the certificate matrix, translations eliminated."""

    least: float  # by Lanczos; at the global minimum zero but for rounding
    gap: float  # the first beyond the d zeros that every minimum has: how far it is from being ambiguous
    proven: float  # eta: no eigenvalue is below -eta; infinite where edges leave translations free
    rounding: float  # below, eigenvalues mean nothing
    direction: Array  # [N, d + 1] eigenvector of the least one, with the translations that go with it


class IsotropicGraph:
    """The quadratic form of a problem's edges with weights kappa [E] and tau [E]."""

    def __init__(self, problem: PoseGraphProblem, kappa: Array, tau: Array) -> None:
        """Analyse the graph; nothing depends on poses yet."""
        n, m, d = len(problem.ids), len(problem.edges), problem.dimension
        self._d, self._edges, self._Z = d, problem.edges, problem.measurements
        self._D = np.column_stack([kappa] * d + [tau])
        ends = np.arange(m)
        self._from = csr_array((np.ones(m), (self._edges[:, 0], ends)), shape=(n, m))
        self._to = csr_array((np.ones(m), (self._edges[:, 1], ends)), shape=(n, m))
        ZD = self._Z * self._D[:, None, :]
        inner = np.asarray(self._from @ (ZD @ self._Z.transpose(0, 2, 1)).reshape(m, (d + 1) ** 2))
        self._diagonal = inner.reshape(n, d + 1, d + 1)  # of M
        self._diagonal[:, range(d + 1), range(d + 1)] += self._to @ self._D
        self._off = -ZD
        self._symbolic = analyse(n, *np.ascontiguousarray(self._edges.T))
        _, self._pinned = np.unique(problem.components(), return_index=True)  # one pose of each part

    def value(self, X: Array) -> float:
        """Return the cost of X [N, r, d + 1], the matrices [R t] of poses in r >= d dimensions."""
        return float(np.einsum("eab,eab,eb->", E := self._residuals(X), E, self._D))

    def spectrum(self, X: Array) -> Spectrum:
        """Return the low end of the spectrum of the certificate matrix at X [N, r, d + 1]."""
        d, n = self._d, len(X)
        S = self._certificate(X, self.force(X))
        scale = float(np.abs(S[:, range(d), range(d)]).max())
        S[self._pinned, d, d] *= 2.0  # holds the translation of each part; costs nothing, as S does not see it
        rounding = _ROUNDING * scale
        if not 0.0 < scale < np.inf:  # no edge knows a rotation, or one knows it beyond what numbers hold
            return Spectrum(np.nan, np.nan, np.inf, 0.0, np.zeros((n, d + 1)))
        factor, eta = Factor(self._symbolic, d + 1), rounding
        off = self._placed(self._off)
        while not factor.factorise(_shifted(S, eta, d), off):
            eta *= 10.0
            if eta > 1e3 * scale:
                return Spectrum(np.nan, np.nan, np.inf, rounding, np.zeros((n, d + 1)))

        def solved(v: Array) -> Array:
            rhs = np.zeros((n, d + 1))
            rhs[:, :d] = v.reshape(n, d)
            return factor.solve(rhs)

        start = np.random.default_rng(0).normal(size=n * d)
        wanted = min(d + _SPECTRUM, n * d - 1)
        operator = LinearOperator((n * d, n * d), matvec=lambda v: solved(v)[:, :d].ravel(), dtype=np.float64)
        try:
            found, vectors = eigsh(operator, k=wanted, which="LA", v0=start, tol=_LANCZOS_TOLERANCE)
        except ArpackError:  # eta is proven all the same
            return Spectrum(np.nan, np.nan, eta, rounding, np.zeros((n, d + 1)))
        order = np.argsort(1.0 / found)
        eigenvalues = 1.0 / found[order] - eta
        gap = float(eigenvalues[min(d, wanted - 1)])
        return Spectrum(float(eigenvalues[0]), gap, eta, rounding, solved(vectors[:, order[0]]))

    def force(self, X: Array) -> Array:
        """Return X M in blocks [N, r, d + 1]: half the derivative of the cost by the matrices X [N, r, d + 1]."""
        E = self._residuals(X) * self._D[:, None, :]
        back, width = E @ self._Z.transpose(0, 2, 1), X.shape[1] * X.shape[2]
        flat = np.asarray(self._to @ E.reshape(len(E), width) - self._from @ back.reshape(len(E), width))
        return flat.reshape(X.shape)

    def curvature(self, X: Array, force: Array, basis: Array) -> tuple[Array, Array, Array]:
        """Return half the Hessian at X [N, r, d + 1] along a basis [N, k, r, d + 1] of the tangents of each pose.

        Blocks of poses [N, k, k] and of edges [E, k, k] as `Factor` takes them, one pose of each part held, and the
        diagonal [N, k] of the form M alone, which is positive.
        """
        n, k = basis.shape[:2]
        flat = basis.reshape(n, k, -1)
        plain = (basis @ self._diagonal[:, None]).reshape(n, k, -1) @ flat.transpose(0, 2, 1)
        multiplied = basis.copy()
        multiplied[..., : self._d] = basis[..., : self._d] @ self._multipliers(X, force)[:, None]
        multiplied[..., self._d] = 0.0
        own = plain - multiplied.reshape(n, k, -1) @ flat.transpose(0, 2, 1)
        own[self._pinned] += plain[self._pinned]
        start, end = basis[self._edges[:, 0]], flat[self._edges[:, 1]]
        off = (start @ self._off[:, None]).reshape(end.shape) @ end.transpose(0, 2, 1)
        return np.ascontiguousarray(own), self._placed(off), np.einsum("nkk->nk", plain)

    def factor(self, k: int) -> Factor:
        """Return an empty factor with blocks of k numbers per pose."""
        return Factor(self._symbolic, k)

    def bytes_of(self, k: int) -> int:
        """Memory that a factor with blocks of k numbers per pose takes."""
        return self._symbolic.bytes(k)

    def _residuals(self, X: Array) -> Array:
        """Return X_j - X_i Z [E, r, d + 1]."""
        out = X[self._edges[:, 1]]
        out -= X[self._edges[:, 0]] @ self._Z
        return out

    def _multipliers(self, X: Array, force: Array) -> Array:
        L = X[:, :, : self._d].transpose(0, 2, 1) @ force[:, :, : self._d]
        return 0.5 * (L + L.transpose(0, 2, 1))

    def _certificate(self, X: Array, force: Array) -> Array:
        """Return the diagonal blocks [N, d + 1, d + 1] of the certificate matrix at X [N, r, d + 1]."""
        S = self._diagonal.copy()
        S[:, : self._d, : self._d] -= self._multipliers(X, force)
        return S

    def _placed(self, off: Array) -> Array:
        """Return blocks (from, to) as `Factor` takes them."""
        swapped = np.where(self._symbolic.later_is_to[:, None, None], off, off.transpose(0, 2, 1))
        return np.ascontiguousarray(swapped)


def _shifted(S: Array, eta: float, d: int) -> Array:
    out = S.copy()
    out[:, range(d), range(d)] += eta
    return out
