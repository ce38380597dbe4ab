"""Inertial data: buffer, preintegration, calibration, rest."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.config import ImuConfig, InitConfig, MachineConfig
from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp, so3_log
from vislam.core.messages import ImuSample, ImuSpan, NavState
from vislam.imu import ImuBuffer, ImuCalibration, RestDetector, join, pose_after, preintegrate, subtract_bias
from worlds.motion import EUROC_NOISE, NS, T0_NS, Motion, RealMotion, to_span
from worlds.parts import GRAVITY_M_S2

GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])


def sample(t_ns: int, value: float = 0.0) -> ImuSample:
    return ImuSample(t_ns, np.full(3, value), np.full(3, 2.0 * value))


def filled(rate_hz: float = 100.0, duration_s: float = 2.0, **config: float) -> ImuBuffer:
    buffer = ImuBuffer(ImuConfig(**config), MachineConfig())
    for k in range(round(duration_s * rate_hz) + 1):
        assert buffer.add(sample(T0_NS + round(k * NS / rate_hz), float(k % 5 if duration_s > 5.0 else k)))
    return buffer


def test_span_interpolates_both_ends() -> None:
    span = filled().span(T0_NS + 12_500_000, T0_NS + 47_500_000)
    assert span is not None
    assert span.t_ns.tolist() == [T0_NS + t for t in (12_500_000, 20_000_000, 30_000_000, 40_000_000, 47_500_000)]
    np.testing.assert_allclose(span.gyro_rad_s[:, 0], [1.25, 2.0, 3.0, 4.0, 4.75], rtol=1e-12)
    np.testing.assert_allclose(span.accel_m_s2[:, 2], 2.0 * span.gyro_rad_s[:, 0], rtol=1e-12)


def test_span_on_samples_repeats_none() -> None:
    span = filled().span(T0_NS + 10_000_000, T0_NS + 30_000_000)
    assert span is not None
    assert (np.diff(span.t_ns) > 0).all()
    assert span.gyro_rad_s[:, 0].tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(("begin", "end"), [(-1, 100), (100, 2_000_000_001), (500, 500), (500, 400)])
def test_span_that_is_not_covered(begin: int, end: int) -> None:
    assert filled().span(T0_NS + begin, T0_NS + end) is None


def test_empty_buffer() -> None:
    buffer = ImuBuffer(ImuConfig(), MachineConfig())
    assert buffer.newest_t_ns is None
    assert buffer.oldest_t_ns is None
    assert buffer.span(0, 1) is None
    assert buffer.gap_s(0, 1) == float("inf")


def test_bad_samples_are_refused_and_counted() -> None:
    buffer = filled(duration_s=0.1)
    assert not buffer.add(sample(T0_NS + 100_000_000))
    assert not buffer.add(sample(T0_NS + 50_000_000))
    assert not buffer.add(ImuSample(T0_NS + NS, np.array([0.0, np.nan, 0.0]), np.zeros(3)))
    assert not buffer.add(ImuSample(T0_NS + NS, np.zeros(3), np.array([0.0, np.inf, 0.0])))
    assert buffer.newest_t_ns == T0_NS + 100_000_000
    assert buffer.counters == {
        "samples": 11,
        "unusable": 2,
        "late": 1,
        "duplicate": 1,
        "stuck": 0,
        "spike": 0,
        "gaps": 0,
    }


def test_history_is_bounded() -> None:
    buffer = filled(rate_hz=200.0, duration_s=60.0, buffer_s=2.0)
    assert buffer.newest_t_ns is not None
    assert buffer.oldest_t_ns is not None
    held_s = (buffer.newest_t_ns - buffer.oldest_t_ns) / NS
    assert 2.0 <= held_s < 2.3
    assert buffer.span(buffer.newest_t_ns - 2 * NS, buffer.newest_t_ns) is not None


def test_a_hole_is_seen_from_inside_and_outside() -> None:
    buffer = filled(duration_s=1.0)
    buffer.add(sample(T0_NS + 2 * NS))
    buffer.add(sample(T0_NS + 2 * NS + 10_000_000))
    assert buffer.counters["gaps"] == 1
    assert buffer.gap_s(T0_NS, T0_NS + NS) == pytest.approx(0.01)
    assert buffer.gap_s(T0_NS, T0_NS + 2 * NS) == pytest.approx(1.0)
    assert buffer.gap_s(T0_NS + 1_300_000_000, T0_NS + 1_350_000_000) == pytest.approx(1.0)


@pytest.mark.parametrize(("rate_hz", "velocity_m_s", "position_m"), [(200.0, 5e-5, 2e-5), (50.0, 8e-4, 3e-4)])
def test_preintegration_is_second_order(rate_hz: float, velocity_m_s: float, position_m: float) -> None:
    """Noise-free samples of brisk motion, 1 s. First-order integration is off by 7 mm at 200 Hz."""
    for seed in range(10):
        motion = Motion.random(seed)
        piece = preintegrate(to_span(motion.samples(1.0, rate_hz)[0]))
        (T0, v0, *_), (T1, v1, *_) = motion.at(0.0), motion.at(1.0)
        R0 = T0[:3, :3]
        assert np.linalg.norm(v0 + GRAVITY + R0 @ piece.dv_m_s - v1) < velocity_m_s
        assert np.linalg.norm(T0[:3, 3] + v0 + 0.5 * GRAVITY + R0 @ piece.dp_m - T1[:3, 3]) < position_m
        assert np.linalg.norm(so3_log(T1[:3, :3].T @ R0 @ piece.dR)) < (3e-5 if rate_hz == 200.0 else 5e-4)


def test_preintegration_jacobians() -> None:
    span = to_span(Motion.random(3, 2.0).samples(0.5)[0])
    gyro_bias, accel_bias, step = np.array([0.01, -0.02, 0.03]), np.array([0.2, -0.1, 0.05]), 1e-6
    piece = preintegrate(span, gyro_bias, accel_bias)
    for axis in range(3):
        d = np.eye(3)[axis] * step
        plus, minus = preintegrate(span, gyro_bias + d, accel_bias), preintegrate(span, gyro_bias - d, accel_bias)
        rotation = (so3_log(piece.dR.T @ plus.dR) - so3_log(piece.dR.T @ minus.dR)) / (2 * step)
        np.testing.assert_allclose(piece.dR_dgyro[:, axis], rotation, atol=1e-7)
        np.testing.assert_allclose(piece.dv_dgyro[:, axis], (plus.dv_m_s - minus.dv_m_s) / (2 * step), atol=1e-6)
        np.testing.assert_allclose(piece.dp_dgyro[:, axis], (plus.dp_m - minus.dp_m) / (2 * step), atol=1e-6)
        plus, minus = preintegrate(span, gyro_bias, accel_bias + d), preintegrate(span, gyro_bias, accel_bias - d)
        np.testing.assert_allclose(piece.dv_daccel[:, axis], (plus.dv_m_s - minus.dv_m_s) / (2 * step), atol=1e-7)
        np.testing.assert_allclose(piece.dp_daccel[:, axis], (plus.dp_m - minus.dp_m) / (2 * step), atol=1e-7)
    bias = np.concatenate((gyro_bias, accel_bias))
    for axis in range(6):  # of an axis that shows `1 + s` times the truth
        ends = []
        for s in (step, -step):
            true = (np.column_stack((span.gyro_rad_s, span.accel_m_s2)) - bias) / (1.0 + s * np.eye(6)[axis]) + bias
            other = preintegrate(replace(span, gyro_rad_s=true[:, :3], accel_m_s2=true[:, 3:]), gyro_bias, accel_bias)
            ends.append(np.concatenate((so3_log(piece.dR.T @ other.dR), other.dv_m_s, other.dp_m)))
        np.testing.assert_allclose(piece.by_axes[:, axis], (ends[0] - ends[1]) / (2 * step), atol=2e-6)


def test_first_order_correction_follows_reintegration() -> None:
    span = to_span(Motion.random(4).samples(1.0)[0])
    gyro, accel = np.array([2e-3, -1e-3, 1e-3]), np.array([0.02, 0.03, -0.01])
    dR, dv, dp = preintegrate(span).corrected(gyro, accel)
    again = preintegrate(span, gyro, accel)
    assert np.linalg.norm(so3_log(again.dR.T @ dR)) < 1e-5
    assert np.linalg.norm(again.dv_m_s - dv) < 1e-4
    assert np.linalg.norm(again.dp_m - dp) < 1e-4
    shifted = preintegrate(subtract_bias(span, gyro, accel))
    np.testing.assert_allclose(shifted.dp_m, again.dp_m, atol=1e-12)


def test_preintegration_covariance_is_honest() -> None:
    """Chi-square of 9 degrees over many noisy spans; the mean of 400 lies in its 99.9 % band."""
    motion, rng, runs = Motion.random(5), np.random.default_rng(11), 400
    clean = to_span(motion.samples(0.5)[0])
    ideal = preintegrate(clean)
    white = np.array([EUROC_NOISE.gyroscope_noise_density, EUROC_NOISE.accelerometer_noise_density]) * np.sqrt(200.0)
    total = 0.0
    for _ in range(runs):
        gyro = clean.gyro_rad_s + rng.normal(size=clean.gyro_rad_s.shape) * white[0]
        accel = clean.accel_m_s2 + rng.normal(size=clean.accel_m_s2.shape) * white[1]
        piece = preintegrate(ImuSpan(clean.t_ns, gyro, accel), noise=EUROC_NOISE)
        error = np.concatenate([so3_log(piece.dR.T @ ideal.dR), ideal.dv_m_s - piece.dv_m_s, ideal.dp_m - piece.dp_m])
        total += error @ np.linalg.solve(piece.covariance, error)
    # interpolated ends carry half a sample's noise each, so the truth is a little below 9
    assert 8.2 < total / runs < 9.7


@settings(max_examples=40)
@given(cut=st.integers(5_000_001, 495_000_000), seed=st.integers(0, 5), shift=st.integers(-(10**15), 10**15))
def test_spans_compose_and_do_not_know_the_date(cut: int, seed: int, shift: int) -> None:
    buffer = ImuBuffer(ImuConfig(), MachineConfig())
    for s in Motion.random(seed).samples(0.5)[0]:
        buffer.add(s)
    end = T0_NS + NS // 2
    whole, a, b = buffer.span(T0_NS, end), buffer.span(T0_NS, T0_NS + cut), buffer.span(T0_NS + cut, end)
    assert whole is not None
    assert a is not None
    assert b is not None
    full, first, second = preintegrate(whole), preintegrate(a), preintegrate(b)
    assert first.dt_s + second.dt_s == pytest.approx(full.dt_s, abs=1e-12)
    np.testing.assert_allclose(first.dR @ second.dR, full.dR, atol=2e-6)
    np.testing.assert_allclose(first.dv_m_s + first.dR @ second.dv_m_s, full.dv_m_s, atol=3e-5)
    joined = preintegrate(join([a, b]))
    np.testing.assert_allclose(joined.dp_m, first.dp_m + first.dv_m_s * second.dt_s + first.dR @ second.dp_m, atol=1e-9)
    moved = preintegrate(ImuSpan(whole.t_ns + shift, whole.gyro_rad_s, whole.accel_m_s2))
    np.testing.assert_array_equal(moved.dp_m, full.dp_m)


def test_join_refuses_strangers() -> None:
    buffer = filled()
    a, b = buffer.span(T0_NS, T0_NS + 100_000_000), buffer.span(T0_NS + 150_000_000, T0_NS + 200_000_000)
    assert a is not None
    assert b is not None
    with pytest.raises(ValueError, match="do not follow"):
        join([a, b])


def test_preintegration_needs_two_samples() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        preintegrate(ImuSpan(np.array([1]), np.zeros((1, 3)), np.zeros((1, 3))))


def test_calibration() -> None:
    matrix = np.diag([1.02, 0.98, 1.0]) @ so3_exp(np.array([0.0, 0.0, 0.5 * np.pi]))
    calibration = ImuCalibration(np.full(3, 0.1), np.full(3, 0.2), np.eye(3), matrix)
    out = calibration.apply(ImuSample(7, np.full(3, 0.3), np.array([1.2, 0.2, 0.2])))
    assert out.t_ns == 7
    np.testing.assert_allclose(out.gyro_rad_s, np.full(3, 0.2))
    np.testing.assert_allclose(out.accel_m_s2, [0.0, 0.98, 0.0], atol=1e-15)
    with pytest.raises(DataError, match="singular"):
        ImuCalibration(accel_matrix=np.zeros((3, 3)))
    with pytest.raises(DataError, match="finite"):
        ImuCalibration(gyro_bias_rad_s=np.array([0.0, np.nan, 0.0]))


def rest_answers(samples: list[ImuSample]) -> list[bool]:
    detector = RestDetector(InitConfig(), EUROC_NOISE)
    return [detector.add(to_span(samples[k : k + 11])) for k in range(0, len(samples) - 10, 10)]


def test_rest_takes_its_time_and_motion_ends_it() -> None:
    rng = np.random.default_rng(2)
    still = [
        ImuSample(
            T0_NS + 5_000_000 * k,
            np.array([0.02, -0.05, 0.08]) + rng.normal(size=3) * 2.4e-3,
            np.array([0.3, 0.0, 9.8]) + rng.normal(size=3) * 0.03,
        )
        for k in range(301)
    ]
    answers = rest_answers(still)
    assert not any(answers[:14])
    assert all(answers[14:])
    moving = Motion.random(0).samples(1.5)[0]
    assert not any(rest_answers(moving))
    detector = RestDetector(InitConfig(), EUROC_NOISE)
    assert not detector.add(to_span(still[:101]))
    assert not detector.add(to_span(still[110:211]))  # a hole: what was seen before does not count
    assert not detector.add(None)
    assert not detector.add(to_span(still[210:260]))


def test_a_smooth_start_ends_rest_by_the_speed_that_it_gains() -> None:
    """Force spreads by less than idling motors shake; 30 s of rest before it are told throughout."""
    rng = np.random.default_rng(3)
    t_s = 0.005 * np.arange(6601)
    speed = np.where(t_s > 30.0, 0.15 * (t_s - 30.0) ** 2, 0.0)
    white = np.array([EUROC_NOISE.gyroscope_noise_density, EUROC_NOISE.accelerometer_noise_density]) * np.sqrt(200.0)
    samples = [
        ImuSample(
            T0_NS + 5_000_000 * k,
            np.array([0.02, -0.05, 0.08]) + rng.normal(size=3) * white[0],
            np.array([0.3 + 0.3 * max(t - 30.0, 0.0), 1e-3 * t, 9.8]) + rng.normal(size=3) * white[1],
        )
        for k, t in enumerate(t_s)
    ]
    answers = np.array(rest_answers(samples))
    told_s = t_s[10 * np.flatnonzero(answers) + 10]
    assert answers[16 : 30 * 20].all()
    assert np.interp(told_s.max(), t_s, speed) < 0.04
    assert told_s.max() > 30.1


@pytest.mark.data
def test_rest_on_a_real_recording(data_root) -> None:
    """V1_01 stands on the floor with idling motors at its end, and flies in the middle."""
    samples = RealMotion.euroc(data_root / "euroc_v101_imu").samples
    assert all(rest_answers(samples[-201:])[16:])
    assert not any(rest_answers(samples[4000:25000]))


def test_a_body_that_is_thrown_falls_and_one_that_stands_does_not() -> None:
    t_ns, zeros = T0_NS + np.arange(101, dtype=np.int64) * 10_000_000, np.zeros((101, 3))
    velocity, none = np.array([2.0, -1.0, 3.0]), np.zeros(3)
    thrown = NavState(T0_NS, np.eye(4), velocity, none, none, np.eye(15))
    there = pose_after(thrown, ImuSpan(t_ns, zeros, zeros), GRAVITY_M_S2)
    np.testing.assert_allclose(there[:3, 3], velocity + 0.5 * GRAVITY, atol=1e-9)
    stands = NavState(T0_NS, np.eye(4), none, none, none, np.eye(15))
    np.testing.assert_allclose(
        pose_after(stands, ImuSpan(t_ns, zeros, zeros - GRAVITY), GRAVITY_M_S2), np.eye(4), atol=1e-9
    )
