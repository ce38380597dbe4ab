"""A sensor on a serial port: a thread of its own reads it, for those who ask must not wait."""

import threading
import time
from collections import Counter, deque

from vislam.core.readings import Reading
from vislam.hw.serial_port import SerialPort
from vislam.hw.talks import talk_of
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.toml import SensorPort

_NS = 1_000_000_000
_GAP_S = 0.05  # without a byte for so long, a burst is over
_REOPEN_S = 0.5  # between attempts to open a port that is not there
_SILENT_NS = 5 * _NS  # without a byte for this long, the port is opened again
_MOST_WAITING = 256  # readings that were not taken
_CLOSING_S = 2.0


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
        self._counts = Counter(dict.fromkeys(("opened", "open_failures", "port_lost", "mute"), 0))
        self._port = SerialPort(config.port, config.baud, self._counts)
        self._path = config.port
        self._talk = talk_of(name, config)
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
        return self._port.problem or self._talk.status()

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
            if self._port.open():
                self._listen()
            if not self._port.is_open:
                self._stop.wait(_REOPEN_S)
            self._port.close()

    def _listen(self) -> None:
        """Read an open port until it is to be closed, goes away, or has been mute for long."""
        self._talk.begin()
        heard_ns = time.monotonic_ns()
        while not self._stop.is_set() and (data := self._port.received(_GAP_S)) is not None:
            now_ns = time.monotonic_ns()
            self._waiting.extend(self._talk.feed(data, now_ns) if data else self._talk.end_burst())
            if data:
                heard_ns, self._port.problem = now_ns, ""
            elif now_ns - heard_ns > _SILENT_NS:
                self._counts["mute"] += 1
                self._port.problem = f"{self._path} is silent; has the device power, and is the baud rate right?"
                return
