"""The boards that may sit behind an emulated serial bridge: what the sketch states of each, and how old counts are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vislam.hw.bridge.protocol import Ages, Chips, Hello

BridgedName = Literal["GY-85", "MPU-6050", "MPU-6500", "MPU-9250", "MPU-9255", "stranger"]
_WHO_AM_I = {"MPU-6050": 0x68, "MPU-6500": 0x70, "MPU-9250": 0x71, "MPU-9255": 0x73}
_STRANGER = 0x98  # of a clone of the MPU-6050 that the sketch does not know
_INSIDE_NS = 1_007_000  # between samples inside such a chip, by a clock that is 0.7 % slow


@dataclass(frozen=True, slots=True)
class Bridged:
    """What the sketch states about the chips behind it, and how their counts come about."""

    hello: Hello
    ages: Ages | None  # None: nothing is sent
    gyro_delay_ns: int  # of its filter
    accel_delay_ns: int
    inside_ns: int  # between samples inside the chip, of which the newest is read; 0: in the delays
    accel_most: int  # counts
    mag_overflow: int  # what an axis has then
    first_hellos: int  # before the first sample

    def newest_ns(self, t_ns: int) -> int:
        """Return when the sample was taken that is read at a time."""
        return t_ns - t_ns % self.inside_ns if self.inside_ns else t_ns


_GY85 = Bridged(
    Hello(0, 0, Chips(7), 0xE5, 0x68, b"H43", 400, 38_307_227, 1_214_142, 91_743, 3_571_429, 82_143, 4095, 28_750,
          2048),
    None, 3_300_000, 3_300_000, 0, 4095, -4096, 1,
)  # fmt: skip


def bridged(name: BridgedName) -> Bridged:
    """Return a board; the MPU-9250 and -9255 with their magnetometer, the MPU-6050 and -6500 without one.

    A `stranger` is a chip in their place whose id the sketch does not know: its samples have errors.
    """
    if name == "GY-85":
        return _GY85
    if name == "stranger":
        h = _GY85.hello
        hello = Hello(
            0, 0, Chips(0), _STRANGER, 0, b"\0\0\0", h.rate_hz, h.accel_nm_s2, h.gyro_nrad_s, h.mag_pt,
            h.temperature_nk, h.temperature_mc, h.accel_limit, h.gyro_limit, h.mag_limit,
        )  # fmt: skip
        return Bridged(hello, None, 0, 0, 0, 4095, -4096, 1)
    who, is_first, has_mag = _WHO_AM_I[name], name == "MPU-6050", name in ("MPU-9250", "MPU-9255")
    mag_id, mag_pt, mag_limit, mag_us = (
        (b"H\0\0", 150_000, 32_760, 5000) if has_mag else (b"\0\0\0", 91_743, 2048, 6700)
    )
    kelvin_nk, at_0_mc = (2_941_176, 36_530) if is_first else (2_995_178, 21_000)
    chips = Chips.ACCEL | Chips.GYRO | (Chips.MAG if has_mag else 0)
    hello = Hello(
        0, 0, chips, who, who, mag_id, 400, 2_394_202, 266_462, mag_pt, kelvin_nk, at_0_mc, 32_767, 32_767, mag_limit
    )
    gyro_us, accel_us = (2800, 3000) if is_first else (3900, 2880)
    ages = Ages(0, 0, who, gyro_us + 500, accel_us + 500, mag_us)
    return Bridged(hello, ages, 1000 * gyro_us, 1000 * accel_us, _INSIDE_NS, 32_767, -32_767, 2)
