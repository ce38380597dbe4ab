"""GPMF, GoPro's metadata: keys, types, sizes and values, big-endian, in multiples of four bytes.

After the description that GoPro publishes with gpmf-parser. A payload is a tree of devices (DEVC) and streams (STRM);
in a stream, everything before its last value describes that one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

_TYPES = {
    "b": "i1", "B": "u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8", "J": ">u8",
    "f": ">f4", "d": ">f8", "q": ">i4", "Q": ">i8",
}  # fmt: skip
_FIXED_POINT = {"q": 2.0**16, "Q": 2.0**32}
_NEST = "\0"
_MOST_DEPTH = 8
_MOST_TYPES = 255  # a sample has no more bytes


@dataclass(frozen=True, slots=True)
class Value:
    """One key with what it holds: `count` samples of `size` bytes of a type."""

    key: str
    type: str
    size: int
    count: int
    data: memoryview


@dataclass(slots=True)
class Stream:
    """One stream of a payload: its values by key; the last one is what was measured."""

    device: str
    values: dict[str, Value] = field(default_factory=dict)

    def text(self, key: str) -> str:
        """Return the text of a key, empty where there is none."""
        value = self.values.get(key)
        if value is None or value.type not in "cFU":
            return ""
        return bytes(value.data).decode("latin-1").rstrip("\0 ")

    def number(self, key: str) -> int | None:
        """Return the first number of a key as a whole number, None where there is none."""
        value = self.values.get(key)
        if value is None or value.type not in "bBsSlLjJ":
            return None
        numbers = np.frombuffer(value.data, _TYPES[value.type], min(1, len(value.data) // _width(value.type)))
        return int(numbers[0]) if len(numbers) else None

    def count(self, key: str) -> int:
        """Return how many samples a key has."""
        return self.values[key].count if key in self.values else 0

    def samples(self, key: str) -> Numbers:
        """Return the samples [N, C] of a key, divided by their scale; raises ValueError where they cannot be read."""
        value = self.values[key]
        raw = _decoded(value, self.text("TYPE"))
        scale = self.values.get("SCAL")
        if scale is None:
            return raw
        divisors = _decoded(scale, "").ravel()
        if len(divisors) not in (1, raw.shape[1]) or not (np.isfinite(divisors).all() and divisors.all()):
            raise ValueError(f"a scale of {len(divisors)} numbers, or zero, for {key} of {raw.shape[1]}")
        return raw / divisors


def read_streams(payload: bytes) -> tuple[list[Stream], bool]:
    """Return the streams of a payload, and whether all of it could be read; what comes before damage is kept."""
    streams: list[Stream] = []
    whole = _walk(memoryview(payload), "", streams, None, _MOST_DEPTH)
    return streams, whole


def _walk(body: memoryview, device: str, streams: list[Stream], stream: Stream | None, depth: int) -> bool:
    """Collect the streams in a body; `stream` is the one that it belongs to, if any."""
    at, whole = 0, depth > 0
    while whole and len(body) - at >= 8:
        key = bytes(body[at : at + 4])
        if key == b"\0\0\0\0":
            break  # what was kept free at the end
        kind, size, count = chr(body[at + 4]), body[at + 5], int.from_bytes(body[at + 6 : at + 8], "big")
        length = size * count
        data = body[at + 8 : at + 8 + length]
        if not key.isascii() or (len(data) < length and kind != _NEST):
            return False
        at += 8 + (length + 3) // 4 * 4
        value = Value(key.decode("ascii"), kind, size, count, data)
        if kind == _NEST and value.key == "STRM":
            streams.append(Stream(device))
            whole = _walk(data, device, streams, streams[-1], depth - 1) and len(data) == length
        elif kind == _NEST and stream is None:
            whole = _walk(data, device, streams, None, depth - 1) and len(data) == length
        elif value.key == "DVNM":
            device = bytes(data).decode("latin-1").rstrip("\0 ")
        elif stream is not None and kind != _NEST:
            stream.values[value.key] = value
    return whole


def _width(kind: str) -> int:
    return np.dtype(_TYPES[kind]).itemsize


def _decoded(value: Value, complex_type: str) -> Numbers:
    """Return samples [N, C]; `complex_type` are the types of a sample whose own is "?"."""
    if value.type == "?":
        kinds = list(_spelled(complex_type))
    elif value.type in _TYPES and value.size % _width(value.type) == 0:
        kinds = [value.type] * (value.size // _width(value.type))
    else:
        raise ValueError(f"{value.key} of type {value.type!r}")
    row = np.dtype([(str(i), _TYPES[kind]) for i, kind in enumerate(kinds)])
    if not kinds or row.itemsize != value.size:
        raise ValueError(f"{value.key}: samples of {value.size} bytes, its types have {row.itemsize}")
    rows = np.frombuffer(value.data, row, value.count)
    columns = [rows[str(i)].astype(np.float64) / _FIXED_POINT.get(kind, 1.0) for i, kind in enumerate(kinds)]
    return np.stack(columns, axis=1)


def _spelled(text: str) -> Iterator[str]:
    """Yield the types in a text such as "fs[2]L"; raises ValueError for what is none."""
    at, spelled = 0, 0
    while at < len(text):
        kind, at, times = text[at], at + 1, 1
        if kind not in _TYPES:
            raise ValueError(f"type {kind!r}")
        if at < len(text) and text[at] == "[":
            end = text.find("]", at)
            if end < 0 or not text[at + 1 : end].isdecimal() or end - at > 4:
                raise ValueError(f"types {text!r}")
            times, at = int(text[at + 1 : end]), end + 1
        spelled += times
        if spelled > _MOST_TYPES:
            raise ValueError(f"types {text!r}")
        yield from [kind] * times
