"""Further sensors of a cart, on ports of this machine."""

from __future__ import annotations

from collections.abc import Mapping

from vislam.core.readings import Reading
from vislam.hw.gnss_port import GnssPort
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.toml import SensorPort


class PortReadings:
    """Satisfies `ReadingSource`: satellite receivers, each read by a thread of its own."""

    def __init__(self, ports: Mapping[str, SensorPort]) -> None:
        """Begin to read the port of each sensor; raises HardwareError without pyserial."""
        self._receivers = {name: GnssPort(name, port) for name, port in ports.items()}

    def read(self) -> list[Reading]:
        """Return what came since the last call, at once."""
        return [reading for receiver in self._receivers.values() for reading in receiver.take()]

    def status(self) -> dict[str, str]:
        """Return how each receiver is."""
        return {name: receiver.status() for name, receiver in self._receivers.items()}

    def counters(self) -> dict[str, dict[str, int]]:
        """Return what came, and how often each fault occurred."""
        return {name: receiver.counters() for name, receiver in self._receivers.items()}

    def datums(self) -> dict[str, Geodetic]:
        """Return the first good fix of each receiver that had one, or the datum that was told."""
        return {name: datum for name, receiver in self._receivers.items() if (datum := receiver.datum) is not None}

    def close(self) -> None:
        """Stop reading; may be called twice."""
        for receiver in self._receivers.values():
            receiver.close()
