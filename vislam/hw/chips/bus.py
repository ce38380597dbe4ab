"""An I2C bus through smbus2: several register reads in one system call, no wait without a limit, counted errors."""

from __future__ import annotations

import ctypes
import errno
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vislam.core.errors import HardwareError, install_line
from vislam.hw.timing import Clock

if TYPE_CHECKING:
    import smbus2

MAX_READS = 21  # in one system call: the kernel takes 42 messages, two per read
_I2C_RETRIES, _I2C_TIMEOUT = 0x0701, 0x0702  # linux/i2c-dev.h; smbus2 does not name them
_KINDS = {
    errno.EREMOTEIO: "nack",
    errno.ENXIO: "nack",
    errno.ETIMEDOUT: "timeout",
    errno.EIO: "timeout",
    errno.EAGAIN: "timeout",  # arbitration lost: a line is held low
    errno.EBUSY: "busy",
    errno.ENODEV: "gone",
    errno.EBADF: "gone",
    errno.ENOENT: "gone",
    errno.EACCES: "permission",
}
_NEXT_STEP = {
    "nack": "check the chip's power and wires; `vislam doctor` lists what answers",
    "timeout": "a line is held low: check for a short circuit, or switch the board's power off and on",
    "busy": "a kernel driver owns the address: unbind it; `vislam doctor` shows how",
    "gone": "the adapter is not there: plug it in, or enable I2C (raspi-config); `vislam doctor` lists buses",
    "permission": "add yourself to the group that owns the device (usually: sudo usermod -aG i2c $USER), log in again",
    "other": "run `vislam doctor`",
}


class BusError(HardwareError):
    """A transfer failed; `kind` is nack, timeout, busy, gone, permission or other."""

    def __init__(self, what: str, error: OSError) -> None:
        """Say what was tried and why it failed."""
        self.kind = _KINDS.get(error.errno or 0, "other")
        super().__init__(f"{what}: {error.strerror or error}; {_NEXT_STEP[self.kind]}")


class SettingsLostError(HardwareError):
    """A chip no longer has the settings that it was given: it was without power for a moment; set it up again."""


def kept(name: str, data: bytes, given: bytes) -> bytes:
    """Return what follows the settings that data begin with; raises SettingsLostError where they are others."""
    if data[: len(given)] != given:
        raise SettingsLostError(f"{name}: settings {data[: len(given)].hex()}, given {given.hex()}")
    return data[len(given) :]


def _load_smbus2() -> Any:
    try:
        import smbus2.smbus2 as module
    except ImportError as error:
        raise HardwareError(f"sensors on I2C need smbus2; install it: {install_line('hw')}") from error
    return module


class I2cBus:
    """One adapter, such as /dev/i2c-1; one thread, one user.

    Where the kernel offers plain I2C, reads are combined messages (I2C_RDWR); else SMBus block reads, one by one. The
    adapter of a Raspberry Pi (i2c-bcm2835) takes one read per call: that shows at the first longer one.

    Attributes:
        path: of the device file.
        is_combined: there are combined messages.
        is_chained: several reads fit one call.
        counters: failed transfers by kind; pass a counter in to go on counting after a reopening.
    """

    def __init__(self, path: str, timeout_s: float, counters: Counter[str] | None = None) -> None:
        """Open the bus and bound its transfers.

        Raises:
            BusError: the device file cannot be opened.
            HardwareError: smbus2 is not installed.
        """
        self.path = path
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._smbus2 = _load_smbus2()
        try:
            self._bus: smbus2.SMBus = self._smbus2.SMBus(path)
        except OSError as error:
            raise self._failed("it cannot be opened", error) from error
        self.is_combined = bool(self._bus.funcs & self._smbus2.I2cFunc.I2C)
        self.is_chained = self.is_combined
        for request, value in ((_I2C_TIMEOUT, max(round(timeout_s * 100.0), 1)), (_I2C_RETRIES, 0)):
            try:
                self._smbus2.ioctl(self._bus.fd, request, value)
            except OSError:
                self.counters["timeout_refused"] += 1  # an adapter that does not know it keeps its own limit, 1 s

    def read(self, address: int, register: int, length: int) -> bytes:
        """Read registers from `register` on; raises BusError."""
        return self.prepare([(address, register, length)]).run()

    def prepare(self, reads: Sequence[tuple[int, int, int]]) -> Reads:
        """Return reads of (address, register, length) that run again and again, in one system call if possible."""
        return Reads(self, reads)

    def write(self, address: int, register: int, value: int) -> None:
        """Write one register; raises BusError."""
        try:
            if self.is_combined:
                self._bus.i2c_rdwr(self._smbus2.i2c_msg.write(address, [register, value]))
            else:
                self._bus.write_byte_data(address, register, value)
        except OSError as error:
            raise self._failed(f"write of register 0x{register:02x} at 0x{address:02x}", error) from error

    def write_block(self, address: int, register: int, data: bytes) -> None:
        """Write registers from `register` on, or one that takes a row of bytes, 1 to 32; raises BusError."""
        try:
            if self.is_combined:
                self._bus.i2c_rdwr(self._smbus2.i2c_msg.write(address, [register, *data]))
            else:
                self._bus.write_i2c_block_data(address, register, list(data))
        except OSError as error:
            raise self._failed(f"write of register 0x{register:02x} at 0x{address:02x}", error) from error

    def answers(self, address: int, register: int = 0, times: int = 1) -> bool:
        """Return whether a chip lets one register be read, asked up to `times`; a silent address is no fault.

        Raises BusError for anything else than silence.
        """
        read = self.prepare([(address, register, 1)])
        for _ in range(times):
            try:
                read.transfer(1)
                return True
            except OSError as error:
                if _KINDS.get(error.errno or 0) != "nack":
                    raise self._failed(f"read of register 0x{register:02x} at 0x{address:02x}", error) from error
        return False

    def measure_hz(self, address: int, register: int, clock: Clock) -> float:
        """Return the clock of the bus in Hz, from the time that 31 bytes more take; they cost 9 bits each.

        Reads 32 registers from `register` on, which reading must not change. Raises BusError when none can be read.
        """
        fastest = []
        for length in (1, 32):
            read = self.prepare([(address, register, length)])
            durations = []
            for _ in range(20):
                start = clock.now_ns()
                with suppress(BusError):
                    read.run()
                    durations.append(clock.now_ns() - start)
            if not durations:
                read.run()
            fastest.append(min(durations))
        return 31 * 9 * 1e9 / max(fastest[1] - fastest[0], 1)

    def close(self) -> None:
        """Close the device file; may be called twice."""
        try:
            self._bus.close()
        except OSError:
            self.counters["close_failed"] += 1

    def _failed(self, what: str, error: OSError) -> BusError:
        failure = BusError(f"{self.path}: {what}", error)
        self.counters[failure.kind] += 1
        return failure


