import numpy as np
import pytest

from vislam.core.errors import UsageError
from vislam.core.geometry import se3_log, so3_exp, so3_log, transform
from vislam.sim import WORLD_NAMES, open_world
from vislam.sim.motion.path import Travel, rounded_path
from vislam.sim.motion.spline import BodySpline


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_derivatives_match_finite_differences(name):
    spline = open_world(name).spline
    t = np.random.default_rng(1).uniform(0.1, spline.duration_s - 0.1, 200)
    h = 1e-4
    before, at, after = spline.at(t - h), spline.at(t), spline.at(t + h)
    velocity = (after.T_world_body[:, :3, 3] - before.T_world_body[:, :3, 3]) / (2.0 * h)
    acceleration = (after.velocity_world_m_s - before.velocity_world_m_s) / (2.0 * h)
    pairs = zip(before.T_world_body, after.T_world_body, strict=True)
    rate = np.array([so3_log(a[:3, :3].T @ b[:3, :3]) for a, b in pairs]) / (2.0 * h)
    np.testing.assert_allclose(at.velocity_world_m_s, velocity, atol=2e-6)
    np.testing.assert_allclose(at.acceleration_world_m_s2, acceleration, atol=2e-5)
    np.testing.assert_allclose(at.rate_body_rad_s, rate, atol=2e-6)


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_exact_imu_samples_integrate_to_the_true_pose(name):
    world = open_world(name, imu_noise=False)
    stamps = world.dense_truth().t_ns
    seconds = 20.0
    count = int(seconds * world.imu_noise.rate_hz) // 2 * 2
    start = count // 4 // 2 * 2  # begins in motion
    record, states = world._imu, world.true_states(stamps)
    gravity = np.array([0.0, 0.0, -9.81])
    R, p, v = states.T_world_body[start, :3, :3], states.T_world_body[start, :3, 3], states.velocity_world_m_s[start]
    dt = 2.0 / world.imu_noise.rate_hz
    for k in range(start, start + count, 2):  # Simpson over pairs of samples, rotation by a Magnus step of fourth order
        w0, wm, w1 = record.gyro_rad_s[k : k + 3]
        f0, fm, f1 = record.accel_m_s2[k : k + 3]
        R_mid = R @ so3_exp(dt / 24.0 * (5.0 * w0 + 8.0 * wm - w1) + dt * dt / 48.0 * np.cross(w0, wm))
        R_end = R @ so3_exp(dt / 6.0 * (w0 + 4.0 * wm + w1) + dt * dt / 12.0 * np.cross(w0, w1))
        a0, am, a1 = R @ f0 + gravity, R_mid @ fm + gravity, R_end @ f1 + gravity
        p = p + dt * v + dt * dt / 6.0 * (a0 + 2.0 * am)
        v = v + dt / 6.0 * (a0 + 4.0 * am + a1)
        R = R_end
    end = states.T_world_body[start + count]
    error = se3_log(np.linalg.inv(end) @ transform(R, p))
    assert np.linalg.norm(error[3:]) < 1e-3
    assert np.linalg.norm(error[:3]) < 1e-5


def test_a_body_whose_control_points_stand_still_is_exactly_at_rest():
    positions, angles = np.tile([1.0, -2.0, 0.5], (12, 1)), np.tile([0.1, -0.2, 3.0], (12, 1))
    positions[9:, 0] += 1.0  # moves only at the end
    motion = BodySpline(positions, angles, 0.1).at(np.linspace(0.0, 0.35, 8))
    assert np.abs(motion.velocity_world_m_s).max() < 1e-12
    assert np.abs(motion.rate_body_rad_s).max() < 1e-12
    np.testing.assert_allclose(motion.T_world_body[:, :3, 3], np.tile([1.0, -2.0, 0.5], (8, 1)), atol=1e-12)


def test_acceleration_is_smooth():
    rng = np.random.default_rng(7)
    spline = BodySpline(rng.normal(0.0, 1.0, (30, 3)), rng.normal(0.0, 0.3, (30, 3)), 0.2)
    h = 1e-5
    knots = np.arange(1, 20) * 0.2
    jump = spline.at(knots + h).acceleration_world_m_s2 - spline.at(knots - h).acceleration_world_m_s2
    jerk = np.abs(np.diff(spline.at(np.linspace(0.5, 4.5, 4000)).acceleration_world_m_s2, axis=0)).max() / 0.001
    assert np.abs(jump).max() < 2.0 * h * jerk * 1.1


@pytest.mark.parametrize(
    ("positions", "angles", "spacing", "part"),
    [
        (np.zeros((5, 3)), np.zeros((5, 3)), 0.1, "at least 6"),
        (np.full((8, 3), np.nan), np.zeros((8, 3)), 0.1, "finite"),
        (np.zeros((8, 3)), np.zeros((7, 3)), 0.1, "as many angles"),
        (np.zeros((8, 3)), np.zeros((8, 3)), 0.0, "spacing"),
        (np.zeros((8, 3)), np.full((8, 3), 1.5), 0.1, "pitch"),
    ],
)
def test_bad_control_points_are_refused(positions, angles, spacing, part):
    with pytest.raises(UsageError, match=part):
        BodySpline(positions, angles, spacing)


def test_times_outside_are_refused_and_rounding_is_not():
    spline = BodySpline(np.zeros((8, 3)), np.zeros((8, 3)), 0.1)
    assert spline.duration_s == pytest.approx(0.3)
    spline.at(np.array([-1e-9, 0.3 + 1e-9]))
    for t in (-0.01, 0.31, np.nan):
        with pytest.raises(UsageError, match="outside"):
            spline.at(np.array([t]))


def test_rounded_path_has_arcs_of_the_radius_and_the_right_length():
    path = rounded_path([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0)], 1.0)
    assert path.length_m == pytest.approx(3.0 + 2.0 + np.pi / 2.0, abs=2e-3)
    curvature = np.gradient(path.heading_rad, path.arc_m)
    inside = (path.arc_m > 3.1) & (path.arc_m < 3.0 + np.pi / 2.0 - 0.1)
    np.testing.assert_allclose(curvature[inside], 1.0, atol=0.02)
    assert path.heading_rad[-1] == pytest.approx(np.pi / 2.0, abs=1e-6)
    with pytest.raises(UsageError, match="too close"):
        rounded_path([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (2.0, 1.0)], 0.8)


def test_travel_rests_pauses_and_arrives():
    travel = Travel(10.0, 1.0, 1.0, 2.0, 1.5, stops_m=(4.0,), pause_s=3.0)
    t = np.linspace(0.0, travel.duration_s, 5000)
    arc = travel.arc_m(t)
    speed = np.gradient(arc, t)
    assert travel.duration_s == pytest.approx(2.0 + 5.0 + 3.0 + 7.0 + 1.5)
    assert np.all(np.diff(arc) >= -1e-12)
    assert arc[-1] == pytest.approx(10.0)
    assert speed.max() == pytest.approx(1.0, abs=1e-3)
    assert np.all(arc[t < 2.0] == 0.0)
    np.testing.assert_allclose(arc[(t > 7.01) & (t < 9.99)], 4.0, atol=1e-9)
