"""A virtual I2C adapter: answers what smbus2 asks of the kernel, with the faults that wires and plugs have."""

import ctypes
import errno
import importlib
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from vislam.hw.emulator.chips import Chip
from vislam.hw.emulator.stepped_clock import SteppedClock

_I2C_FUNC_I2C, _I2C_FUNC_SMBUS = 0x1, 0x0EFF0008
_RETRIES, _TIMEOUT, _SLAVE, _SLAVE_FORCE, _FUNCS, _RDWR, _SMBUS = 0x701, 0x702, 0x703, 0x706, 0x705, 0x707, 0x720
_BYTE_DATA, _BLOCK_DATA = 2, 8
_FIRST_FD, _FDS = 1_000_000_000, 100_000_000  # no process has as many files; openings of one bus


class EmulatedBus:
    """Chips by address, behind a device file that exists for smbus2 only.

    Attributes:
        chips: by address; taking one out or putting one in is a change of the board.
        nack_every: one transfer in this many is not acknowledged; 0: none.
        is_stuck: a line is held low: every transfer times out.
        busy: addresses that a kernel driver owns (only SMBus transfers ask for that).
        transfers: number asked for.
    """

    def __init__(
        self,
        chips: Mapping[int, Chip],
        path: str = "/dev/i2c-emulated",
        smbus_only: bool = False,
        one_read: bool = False,
        stepped: SteppedClock | None = None,
        bus_hz: float = 400_000.0,
    ) -> None:
        """Take the chips and the device file; a stepped clock is moved on by the time that transfers need at `bus_hz`.

        `smbus_only`: no combined messages; `one_read`: a read must be the last of them, as on a Raspberry Pi.
        """
        self.chips = dict(chips)
        self.path = path
        self.nack_every = 0
        self.is_stuck = False
        self.busy: set[int] = set()
        self.transfers = 0
        self._smbus_only, self._one_read, self._clock, self._bit_ns = smbus_only, one_read, stepped, 1e9 / bus_hz
        self._is_plugged = True
        self._address = -1
        self._timeout_ns = 1_000_000_000

    def unplug(self) -> None:
        """Take the adapter away: its device file vanishes, open descriptors fail."""
        self._is_plugged = False

    def replug(self) -> None:
        """Bring it back; the chips come up as after power-up."""
        self._is_plugged = True
        for chip in self.chips.values():
            chip.power_cycle()

    def open(self) -> None:
        """Raise what opening the device file raises."""
        if not self._is_plugged:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT), self.path)

    def ioctl(self, request: int, argument: Any) -> int:
        """Do what linux/i2c-dev.h defines for a request."""
        if not self._is_plugged:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        if request == _FUNCS:
            argument.value = _I2C_FUNC_SMBUS | (0 if self._smbus_only else _I2C_FUNC_I2C)
        elif request in (_SLAVE, _SLAVE_FORCE):
            if request == _SLAVE and argument in self.busy:
                raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
            self._address = argument
        elif request == _TIMEOUT:
            self._timeout_ns = argument * 10_000_000
        elif request == _RDWR and not self._smbus_only:
            self._count_transfer()
            self._combined(argument)
        elif request == _SMBUS:
            self._count_transfer()
            self._smbus(argument)
        elif request != _RETRIES:
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))
        return 0

    def _count_transfer(self) -> None:
        self.transfers += 1
        if self.is_stuck:
            self._spend(self._timeout_ns)
            raise OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
        if self.nack_every and self.transfers % self.nack_every == 0:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))

    def _spend(self, duration_ns: float) -> None:
        if self._clock is not None:
            self._clock.advance(round(duration_ns))

    def _chip(self, address: int, byte_count: int) -> Chip:
        self._spend((9 * (1 + byte_count) + 1) * self._bit_ns)
        chip = self.chips.get(address)
        if chip is None or not chip.is_on_bus:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        return chip

    def _combined(self, transfer: Any) -> None:
        count = transfer.nmsgs
        if count > 42 or (self._one_read and any(transfer.msgs[k].flags & 1 for k in range(count - 1))):
            error = errno.EINVAL if count > 42 else errno.EOPNOTSUPP
            raise OSError(error, os.strerror(error))
        for k in range(count):
            message = transfer.msgs[k]
            chip = self._chip(message.addr, message.len)
            if message.flags & 1:
                ctypes.memmove(message.buf, chip.read(message.len), message.len)
            else:
                chip.write(ctypes.string_at(message.buf, message.len))

    def _smbus(self, transfer: Any) -> None:
        data = transfer.data.contents
        if transfer.size not in (_BYTE_DATA, _BLOCK_DATA):
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))
        if not transfer.read_write:
            block = [data.byte] if transfer.size == _BYTE_DATA else data.block[1 : data.block[0] + 1]
            self._chip(self._address, 1 + len(block)).write(bytes([transfer.command, *block]))
            return
        length = 1 if transfer.size == _BYTE_DATA else data.block[0]
        chip = self._chip(self._address, 2 + length)
        chip.write(bytes([transfer.command]))
        answer = chip.read(length)
        if transfer.size == _BYTE_DATA:
            data.byte = answer[0]
        else:
            data.block[1 : length + 1] = list(answer)


class _FileFunctions:
    """Stands for module os inside smbus2: knows the virtual device files and leaves all others to the kernel."""

    O_RDWR = os.O_RDWR

    def __init__(self, inner: Any, bus: EmulatedBus, first_fd: int) -> None:
        self._inner, self._bus, self.first_fd, self._next_fd = inner, bus, first_fd, first_fd
        self.open_fds: set[int] = set()

    def open(self, path: str, flags: int) -> int:
        if path != self._bus.path:
            return int(self._inner.open(path, flags))
        self._bus.open()
        self._next_fd += 1
        self.open_fds.add(self._next_fd)
        return self._next_fd

    def close(self, fd: int) -> None:
        if fd in self.open_fds:
            self.open_fds.discard(fd)
        else:
            self._inner.close(fd)


@contextmanager
def emulated_bus(bus: EmulatedBus) -> Iterator[EmulatedBus]:
    """Let smbus2 find a virtual bus under `bus.path` while the block lasts; several may be nested.

    Only the file functions inside smbus2 are replaced, for the whole process; everything above them is the real one.
    """
    module: Any = importlib.import_module("smbus2.smbus2")
    inner_os, inner_ioctl = module.os, module.ioctl
    is_nested = isinstance(inner_os, _FileFunctions)
    files = _FileFunctions(inner_os, bus, inner_os.first_fd + _FDS if is_nested else _FIRST_FD)

    def ioctl(fd: int, request: int, argument: Any) -> Any:
        return bus.ioctl(request, argument) if fd in files.open_fds else inner_ioctl(fd, request, argument)

    module.os, module.ioctl = files, ioctl
    try:
        yield bus
    finally:
        module.os, module.ioctl = inner_os, inner_ioctl
