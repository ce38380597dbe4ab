"""How a lens bends rays: distortion models with derivatives, compiled, for whatever must not load OpenCV."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array


class Lens(NamedTuple):
    """A camera as compiled code takes it; see `Camera.lens`."""

    pinhole: Array  # [5] fx, fy, cx, cy, skew, px
    model: int
    k: Array  # coefficients, zeros where it has fewer than five
    max_r2: float  # squared radius on z = 1 beyond which two rays share a pixel


@njit(cache=True, nogil=True)
def distort(x: float, y: float, model: int, k: Array) -> tuple[float, float, float, float, float, float]:
    """Return the distorted point and its Jacobian (du/dx, du/dy, dv/dx, dv/dy) on the plane z = 1."""
    if model == 0:
        return x, y, 1.0, 0.0, 0.0, 1.0
    r2 = x * x + y * y
    if model == 2:
        r = np.sqrt(r2)
        if r < 1e-9:
            return x, y, 1.0, 0.0, 0.0, 1.0
        theta = np.arctan(r)
        t2 = theta * theta
        bent = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
        scale = bent / r
        # d(scale)/dr divided by r, so that multiplying by x and y gives the gradient of scale
        change = (slope / (1.0 + r2) - scale) / r2
        return x * scale, y * scale, scale + change * x * x, change * x * y, change * x * y, scale + change * y * y
    radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    slope = 2.0 * (k[0] + r2 * (2.0 * k[1] + 3.0 * k[4] * r2))
    if model == 3:
        under = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
        if not under > 0.0:  # at a pole, which lies beyond what the model can see
            return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
        radial /= under
        slope = (slope - 2.0 * radial * (k[5] + r2 * (2.0 * k[6] + 3.0 * k[7] * r2))) / under
    u = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x)
    v = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y
    ux = radial + slope * x * x + 2.0 * k[2] * y + 6.0 * k[3] * x
    uy = slope * x * y + 2.0 * k[2] * x + 2.0 * k[3] * y
    vy = radial + slope * y * y + 6.0 * k[2] * y + 2.0 * k[3] * x
    return u, v, ux, uy, uy, vy


@njit(cache=True, nogil=True)
def imaged(x: float, y: float, lens: Lens) -> tuple[float, float, float, float, float, float]:
    """Return the pixel, from the principal point, of a point on z = 1 and its Jacobian; NaN beyond the model."""
    if not x * x + y * y <= lens.max_r2:
        return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
    fx, fy, skew = lens.pinhole[0], lens.pinhole[1], lens.pinhole[4]
    u, v, ux, uy, vx, vy = distort(x, y, lens.model, lens.k)
    return fx * u + skew * v, fy * v, fx * ux + skew * vx, fx * uy + skew * vy, fy * vx, fy * vy
