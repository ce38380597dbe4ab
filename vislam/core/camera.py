"""Cameras and rigs: projection, unprojection, undistortion of points and images, stereo rectification.

Models on a pinhole with pixel skew: radial-tangential (Brown; k1, k2, p1, p2[, k3], as in OpenCV), rational (the same
over a polynomial; k1, k2, p1, p2, k3, k4, k5, k6, as OpenCV's CALIB_RATIONAL_MODEL and ROS have it), equidistant
(Kannala-Brandt, PAMI 2006; k1..k4, as in OpenCV's fisheye and in Kalibr), and those over spheres, which see beyond 90
degrees: ucm, eucm, ds, omni (`vislam.core.lens`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.geometry import are_rotations, invert
from vislam.core.jit import njit
from vislam.core.lens import (
    MODELS,
    SPHERES,
    Distortion,
    Lens,
    Lenses,
    LensModel,
    bend,
    distort,
    imaged,
    lift,
    table_of,
    undistort,
)
from vislam.core.messages import Array
from vislam.core.reading import MAX_PIXELS

MapF32 = NDArray[np.float32]

_MIN_Z_M = 1e-6
_WIDEST_RAD = 1.5  # from the axis, that z = 1 takes from a lens over spheres: 86 deg, at 14 m to the side
_ASKED = 12  # pixels across and down the first image, by which it is asked what two cameras share
_LEAST_SHARED = 0.25  # of the first image, at infinity, that makes two cameras a pair
_LEAST_BASELINE_M = 1e-4  # less is what poses of one place differ by when they are inverted and multiplied


@njit(cache=True, nogil=True)
def _project(points: Array, lens: Lens, least_cosine: float) -> Array:
    out = np.full((len(points), 2), np.nan)
    for i in range(len(points)):
        x, y, z = points[i]
        if lens.model >= SPHERES:
            if not _is_within(x, y, z, least_cosine):
                continue
            u, v, _, _ = bend(x, y, z, lens.model, lens.k)
            u, v = lens.pinhole[0] * u + lens.pinhole[4] * v, lens.pinhole[1] * v
        else:
            if not z > _MIN_Z_M:
                continue
            u, v, _, _, _, _ = imaged(x / z, y / z, lens)
        out[i, 0], out[i, 1] = u + lens.pinhole[2], v + lens.pinhole[3]
    return out


@njit(cache=True, nogil=True)
def _project_jacobian(points: Array, lens: Lens, least_cosine: float) -> Array:
    out = np.full((len(points), 2, 3), np.nan)
    fx, fy, _, _, skew = lens.pinhole
    for i in range(len(points)):
        x, y, z = points[i]
        if lens.model >= SPHERES:
            if _is_within(x, y, z, least_cosine):
                _, _, by_u, by_v = bend(x, y, z, lens.model, lens.k)
                for j in range(3):
                    out[i, 0, j], out[i, 1, j] = fx * by_u[j] + skew * by_v[j], fy * by_v[j]
            continue
        if not z > _MIN_Z_M:
            continue
        x, y = x / z, y / z
        _, _, ux, uy, vx, vy = distort(x, y, lens.model, lens.k)
        px, py = fx * ux + skew * vx, fx * uy + skew * vy
        qx, qy = fy * vx, fy * vy
        out[i, 0, 0], out[i, 0, 1], out[i, 0, 2] = px / z, py / z, -(px * x + py * y) / z
        out[i, 1, 0], out[i, 1, 1], out[i, 1, 2] = qx / z, qy / z, -(qx * x + qy * y) / z
    return out


@njit(cache=True, nogil=True)
def _is_within(x: float, y: float, z: float, least_cosine: float) -> bool:
    length = np.sqrt(x * x + y * y + z * z)
    return length > _MIN_Z_M and z > least_cosine * length


@njit(cache=True, nogil=True)
def _rays(pixels: Array, lens: Lens) -> Array:
    """Return rays [N, 3]: of length 1 over spheres, else with z = 1; NaN where no ray gives the pixel."""
    out = np.full((len(pixels), 3), np.nan)
    fx, fy, cx, cy, skew = lens.pinhole
    for i in range(len(pixels)):
        v0 = (pixels[i, 1] - cy) / fy
        u0 = (pixels[i, 0] - cx - skew * v0) / fx
        if not (np.isfinite(u0) and np.isfinite(v0)):
            continue
        if lens.model >= SPHERES:
            out[i, 0], out[i, 1], out[i, 2] = lift(u0, v0, lens.model, lens.k)
            continue
        out[i, 0], out[i, 1] = undistort(u0, v0, lens.model, lens.k, lens.max_r2)
        out[i, 2] = 1.0
    return out


@njit(cache=True, nogil=True)
def _normalise(pixels: Array, lens: Lens) -> Array:
    out = _rays(pixels, lens)
    if lens.model >= SPHERES:
        for i in range(len(out)):
            z = out[i, 2]
            x, y = (out[i, 0] / z, out[i, 1] / z) if z > _MIN_Z_M else (np.nan, np.nan)
            if not x * x + y * y <= lens.max_r2:
                x, y = np.nan, np.nan
            out[i, 0], out[i, 1] = x, y
    return out[:, :2].copy()


@dataclass(frozen=True, slots=True)
class CameraSigmas:
    """How far a camera may be from its calibration, 1 sigma; by default as for a board, or a maker who states none.

    EuRoC's own calibration leaves three systems 0.5 to 0.7 % too short, and turns of 0.3 mrad between its cameras.
    """

    focal: float = 0.003  # relative
    metres: float = 0.005  # relative, of the distance to the camera before it, or of the first one's depth images
    turn_rad: float = 0.002  # against the camera before it


MOST_CAMERAS = 8  # of a rig
EXACT = CameraSigmas(0.0, 0.0, 0.0)  # of a simulation


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: pinhole with skew and a distortion model; pixels are raw image coordinates.

    Focal lengths are those in the middle of the image, also where Kalibr's and Basalt's (`ds`, `omni`) are 1 + xi as
    large; the files are converted.

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
        if self.distortion not in MODELS:
            raise DataError(f"camera distortion '{self.distortion}' is unknown; known: {', '.join(MODELS)}")
        if fault := self.model.fault(self.coefficients):
            raise DataError(f"{self.distortion} distortion {fault}")

    def with_focal(self, factor: float) -> Camera:
        """Return the camera with focal lengths times a factor."""
        return replace(self, fx=self.fx * factor, fy=self.fy * factor)

    @property
    def K(self) -> Array:
        """The intrinsic matrix [3, 3]."""
        return np.array([[self.fx, self.skew_px, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def model(self) -> LensModel:
        """What its lens has in common with others of the same model."""
        return MODELS[self.distortion]

    @cached_property
    def lens(self) -> Lens:
        """The camera as compiled code takes it."""
        k = self.model.pack(self.coefficients)
        if self.model.is_spherical:
            max_r2 = float(np.tan(min(_WIDEST_RAD, np.arccos(self._least_cosine))) ** 2)
        else:
            max_r2 = self.model.limit(k)
        pinhole = np.array([self.fx, self.fy, self.cx, self.cy, self.skew_px])
        return Lens(pinhole, self.model.code, k, max_r2)

    @cached_property
    def _least_cosine(self) -> float:
        """Cosine of the widest angle from the axis at which a lens over spheres has an image; 0 for a planar one."""
        return self.model.limit(self.model.pack(self.coefficients)) if self.model.is_spherical else 0.0

    def project(self, points_cam_m: Array) -> Array:
        """Return raw pixels [N, 2] of points [N, 3] in the camera frame; NaN beyond what the model sees.

        Planar models see nothing behind the camera.
        """
        return _project(_rows(points_cam_m, 3), self.lens, self._least_cosine)

    def project_jacobian(self, points_cam_m: Array) -> Array:
        """Return d(pixel)/d(point) [N, 2, 3] at points [N, 3] in the camera frame; NaN where `project` has none.

        Planar models have it wherever a point is before the camera.
        """
        return _project_jacobian(_rows(points_cam_m, 3), self.lens, self._least_cosine)

    def normalise(self, pixels: Array) -> Array:
        """Return undistorted coordinates [N, 2] on the plane z = 1 of raw pixels [N, 2]; NaN where none exist.

        Of a lens over spheres there are none beyond 1.5 rad from the axis; `bearings` has those.
        """
        return _normalise(_rows(pixels, 2), self.lens)

    def unproject(self, pixels: Array) -> Array:
        """Return rays [N, 3] with z = 1 of raw pixels [N, 2]; multiply by z-depth to get points."""
        xy = self.normalise(pixels)
        return np.column_stack([xy, np.ones(len(xy))])

    def bearings(self, pixels: Array) -> Array:
        """Return rays [N, 3] of length 1 of raw pixels [N, 2], over the whole field of view; NaN where none exist."""
        rays = _rays(_rows(pixels, 2), self.lens)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

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

    @cached_property
    def is_stereo(self) -> bool:
        """Whether the second camera sees so much of what the first one does that the two measure depth."""
        if len(self.cameras) < 2:
            return False
        first, second = self.cameras[:2]
        across, down = np.meshgrid(*(np.linspace(0.0, side - 1.0, _ASKED) for side in (first.width, first.height)))
        rays = first.bearings(np.column_stack([across.ravel(), down.ravel()]))
        pixels = second.project(rays @ self.T_cam0_cam1[:3, :3])
        return float(second.contains(pixels).mean()) >= _LEAST_SHARED

    @property
    def further(self) -> tuple[int, ...]:
        """Which cameras are followed each by itself: all but the first, and the second where it makes a pair."""
        return tuple(range(2 if self.is_stereo else 1, len(self.cameras)))

    @property
    def T_body_cam0(self) -> Array:
        """Pose [4, 4] of the first camera in the body; the identity without one."""
        return self.T_body_cams[0] if self.cameras else np.eye(4)

    @property
    def lenses(self) -> Lenses:
        """All cameras as compiled code takes them."""
        return table_of([camera.lens for camera in self.cameras])

    @property
    def T_cam0_cams(self) -> Array:
        """Poses [C, 4, 4] of all cameras in the first."""
        return np.array([invert(self.T_body_cams[0]) @ T for T in self.T_body_cams])

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
