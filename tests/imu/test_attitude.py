"""Attitude from the IMU alone: in the hand (BROAD), and on a cart that accelerates, turns, shakes and meets magnets."""

from dataclasses import replace
from pathlib import Path

import imufusion
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needs import missing
from vislam.config import AttitudeConfig
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, ImuSample, ImuSpan, MagSample
from vislam.imu.attitude import AttitudeFilter
from worlds.broad import Trial, errors_deg, rms, started
from worlds.cart import Cart
from worlds.parts import GRAVITY_M_S2

VQF, COMPLEMENTARY = AttitudeConfig(), AttitudeConfig(method="complementary")
BOTH = pytest.mark.parametrize("config", [VQF, COMPLEMENTARY], ids=["vqf", "complementary"])
LIBRARY_DEG = {  # vqf 2.1.2 with its defaults: all, heading, inclination; benchmarks/attitude.py
    "01_undisturbed_slow_rotation_A": (1.99, 1.89, 0.60),
    "04_undisturbed_slow_rotation_with_breaks_A": (1.07, 0.73, 0.79),
    "21_undisturbed_fast_combined": (4.08, 3.70, 1.72),
    "28_disturbed_stationary_magnet_A": (4.04, 3.86, 1.21),
}


def estimate(cart: Cart, config: AttitudeConfig | None = None) -> Array:
    return AttitudeFilter(config or AttitudeConfig(), GRAVITY_M_S2, cart.R_world_body[0], np.zeros(3)).add_span(
        cart.span
    )


@pytest.mark.parametrize("shake", [0.0, 0.5])
def test_tilt_stays_at_what_the_accelerometer_bias_alone_leaves(shake: float) -> None:
    carts = [Cart.drive(seed, shake=shake) for seed in range(4)]
    tilt = [rms(cart.tilt_deg(estimate(cart))) for cart in carts]
    complementary = [rms(cart.tilt_deg(estimate(cart, COMPLEMENTARY))) for cart in carts]
    textbook = replace(COMPLEMENTARY, proportional_gain=1.0, integral_gain=0.01, gate_m_s2=1e3)
    ungated = [rms(cart.tilt_deg(estimate(cart, textbook))) for cart in carts]
    print(f"seeds 0 to 3: tilt rms {np.round(tilt, 3)} deg, complementary {np.round(complementary, 3)} deg")
    print(f"textbook gains without a gate {np.round(ungated, 3)} deg")
    assert np.mean(tilt) < 1.05 * np.mean(complementary) < 0.6
    assert np.mean(complementary) < 0.65 * np.mean(ungated)


@BOTH
def test_the_bias_of_the_gyro_is_learnt_as_far_as_gravity_shows_it(config: AttitudeConfig) -> None:
    t_ns = np.arange(0, 400_000_000_000, 5_000_000)
    ones = np.ones((len(t_ns), 1))
    still = ImuSpan(t_ns, ones * [0.004, -0.003, 0.0], ones * [0.0, 0.0, GRAVITY_M_S2])
    attitude = AttitudeFilter(config, GRAVITY_M_S2, np.eye(3), np.zeros(3))
    R = attitude.add_span(still)
    np.testing.assert_allclose(attitude.gyro_bias_rad_s[:2], [0.004, -0.003], atol=2e-4)
    assert np.rad2deg(np.arccos(np.clip(R[-1, 2, 2], -1.0, 1.0))) < 0.15


@BOTH
def test_a_magnetometer_holds_yaw_and_a_magnet_does_not_turn_it(config: AttitudeConfig) -> None:
    cart = Cart.drive(0, duration_s=90.0)
    errors = {}
    for gate in (config.mag_gate, 1e3):
        dip_deg = 180.0 if gate > 1.0 else config.mag_dip_gate_deg
        attitude = AttitudeFilter(
            replace(config, mag_gate=gate, mag_dip_gate_deg=dip_deg), GRAVITY_M_S2, cart.R_world_body[0], np.zeros(3)
        )
        R = []
        for k, (t_ns, gyro, accel) in enumerate(
            zip(cart.span.t_ns.tolist(), cart.span.gyro_rad_s, cart.span.accel_m_s2, strict=True)
        ):
            mag = MagSample(t_ns, cart.field_ut[k]) if k % 4 == 0 else None
            attitude.add(ImuSample(t_ns, gyro, accel), mag)
            R.append(attitude.R_world_body)
        errors[gate] = cart.yaw_deg(np.array(R))
    without = cart.yaw_deg(estimate(cart, config))
    gated, open_ = errors.values()
    print(f"yaw: without {without.max():.1f}, gated {gated.max():.1f}, not gated {open_.max():.1f} deg")
    assert gated.max() < 5.0
    assert open_[cart.is_disturbed].max() > 3.0 * gated[cart.is_disturbed].max()
    assert gated[-1] < 0.6 * without[-1]


