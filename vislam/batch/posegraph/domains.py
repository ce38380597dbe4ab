"""A large pose graph solved by overlapping domains: side by side, and none needs memory for the whole.

Each domain is solved alone, and all are placed as rigid bodies, between which an edge is one of a pose graph again.
Then sweeps follow: every domain takes a Gauss-Newton step with what surrounds its overlap held, and small clusters of
poses move as rigid bodies, for what is bent over many domains. A sweep's motion and that of the step before it are
scaled together to the lowest linearised cost, as in conjugate gradients. Restricted additive Schwarz (Cai, Sarkis, SIAM
J. Sci. Comput. 1999) with rigid motions as coarse space (Nicolaides, SIAM J. Numer. Anal. 1987).

How poses are divided hangs on the graph alone: where the domains are solved, and by how many, changes no byte.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.arithmetic import errors_2d, errors_3d
from vislam.batch.posegraph.clusters import Clusters, RigidMotions, grown
from vislam.batch.posegraph.ordering import adjacency
from vislam.batch.posegraph.plain import part_of, solve
from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.batch.posegraph.solver import Descent, Progress, levenberg_marquardt
from vislam.batch.posegraph.structure import NormalEquations, Structure, adjoints
from vislam.config import PoseGraphConfig
from vislam.core.geometry import invert_many
from vislam.core.jit import njit
from vislam.core.messages import Array

_CLUSTER, _DOMAIN = 16, 8192  # poses
_LAYERS, _OVERLAP = 6, 0.2  # of neighbours around a domain: this count, or until they are this share of it
_START = PoseGraphConfig(iterations=20, tolerance=1e-4)  # of a domain alone; what surrounds it will move it anyway
_SHARES = (1.0, 0.25, 0.0625)  # of a step, tried until one lowers the cost

Arguments = tuple[Any, ...]


class Team(Protocol):
    """Who solves domains: `Alone` here, or the workers of a cluster."""

    def keep(self, make: Callable[..., Any], arguments: Sequence[Arguments]) -> list[Any]:
        """Return what stands for make(*arguments), once for each, which stays with who made it."""
        ...

    def each(self, task: Callable[..., Array], kept: Sequence[Any], arguments: Sequence[Arguments]) -> list[Array]:
        """Return task(kept, *arguments) for each that is kept, in their order."""
        ...


class Alone:
    """Solves one domain after another in this process."""

    def keep(self, make: Callable[..., Any], arguments: Sequence[Arguments]) -> list[Any]:
        """See `Team`."""
        return [make(*a) for a in arguments]

    def each(self, task: Callable[..., Array], kept: Sequence[Any], arguments: Sequence[Arguments]) -> list[Array]:
        """See `Team`."""
        return [task(k, *a) for k, a in zip(kept, arguments, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class _Domain:
    """Poses that are solved together, as who solves them keeps them."""

    structure: Structure  # of the domain, its overlap, and what is held around both
    own: NDArray[np.bool_]  # [n] poses that are of no other domain


def solve_by_domains(
    problem: PoseGraphProblem,
    team: Team,
    *,
    iterations: int,
    tolerance: float,
    start: Array | None = None,
    progress: Progress | None = None,
) -> tuple[Array, Descent]:
    """Return the start, and the optimum near it, of a graph of poses alone.

    `start` [N, d + 1, d + 1]: where to begin; None: with each domain alone. It ends as `levenberg_marquardt` does.
    """
    neighbours = adjacency(len(problem.ids), *np.ascontiguousarray(problem.edges.T))
    cluster = grown(*neighbours, _CLUSTER)
    between = np.ascontiguousarray(cluster[problem.edges].T)
    domain = grown(*adjacency(int(cluster.max(initial=-1)) + 1, *between), _DOMAIN // _CLUSTER)[cluster]
    wholes, parts = _overlapping(problem, domain, neighbours)
    kept, at = team.keep(_domain, parts), [(w, w[own]) for w, (_, own) in zip(wholes, parts, strict=True)]
    del parts  # the team has them
    if start is None:
        start = np.empty_like(problem.poses)
        for (_, own), alone in zip(at, team.each(_solved_alone, kept, [()] * len(kept)), strict=True):
            start[own] = alone
        start = _moved_as_bodies(problem, start, domain, None)
        start = _moved_as_bodies(problem, start, cluster, _START.iterations)

    def stepped(poses: Array) -> Array:
        out = poses.copy()
        of_domains = team.each(_stepped, kept, [(poses[whole],) for whole, _ in at])
        for (_, own), moved in zip(at, of_domains, strict=True):
            out[own] = moved
        return out

    return start, _descend(problem, start, stepped, iterations, tolerance, progress)


def _overlapping(
    problem: PoseGraphProblem, domain: Ids, neighbours: tuple[Ids, Ids]
) -> tuple[list[Ids], list[tuple[PoseGraphProblem, NDArray[np.bool_]]]]:
    """Return the poses (indices) of each part, and the parts: a domain with overlap, and which poses are its own.

    Poses beyond the overlap that edges join to it are in the part too, and fixed.
    """
    order = np.argsort(problem.edges.ravel(), kind="stable") // 2  # edges by the poses that they join
    begins = np.concatenate([[0], np.cumsum(np.bincount(problem.edges.ravel(), minlength=len(problem.ids)))])
    held = np.zeros(len(problem.ids), dtype=np.bool_)
    held[problem.anchors()] = True

    def edges_at(poses: Ids) -> Ids:
        counts = begins[poses + 1] - begins[poses]
        offsets = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
        return np.unique(order[np.repeat(begins[poses], counts) + offsets])

    by_domain = np.argsort(domain, kind="stable")
    at, parts = [], []
    for own in np.split(by_domain, np.cumsum(np.bincount(domain))[:-1]):
        inside = np.sort(_with_layers(*neighbours, own, _LAYERS, int((1.0 + _OVERLAP) * len(own))))
        edges = edges_at(inside)
        poses = np.union1d(inside, problem.edges[edges])
        part = part_of(problem, poses, edges)
        fixed = ~np.isin(poses, inside) | held[poses]
        at.append(poses)
        parts.append((replace(part, fixed=fixed, passed_lines=(), notes=()), np.isin(poses, own)))
    return at, parts


@njit(cache=True, nogil=True)
def _with_layers(begins: Ids, neighbours: Ids, own: Ids, layers: int, enough: int) -> Ids:
    """Return nodes with `layers` of neighbours around them, or as many as make them `enough`."""
    seen, inside = np.zeros(len(begins) - 1, dtype=np.bool_), np.empty(len(begins) - 1, dtype=np.int64)
    begin, count = 0, len(own)
    inside[:count] = own
    seen[own] = True
    for _ in range(layers):
        if count >= enough:
            break
        end = count
        for p in range(begin, end):
            for q in range(begins[inside[p]], begins[inside[p] + 1]):
                if not seen[neighbours[q]]:
                    seen[neighbours[q]] = True
                    inside[count] = neighbours[q]
                    count += 1
        begin = end
    return inside[:count]


def _domain(part: PoseGraphProblem, own: NDArray[np.bool_]) -> _Domain:
    return _Domain(Structure(part, "cholesky"), own)


def _solved_alone(domain: _Domain) -> Array:
    """Return the domain's own poses [m, d + 1, d + 1] by the edges between them, in a frame of their own."""
    part, own = domain.structure.problem, np.flatnonzero(domain.own)
    inside = np.flatnonzero(domain.own[part.edges].all(axis=1))
    return solve(Structure(part_of(part, own, inside), "cholesky"), _START).descent.poses


