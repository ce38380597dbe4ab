"""Defaults of batch optimisation, of runs and of pose-graph files."""

from dataclasses import dataclass
from typing import Annotated, Literal

from vislam.config.ranges import Count, Many, NonNegative, Positive, Probability, Range, Seed, Share


@dataclass(frozen=True, slots=True)
class BatchConfig:
    """Batch optimisation of a finished run: visual-inertial bundle adjustment over all keyframes."""

    rounds: Count = 5  # of optimising, then judging tracks, loops, noise, readout again; the last changes 3 % or less
    huber_k: Positive = 2.0  # standard deviations, in later rounds
    vision_inflation: Positive = 2.0  # on sigmas against the IMU: errors of a track and of calibration go together
    covariances: bool = True  # of all states; costs about as much as a round


@dataclass(frozen=True, slots=True)
class PoseGraphConfig:
    """Optimisation of a pose graph from a file."""

    start: Literal["auto", "file", "odometry", "tree", "chordal", "angles", "grown"] = (
        "auto"  # auto: the one of lowest cost; all of them where it ends above what noise allows
    )
    equations: Literal["auto", "cholesky", "gradients"] = "auto"  # conjugate gradients where a factor would be large
    # by which cost edges that do not join successive ids may be rejected; auto tries several and reports its choice
    robust: Literal["none", "auto", "cauchy", "geman-mcclure", "dcs", "gnc"] = "none"
    rescale_noise: bool = False  # variances of each kind of edge multiplied by what its residuals show, solved again
    iterations: Count = 100  # most of them; 3 to 8 as a rule
    tolerance: Annotated[float, Range(1e-15, 1.0)] = 1e-9  # of the cost: the decrease still to come at which to end
    inlier_probability: Probability = 0.999  # chi-square beyond which a loop is false; 1 of 1000 true ones goes with it
    noise: bool = True  # report what residuals show of the stated noise: takes about as long as finding the optimum
    certify: bool = True  # examine whether the optimum is the global one: takes two to five times as long as finding it
    covariances: bool = False  # write those of all poses: in space 300 bytes each
    # what an iSAM file in the plane states: square roots of information, or covariances; auto finds and reports which
    isam_noise: Literal["auto", "root", "covariance"] = "auto"
    repair_information: bool = False  # take the nearest positive definite matrix for what is not; else it is refused


@dataclass(frozen=True, slots=True)
class GraphWorldConfig:
    """A made pose graph, as `vislam simulate --graph` writes it. Noise is white, of odometry and loops alike."""

    poses: Many = 1000
    loops_per_pose: NonNegative = 1.0  # true ones; only between poses that are at most 5 m apart
    rotation_sigma_deg: NonNegative = 1.0  # per axis; the drift of a thousand steps then needs its loops
    translation_sigma_m: NonNegative = 0.05  # per axis; 5 % of a step, poor odometry
    anisotropy: Positive = 1.0  # forward, and about z, the sigmas are this many times as large
    outlier_fraction: Share = 0.0  # of all loops
    alias_group: Count = 1  # successive false loops that agree, as from a corridor that looks like another one
    seed: Seed = 0  # same seed, same graph
