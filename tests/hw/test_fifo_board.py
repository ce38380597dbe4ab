"""Every board with a FIFO through the real smbus2: samples at the right times, and whatever wires and plugs do."""

import numpy as np
import pytest

from vislam.config import BoardConfig, SensorCalibration
from vislam.core.errors import HardwareError, UsageError
from vislam.hw.emulator import SteppedClock, emulated_bus, emulated_gy85
from vislam.hw.fifo_board import FifoBoard
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.hw.timing import SampleClock
from worlds.fifo_boards import KINDS, fifo_board, inertial_chip, stamp_errors_ms
from worlds.gy85 import collect, driving, errors, still

GONE = Health.IMU_MISSING | Health.ACCEL_FAULT | Health.GYRO_FAULT


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rate_error", [-0.02, 0.0, 0.02])
def test_samples_are_the_truth_at_their_own_stamps(kind: str, rate_error: float) -> None:
    with fifo_board(kind, grade="exact", rate_error=rate_error) as (driver, bus, clock):
        source: InertialSource = driver
        inertial, _ = collect(driver, clock, 6.0)
        assert driver.imu is not None
        assert driver.imu.name == kind
        settled = inertial[len(inertial) // 3 :]
        gyro, accel = errors(settled)
        assert abs(gyro).max() < 0.0015, "half a count is 0.0002, and 1 ms of its fastest motion 0.0009"
        assert abs(accel).max() < 0.006, "half a count is 0.0012, and 1 ms of its fastest motion 0.003"
        assert abs(accel.mean(axis=0)).max() < 1e-3
        assert len(inertial) == pytest.approx(5.9 * source.rate_hz, rel=0.025)
        assert abs(stamp_errors_ms(driver, bus, settled)).max() < 0.6
        assert driver.health() == Health(0)
        assert driver.counters() == {}
        assert driver.temperature_c == pytest.approx(30.0, abs=0.01)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("adapter", ["one_read", "smbus_only"])
def test_every_adapter_will_do(kind: str, adapter: str) -> None:
    with fifo_board(kind, grade="exact", **{adapter: True}) as (driver, _, clock):
        inertial, _ = collect(driver, clock, 2.0)
        assert len(inertial) == pytest.approx(1.9 * driver.rate_hz, rel=0.02)
        assert abs(errors(inertial[100:])[0]).max() < 0.002


@pytest.mark.parametrize("kind", KINDS)
def test_a_host_that_comes_late_loses_nothing_and_stamps_stay_even(kind: str) -> None:
    with fifo_board(kind, grade="exact", rate_error=0.003) as (driver, bus, clock):
        inertial, _ = collect(driver, clock, 20.0, late_s=0.002)
        settled = inertial[len(inertial) // 4 :]
        off_ms = stamp_errors_ms(driver, bus, settled)
        steps_ms = np.diff([s.t_ns for s in settled]) * 1e-6
        assert driver.counters() == {}
        assert abs(off_ms).max() < 0.8, "reads are up to 40 ms late, 2 ms in the mean"
        assert steps_ms.std() < 0.05
        bound_ms = driver.stamp_bound_ms
        assert bound_ms is not None
        assert abs(off_ms).mean() < 2.0 * bound_ms
        assert bound_ms < 0.6


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("asked_hz", "gyro", "accel"), [(100.0, 250, 2), (400.0, 1000, 4), (25.0, 2000, 16)])
def test_every_rate_and_range_has_the_right_scale(kind: str, asked_hz: float, gyro: int, accel: int) -> None:
    config = BoardConfig(rate_hz=asked_hz, gyro_range_deg_s=gyro, accel_range_g=accel)  # type: ignore[arg-type]
    with fifo_board(kind, config=config, grade="exact") as (driver, _, clock):
        inertial, _ = collect(driver, clock, 4.0)
        assert asked_hz <= driver.rate_hz <= 2.0 * asked_hz
        assert len(inertial) > 3.2 * asked_hz
        gyro_off, accel_off = errors(inertial[len(inertial) // 2 :])
        assert abs(gyro_off).max() < 0.003 + 0.1 / asked_hz
        assert abs(accel_off).max() < 0.01 + 0.5 / asked_hz


def test_the_chip_lies_as_its_axes_say() -> None:
    calibration = SensorCalibration(gyro_axes=("-y", "x", "z"), accel_axes=("z", "-x", "-y"))
    with fifo_board(config=BoardConfig(calibration=calibration), grade="exact") as (driver, _, clock):
        gyro, accel = errors(collect(driver, clock, 2.0)[0][100:])
        assert abs(gyro).mean() < 5e-4
        assert abs(accel).mean() < 5e-3


def test_what_is_in_the_place_of_a_chip_is_told() -> None:
    with fifo_board("LSM6DSOX") as (driver, virtual, clock):
        driver.close()
        inertial_chip(virtual).registers[0x0F] = 0x69
        with pytest.raises(HardwareError, match=r"0x6a has 0x69 in register 0x0f.*vislam doctor") as refused:
            FifoBoard(BoardConfig(bus=virtual.path), clock)
        assert refused.value.exit_code == 5
        virtual.chips.clear()
        with pytest.raises(HardwareError, match="no mpu6050 answers at 0x68, 0x69"):
            FifoBoard(BoardConfig(bus=virtual.path, chip="mpu6050"), clock)
    with pytest.raises(HardwareError, match="vislam doctor"):
        FifoBoard(BoardConfig(bus="/dev/i2c-absent"))
    with pytest.raises(UsageError, match="at most 1000"):
        FifoBoard(BoardConfig(rate_hz=5000.0))


def test_a_gy85_is_not_taken_for_one_of_these() -> None:
    clock = SteppedClock()
    bus = emulated_gy85(still, clock.now_ns, stepped=clock)
    with emulated_bus(bus), pytest.raises(HardwareError, match="no inertial chip with a FIFO"):
        FifoBoard(BoardConfig(bus=bus.path), clock)


def test_a_chip_at_its_other_address_is_found_and_one_that_is_named_is_taken() -> None:
    with fifo_board("LSM6DSOX", address=0x6B) as (driver, _, _):
        assert driver.imu is not None
        assert driver.imu.address == 0x6B
    with fifo_board("MPU-6050", address=0x69, config=BoardConfig(address=0x69, chip="mpu6050")) as (driver, _, _):
        assert driver.imu is not None
        assert driver.imu.address == 0x69


def test_a_fifo_emptied_after_a_host_was_put_aside_is_no_silent_chip() -> None:
    with fifo_board("MPU-6050", driving) as (driver, virtual, clock):
        collect(driver, clock, 1.0)
        for way in range(1, 12):  # one of these breaks off while samples are fetched
            virtual.nack_every = way
            driver.read(0.01)
            virtual.nack_every = 0
            clock.advance(300_000_000)
            collect(driver, clock, 0.2)
        assert not {"imu_silent", "reopened"} & set(driver.counters()), driver.counters()


def test_stamps_increase_whatever_the_questions_find() -> None:
    rng = np.random.default_rng(5)
    stamps, t_ns, last = SampleClock(200.0), 10**12, 0
    assert stamps.bound_ms is None
    for _ in range(3000):
        t_ns += int(rng.exponential(8e6))
        if rng.random() < 0.01:
            stamps.restart()
        for stamp in stamps.stamps(int(rng.integers(1, 6)), t_ns, t_ns + int(rng.exponential(2e5))):
            assert stamp > last
            last = stamp
