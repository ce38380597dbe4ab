"""From tracks to a lens: which focal length fits at all, then the whole lens with the readout."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from vislam.calibration.extrinsics import RotationPair, solve_hand_eye
from vislam.calibration.self_calibration.adjust import Piece, Prior, Shared, adjust, judged, scatter_px, steadied
from vislam.calibration.self_calibration.segments import LEAST_KEYFRAMES, Segment
from vislam.calibration.self_calibration.structure import GYRO, LENS, READOUT, SCALE, SHARED, Gyro, Structure
from vislam.core.camera import Camera
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, Bools
from vislam.vision.two_view import essential_ransac

_FACTORS = (1.0, 0.8, 1.25, 0.64, 1.56)  # of the focal length that is tried, the likeliest first
_START_PX = 2.0  # noise while the lens is still wrong
_LEAST_PX = 0.05
_START_STEPS, _STEPS = 8, 8
_ROUNDS = 2
_TRIED = 6  # stretches with which focal lengths are tried
_DAMPING = 1e-6  # near the end: what is weakly determined would creep under more
_WORST = 3.0  # times the usual scatter: such a stretch ended in a minimum of its own
_LEAST_PIECES = 0.5  # share of the stretches that a focal length must let begin
# What is taken of cameras in general, one sigma: principal point in the middle, square pixels, modest distortion
_CENTRE = 0.04  # of the width
_RADTAN = (0.5, 0.5, 0.01, 0.01, 0.5)
_EQUIDISTANT = (0.3, 0.3, 0.3, 0.3)
_HELD = 1e-6  # a coefficient that stays as it is
_READOUT_S = 0.02
_ASPECT = 0.01
_OFFSET_S = 0.1
_BIAS = 1.0  # rad/s
_PAIR_RAD = 2e-3  # of a keyframe's rotation; what is true of it the hand-eye solution finds
_LEAST_CORRELATION = 0.5  # of the speeds of turning: less, and camera and gyroscope saw different things

Rematch = Callable[[Sequence[Piece], Shared], list[Segment]]
_SHARED = 60  # tracks that the first two views should share
_LEAST = 20
_GATE_PX = 4.0  # of a wrong lens: half a per cent of the image
_TRIES = 200


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Structures and lens that fit what was seen."""

    pieces: list[Piece]
    shared: Shared
    prior: Prior
    sigma_px: float


def prior_of(camera: Camera) -> Prior:
    """Return what is taken of cameras in general."""
    centre = _CENTRE * camera.width
    count = len(camera.coefficients)
    modest = _EQUIDISTANT if camera.distortion == "equidistant" else _RADTAN
    k = [*modest[:count], *[_HELD] * (LENS - 4 - count)]
    nothing = [np.inf] * 3  # of the rotation against the IMU
    sigma = np.array([np.inf, np.inf, centre, centre, *k, _READOUT_S, *nothing, _OFFSET_S, *[_BIAS] * 3, 1.0])
    mean = np.zeros(SHARED)
    mean[2:4] = camera.cx, camera.cy
    return Prior(mean, sigma**-2.0, _ASPECT**-2.0)


def find_lens(segments: Sequence[Segment], camera: Camera, rematch: Rematch | None) -> Solution | None:
    """Return the lens that explains the stretches, beginning at a guess; None where hardly any begins.

    `rematch` finds observations again once structure and lens are roughly known.
    """
    prior = prior_of(camera)
    shared = _swept(segments, camera, prior)
    if shared is None:
        return None
    pieces = begun(segments, shared.camera)
    pieces, shared, _ = adjust(pieces, shared, prior, _only(0, 1, 4, READOUT), _START_PX, _START_STEPS)
    solution = refined(Solution(pieces, shared, _stiffer(prior), scatter_px(pieces, shared)))
    if len(camera.coefficients) == LENS - 4:
        solution = refined(replace(solution, prior=prior))
    if rematch is None:
        return solution
    matched = rematch(solution.pieces, solution.shared)
    pieces = [replace(p, segment=s, kept=_seen(s)) for p, s in zip(solution.pieces, matched, strict=True)]
    return refined(replace(solution, pieces=pieces))


def _stiffer(prior: Prior) -> Prior:
    """Return the prior with the last coefficient held: free from afar it leads astray, left out it bends the rest."""
    information = prior.information.copy()
    information[LENS - 1] = _HELD**-2.0
    return replace(prior, information=information)


