"""What a filter knows of a cart: its axle goes neither sideways nor up, and its floor is level."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from vislam.config import EkfConfig, MachineConfig
from vislam.core.geometry import invert, so3_exp, transform
from vislam.core.messages import Array, ImuSample, NavState, NoiseScale, Observations, Tracking, VoMeasurement
from vislam.ekf import Correction, Ekf
from vislam.ekf.loose import kernels
from vislam.ekf.loose.measurements import on_wheels
from vislam.imu import ImuNoise, SeenNoise

NOISE = ImuNoise(5e-4, 6e-3, 3e-5, 4e-4, 200.0)
GRAVITY_M_S2 = 9.81
AXLE_M = np.array([-0.3, 0.05, -0.1])
SPEED_M_S, TURN_RAD_S = 0.8, 0.3
CART = MachineConfig(slip_sigma_m_s=0.02, axle_m=(-0.3, 0.05, -0.1))


def perturbed(x: Array, d: Array) -> Array:
    y = x.copy()
    y[:3], y[3:6] = x[:3] + d[3:6], x[3:6] + d[6:9]
    kernels.turn(y, 6, *d[:3])
    y[13:16], y[10:13] = x[13:16] + d[9:12], x[10:13] + d[12:15]
    return y


def test_derivatives_are_those_of_the_axle_s_velocity() -> None:
    rng = np.random.default_rng(3)
    x = np.zeros(kernels.NOMINAL)
    x[6] = x[19] = 1.0
    x = perturbed(x, rng.normal(0.0, 0.3, 15))
    gyro = rng.normal(0.0, 0.5, 3)
    measured = on_wheels(x, gyro, AXLE_M, 0.02, 0.1, 0.01)
    assert measured.H.shape == (3, kernels.ERRORS) and on_wheels(x, gyro, AXLE_M, 0.02, 0.1, 0.0).H.shape[0] == 2
    h = 1e-6
    for k in range(15):
        d = h * np.eye(15)[k]
        ahead, behind = (on_wheels(perturbed(x, s * d), gyro, AXLE_M, 0.02, 0.1, 0.01).residual for s in (1, -1))
        assert np.allclose(measured.H[:, k], (behind - ahead) / (2 * h), atol=1e-6)


def cart(t_s: float) -> tuple[Array, Array, Array, Array]:
    """Pose, velocity, rate and specific force of the body of a cart that drives in a circle about its axle's centre."""
    R = np.asarray(so3_exp(np.array([0.0, 0.0, TURN_RAD_S * t_s])))
    radius = SPEED_M_S / TURN_RAD_S
    axle = radius * np.array([np.sin(TURN_RAD_S * t_s), 1.0 - np.cos(TURN_RAD_S * t_s), 0.0])
    rate = np.array([0.0, 0.0, TURN_RAD_S])
    lever = -AXLE_M
    velocity = R @ (np.array([SPEED_M_S, 0.0, 0.0]) + np.cross(rate, lever))
    force = np.array([0.0, SPEED_M_S * TURN_RAD_S, GRAVITY_M_S2]) + np.cross(rate, np.cross(rate, lever))
    return transform(R, axle + R @ lever), velocity, rate, force


def drive(machine: MachineConfig, seed: int, seconds: float = 12.0) -> tuple[Ekf, NavState]:
    """Let a filter that has no vision follow a cart."""
    rng = np.random.default_rng(seed)
    ekf = Ekf(EkfConfig(), NOISE, machine)
    T, velocity, _, _ = cart(0.0)
    sigmas = np.repeat([0.005, 1e-3, 0.02, 5e-4, 0.03], 3)
    sigmas[2] = 1e-4
    off = rng.normal(0.0, sigmas)
    bias_gyro, bias_accel = off[9:12], off[12:15]
    start = transform(T[:3, :3] @ so3_exp(off[:3]), T[:3, 3])
    ekf.initialise(NavState(0, start, velocity + off[6:9], np.zeros(3), np.zeros(3), np.diag(sigmas**2)))
    for k in range(round(seconds * NOISE.rate_hz) + 1):
        _, _, rate, force = cart(k / NOISE.rate_hz)
        white = np.sqrt(NOISE.rate_hz) * rng.normal(0.0, np.repeat([5e-4, 6e-3], 3))
        t_ns = round(k * 1e9 / NOISE.rate_hz)
        ekf.predict(ImuSample(t_ns, rate + bias_gyro + white[:3], force + bias_accel + white[3:]))
        if machine.slip_sigma_m_s is not None and k % 20 == 0:
            ekf.update_nonholonomic(t_ns)
    return ekf, ekf.state()


def error(state: NavState, seconds: float = 12.0) -> float:
    return float(np.linalg.norm(state.T_world_body[:3, 3] - cart(seconds)[0][:3, 3]))


def test_wheels_hold_the_drift_without_vision() -> None:
    free, wheels, floor = [], [], []
    for seed in range(3):
        free.append(error(drive(replace(CART, slip_sigma_m_s=None), seed)[1]))
        ekf, state = drive(CART, seed)
        wheels.append(error(state))
        assert ekf.counters["nonholonomic_accepted"] > 100
        on_floor = drive(replace(CART, floor_sigma_m=0.005), seed)[1]
        floor.append(abs(on_floor.T_world_body[2, 3] - cart(12.0)[0][2, 3]))
    print(f"12 s without vision: {np.mean(free):.2f} m alone, {np.mean(wheels):.2f} m on wheels")
    assert np.mean(wheels) < 0.6 * np.mean(free) and max(floor) < 0.02


