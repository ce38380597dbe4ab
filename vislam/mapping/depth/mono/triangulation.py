"""Inverse depth of a pixel from where it is found in another image, and how much a pixel there is worth.

A point on the ray of reference pixel x at inverse z-depth rho lies, up to scale, at q + rho t in the other camera, with
q = R_cur_ref K^-1 x and t = t_cur_ref. All rays are in one frame before they are compared; the code published with the
slambook leaves the ray of the shifted pixel in the frame of the other camera, and stops converging when it turns.
"""

from __future__ import annotations

from vislam.core.jit import njit

Vector = tuple[float, float, float]


@njit(cache=True, nogil=True, error_model="numpy")
def inverse_depth(q: Vector, t: Vector, u: float, v: float, du: float, dv: float) -> float:
    """Return the inverse z-depth in the reference camera of a match at (u, v), in normalised coordinates of the other.

    `(du, dv)` is the direction of the epipolar line there: the match is taken at its place along the line. Not finite
    where the line shrinks to a point.
    """
    return (du * (u * q[2] - q[0]) + dv * (v * q[2] - q[1])) / (du * (t[0] - u * t[2]) + dv * (t[1] - v * t[2]))


@njit(cache=True, nogil=True, error_model="numpy")
def inverse_depth_sigma(
    q: Vector, t: Vector, u: float, v: float, du: float, dv: float, sigma: float
) -> tuple[float, float]:
    """Return the inverse depth of a match and its standard deviation.

    The match may be off by `sigma` pixels along the epipolar line; `(du, dv)` is one pixel along it in normalised
    coordinates. As in the slambook, the match is shifted by that and triangulated again: there with angles and the law
    of sines, which is the same triangle.
    """
    rho = inverse_depth(q, t, u, v, du, dv)
    shifted = inverse_depth(q, t, u + sigma * du, v + sigma * dv, du, dv)
    return rho, abs(shifted - rho)
