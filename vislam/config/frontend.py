"""Defaults of the visual front end and of initialisation."""

from dataclasses import dataclass, field
from typing import Literal, get_args

from vislam.config.ranges import Count, Finite, NonNegative, Positive, Share, Whole
from vislam.core.kinds import check_name

_OwnMode = Literal["auto", "mono", "stereo", "rgbd", "planar"]
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
    tilt_deg: Finite | None = None  # of the optical axis below the horizon; None: body z is up, cam0 as the rig says
    roll_deg: Finite = 0.0  # about the optical axis, clockwise in the image; counts with tilt_deg only
    tilt_sigma_deg: NonNegative = 0.5  # of both, before the floor itself corrects them; 0.5 deg is 2.5 % of scale
    method: Literal["joint", "split"] = "joint"  # split: Karpov 2026, rotation from above the horizon
    vibration_deg: NonNegative = 0.2  # of a driving cart's tilt, where no gyro tells it
    vibration_known_deg: NonNegative = 0.03  # what the gyro leaves of it
    vibration_s: NonNegative = 3.0  # so long the gyro's word on tilt counts: springs bring a cart back, bias would not
    tilt_walk_deg: NonNegative = 0.01  # per root of a second, of the mean tilt: load and tyres
    heave_m: NonNegative = 0.002  # of the camera's height between two frames
    # in place of `ekf.vo_inflation`: tilt, springs and stamps are in the covariance already
    vo_inflation: Positive = 1.0
    stamp_jitter_s: NonNegative = 0.002  # of frames, by a webcam over USB; in a turn 1 ms is 0.05 deg
    sigma_px: Positive = 0.3  # of a corner of the floor followed from the keyframe; residuals raise it
    # of floor points: a pixel is worth d^2 / H; at 8, patches come out 0.2 % short
    max_distance_heights: NonNegative = 5.0
    correlation_m: NonNegative = 10.0  # way over which an error of height or tilt adds up: the size of a room
    max_tracks: Count = 260  # over the whole image; 60 on the floor are as good as 320
    min_points: Whole = 20  # of the floor that agree on a motion; fewer: lost
    min_cells: Whole = 4  # of 8 parts of the floor in which they lie
    texture_ratio: NonNegative = 4.0  # of a corner's response to that of image noise alone; below, it is noise
    yaw_gate_sigmas: NonNegative = 4.0  # between the yaw of floor and gyro; beyond, one of them is wrong
    yaw_gate_deg: NonNegative = 0.3  # and by at least as much
    history_frames: Count = 8  # method split: a base frame is at most so old


