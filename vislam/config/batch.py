"""Defaults of batch optimisation, of runs and of pose-graph files."""

from dataclasses import dataclass
from typing import Literal

from vislam.config.ranges import Count, NonNegative, Positive, Probability, Share, Whole


@dataclass(frozen=True, slots=True)
class BatchConfig:
    """Batch optimisation of a finished run: visual-inertial bundle adjustment over all keyframes."""

    rounds: Count = 5  # of optimising, then judging tracks, loops, noise and readout anew; the last changes 3 % or less
    iterations: Count = 20  # most Levenberg-Marquardt steps of a round; converged earlier as a rule
    start_gate_px: NonNegative = 20.0  # first round: poses of the run may be off, only gross outliers leave
    start_cauchy: Positive = 3.0  # standard deviations, scale of the kernel in that round
    huber_k: Positive = 2.0  # standard deviations, in later rounds
    gate_probability: Probability = 0.999  # chi-square of a pixel or depth that stays, in later rounds
    max_relative_sigma: Share = 0.25  # of a landmark's distance by its own rays; farther ones lack parallax or depth
    max_observations: Count = 400_000  # bounds memory (2 kB each in gtsam) and time; the longest tracks stay
    min_seen: Whole = 12  # landmarks; a keyframe that sees fewer also gets the odometry of the run
    vision_inflation: Positive = 2.0  # on sigmas against the IMU: errors of a track and of calibration go together
    pixel_sigma_min_px: NonNegative = 0.2  # bounds of the noise that residuals show, from frontend.track_sigma_px on
    pixel_sigma_max_px: NonNegative = 3.0
    loop_probability: Probability = 0.9999  # chi-square of a true loop in the judging of all of them
    # one camera: relative, on the steps of the run's own odometry among the loops
    unscaled_odometry_sigma: NonNegative = 0.1
    covariances: bool = True  # of all states; costs about as much as a round


@dataclass(frozen=True, slots=True)
class PoseGraphConfig:
    """Optimisation of a pose graph from a file."""

    start: Literal["auto", "file", "odometry", "tree", "chordal", "angles", "grown"] = (
        "auto"  # auto: the one of lowest cost
    )
    method: Literal["lm", "dogleg", "gtsam", "isam2"] = "lm"
    equations: Literal["auto", "cholesky", "gradients"] = "auto"  # conjugate gradients where a factor would be large
    # which edges that do not join successive ids may be rejected, by what; auto tries several, judges, and says why
    robust: Literal["none", "auto", "cauchy", "geman-mcclure", "dcs", "gnc"] = "none"
    rescale_noise: bool = False  # variances of each kind of edge multiplied by what its residuals show, solved anew
    iterations: Count = 100  # most of them; 3 to 8 as a rule
    tolerance: Positive = 1e-9  # of the cost: the decrease still to come at which to end
    inlier_probability: Probability = 0.999  # chi-square beyond which a loop is false; 1 of 1000 true ones goes with it
    certify: bool = True  # examine whether the optimum is the global one: takes two to five times as long as finding it
    covariances: bool = False  # write those of all poses: in space 300 bytes each
    # what an iSAM file in the plane states: square roots of information, or covariances; auto tells and says so
    isam_noise: Literal["auto", "root", "covariance"] = "auto"
    repair_information: bool = False  # take the nearest positive definite matrix for what is not; else it is refused


@dataclass(frozen=True, slots=True)
class GraphWorldConfig:
    """A made pose graph, as `vislam simulate --graph` writes it. Noise is white, of odometry and loops alike."""

    poses: Count = 1000
    loops_per_pose: NonNegative = 1.0  # true ones; only between poses that are at most 5 m apart
    rotation_sigma_deg: NonNegative = 1.0  # per axis; the drift of a thousand steps then needs its loops
    translation_sigma_m: NonNegative = 0.05  # per axis; 5 % of a step, poor odometry
    anisotropy: Positive = 1.0  # forward, and about z, the sigmas are this many times as large
    outlier_fraction: Share = 0.0  # of all loops
    alias_group: Count = 1  # so many false loops in a row agree, as a corridor that looks like another one gives them
    seed: Whole = 0  # same seed, same graph
