"""Defaults of the sensors of a cart: chips, bridge, camera, recording."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from vislam.config.frontend import CalibrationConfig
from vislam.config.ranges import Count, Few, Finite, Many, NonNegative, Positive, Range

ImuChip = Literal["auto", "lsm6dsox", "mpu6050", "icm20948", "bmi270"]
Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
Axes = tuple[Axis, Axis, Axis]
Vector3 = tuple[Finite, Finite, Finite]
Matrix3 = tuple[Vector3, Vector3, Vector3]

_IDENTITY: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """From the axes of chips to the calibrated body frame (x forward, y left, z up): axes first, then the rest.

    `calibrated = matrix @ (turned - bias)`, where `turned` is in body axes; zero and identity are an ideal chip.
    """

    gyro_axes: Axes = ("x", "y", "z")  # axes of the chip that point along x, y, z of the body
    accel_axes: Axes = ("x", "y", "z")  # the three chips of a GY-85 are placed alike; check yours: docs/sensors.md
    mag_axes: Axes = ("x", "y", "z")  # clones are placed otherwise
    gyro_bias_rad_s: Vector3 = (0.0, 0.0, 0.0)
    gyro_matrix: Matrix3 = _IDENTITY
    accel_bias_m_s2: Vector3 = (0.0, 0.0, 0.0)
    accel_matrix: Matrix3 = _IDENTITY
    mag_bias_ut: Vector3 = (0.0, 0.0, 0.0)
    mag_matrix: Matrix3 = _IDENTITY


@dataclass(frozen=True, slots=True)
class Gy85Config:
    """The GY-85 board (ADXL345, ITG3205, HMC5883L or a clone of it) on an I2C bus."""

    bus: str = "/dev/i2c-1"  # pins 3 and 5 of a Raspberry Pi
    rate_hz: Positive = 400.0  # of samples; 30 % of a 400 kHz bus. On a 100 kHz bus ask for 100
    gyro_bandwidth_hz: Literal[256, 188, 98, 42, 20, 10, 5] = 98  # below half the rate: the chip cannot be aliased
    gyro_delay_s: NonNegative | None = None  # of that filter, taken off the stamps; None: what its makers state
    accel_rate_hz: Literal[100, 200, 400, 800] = 400  # 1600 and more lose the last bit, less than 100 no self-test
    accel_range_g: Literal[2, 4, 8, 16] = 16  # full resolution has 3.9 mg in every range, so the widest costs nothing
    mag: bool = True  # look for a magnetometer
    mag_rate_hz: Positive = 50.0  # how often it is asked; it measures at 75 (clones: 100)
    mag_range_ga: Positive = 1.9  # or the next wider one that the chip has; the earth has 0.25 to 0.65, motors add
    self_test: bool = True  # at the start, 1 s, standing still; docs/sensors.md
    supply_v: Positive = 3.3  # of the accelerometer: its self-test limits grow with it
    reopen_s: NonNegative = 0.5  # between attempts to reach a chip or bus that went away; one costs up to 0.1 s
    silent_s: NonNegative = 0.1  # without a sample, a chip is set up again, and the source reports it as missing
    max_temperature_change_c: NonNegative = 10.0  # since the biases were taken; an ITG3205 then drifts by up to 1 deg/s
    calibration: SensorCalibration = field(default_factory=SensorCalibration)


@dataclass(frozen=True, slots=True)
class BoardConfig:
    """A board on an I2C bus whose inertial chip has a FIFO; docs/sensors.md lists the chips."""

    chip: ImuChip = "auto"  # a family, known by its id; auto: whichever answers
    bus: str = "/dev/i2c-1"  # pins 3 and 5 of a Raspberry Pi
    address: Annotated[int, Range(1, 127)] | None = None  # None: wherever such a chip can be
    rate_hz: Positive = 200.0  # or the next higher rate that the chip has; 400 Hz need a bus of 400 kHz
    gyro_range_deg_s: Literal[250, 500, 1000, 2000] = 500  # a cart turns by 200 at most; in the hand ask for 2000
    accel_range_g: Literal[2, 4, 8, 16] = 8  # wheels on thresholds give 5
    firmware: str | None = None  # configuration that a BMI270 needs at every start: Bosch's file, docs/sensors.md
    delay_s: NonNegative | None = None  # of the gyro's filter, taken off the stamps; None: the chip's own
    mag: bool | None = None  # a magnetometer must be there; None: it is used if there is one at the start
    mag_rate_hz: Positive = 50.0  # how often it is asked
    mag_range_ga: Positive = 1.9  # or the next wider one that the chip has; the earth has 0.25 to 0.65, motors add
    reopen_s: NonNegative = 0.5  # between attempts to reach a chip or bus that went away
    silent_s: NonNegative = 0.1  # without a sample, the chip is set up again, and the source reports it as missing
    max_temperature_change_c: NonNegative = 10.0  # since the biases were taken
    calibration: SensorCalibration = field(default_factory=SensorCalibration)


@dataclass(frozen=True, slots=True)
class BridgeClockConfig:
    """The line that turns the serial bridge's clock into the host's."""

    bin_s: Positive = 0.1  # the least delayed arrival of each counts; the line is fitted again after each
    settle_s: NonNegative = 0.5  # no sample is passed before the rate has been seen for so long


@dataclass(frozen=True, slots=True)
class SerialConfig:
    """The serial bridge: a microcontroller that reads the inertial chips, docs/sensors.md."""

    port: str = "/dev/ttyUSB0"  # the path in /dev/serial/by-id stays the same when other devices come and go
    baud: Many = 500_000  # exact on a 16 MHz AVR, which misses 230400 by 3.5 %; 400 Hz take a quarter of it
    filter_s: NonNegative = 0.0033  # delay of the gyro's 98 Hz filter, and half a millisecond of its sampling
    missing_s: NonNegative = 0.1  # without a sample for so long, the IMU is missing: 40 samples at 400 Hz
    # an Uno's boot loader runs 2 s after the port is opened; later without a sample, open it again
    start_s: NonNegative = 4.0
    reopen_s: NonNegative = 0.5  # between attempts to open a port that is not there
    calibrated_at_c: Finite | None = None  # temperature of the gyro when its biases were taken
    max_temperature_change_c: NonNegative = 10.0  # from it; an ITG3205 then drifts by up to 1 deg/s
    clock: BridgeClockConfig = field(default_factory=BridgeClockConfig)
    calibration: SensorCalibration = field(default_factory=SensorCalibration)


@dataclass(frozen=True, slots=True)
class LibraryCameraConfig:
    """What all cameras have in common; docs/sensors.md."""

    device: str = ""  # a serial number, an id; empty: the first that is found
    width_px: Count = 640  # enough for 400 tracks; or the nearest size that the camera has, which is reported
    height_px: Count = 480
    rate_hz: Positive = 30.0
    # 1 m/s at 1 m blurs by 5 px; None leaves it to the camera, and lights flicker then
    exposure_s: NonNegative | None = 0.01
    gain: NonNegative | None = None  # in units of the camera; None: its own
    missing_s: NonNegative = 0.5  # without an image for so long the camera is missing: 15 images at 30 Hz
    start_s: NonNegative = 10.0  # until the first image; a device that loads its firmware takes some seconds
    reopen_s: NonNegative = 1.0  # between attempts to open a camera that is not there


@dataclass(frozen=True, slots=True)
class WebcamConfig(LibraryCameraConfig):
    """A webcam on V4L2. What a camera does not do as asked is reported, not hidden."""

    device: str = "0"  # index, or a path below /dev/v4l/by-id, which stays the same when other cameras come and go
    fourcc: str = "MJPG"  # uncompressed video of more than 640x480 at 30 Hz does not fit through USB 2
    # in units of the camera, 0 is infinity; None leaves autofocus on, which moves the centre
    focus: Finite | None = 0.0
    white_balance_k: NonNegative | None = None  # None leaves it to the camera: tracking uses grey images
    buffers: Few = 2  # of the driver; with one, it has nowhere to put the next image while one is decoded
    # from capture to arrival, where the driver's stamps cannot be used: exposure, readout, USB
    delay_s: NonNegative = 0.05
    start_s: NonNegative = 5.0  # until the first image; some cameras take 2 s


@dataclass(frozen=True, slots=True)
class PicamConfig(LibraryCameraConfig):
    """The Raspberry Pi's own camera, by picamera2."""

    device: str = "0"  # its number, as rpicam-hello counts
    focus: NonNegative | None = 0.0  # dioptres, 0 is infinity; None leaves autofocus on, which moves the centre
    buffers: Few = 4  # one is read, one waits, two are with the camera