@dataclass(frozen=True, slots=True)
class FrontEndConfig:
    """Feature tracking and visual odometry."""

    mode: Mode = "auto"  # auto: the richest the recording offers

    max_tracks: Count = 400  # corners; more add little accuracy once the image is covered, and cost time
    cell_px: Count = 48  # side of the grid cells that share the tracks
    min_distance_px: NonNegative = 12.0  # between corners; nearer ones see the same patch
    min_corner_response: NonNegative = 1.0  # (grey levels / px)^2, smaller eigenvalue; sensor noise gives less
    flow_window_px: Count = 16  # Lucas-Kanade window: larger is robuster to blur, smaller to parallax, and cheaper
    flow_levels: Whole = 3  # pyramid levels above the image: reach of about 80 px around the predicted place
    # forward-backward disagreement of a good match; 0.7 drops blurred ones that still help
    max_back_px: NonNegative = 1.5
    max_misses: Whole = 2  # frames in a row that a track may fail before it is dropped
    track_sigma_px: Positive = 1.0  # Lucas-Kanade noise of hand-held video; 0.3 in sharp images
    # rolling shutter, first to last row; 0 is global, None estimates it while running
    readout_s: NonNegative | None = None

    min_depth_m: NonNegative = 0.3  # nearer is out of focus or out of range
    max_depth_m: NonNegative = 8.0  # of depth images: beyond, structured light guesses
    # 1/m: sigma of z is this times z^2; 1.4e-3 is a Kinect's own, the rest registration
    depth_sigma_rho: Positive = 2e-3
    # of the spread of 1/z within 8x8 px: what a wrong registration by some pixels costs
    depth_spread: NonNegative = 0.5
    depth_now_factor: NonNegative = 2.0  # on the sigma of depth between keyframes, which is not averaged over time
    # of depth images after colour beyond what stamps say, None estimates it while running
    depth_delay_s: Finite | None = None
    # of depth images, first to last row, as the camera moves; None estimates it while running, 0: all rows at once
    depth_readout_s: NonNegative | None = None
    depth_edge_rho: NonNegative = 0.06  # 1/m: a larger spread is an edge, its depth belongs to nobody
    # of the last keyframes, to which a new one's depth is fitted where no IMU is; 2 to 8 differ little, 0: it is not
    local_surfaces: Whole = 4
    depth_alone: bool = True  # frames that vision cannot place are placed by their depth image, as degraded
    depth_alone_sigma_m: Positive = 0.3  # of the place in the keyframe; beyond, depth may meet the wrong surfaces
    depth_alone_overlap: Share = 0.4  # of its surface that falls on the last keyframes'; less fits by chance
    # between the exposures of depth and colour of a frame: TUM's pairs are up to 16 ms apart, and depth is stamped late
    depth_apart_s: NonNegative = 0.03
    depth_alone_renew: Share = 0.6  # overlap below which a new keyframe begins; each costs drift
    stereo_window_px: Count = 15  # smaller than in time: depth edges hurt, blur is the same in both images
    stereo_levels: Whole = 3  # pyramid levels above the image
    stereo_sigma_px: Positive = 0.3  # noise of the disparity
    epipolar_gate_px: NonNegative = 1.5  # distance from the epipolar line that calibration and noise explain

    # of rotation by the gyro since a keyframe, beside its bias: scale, time offset
    mono_gyro_sigma_rad: NonNegative = 0.002
    mono_min_parallax_px: NonNegative = 3.0  # less, and the direction of motion drowns in noise: only rotation is told

    cauchy: Positive = 3.0  # scale of the robust kernel in standard deviations
    min_inliers: Whole = 15  # fewer: lost; six unknowns need some redundancy
    degraded_inliers: Whole = 40  # fewer: degraded
    min_inlier_ratio: Share = 0.3  # of the followed tracks; below, the agreement may be chance
    degraded_inlier_ratio: Share = 0.5  # of the followed tracks
    patience_s: NonNegative = 0.4  # so long a lost keyframe is searched for before a new one starts
    min_start_corners: Whole = 40  # an image with fewer cannot start a keyframe
    min_given: Whole = 8  # in place of both numbers for tracks given from elsewhere: few, but somebody chose them
    astray_px: NonNegative = 6.0  # from where a filter that knows its motion expects a track: it belongs to what moves
    contradicting_share: Share = 0.5  # of the tracks behind vision's motion are astray: it is not the camera's
    min_expected_share: Share = 0.2  # of the tracks have to be where they are expected, or the expectation is wrong

    keyframe_parallax_px: NonNegative = 40.0  # median with rotation taken out
    keyframe_rotation_deg: NonNegative = 15.0  # patches turn with the camera and stop matching
    keyframe_min_alive: Share = 0.45  # fraction of the keyframe's tracks that are still followed
    keyframe_min_alive_unfit: Share = 0.2  # the same for a frame without depth, which makes a poor keyframe
    keyframe_min_inliers: Whole = 60  # fewer: new corners are worth the drift
    keyframe_min_interval_s: NonNegative = 0.15  # brisk motion: at most about six keyframes a second
    keyframe_max_interval_s: NonNegative = 2.0  # a camera at rest still reports
    restart_keyframes: Whole = 8  # after a loss, so many come as soon as they may: chances to recognise the place
    described_features: Count = 1000  # ORB keypoints per keyframe for loop closing

    planar: PlanarConfig = field(default_factory=PlanarConfig)

    def __post_init__(self) -> None:
        """Refuse a front end that there is not."""
        check_name("frontend.mode", self.mode, get_args(_OwnMode), "vislam.front_ends")


