from dataclasses import replace

import gtsam
import numpy as np
import pytest

from vislam.config import GraphConfig, MachineConfig, WindowConfig
from vislam.core.messages import ImuSpan
from vislam.factors.preintegration import ACCEL_BIAS_WALK_FLOOR, GYRO_BIAS_WALK_FLOOR, Preintegrator
from vislam.graph import PoseGraph
from vislam.imu import ImuNoise
from worlds.lap import EUROC_NOISE, RIG, World, rmse_m
from worlds.parts import MACHINE

SILENT = ImuNoise(1e-12, 1e-12, 1e-12, 1e-12, 200.0)
NO_BIAS = gtsam.imuBias.ConstantBias()


def _preintegrator(**changes: float) -> Preintegrator:
    return Preintegrator(GraphConfig(), EUROC_NOISE, MachineConfig(**changes))


def _whole_span(world: World) -> ImuSpan:
    return ImuSpan(world.imu_t_ns, world.gyro, world.accel)


def _predict(world: World, pim: gtsam.PreintegratedCombinedMeasurementsG, i: int) -> gtsam.NavState:
    return pim.predict(gtsam.NavState(gtsam.Pose3(world.truth[i]), world.velocity[i]), NO_BIAS)


def test_noise_free_motion_is_integrated_to_a_tenth_of_a_millimetre() -> None:
    world = World(2.0, noise=SILENT, gyro_bias=np.zeros(3), accel_bias=np.zeros(3), walk=False)
    done = _preintegrator().integrate(_whole_span(world), 0, world.t_ns(10), NO_BIAS)
    assert done is not None
    state = _predict(world, done.pim, 0)
    assert done.duration_s == pytest.approx(2.0)
    assert np.linalg.norm(state.position() - world.truth[10, :3, 3]) < 1e-4
    assert np.linalg.norm(state.velocity() - world.velocity[10]) < 1e-4


def test_covariance_is_honest() -> None:
    """Mean squared error per degree of freedom of position and velocity over many seconds of noise."""
    d2 = []
    world = World(150.0, keyframe_hz=1.0, gyro_bias=np.zeros(3), accel_bias=np.zeros(3), walk=False, seed=5)
    noise = replace(EUROC_NOISE, gyroscope_random_walk=0.0, accelerometer_random_walk=0.0)  # as in this world
    integrator = Preintegrator(GraphConfig(imu_integration_sigma=1e-6), noise, MACHINE)
    for k in range(1, world.count):
        done = integrator.integrate(world.span(k), world.t_ns(k - 1), world.t_ns(k), NO_BIAS)
        assert done is not None
        state = _predict(world, done.pim, k - 1)
        factor = gtsam.GalileanCombinedImuFactor(1, 2, 3, 4, 5, 6, done.pim)
        e = factor.evaluateError(
            gtsam.Pose3(world.truth[k - 1]), world.velocity[k - 1], gtsam.Pose3(world.truth[k]), world.velocity[k],
            NO_BIAS, NO_BIAS,
        )  # fmt: skip
        covariance = done.pim.residualCovariance()
        d2.append(e[:9] @ np.linalg.solve(covariance[:9, :9], e[:9]) / 9.0)
        assert np.all(np.isfinite(state.position()))
    assert 0.8 < np.mean(d2) < 1.2


