"""Do turns that a camera saw fit those of the gyroscope, and if not: focal length, mounting or clock?

Corners are followed over the windows in which the body turns fastest. Their epipolar lines give rotations, with the
derivatives by focal length and readout of a rolling shutter; `imu/gyro_turns.py` compares them with the gyroscope's.
Robust Gauss-Newton finds what makes them fit: offset of the clocks, bias, rotation of the mount, focal length, readout.
Sigmas are the larger of those by the residuals and those by a jackknife over the places. It is the rotation part of
Kalibr (Furgale et al., IROS 2013) with the lens among the unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.angles import angles_of
from vislam.core.camera import Camera
from vislam.core.findings import Finding
from vislam.core.geometry import so3_exp, so3_log
from vislam.core.jackknife import jackknife_variances, moves_without
from vislam.core.messages import Array, ImageU8
from vislam.datasets.plausibility import ImuFacts
from vislam.datasets.tables import Row
from vislam.imu.gyro_turns import SeenTurns, integrated, turn_errors, turns_between
from vislam.vision.features import FlowSettings, follow
from vislam.vision.two_view import TwoViewEstimate, direction_given_rotation, essential_ransac, refine_two_view

_PLACES = 12
_PAIRS = 3  # in a row at each place: what a clock is off shows where the rate changes
_PAIR_S, _FRAME_S = 0.15, 0.03  # of a pair, and of the frames that tracks go over
_SLACK_NS = 300_000_000  # of inertial samples, so that frames can be shifted
_LONGEST_GAP_S = 0.1
_CORNERS = 300
_MIN_TRACKS = 40
_FLOW = FlowSettings(levels=4)
_PIXEL_SIGMA, _INLIER_PX, _CAUCHY = 0.5, 1.5, 3.0
_FLOOR_RAD = 1e-4  # of a visual rotation: none is better
_STEPS = np.array([0.02, 0.002])  # of the last two unknowns, for derivatives
_FOCAL_STARTS = (0.0, 0.08, -0.08, 0.16, -0.16)  # as its logarithm
_ROUNDS = 10
_CONVERGED = 0.02  # sigmas
_MOST_FOCAL, _MOST_OFFSET_S = 0.5, 0.2  # that steps may reach
_MEDIAN_CHI2 = 2.37  # of three degrees of freedom
_OFFSET, _BIAS, _TURN, _FOCAL = 0, slice(1, 4), slice(4, 7), 7  # among the unknowns; the readout is last
_WIDE = np.array([0.1, *[0.1] * 3, *[0.3] * 3, 0.3, 0.03])  # priors: what a motion does not show stays as it is given
_MIN_TURN_RAD = np.deg2rad(3.0)  # a smaller turn shows little beside bias and noise of a few tracks
_MIN_PLACES, _MIN_FIT = 3, 5
_POOR, _WRONG = 0.3, 0.5  # of the turn: 0.5 is an axis 30 deg off
# As sigmas: a board gives 0.3 %, but a MEMS gyroscope's scale is known to 1 or 2 %, and its turns are the measure here;
# a mount is measured to a few tenths of a degree; a shutter's rows share a stamp, and a driver's delay varies.
_GOOD_FOCAL, _GOOD_TURN_RAD, _GOOD_CLOCK_S = 0.015, np.deg2rad(0.5), 0.003
_SURE, _SURE_CHI2 = 3.0, 14.2  # of three degrees of freedom, as likely


class TurnTracks(NamedTuple):
    """Corners followed over one span of frames."""

    place: int
    span_ns: tuple[int, int]
    pixels: tuple[Array, Array]  # [N, 2] in the first and the last frame
    speed_px_s: tuple[Array, Array]  # [N, 2] there


@dataclass(frozen=True, slots=True, eq=False)
class TurnFit:
    """How camera and gyroscope differ and what makes them fit, from turns at several places.

    The unknowns are what to add to the camera's stamps (s), bias (rad/s), turn of the camera's axes to the true ones
    (rad), logarithm of the true over the given focal length, and readout (s).
    """

    differ: float  # median of the difference over the turn, as all was given
    places: int
    x: Array | None = None  # [9] unknowns; None: too few places
    covariance: Array | None = None  # [9, 9]


def turn_places(facts: ImuFacts, frame_t_ns: NDArray[np.int64]) -> list[list[range]]:
    """Return for up to 12 places that turn fastest the frames of each pair, first to last."""
    if len(frame_t_ns) < 2:
        return []
    period_s = max(float(np.median(np.diff(frame_t_ns))) * 1e-9, 1e-4)
    stride = max(1, round(_FRAME_S / period_s))
    steps = max(1, round(_PAIR_S / (stride * period_s)))
    rate = np.linalg.norm(facts.gyro_mean - facts.gyro_bias_rad_s, axis=1)
    taken, begins = np.zeros(len(frame_t_ns), dtype=np.bool_), []
    for window in np.argsort(-rate, kind="stable"):
        begin = int(np.searchsorted(frame_t_ns, facts.window_t_ns[window]))
        end = begin + _PAIRS * steps * stride
        if end >= len(frame_t_ns) or taken[begin:end].any():
            continue
        if frame_t_ns[end] - frame_t_ns[begin] > 1.5e9 * period_s * (end - begin):
            continue  # across a gap
        taken[begin:end] = True
        begins.append(begin)
        if len(begins) == _PLACES:
            break
    length = steps * stride
    return [[range(b + k * length, b + (k + 1) * length + 1, stride) for k in range(_PAIRS)] for b in sorted(begins)]


def follow_turns(
    places: Sequence[Sequence[range]], frame_t_ns: NDArray[np.int64], load: Callable[[int], Sequence[ImageU8]]
) -> list[TurnTracks]:
    """Return corners followed over each pair; those whose images are missing or track badly are left out.

    `load` returns the images of a frame, of which the first is used, or none.
    """
    found = []
    for number, pairs in enumerate(places):
        images = {frame: load(frame) for frame in sorted({frame for pair in pairs for frame in pair})}
        for pair in pairs:
            seen = [images[frame][0] for frame in pair if images[frame]]
            paths = _followed(seen) if len(seen) == len(pair) else None
            if paths is not None:
                span_ns = int(frame_t_ns[pair[0]]), int(frame_t_ns[pair[-1]])
                speed = np.gradient(paths, axis=0, edge_order=2 if len(pair) > 2 else 1)
                speed *= 1e9 * (len(pair) - 1) / (span_ns[1] - span_ns[0])
                found.append(TurnTracks(number, span_ns, (paths[0], paths[-1]), (speed[0], speed[-1])))
    return found


def _followed(images: Sequence[ImageU8]) -> Array | None:
    """Return pixels [F, N, 2] of corners in consecutive images, followed by Lucas-Kanade forth and back."""
    start = cv2.goodFeaturesToTrack(images[0], _CORNERS, 0.01, 12.0)
    if start is None:
        return None
    paths = [start.reshape(-1, 2).astype(np.float64)]
    for before, after in pairwise(images):
        paths.append(follow(before, after, paths[-1], paths[-1], _FLOW)[0])
    kept = np.isfinite(paths[-1]).all(axis=1)
    return np.array(paths)[:, kept] if int(kept.sum()) >= _MIN_TRACKS else None


class _Pairs(NamedTuple):
    """Samples, and the pairs that they cover; times are in seconds from the first sample."""

    tracks: list[TurnTracks]  # [M]
    R_start: list[Array]  # [M] of [3, 3]: R_key_frame, roughly
    t_s: Array  # [N]
    gyro: Array  # [N, 3]
    key_s: Array  # [M]
    frame_s: Array  # [M]


class _Equations(NamedTuple):
    """Differences of turns in axes of the key, NaN where a rotation did not converge."""

    errors: Array  # [M, 3]
    J: Array  # [M, 3, 9] what takes them off
    information: Array  # [M, 3, 3]


def fit_turns(
    camera: Camera,
    R_body_cam: Array,
    tracks: Sequence[TurnTracks],
    rows: Iterable[Row[list[float]]],
    bias_rad_s: Array,
) -> TurnFit | None:
    """Compare the turns of tracks with a gyroscope's and find what makes them fit.

    Args:
        camera: as given.
        R_body_cam: as given [3, 3].
        tracks: of several places, in the order of time.
        rows: inertial ones, in the order of time, whose rates in rad/s come first.
        bias_rad_s: of the gyroscope [3], roughly.

    Returns:
        The fit, or only how turns differ where fewer than five places can be used; None where fewer than three turn.
    """
    pairs = _pairs(camera, tracks, rows, bias_rad_s)
    if pairs is None:
        return None
    R_cam_body = np.ascontiguousarray(R_body_cam.T)
    turns = turns_between(integrated(pairs.t_s, pairs.gyro, np.zeros(3)), pairs.key_s, pairs.frame_s)
    sizes = angles_of(turns)
    shown = sizes > _MIN_TURN_RAD
    where = np.array([one.place for one in pairs.tracks])
    places = len(np.unique(where[shown]))
    if places < _MIN_PLACES:
        return None
    by_gyro = R_cam_body @ turns @ R_cam_body.T
    apart = angles_of(np.array(pairs.R_start).swapaxes(1, 2) @ by_gyro)
    differ = float(np.median(apart[shown] / sizes[shown]))
    return TurnFit(differ, places, *_solve(camera, R_cam_body, pairs, where))


def _pairs(
    camera: Camera, tracks: Sequence[TurnTracks], rows: Iterable[Row[list[float]]], bias_rad_s: Array
) -> _Pairs | None:
    t_ns, gyro = _near(rows, [one.span_ns for one in tracks])
    if not len(t_ns):
        return None
    t_s = np.asarray((t_ns - t_ns[0]) * 1e-9, dtype=np.float64)
    kept, starts, spans = [], [], []
    for one in tracks:
        begin_s, end_s = ((t - int(t_ns[0])) * 1e-9 for t in one.span_ns)
        R = _start(camera, one) if _is_covered(t_s, begin_s, end_s) else None
        if R is not None:
            kept.append(one)
            starts.append(R)
            spans.append((begin_s, end_s))
    key_s, frame_s = np.array(spans).reshape(-1, 2).T.copy()
    return _Pairs(kept, starts, t_s, gyro - bias_rad_s, key_s, frame_s) if kept else None


def _near(rows: Iterable[Row[list[float]]], spans: Sequence[tuple[int, int]]) -> tuple[NDArray[np.int64], Array]:
    """Return stamps [N] and rates [N, 3] of the rows around the spans."""
    t_ns, rates, at = list[int](), list[list[float]](), 0
    for t, values in rows:
        while at < len(spans) and spans[at][1] + _SLACK_NS < t:
            at += 1
        if at == len(spans):
            break
        if t >= spans[at][0] - _SLACK_NS:
            t_ns.append(t)
            rates.append(values[:3])
    return np.array(t_ns, dtype=np.int64), np.array(rates, dtype=np.float64).reshape(-1, 3)


def _is_covered(t_s: Array, begin_s: float, end_s: float) -> bool:
    first, last = int(np.searchsorted(t_s, begin_s, side="right")) - 1, int(np.searchsorted(t_s, end_s))
    return first >= 0 and last < len(t_s) and float(np.diff(t_s[first : last + 1]).max()) < _LONGEST_GAP_S


def _start(camera: Camera, tracks: TurnTracks) -> Array | None:
    views = _views(camera, tracks, 0.0)
    if len(views[0]) < _MIN_TRACKS:
        return None
    # of the two rotations of an essential matrix the one nearer to none: a turn on the spot has no depths to decide by
    found = essential_ransac(np.eye(3), *views, _INLIER_PX / camera.fx, 0)
    return None if found is None else found[0]


def _views(camera: Camera, tracks: TurnTracks, readout_s: float) -> tuple[Array, Array]:
    """Return directions [N, 2] on z = 1 in both frames, each at its frame's stamp, which the middle row has."""
    both = [
        camera.normalise(pixels - speed * (readout_s * (pixels[:, 1:] / camera.height - 0.5)))
        for pixels, speed in zip(tracks.pixels, tracks.speed_px_s, strict=True)
    ]
    usable = np.all(np.isfinite(np.hstack(both)), axis=1)
    return np.ascontiguousarray(both[0][usable]), np.ascontiguousarray(both[1][usable])


