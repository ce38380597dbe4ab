"""What the front half has to say of a whole run, as plain values for metrics, report and verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import StartFacts
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
