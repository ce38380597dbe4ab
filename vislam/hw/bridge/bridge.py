"""Inertial samples from a microcontroller on a serial port, which reads the chips on time where a host cannot."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING

from vislam.config import SerialConfig
from vislam.core.errors import HardwareError
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.bridge.behind import Behind
from vislam.hw.bridge.clock import DeviceClock
from vislam.hw.bridge.passer import Passer
from vislam.hw.bridge.protocol import (
    PROTOCOL_VERSION,
    Ages,
    Chips,
    Counts,
    FrameDecoder,
    Hello,
    Message,
    OtherVersion,
    Passed,
    RawSample,
    Spent,
    Status,
)
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.hw.serial_port import SerialPort

if TYPE_CHECKING:
    import socket

_MAG_STUCK = 10  # equal values of a magnetometer in a row: 0.2 s at the sketch's 50 Hz
_NS = 1_000_000_000
_GLANCE_S = 0.05  # while the first sample is waited for, so soon a port that cannot be opened is reported
_NOMINAL_HZ = 400.0  # until the device states it
_TEMPERATURE_TAU_S = 1.0  # its counts are noisy, its changes slow
_SEQUENCES, _WRAP_US = 2**16, 2**32
_STALE_NS = 2_000_000_000  # a shorter pause is no reason to drop what a port has kept
_MOST_STALL_US = 60e6  # for which the host may be put aside while frames are dropped


class FrameGaps:
    """Owns the last frame with a sequence, and when it arrived."""

    def __init__(self) -> None:
        self._last: RawSample | Hello | None = None
        self._last_ns = 0
        self._heard_ns = 0

    def are_stale(self, now_ns: int, seen_ns: int) -> bool:
        """Return whether bytes that are read now cannot be stamped: none were read for longer than a clock was seen.

        Its rate is not known well enough then to compute how long they lay in the port.
        """
        heard_ns, self._heard_ns = self._heard_ns, now_ns
        return self._last is not None and 0 < heard_ns < now_ns - max(_STALE_NS, seen_ns)

    def before(self, frame: RawSample | Hello, arrival_ns: int) -> int | None:
        """Return how many frames are missing before this one; None where the device began again.

        Its first samples come before the hello that states so: its time goes back, or on by far more than the host's.
        """
        last, last_ns = self._last, self._last_ns
        self._last, self._last_ns = frame, arrival_ns
        if last is None:
            return 0
        on_us = (frame.t_us - last.t_us) % _WRAP_US
        if on_us > (arrival_ns - last_ns) / 1000.0 + _MOST_STALL_US:
            return None
        return (frame.sequence - last.sequence - 1) % _SEQUENCES


class SerialBridge(InertialSource):
    """An `InertialSource`. Frames come from firmware/vislam_bridge; see `protocol`.

    What a plug, a cable or a wrong port can cause is in `health`, `counters` and, in words, `problem`. A port that
    goes away is looked for every `config.reopen_s`; one that gives no sample for `config.start_s` is opened again,
    which restarts an Arduino. Nothing is ever written to it. One thread only.
    """

    stamped_by = "the board's clock, on the line below the arrivals of its frames"

    def __init__(self, config: SerialConfig, must_be_there: bool = True, further: socket.socket | None = None) -> None:
        """Open the port and wait for the first sample, `config.start_s` and a second at most.

        With `must_be_there` False nothing is waited for and nothing that is missing is an error. What the board sends
        of encoders and a satellite receiver goes to `further`, see `Passer`.

        Raises:
            HardwareError: no sample came, and why; pyserial is not installed.
        """
        super().__init__(config.calibration, config.missing_s, config.max_temperature_change_c)
        self._config, self._zero_c = config, config.calibrated_at_c
        self.rate_hz = _NOMINAL_HZ
        self._field.held = self._field.stuck = _MAG_STUCK
        self._port = SerialPort(config.port, config.baud, self._faults.counts)
        self._behind = Behind(config)
        self._decoder = FrameDecoder()
        self._line = DeviceClock(config.clock)
        self._passer = Passer(self._line, further)
        self._retry_ns = 0  # when to open the port
        self._patience_ns = 0  # until when a frame must have come
        self._other_version: int | None = None
        self._gaps = FrameGaps()
        self._steps_reported = 0
        self._errors = Health(0)  # of chips, that the last frame reports
        self._last_out_ns = 0
        self._first: list[ImuSample | MagSample] = []
        if must_be_there:
            self._wait_for_sample()

    @property
    def problem(self) -> str:
        """Why no samples come, for a person; empty when they do."""
        return self._port.problem

    @property
    def hello(self) -> Hello | None:
        """What the device said about itself; None before it did."""
        return self._behind.hello

    @property
    def max_zero_deg_s(self) -> float:
        """Of its gyro at rest, by the data sheet."""
        return self._behind.max_zero_deg_s

    @property
    def board_name(self) -> str:
        """Which chips the device has, in words; empty before it said so."""
        return self._behind.name

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured, see `InertialSource`; waits for the first sample, `timeout_s` at most."""
        first, self._first = self._first, []
        now = time.monotonic_ns()
        if first and now - self._last_out_ns < 2 * _NS:  # else the others took long to start
            return first
        deadline = now + round(timeout_s * _NS)
        while True:
            if not self._port.is_open and now >= self._retry_ns:
                self._open(now)
            if not self._port.is_open:
                time.sleep(max(min(deadline, self._retry_ns) - now, 0) / _NS)
            else:
                until = min(deadline, self._patience_ns)
                samples = self._received(max(until - now, 0) / _NS)
                if samples:
                    return samples
            now = time.monotonic_ns()
            if now >= deadline:
                return []

    def health(self) -> Health:
        """Return the sensor bits that hold now and the events since the last call."""
        word = super().health() | self._errors
        if self._line.steps > self._steps_reported:
            self._steps_reported = self._line.steps
            word |= Health.CLOCK_STEP
        return word

    def counters(self) -> dict[str, int]:
        """Return how often each fault occurred since the start."""
        own = Counter(bad_frames=self._decoder.bad, clock_steps=self._line.steps, stamps_doubted=self._line.doubted)
        return dict(self._faults.counts + self._passer.counts + own)

    def close(self) -> None:
        """Close the port; may be called twice."""
        self._port.close()

    def _open(self, now: int) -> None:
        """Try to open the port; what keeps it from opening is in `problem`."""
        config = self._config
        self._retry_ns = now + round(config.reopen_s * _NS)
        if not self._port.open():
            self._passer.lose(self.problem)
            return
        self._patience_ns = now + round(config.start_s * _NS)
        self._decoder.reset()
        self._line.restart()
        self._behind.forget()
        self._other_version, self._gaps = None, FrameGaps()

    def _wait_for_sample(self) -> None:
        end_ns = time.monotonic_ns() + round((self._config.start_s + 1.0) * _NS)
        found: list[ImuSample | MagSample] = []
        while not self._last_out_ns and not (self._gyro.is_held or self._accel.is_held):  # that is a fault
            left_ns = end_ns - time.monotonic_ns()
            found += self.read(min(max(left_ns / _NS, 0.0), _GLANCE_S))
            hopeless = self._other_version is not None or (
                not self._port.is_open and self._faults.counts["opened"] == 0
            )
            if left_ns <= 0 or hopeless:
                problem = self._diagnosis()[1] if self._port.is_open else self.problem
                self.close()
                raise HardwareError(problem)
        self._first = found

    def _diagnosis(self) -> tuple[str, str]:
        """Return why an open port gives no sample: a counter's name and words."""
        port, decoder = self._config.port, self._decoder
        if self._other_version is not None:
            return "other_version", (
                f"{port} speaks version {self._other_version} of the protocol, this vislam speaks {PROTOCOL_VERSION}; "
                "put the sketch of this vislam on the board, see docs/sensors.md"
            )
        if self._behind.hello is not None:
            return "no_sample", f"{port}: {self._behind.why_silent(self._errors)}"
        if decoder.bytes_since_good > 0:
            return "no_valid_frame", (
                f"{port} sends bytes that are no frames: another device, or another rate than {self._config.baud} "
                "baud; set serial.baud to what is in the sketch"
            )
        return "silent", f"{port} is silent; is the board powered and the sketch on it? see docs/sensors.md"

    def _received(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return the samples in what the port has, waiting for the first byte."""
        data = self._port.received(timeout_s)
        is_stale = bool(data) and self._gaps.are_stale(time.monotonic_ns(), self._line.seen_ns)
        if is_stale:  # as arrivals they would bend the clock's line
            self._port.drain()
            self._decoder.reset()
            self._line.restart()
        if data is None or not self._port.is_open:
            self._passer.lose(self.problem)
            return []
        arrival_ns = time.monotonic_ns()
        bad, found = self._decoder.bad, self._decoder.feed(b"" if is_stale else data)
        samples = [one for message in found for one in self._taken(message, arrival_ns, message is found[-1])]
        if self._decoder.bad > bad:
            self._faults.events |= Health.BUS_FAULT
        if samples or is_stale:
            self._patience_ns = arrival_ns + round(self._config.start_s * _NS)
            self._port.problem = ""
        elif arrival_ns >= self._patience_ns:
            self._port.lose(*self._diagnosis())
            self._passer.lose(self.problem)
        samples.sort(key=lambda sample: sample.t_ns)
        return samples

    def _taken(self, message: Message, arrival_ns: int, is_last: bool) -> list[ImuSample | MagSample]:
        if isinstance(message, Counts | Passed):
            self._passer.take(message)
            return []
        if isinstance(message, OtherVersion):
            self._other_version = message.version
            self._behind.forget()
            self._faults.events |= Health.BUS_FAULT
            return []
        if isinstance(message, Hello):
            self._greet(message, arrival_ns)
            return []
        if isinstance(message, Ages | Spent):
            self._behind.take(message)
            return []
        self._follow(message, arrival_ns)
        hello = self._behind.hello
        if hello is None or not self._behind.is_known:
            self._faults.add("before_hello")
            return []
        return self._sampled(message, hello, arrival_ns, is_last)

    def _greet(self, hello: Hello, arrival_ns: int) -> None:
        """Take what the device states about itself."""
        if Chips.STARTED in hello.chips and self._behind.hello is not None:
            self._faults.add("device_restarts")
            self._line.restart()
            self._gaps = FrameGaps()
        self._follow(hello, arrival_ns)
        self._behind.greet(hello)
        self._scaled(hello.gyro_nrad_s * 1e-9, hello.accel_nm_s2 * 1e-9, hello.mag_pt * 1e-6)
        self._gyro.limit, self._accel.limit = hello.gyro_limit, hello.accel_limit
        self._passer.greet(hello)
        self.rate_hz = float(hello.rate_hz)

    def _follow(self, message: RawSample | Hello, arrival_ns: int) -> None:
        """Count frames that are missing before this one."""
        lost = self._gaps.before(message, arrival_ns)
        if lost != 0:
            self._faults.add("frames_lost", Health.IMU_GAP, lost or 0)

    def _sampled(self, raw: RawSample, hello: Hello, arrival_ns: int, is_last: bool) -> list[ImuSample | MagSample]:
        stamp_ns = self._line.stamp(raw.t_us, arrival_ns - self._behind.line_ns, is_last)
        self._note_errors(raw)
        can_use = Status.ACCEL_ERROR not in raw.status and self._accel.sound([raw.accel])[0]
        if Status.GYRO_ERROR not in raw.status:
            can_use = self._gyro.sound([raw.gyro])[0] and can_use
            found_c = raw.temperature * hello.temperature_nk * 1e-9 + hello.temperature_mc * 1e-3
            self._warmed(found_c, 1.0 / (_TEMPERATURE_TAU_S * self.rate_hz))
        samples: list[ImuSample | MagSample] = []
        if Status.MAG_NEW in raw.status and Status.MAG_ERROR not in raw.status:
            is_beyond = max(map(abs, raw.mag)) >= hello.mag_limit
            samples += self._magnetic((stamp_ns or 0) - self._behind.mag_delay_ns, raw.mag, is_beyond)
        if stamp_ns is None:
            self._faults.add("unstamped")
            return []
        if can_use and Status.GYRO_ERROR not in raw.status:
            samples.append(self._inertial(stamp_ns - self._behind.gyro_delay_ns, raw.gyro, self._behind.accel(raw)))
            self._last_out_ns = arrival_ns
        return samples

    def _note_errors(self, raw: RawSample) -> None:
        """Count the faults that a sample reports."""
        if Status.MISSED in raw.status:
            self._faults.add("device_late", Health.IMU_GAP)
        if raw.status & (Status.ACCEL_ERROR | Status.GYRO_ERROR):
            self._faults.events |= Health.IMU_GAP | Health.BUS_FAULT
        self._errors = Health(0)
        for error, name, bit in (
            (Status.ACCEL_ERROR, "accel_errors", Health.ACCEL_FAULT),
            (Status.GYRO_ERROR, "gyro_errors", Health.GYRO_FAULT),
            (Status.MAG_ERROR, "mag_errors", Health.MAG_FAULT),
        ):
            if error in raw.status:
                self._faults.add(name)
                self._errors |= bit
