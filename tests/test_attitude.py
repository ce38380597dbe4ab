"""The complementary filter: attitude from the IMU alone on a cart that accelerates, turns, shakes and meets magnets."""

import imufusion
import numpy as np
import pytest
from carts import GRAVITY_M_S2, Cart
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.config import AttitudeConfig
from vislam.geometry import so3_exp
from vislam.imu.attitude import AttitudeFilter
from vislam.messages import Array, ImuSample, ImuSpan, MagSample


def estimate(cart: Cart, config: AttitudeConfig | None = None) -> Array:
    return AttitudeFilter(config or AttitudeConfig(), GRAVITY_M_S2, cart.R_world_body[0], np.zeros(3)).add_span(
        cart.span
    )


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("shake", [0.0, 0.5])
def test_tilt_stays_at_what_the_accelerometer_bias_alone_leaves(shake: float) -> None:
    carts = [Cart.drive(seed, shake=shake) for seed in range(4)]
    tilt = [rms(cart.tilt_deg(estimate(cart))) for cart in carts]
    textbook = AttitudeConfig(proportional_gain=1.0, integral_gain=0.01, gate_m_s2=1e3)
    ungated = [rms(cart.tilt_deg(estimate(cart, textbook))) for cart in carts]
    print(f"seeds 0 to 3: tilt rms {np.round(tilt, 3)} deg, textbook gains without a gate {np.round(ungated, 3)} deg")
    assert np.mean(tilt) < 0.75
    assert np.mean(tilt) < 0.65 * np.mean(ungated)


def test_the_bias_of_the_gyro_is_learnt_as_far_as_gravity_shows_it() -> None:
    t_ns = np.arange(0, 400_000_000_000, 5_000_000)
    ones = np.ones((len(t_ns), 1))
    still = ImuSpan(t_ns, ones * [0.004, -0.003, 0.0], ones * [0.0, 0.0, GRAVITY_M_S2])
    attitude = AttitudeFilter(AttitudeConfig(), GRAVITY_M_S2, np.eye(3), np.zeros(3))
    R = attitude.add_span(still)
    np.testing.assert_allclose(attitude.gyro_bias_rad_s[:2], [0.004, -0.003], atol=2e-4)
    assert np.rad2deg(np.arccos(R[-1, 2, 2])) < 0.15


def test_a_magnetometer_holds_yaw_and_a_magnet_does_not_turn_it() -> None:
    cart = Cart.drive(0, duration_s=90.0)
    errors = {}
    for gate in (AttitudeConfig().mag_gate, 1e3):
        attitude = AttitudeFilter(AttitudeConfig(mag_gate=gate), GRAVITY_M_S2, cart.R_world_body[0], np.zeros(3))
        R = []
        for k, (t_ns, gyro, accel) in enumerate(
            zip(cart.span.t_ns.tolist(), cart.span.gyro_rad_s, cart.span.accel_m_s2, strict=True)
        ):
            mag = MagSample(t_ns, cart.field_ut[k]) if k % 4 == 0 else None
            attitude.add(ImuSample(t_ns, gyro, accel), mag)
            R.append(attitude.R_world_body)
        errors[gate] = cart.yaw_deg(np.array(R))
    without = cart.yaw_deg(estimate(cart))
    gated, open_ = errors.values()
    print(f"yaw: without {without.max():.1f}, gated {gated.max():.1f}, not gated {open_.max():.1f} deg")
    assert gated.max() < 5.0
    assert open_[cart.is_disturbed].max() > 3.0 * gated[cart.is_disturbed].max()
    assert gated[-1] < 0.6 * without[-1]


def test_samples_one_by_one_and_as_a_span_are_the_same() -> None:
    cart = Cart.drive(1, duration_s=5.0)
    attitude = AttitudeFilter(AttitudeConfig(), GRAVITY_M_S2, cart.R_world_body[0], np.zeros(3))
    spans = estimate(cart)
    samples = list(zip(cart.span.t_ns.tolist(), cart.span.gyro_rad_s, cart.span.accel_m_s2, strict=True))
    for k, (t_ns, gyro, accel) in enumerate(samples):
        attitude.add(ImuSample(t_ns, gyro, accel))
        attitude.add(ImuSample(t_ns, gyro * 100, accel))  # not newer: left out
        np.testing.assert_allclose(attitude.R_world_body, spans[k], atol=2e-5)  # the first force enters its low-pass


@settings(max_examples=50)
@given(
    st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3),
    st.lists(st.floats(-30, 30), min_size=6, max_size=6),
    st.integers(0, 2**31),
)
def test_it_remains_a_rotation_whatever_comes(start: list[float], sample: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    attitude = AttitudeFilter(AttitudeConfig(), GRAVITY_M_S2, so3_exp(np.array(start)), np.zeros(3))
    t_ns = 0
    for _ in range(200):
        t_ns += int(rng.integers(1, 2_000_000_000))
        gyro, accel = np.array(sample[:3]) * rng.standard_normal(3), np.array(sample[3:]) * rng.standard_normal(3)
        attitude.add(ImuSample(t_ns, gyro, accel), MagSample(t_ns, rng.standard_normal(3) * 40))
    R = attitude.R_world_body
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) > 0.0


def test_against_imufusion() -> None:
    cart = Cart.drive(0)
    ahrs = imufusion.Ahrs()
    ahrs.set_sample_period(1.0 / 200.0)
    quaternions = []
    for gyro, accel in zip(cart.span.gyro_rad_s, cart.span.accel_m_s2, strict=True):
        ahrs.update_no_magnetometer(np.rad2deg(gyro), accel / GRAVITY_M_S2)
        quaternions.append(ahrs.get_quaternion())
    w, x, y, z = np.array(quaternions).T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    theirs = np.rad2deg(np.arccos(np.clip(np.sum(up * cart.R_world_body[:, 2], axis=1), -1.0, 1.0)))
    ours = cart.tilt_deg(estimate(cart))
    print(f"tilt rms: ours {rms(ours[2000:]):.2f}, imufusion {rms(theirs[2000:]):.2f} deg")
    assert rms(ours[2000:]) < rms(theirs[2000:])
