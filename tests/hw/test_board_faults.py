"""Whatever a wire, a plug, a chip or a busy host does to any board on I2C: no exception, no wrong sample in silence."""

from functools import partial
from typing import Any

import numpy as np
import pytest

from vislam.config import BoardConfig, Gy85Config
from vislam.hw.emulator import VirtualAdxl345, emulated_board, emulated_bus, emulated_gy85
from vislam.hw.fifo_board import FifoBoard
from vislam.hw.gy85 import Gy85
from vislam.hw.health import Health
from worlds.fifo_boards import (
    GY85,
    KINDS,
    Stalled,
    again,
    any_board,
    assert_right,
    fifo_board,
    inertial_chip,
    stamp_errors_ms,
)
from worlds.gy85 import FIELD_UT, board, collect, driving, still

GONE = Health.IMU_MISSING | Health.ACCEL_FAULT | Health.GYRO_FAULT
BOARDS = (GY85, *KINDS)


def assert_well(driver: Gy85 | FifoBoard, clock: Any, settle_s: float = 1.2) -> list[Any]:
    """Return a second of samples of a board that has come back, of which none is missing and nothing is reported."""
    collect(driver, clock, settle_s)  # an attempt every half second, a reset, 0.1 s to start
    driver.health()
    inertial, _ = collect(driver, clock, 1.0)
    assert len(inertial) == pytest.approx(driver.rate_hz, rel=0.03)
    assert driver.health() == Health(0)
    return inertial


@pytest.mark.parametrize("kind", BOARDS)
def test_unplugged_and_plugged_in_again(kind: str) -> None:
    with any_board(kind) as (driver, virtual, clock):
        inertial, _ = collect(driver, clock, 1.0)
        for _ in range(3):
            virtual.unplug()
            before = virtual.transfers
            gone, _ = collect(driver, clock, 2.0)
            assert len(gone) <= 1
            assert driver.health() & GONE == GONE
            assert virtual.transfers - before < 50, "no busy loop while there is nothing to read"
            virtual.replug()
            inertial += assert_well(driver, clock, 0.9)
        assert driver.counters()["reopened"] == 3 * len(virtual.chips)
        assert_right(inertial, kind)


@pytest.mark.parametrize("kind", BOARDS)
def test_started_before_it_is_plugged_in(kind: str) -> None:
    with any_board(kind) as (driver, virtual, clock):
        driver.close()
        virtual.unplug()
        later = again(driver, virtual, clock)
        assert collect(later, clock, 1.0)[0] == []
        assert later.health() & GONE == GONE
        virtual.replug()
        assert_right(assert_well(later, clock), kind)
        later.close()
        later.close()


@pytest.mark.parametrize("kind", BOARDS)
@pytest.mark.parametrize("every", [7, 50])
def test_nacks_are_counted_and_never_make_a_wrong_sample(kind: str, every: int) -> None:
    with any_board(kind) as (driver, virtual, clock):
        collect(driver, clock, 0.5)
        virtual.nack_every = every
        inertial, _ = collect(driver, clock, 5.0)
        assert_right(inertial, kind)
        nacks = driver.counters()["nack"]
        assert nacks > 10
        if kind == GY85:
            assert len(inertial) >= 2000 - 1.02 * nacks - 30, "each costs the gyro's sample at most"
        assert driver.health() & Health.BUS_FAULT
        assert driver.health() & Health.IMU_GAP == 0, "events are told once"
        virtual.nack_every = 0
        assert_well(driver, clock)


@pytest.mark.parametrize("kind", BOARDS)
def test_a_stuck_bus_is_told_never_waited_for_and_left_behind(kind: str) -> None:
    with any_board(kind) as (driver, virtual, clock):
        collect(driver, clock, 1.0)
        virtual.is_stuck = True
        assert len(collect(driver, clock, 3.0)[0]) <= 1  # bounds the time of every call
        assert driver.health() & GONE == GONE
        assert driver.counters()["timeout"] > 3
        virtual.is_stuck = False
        assert_right(assert_well(driver, clock), kind)


@pytest.mark.parametrize("kind", KINDS)
def test_a_moment_without_power_gives_no_sample_of_the_wrong_scale(kind: str) -> None:
    config = BoardConfig(gyro_range_deg_s=2000, accel_range_g=16)
    with fifo_board(kind, config=config) as (driver, virtual, clock):
        inertial, _ = collect(driver, clock, 1.0)
        for _ in range(3):
            inertial_chip(virtual).power_cycle()
            inertial += collect(driver, clock, 1.5)[0]
        assert_right(inertial, kind)
        counters = driver.counters()
        assert counters.get("settings_lost", 0) + counters.get("imu_silent", 0) == 3
        assert counters["reopened"] == 3


