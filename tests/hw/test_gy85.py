"""The whole board through the real smbus2: calibrated samples at the right times, and the wiring of its axes."""

import numpy as np
import pytest

from vislam.config import Gy85Config, PowerUpConfig, SensorCalibration
from vislam.core.errors import HardwareError, UsageError
from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import ImuSample, ImuSpan
from vislam.hw.gy85 import Gy85
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.hw.timing import SampleClock
from vislam.imu import NoiseFloor, PowerUp, Refusal, power_up
from worlds.gy85 import FIELD_UT, board, collect, driving, errors, still


@pytest.mark.parametrize("rate_error", [-0.02, 0.0, 0.02])
@pytest.mark.parametrize("adapter", ["full", "one_read", "smbus_only"])
def test_samples_are_the_truth_at_their_own_stamps(rate_error: float, adapter: str) -> None:
    kind = {} if adapter == "full" else {adapter: True}
    with board(grade="exact", rate_error=rate_error, magnetometer="none", **kind) as parts:
        driver, _, clock = parts
        source: InertialSource = driver
        inertial, _ = collect(driver, clock, 6.0)
        assert source.rate_hz == 400.0
        gyro, accel = errors(inertial[400:])  # a second for the chip's clock
        assert len(inertial) == pytest.approx(2400, abs=30)
        steps = np.diff([s.t_ns for s in inertial])
        assert abs(steps - 2_500_000).max() < 600_000
        # 1.2 mrad/s is one count; the accelerometer's is 0.038 m/s^2, and 1 ms of its fastest motion 0.003
        assert abs(gyro).max() < 0.0025
        assert abs(gyro).mean() < 5e-4
        assert abs(accel).max() < 0.026
        assert abs(accel.mean(axis=0)).max() < 1e-3
        assert driver.health() == Health.MAG_FAULT
        assert driver.counters() == {}


def test_a_sample_is_given_out_in_the_round_that_captured_it() -> None:
    with board(magnetometer="none") as (driver, _, clock):
        collect(driver, clock, 1.0)
        ages_ms = []
        for _ in range(400):
            samples = driver.read(0.1)
            assert len(samples) == 1
            ages_ms.append((clock.now_ns() - samples[0].t_ns) * 1e-6)
        assert max(ages_ms) < 4.5, "filter delay 3.3 ms and the transfers"


def test_every_chip_lies_as_its_axes_say() -> None:
    calibration = SensorCalibration(
        gyro_axes=("-y", "x", "z"), accel_axes=("z", "-x", "-y"), mag_axes=("-x", "-z", "-y")
    )
    config = Gy85Config(self_test=False, calibration=calibration)
    with board(config=config, grade="exact") as (driver, virtual, clock):
        inertial, magnetic = collect(driver, clock, 3.0)
        gyro, accel = errors(inertial)
        assert abs(gyro).mean() < 6e-4
        assert abs(accel).mean() < 0.02
        np.testing.assert_allclose(np.mean([m.field_ut for m in magnetic], axis=0), FIELD_UT, atol=0.1)
        raw = np.frombuffer(bytes(virtual.chips[0x53].registers[0x32:0x38]), dtype="<i2")
        assert raw[1] < -200, "gravity is on the chip's y axis in this test"


def test_axes_that_name_one_twice_are_refused() -> None:
    config = Gy85Config(calibration=SensorCalibration(gyro_axes=("x", "x", "z")))
    with pytest.raises(HardwareError, match="twice"), board(config=config):
        pass


def test_calibration_undoes_the_errors_of_a_raw_board() -> None:
    with board(truth=driving, grade="raw", magnetometer="none") as (_, virtual, _):
        gyro_error, accel_error = virtual.chips[0x68].error, virtual.chips[0x53].error

    def inverse(error):  # type: ignore[no-untyped-def]
        matrix = error.matrix()
        at_30_c = np.array(error.bias) + 5.0 * np.array(error.bias_per_c)
        return tuple(at_30_c.tolist()), tuple(map(tuple, np.linalg.inv(matrix).tolist()))

    (gyro_bias, gyro_matrix), (accel_bias, accel_matrix) = inverse(gyro_error), inverse(accel_error)
    calibration = SensorCalibration(
        gyro_bias_rad_s=gyro_bias, gyro_matrix=gyro_matrix, accel_bias_m_s2=accel_bias, accel_matrix=accel_matrix
    )
    worst = []
    for chosen in (SensorCalibration(), calibration):
        config = Gy85Config(self_test=False, calibration=chosen)
        with board(config=config, grade="raw", magnetometer="none") as (driver, _, clock):
            gyro, accel = errors(collect(driver, clock, 5.0)[0])
            worst.append((abs(gyro.mean(axis=0)).max(), abs(accel.mean(axis=0)).max()))
    assert worst[0][0] > 0.04
    assert worst[0][1] > 0.3
    assert worst[1][0] < 1e-3, "noise of the mean, and the walk of the bias"
    assert worst[1][1] < 5e-3


