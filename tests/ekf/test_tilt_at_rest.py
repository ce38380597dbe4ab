"""At rest nothing tells tilt from the accelerometer's bias, so however long it lasts neither may become surer."""

import numpy as np
import pytest

from vislam.config import EkfConfig
from vislam.core.messages import Array
from vislam.ekf import MsckfEkf
from vislam.sim.sensing import CONSUMER_IMU
from worlds.flight import MONO, Landmarks, motion_of
from worlds.motion import levelled, state_error, still
from worlds.parts import MACHINE

RATE = 200


def rested(seed: int, duration_s: float) -> tuple[Array, Array, Array, Array]:
    """Return tilt error [N, 2] (deg, in the world), its sigma [N], NEES [N] of tilt and of the bias of level force."""
    rng = np.random.default_rng(seed)
    motion = still(*rng.uniform(-0.2, 0.2, 2))
    T = motion.pose(0.0)
    gyro_bias, accel_bias = rng.normal(size=3) * 0.006, rng.normal(size=3) * 0.06
    samples, biases = motion.samples(duration_s, RATE, CONSUMER_IMU, rng, gyro_bias, accel_bias)
    ekf = MsckfEkf(EkfConfig(), CONSUMER_IMU, MACHINE, MONO)
    ekf.initialise(levelled(rng, T, gyro_bias, accel_bias))
    world = Landmarks(MONO, rng, tracks=30, sigma_px=0.5)
    tilts, sigmas, tests = [], [], []
    for k, sample in enumerate(samples):
        ekf.predict(sample)
        if k % 20 == 10:
            ekf.update_vision(motion_of(sample.t_ns), world.see(motion.pose, k / RATE, False), False)
            ekf.update_zero_velocity(sample.t_ns)
        if k % RATE == 100:
            state = ekf.state()
            R, P = state.T_world_body[:3, :3], state.covariance
            error = state_error((T, np.zeros(3), biases[k]), state)
            tilt, P_tilt = (R @ error[:3])[:2], (R @ P[:3, :3] @ R.T)[:2, :2]
            tilts.append(np.rad2deg(tilt))
            sigmas.append(np.rad2deg(np.sqrt(0.5 * np.trace(P_tilt))))
            bias, P_bias = (R @ error[12:])[:2], (R @ P[12:15, 12:15] @ R.T)[:2, :2]
            tests.append((tilt @ np.linalg.solve(P_tilt, tilt), bias @ np.linalg.solve(P_bias, bias)))
    return np.array(tilts), np.array(sigmas), *np.array(tests).T


@pytest.mark.parametrize("seed", [1, 6])
def test_half_a_minute_at_rest_tells_nothing_of_tilt(seed: int) -> None:
    tilts, sigmas, nees_tilt, nees_bias = rested(seed, 30.0)
    assert sigmas.min() > 0.99 * sigmas[0]
    assert sigmas.max() < 1.02 * sigmas[0]
    assert np.linalg.norm(tilts - tilts[0], axis=1).max() < 0.15
    assert nees_tilt.max() < 13.8  # 99.9 % of chi-square with 2 degrees of freedom
    assert nees_bias.max() < 13.8
