"""What chips with a FIFO say, byte by byte: decoding, pairing, scales, and what is written to their registers."""

import errno
import re
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core.errors import HardwareError
from vislam.hw.chips import BusError, I2cBus, ImuSetup, SettingsLostError, bmi270, icm20948, identify, lsm6dsox, mpu6050
from vislam.hw.chips.fifo_imu import divided, next_of
from vislam.hw.chips.known import find_imu
from vislam.hw.emulator import (
    EmulatedBus,
    FifoChip,
    SensorError,
    SteppedClock,
    VirtualBmi270,
    VirtualIcm20948,
    VirtualLsm6dsox,
    VirtualMpu6050,
    emulated_bus,
)
from worlds.fifo_boards import FIRMWARE
from worlds.gy85 import still

SETUP = ImuSetup(200.0, 500, 8)
COUNTS = st.tuples(*[st.integers(-32768, 32767)] * 3)


class Words:
    """A chip at 0x6a whose FIFO gives words that a test has put there."""

    def __init__(self, data: bytes) -> None:
        self.data, self.pointer = bytearray(data), 0

    is_on_bus = True

    def power_cycle(self) -> None: ...

    def write(self, data: bytes) -> None:
        self.pointer = data[0]

    def read(self, count: int) -> bytes:
        assert self.pointer == 0x78
        taken, self.data = bytes(self.data[:count]), self.data[count:]
        return taken


@contextmanager
def alone(
    driver: Any, virtual: type[FifoChip], setup: ImuSetup = SETUP, is_configured: bool = True, **options: Any
) -> Iterator[tuple[Any, Any, EmulatedBus, SteppedClock]]:
    """Yield a driver, its virtual chip at the usual address, their bus and the clock that transfers move on."""
    clock = SteppedClock()
    own = {k: options.pop(k) for k in ("who_am_i", "gyro", "accel") if k in options}
    chip = virtual(options.pop("truth", still), clock.now_ns, **own)
    address = 0x6A if issubclass(virtual, VirtualLsm6dsox) else 0x69 if virtual is VirtualIcm20948 else 0x68
    bus = EmulatedBus({address: chip}, stepped=clock, **options)
    with emulated_bus(bus):
        made = driver(I2cBus(bus.path, 0.02), setup)
        if is_configured:
            made.configure(clock)
        yield made, chip, bus, clock


def word(sensor: int, slot: int, counts: tuple[int, ...]) -> bytes:
    tag = sensor << 3 | (slot & 3) << 1
    return bytes((tag | tag.bit_count() & 1,)) + struct.pack("<3h", *counts)


@given(st.lists(st.tuples(COUNTS, COUNTS), min_size=1, max_size=60), st.booleans(), st.integers(1, 41))
def test_words_of_the_lsm6dsox_are_paired_by_their_slot(
    samples: list[tuple[tuple[int, ...], tuple[int, ...]]], gyro_first: bool, at_once: int
) -> None:
    data = word(2, 3, (7, 7, 7)) + word(3, 3, (1, 2, 3))  # no gyro yet, and a temperature
    for slot, (gyro, accel) in enumerate(samples):
        words = [word(1, slot, gyro), word(2, slot, accel)]
        data += b"".join(words if gyro_first else reversed(words))
    bus = EmulatedBus({0x6A: Words(data)})  # type: ignore[dict-item]
    with emulated_bus(bus):
        chip = lsm6dsox.Lsm6dsox(I2cBus(bus.path, 0.02), SETUP)
        got_gyro, got_accel, left = [], [], len(data) // 7
        while left:
            raw = chip.take(min(at_once, left))
            left -= min(at_once, left)
            assert len(raw.gyro) == len(raw.accel)
            got_gyro += raw.gyro.tolist()
            got_accel += raw.accel.tolist()
    assert got_gyro == [list(map(float, gyro)) for gyro, _ in samples]
    assert got_accel == [list(map(float, accel)) for _, accel in samples]


