"""What a board asks of an inertial chip that keeps its samples in a FIFO until they are fetched."""

from dataclasses import dataclass

import numpy as np

from vislam.core.errors import HardwareError
from vislam.core.messages import Array
from vislam.hw.chips.bus import MAX_READS, I2cBus, Reads, kept
from vislam.hw.timing import Clock

G_M_S2 = 9.80665
SATURATED_LSB = 32767  # 16 bits; an axis at this value or beyond
SAMPLES, _MOST_PERIODS = 20, 80


@dataclass(frozen=True, slots=True)
class ImuSetup:
    """What is asked of a chip; each takes the next that it has."""

    rate_hz: float  # the next higher one
    gyro_range_deg_s: int
    accel_range_g: int
    firmware: str | None = None  # file that the chip needs at every start
    named: str = ""  # as a command line names it: of chips with one id, and of clones, only the user knows which it is


@dataclass(frozen=True, slots=True)
class Waiting:
    """What a FIFO holds."""

    units: int  # words or samples, as the chip counts
    is_overrun: bool  # some were lost before these


@dataclass(frozen=True, slots=True, eq=False)
class RawSamples:
    """Samples of gyro and accelerometer taken together, oldest first, in counts."""

    gyro: Array  # [N, 3]
    accel: Array  # [N, 3]

    def __len__(self) -> int:
        return len(self.gyro)


NO_SAMPLES = RawSamples(np.zeros((0, 3)), np.zeros((0, 3)))


class FifoImu:
    """Gyro and accelerometer of one chip, sampled together by its own clock.

    Attributes:
        name: as its maker calls it.
        address: on the bus.
        rate_hz: samples per second by the chip's nominal clock; after `configure` as well as the chip knows it.
        gyro_rad_s: of a count.
        accel_m_s2: of a count.
        gyro_delay_s: by which the gyro's filter is late.
        accel_delay_s: by which the accelerometer's is.
        start_up_s: after `configure` until its samples are good.
        max_zero_deg_s: of the gyro at rest, by the data sheet.
        doubt: why the id does not settle the scale; empty: it does.
    """

    start_up_s = 0.1
    max_zero_deg_s = 5.0
    doubt = ""
    rate_hz: float
    gyro_rad_s: float
    accel_m_s2: float
    gyro_delay_s: float
    accel_delay_s: float
    _watch: Reads  # settings that a chip without power for a moment loses, and two bytes of its temperature
    _kept: bytes  # what those settings are to be
    _pops: Reads  # `MAX_READS` of what is fetched out of the FIFO at once

    def __init__(self, bus: I2cBus, address: int, name: str) -> None:
        """Take where it is; nothing is sent yet."""
        self._bus, self.address, self.name = bus, address, name

    def configure(self, clock: Clock) -> None:
        """Reset the chip, set it up and start it with an empty FIFO; raises BusError, HardwareError."""
        raise NotImplementedError

    def waiting(self) -> Waiting:
        """Return what the FIFO holds, in one short transfer; raises BusError.

        Where bytes are overwritten one by one nothing begins where a sample does after an overflow: it is emptied.
        """
        raise NotImplementedError

    def take(self, units: int) -> RawSamples:
        """Take `units` units out of the FIFO, as `waiting` counted them; raises BusError: then `empty` it."""
        raise NotImplementedError

    def empty(self) -> None:
        """Throw away what the FIFO holds, and begin at the boundary of a sample; raises BusError."""
        raise NotImplementedError

    def temperature_c(self) -> float:
        """Return the chip's temperature; raises BusError, and SettingsLostError where it lost its settings."""
        return self._celsius(kept(self.name, self._watch.run(), self._kept))

    def _celsius(self, data: bytes) -> float:
        """Return the temperature [deg C] in two bytes."""
        raise NotImplementedError

    def _identified(self, register: int, names: dict[int, str]) -> tuple[str, int]:
        """Return name and id of the chip that answers; raises HardwareError for one that is not among `names`."""
        found = self._read(register)[0]
        if found in names:
            return names[found], found
        known = ", ".join(f"{name} 0x{value:02x}" for value, name in names.items())
        raise HardwareError(
            f"{self._bus.path}: the chip at 0x{self.address:02x} has the id 0x{found:02x}, expected {known}; check the "
            "board, `vislam doctor` lists what answers"
        )

    def _popped(self, units: int) -> bytes:
        """Return `units` units of the FIFO."""
        counts = (min(units - first, MAX_READS) for first in range(0, units, MAX_READS))
        return b"".join(self._pops.run(count) for count in counts)

    def _read(self, register: int, length: int = 1) -> bytes:
        return self._bus.read(self.address, register, length)

    def _write(self, register: int, *values: int) -> None:
        """Write one register, and those that follow it."""
        for offset, value in enumerate(values):
            self._bus.write(self.address, register + offset, value)

    def _await_reset(self, clock: Clock, register: int, bit: int, wait_s: float, times: int = 1) -> None:
        """Wait until a chip has cleared the bit that resets it."""
        for _ in range(times):
            clock.sleep_until(clock.now_ns() + round(wait_s * 1e9))
            if not self._read(register)[0] & bit:
                return
        raise HardwareError(f"{self._bus.path}: the {self.name} does not come out of its reset; check its supply")

    def _whole(self, count: int, is_overrun: bool, fifo_bytes: int, sample_bytes: int) -> Waiting:
        """Return how many whole samples a FIFO of bytes holds; none, and it is emptied, after an overflow."""
        if is_overrun or count > fifo_bytes - sample_bytes:
            self.empty()
            return Waiting(0, True)
        return Waiting(count // sample_bytes, False)


def fresh(imu: FifoImu, clock: Clock) -> RawSamples:
    """Return `SAMPLES` and some more of a chip whose settings just changed; fewer where they do not come in 80 periods.

    Its FIFO must be emptied afterwards. Raises BusError.
    """
    period_ns = round(1e9 / imu.rate_hz)
    clock.sleep_until(clock.now_ns() + round(imu.start_up_s * 1e9))
    imu.empty()
    taken = NO_SAMPLES
    for _ in range(_MOST_PERIODS // 8):
        clock.sleep_until(clock.now_ns() + 8 * period_ns)
        new = imu.take(imu.waiting().units)
        taken = RawSamples(np.vstack([taken.gyro, new.gyro]), np.vstack([taken.accel, new.accel]))
        if len(taken) >= SAMPLES:
            break
    return taken


def next_of(asked: float, offered: dict[int, int]) -> int:
    """Return the smallest key of `offered` that is not below `asked`, the largest if there is none."""
    return min((value for value in offered if value >= asked), default=max(offered))


def divided(asked_hz: float, base_hz: float) -> int:
    """Return by what `base_hz` is divided, 1 to 256, for a rate that is not below what is asked for."""
    return max(min(int(base_hz / asked_hz), 256), 1)
