"""Further sensors of a live run, as the front process sees them: readings that have come, and how each sensor is."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

from vislam.core.readings import Reading
from vislam.live.epoch import Epoch

_MISSING_S = 2.0  # without a reading for so long, a sensor is said to be silent


class ReadingSource(Protocol):
    """Sensors that are read beside the camera, in the front process; nothing here may wait."""

    def read(self) -> list[Reading]:
        """Return the readings that have come since the last call, stamped by CLOCK_MONOTONIC."""
        ...

    def status(self) -> dict[str, str]:
        """Return in a word how each sensor is: "well", or what ails it."""
        ...

    def close(self) -> None:
        """Give all devices back; may be called twice."""
        ...


class NoReadings:
    """No further sensors."""

    def read(self) -> list[Reading]:
        """Return nothing."""
        return []

    def status(self) -> dict[str, str]:
        """Return nothing."""
        return {}

    def close(self) -> None:
        """Do nothing."""


class Heard:
    """When each sensor was heard last."""

    def __init__(self, names: tuple[str, ...]) -> None:
        """Begin with none heard."""
        self._last_s = dict.fromkeys(names, -float("inf"))

    def hear(self, readings: list[Reading]) -> None:
        """Note readings that have come just now."""
        now_s = time.monotonic()
        for reading in readings:
            self._last_s[reading.sensor] = now_s

    def status(self) -> dict[str, str]:
        """Return "well" for sensors heard of late, and how long the others have been silent."""
        now_s = time.monotonic()
        return {name: _ago(now_s - last_s) for name, last_s in self._last_s.items()}


class ReplayedReadings:
    """Plays readings of a recording at their times."""

    def __init__(
        self, names: tuple[str, ...], streams: Callable[[], Iterator[Reading]], zero_ns: int, epoch: Epoch
    ) -> None:
        """Open the streams, in time order; `zero_ns` of them is the epoch."""
        self._readings = streams()
        self._zero_ns, self._epoch = zero_ns, epoch
        self._next = next(self._readings, None)
        self._heard = Heard(names)

    def read(self) -> list[Reading]:
        """Return the readings whose time has come; see `ReadingSource`."""
        shift_ns, out = self._epoch.begin_ns() - self._zero_ns, list[Reading]()
        now_ns = time.monotonic_ns()
        while self._next is not None and self._next.t_ns + shift_ns <= now_ns:
            out.append(replace(self._next, t_ns=self._next.t_ns + shift_ns))
            self._next = next(self._readings, None)
        self._heard.hear(out)
        return out

    def status(self) -> dict[str, str]:
        """Return which sensors are silent."""
        return self._heard.status()

    def close(self) -> None:
        """Stop reading."""
        self._next = None


def _ago(silent_s: float) -> str:
    if silent_s <= _MISSING_S:
        return "well"
    return "nothing yet" if silent_s == float("inf") else f"silent for {silent_s:.0f} s"
