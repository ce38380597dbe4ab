"""Poses brought onto their priors: a start that relative poses alone gave may lie anywhere in the world."""

from __future__ import annotations

import numpy as np

from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.core.messages import Array


def onto_priors(problem: PoseGraphProblem, poses: Array) -> Array:
    """Return poses [N, d + 1, d + 1], each part that only priors hold turned and shifted onto them as a whole.

    Positions and rotations are fitted together, weighted by the traces of their information: the rotation is the polar
    factor of the sum of both (Umeyama, PAMI 1991, with rotations as further vectors).
    """
    d, of_world = problem.dimension, problem.edges[:, 0] == problem.world
    labels = problem.with_edges(~of_world).components()
    held = np.unique(labels[problem.fixed])
    out, at = poses.copy(), np.flatnonzero(of_world & ~np.isin(labels[problem.edges[:, 1]], held))
    to = problem.edges[at, 1]
    for part in np.unique(labels[to]):
        edges = at[labels[to] == part]
        T, Z, W = poses[problem.edges[edges, 1]], problem.measurements[edges], problem.information[edges]
        weight = np.einsum("eii->e", W[:, -d:, -d:])
        turn = np.where(problem.is_position[edges], 0.0, np.einsum("eii->e", W[:, :-d, :-d]))
        total = max(float(weight.sum()), 1e-300)
        ours, theirs = weight @ T[:, :d, d] / total, weight @ Z[:, :d, d] / total
        M = np.einsum("e,ei,ej->ij", weight, Z[:, :d, d] - theirs, T[:, :d, d] - ours)
        M += np.einsum("e,eik,ejk->ij", turn, Z[:, :d, :d], T[:, :d, :d])
        U, values, Vt = np.linalg.svd(M)
        if not values[0] > 0.0:
            continue
        U[:, -1] *= np.copysign(1.0, np.linalg.det(U) * np.linalg.det(Vt))
        moved = np.eye(d + 1)
        moved[:d, :d] = U @ Vt
        moved[:d, d] = theirs - moved[:d, :d] @ ours if weight.any() else 0.0
        here = labels == part
        out[here] = moved @ poses[here]
    return out
