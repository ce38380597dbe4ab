"""Inertial samples from a microcontroller on a serial port, which reads the chips on time where a host cannot."""

from __future__ import annotations

import errno
import termios
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from vislam.config import SerialConfig
from vislam.core.errors import HardwareError, install_line
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.bridge.behind import Behind
from vislam.hw.bridge.clock import DeviceClock
from vislam.hw.bridge.frame_gaps import FrameGaps
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
from vislam.hw.descriptor import received
from vislam.hw.gyro_zero import GyroZero
from vislam.hw.health import Health
from vislam.hw.link import HELD_SAMPLES

if TYPE_CHECKING:
    import socket

    import serial

_MAG_STUCK = 10  # equal values of a magnetometer in a row: 0.2 s at the sketch's 50 Hz
_STUCK_S = 0.25  # counts of a chip that do not change for so long: even at rest they have noise
_NS = 1_000_000_000
# pyserial raises all of them at a device that goes away; its own SerialException is an OSError
PORT_ERRORS = (OSError, ValueError, TypeError, termios.error)
_GLANCE_S = 0.05  # while the first sample is waited for, so soon a port that cannot be opened is reported
_NOMINAL_HZ = 400.0  # until the device states it
_TEMPERATURE_TAU_S = 1.0  # its counts are noisy, its changes slow


