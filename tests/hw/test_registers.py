"""What each driver writes to its chip, in its order, held against a table of registers with its sources."""

import csv
from collections.abc import Callable
from itertools import groupby
from pathlib import Path

import pytest

from vislam.hw.chips import Adxl345, I2cBus, ImuSetup, Itg3205, find_any_magnetometer, find_imu
from vislam.hw.emulator import (
    EmulatedBus,
    SteppedClock,
    VirtualAdxl345,
    VirtualAkm,
    VirtualBmi270,
    VirtualHmc5883l,
    VirtualIcm20948,
    VirtualItg3205,
    VirtualLis3mdl,
    VirtualLsm6dsox,
    VirtualMpu6050,
    VirtualQmc5883,
)
from vislam.hw.emulator import emulated_bus as emulated
from vislam.hw.emulator.chips import Chip
from worlds.fifo_boards import FIRMWARE
from worlds.gy85 import still

SETUP = ImuSetup(200.0, 500, 8, str(FIRMWARE))
CHIPS: dict[str, tuple[int, type[Chip], dict[str, object]]] = {
    "ADXL345": (0x53, VirtualAdxl345, {}),
    "ITG3205": (0x68, VirtualItg3205, {}),
    "LSM6DSOX": (0x6A, VirtualLsm6dsox, {}),
    "ISM330DHCX": (0x6A, VirtualLsm6dsox, {"who_am_i": 0x6B}),
    "MPU-6050": (0x68, VirtualMpu6050, {}),
    "MPU-9250": (0x68, VirtualMpu6050, {"who_am_i": 0x71}),
    "ICM-20948": (0x69, VirtualIcm20948, {}),
    "BMI270": (0x68, VirtualBmi270, {}),
    "HMC5883L": (0x1E, VirtualHmc5883l, {}),
    "QMC5883L": (0x0D, VirtualQmc5883, {"variant": "L"}),
    "QMC5883P": (0x2C, VirtualQmc5883, {"variant": "P"}),
    "LIS3MDL": (0x1C, VirtualLis3mdl, {}),
    "AK09916": (0x0C, VirtualAkm, {}),
    "AK8963": (0x0C, VirtualAkm, {"variant": "AK8963"}),
}
TABLE = {
    chip: list(rows)
    for chip, rows in groupby(
        csv.DictReader(Path(__file__).with_name("registers.tsv").open(encoding="utf-8"), delimiter="\t"),
        key=lambda row: row["chip"],
    )
}


def set_up(chip: str, bus: I2cBus, clock: SteppedClock) -> None:
    if chip == "ADXL345":
        Adxl345(bus, 400, 16).configure()
    elif chip == "ITG3205":
        Itg3205(bus, 98).configure(clock)
    elif (found := find_any_magnetometer(bus, 1.9)) is not None:
        found.configure(clock)
    else:
        find_imu(bus, SETUP).configure(clock)


@pytest.mark.parametrize("chip", CHIPS)
def test_a_chip_is_set_up_by_the_registers_of_its_sources(chip: str, monkeypatch: pytest.MonkeyPatch) -> None:
    address, virtual, options = CHIPS[chip]
    clock, written = SteppedClock(), list[tuple[int, int]]()
    made = virtual(still, clock.now_ns, **options)  # type: ignore[arg-type]
    own: Callable[[bytes], None] = made.write

    def write(data: bytes) -> None:
        if len(data) == 2:  # longer: a BMI270's configuration
            written.append((data[0], data[1]))
        own(data)

    monkeypatch.setattr(made, "write", write)
    with emulated(EmulatedBus({address: made}, stepped=clock)) as bus:
        set_up(chip, I2cBus(bus.path, 0.02), clock)
    assert written == [(int(row["register"], 16), int(row["value"], 16)) for row in TABLE[chip]]
    assert all(row["source"] and row["name"] and row["meaning"] for row in TABLE[chip])


def test_the_table_has_every_chip_once() -> None:
    assert list(TABLE) == list(CHIPS)