def _stepped(domain: _Domain, poses: Array) -> Array:
    """Return the domain's own poses [m, d + 1, d + 1] after a step from `poses` [n, d + 1, d + 1] of the whole part."""
    weights = np.ones(len(domain.structure.problem.edges))
    return levenberg_marquardt(domain.structure, poses, weights, iterations=1, tolerance=0.0).poses[domain.own]


def _moved_as_bodies(problem: PoseGraphProblem, poses: Array, body: Ids, iterations: int | None) -> Array:
    """Return poses [N, d + 1, d + 1] of lower cost, each moved with all others of its body [N].

    With T_world_i = T_world_a @ A_i in body a, the error of an edge, Log(Z^-1 T_world_i^-1 T_world_j), is that of an
    edge between bodies with the measurement A_i @ Z @ A_j^-1, carried to the body's side by the adjoint of A_j^-1.
    `iterations`: most of them, from `poses`; None: they are placed by the bodies' edges alone.
    """
    _, first = np.unique(body, return_index=True)
    frames = poses[first]
    A = invert_many(frames[body]) @ poses
    crossing = np.flatnonzero(body[problem.edges[:, 0]] != body[problem.edges[:, 1]])
    i, j = problem.edges[crossing].T
    carried = adjoints(invert_many(A[j]))
    information = carried.transpose(0, 2, 1) @ problem.information[crossing] @ carried
    fixed = np.zeros(len(first), dtype=np.bool_)
    fixed[body[problem.anchors()]] = True
    bodies = PoseGraphProblem(
        problem.dimension, np.arange(len(first)), frames, fixed, np.ascontiguousarray(body[problem.edges[crossing]]),
        A[i] @ problem.measurements[crossing] @ invert_many(A[j]),
        0.5 * (information + information.transpose(0, 2, 1)),
    )  # fmt: skip
    config = _START if iterations is None else replace(_START, start="file", iterations=iterations)
    moved = solve(Structure(bodies), config).descent.poses[body] @ A
    return np.where(fixed[body][:, None, None], poses, moved)


