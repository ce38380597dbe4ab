"""What the serial bridge sends: frames of a microcontroller that reads the chips, and a decoder that trusts nothing.

A frame is `type, sequence, device time, body, CRC-16`, stuffed by COBS (Cheshire and Baker, 1999) and ended by a zero
byte, all little-endian. Samples and hellos share one sequence; counts and passed bytes, which a sketch sends only where
it has encoders or a receiver, ages, which it sends only of chips other than a GY-85's, and what a sample takes have one
each: a host which does not know them misses nothing. The CRC is CCITT's with initial value 0xFFFF (`binascii.crc_hqx`).
The structs, flags and values below are the whole table; firmware/vislam_bridge/vislam_bridge.ino is the other end.
"""

import binascii
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import IntFlag
from functools import partial

PROTOCOL_VERSION = 1
SAMPLE_TYPE, HELLO_TYPE, COUNTS_TYPE, PASSED_TYPE, AGES_TYPE, SPENT_TYPE = 1, 2, 3, 4, 5, 6
# longest stuffed frame, without its zero; a longer stretch without a zero is noise, and nothing of it is kept
MAX_STUFFED_BYTES = 64

_SAMPLE = struct.Struct("<BHIB9hh")  # type, sequence, microseconds, status, accel, gyro, mag, temperature
_HELLO = struct.Struct("<BHIBBBB3sHIIIIiHHH")
_COUNTS = struct.Struct("<BHIii")
_PASSED = struct.Struct("<BHI")  # then the bytes
MOST_PASSED = 20  # bytes in a frame: so that behind it an AVR's buffer still has room for a sample
_AGES = struct.Struct("<BHIBHHH")
_SPENT = struct.Struct("<BHIH")
_VERSION_AT = 7  # the same in every version: type, sequence, microseconds, version
_CRC = struct.Struct("<H")
_CRC_BEGIN = 0xFFFF
SAMPLE_WIRE_BYTES = _SAMPLE.size + _CRC.size + 2  # stuffing adds one, the zero at the end another


class Status(IntFlag):
    """Faults that a sample reports; the remaining bits are 0."""

    MAG_NEW = 1 << 0  # the magnetometer was read for this sample; otherwise its values are the last ones
    ACCEL_ERROR = 1 << 1  # the chip did not answer: its values mean nothing
    GYRO_ERROR = 1 << 2
    MAG_ERROR = 1 << 3
    MISSED = 1 << 4  # the device could not sample or send in time before this one


class Chips(IntFlag):
    """Chips that answered with their id, and whether the device has just started."""

    ACCEL = 1 << 0
    GYRO = 1 << 1
    MAG = 1 << 2
    ENCODERS = 1 << 3  # the sketch is configured for encoders, and counts them
    GNSS = 1 << 4  # ... of a satellite receiver, whose bytes it passes on
    FAST_EDGES = 1 << 5  # since the last hello, encoders had more edges than the device counts for sure
    STARTED = 1 << 7  # the first hello since the device started


@dataclass(frozen=True, slots=True)
class RawSample:
    """Counts of one sampling instant, in the axes of the chips."""

    sequence: int  # 16 bits, of all frames
    t_us: int  # device time when the gyro was read, 32 bits
    status: Status
    accel: tuple[int, int, int]
    gyro: tuple[int, int, int]
    mag: tuple[int, int, int]  # x, y, z, whatever the order in the chip
    temperature: int


@dataclass(frozen=True, slots=True)
class Hello:
    """Who the device is and what its counts mean; sent when it starts and then once a second."""

    sequence: int
    t_us: int
    chips: Chips
    # 0xE5: ADXL345; of a chip that is both, what it has in WHO_AM_I, known to the sketch if ACCEL is among `chips`
    accel_id: int
    gyro_id: int  # 0x68, 0x69: ITG3200, ITG3205; of a chip that is both the same as `accel_id`
    mag_id: bytes  # 3 bytes, b"H43": HMC5883L, b"H\0\0": AK8963
    rate_hz: int
    accel_nm_s2: int  # per count
    gyro_nrad_s: int  # per count
    mag_pt: int  # picotesla per count
    temperature_nk: int  # per count
    temperature_mc: int  # thousandths of a degree Celsius at count 0
    accel_limit: int  # counts of this size and beyond are saturated
    gyro_limit: int
    mag_limit: int