@pytest.mark.parametrize(
    ("kind", "address", "counter"),
    [
        (GY85, 0x68, "gyro_stuck"), (GY85, 0x53, "accel_silent"),
        *((kind, 0, "imu_silent") for kind in KINDS),
    ],
)  # fmt: skip
def test_a_chip_that_hangs_is_noticed(kind: str, address: int, counter: str) -> None:
    with any_board(kind) as (driver, virtual, clock):
        collect(driver, clock, 0.5)
        chip = virtual.chips[address] if address else inertial_chip(virtual)
        chip.is_frozen = True  # type: ignore[attr-defined]
        inertial, _ = collect(driver, clock, 3.0)
        assert driver.counters()[counter] >= 1
        if address == 0x68:
            assert len(inertial) <= 40, "20 of the value, and 20 of what is in the registers once it was set up again"
        if counter in ("gyro_stuck", "imu_silent"):
            assert Health.GYRO_FAULT | Health.IMU_MISSING in driver.health()
        chip.is_frozen = False  # type: ignore[attr-defined]
        assert_well(driver, clock)


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize("kind", BOARDS)
def test_a_sensor_that_gives_the_same_for_ever_is_named_and_not_integrated(kind: str, sensor: str) -> None:
    def hung(t_ns: int):  # type: ignore[no-untyped-def]
        rate, force, *rest = driving(t_ns)
        return ((0.0, 0.0, 0.5), force, *rest) if sensor == "gyro" else (rate, (0.0, 0.0, 9.8), *rest)

    with any_board(kind, truth=hung, grade="exact") as (driver, _, clock):
        inertial, _ = collect(driver, clock, 2.0)
        assert len(inertial) <= 22
        counters = driver.counters()
        assert counters[f"{sensor}_stuck"] >= 1
        assert not {"gyro_stuck", "accel_stuck"} - {f"{sensor}_stuck"} & set(counters)
        assert Health[f"{sensor.upper()}_FAULT"] | Health.IMU_GAP | Health.IMU_MISSING in driver.health()


@pytest.mark.parametrize("kind", BOARDS)
def test_saturation_is_told(kind: str) -> None:
    def violent(t_ns: int):  # type: ignore[no-untyped-def]
        s = np.sin(t_ns * 1e-9)
        return (0.0, 0.0, 40.0 * s), (200.0 * s, 0.0, 9.8), tuple(FIELD_UT), 30.0

    with any_board(kind, truth=violent) as (driver, _, clock):
        collect(driver, clock, 4.0)
        assert Health.ACCEL_SATURATED | Health.GYRO_SATURATED in driver.health()
        assert driver.counters()["gyro_saturated"] > 100
        assert driver.counters()["accel_saturated"] > 100


@pytest.mark.parametrize("kind", BOARDS)
def test_random_faults_never_raise_and_never_lie(kind: str) -> None:
    rng = np.random.default_rng(11)
    with any_board(kind) as (driver, virtual, clock):
        inertial = []
        for _ in range(40 if kind == GY85 else 25):
            choice = rng.integers(8)
            virtual.is_stuck = choice == 0
            virtual.nack_every = int(rng.integers(2, 40)) if choice < 4 else 0
            if choice == 5:
                virtual.unplug()
            elif choice == 6:
                list(virtual.chips.values())[rng.integers(len(virtual.chips))].power_cycle()
            inertial += collect(driver, clock, float(rng.uniform(0.2, 1.5)))[0]
            driver.health()
            if choice == 5:
                virtual.replug()
        assert_right(inertial, kind)
        virtual.is_stuck, virtual.nack_every = False, 0
        assert_well(driver, clock, 1.5)


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


@pytest.mark.parametrize("kind", KINDS)
def test_a_full_fifo_is_told_and_what_comes_after_is_right(kind: str) -> None:
    with fifo_board(kind) as (driver, bus, clock):
        collect(driver, clock, 1.0)
        driver.health()
        clock.advance(3_000_000_000)
        inertial, _ = collect(driver, clock, 2.5)
        assert driver.counters() == {"fifo_overrun": 1}
        assert driver.health() & Health.IMU_GAP
        assert_right(inertial, kind)
        assert abs(stamp_errors_ms(driver, bus, inertial[-200:])).max() < 0.8
        driver.health()
        collect(driver, clock, 0.2)
        assert driver.health() == Health(0)


# ---- what a GY-85 alone has: three chips


def test_a_moment_without_power_of_each_chip_gives_no_sample_of_the_wrong_scale() -> None:
    with board() as (driver, virtual, clock):
        inertial, _ = collect(driver, clock, 1.0)
        for address in (0x68, 0x53, 0x1E):
            virtual.chips[address].power_cycle()
            inertial += collect(driver, clock, 1.5)[0]
        assert_right(inertial, GY85)
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
        assert_right(inertial, GY85)
        assert driver.health() == Health(0)


def test_a_reader_that_comes_too_late_learns_what_it_lost() -> None:
    with board() as (driver, _, clock):
        collect(driver, clock, 1.0)
        assert driver.health() == Health(0)
        clock.advance(500_000_000)
        inertial, _ = collect(driver, clock, 1.0)
        assert driver.health() & Health.IMU_GAP
        assert driver.counters()["rounds_missed"] >= 199
        assert driver.counters()["accel_overrun"] == 1
        assert_right(inertial, GY85)


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
