"""What the front half has to say of a whole run, as plain values for metrics, report and verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vislam.config import EkfConfig
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import StartFacts
from vislam.core.messages import Array
from vislam.frontend import FrontEnd
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.planar import PlanarFrontEnd
from vislam.frontend.time_offset import TURN_SIGMA
from vislam.imu import InertialCondition, NoiseRatios
from vislam.trajectory import Alignment, gauge_alignment


@dataclass(frozen=True, slots=True, eq=False)
class FrontReport:
    """What the front half has to say of a whole run."""

    mode: str  # of the front end
    coupling: str | None  # of the filter; None without an IMU
    start: StartFacts | None  # how gravity was found; None: it was not, or there is no IMU
    refusal: str  # why there was no first state, when last tried
    counters: dict[str, dict[str, int]]
    nis: dict[str, tuple[int, float, int]]  # innovations that the filter accepted, see `Ekf.nis_statistics`
    noise_warnings: list[str]
    imu_noise: dict[str, dict[str, float]]  # white noise of the IMU: told, and what the samples showed
    uniform_s: float  # longest stretch without motion that shows scale
    calibration: dict[str, float]  # what was learned of the camera
    scaled_from_ns: int | None = None  # before, poses of one camera have no scale; None: all have
    noise_ratios: NoiseRatios | None = None  # white noise seen over that of the model; None without an IMU
    condition: InertialCondition | None = None  # of the IMU; None without one
    told_noise: ImuNoise | None = None  # of the IMU
    track_noise: dict[str, Any] = field(default_factory=dict)  # of pixels: what tracks showed, and what was used for it
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)  # further ones, see `ReadingIntake.report`

    @property
    def alignment(self) -> Alignment:
        """How the run may be moved onto a truth."""
        return gauge_alignment(self.start is not None, self.mode)


def learned_of_camera(
    frontend: FrontEnd, clock: CameraClock, filter_camera: Array | None, config: EkfConfig, has_imu: bool
) -> dict[str, float]:
    """Return what was learned of the camera, with standard deviations: its clock and turn, and over a floor its mount.

    `filter_camera` [8] is what the filter learned, see `Filtering.camera`.
    """
    told = {"camera_offset_s": clock.applied_s, "camera_offset_sigma_s": clock.sigma_s}
    if clock.drift_sigma > 0.0:
        told |= {"camera_drift": clock.drift, "camera_drift_sigma": clock.drift_sigma}
    mount = frontend.calibration if isinstance(frontend, PlanarFrontEnd) else {}
    return {**({**told, **_turned(clock, filter_camera, config)} if has_imu else {}), **mount}


def _turned(clock: CameraClock, filter_camera: Array | None, config: EkfConfig) -> dict[str, float]:
    """Return by how much the camera stands turned on the body against what was told, in degrees, by rotations."""
    found = clock.estimate
    turn, sigmas, prior_deg = found.R_correction, found.R_correction_sigma, float(np.rad2deg(TURN_SIGMA))
    if filter_camera is not None and filter_camera[5:8].all():
        turn, sigmas, prior_deg = filter_camera[2:5], filter_camera[5:8], config.tight_extrinsic_sigma_deg
    elif not found.frames:
        return {}
    angle = float(np.linalg.norm(turn))
    along = turn / max(angle, 1e-12)
    sigma = float(np.sqrt(np.sum((along * sigmas) ** 2)))
    return {
        "camera_turn_deg": float(np.rad2deg(angle)),
        "camera_turn_sigma_deg": float(np.rad2deg(sigma)),
        "camera_turn_prior_deg": prior_deg,
    }