@dataclass(frozen=True, slots=True)
class OtherVersion:
    """A hello of a protocol that this vislam does not speak."""

    version: int


@dataclass(frozen=True, slots=True)
class Counts:
    """Where the encoders of two wheels stand; both edges of channel A count, 0 when the device started."""

    sequence: int  # 16 bits, of these frames alone
    t_us: int
    left: int  # 32 bits, signed
    right: int


@dataclass(frozen=True, slots=True)
class Passed:
    """Bytes that a satellite receiver sent to the device, 1 to `MOST_PASSED`."""

    sequence: int  # 16 bits, of these frames alone
    t_us: int  # when the first one was taken
    data: bytes


@dataclass(frozen=True, slots=True)
class Ages:
    """How old the values of a chip are when they are read: filters, and half a period; sent before each hello.

    Of a GY-85 nothing is sent: the host knows its chips.
    """

    sequence: int  # 16 bits, of these frames alone
    t_us: int
    accel_id: int  # of the hello that follows
    gyro_us: int
    accel_us: int
    mag_us: int


@dataclass(frozen=True, slots=True)
class Spent:
    """How long a sample took at least, from its time to its first byte on the line; sent before a hello."""

    sequence: int  # 16 bits, of these frames alone
    t_us: int
    spent_us: int


Message = RawSample | Hello | OtherVersion | Counts | Passed | Ages | Spent


def encode(message: RawSample | Hello | Counts | Passed | Ages | Spent) -> bytes:
    """Return a frame with its zero at the end, byte for byte what the firmware sends."""
    if isinstance(message, RawSample):
        m = message
        body = _SAMPLE.pack(SAMPLE_TYPE, m.sequence, m.t_us, m.status, *m.accel, *m.gyro, *m.mag, m.temperature)
    elif isinstance(message, Passed):
        body = _PASSED.pack(PASSED_TYPE, message.sequence, message.t_us) + message.data
    else:
        sequence, t_us, *rest = (getattr(message, field.name) for field in fields(message))
        if isinstance(message, Hello):
            body = _HELLO.pack(HELLO_TYPE, sequence, t_us, PROTOCOL_VERSION, *rest)
        else:
            kind = next(kind for kind, (of, _) in _PLAIN.items() if isinstance(message, of))
            body = _PLAIN[kind][1].pack(kind, sequence, t_us, *rest)
    return stuff(body + _CRC.pack(binascii.crc_hqx(body, _CRC_BEGIN))) + b"\0"


def stuff(data: bytes) -> bytes:
    """Return data as COBS without a zero byte; one byte longer for data of up to 254 bytes."""
    stuffed = bytearray()
    runs = data.split(b"\0")
    for i, run in enumerate(runs):
        rest = run
        while len(rest) >= 254:
            stuffed += b"\xff" + rest[:254]
            rest = rest[254:]
            if not rest and i == len(runs) - 1:
                return bytes(stuffed)
        stuffed.append(len(rest) + 1)
        stuffed += rest
    return bytes(stuffed)


def unstuff(stuffed: bytes) -> bytes | None:
    """Return the data of a COBS block, None where it is none."""
    data = bytearray()
    at, end = 0, len(stuffed)
    while at < end:
        code = stuffed[at]
        following = at + code
        if code == 0 or following > end:
            return None
        data += stuffed[at + 1 : following]
        at = following
        if code < 255 and at < end:
            data.append(0)
    return bytes(data)


