"""Every default of vislam in one typed tree, with its unit and its reason.

`load` reads a TOML file and applies `{"section.field": value}` overrides; `dump` gives the resolved tree as plain data,
which every run writes down as `config.json`.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import TypeAdapter, ValidationError

from vislam.errors import UsageError

Options = TypeVar("Options")


@dataclass(frozen=True, slots=True)
class ImuConfig:
    """Inertial noise; None keeps what the recording's own sensor file says."""

    enabled: bool = True  # off: vision alone, as if the recording had no IMU
    gyro_noise_density: float | None = None  # rad/s/sqrt(Hz)
    accel_noise_density: float | None = None  # m/s^2/sqrt(Hz)
    gyro_bias_walk: float | None = None  # rad/s^2/sqrt(Hz)
    accel_bias_walk: float | None = None  # m/s^3/sqrt(Hz)
    gravity_m_s2: float = 9.81
    buffer_s: float = 30.0  # history kept for spans; longer than any keyframe interval, and 30 s at 400 Hz is 0.7 MB
    noise_tolerance: float = 3.0  # a model of white noise that the quietest half second exceeds by more is raised
    max_gap_s: float = 0.1  # a longer hole between samples is an outage, not something to interpolate across
    max_wait_s: float = 0.5  # a frame waits so long for the inertial sample after it, then goes on without


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

    height_m: float | None = None  # of cam0 above the floor; known, it makes `auto` choose this front end
    height_sigma_m: float = 0.002  # a tape, or a measured drive of 3 m: its share of H is an error of scale
    tilt_deg: float | None = None  # of the optical axis below the horizon; None: body z is up, cam0 as the rig says
    roll_deg: float = 0.0  # about the optical axis, clockwise in the image; counts with tilt_deg only
    tilt_sigma_deg: float = 0.5  # of both, before the floor itself corrects them; 0.5 deg is 2.5 % of scale
    method: Literal["joint", "split"] = "joint"  # split: Karpov 2026, rotation from above the horizon
    vibration_deg: float = 0.2  # of a driving cart's tilt, where no gyro tells it
    vibration_known_deg: float = 0.03  # what the gyro leaves of it
    vibration_s: float = 3.0  # so long the gyro's word on tilt counts: springs bring a cart back, bias would not
    tilt_walk_deg: float = 0.01  # per root of a second, of the mean tilt: load and tyres
    heave_m: float = 0.002  # of the camera's height between two frames
    stamp_jitter_s: float = 0.001  # of frames: what a webcam's driver leaves; in a turn 1 ms is 0.05 deg
    sigma_px: float = 0.3  # of a corner of the floor followed from the keyframe; residuals raise it
    max_distance_heights: float = 5.0  # of floor points: a pixel is worth d^2 / H; at 8, patches come out 0.2 % short
    correlation_m: float = 10.0  # way over which an error of height or tilt adds up: the size of a room
    max_tracks: int = 260  # over the whole image; 60 on the floor are as good as 320
    min_points: int = 20  # of the floor that agree on a motion; fewer: lost
    min_cells: int = 4  # of 8 parts of the floor in which they lie
    texture_ratio: float = 4.0  # of a corner's response to that of image noise alone; below, it is noise
    yaw_gate_sigmas: float = 4.0  # between the yaw of floor and gyro; beyond, one of them is wrong
    yaw_gate_deg: float = 0.3  # and by at least as much
    history_frames: int = 8  # method split: a base frame is at most so old


@dataclass(frozen=True, slots=True)
class FrontEndConfig:
    """Feature tracking and visual odometry."""

    mode: Literal["auto", "mono", "stereo", "rgbd", "planar"] = "auto"  # auto: the richest the recording offers

    max_tracks: int = 400  # more add little accuracy once the image is covered, and cost time
    cell_px: int = 48  # side of the grid cells that share the tracks
    min_distance_px: float = 12.0  # between corners; nearer ones see the same patch
    min_corner_response: float = 1.0  # (grey levels / px)^2, smaller eigenvalue; sensor noise gives less
    flow_window_px: int = 21  # Lucas-Kanade window: larger is robuster to blur, smaller to parallax
    flow_levels: int = 3  # pyramid levels above the image: reach of about 80 px around the predicted place
    max_back_px: float = 1.5  # forward-backward disagreement of a good match; 0.7 drops blurred ones that still help
    max_misses: int = 2  # frames in a row that a track may fail before it is dropped
    track_sigma_px: float = 1.0  # Lucas-Kanade noise of hand-held video; 0.3 in sharp images
    readout_s: float | None = None  # rolling shutter, first to last row; 0 is global, None estimates it while running

    min_depth_m: float = 0.3  # nearer is out of focus or out of range
    max_depth_m: float = 8.0  # of depth images: beyond, structured light guesses
    depth_sigma_rho: float = 2e-3  # 1/m: sigma of z is this times z^2; 1.4e-3 is a Kinect's own, the rest registration
    depth_spread: float = 0.5  # of the spread of 1/z within 8x8 px: what a wrong registration by some pixels costs
    depth_now_factor: float = 2.0  # on the sigma of depth between keyframes, which is not averaged over time
    depth_edge_rho: float = 0.06  # 1/m: a larger spread is an edge, its depth belongs to nobody
    stereo_window_px: int = 15  # smaller than in time: depth edges hurt, blur is the same in both images
    stereo_levels: int = 3  # pyramid levels above the image
    stereo_sigma_px: float = 0.3  # noise of the disparity
    epipolar_gate_px: float = 1.5  # distance from the epipolar line that calibration and noise explain

    mono_gyro_sigma_rad: float = 0.002  # of rotation by the gyro since a keyframe, beside its bias: scale, time offset
    mono_min_parallax_px: float = 3.0  # less, and the direction of motion drowns in noise: only rotation is told

    cauchy: float = 3.0  # scale of the robust kernel in standard deviations
    min_inliers: int = 15  # fewer: lost; six unknowns need some redundancy
    degraded_inliers: int = 40  # fewer: degraded
    min_inlier_ratio: float = 0.3  # of the followed tracks; below, the agreement may be chance
    degraded_inlier_ratio: float = 0.5  # of the followed tracks
    patience_s: float = 0.4  # so long a lost keyframe is searched for before a new one starts
    min_start_corners: int = 40  # an image with fewer cannot start a keyframe

    keyframe_parallax_px: float = 40.0  # median with rotation taken out
    keyframe_rotation_deg: float = 15.0  # patches turn with the camera and stop matching
    keyframe_min_alive: float = 0.45  # fraction of the keyframe's tracks that are still followed
    keyframe_min_alive_unfit: float = 0.2  # the same for a frame without depth, which makes a poor keyframe
    keyframe_min_inliers: int = 60  # fewer: new corners are worth the drift
    keyframe_min_interval_s: float = 0.15  # brisk motion: at most about six keyframes a second
    keyframe_max_interval_s: float = 2.0  # a camera at rest still reports
    restart_keyframes: int = 8  # after a loss, so many come as soon as they may: chances to recognise the place
    described_features: int = 1000  # ORB keypoints per keyframe for loop closing

    planar: PlanarConfig = field(default_factory=PlanarConfig)


