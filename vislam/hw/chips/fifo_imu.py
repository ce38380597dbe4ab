"""What a board asks of an inertial chip that keeps its samples in a FIFO until they are fetched."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vislam.core.errors import HardwareError
from vislam.core.messages import Array
from vislam.hw.chips.bus import MAX_READS, I2cBus, Reads
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


class FifoImu(Protocol):
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

    name: str
    address: int
    rate_hz: float
    gyro_rad_s: float
    accel_m_s2: float
    gyro_delay_s: float
    accel_delay_s: float
    start_up_s: float
    max_zero_deg_s: float
    doubt: str

    def configure(self, clock: Clock) -> None:
        """Reset the chip, set it up and start it with an empty FIFO; raises BusError, HardwareError."""
        ...

    def waiting(self) -> Waiting:
        """Return what the FIFO holds, in one short transfer; raises BusError."""
        ...

    def take(self, units: int) -> RawSamples:
        """Take `units` units out of the FIFO, as `waiting` counted them; raises BusError: then `empty` it."""
        ...

    def empty(self) -> None:
        """Throw away what the FIFO holds, and begin at the boundary of a sample; raises BusError."""
        ...

    def temperature_c(self) -> float:
        """Return the chip's temperature; raises BusError, and SettingsLostError where it lost its settings."""
        ...


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


def refuse_other(bus: I2cBus, address: int, found: int, names: dict[int, str]) -> str:
    """Return the name of the chip with the id `found`; raises HardwareError for one that is not among `names`."""
    if found in names:
        return names[found]
    known = ", ".join(f"{name} 0x{value:02x}" for value, name in names.items())
    raise HardwareError(
        f"{bus.path}: the chip at 0x{address:02x} has the id 0x{found:02x}, expected {known}; check the board, "
        "`vislam doctor` lists what answers"
    )


def divided(asked_hz: float, base_hz: float, most: int = 256) -> int:
    """Return by what `base_hz` is divided, 1 to `most`, for a rate that is not below what is asked for."""
    return max(min(int(base_hz / asked_hz), most), 1)


def popped(pops: Reads, units: int) -> bytes:
    """Return `units` units that a FIFO holds, each fetched by one of `MAX_READS` prepared reads; raises BusError."""
    data = b""
    for first in range(0, units, MAX_READS):
        data += pops.run(min(units - first, MAX_READS))
    return data
