"""Cameras and rigs: projection, unprojection, undistortion of points and images, stereo rectification.

Three distortion models on a pinhole with pixel skew: radial-tangential (Brown; k1, k2, p1, p2[, k3], as in OpenCV),
rational (the same over a polynomial; k1, k2, p1, p2, k3, k4, k5, k6, as OpenCV's CALIB_RATIONAL_MODEL and ROS have it)
and equidistant (Kannala-Brandt, PAMI 2006; k1..k4, as in OpenCV's fisheye and in Kalibr).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.geometry import are_rotations, invert
from vislam.core.jit import njit
from vislam.core.lens import Lens, distort, imaged
from vislam.core.messages import Array
from vislam.core.reading import MAX_PIXELS

MapF32 = NDArray[np.float32]
Distortion = Literal["none", "radtan", "equidistant", "rational"]

_MODEL_CODES = {"none": 0, "radtan": 1, "equidistant": 2, "rational": 3}
_COEFFICIENT_COUNTS = {"none": (0,), "radtan": (4, 5), "equidistant": (4,), "rational": (8,)}
_MAX_NEWTON_STEPS = 20
_MIN_Z_M = 1e-6
_LEAST_BASELINE_M = 1e-4  # less is what poses of one place differ by when they are inverted and multiplied
_NO_COEFFICIENT = 1e-12  # of a polynomial in r^2: what it changes at any radius that a lens sees is no pixel's part


@njit(cache=True, nogil=True)
def _project(points: Array, lens: Lens) -> Array:
    out = np.full((len(points), 2), np.nan)
    for i in range(len(points)):
        z = points[i, 2]
        if not z > _MIN_Z_M:
            continue
        u, v, _, _, _, _ = imaged(points[i, 0] / z, points[i, 1] / z, lens)
        out[i, 0], out[i, 1] = u + lens.pinhole[2], v + lens.pinhole[3]
    return out


@njit(cache=True, nogil=True)
def _project_jacobian(points: Array, pinhole: Array, model: int, k: Array) -> Array:
    out = np.full((len(points), 2, 3), np.nan)
    fx, fy, _, _, skew = pinhole
    for i in range(len(points)):
        z = points[i, 2]
        if not z > _MIN_Z_M:
            continue
        x, y = points[i, 0] / z, points[i, 1] / z
        _, _, ux, uy, vx, vy = distort(x, y, model, k)
        px, py = fx * ux + skew * vx, fx * uy + skew * vy
        qx, qy = fy * vx, fy * vy
        out[i, 0, 0], out[i, 0, 1], out[i, 0, 2] = px / z, py / z, -(px * x + py * y) / z
        out[i, 1, 0], out[i, 1, 1], out[i, 1, 2] = qx / z, qy / z, -(qx * x + qy * y) / z
    return out


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
def _normalise(pixels: Array, pinhole: Array, model: int, k: Array, max_r2: float) -> Array:
    """Invert the projection by Newton's method with halved steps; NaN where no ray gives the pixel."""
    out = np.full((len(pixels), 2), np.nan)
    fx, fy, cx, cy, skew = pinhole
    for i in range(len(pixels)):
        v0 = (pixels[i, 1] - cy) / fy
        u0 = (pixels[i, 0] - cx - skew * v0) / fx
        if not (np.isfinite(u0) and np.isfinite(v0)):
            continue
        x, y = _first_guess(u0, v0, model, max_r2)
        if np.isnan(x):
            continue
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
            out[i, 0], out[i, 1] = x, y
    return out


@dataclass(frozen=True, slots=True)
class CameraSigmas:
    """How far a camera may be from its calibration, 1 sigma; by default that of a board, or of a maker who says none.

    EuRoC's own calibration leaves three systems 0.5 to 0.7 % too short, and turns of 0.3 mrad between its cameras.
    """

    focal: float = 0.003  # relative
    metres: float = 0.005  # relative, of the distance to the camera before it, or of the first one's depth images
    turn_rad: float = 0.002  # against the camera before it