def test_outage_is_bridged_and_pays_for_it() -> None:
    world = World(2.0, noise=SILENT, gyro_bias=np.zeros(3), accel_bias=np.zeros(3), walk=False)
    span = _whole_span(world)
    keep = np.abs(span.t_ns - 1_000_000_000) > 250_000_000
    holed = ImuSpan(span.t_ns[keep], span.gyro_rad_s[keep], span.accel_m_s2[keep])
    whole = _preintegrator().integrate(span, 0, world.t_ns(10), NO_BIAS)
    done = _preintegrator().integrate(holed, 0, world.t_ns(10), NO_BIAS)
    assert whole is not None and done is not None
    assert whole.outage_s == 0.0
    assert done.outage_s == pytest.approx(0.51, abs=0.011)
    sigma = np.sqrt(np.linalg.eigvalsh(done.pim.residualCovariance()[6:9, 6:9]))
    assert 1.2 < sigma[0] < 2.0  # m/s along gravity: 3 m/s^2 over half a second
    assert 2.0 < sigma[2] < 10.0  # m/s across: the unmeasured rotation tilts gravity
    assert sigma[0] > 50 * np.sqrt(whole.pim.residualCovariance()[6, 6])
    error = np.linalg.norm(_predict(world, done.pim, 0).velocity() - world.velocity[10])
    assert error < 3 * sigma[2]


def test_uncovered_ends_count_as_outage_and_long_ones_drop_the_factor() -> None:
    world = World(3.0)
    span = _whole_span(world)
    late = span.t_ns >= 400_000_000
    cut = ImuSpan(span.t_ns[late], span.gyro_rad_s[late], span.accel_m_s2[late])
    done = _preintegrator().integrate(cut, 0, world.t_ns(15), NO_BIAS)
    assert done is not None and done.outage_s == pytest.approx(0.4)
    assert done.duration_s == pytest.approx(3.0)
    assert _preintegrator(max_outage_s=0.3).integrate(cut, 0, world.t_ns(15), NO_BIAS) is None
    assert _preintegrator().integrate(None, 0, 1, NO_BIAS) is None
    outside = ImuSpan(span.t_ns[:1], span.gyro_rad_s[:1], span.accel_m_s2[:1])
    assert _preintegrator().integrate(outside, 10**9, 2 * 10**9, NO_BIAS) is None


@pytest.mark.parametrize("imu_hz", [5.0, 20.0])
def test_a_slow_imu_carries_keyframes_where_vision_is_lost_once_its_rate_is_told(imu_hz: float) -> None:
    noise = replace(EUROC_NOISE, rate_hz=imu_hz)
    world = World(12.0, keyframe_hz=1.0, imu_hz=imu_hz, noise=noise)
    packets = [world.packet(k, lost=k in (8, 9)) for k in range(world.count)]
    errors_m, notes = {}, {}
    for rate_hz in (imu_hz, 200.0):
        config = GraphConfig(coupling="loose")
        graph = PoseGraph(config, replace(noise, rate_hz=rate_hz), MACHINE, RIG, WindowConfig())
        graph.initialise(world.initial_state(0.02, 0.15))
        said = [graph.add(packet).note for packet in packets]
        errors_m[rate_hz], notes[rate_hz] = rmse_m(graph.poses(), world.truth), said
    print(errors_m, notes)
    assert not any("IMU" in note and "bridged by IMU" not in note for note in notes[imu_hz])
    if imu_hz < 10.0:  # told a rate that it has not, every sample is an outage
        assert any("IMU" in note for note in notes[200.0])
        assert errors_m[imu_hz] < 0.5 * errors_m[200.0]
    else:
        assert errors_m[imu_hz] == errors_m[200.0]


def test_bias_walk_is_floored_against_gtsams_pivot_test() -> None:
    tiny = ImuNoise(1e-4, 1e-3, 1e-9, 1e-9, 200.0)
    config = GraphConfig()
    integrator = Preintegrator(config, tiny, MACHINE)
    assert integrator.gyroscope_random_walk == GYRO_BIAS_WALK_FLOOR
    assert integrator.accelerometer_random_walk == ACCEL_BIAS_WALK_FLOOR


def test_biases_walk_with_the_root_of_time_that_of_the_accelerometer_first() -> None:
    noise = replace(EUROC_NOISE, gyroscope_random_walk=0.01, accelerometer_random_walk=0.03)
    walked = Preintegrator(GraphConfig(), noise, MACHINE).bias_walk_sigmas(4.0)
    np.testing.assert_allclose(walked, [0.06, 0.06, 0.06, 0.02, 0.02, 0.02])
