"""A virtual board with a FIFO on a clock that takes no time, and what comes out of the real driver above it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import BoardConfig, Gy85Config
from vislam.core.messages import Array, ImuSample
from vislam.hw.emulator import EmulatedBus, FifoChip, SteppedClock, Truth, emulated_board, emulated_bus
from vislam.hw.fifo_board import FifoBoard
from vislam.hw.gy85 import Gy85
from worlds.gy85 import board, driving, errors

FIRMWARE = Path(__file__).with_name("bmi270_stand_in.c")  # what any virtual BMI270 is content with
GY85 = "GY-85"
KINDS = ("LSM6DSOX", "ISM330DHCX", "MPU-6050", "MPU-9250", "ICM-20948", "BMI270")


@contextmanager
def fifo_board(
    kind: Any = "LSM6DSOX",
    truth: Truth = driving,
    config: BoardConfig | None = None,
    must_be_there: bool = True,
    **options: Any,
) -> Iterator[tuple[FifoBoard, EmulatedBus, SteppedClock]]:
    """Yield a driver on a virtual board; `options` go to `emulated_board`."""
    clock = SteppedClock()
    config = BoardConfig() if config is None else config
    if kind == "BMI270":
        config = replace(config, firmware=str(FIRMWARE))
    told = {"seed": 1, "magnetometer": "none", "axes": config.calibration, **options}
    bus = emulated_board(kind, truth, clock.now_ns, stepped=clock, **told)
    with emulated_bus(bus):
        driver = FifoBoard(replace(config, bus=bus.path), clock, must_be_there)
        try:
            yield driver, bus, clock
        finally:
            driver.close()


@contextmanager
def any_board(kind: str, **options: Any) -> Iterator[tuple[FifoBoard | Gy85, EmulatedBus, SteppedClock]]:
    """Yield a driver on a virtual GY-85, or on a board of a kind with a FIFO."""
    made = board(**options) if kind == GY85 else fifo_board(kind, **options)
    with made as parts:
        yield parts


def again(driver: FifoBoard | Gy85, bus: EmulatedBus, clock: SteppedClock) -> FifoBoard | Gy85:
    """Return a second driver of a board, which may not be there yet."""
    if isinstance(driver, Gy85):
        return Gy85(Gy85Config(bus=bus.path, self_test=False), clock, must_be_there=False)
    return FifoBoard(BoardConfig(bus=bus.path, firmware=str(FIRMWARE)), clock, must_be_there=False)


def assert_right(samples: list[ImuSample], kind: str) -> None:
    """No sample may be wrong, however few there are: 0.3 deg/s and 0.03 m/s^2 of bias, noise, and 1 ms of stamps."""
    assert samples
    gyro, accel = errors(samples)
    assert abs(gyro).max() < (0.06 if kind == GY85 else 0.04)
    assert abs(accel).max() < (0.6 if kind == GY85 else 0.3)
    assert (np.diff([s.t_ns for s in samples]) > 0).all()


class Stalled(SteppedClock):
    """Moves on by 5 us with each look, and by a stall at one of them: the host is put aside."""

    def __init__(self, at: int, stall_ns: int) -> None:
        super().__init__()
        self._left, self.stall_ns = at, stall_ns

    def now_ns(self) -> int:
        self._left -= 1
        self.advance(self.stall_ns if self._left == 0 else 5_000)
        return super().now_ns()


def inertial_chip(bus: EmulatedBus) -> FifoChip:
    return next(chip for chip in bus.chips.values() if isinstance(chip, FifoChip))


def stamp_errors_ms(driver: FifoBoard, bus: EmulatedBus, samples: list[ImuSample]) -> Array:
    """Return by how much stamps [N] are off the times at which the virtual chip sampled, filters left aside."""
    chip = inertial_chip(bus)
    assert driver.imu is not None
    t_ns = np.array([s.t_ns for s in samples], dtype=np.int64) + round(driver.imu.gyro_delay_s * 1e9)
    period, grid_ns = chip._period_ns(), chip._next_ns
    steps = np.round((t_ns - grid_ns) / period)
    assert (np.diff(steps) == 1).all(), "a sample was lost or came twice"
    return (t_ns - (grid_ns + steps * period)) * 1e-6
