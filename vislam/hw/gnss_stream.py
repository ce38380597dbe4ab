"""Fixes from the bytes of a satellite receiver as they arrive, each stamped when its first byte came.

Receivers talk in bursts, one per fix. What they say of UTC is no time of this machine; when they begin to talk is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

from vislam.sensors.gnss import Fix, NmeaFixes, UbxFixes

_TIMED = ("GGA", "RMC", "GST")
_MOST_LINE_BYTES = 1024


class FixStream(Protocol):
    """Makes fixes of chunks of bytes; a gap ends a burst."""

    @property
    def damaged(self) -> int:
        """How much came that could not be read."""
        ...

    def feed(self, data: bytes, arrival_ns: int) -> list[Fix]:
        """Return the fixes that are complete with these bytes, which came at a time of CLOCK_MONOTONIC."""
        ...

    def end_burst(self) -> list[Fix]:
        """Return the fix that is complete because nothing more came."""
        ...


class NmeaStream:
    """Lines of NMEA 0183; see `FixStream`."""

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
        """Return the fixes that these bytes end, by the first sentence of another time; see `FixStream`."""
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
        """Return the fix that was collected; see `FixStream`."""
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
    """u-blox's binary messages; see `FixStream`."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._fixes = UbxFixes()
        self._burst_ns: int | None = None  # when the first byte after a gap or a fix came

    @property
    def damaged(self) -> int:
        """Messages that could not be read."""
        return self._fixes.damaged

    def feed(self, data: bytes, arrival_ns: int) -> list[Fix]:
        """Return the fixes that these bytes end; see `FixStream`."""
        if self._burst_ns is None:
            self._burst_ns = arrival_ns
        found = []
        for fix in self._fixes.feed(data):
            found.append(replace(fix, t_ns=arrival_ns if self._burst_ns is None else self._burst_ns))
            self._burst_ns = None
        return found

    def end_burst(self) -> list[Fix]:
        """Return nothing: messages have their length; see `FixStream`."""
        self._burst_ns = None
        return []
