"""One frame for every pixel of a band of rows: epipolar search, triangulation, fusion, and the tests around them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32, ImageU8
from vislam.mapping.depth.mono.fusion import fuse_beta, fuse_gaussian
from vislam.mapping.depth.mono.matching import MARGIN, SIDE, load_patch, score_at
from vislam.mapping.depth.mono.triangulation import Vector, inverse_depth_sigma

SEARCHED, CONVERGED, FAILED, FLAT = range(4)  # what became of a pixel; only the searched ones cost time
NO_MATCH, MATCH, NO_NEWS = range(3)  # of one pixel in one frame; no news: out of view, or nothing to be learned
_NEAREST_Z = 0.05  # of a point's z in the other camera over that in the reference: nearer is behind or beside it
_PEAK_PX = 3.0  # a second maximum of the score nearer than this belongs to the first


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


class Line(NamedTuple):
    """Where a pixel may be in the other image; pixels count from the principal point."""

    worthwhile: bool
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
            line = epipolar_line(q, t, fx, fy, float(belief.rho[y, x]), math.sqrt(belief.variance[y, x]), rules)
            g = gradients[y, x]
            along = g[0] * line.eu**2 + 2.0 * g[1] * line.eu * line.ev + g[2] * line.ev**2
            if not line.worthwhile or along < rules.min_gradient**2:
                continue  # nothing to be learned, or the texture runs along the line
            mean, squares = load_patch(patch, reference, y, x)
            found, place = _search(line, (cx, cy), rules, current, patch, mean, squares, scores)
            if found == MATCH:
                u, v = (line.um + place * line.eu) / fx, (line.vm + place * line.ev) / fy
                rho, sigma = inverse_depth_sigma(q, t, u, v, line.eu / fx, line.ev / fy, rules.sigma_px)
                matched += _accept(x, y, belief, rules, rho, sigma)
            elif found == NO_MATCH:
                _miss(x, y, belief, rules)
    return matched


@njit(cache=True, nogil=True, error_model="numpy")
def epipolar_line(q: Vector, t: Vector, fx: float, fy: float, mean: float, sigma: float, rules: Rules) -> Line:
    """Return where to search for a point at q + rho t whose inverse depth is about `mean`.

    Not worthwhile: behind the other camera, or too little parallax to tell more than is known.
    """
    low = max(mean - rules.search_sigmas * sigma, rules.rho_min)
    high = min(mean + rules.search_sigmas * sigma, rules.rho_max)
    mean = min(max(mean, low), high)
    za, zm, zb = q[2] + t[2] * low, q[2] + t[2] * mean, q[2] + t[2] * high
    if not (za > _NEAREST_Z and zb > _NEAREST_Z):
        return Line(False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    ua, va = fx * (q[0] + t[0] * low) / za, fy * (q[1] + t[1] * low) / za
    um, vm = fx * (q[0] + t[0] * mean) / zm, fy * (q[1] + t[1] * mean) / zm
    ub, vb = fx * (q[0] + t[0] * high) / zb, fy * (q[1] + t[1] * high) / zb
    du, dv = ub - ua, vb - va
    length = math.sqrt(du * du + dv * dv)
    if not length > 1e-9:
        return Line(False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    eu, ev = du / length, dv / length
    _, expected = inverse_depth_sigma(q, t, um / fx, vm / fy, eu / fx, ev / fy, rules.sigma_px)
    begin = max((ua - um) * eu + (va - vm) * ev, -rules.reach_px) - rules.step_px
    finish = min((ub - um) * eu + (vb - vm) * ev, rules.reach_px) + rules.step_px
    return Line(expected < rules.max_sigma_ratio * sigma, um, vm, eu, ev, begin, finish)


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
        return NO_NEWS, 0.0
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
