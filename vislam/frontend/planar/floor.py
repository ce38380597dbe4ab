"""The floor as a camera on a cart sees it: where it is, how the cart's tilt moves it, and where to look for corners.

Level frame: its origin is cam0, z is up from the floor, x is the body's x along the floor. The rotation that takes
camera axes there is that of the mount, turned a little by what the cart's springs, its load and an inexact calibration
do. The gyroscope measures what changes quickly; the optical flow of the floor itself shows the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.config import PlanarConfig
from vislam.core.camera import Camera
from vislam.core.errors import UsageError
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, ImageU8, ImuSpan
from vislam.imu.gyro_turns import gyro_rotation
from vislam.vision.features import detect_corners, detect_harris, noise_grey

_TEXTURE_RATIO = 4.0  # of a corner's response to that of image noise alone; below, it is noise
_FLOOR_ROWS, _COLUMNS = 2, 4  # regions of the floor; above the horizon there is one row
_HORIZON_PX = 8  # kept clear on both sides of the horizon
_STEEPEST_DEG = 80.0  # of a camera that still looks ahead
_NOISE_RESPONSE = 0.19  # response of a corner in white noise of one grey level, in (grey levels / px)^2
_MAX_NOISE_GREY = 4.0  # no webcam in light is worse; more is fine texture
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """How cam0 is mounted: its height and the rotation to the level frame."""

    height_m: float
    R_level_cam: Array  # [3, 3]
    R_level_body: Array  # [3, 3]

    @property
    def tilt_deg(self) -> float:
        """The optical axis below the horizon."""
        return float(np.rad2deg(np.arcsin(-self.R_level_cam[2, 2])))

    @property
    def roll_deg(self) -> float:
        """About the optical axis, clockwise in the image."""
        return float(np.rad2deg(np.arctan2(-self.R_level_cam[2, 0], -self.R_level_cam[2, 1])))

    def turned(self, tilt: Array) -> Mount:
        """Return the mount with the level frame turned by a small rotation [2] about its x and y."""
        R = _small(tilt)
        return Mount(self.height_m, R @ self.R_level_cam, R @ self.R_level_body)


def make_mount(config: PlanarConfig, R_body_cam: Array) -> Mount:
    """Return the mount that a configuration means, on a body whose camera is turned by R_body_cam [3, 3].

    Raises UsageError when the height is not known, or the camera does not look along the floor.
    """
    if config.height_m is None or not 0.01 <= config.height_m <= 100.0:
        raise UsageError(
            f"front end 'planar' needs the height of the camera above the floor, got {config.height_m}; measure it or "
            "calibrate it, and give --frontend.planar.height-m"
        )
    up_body = _UP
    if config.tilt_deg is not None:
        up_body = R_body_cam @ up_in_camera(np.deg2rad(config.tilt_deg), np.deg2rad(config.roll_deg))
    forward = np.array([1.0, 0.0, 0.0])
    forward = forward - (forward @ up_body) * up_body
    length = float(np.linalg.norm(forward))
    if length < np.cos(np.deg2rad(_STEEPEST_DEG)):
        raise UsageError(
            "the body's x axis does not point along the floor; check T_body_cam0 and frontend.planar.tilt_deg"
        )
    x = forward / length
    R_level_body = np.stack([x, np.cross(up_body, x), up_body])
    mount = Mount(config.height_m, R_level_body @ R_body_cam, R_level_body)
    if abs(mount.tilt_deg) > _STEEPEST_DEG:
        raise UsageError(
            f"the camera looks {mount.tilt_deg:.0f} deg down; planar odometry is for cameras that look ahead, up to "
            f"{_STEEPEST_DEG:.0f} deg: check T_body_cam0 and frontend.planar.tilt_deg"
        )
    return mount


def up_in_camera(tilt_rad: float, roll_rad: float) -> Array:
    """Return the floor's normal [3] in camera axes, of a camera so far below the horizon and turned about its axis."""
    c = np.cos(tilt_rad)
    return np.array([-np.sin(roll_rad) * c, -np.cos(roll_rad) * c, -np.sin(tilt_rad)])


def _small(tilt: Array) -> Array:
    return np.asarray(so3_exp(np.array([tilt[0], tilt[1], 0.0])))


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """The gyroscope's measurement of the turn between two frames."""

    yaw_rad: float  # about the floor's normal
    known: bool  # bias and all


