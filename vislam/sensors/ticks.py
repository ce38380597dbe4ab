"""Counts of wheel encoders as speeds."""

import math
from dataclasses import dataclass
from typing import Literal

from vislam.config.ranges import Positive


@dataclass(frozen=True, slots=True)
class TicksSettings:
    """How counts are made; of both wheels alike, for what they differ by is estimated."""

    ticks_per_turn: Positive  # of the wheel, gear and edges included
    radius_m: Positive
    bits: Literal[8, 16, 32, 64] = 32  # of the counter, which rolls over
    left_sign: Literal[1, -1] = 1  # -1: counts fall when it goes forward
    right_sign: Literal[1, -1] = 1
    max_gap_s: Positive = 1.0  # between counts; over a longer one a speed means little
    max_m_s: Positive = 20.0  # more is a counter that was reset


class TickSpeeds:
    """Turns counts of two wheels into speeds, each that of the time between two counts, stamped in its middle."""

    def __init__(self, settings: TicksSettings) -> None:
        """Take how counts are made."""
        self._settings = settings
        self._last: tuple[int, tuple[int, int]] | None = None

    def speeds(self, t_ns: int, left: int, right: int) -> tuple[int, list[float]] | None:
        """Return stamp and left and right speed in m/s; None for the first counts.

        Raises ValueError for counts too late after the last ones, or of a counter that was reset.
        """
        s, last = self._settings, self._last
        self._last = (t_ns, (left, right))
        if last is None:
            return None
        since_s = (t_ns - last[0]) * 1e-9
        if not 0.0 < since_s <= s.max_gap_s:
            raise ValueError(f"counts {since_s:g} s after the last ones")
        per_tick = 2.0 * math.pi * s.radius_m / s.ticks_per_turn / since_s
        signs = (s.left_sign, s.right_sign)
        speeds = [
            sign * per_tick * counted(now - before, s.bits)
            for sign, now, before in zip(signs, (left, right), last[1], strict=True)
        ]
        if max(map(abs, speeds)) > s.max_m_s:
            raise ValueError(f"wheels at {speeds} m/s; a counter that was reset")
        return t_ns - round(0.5e9 * since_s), speeds


def counted(difference: int, bits: int) -> int:
    """Return by how much a counter of `bits` bits moved: the way round that is shorter."""
    half = 1 << (bits - 1)
    return (difference + half) % (2 * half) - half
