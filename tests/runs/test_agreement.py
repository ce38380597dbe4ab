"""Vision against inertial data over steps between keyframes: what is told right agrees, what is told wrong shows."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.core.geometry import so3_exp
from vislam.core.messages import ImuSpan
from vislam.imu import preintegrate
from vislam.runs.verdict import TurnStep, force_agreement, turn_agreement

_G = 9.81
_RATE_HZ = 200.0
_STEP_S = 0.4


def rotation(t_s):
    return so3_exp(np.array([0.5 * np.sin(0.9 * t_s), 0.4 * np.sin(1.3 * t_s + 1.0), 0.8 * np.sin(0.7 * t_s)]))


def position(t_s):
    return np.array([1.5 * np.sin(0.8 * t_s), np.cos(1.1 * t_s), 0.5 * np.sin(1.7 * t_s)])


def sensed(t_s, gyro_bias, accel_bias, accel_scale, rng):
    """One noisy sample of the motion, derivatives by differences that are exact to far below the noise."""
    h = 1e-4
    R = rotation(t_s)
    turn = R.T @ (rotation(t_s + h) - rotation(t_s - h)) / (2.0 * h)
    rate = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
    acceleration = (position(t_s + h) - 2.0 * position(t_s) + position(t_s - h)) / h**2
    force = R.T @ (acceleration + np.array([0.0, 0.0, _G]))
    noise = rng.normal(size=6) * np.repeat([0.002, 0.02], 3)
    return rate + gyro_bias + noise[:3], accel_scale * force + accel_bias + noise[3:]


@pytest.fixture(scope="module")
def steps():
    """Poses of keyframes and inertial spans between them, without biases and with a scale."""

    def make(accel_scale=1.0, count=50):
        rng = np.random.default_rng(3)
        spans, poses = [], []
        for k in range(count):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation(k * _STEP_S), position(k * _STEP_S) + rng.normal(size=3) * 0.002
            poses.append(T)
            t_s = (k - 1) * _STEP_S + np.arange(round(_STEP_S * _RATE_HZ) + 1) / _RATE_HZ
            values = [
                sensed(t, np.array([0.01, -0.02, 0.03]), np.array([0.05, 0.1, -0.1]), accel_scale, rng) for t in t_s
            ]
            gyro, accel = (np.array(part) for part in zip(*values, strict=True))
            spans.append(ImuSpan(np.round(t_s * 1e9).astype(np.int64), gyro, accel))
        return np.array(poses), spans[1:]

    return make


def seen_turns(poses, spans, mount=(0.0, 0.0, 0.0), scale=1.0):
    """What a camera sees that stands otherwise on the body than told, or whose focal length is off."""
    M, rng = so3_exp(np.asarray(mount)), np.random.default_rng(4)
    for a, b, span in zip(poses[:-1], poses[1:], spans, strict=True):
        turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec() * scale + rng.normal(size=3) * 0.001
        yield TurnStep(preintegrate(span), np.ascontiguousarray(M @ so3_exp(turn) @ M.T))


def test_turns_of_a_right_calibration_agree_whatever_the_bias(steps):
    found = turn_agreement(list(seen_turns(*steps())))
    assert abs(found.scale_error) < 3.5 * found.scale_sigma < 0.01


def test_a_wrong_focal_length_shows_as_turns_that_are_too_large(steps):
    found = turn_agreement(list(seen_turns(*steps(), scale=1.02)))
    assert found.scale_error == pytest.approx(0.02, abs=3.5 * found.scale_sigma)
    assert found.scale_sigma < 0.003


def test_a_turned_camera_is_not_taken_for_a_wrong_focal_length(steps):
    found = turn_agreement(list(seen_turns(*steps(), mount=np.deg2rad([2.0, -1.0, 2.0]))))
    assert abs(found.scale_error) < 3.5 * found.scale_sigma


def test_a_body_that_does_not_turn_says_nothing_of_focal_length(steps):
    _, spans = steps()
    rng = np.random.default_rng(8)
    still = [replace(span, gyro_rad_s=0.01 + rng.normal(size=span.gyro_rad_s.shape) * 0.05) for span in spans]
    turns = [TurnStep(preintegrate(span), so3_exp(rng.normal(size=3) * 1e-4)) for span in still]
    found = turn_agreement(turns)
    assert found.scale_sigma > 0.2


def test_outlying_turns_do_not_decide(steps):
    turns = list(seen_turns(*steps()))
    turns[::9] = [replace(turn, R_seen=turn.R_seen @ so3_exp(np.array([0.2, 0.1, 0.0]))) for turn in turns[::9]]
    found = turn_agreement(turns)
    assert abs(found.scale_error) < 4.0 * found.scale_sigma


def test_a_gyro_axis_that_stands_still_for_a_third_of_the_way_shows_in_the_worst_turns(steps):
    poses, spans = steps()
    sound = turn_agreement(list(seen_turns(poses, spans)))
    assert sound.worst_rad < np.deg2rad(0.5)
    spans[33:] = [replace(s, gyro_rad_s=s.gyro_rad_s * [1.0, 1.0, 0.0]) for s in spans[33:]]
    found = turn_agreement(list(seen_turns(poses, spans)))
    assert found.worst_rad > np.deg2rad(3.0)
    assert abs(found.scale_error) < 4.0 * found.scale_sigma  # while most turns agree


def forces(poses, spans):
    bias = np.array([0.01, -0.02, 0.03])
    inertial = [preintegrate(span, gyro_bias_rad_s=bias) for span in spans]
    return force_agreement(poses, inertial, _G, 0.2)


def test_scale_and_gravity_of_a_right_trajectory_are_found_beside_the_bias(steps):
    found = forces(*steps())
    assert found.scale == pytest.approx(1.0, abs=3.5 * found.scale_sigma)
    assert found.gravity_m_s2 == pytest.approx(_G, abs=3.5 * found.gravity_sigma_m_s2)
    assert found.scale_sigma < 0.01
    assert found.tilt_deg < 0.5


def test_metres_that_are_too_short_show_in_the_scale_alone(steps):
    poses, spans = steps()
    poses[:, :3, 3] /= 1.05
    found = forces(poses, spans)
    assert found.scale == pytest.approx(1.05, abs=4.0 * found.scale_sigma)
    assert found.gravity_m_s2 == pytest.approx(_G, abs=0.1)


def test_an_accelerometer_that_reads_too_much_shows_in_scale_and_gravity(steps):
    found = forces(*steps(accel_scale=1.05))
    assert found.scale == pytest.approx(1.05, abs=4.0 * found.scale_sigma)
    assert found.gravity_m_s2 == pytest.approx(1.05 * _G, abs=0.1)


def test_too_few_steps_say_nothing(steps):
    poses, spans = steps(count=8)
    assert turn_agreement(list(seen_turns(poses, spans))) is None
    assert forces(poses, spans) is None


def test_holes_are_left_out(steps):
    poses, spans = steps()
    inertial = [preintegrate(span, gyro_bias_rad_s=np.array([0.01, -0.02, 0.03])) for span in spans]
    holey = [None if k % 10 == 0 else piece for k, piece in enumerate(inertial)]
    found = force_agreement(poses, holey, _G, 0.2)
    assert found.steps < len(spans) - 8
    assert found.scale == pytest.approx(1.0, abs=3.5 * found.scale_sigma)
