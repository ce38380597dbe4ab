"""Further sensors of a live run, as the front process sees them: readings that have come, and how each sensor is."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from vislam.config import FurtherSensorsConfig
from vislam.core.errors import UsageError
from vislam.core.readings import Reading
from vislam.hw.port_readings import PortReadings
from vislam.hw.source import ReadingSource
from vislam.live.epoch import Epoch
from vislam.sensors import SensorSetup, Suite, load_sensor_setup
from vislam.sensors.geodetic import Geodetic

_MISSING_S = 2.0  # without a reading for so long, a sensor is said to be silent


def live_readings(
    config: FurtherSensorsConfig, opener: Callable[[SensorSetup], Callable[[], ReadingSource]]
) -> tuple[Suite, Callable[[], ReadingSource]]:
    """Return the further sensors configured for a live run, and what opens them; an empty suite without any.

    `opener` is that of the run's source. Raises UsageError for a file that cannot be used, or a sensor that `opener`
    refuses.
    """
    if config.file is None:
        return Suite(), partial(PortReadings, {})
    setup = load_sensor_setup(Path(config.file))
    return setup.suite, opener(setup)


def refuse_unread(setup: SensorSetup, readable: Mapping[str, object], asked: str) -> None:
    """Raise UsageError for the first sensor that is not among the readable ones; `asked` names what it needs.

    What the board's own magnetometer feeds comes with the IMU.
    """
    missing = [name for name in setup.suite.names if name not in readable and not setup.suite[name].from_magnetometer]
    if missing:
        raise UsageError(f"[sensors.{missing[0]}]: {asked}; docs/more-sensors.md, Live")


class Heard:
    """When each sensor was heard last, of sensors without a device, whose datums are known from the beginning."""

    def __init__(self, names: tuple[str, ...]) -> None:
        """Begin with none heard."""
        self._last_s = dict.fromkeys(names, -float("inf"))
        self.count = Counter(dict.fromkeys(names, 0))

    def hear(self, readings: list[Reading]) -> None:
        """Note readings that have come just now."""
        now_s = time.monotonic()
        for reading in readings:
            self._last_s[reading.sensor] = now_s
            self.count[reading.sensor] += 1

    def status(self) -> dict[str, str]:
        """Return "well" for sensors heard of late, and how long the others have been silent."""
        now_s = time.monotonic()
        return {name: _ago(now_s - last_s) for name, last_s in self._last_s.items()}

    def datums(self) -> dict[str, Geodetic]:
        """Return nothing."""
        return {}

    def close(self) -> None:
        """Do nothing; may be called twice."""


class ReplayedReadings(Heard):
    """Plays readings of a recording at their times."""

    def __init__(
        self, names: tuple[str, ...], streams: Callable[[], Iterator[Reading]], zero_ns: int, epoch: Epoch
    ) -> None:
        """Open the streams, in time order; `zero_ns` of them is the epoch."""
        super().__init__(names)
        self._readings = streams()
        self._zero_ns, self._epoch = zero_ns, epoch
        self._next = next(self._readings, None)

    def read(self) -> list[Reading]:
        """Return the readings whose time has come; see `ReadingSource`."""
        shift_ns, out = self._epoch.begin_ns() - self._zero_ns, list[Reading]()
        now_ns = time.monotonic_ns()
        while self._next is not None and self._next.t_ns + shift_ns <= now_ns:
            out.append(replace(self._next, t_ns=self._next.t_ns + shift_ns))
            self._next = next(self._readings, None)
        self.hear(out)
        return out

    def counters(self) -> dict[str, dict[str, int]]:
        """Return how many readings of each sensor were played."""
        return {name: {"played": count} for name, count in self.count.items()}

    def close(self) -> None:
        """Stop reading."""
        self._next = None


def _ago(silent_s: float) -> str:
    if silent_s <= _MISSING_S:
        return "well"
    return "nothing yet" if silent_s == float("inf") else f"silent for {silent_s:.0f} s"
