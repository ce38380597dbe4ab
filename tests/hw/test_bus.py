"""The bus under the real smbus2: what is read and written, on both kinds of adapter, and what its errors become."""

import errno
import sys

import pytest

from vislam.core.errors import HardwareError
from vislam.hw.chips.bus import MAX_READS, BusError, I2cBus, kernel_driver
from vislam.hw.emulator import EmulatedBus, SteppedClock, emulated_bus, emulated_gy85
from vislam.hw.emulator.chips import Chip
from worlds.gy85 import driving


class Memory(Chip):
    """Registers and nothing else."""


def memory_bus(**options: object) -> EmulatedBus:
    chip = Memory(driving, lambda: 0)
    chip.registers[:] = bytes(range(256))
    return EmulatedBus({0x50: chip}, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("smbus_only", [False, True])
def test_reads_and_writes_the_same_bytes_on_both_kinds_of_adapter(smbus_only: bool) -> None:
    with emulated_bus(memory_bus(smbus_only=smbus_only)) as virtual:
        bus = I2cBus(virtual.path, 0.02)
        assert bus.is_combined is not smbus_only
        assert bus.read(0x50, 0x10, 5) == bytes(range(0x10, 0x15))
        bus.write(0x50, 0x20, 0xAB)
        assert virtual.chips[0x50].registers[0x20] == 0xAB
        reads = bus.prepare([(0x50, 1, 2), (0x50, 8, 3), (0x50, 0x20, 1)])
        before = virtual.transfers
        assert reads.run() == bytes([1, 2, 8, 9, 10, 0xAB])
        assert virtual.transfers - before == (3 if smbus_only else 1)
        assert reads.run(2) == bytes([1, 2, 8, 9, 10])
        bus.close()
        bus.close()


def test_twenty_one_reads_fit_one_system_call_and_no_more_are_taken() -> None:
    with emulated_bus(memory_bus()) as virtual:
        bus = I2cBus(virtual.path, 0.02)
        reads = bus.prepare([(0x50, k, 1) for k in range(MAX_READS)])
        before = virtual.transfers
        assert reads.run() == bytes(range(MAX_READS))
        assert virtual.transfers == before + 1
        for wrong in ([(0x50, 0, 1)] * (MAX_READS + 1), [], [(0x50, 0, 33)], [(0x50, 0, 0)]):
            with pytest.raises(ValueError, match="1 to 21 reads"):
                bus.prepare(wrong)


def test_an_adapter_that_takes_one_read_per_call_is_asked_so() -> None:
    with emulated_bus(memory_bus(one_read=True)) as virtual:
        bus = I2cBus(virtual.path, 0.02)
        reads = bus.prepare([(0x50, 1, 2), (0x50, 8, 3), (0x50, 0x20, 1)])
        for _ in range(2):
            before = virtual.transfers
            assert reads.run() == bytes([1, 2, 8, 9, 10, 0x20])
            assert not bus.is_chained
        assert virtual.transfers - before == 3
        assert reads.run(2) == bytes([1, 2, 8, 9, 10])
        assert bus.counters.total() == 0


@pytest.mark.parametrize("smbus_only", [False, True])
def test_errors_have_a_kind_are_counted_and_end_with_exit_code_5(smbus_only: bool) -> None:
    with emulated_bus(memory_bus(smbus_only=smbus_only)) as virtual:
        bus = I2cBus(virtual.path, 0.02)
        assert not bus.answers(0x51)
        assert bus.counters["nack"] == 0, "asking who is there is no fault"
        with pytest.raises(BusError, match="0x51") as nack:
            bus.read(0x51, 0, 1)
        virtual.is_stuck = True
        with pytest.raises(BusError, match="held low") as timeout:
            bus.write(0x50, 0, 1)
        with pytest.raises(BusError):
            bus.answers(0x50)
        virtual.is_stuck = False
        virtual.unplug()
        with pytest.raises(BusError) as gone:
            bus.read(0x50, 0, 1)
        with pytest.raises(BusError, match="cannot be opened"):
            I2cBus(virtual.path, 0.02)
    assert (nack.value.kind, timeout.value.kind, gone.value.kind) == ("nack", "timeout", "gone")
    assert nack.value.exit_code == 5
    assert bus.counters == {"nack": 1, "timeout": 2, "gone": 1}


def test_the_limit_of_a_transfer_reaches_the_kernel() -> None:
    clock = SteppedClock()
    with emulated_bus(memory_bus(stepped=clock)) as virtual:
        bus = I2cBus(virtual.path, 0.02)
        virtual.is_stuck = True
        begin_ns = clock.now_ns()
        with pytest.raises(BusError):
            bus.read(0x50, 0, 1)
        assert clock.now_ns() - begin_ns == 20_000_000


@pytest.mark.parametrize("bus_hz", [100e3, 400e3])
def test_the_speed_of_the_bus_is_measured(bus_hz: float) -> None:
    clock = SteppedClock()
    with emulated_bus(memory_bus(stepped=clock, bus_hz=bus_hz)) as virtual:
        assert I2cBus(virtual.path, 0.02).measure_hz(0x50, 0, clock) == pytest.approx(bus_hz, rel=1e-3)


def test_a_busy_address_on_an_smbus_adapter() -> None:
    with emulated_bus(memory_bus(smbus_only=True)) as virtual:
        virtual.busy.add(0x50)
        with pytest.raises(BusError, match="kernel driver") as busy:
            I2cBus(virtual.path, 0.02).read(0x50, 0, 1)
    assert busy.value.kind == "busy"


def test_the_kernel_driver_of_an_address_is_found(tmp_path) -> None:
    device = tmp_path / "bus" / "i2c" / "devices" / "1-0053"
    driver = tmp_path / "bus" / "i2c" / "drivers" / "adxl345_i2c"
    device.mkdir(parents=True)
    driver.mkdir(parents=True)
    assert kernel_driver("/dev/i2c-1", 0x53, tmp_path) is None
    (device / "driver").symlink_to(driver)
    assert kernel_driver("/dev/i2c-1", 0x53, tmp_path) == "adxl345_i2c"
    assert kernel_driver("/dev/i2c-1", 0x68, tmp_path) is None


def test_smbus2_is_asked_for_when_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("smbus2", "smbus2.smbus2"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(HardwareError, match=r"pip install '\.\[hw\]'"):
        I2cBus("/dev/i2c-1", 0.02)


def test_the_emulation_leaves_nothing_behind_and_other_files_alone(tmp_path) -> None:
    import smbus2.smbus2 as module

    real = module.os, module.ioctl
    outer, inner = memory_bus(path="/dev/i2c-outer"), memory_bus(path="/dev/i2c-inner")
    inner.chips[0x50].registers[0] = 77
    with emulated_bus(outer), emulated_bus(inner):
        assert I2cBus(outer.path, 0.02).read(0x50, 0, 1) == b"\0"
        assert I2cBus(inner.path, 0.02).read(0x50, 0, 1) == bytes([77])
        with pytest.raises(BusError) as other:
            I2cBus(str(tmp_path / "absent"), 0.02)
        (tmp_path / "file").write_bytes(b"x")
        with pytest.raises(BusError):  # a plain file takes no such requests
            I2cBus(str(tmp_path / "file"), 0.02)
    assert other.value.kind == "gone"
    assert (module.os, module.ioctl) == real
    with pytest.raises(BusError):
        I2cBus(outer.path, 0.02)


def test_every_so_many_transfers_fail_when_asked_to() -> None:
    clock = SteppedClock()
    with emulated_bus(emulated_gy85(driving, clock.now_ns)) as virtual:
        bus = I2cBus(virtual.path, 0.02)
        virtual.nack_every = 3
        failed = 0
        for _ in range(30):
            try:
                bus.read(0x53, 0, 1)
            except BusError as error:
                assert isinstance(error.__cause__, OSError)
                assert error.__cause__.errno == errno.EREMOTEIO
                failed += 1
        assert failed == 10
