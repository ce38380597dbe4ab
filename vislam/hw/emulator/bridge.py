"""A serial bridge without hardware: a thread that writes its frames to a pseudo-terminal, with the faults of a cable.

What it sends is what the sketch sends, byte for byte (a test compiles the sketch), so that the real pyserial and the
real driver can be proven on it.
"""

import os
import pty
import random
import select
import threading
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from vislam.hw.bridge.protocol import (
    MOST_PASSED,
    SAMPLE_WIRE_BYTES,
    Ages,
    Chips,
    Counts,
    Hello,
    Passed,
    RawSample,
    Status,
    encode,
)
from vislam.hw.emulator.sensing import Sensing, SensorError, Truth, quantised

_NS = 1_000_000_000
_PERIOD_NS = 2_500_000
_MAG_EVERY = 8
_COUNTS_EVERY = 8  # samples: 50 a second
_LATE_NS = 20_000_000
_MOST_ASIDE_NS = 5 * _NS  # for which its thread may be put aside without loss: the samples come late
_HELLO_EVERY_NS = _NS
_READ_NS = 500_000  # from a sample's time to its first byte
_WIRE_NS = SAMPLE_WIRE_BYTES * 10 * _NS // 500_000  # that a frame is on its way, at 500 kBaud
_BOOT_NS = 120_000_000
_SEQUENCES, _WRAP_US = 2**16, 2**32
NOISE = (  # per sqrt(Hz), of gyro, accelerometer and magnetometer
    SensorError(density=(5.2e-4, 5.2e-4, 5.2e-4)),
    SensorError(density=(4.1e-3, 4.1e-3, 6.0e-3)),
    SensorError(density=(0.033, 0.033, 0.033)),
)
BridgedName = Literal["GY-85", "MPU-6050", "MPU-6500", "MPU-9250", "MPU-9255", "stranger"]
_WHO_AM_I = {"MPU-6050": 0x68, "MPU-6500": 0x70, "MPU-9250": 0x71, "MPU-9255": 0x73}
_STRANGER = 0x98  # of a clone of the MPU-6050 that the sketch does not know
_INSIDE_NS = 1_007_000  # between samples inside such a chip, by a clock that is 0.7 % slow


@dataclass(frozen=True, slots=True)
class Bridged:
    """What the sketch states about the chips behind it, and how their counts come about."""

    hello: Hello
    ages: Ages | None  # None: nothing is sent
    gyro_delay_ns: int  # of its filter
    accel_delay_ns: int
    inside_ns: int  # between samples inside the chip, of which the newest is read; 0: in the delays
    accel_most: int  # counts
    mag_overflow: int  # what an axis has then
    first_hellos: int  # before the first sample

    def newest_ns(self, t_ns: int) -> int:
        """Return when the sample was taken that is read at a time."""
        return t_ns - t_ns % self.inside_ns if self.inside_ns else t_ns


_GY85 = Bridged(
    Hello(0, 0, Chips(7), 0xE5, 0x68, b"H43", 400, 38_307_227, 1_214_142, 91_743, 3_571_429, 82_143, 4095, 28_750,
          2048),
    None, 3_300_000, 3_300_000, 0, 4095, -4096, 1,
)  # fmt: skip


def bridged(name: BridgedName) -> Bridged:
    """Return a board; the MPU-9250 and -9255 with their magnetometer, the MPU-6050 and -6500 without one.

    A `stranger` is a chip in their place whose id the sketch does not know: its samples have errors.
    """
    if name == "GY-85":
        return _GY85
    if name == "stranger":
        hello = replace(_GY85.hello, chips=Chips(0), accel_id=_STRANGER, gyro_id=0, mag_id=b"\0\0\0")
        return Bridged(hello, None, 0, 0, 0, 4095, -4096, 1)
    who, is_first, has_mag = _WHO_AM_I[name], name == "MPU-6050", name in ("MPU-9250", "MPU-9255")
    mag_id, mag_pt, mag_limit, mag_us = (
        (b"H\0\0", 150_000, 32_760, 5000) if has_mag else (b"\0\0\0", 91_743, 2048, 6700)
    )
    kelvin_nk, at_0_mc = (2_941_176, 36_530) if is_first else (2_995_178, 21_000)
    chips = Chips.ACCEL | Chips.GYRO | (Chips.MAG if has_mag else 0)
    hello = Hello(
        0, 0, chips, who, who, mag_id, 400, 2_394_202, 266_462, mag_pt, kelvin_nk, at_0_mc, 32_767, 32_767, mag_limit
    )
    gyro_us, accel_us = (2800, 3000) if is_first else (3900, 2880)
    ages = Ages(0, 0, who, gyro_us + 500, accel_us + 500, mag_us)
    return Bridged(hello, ages, 1000 * gyro_us, 1000 * accel_us, _INSIDE_NS, 32_767, -32_767, 2)