def with_gyro(solution: Solution, gyro: Gyro) -> Solution | str:
    """Return the solution with rotation against the IMU and time offset, or why there are none."""
    pairs = []
    for piece in solution.pieces:
        t_ns, R = piece.segment.t_ns.tolist(), piece.at.R
        for gap in (1, 3):
            for i in range(len(R) - gap):
                pairs.append(RotationPair(t_ns[i], t_ns[i + gap], R[i].T @ R[i + gap], _PAIR_RAD**2 * np.eye(3)))
    t_ns = gyro.zero_ns + np.round(gyro.t_s * 1e9).astype(np.int64)
    pairs.sort(key=lambda pair: (pair.t_ns, pair.key_ns))
    found = solve_hand_eye(pairs, t_ns, gyro.rate_rad_s) if len(t_ns) > 1 else None
    if found is None:
        return "fewer than 30 pairs of keyframes are within what the gyroscope recorded; check the stamps of both"
    alike = float(found.correlation[:, 1].max())
    if alike < _LEAST_CORRELATION:
        return (
            f"camera and gyroscope do not turn alike: their speeds correlate by {alike:.2f}, needed are "
            f"{_LEAST_CORRELATION}; check the stamps of both"
        )
    shared = replace(
        solution.shared, gyro=gyro, R_cam_body=found.R_body_cam.T, time_offset_s=found.time_offset_s,
        gyro_bias_rad_s=found.gyro_bias_rad_s,
    )  # fmt: skip
    information = solution.prior.information.copy()
    information[GYRO + SCALE] = gyro.scale_sigma**-2.0
    return refined(replace(solution, shared=shared, prior=replace(solution.prior, information=information)))


def refined(solution: Solution) -> Solution:
    """Return the solution with all unknowns free, every point placed again and judged, round after round."""
    prior, sigma_px = solution.prior, solution.sigma_px
    pieces, shared = solution.pieces, solution.shared
    free = shared.free
    for _ in range(_ROUNDS):
        pieces = [_placed(piece, shared.camera) for piece in pieces]
        for _ in range(2):
            pieces, shared, _ = adjust(pieces, shared, prior, free, max(sigma_px, _LEAST_PX), _STEPS, _DAMPING)
            sigma_px = scatter_px(pieces, shared)
            pieces = [steadied(judged(piece, shared, sigma_px), shared) for piece in pieces]
        pieces = _agreeing(pieces, shared)
    return Solution(pieces, shared, prior, max(sigma_px, _LEAST_PX))


def _agreeing(pieces: list[Piece], shared: Shared) -> list[Piece]:
    """Return the pieces that fit as well as others and keep as many of their observations."""
    scatter = np.array([scatter_px([piece], shared) for piece in pieces])
    share = np.array([piece.kept.sum() / max(_seen(piece.segment).sum(), 1) for piece in pieces])
    good = (scatter < _WORST * np.median(scatter)) & (share > np.median(share) / _WORST)
    return [piece for piece, fits in zip(pieces, good.tolist(), strict=True) if fits]


def begun(segments: Sequence[Segment], camera: Camera) -> list[Piece]:
    """Return the stretches that a lens lets begin."""
    starts = [start_structure(segment, camera) for segment in segments]
    return [Piece(found[0], found[1], _seen(found[0]) & found[2]) for found in starts if found is not None]


