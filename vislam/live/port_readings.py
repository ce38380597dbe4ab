"""Further sensors of a cart, on ports of this machine."""

from __future__ import annotations

import socket
from collections.abc import Mapping

from vislam.core.readings import Reading
from vislam.hw.bridge.passed_readings import PassedReadings
from vislam.hw.reading_port import ReadingPort
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.toml import SensorPort


class PortReadings:
    """Satisfies `ReadingSource`: sensors at ports, each read by a thread of its own, and those at the serial bridge."""

    def __init__(self, ports: Mapping[str, SensorPort], bridge: socket.socket | None = None) -> None:
        """Begin to read the port of each sensor; `bridge` has what the serial bridge passes on of those at it.

        Raises HardwareError without pyserial.
        """
        self._ports = {name: ReadingPort(name, port) for name, port in ports.items() if not port.at_bridge}
        passed = {name: port for name, port in ports.items() if port.at_bridge}
        self._passed = PassedReadings(bridge, passed) if bridge is not None else None

    def read(self) -> list[Reading]:
        """Return what came since the last call, at once."""
        passed = [] if self._passed is None else self._passed.take()
        return passed + [reading for port in self._ports.values() for reading in port.take()]

    def status(self) -> dict[str, str]:
        """Return how each sensor is."""
        passed = {} if self._passed is None else self._passed.status()
        return passed | {name: port.status() for name, port in self._ports.items()}

    def counters(self) -> dict[str, dict[str, int]]:
        """Return what came, and how often each fault occurred."""
        passed = {} if self._passed is None else self._passed.counters()
        return passed | {name: port.counters() for name, port in self._ports.items()}

    def datums(self) -> dict[str, Geodetic]:
        """Return the first good fix of each receiver that had one, or the datum that was given."""
        passed = {} if self._passed is None else self._passed.datums()
        return passed | {name: datum for name, port in self._ports.items() if (datum := port.datum) is not None}

    def close(self) -> None:
        """Stop reading; may be called twice."""
        for port in self._ports.values():
            port.close()
        if self._passed is not None:
            self._passed.close()
