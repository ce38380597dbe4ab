"""Defaults of the filter, the window and the pose graph."""

from dataclasses import dataclass
from typing import Literal

from vislam.config.ranges import Count, NonNegative, Positive, Probability, Share, Whole


@dataclass(frozen=True, slots=True)
class EkfConfig:
    """The fast path."""

    # loose: motions of visual odometry; tight: the tracks themselves (MSCKF), ten times the time; auto: tight for one
    # camera, whose motions lack scale, loose with stereo or depth
    coupling: Literal["auto", "loose", "tight"] = "auto"
    # accumulated: vision's own sum of motions, taken as a pose; none: inertial data alone from the first state on, for
    # comparison
    vision: Literal["relative", "accumulated", "none"] = "relative"
    odom: Literal["continuous", "corrected"] = "continuous"  # corrected: 3-30 % less error, 5 cm steps at a first turn
    history_s: Positive = 5.0  # how late a measurement may come; vision latency is under 0.3 s, a stalled reader longer
    checkpoint_s: Positive = 0.05  # a rewind replays at most this much more than the delay, 4 kB each
    # what the rate may have been inside a hole longer than machine.max_gap_s, against its interpolation
    gap_gyro_rad_s: NonNegative = 0.5
    gap_accel_m_s2: NonNegative = 2.0  # the same for specific force
    # on sigmas of vision's motion, which miss model errors; over a floor frontend.planar's
    vo_inflation: Positive = 1.5
    vo_shared_fraction: Share = 0.5  # of its variance that all motions relative to one keyframe share (its landmarks)
    # relative, of all metres of vision together: a baseline; over a floor its height joins it
    scale_sigma: NonNegative = 0.0
    # fixed R of accumulated vision; 0.005 to 0.1 err alike, below this motions fail
    accumulated_sigma_m: NonNegative = 0.02
    accumulated_sigma_deg: NonNegative = 0.5  # the gate, for the sum has drifted by more than R says
    gate_probability: Probability = 0.999  # chi-square gate on every innovation
    reset_rejects: Whole = 5  # this many rejections in a row ...
    reset_s: NonNegative = 1.0  # ... over this long mean that the filter is wrong, not vision: P is inflated, counted
    # what such a soft reset adds to the sigmas of the state; the state itself stays
    reset_rotation_deg: NonNegative = 3.0
    reset_position_m: NonNegative = 0.3
    reset_velocity_m_s: NonNegative = 1.0
    reset_gyro_bias_rad_s: NonNegative = 0.02
    reset_accel_bias_m_s2: NonNegative = 0.2
    zero_velocity_sigma_m_s: NonNegative = 0.02  # a vehicle "at rest" still sways
    zero_rate_sigma_rad_s: NonNegative = 0.005  # one gyro sample at rest against the bias
    rest_sigma_m: NonNegative = 0.002  # sway against the pose at which rest began
    rest_sigma_deg: NonNegative = 0.05
    vision_delay_s: NonNegative = 0.0  # for experiments: vision reaches the filter so much later than it was seen
    # without vision, a way known no better ties nothing: a new submap begins
    submap_sigma_m: NonNegative = 5.0
    graph_feedback: bool = False  # take biases from the graph; off, the filter alone is the honest baseline

    tight_clones: Count = 11  # past poses that tracks tie together; half a second at 20 Hz
    tight_points: Whole = 25  # long tracks kept as points of the state; they stop the drift while little moves
    tight_point_depth_ratio: NonNegative = 0.1  # sigma of its distance over it that such a point may have at first
    # on the pixel sigma of such points: real corners err alike in frame after frame; and even with white noise at 1 the
    # filter is too sure of itself (100 runs: NEES of position 4.6 of 3; at 3 it is 2.7)
    tight_point_inflation: Positive = 3.0
    tight_point_misses: Whole = 1  # frames in a row that may not see such a point before it is dropped
    tight_max_tracks: Count = 60  # used per frame; bounds its time
    tight_iterations: Count = 5  # of one update at most; more than one only while velocity is badly known
    tight_min_observations: Whole = 3  # of a track; two leave one equation
    # of a corner followed over many frames; more where tracks scatter by over 0.4 px
    tight_pixel_sigma_px: Positive = 1.0
    tight_stereo_sigma_px: Positive = 0.5  # right minus left pixel: matching, without the error of the corner
    tight_depth_sigma_rho: Positive = 3e-3  # 1/m, of the inverse of a depth image
    tight_outlier_sigmas: NonNegative = 5.0  # one observation of a track; the test of the track follows
    # sigma over inverse depth; above, a point's place is no base to linearise at
    tight_max_depth_ratio: NonNegative = 0.3
    tight_min_range_m: NonNegative = 0.1
    tight_max_range_m: NonNegative = 200.0  # beyond, nothing but rotation is seen
    # image motion between clones below which the older one is kept instead of the newer
    tight_still_px: NonNegative = 1.0
    # between clones; a fast camera would leave a window too short for parallax
    tight_min_interval_s: NonNegative = 0.03
    tight_time_offset: bool = True  # estimate what is to be added to the stamps of frames
    tight_time_offset_sigma_s: NonNegative = 0.01  # prior; USB cameras are stamped up to 30 ms late
    tight_extrinsic_rotation: bool = True  # refine the camera's rotation in the body
    tight_extrinsic_sigma_deg: NonNegative = 0.5  # prior; a calibration 1 deg off is two sigmas
    # rolling shutter, first to last row; None: frontend.readout_s, else global
    tight_readout_s: NonNegative | None = None
    tight_history_s: Positive = 2.0  # how late a measurement may come; a state is 100 to 250 kB, one per frame


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """The sliding window of tight coupling: poses, velocities, biases and landmarks of the newest keyframes."""

    keyframes: Count = 15  # states in the window; the oldest one is marginalised when another comes
    iterations: Count = 6  # most Gauss-Newton steps per keyframe; two or three are usual
    tolerance: Positive = 5e-3  # relative decrease of the cost that ends them; 1e-3 costs a step more and gains nothing
    # of a tracked corner between keyframes; more where the frame's tracks scatter by over 0.4 px
    sigma_px: Positive = 1.0
    right_sigma_px: Positive = 1.0  # of the match in the right image
    depth_sigma_rho: Positive = 4e-3  # 1/m: sigma of 1/z of a depth image; a Kinect's own is 1.4e-3, then registration
    huber_k: Positive = 2.0  # of a reprojection error, in standard deviations
    gate_probability: Probability = 0.999  # chi-square of an observation; above it after optimisation, it is taken out
    gate_track_fraction: Share = 0.34  # of a track's observations beyond the gate: the whole track goes
    rho_sigma_1_m: Positive = 10.0  # prior of inverse depth: only keeps points without parallax from running away
    split_min: Whole = 3  # observations a track gives to the marginal prior at once; the rest starts a new landmark

    reintegrate_gyro_rad_s: NonNegative = 0.005  # bias change after which first-order correction is not enough
    reintegrate_accel_m_s2: NonNegative = 0.05

    gauge_sigma_m: NonNegative = 1e-3  # first position and yaw are a free choice: fixed far below what is measured
    gauge_sigma_rad: NonNegative = 1e-3
    restart_sigma_m: NonNegative = 0.1  # of the state a window restarts from after a failed solution
    restart_sigma_rad: NonNegative = 0.03
    restart_speed_sigma_m_s: NonNegative = 0.3
    restart_gyro_bias_sigma_rad_s: NonNegative = 0.01
    restart_accel_bias_sigma_m_s2: NonNegative = 0.1

    estimate_time_offset: bool = True  # of the camera against the IMU
    time_offset_sigma_s: NonNegative = 0.02  # prior; cheap cameras stamp up to 30 ms late
    estimate_rotation: bool = True  # of the camera on the body
    rotation_sigma_deg: NonNegative = 0.5  # prior; a calibration by Kalibr is good to 0.1, a printed mount to 1
    estimate_readout: bool = False  # of a rolling shutter; needs brisk rotation
    readout_s: NonNegative | None = None  # rolling shutter, first to last row; None: frontend.readout_s, else global
    readout_sigma_s: NonNegative = 0.01  # prior, when it is estimated


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """The iSAM2 pose graph: sigmas of its factors, the gate for loops, and how much work an update may do."""

    coupling: Literal["loose", "tight"] = "tight"  # loose: motions of visual odometry; tight: tracks, in a window
    # IMU factors are stiff: 0.01 left 5-13 mm against the exact optimum, this 1.4
    relinearize_rotation_rad: NonNegative = 0.002
    relinearize_translation_m: NonNegative = 0.005  # what a voxel map can see
    relinearize_velocity_m_s: NonNegative = 0.01
    # rad/s and m/s^2; preintegration's first-order correction is exact to far more
    relinearize_bias: NonNegative = 0.001
    relinearize_skip: Count = 5  # updates between relinearisations; 1 costs 3x the time for the same trajectory
    loop_iterations: Whole = 3  # extra Gauss-Newton steps after a loop is accepted; bounds the work of an update
    read_newest: Count = 300  # poses that each keyframe reads back from the solver; up to this many plus a block: all
    read_block: Count = 200  # older poses that each keyframe reads back in turn, so that its work does not grow
    finish_iterations: Count = 10  # most steps of the final convergence before batch has its try
    moved_m: NonNegative = 0.001  # poses that moved less are not published again
    moved_deg: NonNegative = 0.05

    gauge_sigma_m: NonNegative = 1e-3  # first position and yaw are a free choice: fixed far below what is measured
    gauge_sigma_rad: NonNegative = 1e-3
    tilt_sigma_max_deg: NonNegative = 5.0  # first roll and pitch follow the initialisation, within these bounds
    tilt_sigma_min_deg: NonNegative = 0.05
    # rad/s; bounds of the first bias prior, so that pivots stay within what gtsam takes
    gyro_bias_sigma_max: NonNegative = 0.05
    accel_bias_sigma_max: NonNegative = 0.5  # m/s^2
    # rad/s^2/sqrt(Hz); gtsam 4.3.0 throws when prior sigma / step sigma > 4096
    gyro_bias_walk_floor: NonNegative = 2e-5
    accel_bias_walk_floor: NonNegative = 3e-4  # m/s^3/sqrt(Hz)
    covariance_ratio_max: Positive = 1e6  # eigenvalue ratio of any factor; gtsam 4.3.0 throws above 1e7

    vo_inflation: Positive = 4.0  # mono, on sigma: against truth, motions err 4 to 8 times what residuals say
    vo_degraded_inflation: Positive = 3.0  # further, when the front end says degraded
    vo_floor_deg: NonNegative = 0.05  # no camera and calibration is better than this between keyframes
    vo_floor_m: NonNegative = 0.001
    direction_floor_deg: NonNegative = 0.2  # mono: direction of motion
    direction_soft_m: NonNegative = 0.005  # mono: baselines shorter than this lose their say on direction
    # mono: relative, on the expected step; wide, for only the IMU knows the scale
    direction_scale_sigma: NonNegative = 5.0
    scale_sigma: NonNegative = 0.0  # as in `ekf`; tells how sure the states are and moves nothing
    # on sigma of a window's edges; consecutive ones share errors, here they are summed
    window_inflation: Positive = 2.0
    window_floor_deg: NonNegative = 0.01  # no calibration lets a window know more
    window_floor_m: NonNegative = 0.0005
    # a provisional edge that moved by more of its sigma is replaced at once ...
    window_refresh_sigma: NonNegative = 0.3
    window_refresh_max: Whole = 3  # ... up to so many per keyframe, those that moved most
    gravity_every: Count = 10  # keyframes between tilt factors; errors of nearer ones are the same accelerometer bias
    edges_share_scale: bool = False  # of a window: set by the run, for one camera whose scale is the IMU's
    tilt_floor_deg: NonNegative = 0.1  # an accelerometer's scale and misalignment, which the window does not estimate
    huber_k: Positive = 3.5  # whitened norm; the 95 % point of 6 degrees of freedom
    imu_integration_sigma: NonNegative = 1e-4  # m/sqrt(s), what sampling at finite rate leaves

    loop_gate_probability: Probability = 0.999  # chi-square of a loop against the joint covariance of its two keyframes
    loop_cauchy_k: Positive = 2.0  # whitened norm
    loop_floor_m: NonNegative = 0.005
    loop_floor_deg: NonNegative = 0.2
    loop_min_weight: Share = 0.05  # a loop that optimisation leaves with less is taken out again
    loop_batch_m: NonNegative = 1.0  # a larger correction starts from a batch solution instead of incremental steps
    loop_batch_deg: NonNegative = 10.0
    pending_max: Whole = 200  # pending loops kept; the oldest leave first
    consistency_max_sigma_m: NonNegative = 0.5  # odometry looser than this between two loops proves nothing
    witness_keyframes: Whole = 10  # loops that start and end so near to another's, or ...
    witness_m: NonNegative = 1.0  # ... whose ends lie so near to its ends ...
    witness_deg: NonNegative = 45.0  # ... looking the same way, see the same things: together they are one witness
    # on odometry sigma, for whether two loops of one witness say the same; 3 mixed them
    witness_inflation: Positive = 1.5
    review_loops: Whole = 20  # loops after which all are weighed anew, if any was kept out; ...
    review_doubts: Whole = 3  # ... or so many that were kept out
    review_steps: Whole = 4  # of a review's work per keyframe: joint marginals of a small graph, 1 to 3 ms each
    # nats that a keyframe's loops must tell the graph to get factors, where loops are many
    loop_gain_min: NonNegative = 0.5
    # loops in the graph are many; then a loop to a keyframe that is tied to an older one, or ...
    anchor_after: Whole = 20
    # ... is so many keyframes from one that is, ties to that older one, the place's anchor ...
    anchor_reach: Whole = 10
    anchor_variance_max: NonNegative = 4.0  # ... if the way there adds at most so many times the loop's own variance
    freeze_keyframes: Count = 40  # where loops are many, so many keyframes leave the solver together, once they are ...
    freeze_after: Whole = 200  # ... so many keyframes old, and stand from then on beside one that it keeps
    vo_scale_max: Positive = 10.0  # most that loops may inflate the sigma of visual odometry, over a run

    # the link to a keyframe with which a new submap begins: nothing is known, but equations stay solvable.
    # 100 times weaker than a loop, no more than 4096 times weaker than an edge, beyond which gtsam 4.3.0 throws
    submap_sigma_m: NonNegative = 2.0
    submap_sigma_deg: NonNegative = 30.0
    submap_tilt_sigma_deg: NonNegative = 5.0  # roll and pitch, where gravity is known on both sides
    submap_speed_sigma_m_s: NonNegative = 3.0  # of the first velocity in a submap, with loose coupling
    # new frames whose loops must agree through odometry to join two submaps: one image can deceive
    join_frames: Count = 2
    join_waiting: Whole = 20  # newest loops between submaps that are compared for that; bounds the work
    join_max_contradicting: Share = 0.25  # of the loops between two submaps; more, and they wait for further ones


@dataclass(frozen=True, slots=True)
class PublishConfig:
    """How corrections reach the pose that is published: with the motion of the body, not as jumps."""

    enabled: bool = True  # off: corrections are published as they come
    way_share: Share = 0.4  # of the way that the body makes: a correction looks like odometry that errs by so much
    way_m: Positive = 1.0  # the way over which a correction fades by e, where that is faster
    reach_m: NonNegative = 0.3  # how far a turn counts as way: the length of an arm, or of a cart
    fade_s: Positive = 0.1  # a correction fades no faster: news of single frames contradict each other
    creep_m_s: NonNegative = 0.01  # most at rest: half a millimetre from frame to frame
    creep_s: Positive = 10.0  # and at rest a correction fades in so long
    # a correction of orientation fades in so long, 1 deg by 0.03 deg/s: what good gyroscopes err ...
    turn_s: Positive = 30.0
    gyro_share: Share = 0.5  # ... or by so much of what the gyroscope itself may err, where that is faster
    turn_share: Share = 0.1  # ... or, where no gyroscope is, by so much of the turn that the body makes
    at_once_m: NonNegative = 1.0  # a larger correction is another belief about the place: it comes at once
    at_once_deg: NonNegative = 5.0
