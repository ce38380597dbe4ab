"""Whatever a wire, a plug or a chip does: no exception, no wrong sample in silence, and back when it is back."""

import numpy as np
import pytest

from vislam.config import Gy85Config
from vislam.hw.emulator import VirtualAdxl345
from vislam.hw.health import Health
from worlds.gy85 import FIELD_UT, board, collect, driving, errors, still

IMU = Health.IMU_MISSING | Health.IMU_GAP | Health.ACCEL_FAULT | Health.GYRO_FAULT | Health.BUS_FAULT


def assert_right(samples) -> None:  # type: ignore[no-untyped-def]
    """No sample may be wrong, however few there are: 0.3 deg/s and 0.03 m/s^2 of bias, and noise."""
    gyro, accel = errors(samples)
    assert abs(gyro).max() < 0.06
    assert abs(accel).max() < 0.6


@pytest.mark.parametrize("every", [7, 50])
def test_nacks_are_counted_and_cost_single_samples(every: int) -> None:
    with board() as (driver, virtual, clock):
        virtual.nack_every = every
        inertial, _ = collect(driver, clock, 10.0)
        assert_right(inertial)
        nacks = driver.counters()["nack"]
        assert nacks > 4000 / every
        assert len(inertial) >= 4000 - 1.02 * nacks - 30, "each costs the gyro's sample at most"
        assert driver.health() & Health.BUS_FAULT
        assert driver.health() & Health.IMU_GAP == 0, "events are told once"
        virtual.nack_every = 0
        collect(driver, clock, 0.5)
        driver.health()
        inertial, _ = collect(driver, clock, 1.0)
        assert len(inertial) == pytest.approx(400, abs=2)
        assert driver.health() == Health(0)


def test_a_stuck_bus_is_told_never_waited_for_and_left_behind() -> None:
    with board() as (driver, virtual, clock):
        collect(driver, clock, 1.0)
        virtual.is_stuck = True
        inertial, _ = collect(driver, clock, 3.0)  # bounds the time of every call
        assert len(inertial) <= 1
        assert driver.health() & IMU == IMU
        assert driver.counters()["timeout"] > 3
        virtual.is_stuck = False
        collect(driver, clock, 1.0)
        driver.health()
        inertial, _ = collect(driver, clock, 2.0)
        assert len(inertial) == pytest.approx(800, abs=3)
        assert_right(inertial)
        assert driver.health() == Health(0)
        assert driver.counters()["reopened"] >= 3


def test_unplugged_and_plugged_in_again() -> None:
    with board() as (driver, virtual, clock):
        inertial, _ = collect(driver, clock, 1.0)
        for _ in range(3):
            virtual.unplug()
            gone, _ = collect(driver, clock, 2.0)
            assert len(gone) <= 1
            assert driver.health() & IMU == IMU
            virtual.replug()
            collect(driver, clock, 0.8)  # an attempt every half second, 50 ms for the gyro to start
            driver.health()
            back, _ = collect(driver, clock, 1.0)
            assert len(back) == pytest.approx(400, abs=3)
            assert driver.health() == Health(0)
            inertial += back
        assert_right(inertial)
        assert (np.diff([s.t_ns for s in inertial]) > 0).all()


def test_started_before_it_is_plugged_in() -> None:
    with board() as (driver, virtual, clock):
        driver.close()
        virtual.unplug()
        later = type(driver)(Gy85Config(bus=virtual.path, self_test=False), clock, must_be_there=False)
        assert collect(later, clock, 1.0)[0] == []
        assert later.health() & IMU == IMU & ~Health.IMU_GAP
        virtual.replug()
        collect(later, clock, 1.0)
        assert_right(collect(later, clock, 1.0)[0])
        later.health()
        collect(later, clock, 0.1)
        assert later.health() == Health(0)


def test_a_moment_without_power_gives_no_sample_of_the_wrong_scale() -> None:
    with board() as (driver, virtual, clock):
        inertial, _ = collect(driver, clock, 1.0)
        for address in (0x68, 0x53, 0x1E):
            virtual.chips[address].power_cycle()
            inertial += collect(driver, clock, 1.5)[0]
        assert_right(inertial)
        counters = driver.counters()
        assert counters["settings_lost"] == 2
        assert counters["accel_silent"] == 1
        assert counters["reopened"] == 3
        driver.health()
        magnetic = collect(driver, clock, 1.0)[1]
        np.testing.assert_allclose(np.mean([m.field_ut for m in magnetic], axis=0), FIELD_UT, atol=2.0)
        assert driver.health() == Health(0)


@pytest.mark.parametrize(
    ("address", "bit", "has_inertial"),
    [(0x68, Health.GYRO_FAULT, False), (0x53, Health.ACCEL_FAULT, False), (0x1E, Health.MAG_FAULT, True)],
)
def test_each_chip_may_be_missing_and_come_back(address: int, bit: Health, has_inertial: bool) -> None:
    with board() as (driver, virtual, clock):
        collect(driver, clock, 0.5)
        chip = virtual.chips.pop(address)
        inertial, magnetic = collect(driver, clock, 2.0)
        assert (len(inertial) > 700) is has_inertial
        assert (len(magnetic) > 80) is not has_inertial
        word = driver.health()
        assert word & bit
        assert bool(word & Health.IMU_MISSING) is not has_inertial
        chip.power_cycle()
        virtual.chips[address] = chip
        collect(driver, clock, 1.0)
        driver.health()
        inertial, magnetic = collect(driver, clock, 1.0)
        assert (len(inertial), len(magnetic)) == (pytest.approx(400, abs=3), pytest.approx(50, abs=3))
        assert_right(inertial)
        assert driver.health() == Health(0)


