"""Where depth with a lens of its own sits beside colour, how long its focal length is and how late it comes.

Where foregrounds of registered depth end, the image has edges. Across every end the image's gradient is read; what is
wrong with place, focal length and lag moves all ends by amounts that depend on where they are, how far and how fast.
The parameters under which most gradient lies at the ends are searched, coarse to fine, from several focal lengths.
Depth is registered again with what was found, three times. A shift of the principal point moves ends as a turn does,
and is not distinguished.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import cv2
import numpy as np

from vislam.core.angles import angles_of
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.core.jackknife import jackknife_variances
from vislam.core.messages import Array, ImageF32, ImageU8
from vislam.core.progress import Progress, silent
from vislam.core.recording import Problems
from vislam.datasets.images import DepthFormat
from vislam.datasets.stream import Survey, frame_table, open_loader, with_depth_format
from vislam.vision.depth_edges import foreground_ends
from vislam.vision.depth_registration import DepthCamera

_FRAMES, _FEW_FRAMES, _GLANCE_FRAMES = 80, 20, 12  # to measure, to compare, to see whether there is a need to
_FOCAL_STARTS = tuple(1.15**k for k in range(-4, 4))  # of that stated, 0.57 to 1.52: a search reaches half a step
_ENDS = 300  # of a frame
_ROUNDS = ((32, (8.0, 4.0)), (20, (4.0, 2.0)), (12, (2.0, 1.2)))  # px: reach of a profile, and blurs of it in turn
_NORMAL_SIGMA_PX = 2.0
_FLAT_GREY = 60.0  # gradients of a profile that count as much as this sum are noise
# before anything is measured: turn in rad, place in m, focal length, lag in s, and by how many px foregrounds are wider
_PRIOR = np.array([0.03, 0.03, 0.03, 0.05, 0.05, 0.03, 0.05, 0.04, 2.0])
_WEIGHT = 0.05  # of an end against the prior: ends of one foreground err together
_GROUPS = 12
_WIDER = 3.0  # what all parts of a recording share (drawn scenes: up to 3 sigmas) no part shows that is left out
_LEAST_FRAMES = 12
_LEAST_ENDS = 2000
# gradient at the ends over what lies around them, of depth at its place: 1.5 to 2.0 in 8 frames of two recordings, 0.9
# to 1.15 where it has another lens
_MET = 1.3
_SURE = 2.5  # sigmas beyond nothing
_WIDTH_PX = 640.0  # of images in which that was seen


@dataclass(frozen=True, slots=True, eq=False)
class PlaceFit:
    """How depth is read as found, with sigmas by leaving out parts of the recording in turn (jackknife)."""

    how: DepthFormat
    turn_sigma_rad: Array  # [3]
    place_sigma_m: Array  # [3]
    focal_sigma: float  # relative, of depth
    lag_sigma_s: float
    ends: int

    def moves(self, own: DepthCamera) -> bool:
        """Whether depth surely sits elsewhere than `own` has it, or has another focal length."""
        assert self.how.own is not None
        moved = se3_log(self.how.own.T_color_depth @ invert(own.T_color_depth))
        longer = self.how.own.camera.fx / own.camera.fx - 1.0
        sigmas = np.array([*self.turn_sigma_rad, *self.place_sigma_m, self.focal_sigma])
        return bool((np.abs([*moved, longer]) > _SURE * sigmas).any())

    @property
    def words(self) -> tuple[str, ...]:
        """Where depth is, how long its focal length is and how late it comes."""
        own = self.how.own
        assert own is not None
        mm, sigma_mm = 1e3 * own.T_color_depth[:3, 3], 1e3 * self.place_sigma_m
        turn_deg = np.rad2deg(angles_of(own.T_color_depth[None, :3, :3])[0])
        where = ", ".join(f"{x:.1f} ± {s:.1f}" for x, s in zip(mm, sigma_mm, strict=True))
        return (
            f"depth sits at {where} mm right of, below and ahead of colour",
            f"it is turned by {turn_deg:.2f} ± {np.rad2deg(np.linalg.norm(self.turn_sigma_rad)):.2f}°",
            f"its focal length is {own.camera.fx:.1f} ± {self.focal_sigma * own.camera.fx:.1f} px",
            f"it is late by {-1e3 * self.how.time_offset_s:.1f} ± {1e3 * self.lag_sigma_s:.1f} ms",
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Ends:
    """Ends of foregrounds in one frame: profiles [N, 2 R + 1] across them and what each parameter moves [N, 9] px."""

    profiles: Array
    moves: Array
    given_px: Array  # [N] by which they are moved in any case, as depth and colour are stamped


def misplaced(found: Survey, rig: Rig, progress: Progress = silent) -> PlaceFit | None:
    """Find depth that is not where it is stated to be, be it registered or with a lens of its own; None: it is.

    None also where too few foregrounds end, or nothing makes them meet edges of the image. Raises as `fit_place`.
    """
    if np.count_nonzero(frame_table(found, Problems()).depth_rows >= 0) < _LEAST_FRAMES:
        return None
    stated = _met_at_a_glance(found, rig)
    if stated is None or stated > _MET or (fit := fit_place(found, rig, progress)) is None:
        return None
    at_fit = _met_at_a_glance(with_depth_format(found, fit.how), rig)
    is_better = at_fit is not None and at_fit > max(_MET, _MET * stated)
    return fit if is_better and fit.moves(_stated(found, rig)) else None


def _met_at_a_glance(found: Survey, rig: Rig) -> float | None:
    """Return how much more gradient a few frames have at the ends than around them; None where too few end."""
    (reach, blurs), scale = _ROUNDS[0], rig.cameras[0].width / _WIDTH_PX
    seen = _walk(found, rig, round(reach * scale), silent, _GLANCE_FRAMES)
    if not _is_enough(seen, _GLANCE_FRAMES / _FRAMES):
        return None
    return _Search(seen, blurs[-1] * scale).met(np.zeros(len(_PRIOR)))


def fit_place(found: Survey, rig: Rig, progress: Progress = silent) -> PlaceFit | None:
    """Find place, focal length and lag of depth; None where too few foregrounds end.

    Depth that is stated to be registered is looked for beside colour, with a lens like it. Raises DataError when an
    image is not of the calibrated size.
    """
    how = _start(found, rig, progress)
    theta, frames = np.zeros(len(_PRIOR)), list[_Ends]()
    for reach, blurs in _ROUNDS:
        frames = _walk(with_depth_format(found, how), rig, reach, progress)
        if not _is_enough(frames):
            return None
        theta = _found(frames, blurs)
        how = _changed(how, theta)
    # the neighbours of a frame show the same ends: whole stretches are left out
    groups = [frames[k * len(frames) // _GROUPS : (k + 1) * len(frames) // _GROUPS] for k in range(_GROUPS)]
    parts = [[one for other in groups if other is not group for one in other] for group in groups]
    blurs = _ROUNDS[-1][1]
    sigma = _WIDER * np.sqrt(jackknife_variances(np.array([_found(part, blurs) for part in parts])))
    count = sum(len(one.profiles) for one in frames)
    return PlaceFit(how, sigma[:3], sigma[3:6], float(sigma[6]), float(sigma[7]), count)


def _stated(found: Survey, rig: Rig) -> DepthCamera:
    """Return where depth is stated to be; registered depth has colour's lens, but for what undistorting it did."""
    straight = replace(rig.cameras[0], distortion="none", coefficients=())
    return found.depth_format.own or DepthCamera(straight, np.eye(4))


