"""The normal equations of the window that initialisation refines, as seen by the camera: compiled loops over points."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.geometry import so3_exp
from vislam.messages import Array

_HUBER = 2.0  # standard deviations

Ints = NDArray[np.int64]


@njit(cache=True, nogil=True)
def visual_system(
    begin: Ints,
    node: Ints,
    xy: Array,
    used: NDArray[np.bool_],
    weight: float,
    T: Array,
    v: Array,
    rates: Array,
    offset_s: float,
    points: Array,
    R_body_cam: Array,
    lever: Array,
    damping: float,
) -> tuple[Array, Array, float, Array, Array, Array, Array]:
    """Return the visual part with points eliminated: H, g over nodes [9 each] and time offset; cost; what gives points.

    A camera's pose is that of its node carried on by `offset_s` with the node's velocity and rate. Residuals are
    measured minus predicted, whitened, with Huber's weight.
    """
    nodes, count = len(T), len(points)
    size = 9 * nodes + 1
    H, g, cost = np.zeros((size, size)), np.zeros(size), 0.0
    inverses, heads, links = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3, size))
    residuals = np.full((len(node), 2), 1e6)
    R, p = _carried_on(T, v, rates, offset_s)
    toward, apart, speed, D, J_point = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((2, 3))
    J_i, J_a, J_t = np.empty((2, 6)), np.empty((2, 6)), np.empty(2)
    for k in range(count):
        a = node[begin[k]]
        rho = points[k, 2]
        # the point times its inverse depth, so that far points stay finite
        ray_body = _turned(R_body_cam, np.array([points[k, 0], points[k, 1], 1.0]))
        for c in range(3):
            ray_body[c] += rho * lever[c]
        ray_world = _turned(R[a], ray_body)
        block, head = np.zeros((3, 3)), np.zeros(3)
        for m in range(begin[k], begin[k + 1]):
            i = node[m]
            for c in range(3):
                apart[c], speed[c] = p[a, c] - p[i, c], v[a, c] - v[i, c]
                toward[c] = ray_world[c] + rho * apart[c]
            body = _turned_back(R[i], toward)
            for c in range(3):
                toward[c] = body[c] - rho * lever[c]
            cam = _turned_back(R_body_cam, toward)
            if cam[2] <= 1e-3:
                cost += 1e3 * used[m]
                continue
            x, y = cam[0] / cam[2], cam[1] / cam[2]
            r0, r1 = weight * (xy[m, 0] - x), weight * (xy[m, 1] - y)
            residuals[m, 0], residuals[m, 1] = r0, r1
            if not used[m]:
                continue
            norm = np.sqrt(r0 * r0 + r1 * r1)
            robust = 1.0 if norm <= _HUBER else _HUBER / norm
            cost += norm * norm if norm <= _HUBER else 2.0 * _HUBER * norm - _HUBER * _HUBER
            _derivative(
                x, y, weight / cam[2], rho, R_body_cam, R[i], R[a], i == a, apart, lever, body, ray_body,
                speed, rates[i], rates[a], D, J_i, J_a, J_t, J_point,
            )  # fmt: skip
            _add_rows(H, g, links[k], block, head, 9 * i, 9 * a, size - 1, J_i, J_a, J_t, J_point, r0, r1, robust)
        for c in range(3):
            block[c, c] += 1e-9 + damping * block[c, c]
        inverses[k] = np.linalg.inv(block)
        heads[k] = head
        _eliminate(H, g, links[k], inverses[k], head, node[begin[k] : begin[k + 1]], a)
    for c in range(size):
        for e in range(c):
            H[e, c] = H[c, e]
    return H, g, cost, inverses, heads, links, residuals


@njit(cache=True, nogil=True)
def _derivative(
    x: float, y: float, scale: float, rho: float, R_body_cam: Array, R_i: Array, R_a: Array, same: bool, apart: Array,
    lever: Array, body: Array, ray_body: Array, speed: Array, rate_i: Array, rate_a: Array, D: Array,
    J_i: Array, J_a: Array, J_t: Array, J_point: Array,
) -> None:  # fmt: skip
    """Write the derivative of a pixel by its node, the anchor, the time offset and the point; D [3] is scratch.

    `apart` and `speed` are the anchor's position and velocity less the node's; `same`: the node is the anchor.
    """
    J_i[:] = 0.0
    J_a[:] = 0.0
    J_t[:] = 0.0
    for row in range(2):
        D[0], D[1] = (scale, 0.0) if row == 0 else (0.0, scale)
        D[2] = -scale * (x if row == 0 else y)
        D_body = _turned(R_body_cam, D)
        D_world = _turned(R_i, D_body)
        D_anchor = _turned_back(R_a, D_world)
        by_ray = _turned_back(R_body_cam, D_anchor)
        J_point[row, 0], J_point[row, 1], J_point[row, 2] = by_ray[0], by_ray[1], 0.0
        for c in range(3):
            J_point[row, 2] += D_anchor[c] * lever[c] + D_world[c] * apart[c] - D_body[c] * lever[c]
        if same:
            continue
        by_turn, by_anchor = _crossed(D_body, body), _crossed(D_anchor, ray_body)
        for c in range(3):
            J_i[row, c], J_i[row, 3 + c] = by_turn[c], -rho * D_world[c]
            J_a[row, c], J_a[row, 3 + c] = -by_anchor[c], rho * D_world[c]
            J_t[row] += by_turn[c] * rate_i[c] - by_anchor[c] * rate_a[c]
            J_t[row] += rho * D_world[c] * speed[c]


@njit(cache=True, nogil=True)
def _carried_on(T: Array, v: Array, rates: Array, offset_s: float) -> tuple[Array, Array]:
    """Return attitudes [N, 3, 3] and positions [N, 3] a moment after those of the nodes."""
    R, p = np.zeros((len(T), 3, 3)), np.zeros((len(T), 3))
    w = np.empty(3)
    for i in range(len(T)):
        for c in range(3):
            w[c] = rates[i, c] * offset_s
            p[i, c] = T[i, c, 3] + v[i, c] * offset_s
        turn = so3_exp(w)
        for c in range(3):
            for d in range(3):
                R[i, c, d] = T[i, c, 0] * turn[0, d] + T[i, c, 1] * turn[1, d] + T[i, c, 2] * turn[2, d]
    return R, p


@njit(cache=True, nogil=True)
def _add_rows(
    H: Array, g: Array, link: Array, block: Array, head: Array, ci: int, ca: int, ct: int,
    J_i: Array, J_a: Array, J_t: Array, J_point: Array, r0: float, r1: float, robust: float,
) -> None:  # fmt: skip
    """Add two whitened rows: columns ci.. of their node, ca.. of the anchor, ct of the time offset, and the point."""
    J, columns = np.empty((2, 13)), np.empty(13, dtype=np.int64)
    for c in range(6):
        columns[c], columns[6 + c] = ci + c, ca + c
        for row in range(2):
            J[row, c], J[row, 6 + c], J[row, 12] = J_i[row, c], J_a[row, c], J_t[row]
    columns[12] = ct
    start = 12 if ci == ca else 0
    for row in range(2):
        r = r0 if row == 0 else r1
        for c in range(start, 13):
            value = robust * J[row, c]
            if value == 0.0:
                continue
            g[columns[c]] += value * r
            for e in range(start, 13):
                H[columns[c], columns[e]] += value * J[row, e]
            for e in range(3):
                link[e, columns[c]] += value * J_point[row, e]
        for c in range(3):
            head[c] += robust * J_point[row, c] * r
            for e in range(3):
                block[c, e] += robust * J_point[row, c] * J_point[row, e]


@njit(cache=True, nogil=True)
def _eliminate(H: Array, g: Array, link: Array, inverse: Array, head: Array, seen_by: Ints, anchor: int) -> None:
    """Take the point out of the system's lower triangle: columns of nodes that see it, and the time offset."""
    count = len(seen_by)
    columns = np.empty(6 * count + 1, dtype=np.int64)
    for n in range(count):
        for c in range(6):
            columns[6 * n + c] = 9 * seen_by[n] + c
    columns[6 * count] = len(g) - 1
    through = np.empty((3, len(columns)))
    for c in range(len(columns)):
        for e in range(3):
            through[e, c] = (
                inverse[e, 0] * link[0, columns[c]]
                + inverse[e, 1] * link[1, columns[c]]
                + inverse[e, 2] * link[2, columns[c]]
            )
    for c in range(len(columns)):
        row = columns[c]
        l0, l1, l2 = link[0, row], link[1, row], link[2, row]
        g[row] -= through[0, c] * head[0] + through[1, c] * head[1] + through[2, c] * head[2]
        for e in range(c + 1):  # columns ascend: the lower triangle
            H[row, columns[e]] -= l0 * through[0, e] + l1 * through[1, e] + l2 * through[2, e]


@njit(cache=True, nogil=True)
def _turned(R: Array, v: Array) -> Array:
    """Return R @ v: in a loop, which numba compiles in a fraction of the time of `@`."""
    out = np.empty(3)
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@njit(cache=True, nogil=True)
def _turned_back(R: Array, v: Array) -> Array:
    """Return R.T @ v."""
    out = np.empty(3)
    for i in range(3):
        out[i] = R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2]
    return out


@njit(cache=True, nogil=True)
def _crossed(a: Array, b: Array) -> Array:
    """Return a @ skew(b), the cross product of a and b."""
    out = np.empty(3)
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return out
