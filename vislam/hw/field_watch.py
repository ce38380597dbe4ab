"""What a magnetometer's readings are worth: new or old, in range or beyond it, alive or hung."""

from __future__ import annotations

from collections import Counter

import numpy as np

from vislam.core.messages import Array, MagSample
from vislam.hw.affine import Affine
from vislam.hw.chips.field import FieldReading
from vislam.hw.link import Link

_NS = 1_000_000_000
_SILENT_READS = 20  # in a row without anything new, of a chip that measures faster than it is asked


class FieldWatch:
    """Makes samples of one magnetometer's readings; owns the last one, to know a chip that hangs."""

    def __init__(self, to_body: Affine, stuck_samples: int) -> None:
        """Take the map from chip to body and how many equal readings in a row a live chip cannot give."""
        self._to_body, self._stuck_samples = to_body, stuck_samples
        self._last_ut: Array = np.full(3, np.nan)

    def taken(
        self, reading: FieldReading | None, link: Link, now_ns: int, rate_hz: float, counts: Counter[str]
    ) -> tuple[MagSample | None, str]:
        """Return the sample [uT] of a reading, if any, and a fault, which is counted: none, or a counter's name.

        After `mag_silent` and `mag_stuck` the chip has to be set up again; `mag_overflow` is beyond its range.
        """
        sample, fault = self._judged(reading, link, now_ns, rate_hz)
        if fault:
            counts[fault] += 1
        return sample, fault

    def _judged(
        self, reading: FieldReading | None, link: Link, now_ns: int, rate_hz: float
    ) -> tuple[MagSample | None, str]:
        link.nacks = 0
        if reading is None:
            link.silent += 1
            return None, "mag_silent" if link.silent >= _SILENT_READS else ""
        link.newest_ns, link.silent = now_ns, 0
        if reading.overflow:
            return None, "mag_overflow"
        link.repeats = link.repeats + 1 if (reading.field_ut == self._last_ut).all() else 0
        self._last_ut = reading.field_ut
        if link.repeats >= self._stuck_samples:
            return None, "mag_stuck"
        # the measurement ended up to a period ago, and took most of one
        t_ns = now_ns - round(0.5 * _NS / rate_hz)
        return MagSample(t_ns, self._to_body.matrix @ reading.field_ut + self._to_body.offset), ""
