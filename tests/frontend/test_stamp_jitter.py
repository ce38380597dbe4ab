"""Jitter of stamps: seen by their unevenness, decided by the gyroscope, and in the noise of what vision says."""

import numpy as np
import pytest

from vislam.config import InitConfig
from vislam.core import Frame, ImuSpan, NavState, Tracking, VoMeasurement, so3_exp, transform
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.stamp_jitter import StampJitter

PERIOD_S = 0.05
STEP_NS = 1_000_000
FRAMES = 300
VISION_RAD = 3e-4


def seen(taken_s, stamp_s, sigma_rad=VISION_RAD, keyframe_every=10):
    """Yield stamps, motions since keyframes, and samples since the frame before, of a body that turns."""
    rng = np.random.default_rng(3)
    t_ns = np.arange(0, round(1e9 * (max(taken_s.max(), stamp_s.max()) + 0.1)), STEP_NS)
    t = t_ns * 1e-9
    gyro = np.column_stack([0.3 * np.sin(2.0 * t), 0.2 * np.cos(1.3 * t), 0.8 * np.sin(0.7 * t)])
    R = [np.eye(3)]
    for rates in 0.5 * (gyro[1:] + gyro[:-1]):
        R.append(R[-1] @ so3_exp(1e-9 * STEP_NS * rates))
    bodies = [R[round(s * 1e3)] @ so3_exp(rng.normal(0.0, sigma_rad, 3)) for s in taken_s]
    for k in range(1, len(taken_s)):
        key = (k - 1) // keyframe_every * keyframe_every
        T = transform(bodies[key].T @ bodies[k], np.zeros(3))
        now_ns, last_ns = round(stamp_s[k] * 1e3) * STEP_NS, round(stamp_s[k - 1] * 1e3) * STEP_NS
        inside = (t_ns >= last_ns) & (t_ns <= now_ns)
        span = ImuSpan(t_ns[inside], gyro[inside], np.zeros((inside.sum(), 3)))
        yield VoMeasurement(now_ns, key, T, np.eye(6) * 1e-8, True, Tracking.OK, 100), span


def found_ms(taken_s, stamp_s, **options):
    jitter = StampJitter()
    jitter.stamp(round(stamp_s[0] * 1e9))
    for vo, span in seen(taken_s, stamp_s, **options):
        jitter.stamp(vo.t_ns)
        jitter.see(vo, span, np.zeros(3))
    return 1e3 * jitter.sigma_s


def even(frames=FRAMES):
    return 0.05 + PERIOD_S * np.arange(frames)


def uneven(sigma_s, frames=FRAMES):
    return np.random.default_rng(1).normal(0.0, sigma_s, frames)


@pytest.mark.parametrize("sigma_s", [0.002, 0.005])
def test_a_jitter_is_found(sigma_s):
    assert found_ms(even(), even() + uneven(sigma_s)) == pytest.approx(1e3 * sigma_s, rel=0.25)


def test_even_stamps_have_none():
    assert found_ms(even(), even()) == 0.0


def test_frames_that_are_missing_are_no_jitter():
    there = np.random.default_rng(2).random(FRAMES) > 0.4
    assert found_ms(even()[there], even()[there]) == 0.0


def test_images_that_are_taken_unevenly_and_say_so_have_little():
    taken_s = even() + uneven(0.004)
    assert found_ms(taken_s, taken_s) < 1.5


def test_without_turns_the_stamps_decide():
    assert found_ms(even(40), even(40) + uneven(0.002, 40), sigma_rad=0.5) == pytest.approx(2.0, rel=0.5)


def test_jitter_is_noise_along_the_motion_of_both_ends():
    clock = CameraClock(InitConfig())
    stamp_s = even(60) + uneven(0.002, 60)
    state = NavState.with_sigmas(0, np.eye(4), (0.01, 0.01), velocity_world_m_s=(1.5, 0.0, 0.0))
    image = np.zeros((4, 4), np.uint8)
    for index, (vo, span) in enumerate(seen(even(60), stamp_s)):
        clock.in_imu_time(Frame(vo.t_ns, index, (image,)))
        jittered = clock.jittered(vo, span, state)
        if vo.t_ns > 0.5 * PERIOD_S * 60 * 1e9 and index % 10 == 0:
            clock.took_keyframe()
    more = np.diag(jittered.covariance - vo.covariance)
    assert more[3] == pytest.approx(2.0 * (1.5 * clock.jitter_s) ** 2, rel=0.1)
    assert more[4] < 0.1 * more[3]
    rate = span.gyro_rad_s.mean(axis=0)
    assert more[:3].sum() == pytest.approx(2.0 * (np.linalg.norm(rate) * clock.jitter_s) ** 2, rel=0.5)
    assert clock.jittered(vo, None, None).covariance == pytest.approx(vo.covariance, abs=1e-5)
