"""Every board with a FIFO through the real smbus2: samples at the right times, and whatever wires and plugs do."""

from functools import partial
from typing import Any

import numpy as np
import pytest

from vislam.config import BoardConfig, Gy85Config, PowerUpConfig, SensorCalibration
from vislam.core.errors import HardwareError, UsageError
from vislam.core.messages import ImuSample, ImuSpan
from vislam.hw.emulator import SteppedClock, emulated_board, emulated_bus, emulated_gy85
from vislam.hw.fifo_board import FifoBoard
from vislam.hw.gy85 import Gy85
from vislam.hw.health import Health
from vislam.hw.source import InertialSource
from vislam.hw.timing import SampleClock
from vislam.imu import PowerUp, power_up
from worlds.fifo_boards import FIRMWARE, KINDS, Stalled, fifo_board, inertial_chip, stamp_errors_ms
from worlds.gy85 import board, collect, driving, errors, still

GONE = Health.IMU_MISSING | Health.ACCEL_FAULT | Health.GYRO_FAULT


def assert_right(samples: list[ImuSample]) -> None:
    """No sample may be wrong, however few there are: 0.3 deg/s and 0.03 m/s^2 of bias, noise, and 1 ms of stamps."""
    assert samples
    gyro, accel = errors(samples)
    assert np.isfinite(gyro).all()
    assert np.isfinite(accel).all()
    assert abs(gyro).max() < 0.04
    assert abs(accel).max() < 0.3
    assert (np.diff([s.t_ns for s in samples]) > 0).all()


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
def test_a_full_fifo_is_told_and_what_comes_after_is_right(kind: str) -> None:
    with fifo_board(kind) as (driver, bus, clock):
        collect(driver, clock, 1.0)
        driver.health()
        clock.advance(3_000_000_000)
        inertial, _ = collect(driver, clock, 2.5)
        assert driver.counters() == {"fifo_overrun": 1}
        assert driver.health() & Health.IMU_GAP
        assert_right(inertial)
        assert abs(stamp_errors_ms(driver, bus, inertial[-200:])).max() < 0.8
        driver.health()
        collect(driver, clock, 0.2)
        assert driver.health() == Health(0)


@pytest.mark.parametrize("kind", KINDS)
def test_unplugged_and_plugged_in_again(kind: str) -> None:
    with fifo_board(kind) as (driver, virtual, clock):
        inertial, _ = collect(driver, clock, 1.0)
        for _ in range(3):
            virtual.unplug()
            before = virtual.transfers
            gone, _ = collect(driver, clock, 2.0)
            assert len(gone) <= 1
            assert driver.health() & GONE == GONE
            assert virtual.transfers - before < 50, "no busy loop while there is nothing to read"
            virtual.replug()
            collect(driver, clock, 0.9)  # an attempt every half second, a reset, 0.1 s to start
            driver.health()
            back, _ = collect(driver, clock, 1.0)
            assert len(back) == pytest.approx(driver.rate_hz, rel=0.03)
            assert driver.health() == Health(0)
            inertial += back
        assert driver.counters()["reopened"] == 3
        assert_right(inertial)


@pytest.mark.parametrize("kind", KINDS)
def test_started_before_it_is_plugged_in(kind: str) -> None:
    with fifo_board(kind) as (driver, virtual, clock):
        driver.close()
        virtual.unplug()
        later = FifoBoard(BoardConfig(bus=virtual.path, firmware=str(FIRMWARE)), clock, must_be_there=False)
        assert collect(later, clock, 1.0)[0] == []
        assert later.health() & GONE == GONE
        virtual.replug()
        collect(later, clock, 1.0)
        assert_right(collect(later, clock, 1.0)[0])
        later.health()
        collect(later, clock, 0.1)
        assert later.health() == Health(0)
        later.close()
        later.close()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("every", [7, 50])