@dataclass(frozen=True, slots=True)
class DepthCameraConfig(LibraryCameraConfig):
    """A camera with a stereo pair, or colour and depth, and its maker's calibration; where it sits on the body."""

    # place of its first camera (left or colour), m; None: only a calibration file has it
    position_m: Vector3 | None = None
    tilt_deg: Annotated[float, Range(-90.0, 90.0)] = 0.0  # nose down from looking ahead
    imu_rate_hz: Positive = 200.0  # of its own IMU's gyro, where that is read; the nearest that it has
    imu_silent_s: NonNegative = 0.1  # without a sample for so long, its IMU is missing
    calibration: SensorCalibration = field(default_factory=SensorCalibration)  # of its own IMU, beside its maker's


@dataclass(frozen=True, slots=True)
class RealsenseConfig(DepthCameraConfig):
    """A RealSense, by pyrealsense2."""

    # from the middle of the exposure to arrival, at the fastest: half of 10 ms, readout and USB; not measured
    delay_s: NonNegative = 0.02
    # from a sample of its IMU to arrival, at the fastest: the filter and USB; not measured
    imu_delay_s: NonNegative = 0.002


@dataclass(frozen=True, slots=True)
class OakConfig(DepthCameraConfig):
    """An OAK, by depthai."""

    height_px: Count = 400  # with 640 the shape of its sensors: nothing is cut off
    gain: NonNegative | None = 400.0  # ISO, with a fixed exposure: 100 to 1600