class SerialBridge:
    """Satisfies `InertialSource`. Frames come from firmware/vislam_bridge; see `protocol`.

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
        self._serial = load_pyserial()
        self._config = config
        self.rate_hz = _NOMINAL_HZ
        self.problem = f"{config.port} has not been opened"
        self._behind = Behind(config)
        self._decoder = FrameDecoder()
        self._clock = DeviceClock(config.clock)
        self._passer = Passer(self._clock, further)
        self._port: serial.Serial | None = None
        self._retry_ns = 0  # when to open the port
        self._patience_ns = 0  # until when a frame must have come
        self._other_version: int | None = None
        self._gaps = FrameGaps()
        self._counts: Counter[str] = Counter()
        self._events = Health(0)
        self._steps_reported = 0
        self._faults = Health(0)  # that the last frames report
        self._newest_ns = 0  # when the last inertial sample came
        self._watches = {name: _Watch() for name in ("accel", "gyro", "mag")}
        self._temperature_c: float | None = None
        self._zero = GyroZero(config.calibrated_at_c)
        self._first: list[ImuSample | MagSample] = []
        if must_be_there:
            self._wait_for_sample()

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the gyro, smoothed over a second; None before the first sample."""
        return self._temperature_c

    def zeroed_at(self, temperature_c: float, gyro_per_c: Array) -> None:
        """Take the drift from a temperature on off; see `InertialSource`. TEMPERATURE_DRIFT is set when it is far."""
        self._zero = GyroZero(temperature_c, np.asarray(gyro_per_c))

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
        if first and now - self._newest_ns < 2 * _NS:  # else the others took long to start
            return first
        deadline = now + round(timeout_s * _NS)
        while True:
            if self._port is None and now >= self._retry_ns:
                self._open(now)
            if self._port is None:
                time.sleep(max(min(deadline, self._retry_ns) - now, 0) / _NS)
            else:
                until = min(deadline, self._patience_ns)
                samples = self._received(self._port, max(until - now, 0) / _NS)
                if samples:
                    return samples
            now = time.monotonic_ns()
            if now >= deadline:
                return []

    def health(self) -> Health:
        """Return the sensor bits that hold now and the events since the last call."""
        word, self._events = self._events | self._faults, Health(0)
        if self._clock.steps > self._steps_reported:
            self._steps_reported = self._clock.steps
            word |= Health.CLOCK_STEP
        if time.monotonic_ns() - self._newest_ns > self._config.missing_s * _NS:
            word |= Health.IMU_MISSING
        if self._zero.is_far(self._temperature_c, self._config.max_temperature_change_c):
            word |= Health.TEMPERATURE_DRIFT
        return word

    def counters(self) -> dict[str, int]:
        """Return how often each fault occurred since the start."""
        own = Counter(bad_frames=self._decoder.bad, clock_steps=self._clock.steps, stamps_doubted=self._clock.doubted)
        return dict(self._counts + self._passer.counts + own)

    def close(self) -> None:
        """Close the port; may be called twice."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except PORT_ERRORS:
                self._counts["close_failures"] += 1

    def _open(self, now: int) -> None:
        """Try to open the port; what keeps it from opening is in `problem`."""
        config = self._config
        self._retry_ns = now + round(config.reopen_s * _NS)
        try:
            # exclusive: two programs on one port would each get half of the bytes
            self._port = self._serial.Serial(config.port, config.baud, timeout=0, exclusive=True)
        except PORT_ERRORS as error:
            self._counts["open_failures"] += 1
            self.problem = why_not_open(config, error)
            self._passer.lose(self.problem)
            return
        self._counts["opened"] += 1
        self._patience_ns = now + round(config.start_s * _NS)
        self._decoder.reset()
        self._clock.restart()
        self._behind.forget()
        self._other_version, self._gaps = None, FrameGaps()

    def _wait_for_sample(self) -> None:
        end_ns = time.monotonic_ns() + round((self._config.start_s + 1.0) * _NS)
        found: list[ImuSample | MagSample] = []
        while not self._newest_ns and self._watches["gyro"].count < HELD_SAMPLES:  # a gyro that hangs is a fault
            left_ns = end_ns - time.monotonic_ns()
            found += self.read(min(max(left_ns / _NS, 0.0), _GLANCE_S))
            hopeless = self._other_version is not None or (self._port is None and self._counts["opened"] == 0)
            if left_ns <= 0 or hopeless:
                problem = self.problem if self._port is None else self._diagnosis()[1]
                self.close()
                raise HardwareError(problem)
        self._first = found

    def _lose(self, what: str, problem: str) -> None:
        self._counts[what] += 1
        self.problem = problem
        self._passer.lose(problem)
        self.close()

    def _diagnosis(self) -> tuple[str, str]:
        """Return why an open port gives no sample: a counter's name and words."""
        port, decoder = self._config.port, self._decoder
        if self._other_version is not None:
            return "other_version", (
                f"{port} speaks version {self._other_version} of the protocol, this vislam speaks {PROTOCOL_VERSION}; "
                "put the sketch of this vislam on the board, see docs/sensors.md"
            )
        if self._behind.hello is not None:
            return "no_sample", f"{port}: {self._behind.why_silent(self._faults)}"
        if decoder.bytes_since_good > 0:
            return "no_valid_frame", (
                f"{port} sends bytes that are no frames: another device, or another rate than {self._config.baud} "
                "baud; set serial.baud to what is in the sketch"
            )
        return "silent", f"{port} is silent; is the board powered and the sketch on it? see docs/sensors.md"

    def _received(self, port: serial.Serial, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return the samples in what the port has, waiting for the first byte; an unplugged port is closed."""
        config = self._config
        try:
            data = received(port.fileno(), timeout_s)
            is_stale = bool(data) and self._gaps.are_stale(time.monotonic_ns(), self._clock.seen_ns)
            if is_stale:  # as arrivals they would bend the clock's line
                port.reset_input_buffer()
                self._decoder.reset()
                self._clock.restart()
                data = b""
        except PORT_ERRORS as error:
            self._lose("port_lost", f"{config.port} went away: {error}; plug it in again")
            return []
        arrival_ns = time.monotonic_ns()
        bad, found = self._decoder.bad, self._decoder.feed(data)
        samples = [one for message in found for one in self._taken(message, arrival_ns, message is found[-1])]
        if self._decoder.bad > bad:
            self._events |= Health.BUS_FAULT
        if samples or is_stale:
            self._patience_ns = arrival_ns + round(config.start_s * _NS)
            self.problem = ""
        elif arrival_ns >= self._patience_ns:
            self._lose(*self._diagnosis())
        samples.sort(key=lambda sample: sample.t_ns)
        return samples

    def _taken(self, message: Message, arrival_ns: int, is_last: bool) -> list[ImuSample | MagSample]:
        if isinstance(message, Counts | Passed):
            self._passer.take(message)
            return []
        if isinstance(message, OtherVersion):
            self._other_version = message.version
            self._behind.forget()
            self._events |= Health.BUS_FAULT
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
            self._counts["before_hello"] += 1
            return []
        return self._sampled(message, hello, arrival_ns, is_last)

    def _greet(self, hello: Hello, arrival_ns: int) -> None:
        """Take what the device states about itself."""
        if Chips.STARTED in hello.chips and self._behind.hello is not None:
            self._counts["device_restarts"] += 1
            self._clock.restart()
            self._gaps = FrameGaps()
        self._follow(hello, arrival_ns)
        self._behind.greet(hello)
        self._passer.greet(hello)
        self.rate_hz = float(hello.rate_hz)

    def _follow(self, message: RawSample | Hello, arrival_ns: int) -> None:
        """Count frames that are missing before this one."""
        lost = self._gaps.before(message, arrival_ns)
        if lost != 0:
            self._counts["frames_lost"] += lost or 0
            self._events |= Health.IMU_GAP

    def _sampled(self, raw: RawSample, hello: Hello, arrival_ns: int, is_last: bool) -> list[ImuSample | MagSample]:
        stamp_ns = self._clock.stamp(raw.t_us, arrival_ns - self._behind.line_ns, is_last)
        self._note_status(raw, hello)
        if stamp_ns is None:
            self._counts["unstamped"] += 1
            return []
        samples: list[ImuSample | MagSample] = []
        is_sound = max(map(abs, raw.mag)) < hello.mag_limit and not self._faults & Health.MAG_FAULT
        if Status.MAG_NEW in raw.status and is_sound:
            samples.append(self._behind.field(raw, stamp_ns))
        if raw.status & (Status.ACCEL_ERROR | Status.GYRO_ERROR):
            self._events |= Health.IMU_GAP | Health.BUS_FAULT
        elif self._watches["gyro"].count >= HELD_SAMPLES:
            self._events |= Health.IMU_GAP
        else:
            samples.append(self._behind.inertial(raw, stamp_ns, self._zero.drift_rad_s(self._temperature_c)))
            self._newest_ns = arrival_ns
        return samples

    def _note_status(self, raw: RawSample, hello: Hello) -> None:
        """Count the faults that a sample reports, and those of its counts."""
        faults, counts, stuck = Health(0), self._counts, round(_STUCK_S * hello.rate_hz)
        if Status.MISSED in raw.status:
            counts["device_late"] += 1
            self._events |= Health.IMU_GAP
        for error, name, bit in (
            (Status.ACCEL_ERROR, "accel_errors", Health.ACCEL_FAULT),
            (Status.GYRO_ERROR, "gyro_errors", Health.GYRO_FAULT),
            (Status.MAG_ERROR, "mag_errors", Health.MAG_FAULT),
        ):
            if error in raw.status:
                counts[name] += 1
                faults |= bit
        if Status.ACCEL_ERROR not in raw.status:
            if max(map(abs, raw.accel)) >= hello.accel_limit:
                counts["accel_saturated"] += 1
                self._events |= Health.ACCEL_SATURATED
            if self._watches["accel"].repeats(raw.accel) >= stuck:
                counts["accel_stuck"] += 1
                faults |= Health.ACCEL_FAULT
        if Status.GYRO_ERROR not in raw.status:
            if max(map(abs, raw.gyro)) >= hello.gyro_limit:
                counts["gyro_saturated"] += 1
                self._events |= Health.GYRO_SATURATED
            if self._watches["gyro"].repeats(raw.gyro) >= stuck:
                counts["gyro_stuck"] += 1
                faults |= Health.GYRO_FAULT
            told_c = raw.temperature * hello.temperature_nk * 1e-9 + hello.temperature_mc * 1e-3
            self._temperature_c = _smoothed(told_c, self._temperature_c, self.rate_hz)
        self._faults = faults | self._field_faults(raw, hello)

    def _field_faults(self, raw: RawSample, hello: Hello) -> Health:
        """Count the faults of a magnetometer's counts; return the bit that holds while they stay the same."""
        if Status.MAG_NEW in raw.status:
            if max(map(abs, raw.mag)) >= hello.mag_limit:
                self._counts["mag_overflow"] += 1
                self._events |= Health.MAG_FAULT
            elif self._watches["mag"].repeats(raw.mag) >= _MAG_STUCK:
                self._counts["mag_stuck"] += 1
        return Health.MAG_FAULT if self._watches["mag"].count >= _MAG_STUCK else Health(0)


class _Watch:
    """Counts how often values came again to the last bit; noise makes that impossible, a hung chip does it."""

    def __init__(self) -> None:
        self._last: tuple[int, ...] | None = None
        self.count = 0

    def repeats(self, values: tuple[int, ...]) -> int:
        self.count = self.count + 1 if values == self._last else 0
        self._last = values
        return self.count


def _smoothed(told_c: float, before_c: float | None, rate_hz: float) -> float:
    """Return a temperature, smoothed over `_TEMPERATURE_TAU_S`."""
    if before_c is None:
        before_c = told_c
    gain = min(1.0 / (_TEMPERATURE_TAU_S * rate_hz), 1.0)
    return before_c + gain * (told_c - before_c)


def load_pyserial() -> Any:
    """Return the module; raises HardwareError where it is not installed."""
    try:
        import serial as module
    except ImportError as error:
        raise HardwareError(f"a serial port needs pyserial; install it: {install_line('hw')}") from error
    return module


def why_not_open(config: SerialConfig, error: Exception) -> str:
    """Return what keeps a port from opening, and what to do about it."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        from serial.tools import list_ports

        there = ", ".join(port.device for port in list_ports.comports()) or "none"
        return f"there is no port {config.port}; there are: {there}. Plug the board in, or name another port"
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"{config.port} may not be opened; add yourself to the group that owns it (usually: "
            "sudo usermod -aG dialout $USER) and log in again"
        )
    if number in (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK):
        return f"{config.port} is used by another program; close it (the Arduino IDE's monitor?)"
    return f"{config.port} cannot be opened as a serial port at {config.baud} baud: {error}"