def _descend(
    problem: PoseGraphProblem,
    poses: Array,
    stepped: Callable[[Array], Array],
    iterations: int,
    tolerance: float,
    progress: Progress | None,
) -> Descent:
    """Sweep until the decrease still to come, extrapolated from the last two, is below `tolerance` of the cost."""
    structure, weights = Structure(problem), np.ones(len(problem.edges))
    clusters = Clusters(len(structure.free), structure.ends, _CLUSTER)
    equations = NormalEquations(structure, RigidMotions(clusters, problem.tangent))
    costs, before, last_gain = [problem.chi2(poses)], np.empty((0, *equations.gradient.shape)), 0.0
    converged = not len(structure.free)
    while len(costs) <= iterations and not converged:
        equations.linearise(poses, weights)
        ahead = _motions(poses, stepped(poses))[structure.free]
        if equations.factorise(0.0):
            ahead = ahead + equations.rest(ahead)
        step = _lowest(equations, np.concatenate([ahead[None], before]))
        for share in _SHARES:
            candidate = np.empty_like(poses)
            equations.retract(poses, share * step, candidate)
            cost = problem.chi2(candidate)
            if cost <= costs[-1] * (1.0 + 1e-12):
                break
        else:
            break
        poses, before = candidate, step[None]
        gain = costs[-1] - cost
        costs.append(cost)
        if progress is not None:
            progress(len(costs) - 1, cost)
        rest = gain * min(1.0, gain / last_gain) if last_gain > 0.0 else gain
        converged, last_gain = rest <= tolerance * cost or cost < 1e-12, gain
    return Descent(poses, tuple(costs), converged)


def _lowest(equations: NormalEquations, steps: Array) -> Array:
    """Return the sum of steps [S, n, k], scaled for the lowest linearised cost."""
    products = [equations.product(step) for step in steps]
    normal = np.array([[np.vdot(a, b) for b in products] for a in steps])
    slopes = np.array([np.vdot(equations.gradient, step) for step in steps])
    scales = np.linalg.lstsq(normal, -slopes, rcond=1e-12)[0]
    return np.asarray(np.einsum("s,snk->nk", scales, steps))


def _motions(poses: Array, to: Array) -> Array:
    """Return xi [N, k] with poses @ Exp(xi) = to."""
    n, d = len(poses), poses.shape[1] - 1
    out = np.empty((n, 3 * (d - 1)))
    pairs = np.ascontiguousarray(np.column_stack([np.arange(n), np.arange(n, 2 * n)]))
    same = np.tile(np.eye(d + 1), (n, 1, 1))
    (errors_2d if d == 2 else errors_3d)(pairs, np.concatenate([poses, to]), same, out)
    return out