class Tilt:
    """Follows the tilt of the cart against the floor: its mean by the floor's flow, its changes by the gyroscope.

    Attributes:
        mean: rotation [2] about x and y of the level frame that the mount lacks, as the floor shows it.
        covariance: [2, 2] of that in rad^2.
        sway: [2] rotation beyond the mean in the newest frame, by the gyroscope.
        sway_sigma_rad: how well that is known: not at all at first, for a cart may begin on a bump.
    """

    def __init__(self, config: PlanarConfig, mount: Mount) -> None:
        """Start with the mount as calibrated."""
        self._config = config
        self._mount = mount
        self.mean: Array = np.zeros(2)
        self.covariance: Array = np.eye(2) * np.deg2rad(config.tilt_sigma_deg) ** 2
        self.sway: Array = np.zeros(2)
        self.sway_sigma_rad = float(np.deg2rad(config.vibration_deg))

    @property
    def mount(self) -> Mount:
        """The mount as it is now believed to be, without sway."""
        return self._mount.turned(self.mean)

    @property
    def R_level_cam(self) -> Array:
        """The rotation [3, 3] in the newest frame."""
        return np.asarray(_small(self.mean + self.sway) @ self._mount.R_level_cam)

    def advance(self, dt_s: float, imu: ImuSpan | None, gyro_sigma_rad_s: float) -> Turn:
        """Take the time to the next frame and its bias-corrected inertial span."""
        self.covariance = self.covariance + np.eye(2) * np.deg2rad(self._config.tilt_walk_deg) ** 2 * dt_s
        if imu is None or len(imu.t_ns) < 2 or not np.isfinite(imu.gyro_rad_s).all():
            self._forget_sway()
            return Turn(0.0, False)
        R = self._mount.R_level_body
        turned = _small(self.sway) @ R @ gyro_rotation(imu) @ R.T
        yaw = float(np.arctan2(turned[1, 0], turned[0, 0]))
        config = self._config
        by_bias_rad = gyro_sigma_rad_s * config.vibration_s
        if not by_bias_rad < np.deg2rad(config.vibration_deg):
            self._forget_sway()
            return Turn(yaw, False)
        up = turned.T @ _UP
        keep = float(np.exp(-dt_s / config.vibration_s))
        self.sway = keep * np.array([up[1], -up[0]])
        least = float(np.hypot(np.deg2rad(config.vibration_known_deg), by_bias_rad))
        self.sway_sigma_rad = max(keep * self.sway_sigma_rad, least)
        return Turn(yaw, True)

    def _forget_sway(self) -> None:
        self.sway, self.sway_sigma_rad = np.zeros(2), float(np.deg2rad(self._config.vibration_deg))

    def learn(self, change: Array, covariance: Array, prior: Array) -> None:
        """Take the common tilt error [2] that a fit found, its covariance [2, 2] and that of the fit's own prior."""
        information = np.linalg.inv(covariance) - np.linalg.inv(prior)
        values, vectors = np.linalg.eigh(0.5 * (information + information.T))
        values = np.maximum(values, 0.0)
        information = (vectors * values) @ vectors.T
        if values[-1] <= 1e-9 / prior[0, 0]:
            return
        # the fit's posterior mean, freed from its prior: information @ found = posterior information @ change
        wanted = np.linalg.inv(covariance) @ change
        sway = self.sway_sigma_rad**2
        gain_information = vectors * (values / (1.0 + values * sway)) @ vectors.T
        found = np.linalg.pinv(information, rcond=1e-6) @ wanted
        posterior = np.linalg.inv(np.linalg.inv(self.covariance) + gain_information)
        step = posterior @ gain_information @ found
        self.mean = self.mean + step
        self.covariance = 0.5 * (posterior + posterior.T)

    def start_at(self, mean: Array, covariance: Array) -> None:
        """Take what an earlier run knew."""
        self.mean, self.covariance = mean.copy(), covariance.copy()


class Regions:
    """Parts of the image: two by four of the floor, one by four above the horizon."""

    def __init__(self, config: PlanarConfig, camera: Camera, mount: Mount) -> None:
        """Divide the image of a camera at its horizon."""
        self._config = config
        ahead = mount.R_level_cam.T @ np.array([[1.0], [0.0], [0.0]])
        row = -1.0 if ahead[2, 0] <= 0.0 else float(camera.project(ahead.T)[0, 1])
        self.horizon_px = float(np.clip(np.nan_to_num(row, nan=-1.0), 0.0, camera.height - 1.0))
        top, bottom = self.horizon_px + _HORIZON_PX, float(camera.height)
        self.floor = _grid(0.0, top, float(camera.width), bottom, _FLOOR_ROWS)
        self.above = _grid(0.0, 0.0, float(camera.width), max(self.horizon_px - _HORIZON_PX, 0.0), 1)

    def shi_tomasi(
        self, image: ImageU8, live: Array, count: int, cell_px: int, distance_px: float, least: float,
        mask: ImageU8 | None,
    ) -> Array:  # fmt: skip
        """Find corners over the whole image whose response stands out from the image's own noise."""
        noise = min(noise_grey(image), _MAX_NOISE_GREY)
        least = max(least, _TEXTURE_RATIO * _NOISE_RESPONSE * noise * noise)
        return detect_corners(image, count, cell_px, distance_px, live, least, mask)

    def harris(self, image: ImageU8, live: Array, distance_px: float, mask: ImageU8 | None) -> Array:
        """Find corners region by region, as many in each."""
        boxes = np.vstack([self.floor, self.above])
        return detect_harris(image, boxes, self._config.max_tracks // len(boxes), distance_px, live, mask)

    def counts(self, pixels: Array) -> NDArray[np.int64]:
        """Return how many pixels [N, 2] lie in each of the eight regions of the floor [8]."""
        return _inside(self.floor, pixels)

    def counts_above(self, pixels: Array) -> NDArray[np.int64]:
        """Return how many pixels [N, 2] lie in each of the four regions above the horizon [4]."""
        return _inside(self.above, pixels)


def _grid(left: float, top: float, right: float, bottom: float, rows: int) -> Array:
    """Return boxes [rows * 4, 4] that share an area."""
    x, y = np.linspace(left, right, _COLUMNS + 1), np.linspace(top, max(bottom, top), rows + 1)
    return np.array([[x[c], y[r], x[c + 1], y[r + 1]] for r in range(rows) for c in range(_COLUMNS)])


def _inside(boxes: Array, pixels: Array) -> NDArray[np.int64]:
    low, high = boxes[:, None, :2] <= pixels[None], pixels[None] < boxes[:, None, 2:]
    return np.count_nonzero((low & high).all(axis=2), axis=1)
