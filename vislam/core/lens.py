"""How a lens bends rays: models with derivatives, compiled, for whatever must not load OpenCV.

Two families. Planar ones map the plane z = 1 onto itself: `radtan`, `rational`, `equidistant`. Those over spheres map
a ray (x, y, z) to (x, y) / s, where s depends on z and x^2 + y^2 alone, and so see beyond 90 degrees:

- `ucm`, `eucm`: Khomutenko, Garcia, Martinet, "An enhanced unified camera model", RA-L 2016; ucm has beta = 1
- `ds`: Usenko, Demmel, Cremers, "The double sphere camera model", 3DV 2018
- `omni`: Mei and Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007, with
  radtan on (x, y) / s; Kalibr's omni-radtan

Focal lengths are those in the middle of the image for all of them: Kalibr's are larger by 1 + xi.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array

Distortion = Literal["none", "radtan", "equidistant", "rational", "ucm", "eucm", "ds", "omni"]

_MAX_NEWTON_STEPS = 20
SPHERES, _DS, _OMNI = 4, 5, 6  # codes of the models over spheres, which are the last
_MOST_COEFFICIENTS = 8  # of a rational lens
_XI, _LIMIT = 5, 6  # where omni's k has what radtan does not know: xi, and the squared radius up to which radtan holds
_NO_COEFFICIENT = 1e-12  # of a polynomial in r^2: what it changes at any radius that a lens sees is no pixel's part


class Lens(NamedTuple):
    """A camera as compiled code takes it; see `Camera.lens`."""

    pinhole: Array  # [5] fx, fy, cx, cy, skew, px
    model: int  # the code of one of `MODELS`
    k: Array  # coefficients, as it packs them
    max_r2: float  # squared radius on z = 1 beyond which two rays share a pixel


class Lenses(NamedTuple):
    """Lenses of a rig, C of them, as a table: compiled code is the same however many there are."""

    pinhole: Array  # [C, 5]
    model: NDArray[np.int64]  # [C]
    k: Array  # [C, 8]
    max_r2: Array  # [C]


def table_of(lenses: Sequence[Lens]) -> Lenses:
    """Return lenses as a table."""
    k = np.zeros((len(lenses), _MOST_COEFFICIENTS))
    for row, lens in zip(k, lenses, strict=True):
        row[: len(lens.k)] = lens.k
    return Lenses(
        np.array([lens.pinhole for lens in lenses]), np.array([lens.model for lens in lenses], dtype=np.int64), k,
        np.array([lens.max_r2 for lens in lenses]),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def lens_at(lenses: Lenses, camera: int) -> Lens:
    """Return the lens of a camera."""
    return Lens(lenses.pinhole[camera], lenses.model[camera], lenses.k[camera], lenses.max_r2[camera])


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
def _first_guess(u0: float, v0: float, model: int, max_r2: float) -> tuple[float, float]:
    """Return where to begin the search of the ray to a distorted point; NaN where there is none."""
    if model == 2:  # on the undistorted side: theta ~ bent radius
        bent = np.sqrt(u0 * u0 + v0 * v0)
        if bent >= 1.5:
            return np.nan, np.nan
        if bent > 1e-9:
            return u0 * np.tan(bent) / bent, v0 * np.tan(bent) / bent
    elif model == 3 and u0 * u0 + v0 * v0 > max_r2:  # where the model holds
        shrink = 0.9 * np.sqrt(max_r2 / (u0 * u0 + v0 * v0))
        return u0 * shrink, v0 * shrink
    return u0, v0


@njit(cache=True, nogil=True)
def undistort(u0: float, v0: float, model: int, k: Array, max_r2: float) -> tuple[float, float]:
    """Invert `distort` by Newton's method with halved steps; NaN where no point within the limit gives (u0, v0)."""
    x, y = _first_guess(u0, v0, model, max_r2)
    if np.isnan(x):
        return np.nan, np.nan
    u, v, ux, uy, vx, vy = distort(x, y, model, k)
    error = (u - u0) ** 2 + (v - v0) ** 2
    for _ in range(_MAX_NEWTON_STEPS):
        if error < 1e-24:
            break
        det = ux * vy - uy * vx
        if abs(det) < 1e-12:
            break
        dx = (vy * (u0 - u) - uy * (v0 - v)) / det
        dy = (ux * (v0 - v) - vx * (u0 - u)) / det
        step = 1.0
        improved = False
        while step > 1e-3:
            xn, yn = x + step * dx, y + step * dy
            if model == 3 and xn * xn + yn * yn > max_r2:  # behind a pole other rays give the same pixel
                step *= 0.5
                continue
            un, vn, uxn, uyn, vxn, vyn = distort(xn, yn, model, k)
            new_error = (un - u0) ** 2 + (vn - v0) ** 2
            if new_error < error:
                x, y, u, v, ux, uy, vx, vy, error = xn, yn, un, vn, uxn, uyn, vxn, vyn, new_error
                improved = True
                break
            step *= 0.5
        if not improved:
            break
    if error < 1e-18 and x * x + y * y <= max_r2:
        return x, y
    return np.nan, np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def _divisor(r2: float, z: float, model: int, k: Array) -> tuple[float, float, float]:
    """Return s of a ray by its x^2 + y^2 and z, 1 on the axis at z = 1, with ds/dx / x = ds/dy / y, and ds/dz."""
    if model == SPHERES:  # alpha, beta
        d = np.sqrt(k[1] * r2 + z * z)
        return k[0] * d + (1.0 - k[0]) * z, k[0] * k[1] / d, k[0] * z / d + 1.0 - k[0]
    d = np.sqrt(r2 + z * z)
    xi = k[0] if model == _DS else k[_XI]
    unit = 1.0 / (1.0 + xi)
    if model == _OMNI:
        return (z + xi * d) * unit, xi / d * unit, (1.0 + xi * z / d) * unit
    w = xi * d + z  # double sphere: xi, alpha
    d2 = np.sqrt(r2 + w * w)
    by_w = k[1] * w / d2 + 1.0 - k[1]
    return (k[1] * d2 + (1.0 - k[1]) * w) * unit, (k[1] / d2 + by_w * xi / d) * unit, by_w * (xi * z / d + 1.0) * unit


