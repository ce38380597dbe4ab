"""Defaults of the verdict on a run: what its evidence may be by chance, and how good what was told of sensors is."""

from dataclasses import dataclass

from vislam.config.ranges import NonNegative, Probability, Share, Whole


@dataclass(frozen=True, slots=True)
class VerdictConfig:
    """When a run is doubted. Sigmas are those of classes of sensors, not of a recording."""

    # of each test to pass where nothing is wrong: some 15 tests, 1 doubt in 60 sound runs
    probability: Probability = 0.999
    # of the camera on the body as told: Kalibr is good to 0.1, a printed mount to 1
    rotation_sigma_deg: NonNegative = 0.5
    # of the camera's clock as told: drivers that stamp on arrival are off by up to 30 ms
    clock_sigma_s: NonNegative = 0.015
    turn_scale_sigma: NonNegative = 0.004  # relative, of focal length (Kalibr: 0.2 %) and of a calibrated gyro (0.3 %)
    force_scale_sigma: NonNegative = 0.01  # relative, of accelerometer and of baseline or depth, all calibrated
    accel_bias_sigma_m_s2: NonNegative = 0.2  # as `init.accel_bias_sigma_m_s2`: of a calibrated cheap accelerometer
    # white noise of inertial data, in the quietest half second; what is told does not matter, for estimators learn it.
    # Flights of EuRoC have 0.1 and 0.05; beyond these two, inertial data tell less than vision between two keyframes
    gyro_noise_deg: NonNegative = 1.0  # after a second
    accel_noise_m_s: NonNegative = 0.3  # after a second
    rate_error: Share = 0.2  # relative, of the inertial rate against that told: clocks are good to 3 %
    lost_share: Share = 0.1  # of the frames that vision may lose: it finds its keyframe again, and nothing drifted ...
    lost_s: NonNegative = 1.0  # ... but not after so long: a cheap IMU alone is off by a centimetre to a decimetre then
    degraded_share: Share = 0.2  # of the frames on which vision may lean weakly
    missing_share: Share = 0.1  # of the frames that may never arrive: patches are followed over twice the interval then
    repeated_frames: Whole = 3  # images equal to the last bit in motion: one may be a hiccup, a stuck driver sends many
    refused_share: Share = 0.1  # of visual measurements that the filter may refuse: more than outliers explain
    contradicting_share: Share = 0.25  # of verified loops that the graph may refuse, as `graph.join_max_contradicting`
    uniform_s: NonNegative = 20.0  # one camera without motion that shows scale: biases have walked away by then
    sigma_m: NonNegative = 1.0  # of the filter's position at its worst: no controller can use it
    # rms between filter and graph over what both admit: independent models would differ by 1
    apart_sigmas: NonNegative = 3.0
    apart_share: Share = 0.005  # of the way: closer together than this they tell the same story, whatever they admit
    min_coverage: Share = 0.5  # of the frames that must have a pose; below, the run is lost
