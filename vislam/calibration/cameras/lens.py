"""Intrinsics of a camera from views of a board: Zhang's method through OpenCV, then our own refinement with sigmas.

Zhang, "A flexible new technique for camera calibration", PAMI 2000. OpenCV gives no sigmas for fisheye lenses and none
that hold when the errors of one view belong together (a bent board, blur). Here all models are refined by
Gauss-Newton on `vislam.core.camera.Camera`, the poses eliminated; sigmas come from the scatter of residuals, or from
leaving out one view at a time (a jackknife of one step) where that is larger.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np

from vislam.calibration.cameras.board import View
from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import se3_exp, so3_exp, transform
from vislam.core.jackknife import jackknife_variances, moves_without
from vislam.core.lens import Distortion
from vislam.core.messages import Array, Bools

WIDE: Mapping[str, Distortion] = {"ucm": "ucm", "eucm": "eucm", "ds": "ds", "omni": "omni"}

_FOCALS = np.geomspace(0.1, 2.0, 22)  # of the image's width
_XI = -0.2  # of a usual double sphere
_LOST_PX = 1e3  # of a view whose board no pose explains
Model = Literal["radtan", "radtan5", "equidistant", "ucm", "eucm", "ds", "omni"]

COEFFICIENTS: dict[Model, int] = {"radtan": 4, "radtan5": 5, "equidistant": 4}  # of planar models
_ITERATIONS = 30
_CONVERGED = 1e-4  # px: of all residuals together that a step still changes
_OUTLIER_SIGMAS = 5.0
_MIN_SIGMA_PX = 0.02  # corners are not found better
_STEP = 1e-6  # of numerical derivatives, relative for focal lengths
_DAMPING = 1e-9


def unified_start(views: list[View], size: tuple[int, int]) -> tuple[Camera, list[Array]]:
    """Return a unified camera of `size` (width, height) that explains most views roughly, and T_cam_board [4, 4] each.

    With alpha = 1/2 it is about as wide as lenses of 120 to 200 degrees are, whatever they are made of: then only the
    focal length is to be tried (Mei and Rives, ICRA 2007, begin at xi = 1, which is the same). Poses come from
    homographies in views turned towards the board, so that one beside or behind the camera is as good as one before it.
    Raises DataError where none does.
    """
    width, height = size
    best: tuple[float, Camera, list[Array]] | None = None
    for focal_px in _FOCALS * width:
        camera = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, 0.0, "ucm", (0.5,))
        placed = [_place(camera, view) for view in views]
        error_px = float(np.mean([min(error, _LOST_PX) for error, _ in placed]))
        if best is None or error_px < best[0]:
            best = error_px, camera, [T for _, T in placed]
    if best is None or best[0] >= _LOST_PX:
        raise DataError("the views do not give a camera: no focal length explains them")
    return best[1], best[2]


def from_unified(camera: Camera, model: Distortion) -> Camera:
    """Return a unified camera as one of a model that contains it."""
    (alpha,) = camera.coefficients
    if model == "ds":
        return _nearest_double(camera)
    k = {"ucm": (alpha,), "eucm": (alpha, 1.0), "omni": (alpha / (1.0 - alpha), 0.0, 0.0, 0.0, 0.0)}
    return replace(camera, distortion=model, coefficients=k[model])


def _nearest_double(camera: Camera) -> Camera:
    """Return the double sphere most like a unified camera whose first sphere is not at 0, where both do the same."""
    angles = np.linspace(0.0, 1.6, 33)
    rays = np.column_stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)])
    doubles = [replace(camera, distortion="ds", coefficients=(_XI, alpha)) for alpha in np.linspace(0.02, 0.98, 97)]
    apart = [np.nan_to_num(np.abs(ds.project(rays) - camera.project(rays)), nan=_LOST_PX).sum() for ds in doubles]
    return doubles[int(np.argmin(apart))]


def _place(camera: Camera, view: View) -> tuple[float, Array]:
    """Return the rms error of a board [px] at its best pose, and the pose; infinite where there is none."""
    nowhere = float("inf"), np.eye(4)
    rays = camera.bearings(view.pixels)
    seen = np.isfinite(rays).all(axis=1)
    if seen.sum() < 4:
        return nowhere
    middle = rays[seen].mean(axis=0)
    # rows of R are axes of a view whose z points at the board
    R = np.linalg.svd(middle[None])[2][[1, 2, 0]]
    R[2] *= np.sign(R[2] @ middle)
    R[0] *= np.linalg.det(R)
    turned = rays @ R.T
    seen &= turned[:, 2] > 0.05
    H = cv2.findHomography(view.points_m[seen, :2], turned[seen, :2] / turned[seen, 2:])[0] if seen.sum() >= 4 else None
    if H is None:
        return nowhere
    H = H / np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1])) * np.sign(H[2] @ [*view.points_m[0, :2], 1.0])
    u, _, vt = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    T = transform(R.T @ (u @ vt), R.T @ H[:, 2])
    errors = view.pixels - camera.project(view.points_m @ T[:3, :3].T + T[:3, 3])
    squares = np.nan_to_num(np.sum(errors**2, axis=1), nan=_LOST_PX**2)
    return float(np.sqrt(np.mean(squares))), T


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A calibrated camera and how well it is known."""

    camera: Camera
    covariance: Array  # [P, P] of fx, fy, cx, cy, the skew if it was estimated, then the coefficients
    T_cam_board: tuple[Array, ...]  # [4, 4] per view
    residuals_px: tuple[Array, ...]  # [N, 2] per view, NaN where left out as outlier
    rms_px: float  # over both coordinates of a corner together, as OpenCV reports it
    outliers: int
    grouping: float  # variance between views over that which independent corners explain; 1 when they are independent
    with_skew: bool = False

    @property
    def names(self) -> list[str]:
        """The names of the parameters."""
        return parameter_names(self.camera, self.with_skew)

    @property
    def values(self) -> Array:
        """The parameters [P]; focal lengths, principal point and skew in pixels."""
        return parameters_of(self.camera, self.with_skew)

    @property
    def sigmas(self) -> Array:
        """Standard deviations [P] of the parameters."""
        return np.sqrt(np.diag(self.covariance))


