"""What devices say, as readings: satellite receivers, lines of numbers, and counts of encoders.

Receivers talk in bursts, one per fix. What they say of UTC is no time of this machine; when they begin to talk is.
"""

import math
import re
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from vislam.config import BridgeClockConfig
from vislam.core.readings import Reading
from vislam.hw.bridge.clock import DeviceClock
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.gnss import Fix, FixReadings, NmeaFixes, UbxFixes
from vislam.sensors.ticks import TickSpeeds, TicksSettings
from vislam.sensors.toml import SensorPort

_NS = 1_000_000_000
_OLD_NS = 3 * _NS  # without a reading for so long, a device is said to have none
_MOST_LINE_BYTES = 1024
_BETWEEN = re.compile(rb"[,;\s]+")
_MICROSECONDS = 2**32
_TIMED = ("GGA", "RMC", "GST")


class NmeaStream:
    """Lines of NMEA 0183 as fixes; a gap ends a burst."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.damaged = 0
        self._fixes = NmeaFixes()
        self._rest = b""
        self._line_ns = 0  # when the first byte of `_rest` came
        self._burst_ns: int | None = None  # when the first byte of the burst came, while no sentence had a time
        self._begins_burst = True
        self._time, self._stamp_ns = "", 0  # of the fix that is collected

    def feed(self, data: bytes, arrival_ns: int) -> list[Fix]:
        """Return the fixes that bytes, which came at a time of CLOCK_MONOTONIC, end by a sentence of another time."""
        if self._begins_burst:
            self._begins_burst, self._burst_ns = False, arrival_ns
        found = []
        for piece in data.splitlines(keepends=True):
            if not self._rest:
                self._line_ns = arrival_ns
            self._rest += piece
            if not self._rest.endswith((b"\n", b"\r")):
                if len(self._rest) > _MOST_LINE_BYTES:  # another rate, or another device
                    self._rest = b""
                    self.damaged += 1
                continue
            line, self._rest = self._rest.strip(), b""
            fix = self._sentence(line.decode("ascii", errors="replace")) if line else None
            if fix is not None:
                found.append(fix)
        return found

    def end_burst(self) -> list[Fix]:
        """Return the fix that is complete because nothing more came."""
        self._begins_burst = True
        fix = self._fixes.end()
        return [] if fix is None else [fix]

    def _sentence(self, line: str) -> Fix | None:
        sentence = line[line.find("$") :]
        before = self._time, self._stamp_ns, self._burst_ns
        time = sentence.split(",")[1] if sentence[3:6] in _TIMED and "," in sentence else ""
        if time and time != self._time:
            self._time, self._stamp_ns = time, self._line_ns if self._burst_ns is None else self._burst_ns
            self._burst_ns = None
        try:
            return self._fixes.feed(f"{self._stamp_ns} {sentence}")
        except ValueError:
            self.damaged += 1
            self._time, self._stamp_ns, self._burst_ns = before
            return None


class UbxStream:
    """u-blox's binary messages as fixes; a gap ends a burst."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._fixes = UbxFixes()
        self._burst_ns: int | None = None  # when the first byte after a gap or a fix came

    @property
    def damaged(self) -> int:
        """Messages that could not be read."""
        return self._fixes.damaged

    def feed(self, data: bytes, arrival_ns: int) -> list[Fix]:
        """Return the fixes that are complete with these bytes, which came at a time of CLOCK_MONOTONIC."""
        if self._burst_ns is None:
            self._burst_ns = arrival_ns
        found = []
        for fix in self._fixes.feed(data):
            found.append(replace(fix, t_ns=arrival_ns if self._burst_ns is None else self._burst_ns))
            self._burst_ns = None
        return found

    def end_burst(self) -> list[Fix]:
        """Return nothing: messages have their length."""
        self._burst_ns = None
        return []


class Talk:
    """Makes readings of what one device sends; counts them, and keeps why others were refused."""

    def __init__(self, noun: str, plural: str) -> None:
        """Take what a reading is called."""
        self._counts = {plural: 0, "refused": 0}
        self._noun, self._plural, self._refusal = noun, plural, ""
        self._newest_ns: int | None = None  # when the last good one came

    @property
    def datum(self) -> Geodetic | None:
        """Where the frame of the readings begins; None: none, or not known yet."""
        return None

    def begin(self) -> None:
        """Forget what was half said, and what it is counted from: the device was plugged in again."""
        raise NotImplementedError

    def feed(self, data: bytes, arrival_ns: int) -> list[Reading]:
        """Return the readings that are complete with these bytes, which came at a time of CLOCK_MONOTONIC."""
        raise NotImplementedError

    def end_burst(self) -> list[Reading]:
        """Return the readings that are complete because nothing more came."""
        return []

    def status(self) -> str:
        """Return "well", or why there is no reading."""
        newest_ns = self._newest_ns
        silent_ns = 0 if newest_ns is None else time.monotonic_ns() - newest_ns
        if newest_ns is not None and silent_ns <= _OLD_NS:
            return "well"
        since = f"no {self._noun} yet" if newest_ns is None else f"no {self._noun} for {silent_ns / _NS:.0f} s"
        return f"{since}: {self._refusal}" if self._refusal else since

    def counters(self) -> dict[str, int]:
        """Return how many readings were good, and how often each fault occurred."""
        return dict(self._counts)

    def _take(self) -> None:
        self._counts[self._plural] += 1
        self._refusal, self._newest_ns = "", time.monotonic_ns()

    def _refuse(self, why: str) -> None:
        self._counts["refused"] += 1
        self._refusal = why