def test_noise_comes_through_with_the_density_of_the_data_sheets() -> None:
    model = ImuNoise(np.deg2rad(0.03), 9.80665 / 256 / np.sqrt(50.0) * 0.87, 0.0, 0.0, 400.0)
    with board(truth=still, magnetometer="none") as (driver, _, clock):
        envelope = NoiseFloor(model)
        inertial, _ = collect(driver, clock, 12.0)
        for sample in inertial:
            envelope.add(sample)
    means = np.array([s.gyro_rad_s for s in inertial])[: 23 * 200].reshape(23, 200, 3).mean(axis=1)
    density = means.std(axis=0).mean() * np.sqrt(0.5)  # of averages over half a second
    # a data sheet counts noise over positive frequencies, filters over both signs: sqrt(2) between them
    assert density * np.sqrt(2.0) == pytest.approx(np.deg2rad(0.03), rel=0.3)
    ratios = envelope.ratios
    assert ratios is not None
    assert 0.4 < ratios.gyro_typical < 1.2  # the filter takes out what is above 98 Hz
    assert 0.5 < ratios.accel_typical < 1.3


def test_self_tests_run_at_the_start_and_disturb_nothing() -> None:
    with board(truth=still, config=Gy85Config()) as (driver, _, clock):
        assert [(t.chip, t.passed) for t in driver.self_tests] == [("ADXL345", True), ("HMC5883L", True)]
        inertial, _ = collect(driver, clock, 2.0)
        assert len(inertial) > 780
        assert driver.health() == Health(0)
        assert driver.counters() == {}


def test_a_board_that_is_not_there_is_an_error_that_says_what_to_do() -> None:
    with pytest.raises(HardwareError, match="vislam doctor") as missing:
        Gy85(Gy85Config(bus="/dev/i2c-absent"))
    assert missing.value.exit_code == 5
    with board(must_be_there=False) as (driver, virtual, clock):
        virtual.chips.clear()
        assert driver.health() is not None
        with pytest.raises(HardwareError, match="0x68"):
            Gy85(Gy85Config(bus=virtual.path), clock)


def test_the_clock_of_a_chip_is_followed_through_jitter() -> None:
    rng = np.random.default_rng(5)
    for true_hz in (392.0, 400.0, 408.0):
        fit = SampleClock(400.0)
        done, worst = 0, 0.0
        t_s = 0.0
        for k in range(8000):
            t_s += 0.0025 + (rng.exponential(0.002) if rng.random() < 0.05 else 0.0)
            there = int(t_s * true_hz)
            if there == done:
                continue
            answered_ns = round(t_s * 1e9) + round(rng.exponential(2e5))
            newest = fit.stamps(there - done, round(t_s * 1e9), answered_ns)[-1]
            done = there
            if k > 2000:
                worst = max(worst, abs(newest * 1e-9 - there / true_hz))
        assert worst < 1.3e-3, "half a period where questions keep step with the samples, less elsewhere"
        assert fit.rate_hz == pytest.approx(true_hz, rel=2e-3)


@pytest.mark.parametrize(("accel_rate_hz", "rate_hz"), [(100, 400.0), (200, 100.0), (800, 400.0), (800, 50.0)])
def test_the_chips_need_not_sample_alike(accel_rate_hz: int, rate_hz: float) -> None:
    config = Gy85Config(self_test=False, accel_rate_hz=accel_rate_hz, rate_hz=rate_hz, mag=False)
    with board(config=config, grade="exact") as (driver, _, clock):
        inertial, _ = collect(driver, clock, 3.0)
        gyro, accel = errors(inertial[len(inertial) // 3 :])
        assert len(inertial) == pytest.approx(3.0 * rate_hz, abs=0.03 * rate_hz + 12)
        assert abs(gyro).max() < 0.0025
        assert abs(accel).max() < 0.021 + 1.6 / accel_rate_hz, "a count, and half a period of the fastest motion"
        assert driver.health() == Health(0)
        assert driver.counters() == {}


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), 5000.0])
def test_a_rate_that_cannot_be_is_refused(rate_hz: float) -> None:
    with pytest.raises(UsageError, match="rate_hz must be 1 to 1000"), board(config=Gy85Config(rate_hz=rate_hz)):
        pass


def test_power_up_on_the_board_as_on_the_cart() -> None:
    def begins_to_turn(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 0.5 if t_ns > 1_004_000_000_000 else 0.0), (0.17, -0.34, 9.80185), tuple(FIELD_UT), 30.0

    def span(samples: list[ImuSample]) -> ImuSpan:
        t_ns = np.array([s.t_ns for s in samples], dtype=np.int64)
        return ImuSpan(t_ns, np.array([s.gyro_rad_s for s in samples]), np.array([s.accel_m_s2 for s in samples]))

    with board(truth=begins_to_turn) as (driver, virtual, clock):
        error = virtual.chips[0x68].error
        bias = np.array(error.bias) + 5.0 * np.array(error.bias_per_c)
        standing, _ = collect(driver, clock, 3.0)
        found = power_up(span(standing), PowerUpConfig(), 9.81, driver.temperature_c)
        assert isinstance(found, PowerUp)
        np.testing.assert_allclose(found.gyro_bias_rad_s, bias, atol=1.5e-3)
        np.testing.assert_allclose(found.R_level_body @ [0.17, -0.34, 9.80185], [0.0, 0.0, 9.81], atol=0.1)
        assert found.temperature_c == pytest.approx(30.0, abs=0.1)
        collect(driver, clock, 0.5)
        turning, _ = collect(driver, clock, 2.0)
        refused = power_up(span(turning), PowerUpConfig(), 9.81, driver.temperature_c)
        assert isinstance(refused, Refusal)
        assert "rad/s" in refused.reason