def fit_lens(views: list[View], size: tuple[int, int], model: Model, with_skew: bool = False) -> LensFit:
    """Calibrate a camera of `size` (width, height); raises DataError when the views do not determine it at all.

    `with_skew` estimates s of K = [[fx, s, cx], [0, fy, cy], [0, 0, 1]] as well, which is 0 else.
    """
    camera, poses = _start(views, size, model)
    good = [np.ones(len(view.points_m), dtype=np.bool_) for view in views]
    for _ in range(2):
        camera, poses = _refine(camera, poses, views, good, with_skew)
        residuals = [_residuals(camera, T, view) for T, view in zip(poses, views, strict=True)]
        every = np.concatenate(residuals)
        scatter = max(1.4826 * float(np.nanmedian(np.abs(every))), _MIN_SIGMA_PX)
        good = [np.all(np.abs(r) < _OUTLIER_SIGMAS * scatter, axis=1) for r in residuals]  # NaN is no good either
        if all(g.all() for g in good) or min(int(g.sum()) for g in good) < 4:
            break
    else:
        camera, poses = _refine(camera, poses, views, good, with_skew)
    return _judge(camera, poses, views, good, with_skew)


def _start(views: list[View], size: tuple[int, int], model: Model) -> tuple[Camera, list[Array]]:
    if model in WIDE:
        camera, poses = unified_start(views, size)
        good = [np.ones(len(view.points_m), dtype=np.bool_) for view in views]
        camera, poses = _refine(camera, poses, views, good, False)
        return from_unified(camera, WIDE[model]), poses
    points = [view.points_m.astype(np.float32)[:, None] for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    try:
        if model == "equidistant":
            owner: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 4 and 5
            flags = owner.CALIB_RECOMPUTE_EXTRINSIC | owner.CALIB_FIX_SKEW
            _, K, k, rotations, translations = cv2.fisheye.calibrate(
                [p.transpose(1, 0, 2) for p in points], [p.transpose(1, 0, 2) for p in pixels], size,
                np.eye(3), np.zeros(4), flags=flags,
            )  # fmt: skip
        else:
            flags = 0 if model == "radtan5" else cv2.CALIB_FIX_K3
            _, K, k, rotations, translations, _, _, _ = cv2.calibrateCameraExtended(
                points, pixels, size, np.eye(3), np.zeros(5), flags=flags
            )
        coefficients = tuple(np.ravel(k)[: COEFFICIENTS[model]].tolist())
        camera = Camera(
            size[0], size[1], K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0.0,
            "equidistant" if model == "equidistant" else "radtan", coefficients,
        )  # fmt: skip
    except (cv2.error, DataError) as error:
        raise DataError(
            f"the views do not give a {model} camera: {' '.join(str(error).split())[:120]}; tilt the board more, show "
            "it everywhere in the image, or try another --model"
        ) from error
    poses = [
        transform(so3_exp(np.ravel(r).astype(np.float64)), np.ravel(t).astype(np.float64))
        for r, t in zip(rotations, translations, strict=True)
    ]
    return camera, poses


def parameter_names(camera: Camera, with_skew: bool = False) -> list[str]:
    """Return the names of what `parameters_of` returns."""
    k = camera.model.names[: len(camera.coefficients)]
    return ["fx", "fy", "cx", "cy", *(["s"] if with_skew else []), *k]


def parameters_of(camera: Camera, with_skew: bool = False) -> Array:
    """Return fx, fy, cx, cy, the skew if asked for, and the coefficients [P]."""
    skew = [camera.skew_px] if with_skew else []
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *skew, *camera.coefficients])