def _compare(camera: Camera, R_cam_body: Array, pairs: _Pairs, x: Array, by_lens_too: bool = True) -> _Equations:
    """Return by how much turns differ where the unknowns are at `x`; the search of visual ones starts at the gyro's.

    Without `by_lens_too` derivatives by focal length and readout are left out, and a third of the time is enough.
    """
    turns = integrated(pairs.t_s, pairs.gyro, x[_BIAS])
    R_now = np.ascontiguousarray(so3_exp(x[_TURN].copy()) @ R_cam_body)
    starts = R_now @ turns_between(turns, pairs.key_s + x[_OFFSET], pairs.frame_s + x[_OFFSET]) @ R_now.T
    count = len(pairs.tracks)
    R, by_lens, information = np.full((count, 3, 3), np.nan), np.zeros((count, 3, 2)), np.zeros((count, 3, 3))
    steps = [np.zeros(2), *(np.diag(_STEPS) if by_lens_too else ())]
    for k, (tracks, start) in enumerate(zip(pairs.tracks, starts, strict=True)):
        seen = [_refined(camera, tracks, start, x[_FOCAL:] + step) for step in steps]
        if all(one.converged for one in seen):
            now = R[k] = seen[0].R_key_cam
            if by_lens_too:
                by_lens[k] = np.column_stack([so3_log(one.R_key_cam @ now.T) for one in seen[1:]]) / _STEPS
            information[k] = np.linalg.inv(now @ seen[0].covariance[:3, :3] @ now.T + _FLOOR_RAD**2 * np.eye(3))
    errors, J = turn_errors(turns, SeenTurns(pairs.key_s, pairs.frame_s, R), R_now, x[_OFFSET], 0.0)
    return _Equations(errors, np.concatenate([J[:, :, :_FOCAL], -by_lens], axis=2), information)


