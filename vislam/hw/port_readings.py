"""Further sensors of a cart, on ports of this machine."""

import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import replace

from vislam.core.readings import Reading
from vislam.hw.bridge.passer import BridgeState, BytesAt, CountsAt, passed_on
from vislam.hw.bridge.protocol import Chips
from vislam.hw.serial_port import SerialPort
from vislam.hw.talks import CountTalk, FixTalk, Talk, talk_of
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
_NS = 1_000_000_000
_GAP_S = 0.05  # without a byte for so long, a burst is over
_REOPEN_S = 0.5  # between attempts to open a port that is not there
_SILENT_NS = 5 * _NS  # without a byte for this long, the port is opened again
_MOST_WAITING = 256  # readings that were not taken
_CLOSING_S = 2.0


class ReadingPort:
    """Reads a sensor until it is closed, in a thread of its own, for those who ask must not wait.

    A port that goes away is looked for again. Nothing is written to it.

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