def with_parameters(camera: Camera, x: Array, with_skew: bool = False) -> Camera:
    """Return the camera with other parameters [P]."""
    fx, fy, cx, cy, *k = x.tolist()
    skew_px = k.pop(0) if with_skew else camera.skew_px
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, skew_px=skew_px, coefficients=tuple(k))


def by_parameters(camera: Camera, points_cam_m: Array, with_skew: bool = False) -> Array:
    """Return the derivative [N, 2, P] of pixels by the camera's parameters at points [N, 3]."""
    x = parameters_of(camera, with_skew)
    steps = _STEP * np.where(np.arange(len(x)) < 4, np.maximum(np.abs(x), 1.0), 1.0)
    out = np.empty((len(points_cam_m), 2, len(x)))
    for p, step in enumerate(steps):
        d = np.zeros(len(x))
        d[p] = step
        ahead, behind = (with_parameters(camera, at, with_skew) for at in (x + d, x - d))
        out[:, :, p] = (ahead.project(points_cam_m) - behind.project(points_cam_m)) / (2.0 * step)
    return out


def _residuals(camera: Camera, T_cam_board: Array, view: View) -> Array:
    return np.asarray(view.pixels - camera.project(view.points_m @ T_cam_board[:3, :3].T + T_cam_board[:3, 3]))


@dataclass(slots=True)
class _Block:
    """One view linearised: what it contributes to the parameters once its pose is eliminated."""

    H: Array  # [P, P]
    g: Array  # [P]
    solve_pose: Array  # [6, rows]
    A: Array  # [rows, P]
    r: Array  # [rows]


def _blocks(camera: Camera, poses: list[Array], views: list[View], good: list[Bools], with_skew: bool) -> list[_Block]:
    """Linearise all views; the cameras with other parameters are made once for all of them."""
    points = [v.points_m[g] @ T[:3, :3].T + T[:3, 3] for T, v, g in zip(poses, views, good, strict=True)]
    ends = np.cumsum([len(p) for p in points])[:-1]
    every = np.split(by_parameters(camera, np.concatenate(points), with_skew), ends)
    return [
        _block(camera, T, view, g, p, A) for T, view, g, p, A in zip(poses, views, good, points, every, strict=True)
    ]


def _block(camera: Camera, T: Array, view: View, good: Bools, points: Array, by_parameter: Array) -> _Block:
    r = (view.pixels[good] - camera.project(points)).ravel()
    A = by_parameter.reshape(len(r), by_parameter.shape[2])
    by_point = camera.project_jacobian(points)  # [N, 2, 3]
    board = view.points_m[good]
    turned = np.zeros((len(board), 3, 6))  # T exp(xi): rotation of the board's points on its own side
    turned[:, 0, 1], turned[:, 0, 2] = board[:, 2], -board[:, 1]
    turned[:, 1, 0], turned[:, 1, 2] = -board[:, 2], board[:, 0]
    turned[:, 2, 0], turned[:, 2, 1] = board[:, 1], -board[:, 0]
    turned[:, :, 3:] = np.eye(3)
    B = np.einsum("nij,jk,nkl->nil", by_point, T[:3, :3], turned).reshape(len(r), 6)
    usable = np.isfinite(r) & np.isfinite(A).all(axis=1) & np.isfinite(B).all(axis=1)
    A, B, r = A[usable], B[usable], r[usable]
    solve_pose = np.linalg.pinv(B)
    reduced = A - B @ (solve_pose @ A)
    return _Block(reduced.T @ reduced, reduced.T @ r, solve_pose, A, r)


