"""What the serial bridge sends besides inertial data, handed on to the reader of a run's further sensors.

The process that reads the bridge publishes the pose and never waits: what the other one does not take in time is lost,
and counted.
"""

import socket
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from vislam.hw.bridge.clock import DeviceClock
from vislam.hw.bridge.protocol import Chips, Counts, Hello, Passed

_HEAD = struct.Struct("<Bq")  # which, and its time
_COUNTS = struct.Struct("<ii")
_COUNTED, _SAID, _STANDS = range(3)
_SEQUENCES = 2**16
_MOST_BYTES = 2048


@dataclass(frozen=True, slots=True)
class CountsAt:
    """Where the encoders of two wheels stood."""

    t_ns: int  # CLOCK_MONOTONIC
    left: int
    right: int


@dataclass(frozen=True, slots=True)
class BytesAt:
    """Bytes of a satellite receiver."""

    t_ns: int  # of the first one
    data: bytes


@dataclass(frozen=True, slots=True)
class BridgeState:
    """How the bridge is; after each, counts and bytes have nothing to do with those before."""

    chips: Chips
    problem: str  # empty: it is there


PassedOn = CountsAt | BytesAt | BridgeState


class Passer:
    """Stamps counts and bytes by the host's clock and sends them on, through a socket that is never waited for."""

    def __init__(self, clock: DeviceClock, to: socket.socket | None) -> None:
        """Take the bridge's clock and where to; None: only count."""
        self.counts: Counter[str] = Counter()
        self._clock, self._to = clock, to
        self._sequences: dict[type, int] = {}
        self._reported: tuple[Chips, str, int] | None = None
        if to is not None:
            to.setblocking(False)

    def take(self, message: Counts | Passed) -> None:
        """Send a message of the bridge on."""
        name = "counts" if isinstance(message, Counts) else "passed"
        last = self._sequences.get(type(message))
        self._sequences[type(message)] = message.sequence
        self.counts[f"{name}_frames"] += 1
        lost = 0 if last is None else (message.sequence - last - 1) % _SEQUENCES
        self.counts[f"{name}_lost"] += lost if lost < _SEQUENCES // 2 else 0  # else it began again, unannounced
        t_ns = self._clock.host_ns(message.t_us)
        if t_ns is None or self._reported is None:
            self.counts[f"{name}_unstamped"] += 1
            return
        if self._reported[2] != self._clock.steps:  # stamps before and after have no interval
            self._report(self._reported[0], self._reported[1])
        if isinstance(message, Counts):
            self._send(_COUNTED, t_ns, _COUNTS.pack(message.left, message.right))
        else:
            self._send(_SAID, t_ns, message.data)

    def greet(self, hello: Hello) -> None:
        """Report what the device has, where it is new or has just started."""
        chips = hello.chips & (Chips.ENCODERS | Chips.GNSS | Chips.FAST_EDGES)
        self.counts["counts_doubted"] += Chips.FAST_EDGES in chips
        if Chips.STARTED in hello.chips:
            self._sequences.clear()
        if Chips.STARTED in hello.chips or self._reported is None or self._reported[:2] != (chips, ""):
            self._report(chips, "")

    def lose(self, problem: str) -> None:
        """Report that the bridge does not answer, and why."""
        self._sequences.clear()
        if self._reported is None or self._reported[1] != problem:
            self._report(Chips(0), problem)

    def _report(self, chips: Chips, problem: str) -> None:
        is_sent = self._send(_STANDS, int(chips), problem.encode()[:_MOST_BYTES])
        self._reported = (chips, problem, self._clock.steps) if is_sent else None  # else the next hello reports it

    def _send(self, kind: int, t_ns: int, data: bytes) -> bool:
        """Return whether it went, or is not asked for."""
        if self._to is None:
            return True
        try:
            self._to.send(_HEAD.pack(kind, t_ns) + data)
        except OSError:  # it is full, or has no listener any more
            self.counts["passed_on_lost"] += 1
            return False
        return True


def passed_on(source: socket.socket) -> Iterator[PassedOn]:
    """Yield what has come through the other end of a passer's socket, without waiting."""
    while True:
        try:
            packet = source.recv(_HEAD.size + _MOST_BYTES, socket.MSG_DONTWAIT)
        except OSError:
            return
        if len(packet) < _HEAD.size:
            return
        (kind, t_ns), data = _HEAD.unpack_from(packet), packet[_HEAD.size :]
        if kind == _COUNTED:
            yield CountsAt(t_ns, *_COUNTS.unpack(data))
        elif kind == _SAID:
            yield BytesAt(t_ns, data)
        else:
            yield BridgeState(Chips(t_ns), data.decode(errors="replace"))
