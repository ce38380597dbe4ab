"""Defaults of the visual front end and of initialisation."""

from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from vislam.config.ranges import Count, Finite, NonNegative, Positive, Range, Whole
from vislam.core.kinds import check_name

_OwnMode = Literal["auto", "mono", "stereo", "rgbd", "planar", "none"]
Mode = _OwnMode | str  # or what a package brings: docs/extend.md


@dataclass(frozen=True, slots=True)
class CalibrationConfig:
    """Files that `vislam calibrate` writes; None keeps what the recording's own sensor files say."""

    camera: str | None = None  # Kalibr's camchain.yaml, an ASL sensor.yaml or ROS's camera_info
    imu: str | None = None  # scale, axes and bias, applied to samples that must be raw
    imu_noise: str | None = None  # Kalibr's imu.yaml or an ASL sensor.yaml; single numbers in `imu` go before it
    mag: str | None = None  # hard and soft iron, applied to a field that must be raw


@dataclass(frozen=True, slots=True)
class PlanarConfig:
    """Odometry of a cart by the floor that one camera sees (front end `planar`)."""

    height_m: NonNegative | None = None  # of cam0 above the floor; known, it makes `auto` choose this front end
    height_sigma_m: NonNegative = 0.002  # a tape, or a measured drive of 3 m: its share of H is an error of scale
    tilt_deg: Finite | None = None  # of the optical axis below the horizon; None: body z is up, cam0 as in the rig
    roll_deg: Finite = 0.0  # about the optical axis, clockwise in the image; counts with tilt_deg only
    tilt_sigma_deg: NonNegative = 0.5  # of both, before the floor itself corrects them; 0.5 deg is 2.5 % of scale
    method: Literal["joint", "split"] = "joint"  # split: Karpov 2026, rotation from above the horizon
    vibration_deg: NonNegative = 0.2  # of a driving cart's tilt, where no gyro measures it
    vibration_known_deg: NonNegative = 0.03  # what the gyro leaves of it
    vibration_s: NonNegative = 3.0  # for which tilt by the gyro is used: springs bring a cart back, bias would not
    tilt_walk_deg: NonNegative = 0.01  # per root of a second, of the mean tilt: load and tyres
    heave_m: NonNegative = 0.002  # of the camera's height between two frames
    # in place of `ekf.vo_inflation`: tilt, springs and stamps are in the covariance already
    vo_inflation: Positive = 1.0
    sigma_px: Positive = 0.3  # of a corner of the floor followed from the keyframe; residuals raise it
    max_tracks: Count = 260  # over the whole image; 60 on the floor are as good as 320
    yaw_gate_sigmas: NonNegative = 4.0  # between the yaw of floor and gyro; beyond, one of them is wrong


@dataclass(frozen=True, slots=True)
class FrontEndConfig:
    """Feature tracking and visual odometry."""

    mode: Mode = "auto"  # auto: the richest the recording offers
    # masks: camK.png (all images) or camK/STAMP.png (one), below 128 where pixels are not used; docs/formats.md
    masks: str | None = None

    max_tracks: Count = 400  # corners; more add little accuracy once the image is covered, and cost time
    min_distance_px: NonNegative = 12.0  # between corners; nearer ones see the same patch
    max_misses: Whole = 2  # frames in a row that a track may fail before it is dropped
    track_sigma_px: Annotated[float, Range(1e-6, 2.0**14)] = (
        1.0  # Lucas-Kanade noise of hand-held video; 0.3 in sharp images
    )
    # rolling shutter, first to last row; 0 is global, None estimates it while running
    readout_s: NonNegative | None = None

    min_depth_m: Positive = 0.3  # nearer is out of focus or out of range
    max_depth_m: NonNegative = 8.0  # of depth images: beyond, structured light guesses
    # 1/m: sigma of z is this times z^2; 1.4e-3 is a Kinect's own, the rest registration
    depth_sigma_rho: Positive = 2e-3
    # of depth images after colour beyond what stamps say, None estimates it while running
    depth_delay_s: Finite | None = None
    # of depth images, first to last row, as the camera moves; None estimates it while running, 0: all rows at once
    depth_readout_s: NonNegative | None = None
    # of the last keyframes, to which a new one's depth is fitted where no IMU is; 2 to 8 differ little, 0: it is not
    local_surfaces: Whole = 4
    depth_alone: bool = True  # frames that vision cannot place are placed by their depth image, as degraded
    depth_alone_sigma_m: Positive = 0.3  # of the place in the keyframe; beyond, depth may meet the wrong surfaces
    stereo_sigma_px: Positive = 0.3  # noise of the disparity

    cauchy: Positive = 3.0  # scale of the robust kernel in standard deviations
    min_inliers: Whole = 15  # fewer: lost; six unknowns need some redundancy
    astray_px: NonNegative = 6.0  # from where a filter that knows its motion expects a track: it belongs to what moves

    keyframe_parallax_px: NonNegative = 40.0  # median with rotation taken out
    keyframe_min_inliers: Whole = 60  # fewer: new corners are worth the drift
    keyframe_min_interval_s: NonNegative = 0.15  # brisk motion: at most about six keyframes a second
    keyframe_max_interval_s: NonNegative = 2.0  # a camera at rest still reports
    described_features: Count = 1000  # ORB keypoints per keyframe for loop closing

    planar: PlanarConfig = field(default_factory=PlanarConfig)

    def __post_init__(self) -> None:
        """Refuse a front end that there is not."""
        check_name("frontend.mode", self.mode, get_args(_OwnMode), "vislam.front_ends")


@dataclass(frozen=True, slots=True)
class InitConfig:
    """How the first gravity-aligned state is found."""

    rest_s: Positive = 0.75  # the IMU's statistics need this long; shorter pauses happen in hand-held motion
    mono_window_s: NonNegative = 4.0  # without scale, acceleration has to be seen against its bias, which takes longer
    accel_bias_sigma_m_s2: Positive = 0.2  # prior; a calibrated cheap accelerometer
    gyro_bias_sigma_rad_s: NonNegative = 0.5  # prior for the motion start; wide enough for the ITG3205's 40 deg/s
    # relative, monocular only: a provisional start, which the window that follows refines
    max_scale_sigma: NonNegative = 0.1
    test_s: NonNegative = 1.0  # a start is final when a solution of so much more motion agrees with it
    give_up_s: NonNegative = 30.0  # go on with vision alone after so long without a trustworthy first state
    min_excitation_m_s2: NonNegative = 0.15  # monocular: rms change of acceleration; less is also what vibration leaves
    time_offset: bool = True  # estimate what the camera's clock is off from the IMU's, and correct its stamps
    time_offset_s: Finite = 0.0  # what is known before: added to the camera's stamps from the first frame on
    time_offset_sigma_s: NonNegative = 0.015  # of that; drivers that stamp on arrival are off by up to 30 ms
    clock_drift: bool = False  # the camera's stamps are of a clock of its own, as those of video files: follow its rate