def _refine(
    camera: Camera, poses: list[Array], views: list[View], good: list[Bools], with_skew: bool
) -> tuple[Camera, list[Array]]:
    for _ in range(_ITERATIONS):
        blocks = _blocks(camera, poses, views, good, with_skew)
        H = np.sum([block.H for block in blocks], axis=0)
        g = np.sum([block.g for block in blocks], axis=0)
        scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        try:
            step = np.linalg.solve(H / np.outer(scale, scale) + _DAMPING * np.eye(len(g)), g / scale) / scale
            camera = with_parameters(camera, parameters_of(camera, with_skew) + step, with_skew)
        except (np.linalg.LinAlgError, DataError) as error:
            raise DataError("the views do not determine the camera; tilt the board to all sides") from error
        poses = [
            T @ se3_exp(block.solve_pose @ (block.r - block.A @ step)) for T, block in zip(poses, blocks, strict=True)
        ]
        if float(np.max(np.abs(step * scale))) < _CONVERGED:
            break
    return camera, poses


def _judge(camera: Camera, poses: list[Array], views: list[View], good: list[Bools], with_skew: bool) -> LensFit:
    blocks = _blocks(camera, poses, views, good, with_skew)
    H = np.sum([block.H for block in blocks], axis=0)
    if np.linalg.matrix_rank(H / np.sqrt(np.outer(np.diag(H), np.diag(H)))) < len(H):
        raise DataError("the views do not determine the camera; tilt the board to all sides")
    squares = float(sum(block.r @ block.r for block in blocks))
    rows = sum(len(block.r) for block in blocks)
    white = squares / max(rows - len(H) - 6 * len(views), 1) * np.linalg.inv(H)
    moves = moves_without(H, np.array([block.H for block in blocks]), np.array([block.g for block in blocks]))
    grouping = max(1.0, float(np.median(jackknife_variances(moves) / np.diag(white))))
    residuals = []
    for T, view, g in zip(poses, views, good, strict=True):
        r = _residuals(camera, T, view)
        r[~g] = np.nan
        residuals.append(r)
    outliers = int(sum((~g).sum() for g in good))
    rms = float(np.sqrt(squares / (rows / 2.0)))
    return LensFit(camera, white * grouping, tuple(poses), tuple(residuals), rms, outliers, grouping, with_skew)


def direction_sigma_px(fit: LensFit, columns: int, rows: int) -> Array:
    """Return by how many pixels (1 sigma) rays are off over a grid [rows, columns], but for a turn of them all.

    A turn that all rays share is no error of a lens: the pose of the camera takes it up.
    """
    camera = fit.camera
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows))
    rays = camera.bearings(np.column_stack([u.ravel(), v.ravel()]))
    seen = np.isfinite(rays).all(axis=1)
    out = np.full(len(rays), np.nan)
    J = by_parameters(camera, rays[seen], fit.with_skew)
    by_point = camera.project_jacobian(rays[seen])
    x, y, z = rays[seen].T
    turn = np.zeros((len(x), 3, 3))
    turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 0] = z, -y, -z
    turn[:, 1, 2], turn[:, 2, 0], turn[:, 2, 1] = x, y, -x
    by_turn = (by_point @ turn).reshape(-1, 3)
    flat = J.reshape(-1, J.shape[2])
    left = (flat - by_turn @ np.linalg.lstsq(by_turn, flat, rcond=None)[0]).reshape(J.shape)
    variance = np.einsum("nip,pq,niq->n", left, fit.covariance, left)
    out[seen] = np.sqrt(np.maximum(variance, 0.0))
    return out.reshape(rows, columns)