@pytest.mark.parametrize(
    ("address", "counter"), [(0x68, "gyro_stuck"), (0x53, "accel_silent"), (0x1E, "mag_stuck"), (0x0D, "mag_silent")]
)
def test_a_chip_that_hangs_is_noticed(address: int, counter: str) -> None:
    kind = "QMC5883L" if address == 0x0D else "HMC5883L"
    with board(magnetometer=kind) as (driver, virtual, clock):
        collect(driver, clock, 0.5)
        virtual.chips[address].is_frozen = True
        inertial, _ = collect(driver, clock, 3.0)
        assert driver.counters()[counter] >= 1
        if address == 0x68:
            assert len(inertial) <= 40, "20 of the value, and 20 of what is in the registers once it was set up again"
            assert Health.GYRO_FAULT | Health.IMU_GAP in driver.health()
        virtual.chips[address].is_frozen = False
        collect(driver, clock, 1.0)
        driver.health()
        collect(driver, clock, 0.2)
        assert driver.health() == Health(0)


def test_a_stuck_accelerometer_that_goes_on_counting() -> None:
    def dead(t_ns: int):  # type: ignore[no-untyped-def]
        return driving(t_ns)[0], (0.0, 0.0, 0.0), tuple(FIELD_UT), 30.0

    with board(truth=dead, grade="exact", magnetometer="none") as (driver, _, clock):
        collect(driver, clock, 1.0)
        assert driver.counters()["accel_stuck"] >= 1


def test_a_reader_that_comes_too_late_learns_what_it_lost() -> None:
    with board() as (driver, _, clock):
        collect(driver, clock, 1.0)
        assert driver.health() == Health(0)
        clock.advance(500_000_000)
        inertial, _ = collect(driver, clock, 1.0)
        assert driver.health() & Health.IMU_GAP
        assert driver.counters()["rounds_missed"] >= 199
        assert driver.counters()["accel_overrun"] == 1
        assert_right(inertial)


def test_saturation_is_told() -> None:
    def violent(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 40.0 * np.sin(t_ns * 1e-9)), (200.0 * np.sin(t_ns * 1e-9), 0.0, 9.8), tuple(FIELD_UT), 30.0

    with board(truth=violent) as (driver, _, clock):
        collect(driver, clock, 4.0)
        word = driver.health()
        assert word & Health.ACCEL_SATURATED
        assert word & Health.GYRO_SATURATED
        assert driver.counters()["accel_saturated"] > 100
        assert driver.counters()["gyro_saturated"] > 100


def test_a_magnetometer_beyond_its_range_gives_no_sample() -> None:
    def magnet(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 0.0), (0.0, 0.0, 9.8), (500.0, -500.0, 500.0), 30.0

    with board(truth=magnet) as (driver, _, clock):
        inertial, magnetic = collect(driver, clock, 3.0)
        assert len(inertial) > 1180
        assert magnetic == []
        assert set(driver.counters()) == {"mag_overflow"}
        assert driver.health() & Health.MAG_FAULT
        assert driver.counters()["mag_overflow"] > 30


def test_a_failed_self_test_stays_in_the_health_word() -> None:
    with board() as (driver, virtual, clock):
        weak = VirtualAdxl345(still, clock.now_ns, virtual.chips[0x53].error, self_test_g=(0.0, 0.0, 0.0))
        weak.write(bytes([0x2C, *virtual.chips[0x53].registers[0x2C:0x3A]]))
        virtual.chips[0x53] = weak
        results = {t.chip: t.passed for t in driver.run_self_tests()}
        assert results["ADXL345"] is False
        collect(driver, clock, 0.5)
        assert driver.health() == Health.ACCEL_FAULT


@pytest.mark.parametrize("every", [3, 5, 11, 29, 60])
def test_a_self_test_that_breaks_off_leaves_no_stimulus_on(every: int) -> None:
    with board(truth=still) as (driver, virtual, clock):
        collect(driver, clock, 0.2)
        virtual.nack_every = every
        driver.run_self_tests()
        virtual.nack_every = 0
        inertial, _ = collect(driver, clock, 1.5)
        accel = np.array([s.accel_m_s2 for s in inertial])
        assert len(inertial) > 300
        assert abs(accel - [0.0, 0.0, 9.80665]).max() < 0.6, "0.9 g would be the push"
        magnetic = collect(driver, clock, 1.0)[1]
        np.testing.assert_allclose(np.mean([m.field_ut for m in magnetic], axis=0), FIELD_UT, atol=2.0)


def test_random_faults_never_raise_and_never_lie() -> None:
    rng = np.random.default_rng(11)
    print("seed 11")
    with board() as (driver, virtual, clock):
        inertial = []
        for _ in range(40):
            choice = rng.integers(8)
            virtual.is_stuck = choice == 0
            virtual.nack_every = int(rng.integers(2, 40)) if choice < 4 else 0
            if choice == 5:
                virtual.unplug()
            elif choice == 6:
                virtual.chips[[0x53, 0x68, 0x1E][rng.integers(3)]].power_cycle()
            inertial += collect(driver, clock, float(rng.uniform(0.2, 1.5)))[0]
            driver.health()
            if choice == 5:
                virtual.replug()
        assert_right(inertial)
        assert (np.diff([s.t_ns for s in inertial]) > 0).all()
        virtual.is_stuck, virtual.nack_every = False, 0
        collect(driver, clock, 1.2)
        driver.health()
        assert len(collect(driver, clock, 1.0)[0]) == pytest.approx(400, abs=3)
        assert driver.health() == Health(0)
