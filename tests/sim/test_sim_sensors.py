import numpy as np
import pytest

from vislam.imu import ImuNoise
from vislam.sim.motion.spline import BodySpline
from vislam.sim.sensing import (
    CONSUMER_IMU,
    EARTH_FIELD_UT,
    DepthNoise,
    Imager,
    exposure_gains,
    sense_depth,
    sense_field,
    sense_imu,
)

SEED = 20240611


def still(seconds: float, rate_hz: float, angles=(0.3, -0.2, 1.0)):
    spline = BodySpline(np.zeros((8, 3)), np.tile(angles, (8, 1)), seconds / 3.0)
    return spline.at(np.arange(int(seconds * rate_hz)) / rate_hz)


def test_at_rest_the_accelerometer_reads_gravity_up_and_the_gyro_nothing():
    motion = still(1.0, 200.0)
    record = sense_imu(motion, CONSUMER_IMU, 9.81, np.random.default_rng(SEED), disturbed=False)
    up = np.einsum("nij,nj->ni", motion.T_world_body[:, :3, :3], record.accel_m_s2)
    np.testing.assert_allclose(up, np.tile([0.0, 0.0, 9.81], (200, 1)), atol=1e-12)
    np.testing.assert_allclose(record.gyro_rad_s, 0.0, atol=1e-12)


@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
def test_white_noise_and_bias_walk_have_the_stated_densities(rate_hz):
    noise = ImuNoise(1e-3, 5e-3, 2e-4, 4e-3, rate_hz)
    motion = still(400.0, rate_hz)
    exact = sense_imu(motion, noise, 9.81, np.random.default_rng(0), disturbed=False)
    record = sense_imu(motion, noise, 9.81, np.random.default_rng(SEED))
    for measured, true, bias, density, walk in (
        (record.gyro_rad_s, exact.gyro_rad_s, record.gyro_bias_rad_s, 1e-3, 2e-4),
        (record.accel_m_s2, exact.accel_m_s2, record.accel_bias_m_s2, 5e-3, 4e-3),
    ):
        white = measured - true - bias
        assert white.std() == pytest.approx(density * np.sqrt(rate_hz), rel=0.02)
        # Allan deviation at one second equals the density, at four seconds half of it.
        for seconds in (1, 4):
            means = white.reshape(-1, int(rate_hz) * seconds, 3).mean(axis=1)
            allan = np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2))
            assert allan == pytest.approx(density / np.sqrt(seconds), rel=0.15)
        steps = np.diff(bias, axis=0)
        assert steps.std() == pytest.approx(walk / np.sqrt(rate_hz), rel=0.02)
        lagged = np.mean(steps[1:] * steps[:-1]) / np.mean(steps**2)
        assert abs(lagged) < 0.02


def test_magnetometer_turns_with_the_body():
    motion = still(1.0, 50.0)
    exact = sense_field(motion, 0.0, np.random.default_rng(SEED))
    back = np.einsum("nij,nj->ni", motion.T_world_body[:, :3, :3], exact)
    np.testing.assert_allclose(back, np.tile(EARTH_FIELD_UT, (50, 1)), atol=1e-9)
    noisy = sense_field(still(200.0, 50.0), 0.4, np.random.default_rng(SEED))
    assert (noisy - exact[0]).std() == pytest.approx(0.4, rel=0.03)


def test_shot_noise_follows_the_light_and_gain_brightens():
    imager = Imager(320, 240, noisy=True)
    spread = {}
    for level in (30.0, 120.0, 220.0):
        flat = np.full((240, 320, 3), level, dtype=np.float32)
        image = imager.sense(flat, 1.0, np.random.default_rng(SEED))
        centre = image[100:140, 130:190].astype(float)
        spread[level] = centre.std()
        assert centre.mean() == pytest.approx(level, abs=1.5)
    assert 1.0 < spread[120.0] < 3.0
    assert spread[30.0] > spread[220.0]  # display encoding stretches the dark
    brighter = imager.sense(np.full((240, 320, 3), 120.0, np.float32), 1.3, np.random.default_rng(SEED))
    assert brighter[100:140, 130:190].mean() == pytest.approx(120.0 * 1.3 ** (1.0 / 2.2), abs=1.5)
    assert brighter[:8, :8].mean() < brighter[100:140, 130:190].mean() - 8.0  # vignetting


def test_without_noise_an_image_is_only_rounded_and_clipped():
    light = np.random.default_rng(SEED).uniform(-20.0, 300.0, (48, 64, 3)).astype(np.float32)
    image = Imager(64, 48, noisy=False).sense(light, 1.0, np.random.default_rng(0))
    np.testing.assert_array_equal(image, np.floor(np.clip(light, 0.0, 255.0) + 0.5).clip(0, 255).astype(np.uint8))


def test_depth_noise_grows_with_the_square_and_edges_and_far_things_are_lost():
    depth = np.full((240, 320), 2.0, dtype=np.float32)
    depth[:, 160:] = 4.0
    depth[:40] = 9.0
    depth[-40:] = 0.2
    noise = DepthNoise()
    sensed = sense_depth(depth, noise, np.random.default_rng(SEED))
    for columns, z in ((slice(10, 150), 2.0), (slice(170, 310), 4.0)):
        patch = sensed[60:180, columns]
        patch = patch[patch > 0.0]
        assert patch.std() == pytest.approx(noise.floor_m + noise.sigma_m_at_1m * z * z, rel=0.05)
        assert patch.mean() == pytest.approx(z, abs=1e-3)
    assert not sensed[:38].any()
    assert not sensed[-38:].any()
    edge = sensed[60:180, 159:161]
    assert np.mean(edge == 0.0) == pytest.approx(noise.edge_loss, abs=0.12)


def test_exposure_drifts_and_steps_within_bounds():
    t = np.arange(0.0, 60.0, 1.0 / 15.0)
    gains = exposure_gains(t, np.random.default_rng(SEED))
    assert 0.55 < gains.min() < 0.97
    assert 1.0 < gains.max() < 1.55
    assert np.abs(np.diff(np.log(gains))).max() < 0.2
    assert len(exposure_gains(np.empty(0), np.random.default_rng(0))) == 0
