"""Which surface a ray meets first, in the frame of the camera that looks: what rays share is computed once per pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.sim.scene.scene import CYLINDER, DISC
from vislam.sim.scene.tiles import NEAR_M

Hit = tuple[float, float, float]  # depth, and metres along u and v


@njit(cache=True, nogil=True)
def turn_to(pose: Array, geometry: Array, visible: NDArray[np.int64], seen: Array) -> None:
    """Fill `seen` [P, 16] with the geometry of the visible surfaces as a camera at `pose` [3, 4] has it.

    A row holds, instead of the origin, how far it is from the camera along u, v and normal [0:3], then u [3:6],
    v [6:9] and normal [9:12] in the camera's frame, and [12:16] as it was; see `Scene`.
    """
    for p in visible:
        g, s = geometry[p], seen[p]
        ex, ey, ez = g[0] - pose[0, 3], g[1] - pose[1, 3], g[2] - pose[2, 3]
        for axis in range(3):
            x, y, z = g[3 + 3 * axis], g[4 + 3 * axis], g[5 + 3 * axis]
            s[axis] = x * ex + y * ey + z * ez
            for j in range(3):
                s[3 + 3 * axis + j] = x * pose[0, j] + y * pose[1, j] + z * pose[2, j]
        for j in range(12, 16):
            s[j] = g[j]


@njit(cache=True, nogil=True)
def _meet_cylinder(s: Array, x: float, y: float, limit: float) -> Hit:
    """Return depth, u and v in metres where the ray (x, y, 1) enters a cylinder; infinite depth where it does not."""
    radius = s[12] / (2.0 * np.pi)
    du, dn = s[3] * x + s[4] * y + s[5], s[9] * x + s[10] * y + s[11]
    square, linear = du * du + dn * dn, du * s[0] + dn * s[2]
    rest = s[0] * s[0] + s[2] * s[2] - radius * radius
    root = linear * linear - square * rest
    if root <= 0.0 or square <= 0.0 or rest <= 0.0:
        return np.inf, 0.0, 0.0
    t = (linear - np.sqrt(root)) / square
    if t <= NEAR_M or t >= limit:
        return np.inf, 0.0, 0.0
    b = t * (s[6] * x + s[7] * y + s[8]) - s[1]
    if b < 0.0 or b > s[13]:
        return np.inf, 0.0, 0.0
    angle = np.arctan2(t * dn - s[2], t * du - s[0])
    return t, radius * (angle if angle >= 0.0 else angle + 2.0 * np.pi), b


@njit(cache=True, nogil=True)
def trace(
    x: float,
    y: float,
    candidates: NDArray[np.int64],
    count: int,
    nearest: Array,
    kind: NDArray[np.int64],
    seen: Array,
) -> tuple[int, float, float, float]:
    """Return the first surface on the ray (x, y, 1), or -1, its depth and the hit in metres along its u and v."""
    best, best_t, best_a, best_b = -1, np.inf, 0.0, 0.0
    for i in range(count):
        p = candidates[i]
        if nearest[p] > best_t:
            break
        s = seen[p]
        if kind[p] == CYLINDER:
            t, a, b = _meet_cylinder(s, x, y, best_t)
            if t < best_t:
                best, best_t, best_a, best_b = p, t, a, b
            continue
        slope = s[9] * x + s[10] * y + s[11]
        if slope >= 0.0:
            continue
        t = s[2] / slope
        if t <= NEAR_M or t >= best_t:
            continue
        a = t * (s[3] * x + s[4] * y + s[5]) - s[0]
        b = t * (s[6] * x + s[7] * y + s[8]) - s[1]
        if a < 0.0 or a > s[12] or b < 0.0 or b > s[13]:
            continue
        if kind[p] == DISC and (a - 0.5 * s[12]) ** 2 + (b - 0.5 * s[12]) ** 2 > 0.25 * s[12] * s[12]:
            continue
        best, best_t, best_a, best_b = p, t, a, b
    return best, best_t, best_a, best_b