EXACT = CameraSigmas(0.0, 0.0, 0.0)  # of a simulation


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: pinhole with skew and a distortion model; pixels are raw image coordinates.

    Raises DataError when the numbers cannot be a calibration.
    """

    width: int
    height: int
    fx: float  # px
    fy: float  # px
    cx: float  # px
    cy: float  # px
    skew_px: float = 0.0  # the s of K = [[fx, s, cx], [0, fy, cy], [0, 0, 1]]
    distortion: Distortion = "none"
    coefficients: tuple[float, ...] = ()
    sigmas: CameraSigmas = CameraSigmas()

    def __post_init__(self) -> None:
        numbers = np.array([self.fx, self.fy, self.cx, self.cy, self.skew_px, *self.coefficients], dtype=np.float64)
        if not np.all(np.isfinite(numbers)) or self.fx <= 0.0 or self.fy <= 0.0:
            raise DataError(f"camera intrinsics must be finite with positive focal lengths, got {numbers.tolist()}")
        if self.width <= 0 or self.height <= 0:
            raise DataError(f"camera image size must be positive, got {self.width}x{self.height}")
        if self.width * self.height > MAX_PIXELS:
            raise DataError(f"camera images must have at most {MAX_PIXELS} pixels, got {self.width}x{self.height}")
        if self.distortion not in _MODEL_CODES:
            raise DataError(f"camera distortion '{self.distortion}' is unknown; known: {', '.join(_MODEL_CODES)}")
        allowed = _COEFFICIENT_COUNTS[self.distortion]
        if len(self.coefficients) not in allowed:
            raise DataError(f"{self.distortion} distortion takes {allowed} coefficients, got {len(self.coefficients)}")

    def with_focal(self, factor: float) -> Camera:
        """Return the camera with focal lengths times a factor."""
        return replace(self, fx=self.fx * factor, fy=self.fy * factor)

    @property
    def K(self) -> Array:
        """The intrinsic matrix [3, 3]."""
        return np.array([[self.fx, self.skew_px, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def _pinhole(self) -> Array:
        return np.array([self.fx, self.fy, self.cx, self.cy, self.skew_px])

    @cached_property
    def _model(self) -> int:
        return _MODEL_CODES[self.distortion]

    @cached_property
    def _k(self) -> Array:
        k = np.zeros(max(5, len(self.coefficients)))
        k[: len(self.coefficients)] = self.coefficients
        return k

    @cached_property
    def _max_r2(self) -> float:
        """Squared radius on z = 1 up to which distortion is monotonic; beyond it two rays share a pixel."""
        if self.distortion == "none":
            return float("inf")
        k = self._k
        if self.distortion == "radtan":
            slope = np.polynomial.Polynomial([1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[4]])
            limit = _smallest_positive_root(slope)
            return limit if np.isfinite(limit) else float("inf")
        if self.distortion == "rational":
            return _rational_limit(k)
        slope = np.polynomial.Polynomial([1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]])
        theta = min(float(np.sqrt(_smallest_positive_root(slope))), np.deg2rad(89.5))
        return float(np.tan(theta) ** 2)

    @cached_property
    def lens(self) -> Lens:
        """The camera as compiled code takes it."""
        return Lens(self._pinhole, self._model, self._k, self._max_r2)

    def project(self, points_cam_m: Array) -> Array:
        """Return raw pixels [N, 2] of points [N, 3] in the camera frame; NaN behind the camera or beyond the model."""
        return _project(_rows(points_cam_m, 3), self.lens)

    def project_jacobian(self, points_cam_m: Array) -> Array:
        """Return d(pixel)/d(point) [N, 2, 3] at points [N, 3] in the camera frame; NaN behind the camera."""
        return _project_jacobian(_rows(points_cam_m, 3), self._pinhole, self._model, self._k)

    def normalise(self, pixels: Array) -> Array:
        """Return undistorted coordinates [N, 2] on the plane z = 1 of raw pixels [N, 2]; NaN where none exist."""
        return _normalise(_rows(pixels, 2), self._pinhole, self._model, self._k, self._max_r2)

    def unproject(self, pixels: Array) -> Array:
        """Return rays [N, 3] with z = 1 of raw pixels [N, 2]; multiply by z-depth to get points."""
        xy = self.normalise(pixels)
        return np.column_stack([xy, np.ones(len(xy))])

    def resampling_maps(self, K_inverse: Array, R_cam_new: Array, size: tuple[int, int]) -> tuple[MapF32, MapF32]:
        """Return maps [h, w] for `cv2.remap` to a pinhole view of `size` (w, h), turned by R_cam_new."""
        u, v = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
        rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ (R_cam_new @ K_inverse).T
        pixels = np.nan_to_num(self.project(rays), nan=-1.0).astype(np.float32).reshape(size[1], size[0], 2)
        return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])

    def check_image(self, image: NDArray[np.generic]) -> None:
        """Raise DataError unless the image [H, W(, 3)] has the size the camera was calibrated for."""
        if image.shape[:2] != (self.height, self.width):
            raise DataError(
                f"image is {image.shape[1]}x{image.shape[0]} but the calibration is for {self.width}x{self.height}; "
                "correct the calibration's resolution or the images"
            )

    def contains(self, pixels: Array, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Return which pixels [N, 2] lie inside the image, at least `margin_px` from its border; NaN is outside."""
        x, y = pixels[:, 0], pixels[:, 1]
        inside_x = (x >= margin_px) & (x <= self.width - 1 - margin_px)
        return np.asarray(inside_x & (y >= margin_px) & (y <= self.height - 1 - margin_px))

    def scaled(self, factor: float) -> Camera:
        """Return the camera of the same image resized by `factor` (pixel centres at integers, as in OpenCV)."""
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * factor),
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
            skew_px=self.skew_px * factor,
        )


def _rows(values: Array, columns: int) -> Array:
    return np.ascontiguousarray(values, dtype=np.float64).reshape(-1, columns)


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