@dataclass(frozen=True, slots=True)
class InitConfig:
    """How the first gravity-aligned state is found."""

    still_px: float = 0.8  # median image motion over 0.5 s, noise taken out: below, the camera may be at rest
    rest_s: float = 0.75  # the IMU's statistics need this long; shorter pauses happen in hand-held motion
    rest_gyro_std_rad_s: float = 0.03  # idling EuRoC drone 0.007 to 0.03, hovering above 0.065 (0.5 s windows)
    rest_accel_std_m_s2: float = 0.4  # idling motors shake up to 0.35; the gyro and the image decide between the two
    rest_gyro_max_rad_s: float = 0.7  # mean rate: only the boot bias of a cheap gyro (ITG3205: 40 deg/s) may show
    gravity_tolerance_m_s2: float = 0.5  # of the measured norm: accelerometer bias and scale of a calibrated sensor
    window_s: float = 2.0  # metric visual odometry: gravity to 0.03 deg plus what the accelerometer bias hides
    window_min_s: float = 1.0  # try from here on
    mono_window_s: float = 4.0  # without scale, acceleration has to be seen against its bias, which takes longer
    mono_window_min_s: float = 1.0
    node_spacing_s: float = 0.1  # frames closer than this add noise and cost, not knowledge
    vo_inflation: float = 1.5  # on the sigmas of relative motion, which share the keyframe's landmark errors
    imu_inflation: float = 4.0  # on the white-noise sigmas: vibration and aliasing are not in the data sheets
    accel_bias_sigma_m_s2: float = 0.2  # prior; a calibrated cheap accelerometer
    gyro_bias_sigma_rad_s: float = 0.5  # prior for the motion start; wide enough for the ITG3205's 40 deg/s
    max_tilt_sigma_deg: float = 2.0  # 0.2 m/s^2 of unknown accelerometer bias alone is 1.2 deg
    max_velocity_sigma_m_s: float = 0.2
    max_gyro_bias_sigma_rad_s: float = 0.02
    max_scale_sigma: float = 0.0225  # relative, monocular only; 38 simulated starts and 6 real ones were within 3 %
    max_residual_ratio: float = 3.0  # chi-square per degree of freedom; above it the model does not explain the window
    give_up_s: float = 30.0  # go on with vision alone after so long without a trustworthy first state
    attempt_s: float = 0.3  # between attempts: one costs up to 0.1 s, and a window changes little in this time
    max_nodes: int = 45  # bounds the cost of one attempt (dense, cubic); longer windows get wider spacing
    mono_max_nodes: int = 20  # the same without scale, where every node also carries its sightings of points
    max_points: int = 60  # monocular: points solved for; more cost time and hardly sharpen scale
    min_points: int = 20  # monocular: fewer leave too little redundancy to tell a wrong one
    min_parallax_px: float = 12.0  # monocular: median over the points; below, depth and so scale drown in noise
    min_excitation_m_s2: float = 0.15  # monocular: rms change of acceleration; less is also what vibration leaves
    time_offset: bool = True  # estimate what the camera's clock is off from the IMU's, and correct its stamps
    time_offset_s: float = 0.0  # what is known before: added to the camera's stamps from the first frame on
    time_offset_sigma_s: float = 0.015  # of that; drivers that stamp on arrival are off by up to 30 ms
    time_offset_settled_s: float = 0.0005  # sigma at which the estimate is final
    time_offset_min_s: float = 0.001  # smaller corrections are not worth a step in time
    max_time_offset_sigma_s: float = 0.003  # a metric start waits for this, no longer than its window: 3 mm at 1 m/s