@dataclass(frozen=True, slots=True)
class InitConfig:
    """How the first gravity-aligned state is found."""

    still_px: NonNegative = 0.8  # median image motion over 0.5 s, noise taken out: below, the camera may be at rest
    rest_s: NonNegative = 0.75  # the IMU's statistics need this long; shorter pauses happen in hand-held motion
    rest_gyro_std_rad_s: NonNegative = 0.03  # idling EuRoC drone 0.007 to 0.03, hovering above 0.065 (0.5 s windows)
    # idling motors shake up to 0.35; the gyro and the image decide between the two
    rest_accel_std_m_s2: NonNegative = 0.4
    rest_gyro_max_rad_s: NonNegative = 0.7  # mean rate: only the boot bias of a cheap gyro (ITG3205: 40 deg/s) may show
    # of the measured norm: accelerometer bias and scale of a calibrated sensor
    gravity_tolerance_m_s2: NonNegative = 0.5
    window_s: NonNegative = 2.0  # metric visual odometry: gravity to 0.03 deg plus what the accelerometer bias hides
    window_min_s: NonNegative = 1.0  # try from here on
    mono_window_s: NonNegative = 4.0  # without scale, acceleration has to be seen against its bias, which takes longer
    mono_window_min_s: NonNegative = 1.0
    node_spacing_s: Positive = 0.1  # frames closer than this add noise and cost, not knowledge
    vo_inflation: Positive = 1.5  # on the sigmas of relative motion, which share the keyframe's landmark errors
    accel_bias_sigma_m_s2: NonNegative = 0.2  # prior; a calibrated cheap accelerometer
    gyro_bias_sigma_rad_s: NonNegative = 0.5  # prior for the motion start; wide enough for the ITG3205's 40 deg/s
    max_tilt_sigma_deg: NonNegative = 2.0  # 0.2 m/s^2 of unknown accelerometer bias alone is 1.2 deg
    max_velocity_sigma_m_s: NonNegative = 0.2
    max_gyro_bias_sigma_rad_s: NonNegative = 0.02
    # relative, monocular only: a provisional start, which the window that follows refines
    max_scale_sigma: NonNegative = 0.1
    settled_scale_sigma: NonNegative = 0.03  # of a start that is final, unless the window has reached its length before
    level_s: NonNegative = 0.1  # with metric vision: samples before the first frame that say at once what is level
    level_accel_sigma_m_s2: NonNegative = 1.5  # of a body that may move: a hand or a drone; 9 deg of tilt
    level_speed_sigma_m_s: NonNegative = 2.0  # of the same
    test_s: NonNegative = 1.0  # a start is final when a solution of so much more motion agrees with it
    # chi-square per degree of freedom; above it the model does not explain the window
    max_residual_ratio: NonNegative = 3.0
    give_up_s: NonNegative = 30.0  # go on with vision alone after so long without a trustworthy first state
    attempt_s: NonNegative = 0.3  # between attempts: one costs up to 0.1 s, and a window changes little in this time
    max_nodes: Count = 45  # bounds the cost of one attempt (dense, cubic); longer windows get wider spacing
    mono_max_nodes: Count = 20  # the same without scale, where every node also carries its sightings of points
    max_points: Count = 60  # monocular: points solved for; more cost time and hardly sharpen scale
    min_points: Whole = 10  # monocular: two numbers a sighting leave some redundancy; how much, the sigmas say
    min_parallax_px: NonNegative = 12.0  # monocular: median over the points; below, depth and so scale drown in noise
    min_excitation_m_s2: NonNegative = 0.15  # monocular: rms change of acceleration; less is also what vibration leaves
    time_offset: bool = True  # estimate what the camera's clock is off from the IMU's, and correct its stamps
    time_offset_s: Finite = 0.0  # what is known before: added to the camera's stamps from the first frame on
    time_offset_sigma_s: NonNegative = 0.015  # of that; drivers that stamp on arrival are off by up to 30 ms
    time_offset_settled_s: NonNegative = 0.0005  # sigma at which the estimate is final
    time_offset_min_s: NonNegative = 0.001  # smaller corrections are not worth a step in time
    clock_drift: bool = False  # the camera's stamps are of a clock of its own, as those of video files: follow its rate
    clock_drift_sigma: NonNegative = 0.03  # of that rate: no clock that deserves the name is farther off
    # a metric start waits for this, no longer than its window: 3 mm at 1 m/s
    max_time_offset_sigma_s: NonNegative = 0.003