def _refined(camera: Camera, tracks: TurnTracks, R: Array, lens: Array) -> TwoViewEstimate:
    """Return the motion that tracks show with a lens [2]: logarithm of the focal length over the given, readout."""
    first, last = _views(camera.with_focal(float(np.exp(lens[0]))), tracks, float(lens[1]))
    direction = direction_given_rotation(R, first, last)
    start = np.array([0.0, 0.0, 1.0]) if direction is None else direction
    return refine_two_view(R, start, first, last, _PIXEL_SIGMA / camera.fx, _CAUCHY)


def _solve(
    camera: Camera, R_cam_body: Array, pairs: _Pairs, where: NDArray[np.int64]
) -> tuple[Array, Array] | tuple[()]:
    """Return the unknowns [9] and their covariance [9, 9]; nothing where places [M] of the pairs are too few."""
    x, prior = np.zeros(len(_WIDE)), np.diag(1.0 / _WIDE**2)
    # a wrong focal length leads rotations astray: the search begins at the one of a few that fits best
    x[_FOCAL] = min(_FOCAL_STARTS, key=lambda start: _misfit(camera, R_cam_body, pairs, start))
    H = g = step = np.zeros(0)
    used = np.zeros(0, dtype=np.bool_)
    for _ in range(_ROUNDS):
        errors, J, information = _compare(camera, R_cam_body, pairs, x)
        used = np.asarray(np.isfinite(errors).all(axis=1), dtype=np.bool_)
        if len(np.unique(where[used])) < _MIN_FIT:
            return ()
        errors = np.where(used[:, None], errors, 0.0)
        chi2 = np.einsum("ni,nij,nj->n", errors, information, errors)
        variance = max(float(np.median(chi2[used])) / _MEDIAN_CHI2, 1e-3)
        weight = used / (variance + chi2 / (3.0 * _CAUCHY**2))
        WJ = (weight[:, None, None] * information) @ J
        H, g = np.einsum("nia,nib->nab", J, WJ), np.einsum("nia,ni->na", WJ, errors)
        step = np.linalg.solve(H.sum(axis=0) + prior, g.sum(axis=0) - prior @ x)
        x_turn = so3_log(so3_exp(step[_TURN].copy()) @ so3_exp(x[_TURN].copy()))
        x = x + step
        x[_TURN] = x_turn
        x[_FOCAL] = np.clip(x[_FOCAL], -_MOST_FOCAL, _MOST_FOCAL)
        x[_OFFSET] = np.clip(x[_OFFSET], -_MOST_OFFSET_S, _MOST_OFFSET_S)
        if float(step @ (H.sum(axis=0) + prior) @ step) < _CONVERGED**2:
            break
    groups = [where == place for place in np.unique(where[used])]
    whole = H.sum(axis=0) + prior
    left_out = moves_without(whole, *(np.array([part[group].sum(axis=0) for group in groups]) for part in (H, -g)))
    covariance = np.linalg.inv(whole)
    wider = np.sqrt(np.maximum(1.0, jackknife_variances(left_out) / np.diag(covariance)))
    # where two minima of some pair take turns, the last step shows how far the answer is from settled
    return x, covariance * np.outer(wider, wider) + np.outer(step, step)