@dataclass(frozen=True, slots=True)
class EkfConfig:
    """The fast path."""

    # loose: motions of visual odometry; tight: the tracks themselves (MSCKF), ten times the time; auto: tight for one
    # camera, whose motions lack scale, loose with stereo or depth
    coupling: Literal["auto", "loose", "tight"] = "auto"
    vision: Literal["relative", "accumulated"] = "relative"  # accumulated: vision's own sum of motions, taken as a pose
    odom: Literal["continuous", "corrected"] = "continuous"  # corrected: 3-30 % less error, 5 cm steps at a first turn
    history_s: float = 5.0  # how late a measurement may come; vision latency is under 0.3 s, a stalled reader longer
    checkpoint_s: float = 0.05  # a rewind replays at most this much more than the delay, 4 kB each
    max_gap_s: float = 0.1  # a longer hole in the samples is bridged with the two sigmas below, and counted
    gap_gyro_rad_s: float = 0.5  # what the rate may have been inside a hole, against its interpolation
    gap_accel_m_s2: float = 2.0  # the same for specific force
    imu_inflation: float = 10.0  # on the white-noise sigmas, for vibration; flying EuRoC: innovations fit at 10, not 4
    vo_inflation: float = 1.5  # on the sigmas of visual odometry: covariances from residuals miss model errors
    vo_shared_fraction: float = 0.5  # of its variance that all motions relative to one keyframe share (its landmarks)
    accumulated_sigma_m: float = 0.02  # fixed R of accumulated vision; 0.005 to 0.1 err alike, below this motions fail
    accumulated_sigma_deg: float = 0.5  # the gate, for the sum has drifted by more than R says
    gate_probability: float = 0.999  # chi-square gate on every innovation
    reset_rejects: int = 5  # this many rejections in a row ...
    reset_s: float = 1.0  # ... over this long mean that the filter is wrong, not vision: P is inflated, counted
    reset_rotation_deg: float = 3.0  # what such a soft reset adds to the sigmas of the state; the state itself stays
    reset_position_m: float = 0.3
    reset_velocity_m_s: float = 1.0
    reset_gyro_bias_rad_s: float = 0.02
    reset_accel_bias_m_s2: float = 0.2
    zero_velocity_sigma_m_s: float = 0.02  # a vehicle "at rest" still sways
    zero_rate_sigma_rad_s: float = 0.005  # one gyro sample at rest against the bias
    nonholonomic: bool = False  # a cart: its axle goes neither sideways nor up; loose coupling only
    nonholonomic_sigma_m_s: float = 0.02  # slip, and the mounting of the IMU: 1 degree at 1 m/s
    axle_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # middle of the axle that does not steer, in the body frame
    floor_sigma_m: float | None = None  # a cart on one level floor: its height varies by so much; None: not used
    rest_sigma_m: float = 0.002  # sway against the pose at which rest began
    rest_sigma_deg: float = 0.05
    vision_delay_s: float = 0.0  # for experiments: vision reaches the filter so much later than it was seen
    piece_sigma_m: float = 5.0  # without vision, a way known no better ties nothing: a new piece of trajectory begins
    graph_feedback: bool = False  # take biases from the graph; off, the filter alone is the honest baseline

    tight_clones: int = 11  # past poses that tracks tie together; half a second at 20 Hz
    tight_points: int = 25  # long tracks kept as points of the state; they stop the drift while little moves
    tight_point_depth_ratio: float = 0.1  # sigma of its distance over it that such a point may have at first
    # on the pixel sigma of such points: real corners err alike in frame after frame; and even with white noise at 1 the
    # filter is too sure of itself (100 runs: NEES of position 4.6 of 3; at 3 it is 2.7)
    tight_point_inflation: float = 3.0
    tight_point_misses: int = 1  # frames in a row that may not see such a point before it is dropped
    tight_max_tracks: int = 60  # used per frame; bounds its time
    tight_iterations: int = 5  # of one update at most; more than one only while velocity is badly known
    tight_min_observations: int = 3  # of a track; two leave one equation
    tight_pixel_sigma_px: float = 1.0  # of a corner followed over many frames
    tight_stereo_sigma_px: float = 0.5  # right minus left pixel: matching, without the error of the corner
    tight_depth_sigma_rho: float = 3e-3  # 1/m, of the inverse of a depth image
    tight_outlier_sigmas: float = 5.0  # one observation of a track; the test of the track follows
    tight_max_depth_ratio: float = 0.3  # sigma over inverse depth; above, a point's place is no base to linearise at
    tight_min_range_m: float = 0.1
    tight_max_range_m: float = 200.0  # beyond, nothing but rotation is seen
    tight_still_px: float = 1.0  # image motion between clones below which the older one is kept instead of the newer
    tight_min_interval_s: float = 0.03  # between clones; a fast camera would leave a window too short for parallax
    tight_imu_inflation: float = 10.0  # on the white-noise sigmas; flying EuRoC: NEES of velocity 2.6 at 4, 0.6 here
    tight_time_offset: bool = True  # estimate what is to be added to the stamps of frames
    tight_time_offset_sigma_s: float = 0.01  # prior; USB cameras are stamped up to 30 ms late
    tight_extrinsic_rotation: bool = True  # refine the camera's rotation in the body
    tight_extrinsic_sigma_deg: float = 0.5  # prior; a calibration 1 deg off is two sigmas
    tight_readout_s: float | None = None  # rolling shutter, first to last row; None: frontend.readout_s, else global
    tight_history_s: float = 2.0  # how late a measurement may come; a state is 100 to 250 kB, one per frame


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """The sliding window of tight coupling: poses, velocities, biases and landmarks of the newest keyframes."""

    keyframes: int = 15  # states in the window; the oldest one is marginalised when another comes
    iterations: int = 6  # most Gauss-Newton steps per keyframe; two or three are usual
    tolerance: float = 5e-3  # relative decrease of the cost that ends them; 1e-3 costs a step more and gains nothing
    sigma_px: float = 1.0  # of a tracked corner between keyframes
    right_sigma_px: float = 1.0  # of the match in the right image
    depth_sigma_rho: float = 4e-3  # 1/m: sigma of 1/z of a depth image; a Kinect's own is 1.4e-3, then registration
    huber_k: float = 2.0  # of a reprojection error, in standard deviations
    gate_probability: float = 0.999  # chi-square of an observation; above it after optimisation, it is taken out
    gate_track_fraction: float = 0.34  # of a track's observations beyond the gate: the whole track goes
    rho_sigma_1_m: float = 10.0  # prior of inverse depth: only keeps points without parallax from running away
    split_min: int = 3  # observations a track gives to the marginal prior at once; the rest starts a new landmark

    imu_inflation: float = 6.0  # on white-noise sigmas, for vibration; flying EuRoC: NEES of velocity 9 at 2, 1.6 here
    imu_max_gap_s: float = 0.1  # a longer hole is an outage
    imu_max_outage_s: float = 1.0  # bridged up to here with the two sigmas below; longer ones drop the factor
    outage_accel_sigma_m_s2: float = 3.0  # what nobody measured during an outage
    outage_gyro_sigma_rad_s: float = 1.0
    reintegrate_gyro_rad_s: float = 0.005  # bias change after which first-order correction is not enough
    reintegrate_accel_m_s2: float = 0.05
    lost_speed_sigma_m_s: float = 1.0  # without IMU data the body is assumed to go on as before, this loosely
    lost_rate_sigma_deg_s: float = 30.0
    rest_speed_sigma_m_s: float = 0.005
    rest_sigma_m: float = 0.001  # motion between two keyframes at rest
    rest_sigma_deg: float = 0.05

    gauge_sigma_m: float = 1e-3  # first position and yaw are a free choice: fixed far below what is measured
    gauge_sigma_rad: float = 1e-3
    restart_sigma_m: float = 0.1  # of the state a window restarts from after a failed solution
    restart_sigma_rad: float = 0.03
    restart_speed_sigma_m_s: float = 0.3
    restart_gyro_bias_sigma_rad_s: float = 0.01
    restart_accel_bias_sigma_m_s2: float = 0.1

    estimate_time_offset: bool = True  # of the camera against the IMU
    time_offset_sigma_s: float = 0.02  # prior; cheap cameras stamp up to 30 ms late
    estimate_rotation: bool = True  # of the camera on the body
    rotation_sigma_deg: float = 0.5  # prior; a calibration by Kalibr is good to 0.1, a printed mount to 1
    estimate_readout: bool = False  # of a rolling shutter; needs brisk rotation
    readout_s: float | None = None  # rolling shutter, first to last row; None: frontend.readout_s, else global
    readout_sigma_s: float = 0.01  # prior, when it is estimated


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """The iSAM2 pose graph: sigmas of its factors, the gate for loops, and how much work an update may do."""

    coupling: Literal["loose", "tight"] = "tight"  # loose: motions of visual odometry; tight: tracks, in a window
    relinearize_rotation_rad: float = (
        0.002  # IMU factors are stiff: 0.01 left 5-13 mm against the exact optimum, this 1.4
    )
    relinearize_translation_m: float = 0.005  # what a voxel map can see
    relinearize_velocity_m_s: float = 0.01
    relinearize_bias: float = 0.001  # rad/s and m/s^2; preintegration's first-order correction is exact to far more
    relinearize_skip: int = 5  # updates between relinearisations; 1 costs 3x the time for the same trajectory
    loop_iterations: int = 3  # extra Gauss-Newton steps after a loop is accepted; bounds the work of an update
    read_newest: int = 300  # poses that each keyframe reads back from the solver; up to this many plus a block: all
    read_block: int = 200  # older poses that each keyframe reads back in turn, so that its work does not grow
    finish_iterations: int = 10  # most steps of the final convergence before batch has its try
    moved_m: float = 0.001  # poses that moved less are not published again
    moved_deg: float = 0.05

    gauge_sigma_m: float = 1e-3  # first position and yaw are a free choice: fixed far below what is measured
    gauge_sigma_rad: float = 1e-3
    tilt_sigma_max_deg: float = 5.0  # first roll and pitch follow the initialisation, within these bounds
    tilt_sigma_min_deg: float = 0.05
    gyro_bias_sigma_max: float = (
        0.05  # rad/s; bounds of the first bias prior, so that pivots stay within what gtsam takes
    )
    accel_bias_sigma_max: float = 0.5  # m/s^2
    gyro_bias_walk_floor: float = 2e-5  # rad/s^2/sqrt(Hz); gtsam 4.3.0 throws when prior sigma / step sigma > 4096
    accel_bias_walk_floor: float = 3e-4  # m/s^3/sqrt(Hz)
    covariance_ratio_max: float = 1e6  # eigenvalue ratio of any factor; gtsam 4.3.0 throws above 1e7

    vo_inflation: float = 4.0  # on sigma; against truth, motion between keyframes errs 4 to 8 times what residuals say
    vo_degraded_inflation: float = 3.0  # further, when the front end says degraded
    vo_floor_deg: float = 0.05  # no camera and calibration is better than this between keyframes
    vo_floor_m: float = 0.001
    direction_floor_deg: float = 0.2  # mono: direction of motion
    direction_soft_m: float = 0.005  # mono: baselines shorter than this lose their say on direction
    direction_scale_sigma: float = 5.0  # mono: relative, on the expected step; wide, for only the IMU knows the scale
    window_inflation: float = 2.0  # on sigma of a window's edges; consecutive ones share errors, here they are summed
    window_floor_deg: float = 0.01  # no calibration lets a window know more
    window_floor_m: float = 0.0005
    window_refresh_sigma: float = 0.3  # a provisional edge that moved by more of its sigma is replaced at once ...
    window_refresh_max: int = 3  # ... up to so many per keyframe, those that moved most
    tilt_every: int = 10  # keyframes between tilt factors; errors of nearer ones are the same accelerometer bias
    tilt_floor_deg: float = 0.1  # an accelerometer's scale and misalignment, which the window does not estimate
    huber_k: float = 3.5  # whitened norm; the 95 % point of 6 degrees of freedom
    imu_inflation: float = 2.0  # on white noise sigma: data sheets know no vibration, scale error or time jitter
    imu_integration_sigma: float = 1e-4  # m/sqrt(s), what sampling at finite rate leaves
    imu_max_gap_s: float = 0.1  # a longer hole is an outage
    imu_max_outage_s: float = 1.0  # outages up to this are bridged with the sigmas below, longer ones drop the factor
    outage_accel_sigma_m_s2: float = 3.0  # what nobody measured during an outage
    outage_gyro_sigma_rad_s: float = 1.0
    lost_speed_sigma_m_s: float = 1.0  # without vision and IMU the body is assumed to go on as before, this loosely
    lost_rate_sigma_deg_s: float = 30.0
    rest_speed_sigma_m_s: float = 0.005
    rest_sigma_m: float = 0.001  # sway of a keyframe at rest against the one at which rest began
    rest_sigma_deg: float = 0.05
    floor_sigma_m: float | None = None  # a cart on one level floor: keyframes are at one height; None: not used
    nonholonomic_sigma_m_s: float | None = None  # a cart: slip of its axle, with loose coupling; None: not used
    axle_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # as in `ekf`

    loop_gate_probability: float = 0.999  # chi-square of a loop against the joint covariance of its two keyframes
    loop_cauchy_k: float = 2.0  # whitened norm
    loop_floor_m: float = 0.005
    loop_floor_deg: float = 0.2
    loop_min_weight: float = 0.05  # a loop that optimisation leaves with less is taken out again
    loop_batch_m: float = 1.0  # a larger correction starts from a batch solution instead of incremental steps
    loop_batch_deg: float = 10.0
    parked_max: int = 200  # parked loops kept; the oldest leave first
    consistency_max_sigma_m: float = 0.5  # odometry looser than this between two loops proves nothing
    witness_keyframes: int = 10  # loops that start and end so near to another's, or ...
    witness_m: float = 1.0  # ... whose ends lie so near to its ends ...
    witness_deg: float = 45.0  # ... looking the same way, see the same things: together they are one witness
    witness_inflation: float = 1.5  # on odometry sigma, for whether two loops of one witness say the same; 3 mixed them
    review_loops: int = 20  # loops after which all are weighed anew, if any was kept out; ...
    review_doubts: int = 3  # ... or so many that were kept out
    review_steps: int = 4  # of a review's work per keyframe: joint marginals of a small graph, 1 to 3 ms each
    loop_gain_min: float = 1.0  # variance of the graph over that of a loop; on long runs less adds no factor
    anchor_after: int = 20  # loops in the graph; after them a loop to a keyframe that is tied to an older one, or ...
    anchor_reach: int = 10  # ... is so many keyframes from one that is, ties to that older one, the place's anchor ...
    anchor_variance_max: float = 4.0  # ... if the way there adds at most so many times the loop's own variance
    vo_scale_max: float = 10.0  # most that loops may inflate the sigma of visual odometry, over a run

    # the link to a keyframe with which a new piece of trajectory begins: nothing is known, but equations stay solvable.
    # 100 times weaker than a loop, no more than 4096 times weaker than an edge, beyond which gtsam 4.3.0 throws
    piece_sigma_m: float = 2.0
    piece_sigma_deg: float = 30.0
    piece_tilt_sigma_deg: float = 5.0  # roll and pitch, where gravity is known on both sides
    piece_speed_sigma_m_s: float = 3.0  # of the first velocity in a piece, with loose coupling
    join_frames: int = 2  # new frames whose loops must agree through odometry to join two pieces: one image can deceive
    join_waiting: int = 20  # newest loops between pieces that are compared for that; bounds the work
    join_max_contradicting: float = 0.25  # of the loops between two pieces; more, and they wait for further ones