@BOTH
def test_samples_one_by_one_and_as_a_span_are_the_same(config: AttitudeConfig) -> None:
    cart = Cart.drive(1, duration_s=5.0)
    attitude = AttitudeFilter(config, GRAVITY_M_S2, cart.R_world_body[0], np.zeros(3))
    spans = estimate(cart, config)
    samples = list(zip(cart.span.t_ns.tolist(), cart.span.gyro_rad_s, cart.span.accel_m_s2, strict=True))
    for k, (t_ns, gyro, accel) in enumerate(samples):
        attitude.add(ImuSample(t_ns, gyro, accel))
        attitude.add(ImuSample(t_ns, gyro * 100, accel))  # not newer: left out
        np.testing.assert_allclose(attitude.R_world_body, spans[k], atol=2e-5)  # the first force enters its low-pass


@BOTH
@settings(max_examples=50)
@given(
    st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3),
    st.lists(st.floats(-30, 30), min_size=6, max_size=6),
    st.integers(0, 2**31),
)
def test_it_remains_a_rotation_whatever_comes(
    config: AttitudeConfig, start: list[float], sample: list[float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    attitude = AttitudeFilter(config, GRAVITY_M_S2, so3_exp(np.array(start)), np.zeros(3))
    t_ns = 0
    for _ in range(200):
        t_ns += int(rng.integers(1, 2_000_000_000))
        gyro, accel = np.array(sample[:3]) * rng.standard_normal(3), np.array(sample[3:]) * rng.standard_normal(3)
        attitude.add(ImuSample(t_ns, gyro, accel), MagSample(t_ns, rng.standard_normal(3) * 40))
    R = attitude.R_world_body
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) > 0.0


def moving(seconds: float, force: tuple[float, float], rate_hz: float = 200.0) -> ImuSpan:
    """Return a level body that stands for 10 s, then speeds up for 1 s and stands as long as asked."""
    t = np.arange(round((10.0 + seconds) * rate_hz)) / rate_hz
    accel = np.tile([0.0, 0.0, GRAVITY_M_S2], (len(t), 1))
    accel[(t >= 10.0) & (t < 11.0), :2] = force
    return ImuSpan(np.round(t * 1e9).astype(np.int64), np.zeros_like(accel), accel)


@BOTH
def test_a_change_of_speed_tilts_the_horizon_by_a_degree_at_most_and_passes(config: AttitudeConfig) -> None:
    """1 m/s within a second: 6 deg, were it taken for gravity."""
    attitude = AttitudeFilter(config, GRAVITY_M_S2, np.eye(3), np.zeros(3))
    tilt_deg = np.rad2deg(np.arccos(np.clip(attitude.add_span(moving(60.0, (1.0, 0.0)))[:, 2, 2], -1.0, 1.0)))
    assert 0.1 < tilt_deg.max() < 1.3
    assert tilt_deg[-1] < 0.1


def test_a_wrong_start_at_rest_is_forgotten_within_seconds() -> None:
    R = so3_exp(np.deg2rad([60.0, -40.0, 0.0]))
    attitude = AttitudeFilter(VQF, GRAVITY_M_S2, R, np.zeros(3))
    tilt_deg = np.rad2deg(np.arccos(np.clip(attitude.add_span(moving(10.0, (0.0, 0.0)))[:, 2, 2], -1.0, 1.0)))
    assert tilt_deg[0] > 60.0 and tilt_deg[-1] < 1.0


def test_the_bias_is_learnt_while_the_body_moves() -> None:
    """Rotations about changing axes never rest: gravity shows what integrates wrongly."""
    rate_hz, bias = 200.0, np.deg2rad([0.4, -0.3, 0.5])
    t = np.arange(round(90.0 * rate_hz)) / rate_hz
    rate = np.stack([np.sin(0.9 * t), np.sin(1.3 * t + 1.0), np.sin(0.7 * t + 2.0)], axis=1)
    R = np.empty((len(t), 3, 3))
    R[0] = np.eye(3)
    for k in range(1, len(t)):
        R[k] = R[k - 1] @ so3_exp(rate[k] / rate_hz)
    span = ImuSpan(np.round(t * 1e9).astype(np.int64), rate + bias, GRAVITY_M_S2 * R[:, 2])
    attitude = AttitudeFilter(VQF, GRAVITY_M_S2, np.eye(3), np.zeros(3))
    found = attitude.add_span(span)
    np.testing.assert_allclose(attitude.gyro_bias_rad_s, bias, atol=np.deg2rad(0.1))
    assert np.rad2deg(np.arccos(np.clip(found[-1, 2] @ R[-1, 2], -1.0, 1.0))) < 0.3


def test_a_cart_that_rolls_evenly_is_not_at_rest() -> None:
    """A floor that bends by 0.3 deg/s for some seconds is not a bias: taken for one, it tilts all that follows."""
    rate_hz = 200.0
    t = np.arange(round(120.0 * rate_hz)) / rate_hz
    pitch = np.deg2rad(1.0) * np.sin(2.0 * np.pi * t / 17.0)
    rate = np.gradient(pitch, 1.0 / rate_hz)
    zero = np.zeros_like(t)
    accel = GRAVITY_M_S2 * np.stack([-np.sin(pitch), zero, np.cos(pitch)], axis=1)
    rng = np.random.default_rng(0)
    gyro = np.stack([zero, rate, zero], axis=1) + np.deg2rad(0.3) * rng.standard_normal((len(t), 3))
    span = ImuSpan(np.round(t * 1e9).astype(np.int64), gyro, accel + 0.05 * rng.standard_normal((len(t), 3)))
    attitude = AttitudeFilter(VQF, GRAVITY_M_S2, np.eye(3), np.zeros(3))
    up = attitude.add_span(span)[:, 2]
    off_deg = np.rad2deg(np.arccos(np.clip(np.sum(up * accel, axis=1) / GRAVITY_M_S2, -1.0, 1.0)))
    assert rms(off_deg) < 0.3
    assert np.rad2deg(np.linalg.norm(attitude.gyro_bias_rad_s)) < 0.1


@BOTH
def test_what_is_not_a_number_or_not_newer_changes_nothing(config: AttitudeConfig) -> None:
    cart = Cart.drive(2, duration_s=4.0)
    filters = [AttitudeFilter(config, GRAVITY_M_S2, cart.R_world_body[0], np.zeros(3)) for _ in range(3)]
    span = cart.span
    for k, t_ns in enumerate(span.t_ns.tolist()):
        sample = ImuSample(t_ns, span.gyro_rad_s[k], span.accel_m_s2[k])
        for attitude in filters[:2]:
            attitude.add(sample, MagSample(t_ns, cart.field_ut[k]))
        for wrong in (np.nan, np.inf):
            filters[1].add(ImuSample(t_ns + 1000, np.full(3, wrong), sample.accel_m_s2))
            filters[1].add(ImuSample(t_ns + 1000, sample.gyro_rad_s, np.full(3, wrong)))
        filters[1].add(ImuSample(t_ns - 1_000_000_000, sample.gyro_rad_s + 1.0, sample.accel_m_s2))
    np.testing.assert_array_equal(filters[0].R_world_body, filters[1].R_world_body)
    holes = replace(span, gyro_rad_s=span.gyro_rad_s.copy())
    holes.gyro_rad_s[100:103] = np.nan
    R = filters[2].add_span(holes)
    assert np.isfinite(R).all()
    assert cart.tilt_deg(R).max() < 2.0


def test_a_field_that_is_not_a_number_is_left_out() -> None:
    attitude = AttitudeFilter(VQF, GRAVITY_M_S2, np.eye(3), np.zeros(3))
    for k in range(1, 50):
        still = ImuSample(k * 5_000_000, np.zeros(3), np.array([0.0, 0.0, GRAVITY_M_S2]))
        attitude.add(still, MagSample(still.t_ns, np.full(3, np.nan) if k % 2 else np.zeros(3)))
    np.testing.assert_allclose(attitude.R_world_body, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("shake", [0.0, 0.5])
def test_what_it_says_of_its_tilt_is_honest_on_carts(shake: float) -> None:
    ratios = []
    for seed in range(4):
        cart = Cart.drive(seed, shake=shake)
        attitude = AttitudeFilter(VQF, GRAVITY_M_S2, cart.R_world_body[0], np.zeros(3))
        up, sigma_deg = np.empty((len(cart.field_ut), 3)), np.empty(len(cart.field_ut))
        for k, t_ns in enumerate(cart.span.t_ns.tolist()):
            attitude.add(ImuSample(t_ns, cart.span.gyro_rad_s[k], cart.span.accel_m_s2[k]))
            up[k], sigma_deg[k] = attitude.R_world_body[2], np.rad2deg(attitude.tilt_sigma_rad)
        off_deg = np.rad2deg(np.arccos(np.clip(np.sum(up * cart.R_world_body[:, 2], axis=1), -1.0, 1.0)))
        ratios.append(np.mean(off_deg**2 / (2.0 * sigma_deg**2)))
    print(f"NEES of the tilt per degree of freedom: {np.round(ratios, 2)}")
    assert 0.1 < np.mean(ratios) < 1.5


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY_DEG)
def test_in_the_hand_it_is_as_good_as_the_library_vqf(data_root: Path, name: str) -> None:
    path = data_root / "broad" / f"{name}.mat"
    if not path.is_file():
        missing(f"{path} is not there")
    trial = Trial.read(path)
    R, sigma_rad = trial.estimate(started(trial, VQF))
    errors = errors_deg(trial, R)
    nees = float(np.mean(np.deg2rad(errors[2]) ** 2 / (2.0 * sigma_rad[trial.is_used] ** 2)))
    print(
        f"{name}: {rms(errors).round(2)} deg (all, heading, inclination), library {LIBRARY_DEG[name]}; NEES {nees:.2f}"
    )
    assert (rms(errors) < 1.2 * np.array(LIBRARY_DEG[name])).all()
    assert 0.2 < nees < 2.5


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
