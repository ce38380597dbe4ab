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
    """Inertial noise; None keeps what the recording's own sensor file says."""

    enabled: bool = True  # off: vision alone, as if the recording had no IMU
    gyroscope_noise_density: NonNegative | None = None  # rad/s/sqrt(Hz)
    accelerometer_noise_density: NonNegative | None = None  # m/s^2/sqrt(Hz)
    gyroscope_random_walk: NonNegative | None = None  # rad/s^2/sqrt(Hz)
    accelerometer_random_walk: NonNegative | None = None  # m/s^3/sqrt(Hz)
    # relative errors of scale factor and alignment, where the sensor's file has no ..._scale_sigma of its own
    gyro_scale_prior: NonNegative = 0.003  # of a calibrated MEMS gyroscope: data sheets give 0.2 to 1 %
    accel_scale_prior: NonNegative = 0.01  # of a calibrated MEMS accelerometer: 0.5 to 1 % against motion capture
    buffer_s: Positive = 30.0  # history kept for spans; longer than any keyframe interval, and 30 s at 400 Hz is 0.7 MB
    # a run whose quietest second has less than a third of the white noise told is warned
    noise_tolerance: Positive = 3.0
    max_wait_s: NonNegative = 0.5  # a frame waits so long for the inertial sample after it, then goes on without
    vibration: VibrationConfig = field(default_factory=VibrationConfig)


@dataclass(frozen=True, slots=True)
class PowerUpConfig:
    """Taking the current attitude as horizontal and the current rate as zero, when the power comes on."""

    window_s: NonNegative = 2.0  # of standing still; a gyro of 0.03 deg/s/sqrt(Hz) gives its bias to 0.02 deg/s
    max_gyro_std_rad_s: NonNegative = 0.02  # per axis; an ITG3205 at 98 Hz has 0.0065, a hand on the cart gives 0.03
    max_accel_std_m_s2: NonNegative = 0.25  # per axis; an ADXL345 at 400 Hz has 0.08
    max_rate_rad_s: NonNegative = 0.7  # mean; the ITG3205 may start with 40 deg/s, more is motion
    # between the means of the window's halves: a bias stays, white noise leaves 0.0003
    max_turn_rad_s: NonNegative = 0.005
    # from what was remembered for this temperature: an even turn looks like a bias
    max_bias_change_rad_s: NonNegative = 0.05
    gravity_tolerance_m_s2: NonNegative = 0.5  # of the measured norm: an accelerometer after calibration
    max_tilt_deg: NonNegative = 20.0  # of the body to gravity; more is a wrong axis, or no cart that stands on a floor
    memory: str | None = None  # file of the biases found, by temperature; one for each board. None: forget them
    remembered: Count = 64  # biases kept there, one per degree of temperature


@dataclass(frozen=True, slots=True)
class AttitudeConfig:
    """Attitude without vision; numbers of VQF are its paper's unless a reason is given."""

    method: Literal["vqf", "complementary"] = "vqf"  # complementary: Karpov 2026, the paper's cart
    # relative change of the field's norm: iron or a motor is near; of complementary also of its z
    mag_gate: Share = 0.1

    tilt_floor_deg: NonNegative = 0.4  # vqf publishes it, and what motion does on top: 0.05 m/s^2 of bias is 0.3 deg
    tau_s: Positive = 3.0  # vqf: the force is averaged over it, at least
    tau_max_s: Positive = 10.0  # at most, while the body keeps its tilt
    speed_change_m_s: NonNegative = 1.0  # a walk or a cart that starts; with the next it says what lies between the two
    gyro_error: Share = 0.05  # share of the rate: scale is +-6 % and cross-axis 2 % of an ITG3205 as it comes
    # a body that tilted is remembered for so long: each change of tau lets some motion through
    sway_s: NonNegative = 60.0
    bias_sigma_deg_s: NonNegative = 0.5  # of the gyro's bias, when nothing is known
    bias_motion_sigma_deg_s: NonNegative = 0.1  # what motion and gravity show of it in the long run
    bias_rest_sigma_deg_s: NonNegative = 0.03  # and rest
    bias_vertical_variance: NonNegative = 1e4  # times, about the vertical, where gravity shows nothing
    bias_forgetting_s: NonNegative = 100.0  # in which it may wander by 0.1 deg/s
    bias_innovation_deg_s: NonNegative = 2.0  # no bias changes by more at once
    rest_s: NonNegative = 1.5  # so long nothing may move
    rest_tau_s: Positive = 0.5  # low-pass from which rate and force do not differ at rest
    rest_rate_deg_s: NonNegative = 2.0  # by more than this
    rest_force_m_s2: NonNegative = 0.5  # and this
    # nor the low-passed force from the begin of rest: a cart that rolls tilts, 0.3 deg
    rest_tilt_m_s2: NonNegative = 0.05
    mag_tau_s: Positive = 9.0  # of the heading
    mag_field_tau_s: Positive = 0.05  # low-pass on the field's norm and dip
    mag_reference_tau_s: Positive = 20.0  # over which norm and dip of the reference follow
    mag_dip_gate_deg: NonNegative = 10.0  # as `mag_gate`, of the dip
    mag_undisturbed_s: NonNegative = 0.5  # the field is trusted after being like the reference for so long
    mag_new_s: NonNegative = 20.0  # another field becomes the reference after so long of turning in it
    mag_new_rate_deg_s: NonNegative = 20.0  # at least as fast as this: what the body carries along would show
    mag_reject_s: NonNegative = 60.0  # after so long, a disturbed field is better than a gyro alone
    mag_reject_factor: NonNegative = 2.0  # at a gain so many times lower

    # complementary, 1/s: leans on the accelerometer over 10 s; half and ten times are worse
    proportional_gain: NonNegative = 0.1
    integral_gain: NonNegative = 0.001  # 1/s^2: learns what bias is left after power-up within minutes
    gate_m_s2: NonNegative = 0.15  # |force| further from gravity is motion, not tilt
    level_cutoff_hz: Positive = 5.0  # low-pass on the force that levels, so that vibration does not close the gate
    mag_gain: NonNegative = 0.05  # 1/s, of the yaw by the magnetometer
    tilt_sigma_deg: NonNegative = 1.0  # that is published; twice the error on synthetic carts, whose springs are ideal