@dataclass(frozen=True, slots=True)
class SensorsConfig:
    """The sensors of a cart, for `vislam record`; a TOML file with these sections describes one cart."""

    gy85: Gy85Config = field(default_factory=Gy85Config)
    board: BoardConfig = field(default_factory=BoardConfig)
    serial: SerialConfig = field(default_factory=SerialConfig)
    webcam: WebcamConfig = field(default_factory=WebcamConfig)
    picam: PicamConfig = field(default_factory=PicamConfig)
    realsense: RealsenseConfig = field(default_factory=RealsenseConfig)
    oak: OakConfig = field(default_factory=OakConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    gyroscope_noise_density: NonNegative = 5.2e-4  # rad/s/sqrt(Hz) without a noise file: the ITG3205's data sheet
    accelerometer_noise_density: NonNegative = 6.0e-3  # m/s^2/sqrt(Hz): the ADXL345's data sheet, its worst axis
    gyroscope_random_walk: NonNegative = 2e-5  # rad/s^2/sqrt(Hz), usual for such chips; no data sheet has it
    accelerometer_random_walk: NonNegative = 2e-4  # m/s^3/sqrt(Hz), as well
    # horizontal field of view without a camera file; webcams have 60 to 80
    hfov_deg: Annotated[float, Range(0.0, 180.0, without_low=True, without_high=True)] = 70.0


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """Recording of live sensors to a disk that may be slow or full."""

    max_gb: Positive = 8.0  # the recording ends at this size; 640x480 JPEG at 30 Hz takes 9 an hour
    min_free_gb: NonNegative = 1.0  # and when the disk has less left: a full root disk stops the machine
    image_format: Literal["jpg", "png"] = "jpg"  # MJPG cameras give no more; png takes five times the space
    image_queue: Count = 60  # images that may wait for the disk: 2 s, and 55 MB at 640x480


@dataclass(frozen=True, slots=True)
class FurtherSensorsConfig:
    """Sensors other than IMU and camera; docs/more-sensors.md."""

    file: str | None = None  # TOML with a table `[sensors.NAME]` for each, beside which their readings lie