def _start(found: Survey, rig: Rig, progress: Progress) -> DepthFormat:
    """Return the lens to begin with: the focal length from which most gradient is met."""
    how, (reach, blurs) = found.depth_format, _ROUNDS[0]
    stated, tried = _stated(found, rig), []
    for n, factor in enumerate(_FOCAL_STARTS):
        progress(n + 1, len(_FOCAL_STARTS), "lens of depth")
        start = replace(how, own=DepthCamera(stated.camera.with_focal(factor), stated.T_color_depth))
        frames = _walk(with_depth_format(found, start), rig, reach, silent, _FEW_FRAMES)
        if frames:
            tried.append((_Search(frames, blurs[-1]).met(_found(frames, blurs)), start))
    return max(tried, key=lambda one: one[0])[1] if tried else replace(how, own=stated)


def _is_enough(frames: list[_Ends], share: float = 1.0) -> bool:
    count = sum(len(one.profiles) for one in frames)
    return len(frames) >= share * _LEAST_FRAMES and count >= share * _LEAST_ENDS


def _found(frames: list[_Ends], blurs: Sequence[float]) -> Array:
    """Return the parameters [9] that a search finds, from coarse to fine."""
    theta = np.zeros(len(_PRIOR))
    for blur in blurs:
        theta = _Search(frames, blur).best(theta)
    return theta


def _changed(how: DepthFormat, theta: Array) -> DepthFormat:
    assert how.own is not None
    T = se3_exp(theta[:6]) @ how.own.T_color_depth
    lens = how.own.camera.with_focal(1.0 + float(theta[6]))
    return replace(how, own=DepthCamera(lens, np.asarray(T)), time_offset_s=how.time_offset_s - float(theta[7]))


def _walk(found: Survey, rig: Rig, reach: int, progress: Progress, most: int = _FRAMES) -> list[_Ends]:
    frames = frame_table(found, Problems())
    assert found.depth is not None
    usable = np.flatnonzero(frames.depth_rows[:-1] >= 0)
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, most).astype(int))] if len(usable) else usable
    out = []
    flow_of = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    without_depth = replace(frames, depth_rows=np.full_like(frames.depth_rows, -1))  # registering it is what costs
    with (
        closing(open_loader(found, rig, frames, 1)) as loader,
        closing(open_loader(found, rig, without_depth, 1)) as following,
    ):
        for n, i in enumerate(chosen.tolist()):
            progress(n + 1, len(chosen), "place of depth")
            here, there = loader.load(i), following.load(i + 1)
            if here.depth_m is None or not there.images:
                continue
            image = here.images[0]
            flow = flow_of.calc(image, there.images[0], np.zeros((*image.shape, 2), np.float32))
            speed = np.asarray(flow, np.float32) / np.float32((frames.t_ns[i + 1] - frames.t_ns[i]) * 1e-9)
            delay_s = float(found.depth.t_ns[frames.depth_rows[i]] - frames.t_ns[i]) * 1e-9
            out.append(_ends(rig.cameras[0], here.depth_m, image, speed, delay_s, reach))
    return [one for one in out if len(one.profiles)]