@dataclass(frozen=True, slots=True)
class LoopTruthConfig:
    """What counts as a true revisit, and as a wrong edge, when loops are compared with the truth."""

    min_overlap: float = 0.3  # of two views by their true poses; ORB closes few loops below
    doubtful_overlap: float = 0.05  # between this and min_overlap a retrieved image is neither right nor wrong
    min_apart_s: float = 10.0  # a pair is a loop when it is this far apart in time ...
    min_apart_keyframes: int = 30  # ... or by so many keyframes; nearer pairs are tied by odometry anyway
    gross_m: float = 0.5  # an edge whose translation is off by more would ruin a map
    gross_deg: float = 10.0  # or whose rotation is
    nominal_depth_m: float = 3.0  # of features without depth, to know what two views share
    max_truth_gap_s: float = 0.3  # true poses are interpolated over less: a few millimetres by hand or on wheels
    resamples: int = 1000  # of the bootstrap
    block_keyframes: int = 10  # drawn together, because what follows each other errs alike
    confidence: float = 0.95
    seed: int = 0  # of the bootstrap


@dataclass(frozen=True, slots=True)
class BatchConfig:
    """Batch optimisation of a finished run: visual-inertial bundle adjustment over all keyframes."""

    rounds: int = 5  # of optimising, then judging tracks, loops, noise and readout anew; the last changes 3 % or less
    iterations: int = 20  # most Levenberg-Marquardt steps of a round; converged earlier as a rule
    start_gate_px: float = 20.0  # first round: poses of the run may be off, only gross outliers leave
    start_cauchy: float = 3.0  # standard deviations, scale of the kernel in that round
    huber_k: float = 2.0  # standard deviations, in later rounds
    gate_probability: float = 0.999  # chi-square of a pixel or depth that stays, in later rounds
    max_relative_sigma: float = 0.25  # of a landmark's distance by its own rays; farther ones lack parallax or depth
    max_observations: int = 400_000  # bounds memory (2 kB each in gtsam) and time; the longest tracks stay
    min_seen: int = 12  # landmarks; a keyframe that sees fewer also gets the odometry of the run
    imu_inflation: float = 6.0  # on white-noise sigmas, as in the window, for vibration: V2_01 0.040 m, 0.071 m at 2
    vision_inflation: float = 2.0  # on sigmas against the IMU: errors of a track and of calibration go together
    pixel_sigma_min_px: float = 0.2  # bounds of the noise that residuals show, from frontend.track_sigma_px on
    pixel_sigma_max_px: float = 3.0
    loop_probability: float = 0.9999  # a loop beyond this chi-square is refused by graduated non-convexity
    unscaled_odometry_sigma: float = 0.1  # one camera: relative, on the steps of the run's own odometry among the loops
    covariances: bool = True  # of all states; costs about as much as a round


