"""Gyroscope and accelerometer that were sampled each in its own time, as the samples of one IMU.

The accelerometer is interpolated, straight, at the gyroscope's stamps: turns are what has to be exact, and rates are
what changes faster. Memory is that of two samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from vislam.config import MachineConfig
from vislam.core.errors import DataError
from vislam.core.recording import Problems
from vislam.datasets.tables import Row

Rows = Iterator[Row[list[float]]]


class ImuRows(Protocol):
    """Inertial samples that are no table of their own."""

    def imu_rows(self, problems: Problems, /) -> Rows:
        """Yield stamp, rates (rad/s) and forces (m/s^2); raises DataError when most cannot be used."""
        ...


def paired(rates: Rows, forces: Rows, problems: Problems, what: str) -> Rows:
    """Yield stamp, rates and forces at the stamps of the rates; both come in time order.

    Rates before the first force, after the last one or within a gap of the forces are left out and counted; raises
    DataError where none is left.

    Args:
        rates: stamp in ns and [3] rad/s.
        forces: stamp in ns and [3] m/s^2.
        problems: where to count.
        what: names the recording in what is counted.
    """
    longest_ns = round(MachineConfig().max_gap_s * 1e9)
    before: Row[list[float]] | None = None
    after = next(forces, None)
    t_ns, first_ns, joined = 0, None if after is None else after[0], False
    for t_ns, rate in rates:
        while after is not None and after[0] < t_ns:
            before, after = after, next(forces, None)
        if after is not None and after[0] == t_ns:
            joined = True
            yield t_ns, [*rate, *after[1]]
            continue
        if before is None or after is None:
            problems.count(f"{what}: gyroscope samples outside the accelerometer's time", f"{t_ns} ns")
            continue
        span_ns = after[0] - before[0]
        if span_ns > longest_ns:
            problems.count(f"{what}: gyroscope samples in a gap of the accelerometer", f"{t_ns} ns")
            continue
        joined = True
        share = (t_ns - before[0]) / span_ns
        yield t_ns, [*rate, *((1.0 - share) * a + share * b for a, b in zip(before[1], after[1], strict=True))]
    if first_ns is not None and t_ns and not joined:
        raise DataError(
            f"{what}: no gyroscope sample has forces before and after it within {longest_ns * 1e-9:g} s: the last is "
            f"at {t_ns * 1e-9:.3f} s, the forces begin at {first_ns * 1e-9:.3f} s; export both by one clock"
        )
