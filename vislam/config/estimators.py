"""Defaults of the filter, the window and the pose graph."""

from dataclasses import dataclass
from typing import Literal

from vislam.config.ranges import Count, Few, NonNegative, Positive, Probability, Share, Whole


@dataclass(frozen=True, slots=True)
class EkfConfig:
    """The fast path."""

    # loose: motions of visual odometry; tight: the tracks themselves (MSCKF), ten times the time; auto: tight for one
    # camera, whose motions lack scale, and where there are cameras beyond the first pair, else loose
    coupling: Literal["auto", "loose", "tight"] = "auto"
    # accumulated: vision's own sum of motions, taken as a pose; none: inertial data alone from the first state on, for
    # comparison
    vision: Literal["relative", "accumulated", "none"] = "relative"
    odom: Literal["continuous", "corrected"] = "continuous"  # corrected: 3-30 % less error, 5 cm steps at a first turn
    history_s: Positive = 5.0  # how late a measurement may come; vision latency is under 0.3 s, a stalled reader longer
    # on sigmas of vision's motion, which miss model errors; over a floor frontend.planar's
    vo_inflation: Positive = 1.5
    vo_shared_fraction: Share = 0.5  # of its variance that all motions relative to one keyframe share (its landmarks)
    # relative, of all metres of vision together: a baseline; over a floor its height joins it
    scale_sigma: NonNegative = 0.0
    gate_probability: Probability = 0.999  # chi-square gate on every innovation
    vision_delay_s: NonNegative = 0.0  # for experiments: vision reaches the filter so much later than it was seen
    # without vision, a way known no better ties nothing: a new submap begins
    submap_sigma_m: NonNegative = 5.0
    graph_feedback: bool = False  # take biases from the graph; off, the filter alone is the honest baseline

    # on the pixel sigma of such points: real corners err alike in frame after frame; and even with white noise at 1 the
    # filter is too sure of itself (100 runs: NEES of position 4.6 of 3; at 3 it is 2.7)
    tight_point_inflation: Positive = 3.0
    tight_max_tracks: Count = 60  # used per frame; bounds its time
    # of a corner followed over many frames; more where tracks scatter by over 0.4 px
    tight_pixel_sigma_px: Positive = 1.0
    # priors; at 0 the stated value stays
    tight_time_offset_sigma_s: NonNegative = 0.01  # of what frames' stamps lack; USB cameras stamp up to 30 ms late
    tight_extrinsic_sigma_deg: NonNegative = 0.5  # of the camera's rotation; a calibration 1 deg off is two sigmas
    # rolling shutter, first to last row; None: frontend.readout_s, else global
    tight_readout_s: NonNegative | None = None
    tight_history_s: Positive = 2.0  # how late a measurement may come; a state is 100 to 250 kB, one per frame


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """The sliding window of tight coupling: poses, velocities, biases and landmarks of the newest keyframes."""

    keyframes: Few = 15  # states in the window; the oldest one is marginalised when another comes
    iterations: Count = 6  # most Gauss-Newton steps per keyframe; two or three are usual
    # of a tracked corner between keyframes; more where the frame's tracks scatter by over 0.4 px
    sigma_px: Positive = 1.0
    right_sigma_px: Positive = 1.0  # of the match in the right image
    depth_sigma_rho: Positive = 4e-3  # 1/m: sigma of 1/z of a depth image; a Kinect's own is 1.4e-3, then registration
    huber_k: Positive = 2.0  # of a reprojection error, in standard deviations
    rho_sigma_1_m: Positive = 10.0  # prior of inverse depth: only keeps points without parallax from running away

    # priors; at 0 the stated value stays
    time_offset_sigma_s: NonNegative = 0.02  # of the camera against the IMU; cheap cameras stamp up to 30 ms late
    rotation_sigma_deg: NonNegative = 0.5  # of the camera; a calibration by Kalibr is good to 0.1, a printed mount to 1
    readout_s: NonNegative | None = None  # rolling shutter, first to last row; None: frontend.readout_s, else global


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """The iSAM2 pose graph: sigmas of its factors, the gate for loops, and how much work an update may do."""

    coupling: Literal["loose", "tight"] = "tight"  # loose: motions of visual odometry; tight: tracks, in a window
    # IMU factors are stiff: 0.01 left 5-13 mm against the exact optimum, this 1.4
    relinearize_rotation_rad: NonNegative = 0.002
    relinearize_skip: Count = 5  # updates between relinearisations; 1 costs 3x the time for the same trajectory
    read_newest: Count = 300  # poses that each keyframe reads back from the solver; up to this many plus a block: all
    read_block: Count = 200  # older poses that each keyframe reads back in turn, so that its work does not grow

    covariance_ratio_max: Positive = 1e6  # eigenvalue ratio of any factor; gtsam 4.3.0 throws above 1e7

    vo_inflation: Positive = 2.0  # mono, on sigma: what residuals miss, as neighbours err alike
    vo_degraded_inflation: Positive = 3.0  # further, when the front end reports a degraded frame
    vo_floor_deg: NonNegative = 0.05  # no camera and calibration is better than this between keyframes
    vo_floor_m: NonNegative = 0.001
    scale_sigma: NonNegative = 0.0  # as in `ekf`; enters the covariances of states and moves nothing
    # on sigma of a window's edges; consecutive ones share errors, here they are summed
    window_inflation: Positive = 2.0
    window_floor_deg: NonNegative = 0.01  # no calibration lets a window know more
    window_floor_m: NonNegative = 0.0005
    # a provisional edge that moved by more of its sigma is replaced at once ...
    window_refresh_sigma: NonNegative = 0.3
    window_refresh_max: Whole = 3  # ... at most this number per keyframe, those that moved most
    gravity_every: Count = 10  # keyframes between tilt factors; errors of nearer ones are the same accelerometer bias
    edges_share_scale: bool = False  # of a window: set by the run, for one camera whose scale is the IMU's
    tilt_floor_deg: NonNegative = 0.1  # an accelerometer's misalignment, which the window does not estimate
    huber_k: Positive = 3.5  # whitened norm; the 95 % point of 6 degrees of freedom
    imu_integration_sigma: NonNegative = 1e-4  # m/sqrt(s), what sampling at finite rate leaves

    loop_gate_probability: Probability = 0.999  # chi-square of a loop against the joint covariance of its two keyframes
    loop_floor_m: NonNegative = 0.005
    loop_floor_deg: NonNegative = 0.2
    pending_max: Whole = 200  # pending loops kept; the oldest leave first
    # nats of information that a keyframe's loops must add to the graph to get factors, where loops are many
    loop_gain_min: NonNegative = 0.5
    # loops in the graph, from which on they are many: those of a keyframe are then tied to one anchor
    anchor_after: Whole = 20
    freeze_keyframes: Count = 40  # where loops are many, this number leave the solver together, once they are ...
    freeze_after: Whole = 200  # ... this number of keyframes old; they are then held relative to one that it keeps

    # the link to a keyframe with which a new submap begins: nothing is known, but equations stay solvable.
    # 100 times weaker than a loop, no more than 4096 times weaker than an edge, beyond which gtsam 4.3.0 throws
    submap_sigma_m: NonNegative = 2.0


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """How corrections reach the pose that is published: with the motion of the body, not as jumps."""

    enabled: bool = True  # off: corrections are published as they come
    way_share: Share = 0.4  # of the way that the body makes: a correction looks like odometry that errs by so much
    creep_m_s: NonNegative = 0.01  # most at rest: half a millimetre from frame to frame
    # a correction of orientation fades in so long, 1 deg by 0.03 deg/s: what good gyroscopes err ...
    turn_s: Positive = 30.0
    turn_share: Share = 0.1  # ... or, where no gyroscope is, by so much of the turn that the body makes