class Reads:
    """Register reads whose messages and buffer are made once; see `I2cBus.prepare`."""

    def __init__(self, bus: I2cBus, reads: Sequence[tuple[int, int, int]]) -> None:
        """Lay out the messages; at most MAX_READS reads of at most 32 bytes each."""
        if not 0 < len(reads) <= MAX_READS or not all(0 < length <= 32 for _, _, length in reads):
            raise ValueError(f"1 to {MAX_READS} reads of 1 to 32 bytes, asked for {list(reads)}")
        self._bus = bus
        self._reads = tuple(reads)
        self._buffer = ctypes.create_string_buffer(sum(length for _, _, length in reads))
        self._ends: list[int] = []
        self._messages: list[Any] = []
        message = bus._smbus2.i2c_msg
        place = 0
        for address, register, length in reads:
            self._messages.append(message.write(address, [register]))
            target = ctypes.cast(ctypes.byref(self._buffer, place), ctypes.POINTER(ctypes.c_char))
            self._messages.append(message(address, bus._smbus2.I2C_M_RD, length, target))
            place += length
            self._ends.append(place)

    def run(self, count: int | None = None) -> bytes:
        """Run the first `count` reads (None: all) and return their bytes, one after the other; raises BusError."""
        try:
            return self.transfer(len(self._reads) if count is None else count)
        except OSError as error:
            address, register, _ = self._reads[0]
            raise self._bus._failed(f"read of register 0x{register:02x} at 0x{address:02x}", error) from error

    def transfer(self, count: int) -> bytes:
        """As `run`, but lets the kernel's OSError through, uncounted."""
        bus = self._bus
        if bus.is_combined:
            chained = count if bus.is_chained else 1
            for first in range(0, 2 * count, 2 * chained):
                try:
                    bus._bus.i2c_rdwr(*self._messages[first : first + 2 * chained])
                except OSError as error:
                    if error.errno != errno.EOPNOTSUPP or chained == 1:
                        raise
                    bus.is_chained = False
                    return self.transfer(count)
            return ctypes.string_at(self._buffer, self._ends[count - 1])
        return b"".join(bytes(bus._bus.read_i2c_block_data(*read)) for read in self._reads[:count])


def kernel_driver(path: str, address: int, sysfs: Path = Path("/sys")) -> str | None:
    """Return the name of the kernel driver that owns an address, None if there is none.

    Combined messages do not ask the kernel who owns an address, so two drivers would disturb each other unseen.
    """
    number = path.rpartition("-")[2]
    link = sysfs / "bus" / "i2c" / "devices" / f"{number}-{address:04x}" / "driver"
    return link.resolve().name if link.exists() else None


def unbind_command(path: str, address: int, driver: str) -> str:
    """Return the shell command that takes a chip away from a kernel driver."""
    return f"echo {path.rpartition('-')[2]}-{address:04x} | sudo tee /sys/bus/i2c/drivers/{driver}/unbind"