def test_nacks_are_counted_and_never_make_a_wrong_sample(kind: str, every: int) -> None:
    with fifo_board(kind) as (driver, virtual, clock):
        collect(driver, clock, 0.5)
        virtual.nack_every = every
        inertial, _ = collect(driver, clock, 5.0)
        assert_right(inertial)
        assert driver.counters()["nack"] > 10
        assert driver.health() & Health.BUS_FAULT
        virtual.nack_every = 0
        collect(driver, clock, 1.2)
        driver.health()
        assert len(collect(driver, clock, 1.0)[0]) == pytest.approx(driver.rate_hz, rel=0.03)
        assert driver.health() == Health(0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_stuck_bus_is_told_and_left_behind(kind: str) -> None:
    with fifo_board(kind) as (driver, virtual, clock):
        collect(driver, clock, 1.0)
        virtual.is_stuck = True
        assert len(collect(driver, clock, 3.0)[0]) <= 1  # bounds the time of every call
        assert driver.health() & GONE == GONE
        assert driver.counters()["timeout"] > 3
        virtual.is_stuck = False
        collect(driver, clock, 1.2)
        driver.health()
        assert_right(collect(driver, clock, 1.0)[0])
        assert driver.health() == Health(0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_moment_without_power_gives_no_sample_of_the_wrong_scale(kind: str) -> None:
    config = BoardConfig(gyro_range_deg_s=2000, accel_range_g=16)
    with fifo_board(kind, config=config) as (driver, virtual, clock):
        inertial, _ = collect(driver, clock, 1.0)
        for _ in range(3):
            inertial_chip(virtual).power_cycle()
            inertial += collect(driver, clock, 1.5)[0]
        assert_right(inertial)
        counters = driver.counters()
        assert counters.get("settings_lost", 0) + counters.get("imu_silent", 0) == 3
        assert counters["reopened"] == 3


@pytest.mark.parametrize("kind", KINDS)
def test_a_chip_that_hangs_is_noticed(kind: str) -> None:
    with fifo_board(kind) as (driver, virtual, clock):
        collect(driver, clock, 0.5)
        inertial_chip(virtual).is_frozen = True
        collect(driver, clock, 2.0)
        assert driver.counters()["imu_silent"] >= 1
        assert driver.health() & Health.IMU_MISSING
        inertial_chip(virtual).is_frozen = False
        collect(driver, clock, 1.2)
        driver.health()
        collect(driver, clock, 0.2)
        assert driver.health() == Health(0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_sensor_that_gives_the_same_for_ever_is_noticed(kind: str) -> None:
    def dead(t_ns: int):  # type: ignore[no-untyped-def]
        return driving(t_ns)[0], (0.0, 0.0, 0.0), (20.0, 0.0, -40.0), 30.0

    with fifo_board(kind, truth=dead, grade="exact") as (driver, _, clock):
        collect(driver, clock, 2.0)
        assert driver.counters()["accel_stuck"] >= 1
        assert "gyro_stuck" not in driver.counters()


def test_a_gyro_that_gives_the_same_for_ever_is_not_integrated() -> None:
    def hung(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 0.5), *driving(t_ns)[1:]

    with fifo_board(KINDS[0], truth=hung, grade="exact") as (driver, _, clock):
        inertial, _ = collect(driver, clock, 2.0)
        assert len(inertial) <= 20
        assert driver.counters()["gyro_stuck"] >= 1
        assert Health.GYRO_FAULT | Health.IMU_GAP | Health.IMU_MISSING in driver.health()


@pytest.mark.parametrize("kind", KINDS)
def test_saturation_is_told(kind: str) -> None:
    def violent(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 20.0 * np.sin(t_ns * 1e-9)), (150.0 * np.sin(t_ns * 1e-9), 0.0, 9.8), (20.0, 0, -40), 30.0

    with fifo_board(kind, truth=violent) as (driver, _, clock):
        collect(driver, clock, 4.0)
        assert driver.health() & Health.ACCEL_SATURATED
        assert driver.counters()["gyro_saturated"] > 100
        assert driver.counters()["accel_saturated"] > 100


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


@pytest.mark.parametrize(
    ("make", "chip", "first_c", "own_rad_s", "left_rad_s"),
    [
        (fifo_board, inertial_chip, 26.5, 0.002, 0.001),
        (board, lambda bus: bus.chips[0x68], 26.0, 0.005, 0.0025),
    ],
    ids=["fifo", "gy85"],
)
def test_temperature_drift_is_told_and_its_known_part_taken_off(make, chip, first_c, own_rad_s, left_rad_s) -> None:  # type: ignore[no-untyped-def]
    def warming(t_ns: int):  # type: ignore[no-untyped-def]
        rate, force, field, _ = still(t_ns)
        return rate, force, field, 25.0 + (t_ns - 1_000_000_000_000) * 1e-9

    with make(truth=warming) as (driver, virtual, clock):
        per_c = np.array(chip(virtual).error.bias_per_c)
        first, _ = collect(driver, clock, 2.0)
        assert driver.temperature_c == pytest.approx(first_c, abs=1.1)
        driver.zeroed_at(driver.temperature_c, per_c)
        collect(driver, clock, 6.0)
        assert not driver.health() & Health.TEMPERATURE_DRIFT
        collect(driver, clock, 10.0)
        last, _ = collect(driver, clock, 2.0)
        assert driver.health() & Health.TEMPERATURE_DRIFT
        drift = np.mean([s.gyro_rad_s for s in last], axis=0) - np.mean([s.gyro_rad_s for s in first], axis=0)
        assert abs(18.0 * per_c).max() > own_rad_s, "the chip itself drifts"
        assert abs(drift).max() < left_rad_s


def test_power_up_finds_bias_and_level_as_on_a_gy85() -> None:
    def level(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 0.0), (0.17, -0.34, 9.80185), (20.0, 0.0, -42.0), 30.0

    with fifo_board("LSM6DSOX", truth=level) as (driver, virtual, clock):
        error = inertial_chip(virtual).error
        bias = np.array(error.bias) + 5.0 * np.array(error.bias_per_c)
        samples, _ = collect(driver, clock, 3.0)
        t_ns = np.array([s.t_ns for s in samples], dtype=np.int64)
        rates, forces = np.array([s.gyro_rad_s for s in samples]), np.array([s.accel_m_s2 for s in samples])
        found = power_up(ImuSpan(t_ns, rates, forces), PowerUpConfig(), 9.81, driver.temperature_c)
        assert isinstance(found, PowerUp)
        np.testing.assert_allclose(found.gyro_bias_rad_s, bias, atol=5e-4)
        np.testing.assert_allclose(found.R_level_body @ [0.17, -0.34, 9.80185], [0.0, 0.0, 9.81], atol=0.1)
        assert found.temperature_c == pytest.approx(30.0, abs=0.1)


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


def test_random_faults_never_raise_and_never_lie() -> None:
    rng = np.random.default_rng(11)
    for kind in KINDS:
        with fifo_board(kind) as (driver, virtual, clock):
            inertial = []
            for _ in range(25):
                choice = rng.integers(8)
                virtual.is_stuck = choice == 0
                virtual.nack_every = int(rng.integers(2, 40)) if choice < 4 else 0
                if choice == 5:
                    virtual.unplug()
                elif choice == 6:
                    inertial_chip(virtual).power_cycle()
                inertial += collect(driver, clock, float(rng.uniform(0.2, 1.5)))[0]
                driver.health()
                if choice == 5:
                    virtual.replug()
            assert_right(inertial)
            virtual.is_stuck, virtual.nack_every = False, 0
            collect(driver, clock, 1.5)
            driver.health()
            assert len(collect(driver, clock, 1.0)[0]) == pytest.approx(driver.rate_hz, rel=0.03)
            assert driver.health() == Health(0)


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


@pytest.mark.parametrize("kind", ["LSM6DSOX", "MPU-6050", "GY-85"])
def test_a_host_put_aside_anywhere_blames_no_chip(kind: Any) -> None:
    for at in range(1, 300):
        clock = Stalled(at, (150 if at % 2 else 300) * 1_000_000)
        make = emulated_gy85 if kind == "GY-85" else partial(emulated_board, kind, magnetometer="none")
        with emulated_bus(make(still, clock.now_ns)) as bus:
            fifo, gy85 = BoardConfig(bus=bus.path), Gy85Config(bus=bus.path, mag=False, self_test=False)
            driver = Gy85(gy85, clock) if kind == "GY-85" else FifoBoard(fifo, clock)
            end_ns, count = clock.now_ns() + clock.stall_ns + 200_000_000, 0
            while clock.now_ns() < end_ns:
                count += len(driver.read(0.1))
            counters = driver.counters()
            driver.close()
        assert not {"imu_silent", "accel_silent", "reopened"} & set(counters), (at, counters)
        assert count > 20, at