@given(st.binary(min_size=0, max_size=700))
def test_any_bytes_in_the_fifo_of_an_lsm6dsox_give_finite_pairs_or_nothing(data: bytes) -> None:
    whole = data[: len(data) // 7 * 7]
    bus = EmulatedBus({0x6A: Words(whole)})  # type: ignore[dict-item]
    with emulated_bus(bus):
        raw = lsm6dsox.Lsm6dsox(I2cBus(bus.path, 0.02), SETUP).take(len(whole) // 7)
    assert len(raw.gyro) == len(raw.accel) <= len(whole) // 14
    assert np.isfinite(raw.gyro).all()
    assert (abs(raw.accel) <= 32768).all()


@given(st.lists(st.tuples(COUNTS, COUNTS), max_size=85))
def test_bytes_of_the_mpu_are_accelerometer_then_gyro_high_byte_first(
    samples: list[tuple[tuple[int, ...], tuple[int, ...]]],
) -> None:
    raw = mpu6050.decoded(b"".join(struct.pack(">6h", *accel, *gyro) for gyro, accel in samples))
    assert raw.gyro.tolist() == [list(gyro) for gyro, _ in samples]
    assert raw.accel.tolist() == [list(accel) for _, accel in samples]


def test_the_oscillator_s_own_error_is_taken_from_the_chip() -> None:
    clock = SteppedClock()
    for raw, share in ((0x7F, 0.1905), (0x80, -0.192), (0xFF, -0.0015)):
        chip = VirtualLsm6dsox(still, clock.now_ns, SensorError(rate_error=share))
        bus = EmulatedBus({0x6A: chip}, stepped=clock)
        with emulated_bus(bus):
            driver = lsm6dsox.Lsm6dsox(I2cBus(bus.path, 0.02), SETUP)
            driver.configure(clock)
        assert chip.registers[0x63] == raw
        assert driver.rate_hz == pytest.approx(6667.0 / 32 * (1.0 + share))


@pytest.mark.parametrize("who_am_i", [0x72, 0x74, 0x78, 0x98])
def test_a_clone_is_named_by_its_register_and_taken_as_asked(who_am_i: int) -> None:
    words = f"0x68 is likely a clone of the MPU-6050 \\(0x{who_am_i:02x} in register 0x75\\).*--imu mpu6050-clone"
    with alone(mpu6050.Mpu6050, VirtualMpu6050, is_configured=False, who_am_i=who_am_i) as (_, chip, bus, clock):
        found = identify(I2cBus(bus.path, 0.02))
        assert [(f.name, f.clone) for f in found] == [
            (f"likely a clone of the MPU-6050 (0x{who_am_i:02x} in register 0x75)", "mpu6050-clone")
        ]
        for chip_name in ("auto", "mpu6050"):
            with pytest.raises(HardwareError, match=words):
                find_imu(I2cBus(bus.path, 0.02), SETUP, chip_name)
        taken = find_imu(I2cBus(bus.path, 0.02), replace(SETUP, named="mpu6050-clone"))
        taken.configure(clock)
        assert taken.name == f"MPU-6050 clone 0x{who_am_i:02x}"
        assert chip.registers[0x1D] == 2, "the filter that an MPU-6500 has"


HALF = SensorError(scale=(0.5, 0.5, 0.5))


def tilting(t_ns: int):  # type: ignore[no-untyped-def]
    return (0.0, 0.0, 0.0), (2e-9 * t_ns % 100.0, 0.0, 9.8), (20.0, 0.0, -42.0), 30.0


def shaking(t_ns: int):  # type: ignore[no-untyped-def]
    return (0.0, 0.1 * np.sin(t_ns * 1e-8), 0.0), (0.0, 0.0, 9.8), (20.0, 0.0, -42.0), 30.0


@pytest.mark.parametrize("who_am_i", [0x68, 0x71, 0x98])
@pytest.mark.parametrize(
    ("options", "says", "passed", "words", "next_step"),
    [
        ({}, {}, True, "gyroscope responds with 1.00 1.00 1.00 .*; the accelerometer responds with 1.00 1.00 1.00", ""),
        ({"gyro": HALF}, {}, False, r"gyroscope's scale is off: x 0.50 .* y 0.50 .* asked\), 0.*1", "calibrate imu"),
        ({"accel": HALF}, {}, False, r"gyroscope responds.*accelerometer's scale is off: x 0.50", "calibrate imu"),
        ({"gyro": SensorError(scale=(1.0, 1.0, 2.0))}, {}, False, "gyroscope's scale is off: z 2.00", "calibrate imu"),
        ({}, {"codes": (0,) * 6}, None, "gyroscope's.*no trim.*accelerometer's.*no trim", "calibrate imu"),
        ({}, {"codes": (7, 12, 20, 5, 0, 31)}, None, "gyroscope responds.*accelerometer's.*no trim", "calibrate imu"),
        ({}, {"responds": False}, None, "gyroscope's scale cannot be judged: it does not respond", "calibrate imu"),
        ({"truth": tilting}, {}, None, "accelerometer's scale cannot be judged: it moved", "stand still"),
        ({"truth": shaking}, {}, None, "gyroscope's scale cannot be judged: it moved", "stand still"),
    ],
)
def test_an_mpu_judges_its_scales_by_its_trims(
    who_am_i: int, options: Any, says: dict[str, Any], passed: bool | None, words: str, next_step: str
) -> None:
    with alone(
        mpu6050.Mpu6050, VirtualMpu6050, replace(SETUP, named="mpu6050-clone"), False, who_am_i=who_am_i, **options
    ) as (driver, chip, _, clock):
        for name, value in says.items():
            setattr(chip, name, value)
        driver.configure(clock)
        before = bytes(chip.registers[:0x3A])
        test = driver.self_test(clock)
        assert test.passed is passed, test.what
        assert re.search(words, test.what), test.what
        assert next_step in test.next_step
        assert bool(test.next_step) == bool(next_step)
        assert bytes(chip.registers[:0x3A]) == before
        clock.advance(50_000_000)
        assert driver.waiting().units in (9, 10)


def test_a_self_test_that_breaks_off_restores_an_mpu() -> None:
    with alone(mpu6050.Mpu6050, VirtualMpu6050) as (driver, chip, bus, clock):
        seen, take = set(), driver.take

        def failing(units: int) -> Any:
            seen.add(bytes(chip.registers[0x1B:0x1D]))
            if len(seen) == 2:
                raise BusError(bus.path, OSError(errno.EREMOTEIO, "no acknowledge"))
            return take(units)

        driver.take = failing
        with pytest.raises(BusError):
            driver.self_test(clock)
        assert seen == {b"\x00\x10", b"\xe0\xf0"}, "250 deg/s and 8 g, then with the stimulus"
        assert bytes(chip.registers[0x1B:0x1D]) == b"\x08\x10"
        driver.take, chip.is_frozen = take, True
        silent = driver.self_test(clock)
        assert (silent.passed, silent.what) == (None, "fewer than 20 samples came in time")


@pytest.mark.parametrize("who_am_i", [0x00, 0x19, 0xFF])
def test_of_a_chip_that_is_none_of_its_address_each_register_is_named(who_am_i: int) -> None:
    with alone(mpu6050.Mpu6050, VirtualMpu6050, is_configured=False, who_am_i=who_am_i) as (_, chip, bus, _):
        chip.registers[0x00] = 0xC1
        assert [f.name for f in identify(I2cBus(bus.path, 0.02))] == [
            "unknown chip (0xc1 in register 0x00: no ITG3205 or ICM-20948 or BMI270; "
            f"0x{who_am_i:02x} in register 0x75: no MPU-6050 or MPU-6500 or MPU-9250 or MPU-9255)"
        ]
        with pytest.raises(HardwareError, match=f"0xc1 in register 0x00; 0x68 has 0x{who_am_i:02x} in register 0x75"):
            find_imu(I2cBus(bus.path, 0.02), replace(SETUP, named="mpu6050-clone"))


def test_an_overflow_of_an_mpu_loses_the_boundaries_and_is_thrown_away() -> None:
    with alone(mpu6050.Mpu6050, VirtualMpu6050) as (driver, chip, _, clock):
        clock.advance(420_500_000)
        assert driver.waiting().units == 84, "1024 bytes hold one more, which is left as a margin"
        clock.advance(20_000_000)
        assert len(chip.fifo) > 0
        found = driver.waiting()
        assert (found.units, found.is_overrun) == (0, True)
        clock.advance(20_000_000)
        assert driver.waiting().units in (3, 4)
        raw = driver.take(3)
        np.testing.assert_allclose(raw.accel[:, 2], 4096, atol=1)


def test_an_overrun_of_an_lsm6dsox_leaves_the_newest_512_words() -> None:
    with alone(lsm6dsox.Lsm6dsox, VirtualLsm6dsox) as (driver, _, _, clock):
        clock.advance(5_000_000_000)
        found = driver.waiting()
        assert (found.units, found.is_overrun) == (512, True)
        assert len(driver.take(512)) == 256
        found = driver.waiting()
        assert found.units < 50
        assert not found.is_overrun, "told once"


class Dumb(VirtualLsm6dsox):
    """Keeps what is written, and does nothing of it."""

    def _write_register(self, register: int, value: int) -> None:
        self.registers[register] = value


def test_a_chip_that_never_leaves_its_reset_is_refused() -> None:
    with (
        alone(lsm6dsox.Lsm6dsox, Dumb, is_configured=False) as (driver, _, _, clock),
        pytest.raises(HardwareError, match="does not come out of its reset"),
    ):
        driver.configure(clock)


def test_a_transfer_that_breaks_off_is_a_bus_error() -> None:
    clock = SteppedClock()
    chip = VirtualMpu6050(still, clock.now_ns)
    bus = EmulatedBus({0x68: chip}, stepped=clock)
    with emulated_bus(bus):
        counts: Counter[str] = Counter()
        driver = mpu6050.Mpu6050(I2cBus(bus.path, 0.02, counts), SETUP)
        driver.configure(clock)
        bus.nack_every = 1
        with pytest.raises(BusError, match="vislam doctor"):
            driver.waiting()
        assert counts["nack"] == 1


def test_the_next_rate_and_range_that_a_chip_has() -> None:
    assert next_of(300, {250: 0, 500: 1}) == 500
    assert next_of(9000, {250: 0, 500: 1}) == 500
    assert divided(200.0, 1000.0) == 5
    assert divided(300.0, 1000.0) == 3
    assert divided(1.0, 1000.0) == 256
    assert divided(5000.0, 1000.0) == 1


def test_what_is_written_to_an_icm20948_is_in_the_right_bank() -> None:
    with alone(icm20948.Icm20948, VirtualIcm20948, is_configured=False) as (driver, chip, _, clock):
        chip.registers[0x7F] = 0x20  # another program left it there
        driver.configure(clock)
        assert (chip.banks[2][0x00], chip.banks[2][0x11], chip.registers[0x7F]) == (4, 4, 0), "1125 Hz / 5"
        assert driver.rate_hz == 225.0
        clock.advance(200_000_000)
        assert driver.waiting().is_overrun
        clock.advance(50_000_000)
        assert driver.waiting().units == 11
        np.testing.assert_allclose(driver.take(11).accel[:, 2], 4096, atol=1)
        chip.power_cycle()
        with pytest.raises(SettingsLostError, match="401e"):
            driver.temperature_c()


@pytest.mark.parametrize("size", [328, 8192])
@pytest.mark.parametrize("cas", [-64, -21, 0, 63])
def test_what_the_rate_about_z_leaks_into_x_of_a_bmi270_is_taken_off(tmp_path: Path, size: int, cas: int) -> None:
    """`gx - cas * gz / 512`, cas in 0x1E for bmi270_maximum_fifo, else in 0x3C: Bosch's bmi2.c."""
    file = tmp_path / "whole.bin"
    file.write_bytes(bytes(size))

    def turning(t_ns: int) -> Any:
        return (0.1, 0.0, 2.0), (0.0, 0.0, 9.81), (20.0, 0.0, -42.0), 30.0

    clock = SteppedClock()
    chip = VirtualBmi270(turning, clock.now_ns)
    chip.cas = cas
    with emulated_bus(EmulatedBus({0x68: chip}, stepped=clock)) as bus:
        driver = bmi270.Bmi270(I2cBus(bus.path, 0.02), replace(SETUP, firmware=str(file)))
        driver.configure(clock)
        clock.advance(100_000_000)
        raw = driver.take(driver.waiting().units)
    np.testing.assert_allclose(raw.gyro[-1] * driver.gyro_rad_s, [0.1, 0.0, 2.0], atol=driver.gyro_rad_s)


@pytest.mark.parametrize("smbus_only", [False, True])
def test_a_bmi270_is_sent_its_configuration_byte_for_byte(tmp_path: Path, smbus_only: bool) -> None:
    file = tmp_path / "whole.bin"
    file.write_bytes(bytes(k * 7 & 0xFF for k in range(8192)))
    setup = replace(SETUP, firmware=str(file))
    with alone(bmi270.Bmi270, VirtualBmi270, setup, False, smbus_only=smbus_only) as (driver, chip, _, clock):
        begin_ns = clock.now_ns()
        driver.configure(clock)
        assert chip.given == file.read_bytes()
        assert clock.now_ns() - begin_ns < 300_000_000
        chip.power_cycle()
        with pytest.raises(SettingsLostError, match="a902e902"):
            driver.temperature_c()
        chip.takes = False
        with pytest.raises(HardwareError, match=r"does not take its configuration \(status 2\); Bosch"):
            driver.configure(clock)


def test_the_configuration_of_a_bmi270_is_bytes_or_a_c_file(tmp_path: Path) -> None:
    assert len(bmi270.configuration(str(FIRMWARE))) == 40
    (tmp_path / "a.c").write_text("const uint8_t bmi270_config_file[] = {\n 0xc8, 0x2E,\n 0x00, 0x1 };\nint x = 0xff;")
    assert bmi270.configuration(str(tmp_path / "a.c")) == bytes((0xC8, 0x2E, 0x00, 0x01))
    (tmp_path / "empty.c").write_text("int x = 3;")
    (tmp_path / "odd.bin").write_bytes(bytes(3))
    (tmp_path / "long.bin").write_bytes(bytes(9000))
    for name, size in (("empty.c", 0), ("odd.bin", 3), ("long.bin", 9000)):
        with pytest.raises(HardwareError, match=f"holds {size} bytes of configuration, 2 to 8192 are needed"):
            bmi270.configuration(str(tmp_path / name))
    with pytest.raises(HardwareError, match="needs its configuration file; Bosch's driver"):
        bmi270.configuration(None)
    with pytest.raises(HardwareError, match="No such file"):
        bmi270.configuration(str(tmp_path / "absent.bin"))
    with pytest.raises(HardwareError, match="directory"):
        bmi270.configuration(str(tmp_path))


@given(st.binary(max_size=300))
def test_any_file_of_configuration_is_taken_or_refused(data: bytes) -> None:
    with TemporaryDirectory() as folder:
        for name in ("any.c", "any.bin"):
            path = Path(folder) / name
            path.write_bytes(b"config_file[] = {" + data)
            with suppress(HardwareError):
                assert 0 < len(bmi270.configuration(str(path))) <= 8192
