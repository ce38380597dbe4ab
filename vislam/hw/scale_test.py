"""Whether a chip whose id does not settle its scale measures gravity at rest."""

from __future__ import annotations

import numpy as np

from vislam.hw.chips import FifoImu, SelfTest
from vislam.hw.chips.fifo_imu import G_M_S2
from vislam.hw.timing import Clock

TOLERANCE_M_S2 = 1.0  # zero of an MPU-6050 out of the box: 0.8 m/s^2; a wrong range is off by half
_SAMPLES, _MOST_PERIODS = 20, 80
_MAX_STD_M_S2 = 0.3  # it moved


def force_at_rest(imu: FifoImu, clock: Clock) -> float | None:
    """Return what a chip measures of gravity (m/s^2); None where it moves or its samples do not come, in 80 periods.

    Its FIFO must be emptied afterwards. Raises BusError.
    """
    period_ns = round(1e9 / imu.rate_hz)
    clock.sleep_until(clock.now_ns() + round(imu.start_up_s * 1e9))
    imu.empty()
    counts = np.zeros((0, 3))
    for _ in range(_MOST_PERIODS // 8):
        clock.sleep_until(clock.now_ns() + 8 * period_ns)
        counts = np.vstack([counts, imu.take(imu.waiting().units).accel])
        if len(counts) >= _SAMPLES:
            forces = counts * imu.accel_m_s2
            return None if forces.std(axis=0).max() > _MAX_STD_M_S2 else float(np.linalg.norm(forces.mean(axis=0)))
    return None


def scale_test(imu: FifoImu, force_m_s2: float | None) -> SelfTest:
    """Return whether a force at rest is gravity."""
    if force_m_s2 is None:
        return SelfTest(imu.name, None, f"{imu.doubt}; its scale is not known to fit: start it at rest", (0.0,))
    passed = abs(force_m_s2 - G_M_S2) <= TOLERANCE_M_S2
    what = f"gravity is {force_m_s2:.2f} m/s^2 by its scale, {G_M_S2:.2f} within {TOLERANCE_M_S2:g} expected"
    return SelfTest(imu.name, passed, f"{imu.doubt}; {what}", (force_m_s2,))