def _swept(segments: Sequence[Segment], camera: Camera, prior: Prior) -> Shared | None:
    """Return the lens, of those that the focal lengths tried lead to, which leaves the least residuals."""
    best, least = None, np.inf
    segments = segments[:: max(len(segments) // _TRIED, 1)]
    for factor in _FACTORS:
        start = Shared(replace(camera, fx=factor * camera.fx, fy=factor * camera.fy), 0.0)
        pieces = begun(segments, start.camera)
        if len(pieces) < max(_LEAST_PIECES * len(segments), 1):
            continue
        pieces, shared, _ = adjust(pieces, start, prior, _only(0, 1, 4), _START_PX, _START_STEPS)
        left = scatter_px(pieces, shared)
        if left < least:
            best, least = shared, left
    return best


def _placed(piece: Piece, camera: Camera) -> Piece:
    """Return the piece with all its points triangulated again, also those that were left out."""
    found = placed_points(piece.segment, camera, piece.at.R, piece.at.centre, piece.at.origin)
    if found is None:
        return piece
    return Piece(piece.segment, found[0], _seen(piece.segment) & found[1])


def _seen(segment: Segment) -> Bools:
    return np.isfinite(segment.pixels[:, :, 0])


def _only(*places: int) -> Bools:
    free = np.zeros(SHARED, dtype=np.bool_)
    free[list(places)] = True
    return free


def start_structure(segment: Segment, camera: Camera) -> tuple[Segment, Structure, Bools] | None:
    """Return poses and points as a lens roughly sees them, from two views and then one after the other; None: no fit.

    Returns:
        The stretch with those of its keyframes that found a place, the structure, and which points [m] are placed.
    """
    n, m = segment.pixels.shape[:2]
    xy = camera.normalise(segment.pixels.reshape(-1, 2)).reshape(n, m, 2)
    gate = _GATE_PX * camera.width / 640.0 / camera.fx
    best: Array = np.full((n, 3, 4), np.nan)
    origin = 0
    for first, second in _first_pairs(xy):
        T = _chained(xy, first, second, gate)
        if np.isfinite(T[:, 0, 0]).sum() > np.isfinite(best[:, 0, 0]).sum():
            best, origin = T, first
        if np.isfinite(best[:, 0, 0]).all():
            break
    good = np.isfinite(best[:, 0, 0])
    if good.sum() < LEAST_KEYFRAMES:
        return None
    R = best[good, :, :3].transpose(0, 2, 1)
    centre = -np.einsum("nij,nj->ni", R, best[good, :, 3])
    rest = segment.of(good)
    found = placed_points(rest, camera, R, centre, int(good[:origin].sum()))
    return None if found is None else (rest, *found)


def _chained(xy: Array, first: int, second: int, gate: float) -> Array:
    """Return poses [n, 3, 4] from the stretch to each camera, begun with two of them; NaN where one has no place."""
    T = np.full((len(xy), 3, 4), np.nan)
    found = essential_ransac(None, xy[first], xy[second], gate, _LEAST)
    if found is None:
        return T
    T[first] = np.eye(3, 4)
    T[second] = np.column_stack([found[0].T, -found[0].T @ found[1]])
    middle = (first + second) // 2
    for _ in range(2):  # who did not see enough may do so once others have placed more
        for k in sorted(range(len(xy)), key=lambda k: (abs(k - middle), k)):
            if np.isnan(T[k, 0, 0]):
                T[k] = _resected(*_triangulated(xy, T), xy[k], gate)
    return T


def placed_points(
    segment: Segment, camera: Camera, R: Array, centre: Array, origin: int
) -> tuple[Structure, Bools] | None:
    """Return the structure of known poses, its usual distance 1, and which points [m] have a place; None: too few."""
    xy = camera.normalise(segment.pixels.reshape(-1, 2)).reshape(segment.pixels.shape)
    Rt = R.transpose(0, 2, 1)
    points, known = _triangulated(xy, np.concatenate([Rt, -(Rt @ centre[:, :, None])], axis=2))
    if known.sum() < _LEAST:
        return None
    length = np.maximum(np.linalg.norm(points[:, :3], axis=1), 1e-12)
    rho = np.where(known, points[:, 3] / length, 1.0)
    scale = float(np.median(1.0 / rho[known]))
    ray = np.where(known[:, None], points[:, :3] / length[:, None], [0.0, 0.0, 1.0])
    return Structure(R, centre / scale, ray, np.where(known, rho * scale, 1.0), origin), known


def _first_pairs(xy: Array) -> list[tuple[int, int]]:
    """Return pairs of keyframes about the middle to begin with: far apart, but sharing enough tracks; then nearer."""
    n = len(xy)
    seen = np.isfinite(xy[:, :, 0])
    enough = min(_SHARED, 0.5 * float(np.median(seen.sum(axis=1))))
    halves = [h for h in range(n // 2 - 1, 0, -1) if (seen[n // 2 - h] & seen[n // 2 + h]).sum() >= enough]
    return [
        (n // 2 - h, n // 2 + h) for h in dict.fromkeys([*halves[:1], *halves[len(halves) // 2 :][:1], *halves[-1:]])
    ]


def _triangulated(xy: Array, T: Array) -> tuple[Array, Bools]:
    """Return homogeneous points [m, 4] in the stretch and which [m] two views or more place in front of themselves."""
    placed = np.isfinite(T[:, 0, 0])
    P = T[placed]
    at = np.nan_to_num(xy[placed])
    seen = np.isfinite(xy[placed, :, 0])
    rows = at[..., None] * P[:, None, None, 2] - P[:, None, :2]  # [n, m, 2, 4]
    rows *= seen[..., None, None]
    points = np.linalg.eigh(np.einsum("nmij,nmik->mjk", rows, rows))[1][:, :, 0]
    depth = np.einsum("nj,mj->nm", P[:, 2], points)
    front = np.sum(np.where(seen, np.sign(depth), 0.0), axis=0)
    points = points * np.where(front < 0.0, -1.0, 1.0)[:, None]
    known = (np.abs(front) == seen.sum(axis=0)) & (seen.sum(axis=0) >= 2) & (points[:, 3] > 1e-9)
    return points, known


def _resected(points: Array, known: Bools, xy: Array, gate: float) -> Array:
    """Return the pose [3, 4] from which known points are seen at `xy` [m, 2]; NaN where too few agree."""
    used = known & np.isfinite(xy[:, 0])
    nothing = np.full((3, 4), np.nan)
    if used.sum() < _LEAST:
        return nothing
    places = np.ascontiguousarray(points[used, :3] / points[used, 3:])
    at = np.ascontiguousarray(xy[used])
    try:
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            places, at, np.eye(3), np.zeros(4), iterationsCount=_TRIES, reprojectionError=gate, confidence=0.999,
            flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
        if not ok or inliers is None or len(inliers) < _LEAST // 2:
            return nothing
        good = inliers[:, 0]
        turn, shift = cv2.solvePnPRefineLM(places[good], at[good], np.eye(3), np.zeros(4), turn, shift)
    except cv2.error:  # degenerate samples
        return nothing
    return np.column_stack([so3_exp(np.ravel(turn).astype(np.float64)), np.ravel(shift)])
