"""The window's normal equations: residuals, Jacobians, elimination and solution, compiled.

Compiled by hand: 580 lines, and 130 of `window.gate`. Peer: gtsam's `IncrementalFixedLagSmoother`. With smart factors
it is faster: this takes 1.2 to 1.7 times as long; with landmarks as unknowns gtsam takes 1.1 to 1.4 times as long.
Errors of position are 0 to 13 % smaller than with smart factors (benchmarks/RESULTS.md). What the time is paid for:
calibration of cameras and IMU is estimated with the rest, states that the prior holds are linearised where it was, and
a bad system is a value, not an exception. To be dropped when gtsam's smart factors can do that.
"""

from vislam.window.equations.layout import AXES, CALIBRATION, STATE, Camera, Ints, Links, Normal, Prior, States, Views
from vislam.window.equations.marginal import Leaving, first_pose_prior, first_prior, marginalise, touched
from vislam.window.equations.projection import (
    CALIBRATED,
    COLUMNS,
    ERROR,
    POINT,
    SEEN,
    VIEWED,
    Hosted,
    Measured,
    Mount,
    Optics,
    Place,
    hosted,
    hosting,
    linearised,
    measured,
    mounted,
    optics,
    place,
    residual,
    shift,
    sight,
    through,
)
from vislam.window.equations.schur import invert
from vislam.window.equations.solver import Problem, Room, Solution, joint_covariance, optimise, trailing_covariance

__all__ = [
    "AXES",
    "CALIBRATED",
    "CALIBRATION",
    "COLUMNS",
    "ERROR",
    "POINT",
    "SEEN",
    "STATE",
    "VIEWED",
    "Camera",
    "Hosted",
    "Ints",
    "Leaving",
    "Links",
    "Measured",
    "Mount",
    "Normal",
    "Optics",
    "Place",
    "Prior",
    "Problem",
    "Room",
    "Solution",
    "States",
    "Views",
    "first_pose_prior",
    "first_prior",
    "hosted",
    "hosting",
    "invert",
    "joint_covariance",
    "linearised",
    "marginalise",
    "measured",
    "mounted",
    "optics",
    "optimise",
    "place",
    "residual",
    "shift",
    "sight",
    "through",
    "touched",
    "trailing_covariance",
]