@dataclass(frozen=True, slots=True)
class PoseGraphConfig:
    """Optimisation of a pose graph from a file."""

    start: Literal["auto", "file", "odometry", "tree", "chordal"] = "auto"  # auto: the one of lowest cost
    method: Literal["lm", "dogleg", "gtsam", "isam2"] = "lm"
    robust: Literal["none", "gnc"] = "none"  # gnc: edges that do not join successive ids may be rejected
    iterations: int = 100  # most of them; 3 to 8 as a rule
    tolerance: float = 1e-9  # of the cost: the decrease still to come at which to end
    inlier_probability: float = 0.999  # chi-square beyond which a loop is false; 1 of 1000 true ones goes with it
    certify: bool = True  # examine whether the optimum is the global one: takes two to five times as long as finding it
    covariances: bool = False  # write those of all poses: in space 300 bytes each


@dataclass(frozen=True, slots=True)
class GraphWorldConfig:
    """A made pose graph, as `vislam simulate --graph` writes it. Noise is white, of odometry and loops alike."""

    poses: int = 1000
    loops_per_pose: float = 1.0  # true ones; only between poses that are at most 5 m apart
    rotation_sigma_deg: float = 1.0  # per axis; the drift of a thousand steps then needs its loops
    translation_sigma_m: float = 0.05  # per axis; 5 % of a step, poor odometry
    anisotropy: float = 1.0  # forward, and about z, the sigmas are this many times as large
    outlier_fraction: float = 0.0  # of all loops
    alias_group: int = 1  # so many false loops in a row agree, as a corridor that looks like another one gives them
    seed: int = 0  # same seed, same graph


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """Loop detection and verification."""

    enabled: bool = True
    match_ratio: float = 0.8  # nearest to second nearest descriptor; 0.8 keeps true matches of repeated texture out
    match_max_distance: int = 64  # bits of 256; unrelated ORB descriptors are 128 apart
    inlier_px: float = 3.0  # reprojection error of an inlier; ORB's coarse octaves are good to 2 px
    min_inliers: int = 12  # of PnP; 5,735 pairs of different places gave at most 7
    guided_radius_px: float = 8.0  # search around a point's predicted place once a pose is known
    feature_sigma_px: float = 1.0  # of a keypoint; only its ratio to the depth sigma matters, residuals set the scale
    inverse_depth_sigma_1_m: float = 0.01  # of the difference of two inverse depths
    epipolar_px: float = 1.5  # Sampson error of an inlier where no depth is known
    min_inliers_direction: int = 25  # of the essential matrix; wrong matches reached 15 in 5,735 pairs
    min_parallax_px: float = 6.0  # median that rotation does not explain; less, and the direction is noise
    max_plane_share: float = 0.8  # of the matches; a plane seen twice fits two directions (one was wrong by 109 deg)
    # the fit's own covariance is several times too small (coarse octaves, depth bias, rolling shutter): with these
    # the mean squared error per degree of freedom is 1.1 on TUM fr1_desk, 0.3 on EuRoC MH_01 (motion capture), and 0.1
    # on simulated images, which are kinder than real ones
    covariance_inflation: float = 16.0  # of the fit's variance
    sigma_floor_m: float = 0.005
    sigma_floor_deg: float = 0.25
    direction_floor_deg: float = 2.0  # of a direction without scale: the lever arm of the camera is not in it
    max_sigma_m: float = 0.03  # a pose this good needs no witness; for a scene at 2 m, grows with depth
    max_sigma_any_m: float = 0.10  # a worse pose is no edge and no witness: it can be half a metre off
    agreement_m: float = 0.15  # a witness differs by less; for a scene at 2 m, grows with depth
    agreement_deg: float = 8.0  # a witness differs by less
    agreement_sigmas: float = 3.0  # and by less than both standard deviations, taken together, explain
    agreement_slack_m: float = 0.03  # beside what odometry adds between neighbours
    min_agreement_share: float = 0.5  # of matches that also agree the other way round, and in depth
    max_tilt_deg: float = 5.0  # against gravity; well above the error of a good edge and of the map's own tilt
    max_rotation_sigma_deg: float = 2.0  # of an edge without scale
    max_direction_sigma_deg: float = 5.0  # of its direction
    min_agreeing_direction: int = 2  # witnesses of an edge without scale, which is never taken alone
    max_disagreeing_share: float = 0.25  # of the witnesses; the edges that were wrong by sigmas had at least a third
    neighbour_keyframes: int = 5  # witnesses are at most so far away, so that odometry to them is good
    max_verifications: int = 5  # per keyframe, 4 to 7 ms each: bounds its time; 4 and 6 give the same accuracy
    max_odometry: int = 3  # candidates per keyframe that the map's poses suggest
    odometry_skip_keyframes: int = 5  # the newest ones are tied by visual odometry already
    min_overlap: float = 0.35  # share of what is seen that a candidate should see too, by the map
    min_apart_keyframes: int = 3  # between odometry candidates, so that they constrain different places
    nominal_depth_m: float = 3.0  # of features without depth, to guess what two keyframes share
    max_appearance: int = 2  # candidates per keyframe that look alike
    tags: Literal["off", "16h5", "25h9", "36h10", "36h11"] = "36h11"  # AprilTag family; 3 ms per keyframe
    tag_size_m: float | None = None  # side of the black square; known, a tag alone gives a relative pose
    max_tags: int = 2  # candidates per keyframe that saw the same tag
    retrieved: int = 10  # keyframes asked of the index before they are grouped into islands
    island_gap: int = 3  # ids in one island differ by at most this
    appearance_skip_keyframes: int = 20  # the newest ones always look most alike
    appearance_skip_s: float = 5.0  # and so do those of the last seconds
    vocabulary: str | None = None  # file of `vislam vocabulary`; None: the one that comes along, then the run's own
    train: Literal["auto", "always", "never"] = "auto"  # on the run's own keyframes; auto: unless a file is given
    first_training: int = 20  # keyframes; trained on fewer, words find less than those that come along
    training_growth: float = 1.25  # keyframes, until trained again: words find less what they were not trained on
    min_training_lag: int = 2  # keyframes that come during a training, at least ...
    training_lag_share: float = 0.05  # ... and of those it is trained on; so long it takes at 10 keyframes a second
    catch_up_keyframes: int = 8  # of those, so many are indexed with each new one once it is done: 0.4 ms each
    training_descriptors: int = 500_000  # at most: bounds a training, in the background, to 2 s
    vocabulary_branching: int = 10  # children of a node
    vocabulary_depth: int = 6  # levels at most; as many as leave each word five descriptors
    inject_share: float = 0.0  # for experiments: share of false loops, made up, among those that the graph is offered
    inject_group: int = 1  # how many of them agree among themselves, as from an object that is there twice


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """Where the cart can stand and drive, from the octree."""

    body_length_m: float = 0.60  # of the cart, whose middle is the body's origin
    body_width_m: float = 0.50
    max_step_m: float = 0.05  # between neighbouring cells; less than a voxel is taken for one, which is what is seen
    max_slope_deg: float = 10.0  # what a cart with small wheels and a load brakes on
    slope_window_m: float = 0.40  # slope is that of a plane through the ground within it: a voxel's step is no slope


