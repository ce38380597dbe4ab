"""Further sensors of a cart, on ports of this machine."""

import socket
import time
from collections.abc import Mapping
from dataclasses import replace

from vislam.core.readings import Reading
from vislam.hw.bridge.passer import BridgeState, BytesAt, CountsAt, passed_on
from vislam.hw.bridge.protocol import Chips
from vislam.hw.reading_port import ReadingPort
from vislam.hw.talks import CountTalk, FixTalk, Talk
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.toml import SensorPort

_GAP_NS = 50_000_000  # without a byte for so long, a receiver's burst is over
_LACKS = {
    Chips.ENCODERS: "the sketch on the board counts no encoders; set LEFT_A, LEFT_B, RIGHT_A and RIGHT_B in "
    "vislam_bridge.ino of this vislam and put it on the board",
    Chips.GNSS: "the sketch on the board passes no receiver on; set GNSS_PORT in vislam_bridge.ino of this vislam and "
    "put it on the board",
}
_FAST = (
    "the encoders' edges come too fast for the board, and counts may be wrong; drive slower, or use encoders of fewer "
    "pulses: docs/sensors/wheels.md"
)


class PassedReadings:
    """Encoders and satellite receivers at the board whose inertial data another process reads."""

    def __init__(self, source: socket.socket, sensors: Mapping[str, SensorPort]) -> None:
        """Take the end of the bridge's `Passer`, and the sensors that are at the bridge."""
        self._source = source
        ticks = {name: port.ticks for name, port in sensors.items() if port.ticks}
        self._counts = {name: CountTalk(name, replace(made, bits=32)) for name, made in ticks.items()}
        self._fixes = {name: FixTalk(name, port) for name, port in sensors.items() if name not in ticks}
        self._state = BridgeState(Chips(0), "the serial bridge has not said anything yet")
        self._heard_ns: int | None = None  # when the receiver's last bytes came, while its burst lasts

    def take(self) -> list[Reading]:
        """Return the readings that came since the last call, at once."""
        found: list[Reading] = []
        for item in passed_on(self._source):
            if isinstance(item, CountsAt):
                found += [r for talk in self._counts.values() for r in talk.counted(item.t_ns, item.left, item.right)]
            elif isinstance(item, BytesAt):
                self._heard_ns = time.monotonic_ns()
                found += [r for talk in self._fixes.values() for r in talk.feed(item.data, item.t_ns)]
            else:
                self._state = item
                for _, talk in self._talks():
                    talk.begin()
        if self._heard_ns is not None and time.monotonic_ns() - self._heard_ns > _GAP_NS:
            self._heard_ns = None
            found += [reading for talk in self._fixes.values() for reading in talk.end_burst()]
        return found

    def status(self) -> dict[str, str]:
        """Return by sensor "well", or the problem of the bridge, its sketch or the device at it."""
        asked = dict.fromkeys(self._counts, Chips.ENCODERS) | dict.fromkeys(self._fixes, Chips.GNSS)
        return {name: self._state.problem or self._lack(asked[name]) or talk.status() for name, talk in self._talks()}

    def _lack(self, chip: Chips) -> str:
        chips = self._state.chips
        if chip not in chips:
            return _LACKS[chip]
        return _FAST if chip == Chips.ENCODERS and Chips.FAST_EDGES in chips else ""

    def counters(self) -> dict[str, dict[str, int]]:
        """Return by sensor how many readings came, and how often each fault occurred."""
        return {name: talk.counters() for name, talk in self._talks()}

    def datums(self) -> dict[str, Geodetic]:
        """Return by receiver where its frame begins, as far as it has reported."""
        return {name: datum for name, talk in self._talks() if (datum := talk.datum) is not None}

    def close(self) -> None:
        """Stop listening; may be called twice."""
        self._source.close()

    def _talks(self) -> list[tuple[str, Talk]]:
        return [*self._counts.items(), *self._fixes.items()]


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
