"""The magnetometer of a board: found, polled at its rate, judged, and turned into samples of the body's axes."""

from collections import Counter
from collections.abc import Callable

import numpy as np

from vislam.config import BoardConfig, Gy85Config
from vislam.core.errors import HardwareError
from vislam.core.messages import Array, MagSample
from vislam.hw.affine import Affine
from vislam.hw.chips import BusError, Hmc5883l, I2cBus, Magnetometer, SettingsLostError
from vislam.hw.chips.field import FieldReading
from vislam.hw.health import Health
from vislam.hw.link import STUCK_SAMPLES, ChipLinks, Link
from vislam.hw.timing import Clock

_NS = 1_000_000_000
_SILENT_READS = 20  # in a row without anything new, of a chip that measures faster than it is asked


class BoardMagnetometer:
    """Owns the chip, its link, and when it is asked again.

    Attributes:
        chip: None before one was found.
        link: how it stands with it.
    """

    def __init__(
        self,
        config: Gy85Config | BoardConfig,
        clock: Clock,
        find: Callable[[I2cBus, float], Magnetometer | None],
        is_wanted: bool,
    ) -> None:
        """Take the board's settings and clock, and how such chips are found on a bus for a range in gauss."""
        c = config.calibration
        self._config, self._clock, self._find = config, clock, find
        self._watch = _FieldWatch(Affine.of(c.mag_axes, c.mag_matrix, c.mag_bias_ut, 1.0), STUCK_SAMPLES)
        self._next_ns = 0
        self.chip: Magnetometer | None = None
        self.link = Link(self.start, Health.MAG_FAULT, is_inertial=False, is_wanted=is_wanted)

    @property
    def name(self) -> str | None:
        """Which chip was found; None if there is none."""
        return None if self.chip is None else self.chip.name

    def start(self, bus: I2cBus) -> None:
        """Find the chip and set it up, with the scale that its last self-test gave; raises HardwareError."""
        found = self._find(bus, self._config.mag_range_ga)
        if found is None:
            raise HardwareError(f"{bus.path}: no magnetometer answers")
        if isinstance(found, Hmc5883l) and isinstance(self.chip, Hmc5883l):
            found.scale = self.chip.scale
        self.chip = found
        found.configure(self._clock)

    def read(self, links: ChipLinks, now: int) -> MagSample | None:
        """Return a sample [uT] if one is due and new; faults go to the board's counts, events and link.

        One during whose transfer the host was put aside for longer than a measurement takes has no time: it is dropped.
        """
        if self.chip is None or not self.link.is_up or now < self._next_ns:
            return None
        rate_hz = min(self._config.mag_rate_hz, self.chip.rate_hz)
        self._next_ns = max(self._next_ns + round(_NS / rate_hz), now)
        asked = self._clock.now_ns()  # not `now`: the inertial chips were read since
        try:
            reading = self.chip.read()
        except (BusError, SettingsLostError) as error:
            links.failed(self.link, error)
            return None
        answered = self._clock.now_ns()
        middle = (asked + answered) // 2
        sample, fault = self._watch.taken(reading, self.link, middle, self.chip.rate_hz, links.counts)
        if fault == "mag_overflow":
            links.events |= Health.MAG_FAULT
        elif fault:
            self.link.drop(now)
        return sample if answered - asked < _NS / self.chip.rate_hz else None


class _FieldWatch:
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
