"""Inertial samples of a device that another process owns: it sends them, the fast process reads. Loads no OpenCV."""

import json
import select
import socket
import struct
import time
from collections import Counter, deque
from collections.abc import Iterable

import numpy as np

from vislam.config import SensorCalibration
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource

_NS = 1_000_000_000
_RECORD = struct.Struct("<q6d")
_SAMPLES, _WORD = b"s", b"w"
_BATCH = 32  # samples in a message
_WAITING = 400  # messages that may wait for a reader that is busy: 2 s at 200 Hz and more
_MOST_BYTES = 1 << 16


class ImuHander:
    """The sending end: never waits for the reader. One thread only."""

    def __init__(self, sock: socket.socket) -> None:
        """Own the end of a pair of SOCK_SEQPACKET."""
        sock.setblocking(False)
        self._socket = sock
        self._waiting: deque[bytes] = deque()
        self.lost = 0  # messages that were not taken in time

    def send(self, samples: Iterable[ImuSample | MagSample]) -> None:
        """Hand samples on; those that a stuck reader leaves lying for too long are lost and counted."""
        rows = [
            _RECORD.pack(sample.t_ns, *sample.gyro_rad_s.tolist(), *sample.accel_m_s2.tolist())
            for sample in samples
            if isinstance(sample, ImuSample)
        ]
        for first in range(0, len(rows), _BATCH):
            self._put(_SAMPLES + b"".join(rows[first : first + _BATCH]))
        self._flush()

    def report(self, health: Health, counters: dict[str, int], problem: str) -> None:
        """Hand on how the device is."""
        state = {"health": int(health), "counters": {**counters, "not_handed_on": self.lost}, "problem": problem[:1000]}
        self._put(_WORD + json.dumps(state).encode())
        self._flush()

    def close(self) -> None:
        """End the stream; may be called twice."""
        self._socket.close()

    def _put(self, message: bytes) -> None:
        if len(self._waiting) >= _WAITING:
            self._waiting.popleft()
            self.lost += 1
        self._waiting.append(message)

    def _flush(self) -> None:
        try:
            while self._waiting:
                self._socket.send(self._waiting[0])
                self._waiting.popleft()
        except BlockingIOError:
            return
        except OSError:  # the reader is gone, and the parent knows of it
            self._waiting.clear()


class HandedImu(InertialSource):
    """An `InertialSource` with what an `ImuHander` of another process sends."""

    def __init__(self, sock: socket.socket, rate_hz: float, silent_s: float) -> None:
        """Own the end of a pair of SOCK_SEQPACKET.

        Args:
            sock: the end.
            rate_hz: that was asked of the device.
            silent_s: without a sample for so long, the IMU is missing.
        """
        sock.setblocking(False)
        super().__init__(SensorCalibration(), silent_s)  # they come calibrated
        self.rate_hz, self._socket = rate_hz, sock
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)
        self._is_over = False

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what came, see `InertialSource`."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * _NS)
        samples: list[ImuSample | MagSample] = []
        while True:
            self._receive(samples)
            left_ns = deadline_ns - time.monotonic_ns()
            if samples or left_ns <= 0:
                break
            if self._is_over:
                time.sleep(left_ns / _NS)
            else:
                self._poll.poll(left_ns / 1e6)
        if samples:
            self._last_out_ns = time.monotonic_ns()
        return samples

    def close(self) -> None:
        """Read no more; may be called twice."""
        self._is_over = True
        self._socket.close()

    def _receive(self, samples: list[ImuSample | MagSample]) -> None:
        while not self._is_over:
            try:
                data = self._socket.recv(_MOST_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            kind, rest = data[:1], data[1:]
            if kind == _SAMPLES:
                for t_ns, *numbers in _RECORD.iter_unpack(rest):
                    samples.append(ImuSample(t_ns, np.array(numbers[:3]), np.array(numbers[3:])))
            elif kind == _WORD:
                state = json.loads(rest)
                self._faults.events |= Health(state["health"]) & ~Health.IMU_MISSING  # which is looked at here
                self._faults.counts = Counter(state["counters"])
            else:
                self._is_over = True