@njit(cache=True, nogil=True, error_model="numpy")
def bend(
    x: float, y: float, z: float, model: int, k: Array
) -> tuple[float, float, tuple[float, float, float], tuple[float, float, float]]:
    """Return u and v of a ray within the cone of a model over spheres, with their derivatives by x, y and z."""
    s, by_xy, by_z = _divisor(x * x + y * y, z, model, k)
    u, v = x / s, y / s
    row, column = (1.0 - u * by_xy * x, -u * by_xy * y, -u * by_z), (-v * by_xy * x, 1.0 - v * by_xy * y, -v * by_z)
    row = (row[0] / s, row[1] / s, row[2] / s)
    column = (column[0] / s, column[1] / s, column[2] / s)
    if model != _OMNI:
        return u, v, row, column
    scale = 1.0 + k[_XI]  # Mei's radtan acts before the focal length, which is his own
    bent_u, bent_v, uu, uv, vu, vv = distort(u / scale, v / scale, 1, k)
    if not uu * vv - uv * vu > 0.0:  # beyond the fold, which p1 and p2 move
        nothing = (np.nan, np.nan, np.nan)
        return np.nan, np.nan, nothing, nothing
    return (
        bent_u * scale, bent_v * scale,
        (uu * row[0] + uv * column[0], uu * row[1] + uv * column[1], uu * row[2] + uv * column[2]),
        (vu * row[0] + vv * column[0], vu * row[1] + vv * column[1], vu * row[2] + vv * column[2]),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def lift(u: float, v: float, model: int, k: Array) -> tuple[float, float, float]:
    """Return the ray of length 1 that a model over spheres bends to u and v; NaN where there is none."""
    if model == _OMNI:
        xi = k[_XI]
        u, v = undistort(u / (1.0 + xi), v / (1.0 + xi), 1, k, k[_LIMIT])
        r2 = u * u + v * v
        inside = 1.0 + (1.0 - xi * xi) * r2
        _, _, uu, uv, vu, vv = distort(u, v, 1, k)
        if not (inside > 0.0 and uu * vv - uv * vu > 0.0):
            return np.nan, np.nan, np.nan
        f = (xi + np.sqrt(inside)) / (1.0 + r2)
        return f * u, f * v, f - xi
    xi, alpha, beta = (k[0], k[1], 1.0) if model == _DS else (0.0, k[0], k[1])
    u, v = u / (1.0 + xi), v / (1.0 + xi)
    r2 = u * u + v * v
    inside = 1.0 - (2.0 * alpha - 1.0) * beta * r2
    if not inside > 0.0:
        return np.nan, np.nan, np.nan
    z = (1.0 - beta * alpha * alpha * r2) / (alpha * np.sqrt(inside) + 1.0 - alpha)
    f = (z * xi + np.sqrt(z * z + (1.0 - xi * xi) * r2)) / (z * z + r2)
    return f * u, f * v, f * z - xi


@njit(cache=True, nogil=True)
def imaged(x: float, y: float, lens: Lens) -> tuple[float, float, float, float, float, float]:
    """Return the pixel, from the principal point, of a point on z = 1 and its Jacobian; NaN beyond the model."""
    if not x * x + y * y <= lens.max_r2:
        return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
    fx, fy, skew = lens.pinhole[0], lens.pinhole[1], lens.pinhole[4]
    if lens.model >= SPHERES:
        u, v, (ux, uy, _), (vx, vy, _) = bend(x, y, 1.0, lens.model, lens.k)
    else:
        u, v, ux, uy, vx, vy = distort(x, y, lens.model, lens.k)
    return fx * u + skew * v, fy * v, fx * ux + skew * vx, fx * uy + skew * vy, fy * vx, fy * vy


def radial_limit(k: Array) -> float:
    """Return the squared radius at which 1 + k1 r^2 + k2 r^4 + k3 r^6, times r, first turns back (k3 is k[4])."""
    slope = np.polynomial.Polynomial([1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[4]])
    return _smallest_positive_root(slope.trim(_NO_COEFFICIENT))


def _equidistant_limit(k: Array) -> float:
    slope = np.polynomial.Polynomial([1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]])
    theta = min(float(np.sqrt(_smallest_positive_root(slope))), np.deg2rad(89.5))
    return float(np.tan(theta) ** 2)


