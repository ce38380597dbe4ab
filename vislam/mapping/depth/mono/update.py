"""One frame for every pixel of a band of rows: epipolar search, triangulation, fusion, and the tests around them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32, ImageU8
from vislam.mapping.depth.mono.matching import HALF, MARGIN, PIXELS, SIDE, load_patch, load_warped, score_at

_SQRT_2_PI = math.sqrt(2.0 * math.pi)


Vector = tuple[float, float, float]
SEARCHED, CONVERGED, FAILED, FLAT = range(4)  # what became of a pixel; only the searched ones cost time
NO_MATCH, MATCH, UNCHANGED = range(3)  # of one pixel in one frame; unchanged: out of view, or nothing to be learned
_NEAREST_Z = 0.05  # of a point's z in the other camera over that in the reference: nearer is behind or beside it
_NO_WARP = (1.0, 0.0, 0.0, 1.0)
_SMALLEST_WARP = 1e-6  # of a square of the reference that is seen in the image
_PEAK_PX = 3.0  # a second maximum of the score nearer than this belongs to the first


@njit(cache=True, nogil=True, error_model="numpy")
def fuse_gaussian(rho: float, variance: float, measured: float, measured_variance: float) -> tuple[float, float]:
    """Return mean and variance of the product of two normal distributions."""
    total = variance + measured_variance
    return (measured_variance * rho + variance * measured) / total, variance * measured_variance / total


@njit(cache=True, nogil=True, error_model="numpy")
def fuse_beta(
    rho: float, variance: float, a: float, b: float, measured: float, measured_variance: float, spread: float
) -> tuple[float, float, float, float]:
    """Return mean, variance, and the Beta parameters of the share of good measurements.

    A measurement is either normal around the truth or uniform over `spread`, the whole range of inverse depth; the
    posterior is fitted by its moments (Vogiatzis and Hernandez, "Video-based, real-time multi-view stereo", IVC 2011,
    equations 19 to 28; also in SVO and REMODE).
    """
    total = variance + measured_variance
    off = measured - rho
    mean, fused = fuse_gaussian(rho, variance, measured, measured_variance)
    good = a / (a + b) * math.exp(-0.5 * off * off / total) / (_SQRT_2_PI * math.sqrt(total))
    bad = b / (a + b) / spread
    good, bad = good / (good + bad), bad / (good + bad)
    n = a + b
    first = good * (a + 1.0) / (n + 1.0) + bad * a / (n + 1.0)
    second = (good * (a + 1.0) * (a + 2.0) + bad * a * (a + 1.0)) / ((n + 1.0) * (n + 2.0))
    new = good * mean + bad * rho
    # moments about the new mean: no difference of large numbers
    new_variance = good * (fused + (mean - new) ** 2) + bad * (variance + (rho - new) ** 2)
    new_a = (second - first) / (first - second / first)
    return new, new_variance, new_a, new_a * (1.0 - first) / first


@njit(cache=True, nogil=True, error_model="numpy")
def inverse_depth(q: Vector, t: Vector, u: float, v: float, du: float, dv: float) -> float:
    """Return the inverse z-depth in the reference camera of a match at (u, v), in normalised coordinates of the other.

    A point on the ray of reference pixel x at inverse z-depth rho lies, up to scale, at q + rho t in the other camera,
    with q = R_cur_ref K^-1 x and t = t_cur_ref. All rays are in one frame before they are compared; the code published
    with the slambook leaves the ray of the shifted pixel in the other camera's, and stops converging when it turns.

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


class Belief(NamedTuple):
    """What is known of every pixel of the reference image, all [h, w]."""

    rho: ImageF32  # 1/m, mean of the inverse z-depth
    variance: ImageF32
    a: ImageF32  # of the Beta distribution of the share of good measurements
    b: ImageF32
    state: ImageU8
    misses: ImageU8  # frames without a match, less those with one
    matches: ImageU8