class FixTalk(Talk):
    """A satellite receiver, by NMEA or UBX."""

    def __init__(self, name: str, config: SensorPort) -> None:
        """Begin with nothing said.

        Args:
            name: of the sensor.
            config: of the receiver.
        """
        super().__init__("fix", "fixes")
        self._config = config
        self._readings = FixReadings(name, config.gnss)  # its datum outlives a plug that was pulled
        self._damaged = 0  # by streams before this one
        self._stream = self._new_stream()

    @property
    def datum(self) -> Geodetic | None:
        """As given, or the first good fix; None before that."""
        frame = self._readings.frame
        return None if frame is None else frame.datum

    def begin(self) -> None:
        """See `Talk`."""
        self._damaged += self._stream.damaged
        self._stream = self._new_stream()

    def feed(self, data: bytes, arrival_ns: int) -> list[Reading]:
        """See `Talk`; a fix is stamped when the first byte of its burst came, less the delay of the settings."""
        return [reading for fix in self._stream.feed(data, arrival_ns) for reading in self._made(fix)]

    def end_burst(self) -> list[Reading]:
        """See `Talk`."""
        return [reading for fix in self._stream.end_burst() for reading in self._made(fix)]

    def counters(self) -> dict[str, int]:
        """See `Talk`."""
        return {**self._counts, "damaged": self._damaged + self._stream.damaged}

    def _new_stream(self) -> NmeaStream | UbxStream:
        return UbxStream() if self._config.format == "ubx" else NmeaStream()

    def _made(self, fix: Fix) -> Iterator[Reading]:
        try:
            reading = self._readings.reading(fix)
        except ValueError as error:
            self._refuse(str(error))
            return
        if reading is not None:
            self._take()
            yield replace(reading, t_ns=reading.t_ns - round(self._config.delay_s * _NS))


class CountTalk(Talk):
    """Readings of `wheels` from counts of two encoders."""

    def __init__(self, name: str, settings: TicksSettings) -> None:
        """Take the sensor's name, and how counts are made."""
        super().__init__("reading", "readings")
        self._name, self._settings = name, settings
        self._speeds = TickSpeeds(settings)

    def begin(self) -> None:
        """See `Talk`."""
        self._speeds = TickSpeeds(self._settings)

    def counted(self, t_ns: int, left: int, right: int) -> list[Reading]:
        """Return the speeds since the last counts, at most one reading; those that give none are counted."""
        try:
            found = self._speeds.speeds(t_ns, left, right)
        except ValueError as error:
            self._refuse(str(error))
            return []
        if found is None:
            return []
        self._take()
        return [Reading(self._name, found[0], np.array(found[1]))]


class LineTalk(Talk):
    """Lines of numbers, in the order of the columns of the sensor's kind or `left right` counts.

    A word before them is ignored. A number more than are asked is the device's clock in microseconds, 32 bits;
    without it a line has the time of its first byte. What begins with # is a remark.
    """

    def __init__(self, name: str, config: SensorPort) -> None:
        """Begin with nothing said.

        Args:
            name: of the sensor.
            config: of its port: `columns` and `ticks` say what stands in a line.
        """
        super().__init__("reading", "readings")
        self._name, self._delay_ns = name, round(config.delay_s * _NS)
        self._columns = 2 if config.ticks else len(config.columns)
        self._count = CountTalk(name, config.ticks) if config.ticks else None
        self._faults = {"damaged": 0, "unstamped": 0}
        self._begun = False  # what comes before the first end of a line may be the rest of one
        self._rest, self._line_ns = b"", 0
        self._clock = DeviceClock(BridgeClockConfig())

    def begin(self) -> None:
        """See `Talk`."""
        self._rest, self._begun = b"", False
        self._clock.restart()
        if self._count is not None:
            self._count.begin()

    def feed(self, data: bytes, arrival_ns: int) -> list[Reading]:
        """See `Talk`."""
        found: list[Reading] = []
        for piece in data.splitlines(keepends=True):
            if not self._rest:
                self._line_ns = arrival_ns
            self._rest += piece
            if self._rest.endswith((b"\n", b"\r")):
                line, self._rest = self._rest.strip(), b""
                if line and self._begun:
                    found += self._line(line)
                self._begun = True
            elif len(self._rest) > _MOST_LINE_BYTES:  # another rate, or another device
                self._rest = b""
                self._faults["damaged"] += 1
        return found

    def status(self) -> str:
        """See `Talk`."""
        return super().status() if self._count is None else self._count.status()

    def counters(self) -> dict[str, int]:
        """See `Talk`."""
        return {**(self._counts if self._count is None else self._count.counters()), **self._faults}

    def _line(self, line: bytes) -> list[Reading]:
        if line.startswith(b"#"):
            return []
        fields = deque(filter(None, _BETWEEN.split(line)))
        if fields and fields[0][:1].isalpha():
            fields.popleft()
        try:
            numbers = [float(field) for field in fields]
            further = numbers[self._columns :]
            if not all(map(math.isfinite, numbers)) or len(numbers) not in (self._columns, self._columns + 1):
                raise ValueError
            if self._count is not None and not all(number.is_integer() for number in numbers):
                raise ValueError
        except ValueError:
            self._faults["damaged"] += 1
            return []
        stamp_ns = self._clock.stamp(int(further[0]) % _MICROSECONDS, self._line_ns) if further else self._line_ns
        if stamp_ns is None:
            self._faults["unstamped"] += 1
            return []
        if self._count is not None:
            return self._count.counted(stamp_ns - self._delay_ns, int(numbers[0]), int(numbers[1]))
        self._take()
        return [Reading(self._name, stamp_ns - self._delay_ns, np.array(numbers[: self._columns]))]


def talk_of(name: str, config: SensorPort) -> Talk:
    """Return what makes readings of the bytes of a sensor's port."""
    return LineTalk(name, config) if config.format == "csv" else FixTalk(name, config)