def test_the_filter_on_wheels_knows_its_error() -> None:
    nees = []
    for seed in range(10):
        _, state = drive(CART, seed, 6.0)
        e = state.T_world_body[:3, 3] - cart(6.0)[0][:3, 3]
        nees.append(e @ np.linalg.solve(state.covariance[3:6, 3:6], e))
    assert 1.5 < np.mean(nees) < 5.0  # 3; exact wheels are better than the slip that is assumed


def test_a_cart_that_is_carried_sideways_is_gated() -> None:
    ekf, state = drive(CART, 1, 3.0)
    moved = replace(state, velocity_world_m_s=state.velocity_world_m_s + state.T_world_body[:3, 1])
    ekf.initialise(moved)
    answer = ekf.update_nonholonomic(state.t_ns)
    assert not answer.accepted and "innovation" in answer.reason and ekf.counters["nonholonomic_gated"] == 1


def exactly_known() -> tuple[Ekf, Array, Array]:
    """Return a filter at the true state, and the rate and force that a cart in its turn always has."""
    ekf = Ekf(EkfConfig(), NOISE, CART)
    T, velocity, rate, force = cart(0.0)
    ekf.initialise(NavState(0, T, velocity, np.zeros(3), np.zeros(3), np.eye(15) * 1e-4))
    return ekf, rate, force


def test_late_wheels_are_the_same_as_in_time() -> None:
    states = []
    for late in (False, True):
        ekf, rate, force = exactly_known()
        for k in range(101):
            t_ns = k * 5_000_000
            ekf.predict(ImuSample(t_ns, rate, force))
            if not late and k == 60:
                ekf.update_nonholonomic(t_ns)
        if late:
            ekf.update_nonholonomic(60 * 5_000_000)
        states.append(ekf.state())
    assert states[0].T_world_body == pytest.approx(states[1].T_world_body, abs=1e-12)
    assert states[0].covariance == pytest.approx(states[1].covariance, abs=1e-12)


def test_noise_that_is_told_late_counts_from_when_it_began() -> None:
    states = []
    for late in (False, True):
        ekf, rate, force = exactly_known()
        for k in range(201):
            ekf.predict(ImuSample(k * 5_000_000, rate, force))
            if k == (160 if late else 60):
                ekf.follow_noise(60 * 5_000_000, NoiseScale(3.0, 20.0))
            if k == 180:
                ekf.follow_noise(180 * 5_000_000, NoiseScale(1.0, 1.0))
        assert ekf.counters["noise_changes"] == 2
        states.append(ekf)
    told, again = states[0].state(), states[1].state()
    assert told.covariance == pytest.approx(again.covariance, rel=1e-9, abs=1e-15)
    assert told.T_world_body == pytest.approx(again.T_world_body, abs=1e-12)
    calm, rate, force = exactly_known()
    for k in range(201):
        calm.predict(ImuSample(k * 5_000_000, rate, force))
    at = [60 * 5_000_000, 180 * 5_000_000]
    (before, after), (plain, calmer) = ([ekf.state_at(t) for t in at] for ekf in (states[1], calm))
    assert before is not None and after is not None and plain is not None and calmer is not None
    assert before.covariance == pytest.approx(plain.covariance, rel=1e-9, abs=1e-15)
    grown = np.diag(after.covariance - before.covariance) - np.diag(calmer.covariance - plain.covariance)
    assert grown[6] == pytest.approx(0.6 * NOISE.accelerometer_noise_density**2 * (20.0**2 - 1.0), rel=0.05)
    assert grown[2] == pytest.approx(0.6 * NOISE.gyroscope_noise_density**2 * (3.0**2 - 1.0), rel=0.05)


def test_noise_that_is_no_number_is_refused() -> None:
    ekf, _ = drive(CART, 1, 0.5)
    for gyro, accel in ((np.nan, 1.0), (1.0, 0.0), (-1.0, 1.0)):
        assert not ekf.follow_noise(ekf.state().t_ns, NoiseScale(gyro, accel)).accepted
    assert ekf.counters["noise_invalid"] == 3 and ekf.counters["noise_changes"] == 0


def test_a_correction_takes_the_noise_along_to_another_process() -> None:
    vo = VoMeasurement(60 * 5_000_000, 0, invert(cart(0.0)[0]) @ cart(0.3)[0], np.eye(6) * 1e-4, True, Tracking.OK, 50)
    nothing = Observations(np.empty(0, dtype=np.int64), np.empty((0, 2)))
    told = Correction(vo.t_ns, vo, nothing, False, False, None, noise=SeenNoise(20 * 5_000_000, NoiseScale(1.5, 7.6)))
    ekf = drive(CART, 1, 0.5)[0]
    ekf.add_keyframe(0, 0)
    answer = pickle.loads(pickle.dumps(told)).apply(ekf)  # noqa: S301
    assert answer.accepted and ekf.counters["noise_changes"] == 1