class Rules(NamedTuple):
    """Settings in the form that compiled code takes."""

    measure: int
    beta: bool
    step_px: float
    reach_px: float
    search_sigmas: float
    least_score: float
    uniqueness: float
    sigma_px: float
    min_gradient: float
    max_sigma_ratio: float
    converged: float
    min_matches: int
    max_misses: int
    min_good: float
    rho_min: float
    rho_max: float
    model_sigma_px: float  # negative: matches are `sigma_px` off
    grey_noise: float  # grey levels, of a pixel
    warp_px: float  # infinite: no patch is warped


class Line(NamedTuple):
    """Where a pixel may be in the other image; pixels count from the principal point."""

    expected: float  # sigma of inverse depth that a match would have, `sigma_px` off; infinite: it cannot be there
    um: float  # where the mean inverse depth projects to
    vm: float
    eu: float  # unit direction in which inverse depth grows
    ev: float
    begin: float  # px along it from the middle, a step beyond the ends of what is possible
    end: float


class Views(NamedTuple):
    """The two images and the way between them."""

    reference: ImageF32
    gradients: ImageF32  # [h, w, 3] of the reference
    current: ImageF32  # NaN where nothing was seen
    K: Array  # fx, fy, cx, cy of both
    R: Array  # R_cur_ref
    t: Array  # t_cur_ref


@njit(cache=True, nogil=True, error_model="numpy")
def update_rows(begin: int, end: int, belief: Belief, rules: Rules, views: Views) -> int:
    """Take one frame in for rows `begin` to `end` (exclusive); return how many pixels were matched."""
    reference, gradients, current, K = views.reference, views.gradients, views.current, views.K
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    R, t = views.R, (views.t[0], views.t[1], views.t[2])
    patch = np.zeros((SIDE, SIDE + 1), np.float32)
    scores = np.empty(int(2.0 * rules.reach_px / rules.step_px) + 8, np.float32)
    matched = 0
    for y in range(max(begin, MARGIN), min(end, reference.shape[0] - MARGIN)):
        for x in range(MARGIN, reference.shape[1] - MARGIN):
            if belief.state[y, x] != SEARCHED:
                continue
            h, k = (x - cx) / fx, (y - cy) / fy
            q = (
                R[0, 0] * h + R[0, 1] * k + R[0, 2],
                R[1, 0] * h + R[1, 1] * k + R[1, 2],
                R[2, 0] * h + R[2, 1] * k + R[2, 2],
            )
            sigma = math.sqrt(belief.variance[y, x])
            line = epipolar_line(q, t, fx, fy, float(belief.rho[y, x]), sigma, rules)
            if not line.expected < np.inf:
                continue
            eu, ev, warp = line.eu, line.ev, _NO_WARP
            if rules.warp_px < np.inf:
                warp = patch_warp(R, t, q, fx, fy, float(belief.rho[y, x]))
                if not warp[0] * warp[3] > warp[1] * warp[2]:
                    continue  # seen from behind
                eu, ev = warp[0] * line.eu + warp[1] * line.ev, warp[2] * line.eu + warp[3] * line.ev
            g = gradients[y, x]
            along = g[0] * eu**2 + 2.0 * g[1] * eu * ev + g[2] * ev**2
            sigma_px = match_sigma_px(along, eu * eu + ev * ev, rules)
            worthwhile = line.expected * (sigma_px / rules.sigma_px) < rules.max_sigma_ratio * sigma
            if not worthwhile or along < rules.min_gradient**2:
                continue  # too little parallax to learn more than is known, or the texture runs along the line
            if HALF * max(abs(warp[0] - 1.0) + abs(warp[1]), abs(warp[2]) + abs(warp[3] - 1.0)) > rules.warp_px:
                mean, squares = load_warped(patch, reference, y, x, warp)
                if squares < 0.0:
                    continue
            else:
                mean, squares = load_patch(patch, reference, y, x)
            found, place = _search(line, (cx, cy), rules, current, patch, mean, squares, scores)
            if found == MATCH:
                u, v = (line.um + place * line.eu) / fx, (line.vm + place * line.ev) / fy
                rho, sigma = inverse_depth_sigma(q, t, u, v, line.eu / fx, line.ev / fy, sigma_px)
                matched += _accept(x, y, belief, rules, rho, sigma)
            elif found == NO_MATCH:
                _miss(x, y, belief, rules)
    return matched


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def match_sigma_px(along: float, stretch: float, rules: Rules) -> float:
    """Return how far a match may be off along the line: by image noise in both patches, and by the model.

    `along` is the mean square of the gradient along the line, over the patch, in grey levels per pixel of the other
    image; `stretch` how many squared pixels of the reference one of those is. Least squares over a patch of n pixels
    place it to 2 sigma^2 / (n along), sigma of a grey value (Forster et al. 2014; Pizzoli et al. 2014). Of the gradient
    sigma^2 / 2 is noise itself, by central differences.
    """
    if rules.model_sigma_px < 0.0:
        return rules.sigma_px
    noise = rules.grey_noise * rules.grey_noise
    textured = max(along - 0.5 * noise * stretch, 0.5 * along)
    return math.sqrt(rules.model_sigma_px**2 + 2.0 * noise / (PIXELS * textured + 1e-9))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def patch_warp(R: Array, t: Vector, q: Vector, fx: float, fy: float, rho: float) -> tuple[float, float, float, float]:
    """Return the 2x2 matrix, by rows, that takes steps in the other image to steps in the reference.

    For a surface that faces the reference camera at inverse depth `rho`, as SVO warps patches (Forster et al. 2014,
    section V). Its determinant is not positive where the camera sees its back, or its edge; the identity where that
    would be behind the other camera.
    """
    x, y, z = q[0] + rho * t[0], q[1] + rho * t[1], q[2] + rho * t[2]
    if not z > _NEAREST_Z:
        return _NO_WARP
    h, k = x / z, y / z
    a, b = (R[0, 0] - h * R[2, 0]) / z, (R[0, 1] - h * R[2, 1]) * fx / (fy * z)
    c, d = (R[1, 0] - k * R[2, 0]) * fy / (fx * z), (R[1, 1] - k * R[2, 1]) / z
    determinant = a * d - b * c
    if not abs(determinant) > _SMALLEST_WARP:
        return 0.0, 0.0, 0.0, 0.0
    return d / determinant, -b / determinant, -c / determinant, a / determinant