def _ends(camera: Camera, depth_m: ImageF32, image: ImageU8, speed: ImageF32, delay_s: float, reach: int) -> _Ends:
    """Return ends of foregrounds in registered depth [H, W] with the image's gradient across them."""
    pixels, inside = foreground_ends(depth_m)
    pixels, inside = pixels[:: max(1, -(-len(pixels) // _ENDS))], inside[:: max(1, -(-len(pixels) // _ENDS))]
    if not len(pixels):
        return _Ends(np.empty((0, 2 * reach + 1)), np.empty((0, len(_PRIOR))), np.empty(0))
    with np.errstate(divide="ignore"):
        rho = np.where(depth_m > 0.0, 1.0 / depth_m, 0.0).astype(np.float32)
    # what nothing was measured of beside a foreground lies behind it
    smooth = cv2.GaussianBlur(rho, (0, 0), _NORMAL_SIGMA_PX)
    u, v = pixels.T
    normal = np.column_stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0)[v, u], cv2.Sobel(smooth, cv2.CV_32F, 0, 1)[v, u]])
    normal = normal.astype(np.float64)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    grey = cv2.GaussianBlur(image, (0, 0), 1.0)
    at = pixels[:, None, :] + normal[:, None, :] * np.arange(-reach, reach + 1.0)[:, None]
    x, y = np.ascontiguousarray(at.reshape(-1, 2).T, dtype=np.float32)
    slopes = [
        cv2.remap(cv2.Sobel(grey, cv2.CV_32F, 1 - axis, axis), x, y, cv2.INTER_LINEAR).reshape(at.shape[:2])
        for axis in (0, 1)
    ]
    profiles = np.abs(slopes[0] * normal[:, :1] + slopes[1] * normal[:, 1:])
    profiles /= profiles.sum(axis=1, keepdims=True) + _FLAT_GREY
    rays = camera.unproject(pixels.astype(np.float64))
    J = np.einsum("ni,nij->nj", normal, camera.project_jacobian(rays))
    velocity = speed[inside[:, 1], inside[:, 0]].astype(np.float64)  # of the foreground, to which the edge belongs
    along = np.sum(normal * velocity, axis=1)
    moves = np.column_stack([
        np.cross(rays, J), J * rho[v, u][:, None], -np.sum(J[:, :2] * rays[:, :2], axis=1), along, np.ones(len(J)),
    ])  # fmt: skip
    usable = np.isfinite(moves).all(axis=1)
    return _Ends(profiles[usable], moves[usable], (-along * delay_s)[usable])


class _Search:
    """Looks for the parameters under which most gradient lies at the ends."""

    def __init__(self, frames: list[_Ends], blur: float) -> None:
        profiles, size = np.vstack([one.profiles for one in frames]).astype(np.float32), 2 * int(3 * blur) + 1
        self._profiles = cv2.GaussianBlur(profiles, (size, 1), blur, sigmaY=0.1, borderType=cv2.BORDER_REPLICATE)
        self._moves = np.vstack([one.moves for one in frames]) * _PRIOR
        self._given = np.concatenate([one.given_px for one in frames])
        self._mean = float(profiles.mean())

    def met(self, theta: Array) -> float:
        """Return the gradient at the ends over what lies around them, by parameters [9]."""
        return float(self._at(theta / _PRIOR)[0].mean()) / self._mean

    def best(self, start: Array) -> Array:
        """Return the best parameters [9]."""
        from scipy.optimize import minimize  # doctor seldom comes here

        weight = _WEIGHT / self._mean

        def cost(x: Array) -> tuple[float, Array]:
            value, slope = self._at(x)
            return float(0.5 * x @ x - weight * value.sum()), x - weight * (slope @ self._moves)

        return np.asarray(minimize(cost, start / _PRIOR, jac=True, method="L-BFGS-B").x) * _PRIOR

    def _at(self, x: Array) -> tuple[Array, Array]:
        """Return the gradient [N] at the ends, and its derivatives by where they are.

        By quadratic B-splines: a kink at whole pixels would end the search where it begins, for ends lie on these.
        """
        reach = self._profiles.shape[1] // 2
        given = self._given + self._moves @ x + reach
        place = np.clip(given, 1.0, 2.0 * reach - 1.0)
        rows, middle = np.arange(len(place)), np.rint(place).astype(np.int64)
        t = place - middle
        low, here, high = (self._profiles[rows, middle + k] for k in (-1, 0, 1))
        value = 0.5 * (0.5 - t) ** 2 * low + (0.75 - t**2) * here + 0.5 * (0.5 + t) ** 2 * high
        slope = (t - 0.5) * low - 2.0 * t * here + (t + 0.5) * high
        return value, np.where(place == given, slope, 0.0)
