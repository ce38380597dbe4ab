"""Fixes from u-blox's binary messages: NAV-PVT; all others are passed over."""

import struct
from collections.abc import Iterator
from datetime import date

import numpy as np

from vislam.sensors.geodetic import Geodetic
from vislam.sensors.gnss.fixes import Fix, FixKind

_SYNC = b"\xb5\x62"
_NAV_PVT = b"\x01\x07"
_LENGTH = 92
_MOST_PAYLOAD = 8192  # of any message; a longer one is a damaged length
# iTOW, year, month, day, hour, minute, second, valid, tAcc, nano, fixType, flags, flags2, numSV, lon, lat, height,
# hMSL, hAcc, vAcc: u-blox M8 receiver description, UBX-13003221, 32.17.15
_LAYOUT = struct.Struct("<IHBBBBBBIiBBBBiiiiII")
_EPOCH = date(1970, 1, 1)
_DATED = 0b111  # date and time are valid and fully resolved


class UbxFixes:
    """Finds messages in a stream of bytes, with other protocols or damage in between."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._buffer = bytearray()
        self.damaged = 0  # messages with a wrong checksum or length
        self.undated = 0  # fixes before the receiver knew the time

    def feed(self, data: bytes) -> Iterator[Fix]:
        """Yield the fixes that are complete with these bytes."""
        self._buffer += data
        while payload := self._next():
            if fix := self._fix(payload):
                yield fix

    def _next(self) -> bytes | None:
        """Return the payload of the next NAV-PVT; None: more bytes are needed."""
        buffer, at = self._buffer, 0
        try:
            while True:
                at = buffer.find(_SYNC, at)
                if at < 0:
                    at = max(0, len(buffer) - 1)  # the last byte may be the first of a sync
                    return None
                if len(buffer) < at + 6:
                    return None
                length = int.from_bytes(buffer[at + 4 : at + 6], "little")
                end = at + 8 + length
                if length > _MOST_PAYLOAD:
                    self.damaged += 1
                    at += 2
                elif len(buffer) < end:
                    return None
                elif bytes(buffer[end - 2 : end]) != _checksum(buffer[at + 2 : end - 2]):
                    self.damaged += 1
                    at += 2  # the length may be what is damaged: look for a message inside
                else:
                    is_pvt = buffer[at + 2 : at + 4] == _NAV_PVT and length >= _LENGTH
                    payload, at = bytes(buffer[at + 6 : end - 2]), end
                    if is_pvt:
                        return payload
        finally:
            del buffer[:at]

    def _fix(self, payload: bytes) -> Fix | None:
        """Return the fix in a payload; None for one that has no place in space, or no time."""
        (_, year, month, day, hour, minute, second, valid, _, nano, fix_type, flags, _, _, longitude, latitude, height,
         _, sigma_mm, sigma_up_mm) = _LAYOUT.unpack_from(payload)  # fmt: skip
        if not flags & 1 or fix_type not in (3, 4):
            return None
        try:
            days = (date(year, month, day) - _EPOCH).days
        except ValueError:
            valid = 0
        if valid & _DATED != _DATED:
            self.undated += 1
            return None
        t_ns = (((days * 24 + hour) * 60 + minute) * 60 + second) * 10**9 + nano
        carrier = flags >> 6
        kind: FixKind = (
            "rtk" if carrier == 2 else "float" if carrier == 1 else "differential" if flags & 2 else "single"
        )
        place = Geodetic(latitude * 1e-7, longitude * 1e-7, height * 1e-3)
        return Fix(t_ns, place, kind, sigma_mm * 1e-3, sigma_up_mm * 1e-3)


def _checksum(body: bytes | bytearray) -> bytes:
    """Return Fletcher's two sums of class, id, length and payload."""
    values = np.frombuffer(bytes(body), dtype=np.uint8).astype(np.int64)
    return bytes((int(values.sum()) & 0xFF, int(values @ np.arange(len(values), 0, -1)) & 0xFF))