@njit(cache=True, nogil=True, error_model="numpy")
def epipolar_line(q: Vector, t: Vector, fx: float, fy: float, mean: float, sigma: float, rules: Rules) -> Line:
    """Return where to search for a point at q + rho t whose inverse depth is about `mean`.

    Nowhere, where it would be behind the other camera.
    """
    low = max(mean - rules.search_sigmas * sigma, rules.rho_min)
    high = min(mean + rules.search_sigmas * sigma, rules.rho_max)
    mean = min(max(mean, low), high)
    za, zm, zb = q[2] + t[2] * low, q[2] + t[2] * mean, q[2] + t[2] * high
    if not (za > _NEAREST_Z and zb > _NEAREST_Z):
        return Line(np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    ua, va = fx * (q[0] + t[0] * low) / za, fy * (q[1] + t[1] * low) / za
    um, vm = fx * (q[0] + t[0] * mean) / zm, fy * (q[1] + t[1] * mean) / zm
    ub, vb = fx * (q[0] + t[0] * high) / zb, fy * (q[1] + t[1] * high) / zb
    du, dv = ub - ua, vb - va
    length = math.sqrt(du * du + dv * dv)
    if not length > 1e-9:
        return Line(np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    eu, ev = du / length, dv / length
    _, expected = inverse_depth_sigma(q, t, um / fx, vm / fy, eu / fx, ev / fy, rules.sigma_px)
    begin = max((ua - um) * eu + (va - vm) * ev, -rules.reach_px) - rules.step_px
    finish = min((ub - um) * eu + (vb - vm) * ev, rules.reach_px) + rules.step_px
    return Line(expected, um, vm, eu, ev, begin, finish)


@njit(cache=True, nogil=True, error_model="numpy")
def _search(
    line: Line,
    centre: tuple[float, float],
    rules: Rules,
    image: ImageF32,
    patch: ImageF32,
    mean: np.float32,
    squares: np.float32,
    scores: ImageF32,
) -> tuple[int, float]:
    """Return the outcome, and how far along the line, from its middle, the best match is, refined below a step."""
    cx, cy = centre
    right, bottom = image.shape[1] - MARGIN, image.shape[0] - MARGIN
    step = rules.step_px
    count = min(int((line.end - line.begin) / step) + 1, len(scores))
    best, top, inside = 0, -np.inf, 0
    for i in range(count):
        along = line.begin + i * step
        u, v = line.um + along * line.eu + cx, line.vm + along * line.ev + cy
        if not (u >= MARGIN and v >= MARGIN and u < right and v < bottom):
            scores[i] = -np.inf
            continue
        scores[i] = score_at(rules.measure, patch, mean, squares, image, u, v)
        inside += scores[i] > -np.inf
        if scores[i] > top:
            best, top = i, scores[i]
    if inside < 3:
        return UNCHANGED, 0.0
    if top < rules.least_score or best == 0 or best == count - 1:
        return NO_MATCH, 0.0
    before, after = scores[best - 1], scores[best + 1]
    if not (before > -np.inf and after > -np.inf):
        return NO_MATCH, 0.0
    if rules.uniqueness < 1.0 and not _is_unique(scores, count, best, rules):
        return NO_MATCH, 0.0
    bend = before - 2.0 * top + after
    offset = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return MATCH, line.begin + (best + offset) * step


@njit(cache=True, nogil=True, error_model="numpy")
def _is_unique(scores: ImageF32, count: int, best: int, rules: Rules) -> bool:
    """Return whether every other maximum of the score is clearly worse."""
    perfect = 1.0 if rules.least_score > 0.0 else 0.0
    limit = perfect - (perfect - scores[best]) / rules.uniqueness
    apart = _PEAK_PX / rules.step_px
    for i in range(1, count - 1):
        if abs(i - best) > apart and scores[i] > limit and scores[i] >= max(scores[i - 1], scores[i + 1]):
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _miss(x: int, y: int, belief: Belief, rules: Rules) -> None:
    """Note a frame that should show the pixel and does not."""
    belief.misses[y, x] += 1
    belief.b[y, x] += 1.0
    bad = rules.beta and belief.a[y, x] < 0.5 * rules.min_good * (belief.a[y, x] + belief.b[y, x])
    if bad or belief.misses[y, x] >= rules.max_misses:
        belief.state[y, x] = FAILED


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _accept(x: int, y: int, belief: Belief, rules: Rules, measured: float, sigma: float) -> int:
    """Fuse a measurement, and decide whether the pixel has converged; return whether it could be used."""
    usable = measured > 0.0 and sigma < np.inf
    if usable:
        belief.misses[y, x] -= min(belief.misses[y, x], np.uint8(1))
        belief.matches[y, x] += belief.matches[y, x] < 255
        mean, variance = float(belief.rho[y, x]), float(belief.variance[y, x])
        if rules.beta:
            a, b, spread = float(belief.a[y, x]), float(belief.b[y, x]), rules.rho_max - rules.rho_min
            mean, variance, a, b = fuse_beta(mean, variance, a, b, measured, sigma * sigma, spread)
            belief.a[y, x], belief.b[y, x] = a, b
        else:
            mean, variance = fuse_gaussian(mean, variance, measured, sigma * sigma)
        belief.rho[y, x], belief.variance[y, x] = mean, variance
        good = not rules.beta or belief.a[y, x] > rules.min_good * (belief.a[y, x] + belief.b[y, x])
        if good and belief.matches[y, x] >= rules.min_matches and variance < (rules.converged * mean) ** 2:
            belief.state[y, x] = CONVERGED
    return int(usable)
