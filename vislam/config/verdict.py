"""Defaults of the verdict on a run: what its evidence may be by chance, and how good what was told of sensors is."""

from dataclasses import dataclass

from vislam.config.ranges import NonNegative, Probability, Share


@dataclass(frozen=True, slots=True)
class VerdictConfig:
    """When a run is doubted. Sigmas are those of classes of sensors, not of a recording."""

    # of each test to pass where nothing is wrong: some 15 tests, 1 doubt in 60 sound runs
    probability: Probability = 0.999
    # of the camera on the body as told: Kalibr is good to 0.1, a printed mount to 1
    rotation_sigma_deg: NonNegative = 0.5
    accel_bias_sigma_m_s2: NonNegative = 0.2  # as `init.accel_bias_sigma_m_s2`: of a calibrated cheap accelerometer
    min_coverage: Share = 0.5  # of the frames that must have a pose; below, the run is lost
