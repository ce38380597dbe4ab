"""Bundle adjustment by gtsam: visual factors, Levenberg-Marquardt with landmarks first, marginal covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from vislam.batch.bundle.rays import Mask, Tracks
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.factors.keys import B, V, X
from vislam.factors.solvers import FAILURES

_LANDMARK = ord("l") << 56
_SIGMA_STEPS = 50  # per factor of e: noise models are shared between observations whose sigmas differ by under 2 %
_ITERATIONS = 20  # of a solution at most; converged earlier as a rule
_LAMBDA_MAX = 1e9
_RELATIVE_TOLERANCE = 1e-5  # 1e-6 took 60 % more steps on MH_01 for the same ATE to 0.05 mm


def L(j: int) -> int:
    """Return the key of landmark j."""
    return _LANDMARK | j


@dataclass(frozen=True, slots=True, eq=False)
class VisualNoise:
    """Noise of observations and the kernel over it."""

    sigma_px: float
    depth_factor: float  # on the sigmas of inverse depth
    kernel: gtsam.noiseModel.mEstimator.Base


def visual_factors(
    tracks: Tracks, keep: Mask, with_depth: Mask, T_body_cams: Sequence[Array], noise: VisualNoise
) -> list[gtsam.NonlinearFactor]:
    """Return a projection factor per kept observation, a virtual stereo pair of 1 m baseline where it has depth.

    Its right column is x - rho, so its disparity is the inverse depth, and its noise that of x plus that of rho.
    """
    mounts = [gtsam.Pose3(T) for T in T_body_cams]
    camera = tracks.image % max(len(mounts), 1)
    focal, disparity = tracks.focal, tracks.disparity
    K = gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0)
    K_stereo = gtsam.Cal3_S2Stereo(focal, focal, 0.0, 0.0, 0.0, disparity / focal)
    pixels, disparities = focal * tracks.xy, disparity * tracks.rho
    models: dict[tuple[int, int | None], gtsam.noiseModel.Base] = {}
    sigma = noise.sigma_px * tracks.sigma_per_px
    sigma_rho = noise.depth_factor * tracks.sigma_rho
    steps = np.round(_SIGMA_STEPS * np.log(sigma)).astype(int)
    depth_steps = np.round(_SIGMA_STEPS * np.log(np.where(with_depth, sigma_rho, 1.0))).astype(int)
    factors: list[gtsam.NonlinearFactor] = []
    for i in np.flatnonzero(keep).tolist():
        key = (int(steps[i]), int(depth_steps[i]) if with_depth[i] else None)
        if key not in models:
            models[key] = gtsam.noiseModel.Robust.Create(noise.kernel, _model(*key))
        (x, y), a, b, T = pixels[i], X(int(tracks.keyframe[i])), L(int(tracks.point[i])), mounts[camera[i]]
        if with_depth[i]:
            measured = gtsam.StereoPoint2(x, x - disparities[i], y)
            factors.append(gtsam.GenericStereoFactor3D(measured, models[key], a, b, K_stereo, False, False, T))
        else:
            factors.append(
                gtsam.GenericProjectionFactorCal3_S2(pixels[i], models[key], a, b, K, False, False, T)
            )  # fmt: skip
    return factors


def _model(step: int, depth_step: int | None) -> gtsam.noiseModel.Base:
    variance = float(np.exp(step / _SIGMA_STEPS)) ** 2
    if depth_step is None:
        return gtsam.noiseModel.Isotropic.Sigma(2, np.sqrt(variance))
    covariance = np.eye(3) * variance
    covariance[0, 1] = covariance[1, 0] = variance
    covariance[1, 1] += float(np.exp(depth_step / _SIGMA_STEPS)) ** 2
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What an optimisation ended with."""

    values: gtsam.Values
    cost_before: float
    cost_after: float
    iterations: int
    note: str  # how, when the usual way failed


def solve(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, states: list[int]) -> Solution:
    """Minimise by Levenberg-Marquardt, landmarks eliminated before `states`; by QR when Cholesky fails.

    Raises DataError when neither gives a finite solution.
    """
    before = float(graph.error(values))
    notes = []
    for solver in ("MULTIFRONTAL_CHOLESKY", "MULTIFRONTAL_QR"):
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(_ITERATIONS)
        params.setRelativeErrorTol(_RELATIVE_TOLERANCE)
        params.setlambdaUpperBound(_LAMBDA_MAX)
        params.setLinearSolverType(solver)
        params.setOrdering(gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, states, False))
        try:
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
            solved = optimizer.optimize()
            after = float(graph.error(solved))
        except FAILURES as error:
            lines = str(error).strip().splitlines() or [type(error).__name__]
            notes.append(f"{solver.rpartition('_')[2]} failed ({lines[0][:80]})")
            continue
        if np.isfinite(after) and after <= before:
            return Solution(solved, before, after, int(optimizer.iterations()), "; ".join(notes))
        notes.append(f"{solver.rpartition('_')[2]} went from cost {before:.6g} to {after:.6g}")
    raise DataError(f"the run cannot be optimised: {'; '.join(notes)}; its own trajectory stays as it is")


def marginals_at(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Marginals | None:
    """Return what marginal covariances come from; None where gtsam gives none."""
    try:
        return gtsam.Marginals(graph, values)
    except FAILURES:
        return None


def variances(marginals: gtsam.Marginals | None, keys: list[int]) -> Array | None:
    """Return the variances of variables of one number as a diagonal matrix; None where gtsam gives none."""
    if marginals is None:
        return None
    try:
        return np.diag([float(np.asarray(marginals.marginalCovariance(key))[0, 0]) for key in keys])
    except FAILURES:
        return None


def covariances(
    marginals: gtsam.Marginals | None, values: gtsam.Values, count: int, has_imu: bool
) -> NDArray[np.float64]:
    """Return the marginal covariances [K, 15, 15] in NavState's order and axes; NaN where gtsam gives none."""
    out = np.full((count, 15, 15), np.nan)
    if marginals is None:
        return out
    for k in range(count):
        R = values.atPose3(X(k)).rotation().matrix()
        keys = [X(k), V(k), B(k)] if has_imu else [X(k)]
        try:
            joint = np.asarray(marginals.jointMarginalCovariance(keys).fullMatrix())
        except FAILURES:
            continue
        turn = np.eye(len(joint))
        turn[3:6, 3:6] = R
        if has_imu:
            turn[9:, 9:] = np.roll(np.eye(6), 3, axis=1)
        out[k, : len(joint), : len(joint)] = turn @ joint @ turn.T
    return out
