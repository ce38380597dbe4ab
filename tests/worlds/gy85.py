"""A virtual board on a clock that takes no time, and what comes out of the real driver above it."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from vislam.config import Gy85Config
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.emulator import EmulatedBus, SteppedClock, Truth, emulated_bus, emulated_gy85
from vislam.hw.gy85 import Gy85
from vislam.hw.imu_source import InertialSource

FIELD_UT = np.array([20.0, -5.0, -42.0])


def driving(t_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
    """A cart that turns and shakes a little: smooth, known at every time."""
    s = t_ns * 1e-9
    rate = (
        0.1 * math.sin(3.0 * s),
        0.2 * math.sin(2.0 * s),
        0.5 + 0.4 * math.sin(s),
    )  # never all level at once
    force = (0.6 * math.sin(5.0 * s), 0.6 * math.cos(5.0 * s), 9.80665 + 0.2 * math.sin(7.0 * s))
    return rate, force, tuple(FIELD_UT), 30.0


def still(t_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
    return (0.0, 0.0, 0.0), (0.0, 0.0, 9.80665), tuple(FIELD_UT), 30.0


@contextmanager
def board(
    truth: Truth = driving, config: Gy85Config | None = None, must_be_there: bool = True, **options: Any
) -> Iterator[tuple[Gy85, EmulatedBus, SteppedClock]]:
    """Yield a driver on a virtual board; `options` go to `emulated_gy85`."""
    clock = SteppedClock()
    config = Gy85Config(self_test=False) if config is None else config
    bus = emulated_gy85(truth, clock.now_ns, axes=config.calibration, stepped=clock, **{"seed": 1, **options})
    with emulated_bus(bus):
        driver = Gy85(replace(config, bus=bus.path), clock, must_be_there)
        try:
            yield driver, bus, clock
        finally:
            driver.close()


def collect(
    driver: InertialSource, clock: SteppedClock, duration_s: float, late_s: float = 0.0, seed: int = 3
) -> tuple[list[ImuSample], list[MagSample]]:
    """Read for so long, in calls of 0.1 s at most, of which every one must return in time.

    The host is late by `late_s` in the mean before each call, 20 times that now and then.
    """
    rng = np.random.default_rng(seed)
    inertial: list[ImuSample] = []
    magnetic: list[MagSample] = []
    end_ns = clock.now_ns() + round(duration_s * 1e9)
    while clock.now_ns() < end_ns:
        if late_s:
            late_ns = rng.exponential(late_s) * (20e9 if rng.random() < 0.02 else 1e9)
            clock.advance(round(min(late_ns, 0.12e9)))
        begin_ns = clock.now_ns()
        for sample in driver.read(0.1):
            (inertial if isinstance(sample, ImuSample) else magnetic).append(sample)  # type: ignore[arg-type]
        assert clock.now_ns() - begin_ns < 0.35e9, "a read took longer than its timeout and the bus's limits"
    return inertial, magnetic


def errors(samples: list[ImuSample], truth: Truth = driving) -> tuple[Array, Array]:
    """Return gyro and accelerometer errors [N, 3] against the truth at the samples' own stamps."""
    gyro = np.array([s.gyro_rad_s - np.array(truth(s.t_ns)[0]) for s in samples])
    accel = np.array([s.accel_m_s2 - np.array(truth(s.t_ns)[1]) for s in samples])
    return gyro, accel