def _rational_limit(k: Array) -> float:
    """Return the squared radius at which r * over(r^2) / under(r^2) first turns back, or meets a pole."""
    over = np.polynomial.Polynomial([1.0, k[0], k[1], k[4]])
    under = np.polynomial.Polynomial([1.0, k[5], k[6], k[7]])
    r2 = np.polynomial.Polynomial([0.0, 1.0])
    slope = over * under + 2.0 * r2 * (over.deriv() * under - over * under.deriv())
    return min(_smallest_positive_root(part.trim(_NO_COEFFICIENT)) for part in (slope, under))


def _smallest_positive_root(polynomial: np.polynomial.Polynomial) -> float:
    roots = polynomial.trim().roots()
    positive = [float(root.real) for root in np.asarray(roots, dtype=complex) if abs(root.imag) < 1e-9 < root.real]
    return min(positive, default=float("inf"))


def _sphere_cosine(k: Array) -> float:
    """Return the cosine of the widest angle of an extended unified lens (alpha, beta)."""
    alpha, beta = k[:2]
    w = _steepest(alpha)  # z > -w * sqrt(beta * r^2 + z^2)
    return float(-w * np.sqrt(beta) / np.sqrt(1.0 - w * w + w * w * beta))


def _double_cosine(k: Array) -> float:
    """Return the cosine of the widest angle of a double sphere.

    It is where the ray meets the edge -w of the second sphere's cone: (xi + c)^2 = w^2 (1 + 2 xi c + xi^2). The paper's
    w2 is a little narrower.
    """
    xi, w = k[0], _steepest(k[1])
    narrowed = 1.0 - w * w
    return float(-xi * narrowed - w * np.sqrt(1.0 - xi * xi * narrowed))


