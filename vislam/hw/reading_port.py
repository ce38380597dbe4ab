"""A sensor on a serial port: a thread of its own reads it, for those who ask must not wait."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

from vislam.config import SerialConfig
from vislam.core.errors import HardwareError
from vislam.core.readings import Reading
from vislam.hw.bridge.bridge import PORT_ERRORS, load_pyserial, why_not_open
from vislam.hw.descriptor import received
from vislam.hw.talks import talk_of
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.toml import SensorPort

if TYPE_CHECKING:
    import serial

_NS = 1_000_000_000
_GAP_S = 0.05  # without a byte for so long, a burst is over
_REOPEN_S = 0.5  # between attempts to open a port that is not there
_SILENT_NS = 5 * _NS  # without a byte for this long, the port is opened again
_MOST_WAITING = 256  # readings that were not taken
_CLOSING_S = 2.0


def check_port(config: SensorPort) -> None:
    """Raise HardwareError where a sensor's port is missing or may not be opened, or pyserial is not installed."""
    load_pyserial()
    if not os.access(config.port, os.R_OK | os.W_OK):
        code = errno.EACCES if Path(config.port).exists() else errno.ENOENT
        raise HardwareError(_why_not(config, OSError(code, os.strerror(code))))


class ReadingPort:
    """Reads a sensor until it is closed; a port that goes away is looked for again. Nothing is written to it.

    Readings are stamped by CLOCK_MONOTONIC, less the delay of the settings; see `Talk`.
    """

    def __init__(self, name: str, config: SensorPort) -> None:
        """Begin to read; raises HardwareError without pyserial, nothing for a port that is not there.

        Args:
            name: of the sensor.
            config: of port and device.
        """
        self._serial = load_pyserial()
        self._config = config
        self._talk = talk_of(name, config)
        self._counts = dict.fromkeys(("opened", "open_failures", "port_lost", "mute"), 0)
        self._problem = f"{config.port} has not been opened"
        self._waiting: deque[Reading] = deque(maxlen=_MOST_WAITING)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"sensor {name}", daemon=True)
        self._thread.start()

    def take(self) -> list[Reading]:
        """Return the readings that came since the last call, at once."""
        found = []
        while self._waiting:
            found.append(self._waiting.popleft())
        return found

    def status(self) -> str:
        """Return "well", or the problem of port or device."""
        return self._problem or self._talk.status()

    def counters(self) -> dict[str, int]:
        """Return how many readings were good, and how often each fault occurred."""
        return {**self._talk.counters(), **self._counts}

    @property
    def datum(self) -> Geodetic | None:
        """Where the frame of the readings begins: as given, or the first good fix; None before that, or without one."""
        return self._talk.datum

    def close(self) -> None:
        """Stop reading; may be called twice."""
        self._stop.set()
        self._thread.join(_CLOSING_S)

    def _run(self) -> None:
        while not self._stop.is_set():
            port = self._opened()
            if port is None:
                self._stop.wait(_REOPEN_S)
                continue
            try:
                self._listen(port)
            except PORT_ERRORS as error:
                self._counts["port_lost"] += 1
                self._problem = f"{self._config.port} went away: {error}; plug it in again"
                self._stop.wait(_REOPEN_S)
            finally:
                _close(port)

    def _opened(self) -> serial.Serial | None:
        config = self._config
        try:
            port = self._serial.Serial(config.port, config.baud, timeout=0, exclusive=True)
        except PORT_ERRORS as error:
            self._counts["open_failures"] += 1
            self._problem = _why_not(config, error)
            return None
        self._counts["opened"] += 1
        return port

    def _listen(self, port: serial.Serial) -> None:
        """Read an open port until it is to be closed, goes away, or has been mute for long."""
        self._talk.begin()
        heard_ns = time.monotonic_ns()
        while not self._stop.is_set():
            data = received(port.fileno(), _GAP_S)
            now_ns = time.monotonic_ns()
            self._waiting.extend(self._talk.feed(data, now_ns) if data else self._talk.end_burst())
            if data:
                heard_ns, self._problem = now_ns, ""
            elif now_ns - heard_ns > _SILENT_NS:
                self._counts["mute"] += 1
                self._problem = f"{self._config.port} is silent; has the device power, and is the baud rate right?"
                return


def _why_not(config: SensorPort, error: Exception) -> str:
    return why_not_open(SerialConfig(port=config.port, baud=config.baud), error)


def _close(port: serial.Serial) -> None:
    try:
        port.close()
    except PORT_ERRORS:
        return  # it is gone, as it should be
