"""Monte-Carlo: the filter's covariance is what its errors are, also on real inertial data."""

from __future__ import annotations

import numpy as np
import pytest
from inertial_world import (
    EUROC_NOISE,
    GRAVITY_M_S2,
    T0_NS,
    Motion,
    RealMotion,
    SimulatedVision,
    state_error,
)
from scipy.stats import chi2

from vislam.config import EkfConfig
from vislam.ekf import Ekf
from vislam.geometry import align_points, so3_exp, transform, transform_points
from vislam.imu import ImuNoise
from vislam.messages import Array, NavState

CHEAP = ImuNoise(1e-3, 1e-2, 1e-4, 1e-3, 200.0)
SIGMAS = np.repeat([0.02, 0.001, 0.05, 0.02, 0.1], 3)
CAMERA = transform(so3_exp(np.array([0.3, -0.2, 0.1])), np.array([0.1, -0.05, 0.2]))
RUNS = 12


def one_run(seed: int, shared_truth: float, shared_model: float, camera: Array | None) -> tuple[float, float]:
    """Return mean NEES (15 degrees) and mean NIS per degree of one run of 12 s, vision 1 ms behind the samples."""
    rng, motion = np.random.default_rng(1000 + seed), Motion.random(seed)
    drawn = rng.normal(size=15) * SIGMAS
    samples, biases = motion.samples(12.0, 200.0, CHEAP, rng, -drawn[9:12], -drawn[12:15])
    stamps = [T0_NS + 50_000_000 * k + 1_000_000 for k in range(239)]
    vision = SimulatedVision(shared=shared_truth, T_body_camera=camera)
    motions = vision.motions([motion.pose((t - T0_NS) * 1e-9) for t in stamps], stamps, rng)
    T, v, *_ = motion.at(0.0)
    T = transform(T[:3, :3] @ so3_exp(drawn[:3]), T[:3, 3] + drawn[3:6])
    config = EkfConfig(imu_inflation=1.0, vo_inflation=1.0, vo_shared_fraction=shared_model)
    ekf = Ekf(config, CHEAP, GRAVITY_M_S2, camera)
    ekf.initialise(NavState(T0_NS, T, v + drawn[6:9], np.zeros(3), np.zeros(3), np.diag(SIGMAS**2)))
    nees, nis, i = [], [], 0
    for k, sample in enumerate(samples):
        ekf.predict(sample)
        while i < len(stamps) and sample.t_ns >= stamps[i]:
            if i > 0:
                nis.append(ekf.update_vo(motions[i]).nis / (6 if camera is None else 5))
            if i % vision.keyframe_every == 0:
                ekf.add_keyframe(i // vision.keyframe_every, stamps[i])
            i += 1
        if k >= 1000 and k % 200 == 0:
            T, v, *_ = motion.at(k / 200.0)
            error = state_error((T, v, biases[k]), ekf.state())
            nees.append(error @ np.linalg.solve(ekf.state().covariance, error))
    return float(np.mean(nees)), float(np.mean(nis))


def mean_over_runs(shared_truth: float, shared_model: float, camera: Array | None = None) -> tuple[float, float]:
    runs = np.array([one_run(seed, shared_truth, shared_model, camera) for seed in range(RUNS)])
    print(f"NEES {runs[:, 0].mean():.2f} of 15, NIS {runs[:, 1].mean():.2f} per degree, seeds 1000..{999 + RUNS}")
    return float(runs[:, 0].mean()), float(runs[:, 1].mean())


BAND = chi2.ppf([0.025, 0.975], 15 * RUNS) / RUNS  # of the mean NEES if the filter were exactly consistent


@pytest.mark.slow
@pytest.mark.parametrize("shared", [0.0, 0.5])
def test_metric_vision(shared: float) -> None:
    nees, nis = mean_over_runs(shared, shared)
    assert BAND[0] < nees < BAND[1]
    assert 0.85 < nis < 1.1


@pytest.mark.slow
def test_directions() -> None:
    nees, nis = mean_over_runs(0.5, 0.5, CAMERA)
    assert BAND[0] < nees < 1.2 * BAND[1]  # a direction is not linear in position
    assert 0.8 < nis < 1.1


@pytest.mark.slow
def test_taking_shared_errors_for_independent_ones_is_inconsistent() -> None:
    """Why the filter needs `vo_shared_fraction`: without it the same errors leave the band by far."""
    nees, _ = mean_over_runs(0.5, 0.0)
    assert nees > 1.3 * BAND[1]


@pytest.mark.data
@pytest.mark.parametrize(("name", "ate_m"), [("euroc_v101_imu", 0.03), ("euroc_v201_imu", 0.05)])
def test_real_inertial_data_with_vision_made_from_truth(data_root, name: str, ate_m: float) -> None:
    """30 s of flight with 2 mm and 0.1 deg per motion; default settings, started with 2 deg of tilt error."""
    real, rng = RealMotion.euroc(data_root / name), np.random.default_rng(3)
    start_ns = real.samples[0].t_ns + 10_000_000_000
    stamps = list(range(start_ns, start_ns + 30_000_000_000, 50_000_000))
    vision = SimulatedVision()
    motions = vision.motions([real.pose(t) for t in stamps], stamps, rng)
    T = real.pose(start_ns)
    T[:3, :3] = T[:3, :3] @ so3_exp(np.deg2rad([2.0, 0.0, 0.0]))
    sigmas = np.repeat([0.04, 0.001, 0.1, 0.1, 0.2], 3)
    ekf = Ekf(EkfConfig(), EUROC_NOISE, GRAVITY_M_S2)
    ekf.initialise(NavState(start_ns, T, real.velocity(start_ns), np.zeros(3), np.zeros(3), np.diag(sigmas**2)))
    i, nis, speed_chi2, seen, true = 0, [], [], [], []
    for sample in real.samples:
        ekf.predict(sample)
        while i < len(stamps) and sample.t_ns > stamps[i]:
            if i > 0:
                nis.append(ekf.update_vo(motions[i]).nis / 6)
            if i % vision.keyframe_every == 0:
                ekf.add_keyframe(i // vision.keyframe_every, stamps[i])
            state = ekf.state_at(stamps[i])
            assert state is not None
            T = real.pose(stamps[i])
            seen.append(state.T_world_body[:3, 3])
            true.append(T[:3, 3])
            if i > 40:
                R, P = state.T_world_body[:3, :3], state.covariance
                error = T[:3, :3].T @ real.velocity(stamps[i]) - R.T @ state.velocity_world_m_s
                speed_chi2.append(error @ np.linalg.solve(R.T @ P[6:9, 6:9] @ R, error) / 3)
            i += 1
    estimate, truth = np.array(seen), np.array(true)
    error = transform_points(align_points(estimate, truth), estimate) - truth
    ate = np.sqrt(np.mean(np.sum(error**2, axis=1)))
    print(f"{name}: ATE {ate:.4f} m, NIS {np.mean(nis):.2f} per degree, body velocity {np.mean(speed_chi2):.2f}")
    assert ate < ate_m
    assert 0.2 < np.mean(nis) < 1.5
    assert np.median(speed_chi2) < 3.0  # the truth's own velocity, from 10 Hz differences, is not free of error
    assert ekf.counters["vo_gated"] < 0.03 * len(stamps)
    assert ekf.counters["soft_resets"] == 0