def _omni_cosine(k: Array) -> float:
    """Return the cosine of the widest angle of a unified lens whose radtan holds up to a radius."""
    xi, r2 = k[_XI], k[_LIMIT]
    cosine = -_steepest(xi / (1.0 + xi))
    inside = 1.0 + (1.0 - xi * xi) * r2
    if not np.isfinite(r2) or inside <= 0.0:
        return float(cosine)
    return float(max(cosine, (xi + np.sqrt(inside)) / (1.0 + r2) - xi))


def _steepest(alpha: float) -> float:
    return float(alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha)


class LensModel(NamedTuple):
    """A lens model as one row of a table."""

    code: int
    names: tuple[str, ...]  # of the coefficients
    counts: tuple[int, ...]  # of coefficients that there may be
    limit: Callable[[Array], float]  # of k: max_r2 of a planar model; over spheres the cosine of the widest angle

    @property
    def is_spherical(self) -> bool:
        """Whether it is over spheres."""
        return self.code >= SPHERES

    def focal_in_files(self, coefficients: tuple[float, ...]) -> float:
        """Return by what factor focal lengths in files of Kalibr and Basalt are larger than that in the middle."""
        return 1.0 + coefficients[0] if "xi" in self.names else 1.0

    def pack(self, coefficients: tuple[float, ...]) -> Array:
        """Return coefficients as kernels take them."""
        if self.code == _OMNI:
            xi, *k = coefficients
            return np.array([*k, 0.0, xi, radial_limit(np.array([*k, 0.0]))])
        k = [*coefficients, *([1.0] if self.code == SPHERES else [])]  # a ucm's beta
        return np.array([*k, *[0.0] * (5 - len(k))])

    def fault(self, coefficients: tuple[float, ...]) -> str:
        """Return what is wrong with finite coefficients; nothing where a lens can have them."""
        if len(coefficients) not in self.counts:
            return f"takes {self.counts} coefficients, got {len(coefficients)}"
        for name, value in zip(self.names, coefficients, strict=False):
            low, high = _RANGES.get((self.code, name), (-np.inf, np.inf))
            if not low <= value <= high:
                return f"has {name} from {low:g} to {high:g}, got {value:g}"
        return ""


_RANGES = {  # of coefficients over spheres, by code and name; beyond, two rays share a pixel everywhere
    (SPHERES, "alpha"): (0.0, 1.0), (SPHERES, "beta"): (1e-3, 1e3), (_DS, "alpha"): (0.0, 1.0),
    (_DS, "xi"): (-0.99, 0.99), (_OMNI, "xi"): (0.0, 1e3),
}  # fmt: skip
_BROWN = ("k1", "k2", "p1", "p2", "k3")
MODELS: dict[Distortion, LensModel] = {
    "none": LensModel(0, (), (0,), lambda _: np.inf),
    "radtan": LensModel(1, _BROWN, (4, 5), radial_limit),
    "equidistant": LensModel(2, ("k1", "k2", "k3", "k4"), (4,), _equidistant_limit),
    "rational": LensModel(3, (*_BROWN, "k4", "k5", "k6"), (8,), _rational_limit),
    "ucm": LensModel(SPHERES, ("alpha",), (1,), _sphere_cosine),
    "eucm": LensModel(SPHERES, ("alpha", "beta"), (2,), _sphere_cosine),
    "ds": LensModel(_DS, ("xi", "alpha"), (2,), _double_cosine),
    "omni": LensModel(_OMNI, ("xi", "k1", "k2", "p1", "p2"), (5,), _omni_cosine),
}
