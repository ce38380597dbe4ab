"""Defaults of the inertial unit: its noise, power-up and attitude."""

from dataclasses import dataclass, field
from typing import Literal

from vislam.config.ranges import Count, NonNegative, Positive, Share


@dataclass(frozen=True, slots=True)
class VibrationConfig:
    """A fault for experiments: what the IMU of a recording shows of vibration is added to every inertial sample."""

    recording: str | None = None  # as for `run`, images are not needed; None: nothing is added
    begin_s: NonNegative = 0.0  # of the window in that recording
    length_s: NonNegative | None = None  # of the window, played to and fro; None: to the end
    above_hz: Positive = 15.0  # what moves a body on purpose is slower, rotors and wheels that shake it are faster
    gain: NonNegative = 1.0  # times what was recorded


@dataclass(frozen=True, slots=True)
class ImuConfig:
    """Inertial noise; None keeps that of the recording's own sensor file."""

    enabled: bool = True  # off: vision alone, as if the recording had no IMU
    gyroscope_noise_density: NonNegative | None = None  # rad/s/sqrt(Hz)
    accelerometer_noise_density: NonNegative | None = None  # m/s^2/sqrt(Hz)
    gyroscope_random_walk: NonNegative | None = None  # rad/s^2/sqrt(Hz)
    accelerometer_random_walk: NonNegative | None = None  # m/s^3/sqrt(Hz)
    # relative errors of scale factor and alignment, where the sensor's file has no ..._scale_sigma of its own
    gyro_scale_prior: NonNegative = 0.003  # of a calibrated MEMS gyroscope: data sheets give 0.2 to 1 %
    accel_scale_prior: NonNegative = 0.01  # of a calibrated MEMS accelerometer: 0.5 to 1 % against motion capture
    buffer_s: Positive = 30.0  # history kept for spans; longer than any keyframe interval, and 30 s at 400 Hz is 0.7 MB
    vibration: VibrationConfig = field(default_factory=VibrationConfig)


@dataclass(frozen=True, slots=True)
class PowerUpConfig:
    """Taking the current attitude as horizontal and the current rate as zero, when the power comes on."""

    window_s: NonNegative = 2.0  # of standing still; a gyro of 0.03 deg/s/sqrt(Hz) gives its bias to 0.02 deg/s
    max_rate_rad_s: NonNegative = 0.7  # mean; the ITG3205 may start with 40 deg/s, more is motion
    max_tilt_deg: NonNegative = 20.0  # of the body to gravity; more is a wrong axis, or no cart that stands on a floor
    memory: str | None = None  # file of the biases found, by temperature; one for each board. None: forget them
    remembered: Count = 64  # biases kept there, one per degree of temperature


@dataclass(frozen=True, slots=True)
class AttitudeConfig:
    """Attitude without vision; numbers of VQF are its paper's unless a reason is given."""

    method: Literal["vqf", "complementary"] = "vqf"  # complementary: Karpov 2026, the paper's cart
    # relative change of the field's norm: iron or a motor is near; of complementary also of its z
    mag_gate: Share = 0.1

    mag_dip_gate_deg: NonNegative = 10.0  # as `mag_gate`, of the dip

    # complementary, 1/s: leans on the accelerometer over 10 s; half and ten times are worse
    proportional_gain: NonNegative = 0.1
    integral_gain: NonNegative = 0.001  # 1/s^2: learns what bias is left after power-up within minutes
    gate_m_s2: NonNegative = 0.15  # |force| further from gravity is motion, not tilt