MapProduct = Literal["cloud", "pcd", "octomap", "ot", "grid", "drive", "mesh", "glb", "obj", "poisson", "surfels"]


@dataclass(frozen=True, slots=True)
class MonoDepthConfig:
    """Dense depth from one camera: a filter per pixel of a keyframe, fed by the frames that follow it."""

    enabled: bool = False  # where the front end has one camera
    scale: float = 0.5  # of the images; the time goes with its square
    measure: Literal["sad", "ssd", "ncc", "zsad", "zssd", "zncc"] = "zncc"  # those with z do not mind exposure
    fusion: Literal["gaussian", "beta"] = "beta"  # gaussian: the slambook's; beta knows a share of false matches
    step_px: float = 0.7  # along the epipolar line; patches of 7 px change little over that
    reach_px: float = 100.0  # searched to both sides of where a pixel is expected; bounds its time
    search_sigmas: float = 3.0  # of inverse depth, to both sides
    least_score: float | None = None  # of a match; None: the measure's own, see mapping/monodepth/matching.py
    uniqueness: float = 0.8  # most that the best match's cost may be of the next one's; 1 asks for nothing
    sigma_px: float = 1.0  # of a match along the epipolar line
    min_gradient: float = 2.0  # grey levels per px, rms over the patch along the epipolar line; noise gives less
    max_sigma_ratio: float = 4.0  # of a measurement over what is known; beyond, it is not worth a search
    converged: float = 0.02  # sigma of inverse depth over its mean; on TUM fr1_desk 0.01 finds a quarter less
    min_matches: int = 3
    max_misses: int = 6  # more than matches by so many: hidden, moving or too alike, and not searched any more
    min_good: float = 0.6  # share of good measurements (REMODE); half of it, and the pixel has failed
    min_depth_m: float = 0.3  # nearer, frames share too little
    max_depth_m: float = 20.0
    derotate_deg: float = 1.5  # patches that are turned by more match worse than ones interpolated twice
    handover_sigma: float = 0.05  # of inverse depth that the next keyframe takes over; it measures anew
    smoothing: int = 10  # steps of smoothing inside surfaces; 0: none
    frames_per_keyframe: int = 6  # used between two keyframes, the newer one included; bounds the time
    keyframes: int = 3  # later ones that feed a keyframe before the next is begun; more parallax, fewer depth images
    min_overlap: float = 0.5  # of the image that later ones must still see; less, and the next is begun at once
    max_range_m: float = 8.0  # farther points only clear the way
    threads: int = 2  # the result does not depend on it


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Clouds, the occupancy octree, the navigation grid and the mesh."""

    enabled: bool = True
    resolution_m: float = 0.05  # octree voxel and grid cell; fine enough for table edges, 8 ms per keyframe
    insertion: Literal["discretised", "full"] = "discretised"  # one ray per end voxel; full: one per pixel, 10x dearer
    hit_probability: float = 0.7  # OctoMap's
    miss_probability: float = 0.32  # OctoMap's 0.4 is for 10 scans a second; of keyframes, at 2 Hz and more, with the
    clamp_max_probability: float = 0.9  # clamping here, three clear a voxel: a person who left is gone within 1 s
    clamp_min_probability: float = 0.1192  # OctoMap's: what was free for long is occupied after three scans
    min_range_m: float = 0.3  # nearer, structured-light depth and stereo matching are not valid
    max_range_m: float = 4.0  # depth noise grows with the square; farther points only clear the way to here
    pixel_step: int = 2  # keep every n-th row and column of a depth image; at 4 m still 3 pixels per voxel
    edge_ratio: float = 0.03  # a step to a neighbour pixel of more than this share of depth is an object's border
    edge_px: int = 2  # pixels left out on both sides of such a border, where sensors mix near and far
    speckle_pixels: int = 40  # smaller connected surfaces, in kept pixels, are noise
    stereo_scale: float = 0.5  # image scale for dense stereo; 15 to 30 ms per keyframe, at 1.0 five times that
    stereo_disparity_sigma_px: float = 0.2  # of semi-global matching at that scale
    stereo_max_range_m: float = 10.0  # as max_range_m, for dense stereo
    stereo_max_sigma_m: float = 0.25  # farther stereo points, with a larger error of depth, only clear the way
    move_voxels: float = 1.0  # a keyframe corrected by more than this many voxels is integrated again
    move_deg: float = 1.0  # or turned by more than this: 7 cm at 4 m
    rebuild_keyframes_per_call: int = 8  # that cast rays again in one call while a correction is followed; 3 ms each
    cloud_voxel_m: float = 0.015  # one averaged point per voxel in cloud.ply
    cloud_max_points: int = 1_500_000  # a larger cloud gets larger voxels: 22 MB
    cloud_min_points: int = 4  # depth pixels that must lie in an octree voxel for its points to stay in the cloud
    cloud_neighbours: int = 12  # statistical outlier removal: mean distance to so many neighbours
    cloud_outlier_sigma: float = 2.5  # may exceed the average by so many standard deviations
    grid_floor_m: float | None = None  # height of the floor in map; None: the lowest large horizontal surface
    grid_low_m: float = 0.10  # above the floor: lower things are driven over or are the floor's own noise
    grid_high_m: float = 1.60  # above the floor: higher things are driven under
    drive: DriveConfig = field(default_factory=DriveConfig)
    mesh_voxel_m: float = 0.02  # about the noise of depth at 3 m
    mesh_min_views: int = 2  # keyframes that must have seen a surface; with depth from one camera one is enough
    surfel_m: float = 0.02  # between surfels
    surfel_min_views: int = 2  # keyframes that must have seen a surfel; what one alone saw may be noise
    poisson_depth: int = 9  # levels of Poisson's octree: cells of 2 cm in a room of 10 m
    # what is written into map/; mesh, glb, obj and poisson need Open3D and take seconds, surfels too
    products: tuple[MapProduct, ...] = ("cloud", "octomap", "grid", "drive")
    mono_depth: MonoDepthConfig = field(default_factory=MonoDepthConfig)


@dataclass(frozen=True, slots=True)
class LiveConfig:
    """Live sensors: processes, and the pose that they publish for control."""

    name: str = "vislam-pose"  # of the shared memory, /dev/shm/NAME, and of the socket NAME.sock
    send_to: tuple[str, ...] = ("unix",)  # a datagram per sample to: unix[:PATH], udp:HOST:PORT
    allow_remote: bool = False  # let send_to, mavlink and ROS 2 reach other machines
    ros2_domain: int | None = None  # /odom and /tf over DDS, in this domain; needs cyclonedds
    mavlink: str | None = None  # udp:HOST:PORT that gets ODOMETRY; needs pymavlink
    bridge_rate_hz: float = 50.0  # of both at most: what autopilots want; control near by takes the datagrams
    base_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # what a controller steers, in body axes
    vision_timeout_s: float = 0.3  # without a correction for so long it is dead reckoning; a lost frame says so at once
    drift_sigma_m: float = 0.3  # position sigma gained since vision was lost, above which the pose is invalid
    velocity_sigma_m_s: float = 0.5  # above which it is invalid
    imu_timeout_s: float = 0.1  # without a sample for so long the pose is old: invalid
    heartbeat_s: float = 0.05  # between poses while there are no samples, so that a reader sees why
    event_s: float = 0.5  # so long a passing sensor event stays in the health word
    rest_speed_m_s: float = 0.1  # without vision, still inertial data mean rest only below this speed and its sigma
    keyframe_queue: int = 8  # keyframes that may wait for the back end; when half of that wait, fewer are made
    crowded_spacing: float = 2.0  # factor on the distances between keyframes then
    realtime_priority: int = 0  # 1 to 99: SCHED_FIFO for the fast process, where the system permits; 0: as others


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """The Rerun recording of a run."""

    enabled: bool = True
    every_frames: int = 2  # images are logged for one frame in so many: halves the cost, and nobody sees it
    image_width_px: int = 320  # a JPEG of this width costs 1.5 ms and 9 kB; VGA costs three times that
    jpeg_quality: int = 75
    cloud_points: int = 4000  # per keyframe, from depth; sparse features are all kept
    max_range_m: float = 8.0  # farther depth is noise that hides the scene
    map_every_s: float = 5.0  # octree and grid are written again so often at most
    map_voxels: int = 20_000  # at most in each, larger maps get coarser ones; 16 bytes each


Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
Axes = tuple[Axis, Axis, Axis]
Vector3 = tuple[float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]

_IDENTITY: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """From the axes of chips to the calibrated body frame (x forward, y left, z up): axes first, then the rest.

    `calibrated = matrix @ (turned - bias)`, where `turned` is in body axes; zero and identity are an ideal chip.
    """

    gyro_axes: Axes = ("x", "y", "z")  # axes of the chip that point along x, y, z of the body
    accel_axes: Axes = ("x", "y", "z")  # the three chips of a GY-85 are placed alike; check yours: docs/cart.md
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
    bus_timeout_s: float = 0.02  # of one transfer, in steps of 10 ms; the longest one takes 5 ms at 400 kHz
    rate_hz: float = 400.0  # of samples; 30 % of a 400 kHz bus. On a 100 kHz bus ask for 100
    gyro_bandwidth_hz: Literal[256, 188, 98, 42, 20, 10, 5] = 98  # below half the rate: the chip cannot be aliased
    gyro_delay_s: float | None = None  # of that filter, taken off the stamps; None: what its makers state
    accel_rate_hz: Literal[100, 200, 400, 800] = 400  # 1600 and more lose the last bit, less than 100 no self-test
    accel_range_g: Literal[2, 4, 8, 16] = 16  # full resolution has 3.9 mg in every range, so the widest costs nothing
    mag: bool = True  # look for a magnetometer
    mag_rate_hz: float = 50.0  # how often it is asked; it measures at 75 (clones: 100)
    mag_range_ga: float = 1.9  # or the next wider one that the chip has; the earth has 0.25 to 0.65, motors add
    self_test: bool = True  # at the start, 1 s, standing still; docs/cart.md says what is tested
    supply_v: float = 3.3  # of the accelerometer: its self-test limits grow with it
    reopen_s: float = 0.5  # between attempts to reach a chip or bus that went away; one costs up to 0.1 s
    nacks_to_reopen: int = 5  # in a row until a chip counts as gone: single ones are noise on the wire
    silent_s: float = 0.1  # without a sample, a chip is set up again, and the source says that it is missing
    stuck_samples: int = 100  # equal to the last bit in a row: noise makes this impossible, a hung chip does it
    max_temperature_change_c: float = 10.0  # since the biases were taken; an ITG3205 then drifts by up to 1 deg/s
    calibration: SensorCalibration = field(default_factory=SensorCalibration)


@dataclass(frozen=True, slots=True)
class PowerUpConfig:
    """Taking the current attitude as horizontal and the current rate as zero, when the power comes on."""

    window_s: float = 2.0  # of standing still; a gyro of 0.03 deg/s/sqrt(Hz) gives its bias to 0.02 deg/s
    max_gyro_std_rad_s: float = 0.02  # per axis; an ITG3205 at 98 Hz has 0.0065, a hand on the cart gives 0.03
    max_accel_std_m_s2: float = 0.25  # per axis; an ADXL345 at 400 Hz has 0.08
    max_rate_rad_s: float = 0.7  # mean; the ITG3205 may start with 40 deg/s, more is motion
    max_turn_rad_s: float = 0.005  # between the means of the window's halves: a bias stays, white noise leaves 0.0003
    max_bias_change_rad_s: float = 0.05  # from what was remembered for this temperature: an even turn looks like a bias
    gravity_tolerance_m_s2: float = 0.5  # of the measured norm: an accelerometer after calibration
    max_tilt_deg: float = 20.0  # of the body to gravity; more is a wrong axis, or no cart that stands on a floor
    remembered: int = 64  # biases kept, one per degree of temperature


@dataclass(frozen=True, slots=True)
class AttitudeConfig:
    """Complementary filter: attitude from gyro and accelerometer alone, the baseline without vision."""

    proportional_gain: float = 0.1  # 1/s: leans on the accelerometer over 10 s; half of it and ten times it are worse
    integral_gain: float = 0.001  # 1/s^2: learns what bias is left after power-up within minutes
    gate_m_s2: float = 0.15  # |force| further from gravity is motion, not tilt
    level_cutoff_hz: float = 5.0  # low-pass on the force that levels, so that vibration does not close the gate
    mag_gain: float = 0.05  # 1/s, of the yaw by the magnetometer
    mag_gate: float = 0.1  # relative change of the field's norm, and of its vertical part: iron or a motor is near


@dataclass(frozen=True, slots=True)
class BridgeClockConfig:
    """The line that turns the serial bridge's clock into the host's."""

    window_s: float = 20.0  # of arrivals that the line is laid under; 0.1 ms of jitter then costs 5 ppm of rate
    bin_s: float = 0.1  # the least delayed arrival of each counts; the line is laid anew so often
    settle_s: float = 0.5  # no sample is passed before the rate has been seen for so long
    max_drift: float = 0.025  # of the rate; a ceramic resonator, as on an Arduino Nano, is off by up to 0.5 %
    step_s: float = 0.1  # before its time by so much is no jitter: the device restarted or the host slept
    late_s: float = 2.0  # everything late by step_s for so long: the device's clock lost time
    max_slew: float = 0.05  # share of an interval by which a better line may stretch it: 5 ms are caught up in 0.1 s


@dataclass(frozen=True, slots=True)
class SerialConfig:
    """The serial bridge: a microcontroller that reads the inertial chips, docs/cart.md."""

    port: str = "/dev/ttyUSB0"  # the path in /dev/serial/by-id stays the same when other devices come and go
    baud: int = 500_000  # exact on a 16 MHz AVR, which misses 230400 by 3.5 %; 400 Hz take a quarter of it
    chips_s: float = 0.0005  # from a sample's time to its first byte: reading two chips at 400 kHz
    filter_s: float = 0.0033  # delay of the gyro's 98 Hz filter, and half a millisecond of its sampling
    mag_delay_s: float = 0.0067  # half a period of 75 Hz
    missing_s: float = 0.1  # without a sample for so long, the IMU is missing: 40 samples at 400 Hz
    start_s: float = 4.0  # an Uno's boot loader runs 2 s after the port is opened; later without a sample, open it anew
    reopen_s: float = 0.5  # between attempts to open a port that is not there
    stuck_s: float = 0.25  # counts of a chip that do not change for so long: even at rest they have noise
    calibrated_at_c: float | None = None  # temperature of the gyro when its biases were taken
    max_temperature_change_c: float = 10.0  # from it; an ITG3205 then drifts by up to 1 deg/s
    clock: BridgeClockConfig = field(default_factory=BridgeClockConfig)
    calibration: SensorCalibration = field(default_factory=SensorCalibration)


@dataclass(frozen=True, slots=True)
class WebcamConfig:
    """A webcam on V4L2; docs/cart.md. What a camera does not do as asked is reported, not hidden."""

    device: str = "0"  # index, or a path below /dev/v4l/by-id, which stays the same when other cameras come and go
    width_px: int = 640  # enough for 400 tracks; 1280 costs four times the work of the front end
    height_px: int = 480
    rate_hz: float = 30.0
    fourcc: str = "MJPG"  # uncompressed video of more than 640x480 at 30 Hz does not fit through USB 2
    exposure_s: float | None = 0.01  # 1 m/s at 1 m blurs by 5 px; None leaves it to the camera, and lights flicker then
    gain: float | None = None  # in units of the camera; None leaves it as it is
    focus: float | None = 0.0  # in units of the camera, 0 is infinity; None leaves autofocus on, which moves the centre
    white_balance_k: float | None = None  # None leaves it to the camera: tracking uses grey images
    buffers: int = 2  # of the driver; with one, it has nowhere to put the next image while one is decoded
    delay_s: float = 0.05  # from capture to arrival, where the driver's stamps cannot be used: exposure, readout, USB
    max_age_s: float = 1.0  # of a stamp at arrival; older, it is from another clock
    missing_s: float = 0.5  # without an image for so long the camera is missing: 15 images at 30 Hz
    start_s: float = 5.0  # until the first image; some cameras take 2 s
    reopen_s: float = 1.0  # between attempts to open a camera that is not there


@dataclass(frozen=True, slots=True)
class SensorsConfig:
    """The sensors of a cart, for `vislam record`; a TOML file with these sections describes one cart."""

    gy85: Gy85Config = field(default_factory=Gy85Config)
    serial: SerialConfig = field(default_factory=SerialConfig)
    webcam: WebcamConfig = field(default_factory=WebcamConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    gyro_noise_density: float = 5.2e-4  # rad/s/sqrt(Hz) without a noise file: the ITG3205's data sheet
    accel_noise_density: float = 6.0e-3  # m/s^2/sqrt(Hz): the ADXL345's data sheet, its worst axis
    gyro_bias_walk: float = 2e-5  # rad/s^2/sqrt(Hz), usual for such chips; no data sheet tells it
    accel_bias_walk: float = 2e-4  # m/s^3/sqrt(Hz), as well
    hfov_deg: float = 70.0  # horizontal field of view without a camera file; webcams have 60 to 80


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """Recording of live sensors to a disk that may be slow or full."""

    max_gb: float = 8.0  # the recording ends at this size; 640x480 JPEG at 30 Hz takes 9 an hour
    min_free_gb: float = 1.0  # and when the disk has less left: a full root disk stops the machine
    image_format: Literal["jpg", "png"] = "jpg"  # MJPG cameras give no more; png takes five times the space
    image_queue: int = 60  # images that may wait for the disk: 2 s, and 55 MB at 640x480
    imu_queue: int = 8000  # samples that may wait: 18 s at 450 Hz


@dataclass(frozen=True, slots=True)
class Config:
    """The whole configuration of a run."""

    seed: int = 0  # of every random choice in the pipeline
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    frontend: FrontEndConfig = field(default_factory=FrontEndConfig)
    init: InitConfig = field(default_factory=InitConfig)
    ekf: EkfConfig = field(default_factory=EkfConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    batch: BatchConfig = field(default_factory=BatchConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    map: MapConfig = field(default_factory=MapConfig)
    live: LiveConfig = field(default_factory=LiveConfig)
    view: ViewConfig = field(default_factory=ViewConfig)


def dump(config: Config) -> dict[str, Any]:
    """Return the configuration as plain nested data, ready for JSON."""
    return dataclasses.asdict(config)


def load(path: Path | None = None, overrides: dict[str, Any] | None = None) -> Config:
    """Build a configuration from defaults, a TOML file and dotted overrides such as `{"graph.coupling": "tight"}`.

    Raises UsageError naming the field, what was asked and what is allowed.
    """
    data = {} if path is None else _read_toml(path)
    for dotted, value in (overrides or {}).items():
        *sections, name = dotted.split(".")
        node = data
        for section in sections:
            node = node.setdefault(section, {})
        node[name] = value
    return from_data(data, source=str(path) if path else "overrides")


def load_sensors(path: Path | None = None) -> SensorsConfig:
    """Return the sensors of a cart as a TOML file describes them; raises UsageError as `load` does."""
    data = {} if path is None else _read_toml(path)
    _refuse_unknown(data, SensorsConfig, str(path))
    return validated(SensorsConfig, data, str(path))


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"config {path} cannot be read: {error}; see docs/config.md for an example") from error


def from_data(data: dict[str, Any], source: str) -> Config:
    """Build a configuration from plain nested data; unknown and ill-typed fields raise UsageError with `source`."""
    _refuse_unknown(data, Config, source)
    return validated(Config, data, source)


def validated(cls: type[Options], data: Mapping[str, Any], where: str) -> Options:
    """Build a dataclass from plain data; unknown and ill-typed fields raise UsageError that begins with `where`."""
    known = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for name in data:
        if name not in known:
            raise UsageError(f"{where}: no option '{name}'; there are: {', '.join(known)}")
    try:
        return TypeAdapter(cls).validate_python(data)
    except ValidationError as error:
        first = error.errors()[0]
        field_path = ".".join(str(part) for part in first["loc"])
        raise UsageError(f"{where}: option {field_path}: {first['msg']}, got {first['input']!r}") from error


def _refuse_unknown(data: dict[str, Any], cls: type, source: str, prefix: str = "") -> None:
    known = {f.name: f for f in dataclasses.fields(cls)}
    for name, value in data.items():
        if name not in known:
            raise UsageError(f"{source}: no setting '{prefix}{name}'; this section has: {', '.join(known)}")
        factory = known[name].default_factory
        if isinstance(value, dict) and isinstance(factory, type) and dataclasses.is_dataclass(factory):
            _refuse_unknown(value, factory, source, f"{prefix}{name}.")