def _misfit(camera: Camera, R_cam_body: Array, pairs: _Pairs, focal: float) -> float:
    x = np.zeros(len(_WIDE))
    x[_FOCAL] = focal
    errors, _, information = _compare(camera, R_cam_body, pairs, x, by_lens_too=False)
    chi2 = np.einsum("ni,nij,nj->n", errors, information, errors)
    return float(np.median(np.where(np.isfinite(chi2), chi2, np.inf)))


def judged_turns(
    camera: Camera,
    R_body_cam: Array,
    tracks: Sequence[TurnTracks],
    rows: Callable[[], Iterable[Row[list[float]]]],
    bias_rad_s: Array,
    name: str = "cam0",
) -> list[Finding]:
    """Judge how turns of tracks fit a gyroscope's, as `fit_turns` takes them; where they do not, the inverse is tried.

    `name` is the camera's. Empty where fewer than three places turn. `rows` begins again at every call.
    """
    fit = fit_turns(camera, R_body_cam, tracks, rows(), bias_rad_s)
    if fit is None:
        return []
    inverse = fit_turns(camera, R_body_cam.T, tracks, rows(), bias_rad_s) if fit.differ > _WRONG else None
    return turn_findings(fit, None if inverse is None else inverse.differ, name)


def turn_findings(fit: TurnFit, inverse_differs: float | None = None, name: str = "cam0") -> list[Finding]:
    """Judge what would make camera and gyroscope fit: wrong is what its sigma and a good calibration do not explain.

    `inverse_differs` is as `fit.differ`, with the inverse of the rotation.
    """
    what = f"turns seen by {name} and by the gyro differ by {100.0 * fit.differ:.0f} % in {fit.places} places"
    if fit.differ > _WRONG:
        step = "check the rotation in T_BS (is it the camera in the body, not the body in the camera?) and the clocks"
        if inverse_differs is not None and inverse_differs < _WRONG:
            step = f"with the inverse they differ by {100.0 * inverse_differs:.0f} %: write the inverse of its pose"
        return [Finding("error", f"{what}: extrinsics or time stamps are wrong", name, step)]
    judged = [] if fit.x is None or fit.covariance is None else _judged(fit.x, fit.covariance, name)
    wrong = [Finding("warning", f"by the gyro's turns {text}", name, step) for bad, text, step in judged if bad]
    if not wrong and fit.differ > _POOR:
        return [Finding("warning", what, name, "check the rotation in T_BS and the clocks")]
    found = ", ".join(text for _, text, _ in judged)
    return wrong or [Finding("ok", f"{what}: {found}" if found else what, name)]