@dataclass(frozen=True, slots=True)
class LineFaults:
    """What goes wrong between device and host; shares of bytes."""

    dropped: float = 0.0
    flipped: float = 0.0
    silent: bool = False  # the device sends nothing
    garbage: bool = False  # as at another baud rate: every byte is another one
    no_accel: bool = False  # the chip does not answer
    no_gyro: bool = False
    frozen: bool = False  # the gyro gives the same counts for ever
    frozen_accel: bool = False
    frozen_mag: bool = False


class BridgeEmulator:
    """A board on a port of its own; `path` is what a driver opens. Use it as a context manager.

    The path is a link that comes and goes with `plug` and `unplug`, as below /dev/serial/by-id.
    """

    def __init__(
        self,
        path: Path,
        truth: Truth,
        seed: int = 0,
        drift: float = 0.0,
        errors: tuple[SensorError, SensorError, SensorError] = NOISE,
        turned: Callable[[int], tuple[float, float]] | None = None,
        has_receiver: bool = False,
        board: BridgedName = "GY-85",
    ) -> None:
        """Start the board and plug it in.

        Args:
            path: link to make.
            truth: the motion, see `sensing.Truth`.
            seed: of noise and faults.
            drift: of the device's clock, relative; 0.02 runs fast.
            errors: of gyro, accelerometer and magnetometer; the noise of the data sheets by default.
            turned: by how many counts left and right wheel have turned at a time; None: a sketch without encoders.
            has_receiver: the sketch passes on what `say` is given.
            board: what is behind it, see `bridged`.
        """
        self.path = path
        self.faults = LineFaults()
        self._truth = truth
        self._drift = drift
        self._turned = turned
        self._board = bridged(board)
        self._chips = self._board.hello.chips | (Chips.ENCODERS if turned else 0) | (Chips.GNSS if has_receiver else 0)
        self._said = b""  # by the receiver
        self._unsent = b""  # that the line has not taken yet
        self._rng = random.Random(seed)
        self._sensing = [Sensing(error, seed + i) for i, error in enumerate(errors)]
        self._lock = threading.Lock()
        self._master: int | None = None
        self._is_stopping = threading.Event()
        self._restart_asked = threading.Event()
        self.plug()
        self._thread = threading.Thread(target=self._run, name="bridge-emulator", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def plug(self) -> None:
        """Plug the cable in; the board starts, as one that is powered by USB."""
        with self._lock:
            if self._master is not None:
                return
            self._master, slave = pty.openpty()
            self._unsent = b""
            tty.setraw(slave)
            os.set_blocking(self._master, False)
            self.path.unlink(missing_ok=True)
            self.path.symlink_to(os.ttyname(slave))
            os.close(slave)
        self._restart_asked.set()

    def unplug(self) -> None:
        """Pull the cable out."""
        with self._lock:
            master, self._master = self._master, None
            if master is not None:
                self.path.unlink(missing_ok=True)
                os.close(master)

    def await_closing(self, timeout_s: float) -> bool:
        """Wait until no program has the port open; return whether that is so."""
        with self._lock:
            if self._master is None:
                return True
            slave_gone = select.poll()
            slave_gone.register(self._master, 0)  # poll reports POLLHUP whether asked or not
        return bool(slave_gone.poll(timeout_s * 1000.0))

    def restart(self) -> None:
        """Press the board's reset button."""
        self._restart_asked.set()

    def say(self, data: bytes) -> None:
        """Let the satellite receiver at the board say something; without one it is lost."""
        if Chips.GNSS in self._chips:
            with self._lock:
                self._said += data

    def close(self) -> None:
        """Stop the board; may be called twice."""
        self._is_stopping.set()
        self._thread.join(timeout=5.0)
        self.unplug()

    def _run(self) -> None:
        while not self._is_stopping.is_set():
            self._restart_asked.clear()
            if self._waited_until(time.monotonic_ns() + _BOOT_NS):
                self._run_from(time.monotonic_ns())

    def _run_from(self, begin_ns: int) -> None:
        """Sample and send as the sketch does, until the board is to restart."""
        sequence = ticks = 0
        hello_ns, chips = begin_ns, self._chips | Chips.STARTED
        further = _Further(self._turned, begin_ns)
        greeter, due_ns = _Greeter(self._board), begin_ns
        while True:
            frames = b""
            if due_ns >= hello_ns:
                hello_ns += _HELLO_EVERY_NS
                for _ in range(greeter.hellos()):
                    t_us = self._device_us(due_ns - begin_ns)
                    frames += greeter.ages(t_us) + encode(self._hello(sequence, t_us, chips))
                    sequence, chips = (sequence + 1) % _SEQUENCES, self._chips
            sample = self._sample(sequence, self._device_us(due_ns - begin_ns), due_ns, ticks)
            sequence, ticks = (sequence + 1) % _SEQUENCES, ticks + 1
            if not self._waited_until(due_ns + _READ_NS + _WIRE_NS):
                return
            frames += encode(sample)
            with self._lock:
                said, self._said = self._said[:MOST_PASSED], self._said[MOST_PASSED:]
            frames += further.counts(due_ns, self._device_us(due_ns - begin_ns), ticks)
            taken_ns = min(time.monotonic_ns(), due_ns + _LATE_NS)  # of a thread that was put aside: near its samples
            self._send(frames + further.passed(self._device_us(taken_ns - begin_ns), said))
            due_ns += _PERIOD_NS
            aside = max(time.monotonic_ns() - due_ns - _MOST_ASIDE_NS, 0) // _PERIOD_NS  # the board would have gone on
            due_ns, sequence, ticks = due_ns + aside * _PERIOD_NS, (sequence + aside) % _SEQUENCES, ticks + aside

    def _device_us(self, elapsed_ns: int) -> int:
        return round(elapsed_ns * (1.0 + self._drift)) // 1000 % _WRAP_US

    def _hello(self, sequence: int, t_us: int, chips: Chips) -> Hello:
        if self.faults.no_accel:
            chips &= ~Chips.ACCEL
        if self.faults.no_gyro:
            chips &= ~Chips.GYRO
        return replace(self._board.hello, sequence=sequence, t_us=t_us, chips=chips)

    def _sample(self, sequence: int, t_us: int, t_ns: int, tick: int) -> RawSample:
        """Return what the chips show at a time of the host's clock."""
        board, hello = self._board, self._board.hello
        newest_ns = board.newest_ns(t_ns)
        rate, force, field_ut, temperature_c = self._truth(newest_ns - board.gyro_delay_ns)
        if board.accel_delay_ns != board.gyro_delay_ns:
            _, force, _, _ = self._truth(newest_ns - board.accel_delay_ns)
        gyro, accel, mag = self._sensing
        status = Status(0)
        if tick % _MAG_EVERY == 0 and tick >= 2 * _MAG_EVERY and Chips.MAG in hello.chips:
            status |= Status.MAG_NEW
        if self.faults.no_accel or Chips.ACCEL not in hello.chips:
            status |= Status.ACCEL_ERROR
        if self.faults.no_gyro or Chips.GYRO not in hello.chips:
            status |= Status.GYRO_ERROR
        counts = quantised(gyro(rate, t_ns, temperature_c, 98.0), 1.0 / (hello.gyro_nrad_s * 1e-9), -32768, 32767)
        field = quantised(mag(field_ut, t_ns, temperature_c, 37.5), 1.0 / (hello.mag_pt * 1e-6), -32768, 32767)
        field = field if max(map(abs, field)) < hello.mag_limit else (board.mag_overflow,) * 3
        temperature = round((temperature_c - hello.temperature_mc * 1e-3) / (hello.temperature_nk * 1e-9))
        if self.faults.frozen:
            counts, temperature = (1, 2, 3), 0
        if self.faults.frozen_mag:
            field = (200, -400, 8)
        accel_lsb, most = 1.0 / (hello.accel_nm_s2 * 1e-9), board.accel_most
        pushed = quantised(accel(force, t_ns, temperature_c, 200.0), accel_lsb, -most - 1, most)
        return RawSample(
            sequence, t_us, status, (1, 2, 250) if self.faults.frozen_accel else pushed, counts, field, temperature,
        )  # fmt: skip

    def _waited_until(self, t_ns: int) -> bool:
        """Return at a time, or earlier with False when the board is to stop or to restart."""
        left_s = (t_ns - time.monotonic_ns()) / _NS
        while left_s > 0.0 and not self._interrupted():
            time.sleep(min(left_s, 0.05))
            left_s = (t_ns - time.monotonic_ns()) / _NS
        return not self._interrupted()

    def _interrupted(self) -> bool:
        return self._is_stopping.is_set() or self._restart_asked.is_set()

    def _send(self, frames: bytes) -> None:
        """Put frames on the wire; what a full line does not take is lost whole, as in the sketch."""
        faults = self.faults
        if faults.silent:
            return
        if faults.dropped or faults.flipped or faults.garbage:
            frames = self._spoiled(frames, faults)
        with self._lock:
            if self._master is not None:
                with suppress(OSError):  # no listener, or the line is full
                    self._unsent = self._unsent[os.write(self._master, self._unsent) :]
                    if not self._unsent:
                        self._unsent = frames[os.write(self._master, frames) :]

    def _spoiled(self, frames: bytes, faults: LineFaults) -> bytes:
        if faults.garbage:
            return bytes(byte * 7 + 3 & 0xFF for byte in frames)
        kept = [byte for byte in frames if self._rng.random() >= faults.dropped]
        return bytes(
            byte ^ 1 << self._rng.randrange(8) if self._rng.random() < faults.flipped else byte for byte in kept
        )


class _Greeter:
    """How the sketch identifies itself, since it started."""

    def __init__(self, board: Bridged) -> None:
        self._board = board
        self._first, self._ages_sent = board.first_hellos, 0

    def hellos(self) -> int:
        """Return how many hellos are due now."""
        count, self._first = self._first, 1
        return count

    def ages(self, t_us: int) -> bytes:
        """Return the frame before a hello, nothing where there is none."""
        if self._board.ages is None:
            return b""
        self._ages_sent += 1
        return encode(replace(self._board.ages, sequence=(self._ages_sent - 1) % _SEQUENCES, t_us=t_us))


class _Further:
    """What a board sends besides, since it started."""

    def __init__(self, turned: Callable[[int], tuple[float, float]] | None, begin_ns: int) -> None:
        self._turned = turned
        self._begun = (0.0, 0.0) if turned is None else turned(begin_ns)
        self._counted = self._passed = 0

    def counts(self, t_ns: int, t_us: int, tick: int) -> bytes:
        if self._turned is None or tick % _COUNTS_EVERY:
            return b""
        left, right = (round(now - then) for now, then in zip(self._turned(t_ns), self._begun, strict=True))
        self._counted += 1
        return encode(Counts((self._counted - 1) % _SEQUENCES, t_us, _signed(left), _signed(right)))

    def passed(self, t_us: int, said: bytes) -> bytes:
        if not said:
            return b""
        self._passed += 1
        return encode(Passed((self._passed - 1) % _SEQUENCES, t_us, said))


def _signed(count: int) -> int:
    return (count + 2**31) % 2**32 - 2**31


def at_rest(t_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
    """Return the truth of a board that stands level at 25 deg C, for `BridgeEmulator`."""
    return (0.0, 0.0, 0.0), (0.0, 0.0, 9.80665), (20.0, 0.0, -43.0), 25.0
