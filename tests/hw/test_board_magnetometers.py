"""Magnetometers beside or inside an inertial chip: found by address and id, in its axes, with the right scale."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest

from vislam.config import BoardConfig, Gy85Config, SensorCalibration
from vislam.core.messages import MagSample
from vislam.hw.chips import I2cBus, SettingsLostError
from vislam.hw.chips.akm import AK8963, Akm
from vislam.hw.chips.known import find_any_magnetometer
from vislam.hw.chips.lis3mdl import Lis3mdl
from vislam.hw.emulator import (
    EmulatedBus,
    SteppedClock,
    VirtualAkm,
    VirtualLis3mdl,
    emulated_board,
    emulated_bus,
    emulated_gy85,
)
from vislam.hw.fifo_board import FifoBoard
from vislam.hw.gy85 import Gy85
from vislam.hw.health import Health
from worlds.fifo_boards import GY85, Stalled, any_board, fifo_board, inertial_chip
from worlds.gy85 import FIELD_UT, collect, driving, still

BOARDS = (
    ("MPU-9250", "inside", "AK8963", 0x0C),
    ("ICM-20948", "inside", "AK09916", 0x0C),
    ("LSM6DSOX", "LIS3MDL", "LIS3MDL", 0x1C),
    ("LSM6DSOX", "QMC5883P", "QMC5883P", 0x2C),
    (GY85, "HMC5883L", "HMC5883L", 0x1E),
    (GY85, "DA5883", "DA5883", 0x1E),
    (GY85, "QMC5883L", "QMC5883L", 0x0D),
)


@pytest.mark.parametrize(("kind", "magnetometer", "name", "address"), BOARDS)
def test_the_field_comes_in_the_body_s_axes_at_its_rate(kind: str, magnetometer: str, name: str, address: int) -> None:
    calibration = SensorCalibration(mag_axes=("-y", "x", "z"))
    config = (
        Gy85Config(self_test=False, calibration=calibration) if kind == GY85 else BoardConfig(calibration=calibration)
    )
    with any_board(kind, magnetometer=magnetometer, config=config) as (driver, _, clock):
        inertial, magnetic = collect(driver, clock, 5.0)
        assert driver.magnetometer_name == name
        assert len(magnetic) == pytest.approx(245, abs=10)
        assert (np.diff([m.t_ns for m in magnetic]) > 0).all()
        np.testing.assert_allclose(np.mean([m.field_ut for m in magnetic], axis=0), FIELD_UT, atol=2.0)
        assert len(inertial) == pytest.approx(4.9 * driver.rate_hz, rel=0.03)
        assert driver.health() == Health(0)
        assert driver.counters() == {}


@pytest.mark.parametrize(("kind", "magnetometer", "name", "address"), BOARDS)
def test_it_goes_and_comes_back_without_the_inertial_chip_noticing(
    kind: str, magnetometer: str, name: str, address: int
) -> None:
    with any_board(kind, magnetometer=magnetometer) as (driver, virtual, clock):
        collect(driver, clock, 1.0)
        virtual.chips[address].power_cycle()
        collect(driver, clock, 1.0)
        assert driver.counters().get("settings_lost", 0) == 1
        chip = virtual.chips.pop(address)
        inertial, magnetic = collect(driver, clock, 2.0)
        assert len(inertial) == pytest.approx(2.0 * driver.rate_hz, rel=0.03)
        assert len(magnetic) < 3
        assert driver.health() & Health.MAG_FAULT
        virtual.chips[address] = chip
        collect(driver, clock, 1.0)
        driver.health()
        assert len(collect(driver, clock, 1.0)[1]) == pytest.approx(50, abs=4)
        assert driver.health() == Health(0)


@pytest.mark.parametrize(("kind", "magnetometer", "name", "address"), BOARDS)
def test_one_that_hangs_and_one_beyond_its_range_are_told(
    kind: str, magnetometer: str, name: str, address: int
) -> None:
    with any_board(kind, magnetometer=magnetometer) as (driver, virtual, clock):
        collect(driver, clock, 1.0)
        virtual.chips[address].is_frozen = True
        collect(driver, clock, 3.0)
        assert {"mag_silent", "mag_stuck"} & set(driver.counters())
        assert driver.health() & Health.MAG_FAULT

    def magnet(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 0.0), (0.0, 0.0, 9.8), (4000.0, -3500.0, 100.0), 30.0

    with any_board(kind, magnetometer=magnetometer, truth=magnet) as (driver, _, clock):
        inertial, magnetic = collect(driver, clock, 2.0)
        assert magnetic == []
        assert len(inertial) > 350
        assert driver.counters()["mag_overflow"] > 30
        assert driver.health() & Health.MAG_FAULT


def turning(t_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
    """At rest, in a field that turns once a second: its direction tells when it was measured."""
    angle = 2e-9 * math.pi * (t_ns % 1_000_000_000)
    return (0.0, 0.0, 0.0), (0.0, 0.0, 9.80665), (30.0 * math.cos(angle), 30.0 * math.sin(angle), -20.0), 30.0


@pytest.mark.parametrize("kind", ["LSM6DSOX", "GY-85"])
def test_a_host_put_aside_anywhere_dates_no_field_wrongly(kind: Any) -> None:
    for at in range(1, 400, 5):
        clock = Stalled(at, 300_000_000)
        gy85 = kind == "GY-85"
        make = emulated_gy85 if gy85 else partial(emulated_board, kind, magnetometer="LIS3MDL")
        with emulated_bus(make(turning, clock.now_ns, grade="exact")) as bus:
            config = BoardConfig(bus=bus.path)
            driver = Gy85(Gy85Config(bus=bus.path, self_test=False), clock) if gy85 else FifoBoard(config, clock)
            end_ns, fields = clock.now_ns() + 600_000_000, []
            while clock.now_ns() < end_ns:
                fields += [sample for sample in driver.read(0.1) if isinstance(sample, MagSample)]
            driver.close()
        assert len(fields) > 5, at
        for sample in fields:
            told_s = math.atan2(sample.field_ut[1], sample.field_ut[0]) / (2.0 * math.pi)
            wrong_s = (sample.t_ns % 1_000_000_000 * 1e-9 - told_s + 0.5) % 1.0 - 0.5
            assert abs(wrong_s) < 0.03, (at, wrong_s)


def test_unplugging_takes_and_brings_both() -> None:
    with fifo_board("ICM-20948", magnetometer="inside") as (driver, virtual, clock):
        collect(driver, clock, 1.0)
        virtual.unplug()
        collect(driver, clock, 1.5)
        assert driver.health() & Health.MAG_FAULT
        virtual.replug()
        collect(driver, clock, 1.5)
        driver.health()
        inertial, magnetic = collect(driver, clock, 1.0)
        assert len(inertial) == pytest.approx(225, abs=5)
        assert len(magnetic) == pytest.approx(50, abs=4)
        assert driver.health() == Health(0)


def test_asked_for_or_not() -> None:
    with fifo_board("LSM6DSOX", config=BoardConfig(mag=True)) as (driver, _, clock):
        collect(driver, clock, 0.5)
        assert driver.health() == Health.MAG_FAULT
    with fifo_board("LSM6DSOX", config=BoardConfig(mag=False), magnetometer="LIS3MDL") as (driver, _, clock):
        assert collect(driver, clock, 0.5)[1] == []
        assert driver.health() == Health(0)


def test_one_inside_is_silent_until_the_chip_around_lets_it_through() -> None:
    with fifo_board("ICM-20948", magnetometer="inside") as (driver, virtual, _):
        driver.close()
        inertial_chip(virtual).power_cycle()
        assert find_any_magnetometer(I2cBus(virtual.path, 0.02), 1.9) is None


def test_an_lis3mdl_takes_the_range_that_is_asked_for_and_notices_lost_settings() -> None:
    clock = SteppedClock()
    chip = VirtualLis3mdl(driving, clock.now_ns)
    bus = EmulatedBus({0x1C: chip}, stepped=clock)
    with emulated_bus(bus):
        for range_ga, code in ((1.9, 0x00), (8.0, 0x20), (30.0, 0x60)):
            driver = Lis3mdl(I2cBus(bus.path, 0.02), range_ga)
            driver.configure(clock)
            assert bytes(chip.registers[0x20:0x25]) == bytes((0x5C, code, 0x00, 0x08, 0x40))
            clock.advance(30_000_000)
            reading = driver.read()
            assert reading is not None
            np.testing.assert_allclose(reading.field_ut, FIELD_UT, atol=0.1)
            assert driver.read() is None
        chip.power_cycle()
        with pytest.raises(SettingsLostError):
            driver.read()
        assert driver.self_test(clock).passed is None


def test_the_fuses_of_an_ak8963_are_its_sensitivity() -> None:
    clock = SteppedClock()
    chip = VirtualAkm(still, clock.now_ns, variant="AK8963", fuses=(60, 128, 255))
    bus = EmulatedBus({0x0C: chip}, stepped=clock)
    with emulated_bus(bus):
        driver = Akm(AK8963, I2cBus(bus.path, 0.02))
        driver.configure(clock)
        clock.advance(30_000_000)
        reading = driver.read()
        assert reading is not None
        np.testing.assert_allclose(reading.field_ut, FIELD_UT, atol=0.15)
        raw = np.frombuffer(bytes(chip.registers[0x03:0x09]), dtype="<i2")
        assert raw[0] == pytest.approx(FIELD_UT[1] / 0.15 / (1.0 - 68 / 256), abs=1)
        assert driver.self_test(clock).passed is None


def test_what_is_no_magnetometer_is_not_taken_for_one() -> None:
    with fifo_board("LSM6DSOX", config=BoardConfig(mag=True)) as (driver, virtual, clock):
        driver.close()
        other = VirtualLis3mdl(still, clock.now_ns)
        other.registers[0x0F] = 0x3E
        virtual.chips[0x1C] = other
        again = FifoBoard(BoardConfig(bus=virtual.path, mag=True), clock)
        assert again.magnetometer_name is None