def _judged(x: Array, covariance: Array, name: str) -> list[tuple[bool, str, str]]:
    """Return for focal length, rotation and clock whether it is wrong, what was found and what to do then."""
    sigma, turn, spread = np.sqrt(np.diag(covariance)), x[_TURN], covariance[_TURN, _TURN]
    is_focal = abs(x[_FOCAL]) > _SURE * np.hypot(sigma[_FOCAL], _GOOD_FOCAL)
    is_turn = turn @ np.linalg.solve(spread + _GOOD_TURN_RAD**2 * np.eye(3), turn) > _SURE_CHI2
    is_clock = abs(x[_OFFSET]) > _SURE * np.hypot(sigma[_OFFSET], _GOOD_CLOCK_S)
    off, angle = np.expm1(-x[_FOCAL]), max(float(np.linalg.norm(turn)), 1e-12)
    about = np.sqrt(turn @ spread @ turn) / angle
    return [
        (
            bool(is_focal),
            f"the focal length is {100.0 * abs(off):.1f} ± {100.0 * sigma[_FOCAL] * (1.0 + off):.1f} % too "
            f"{'long' if off > 0.0 else 'short'}",
            "check intrinsics and size of the images; `vislam calibrate camera` measures them",
        ),
        (
            bool(is_turn),
            f"{name} is turned by {np.rad2deg(angle):.1f} ± {np.rad2deg(about):.1f} deg against its T_BS",
            "check the rotation in T_BS; `vislam calibrate camera-imu` measures it",
        ),
        (
            bool(is_clock),
            f"its stamps are {1e3 * abs(x[_OFFSET]):.1f} ± {1e3 * sigma[_OFFSET]:.1f} ms "
            f"{'late' if x[_OFFSET] < 0.0 else 'early'}",
            f"`--init.time-offset-s {x[_OFFSET]:.4f}` makes up for it; `vislam calibrate camera-imu` measures it",
        ),
    ]  # fmt: skip