@dataclass(frozen=True)
class Rig:
    """The cameras of a recording, if any, and where they sit on the body; depth, if any, is registered to cam0."""

    cameras: tuple[Camera, ...]
    T_body_cams: tuple[Array, ...]  # [4, 4] each
    has_depth: bool = False

    def __post_init__(self) -> None:
        if len(self.cameras) != len(self.T_body_cams) or (self.has_depth and not self.cameras):
            raise DataError(f"a rig needs one pose per camera, got {len(self.cameras)} and {len(self.T_body_cams)}")
        for index, T in enumerate(self.T_body_cams):
            if T.shape != (4, 4) or not are_rotations(T[:3, :3], 1e-3):
                raise DataError(f"extrinsics of cam{index} are not a rigid transform: {np.asarray(T).tolist()}")

    def __repr__(self) -> str:
        cameras = ", ".join(f"{c.width} x {c.height} px, {c.distortion}" for c in self.cameras)
        return f"Rig({len(self.cameras)} cameras: {cameras}{', depth' if self.has_depth else ''})"

    @property
    def is_blind(self) -> bool:
        """Whether there is no camera."""
        return not self.cameras

    @property
    def is_stereo(self) -> bool:
        """Whether there is a second camera."""
        return len(self.cameras) > 1

    @property
    def T_body_cam0(self) -> Array:
        """Pose [4, 4] of the first camera in the body; the identity without one."""
        return self.T_body_cams[0] if self.cameras else np.eye(4)

    @property
    def lenses(self) -> tuple[Lens, Lens]:
        """The first two cameras as compiled code takes them; one camera stands for both."""
        return self.cameras[0].lens, self.cameras[:2][-1].lens

    @property
    def metres_sigma(self) -> float:
        """How well the baseline or the unit of depth is known, relative; 0 where neither is there."""
        measures = self.cameras[1:2] if self.is_stereo else self.cameras[: int(self.has_depth)]
        return measures[0].sigmas.metres if measures else 0.0

    @property
    def T_cam0_cam1(self) -> Array:
        """Pose [4, 4] of the second camera in the first."""
        return invert(self.T_body_cams[0]) @ self.T_body_cams[1]

    def check_baseline(self) -> None:
        """Raise DataError where the first two cameras sit at one place: such a pair measures no depth."""
        if self.is_stereo and np.linalg.norm(self.T_cam0_cam1[:3, 3]) < _LEAST_BASELINE_M:
            raise DataError(
                "cam0 and cam1 sit at the same place, by which they see no depth; state where both are (T_BS of each "
                "sensor.yaml, /tf_static of a bag, or --calibration.camera FILE with T_cam_imu), or use one: "
                "--frontend.mode mono"
            )


@dataclass(frozen=True)
class StereoRectification:
    """A stereo pair as two parallel ideal cameras with common K: same rows, disparity = K[0, 0] * baseline / z."""

    K: Array  # [3, 3]
    baseline_m: float
    maps0: tuple[MapF32, MapF32]
    maps1: tuple[MapF32, MapF32]
    R_rect_cam0: Array  # [3, 3]
    size: tuple[int, int]  # width, height

    def apply(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return both images [h, w] resampled into the rectified view."""
        return (
            np.asarray(cv2.remap(left, *self.maps0, cv2.INTER_LINEAR), dtype=np.uint8),
            np.asarray(cv2.remap(right, *self.maps1, cv2.INTER_LINEAR), dtype=np.uint8),
        )


def rectify(rig: Rig, scale: float = 1.0) -> StereoRectification:
    """Return the rectification of a rig's first two cameras at `scale` times cam0's image size.

    The rotation that both cameras share halfway is taken, then x is turned onto the baseline (Bouguet's method, by
    OpenCV); the maps come from our own projection, so every camera model works. Raises DataError without a second
    camera or when cam1 is not to the right of cam0.
    """
    if not rig.is_stereo:
        raise DataError("stereo rectification needs two cameras, the rig has one")
    rig.check_baseline()
    T_cam1_cam0 = invert(rig.T_cam0_cam1)
    first, second = rig.cameras[0].scaled(scale), rig.cameras[1].scaled(scale)
    size = (first.width, first.height)
    none = np.zeros(4)
    R0, R1, P0, P1 = cv2.stereoRectify(
        first.K, none, second.K, none, size, T_cam1_cam0[:3, :3].copy(), T_cam1_cam0[:3, 3:].copy(),
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0,
    )[:4]  # fmt: skip
    baseline_m = float(-P1[0, 3] / P1[0, 0])
    if baseline_m <= 0.0:
        raise DataError(f"cam1 must be to the right of cam0, got a baseline of {baseline_m:.3f} m; swap the cameras")
    K_inverse = np.linalg.inv(P0[:3, :3])
    return StereoRectification(
        K=np.array(P0[:3, :3]),
        baseline_m=baseline_m,
        maps0=first.resampling_maps(K_inverse, R0.T, size),
        maps1=second.resampling_maps(K_inverse, R1.T, size),
        R_rect_cam0=np.array(R0),
        size=size,
    )
