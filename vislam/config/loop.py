"""Defaults of loop closing and of how loops are judged."""

from dataclasses import dataclass
from typing import Literal

from vislam.config.ranges import Count, Few, Many, NonNegative, Positive, Seed, Share, Whole


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """Loop detection and verification."""

    enabled: bool = True  # off: odometry alone, which drifts
    min_inliers: Whole = 12  # of PnP; 5,735 pairs of different places gave at most 7
    min_inliers_direction: Whole = 25  # of the essential matrix; wrong matches reached 15 in 5,735 pairs
    # the fit's own covariance is several times too small (coarse octaves, depth bias, rolling shutter): with these
    # the mean squared error per degree of freedom is 1.1 on TUM fr1_desk, 0.3 on EuRoC MH_01 (motion capture), and 0.1
    # on simulated images, which are kinder than real ones
    covariance_inflation: Positive = 16.0  # of the fit's variance
    sigma_floor_m: NonNegative = 0.005
    sigma_floor_deg: NonNegative = 0.25
    max_verifications: Whole = 5  # per keyframe, 4 to 7 ms each: bounds its time; 4 and 6 give the same accuracy
    max_odometry: Whole = 3  # candidates per keyframe that the map's poses suggest
    odometry_skip_keyframes: Whole = 5  # the newest ones are tied by visual odometry already
    max_appearance: Whole = 2  # candidates per keyframe that look alike; more where the map suggests too few
    # matches that keep their distances, for views with depth to be alike; chance gives 3, rarely 4
    min_rigid: Whole = 5
    chance_matched_share: Share = 0.015  # of the features that chance matches; views without depth need clearly more
    tags: Literal["off", "16h5", "25h9", "36h10", "36h11"] = "36h11"  # AprilTag family
    tags_every: Count = 4  # keyframes, until a tag was seen: 3 to 5 ms each; then, or with a size, all are searched
    tag_size_m: NonNegative | None = None  # side of the black square; known, a tag alone gives a relative pose
    retrieved: Count = 10  # keyframes asked of the index and matched, 0.4 ms each
    island_gap: Whole = 3  # ids in one island differ by at most this
    appearance_skip_keyframes: Whole = 20  # the newest ones always look most alike
    appearance_skip_s: NonNegative = 5.0  # and so do those of the last seconds
    vocabulary: str | None = None  # file of `vislam vocabulary`; None: the one that comes along, then the run's own
    train: Literal["auto", "always", "never"] = "auto"  # on the run's own keyframes; auto: unless a file is given
    first_training: Whole = 20  # keyframes; trained on fewer, words find less than those that come along
    training_growth: Positive = 1.25  # keyframes, until trained again: words find less what they were not trained on
    min_training_lag: Whole = 2  # keyframes that come during a training, at least ...
    catch_up_keyframes: Whole = 8  # of those, indexed with each new one once it is done: 0.4 ms each
    training_descriptors: Many = 500_000  # at most: bounds a training, in the background, to 2 s
    vocabulary_branching: Few = 10  # children of a node
    vocabulary_depth: Few = 6  # levels at most; as many as leave each word five descriptors
    # with --map OLD and a depth camera: where no image finds the map, depth is asked about the pose carried on so far
    depth_in_map: bool = True
    depth_in_a_row: Count = 3  # keyframes whose answers agree through odometry, before one is offered: rooms repeat
    depth_worth_m: NonNegative = 0.03  # of that pose, one sigma: known better, depth adds little to it ...
    depth_worth_deg: NonNegative = 1.5  # ... nor to where it looks: an answer is good to 1 cm and 0.6 deg
    start_in_map: str | None = None  # X,Y,Z,QX,QY,QZ,QW of the body in OLD's map at the begin, for depth: 0.3 m, 15 deg
    proposers: tuple[str, ...] = ()  # that packages bring, asked for candidates beside appearance, odometry and tags
    inject_share: Share = 0.0  # for experiments: share of false loops, made up, among those that the graph is offered
    inject_group: Count = 1  # how many of them agree among themselves, as from an object that is there twice


@dataclass(frozen=True, slots=True)
class LoopTruthConfig:
    """What counts as a true revisit, and as a wrong edge, when loops are compared with the truth."""

    min_overlap: Share = 0.3  # of two views by their true poses; ORB closes few loops below
    near_m: NonNegative = 1.0  # a keyframe that was proposed is truly near below this, ...
    near_deg: NonNegative = 40.0  # ... turned by less than this, and where the views overlap by min_overlap
    min_apart_s: NonNegative = 10.0  # a pair is a loop when it is this far apart in time ...
    min_apart_keyframes: Whole = 30  # ... or by this number of keyframes; nearer pairs are tied by odometry anyway
    gross_m: NonNegative = 0.5  # an edge whose translation is off by more would ruin a map
    gross_deg: NonNegative = 10.0  # or whose rotation is
    max_truth_gap_s: NonNegative = 0.3  # true poses are interpolated over less: a few millimetres by hand or on wheels
    seed: Seed = 0  # of the bootstrap