def parse(stuffed: bytes) -> Message | None:
    """Return the message of a frame without its zero; None unless stuffing, length, CRC and every field fit."""
    data = unstuff(stuffed)
    if data is None or len(data) <= _VERSION_AT + _CRC.size:
        return None
    body = data[: -_CRC.size]
    if binascii.crc_hqx(body, _CRC_BEGIN) != _CRC.unpack(data[-_CRC.size :])[0]:
        return None
    return _READERS[body[0]](body) if body[0] in _READERS else None


def _sample(body: bytes) -> RawSample | None:
    if len(body) != _SAMPLE.size:
        return None
    _, sequence, t_us, status, *values = _SAMPLE.unpack(body)
    if status & ~_ALL_STATUS:
        return None
    ax, ay, az, wx, wy, wz, mx, my, mz, temperature = values
    return RawSample(sequence, t_us, Status(status), (ax, ay, az), (wx, wy, wz), (mx, my, mz), temperature)


def _hello(body: bytes) -> Hello | OtherVersion | None:
    if body[_VERSION_AT] != PROTOCOL_VERSION:
        return OtherVersion(body[_VERSION_AT])
    if len(body) != _HELLO.size:
        return None
    _, sequence, t_us, _, chips, *rest = _HELLO.unpack(body)
    hello = Hello(sequence, t_us, Chips(chips), *rest)
    scales = (hello.rate_hz, hello.accel_nm_s2, hello.gyro_nrad_s, hello.mag_pt, hello.accel_limit, hello.gyro_limit)
    return hello if all(scales) else None


def _passed(body: bytes) -> Passed | None:
    _, sequence, t_us = _PASSED.unpack_from(body)
    data = body[_PASSED.size :]
    return Passed(sequence, t_us, data) if len(data) <= MOST_PASSED else None


def _plain(made: type[Counts | Ages | Spent], layout: struct.Struct, body: bytes) -> Counts | Ages | Spent | None:
    return made(*layout.unpack(body)[1:]) if len(body) == layout.size else None


_ALL_STATUS = sum(Status)
# those whose fields stand in a frame one after the other
_PLAIN: dict[int, tuple[type[Counts | Ages | Spent], struct.Struct]] = {
    COUNTS_TYPE: (Counts, _COUNTS),
    AGES_TYPE: (Ages, _AGES),
    SPENT_TYPE: (Spent, _SPENT),
}
_READERS: dict[int, Callable[[bytes], Message | None]] = {
    SAMPLE_TYPE: _sample,
    HELLO_TYPE: _hello,
    PASSED_TYPE: _passed,
    **{kind: partial(_plain, *made) for kind, made in _PLAIN.items()},
}


class FrameDecoder:
    """Cuts a stream of bytes at its zeros and keeps what is a whole frame; memory stays below MAX_STUFFED_BYTES.

    `bad` counts what was cut out and is no frame, `bytes_since_good` what came since the last frame that is one.
    """

    def __init__(self) -> None:
        self.bad = 0
        self.bytes_since_good = 0
        self._rest = b""
        self._begun = False  # what comes before the first zero may be the end of a frame, which is no fault

    def feed(self, received: bytes) -> list[Message]:
        """Return the messages whose last byte is in `received`."""
        messages: list[Message] = []
        self.bytes_since_good += len(received)
        *whole, rest = (self._rest + received).split(b"\0")
        for stuffed in whole:
            message = parse(stuffed) if len(stuffed) <= MAX_STUFFED_BYTES else None
            if message is not None:
                messages.append(message)
                self.bytes_since_good = 0
            elif stuffed and self._begun:
                self.bad += 1
            self._begun = True
        self._rest = rest[: MAX_STUFFED_BYTES + 1]  # what is longer is bad whatever follows
        return messages

    def reset(self) -> None:
        """Forget the part of a frame that was received; the stream was interrupted."""
        self._rest = b""
        self._begun = False
