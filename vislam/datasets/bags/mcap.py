"""MCAP files, read front to back: as with rosbag 1 the index is not asked, so a file without one is read alike.

Only behind damage the index shows where to go on, if it is there and right.
"""

from __future__ import annotations

import re
import struct
from bisect import bisect_left
from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

from vislam.core.errors import DataError
from vislam.core.reading import Budget
from vislam.core.recording import Problems
from vislam.datasets.bags import foxglove
from vislam.datasets.bags.chunks import MOST_CHUNK_BYTES, Bytes, ChunkedFile, FileBytes
from vislam.datasets.bags.stored import (
    HEAD_BYTES,
    MOST_MESSAGE_BYTES,
    MOST_TOPICS,
    DamagedError,
    Found,
    Place,
    Topic,
    message_type,
)

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _DATA_END = 2, 3, 4, 5, 6, 8, 15
_FOOTER_BYTES = 37  # with the mark at the file's end
_MOST_INDEXED = 1_000_000
_MOST_RECORD_BYTES = 2**22  # of a schema or channel
_RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_METHODS = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")  # in the head of a packed chunk
_BLOCK_BYTES = 2**16
_MOST_HEAD_BYTES = _CHUNK_HEAD.size + 32 + 8


class _Schema(NamedTuple):
    """What a schema states of the messages on its channels."""

    name: str
    refused: str = ""


class _Known(NamedTuple):
    """What was announced so far, and what may still come."""

    schemas: dict[int, _Schema]
    topics: dict[int, Topic]
    budget: Budget


class _Chunk(NamedTuple):
    """The head of a chunk."""

    method: str
    at: int  # of its records, packed or not
    length: int
    unpacked_length: int


class Mcap(ChunkedFile):
    """One MCAP file."""

    def scan(self, problems: Problems) -> Iterator[Found]:
        """Yield the messages in the order in which they were stored; raises DataError when it is no MCAP file."""
        if self._bytes.read(0, len(MAGIC)) != MAGIC:
            raise DataError(f"{self._path} is no MCAP file: it does not begin as one")
        known = _Known({}, {}, Budget(self._path, self._bytes.size))
        at = len(MAGIC)
        while at < self._bytes.size:
            known.budget.take()
            try:
                op, data_at, length = _record(self._bytes, at)
                if op in (_DATA_END, _FOOTER):
                    return
                if op == _CHUNK:
                    yield from self._chunk(data_at, length, known, problems)
                else:
                    yield from _one(self._bytes, op, (data_at, length), (self._file, -1), known)
                if data_at + length > self._bytes.size:
                    raise DamagedError("cut off")
                at = data_at + length
            except DamagedError as error:
                problems.count(f"{self._path.name}: {error}", f"byte {at}")
                at = self._next_chunk(at + 1)
        problems.count(f"{self._path.name}: not closed by its recorder")

    def _chunk(self, at: int, length: int, known: _Known, problems: Problems) -> Iterator[Found]:
        chunk = _chunk_head(self._bytes.read(at, _MOST_HEAD_BYTES), at)
        if chunk.length > length:
            raise DamagedError("chunk that is larger than its record")
        if not chunk.method:
            end = min(chunk.at + chunk.length, self._bytes.size)
            yield from _walk(self._bytes, chunk.at, end, (self._file, -1), known)
            return
        data, whole = self._chunk_at(at)
        known.budget.take(0, len(data))
        yield from _walk(Bytes(data), 0, len(data), (self._file, at), known)
        if not whole:
            problems.count(f"{self._path.name}: chunk that cannot be unpacked to its end", f"byte {at}")

    def _unpack(self, at: int) -> tuple[bytes, bool]:
        chunk = _chunk_head(self._bytes.fetch(at, _MOST_HEAD_BYTES), at)
        return self._unpacked(chunk.at, chunk.length, chunk.method, chunk.unpacked_length)

    def _next_chunk(self, at: int) -> int:
        """Return where the next chunk begins, by the index if there is one; the file's end when there is none.

        Without an index only packed chunks are found.
        """
        later = bisect_left(self._indexed, at)
        if later < len(self._indexed):
            return self._indexed[later]
        before = _RECORD.size + _CHUNK_HEAD.size - 4  # in front of the name of its method
        while at < self._bytes.size:
            block = self._bytes.fetch(at, _BLOCK_BYTES)
            for match in _METHODS.finditer(block):
                begin = at + match.start() - before
                if match.start() >= before and self._is_chunk(begin):
                    return begin
            at += len(block) - before - 8 if len(block) == _BLOCK_BYTES else len(block)
        return self._bytes.size

    @cached_property
    def _indexed(self) -> list[int]:
        """Where chunks begin by the index, rising: read once, however often the file is damaged."""
        return [begin for begin in sorted(set(self._indexed_chunks())) if self._is_chunk(begin)]

    def _indexed_chunks(self) -> Iterator[int]:
        """Yield where chunks begin by the index at the file's end, as far as it can be read."""
        footer = self._bytes.fetch(self._bytes.size - _FOOTER_BYTES, _FOOTER_BYTES)
        if len(footer) < _FOOTER_BYTES or footer[0] != _FOOTER:
            return
        at = int(_U64.unpack_from(footer, _RECORD.size)[0])
        for _ in range(_MOST_INDEXED):
            try:
                op, data_at, length = _record(self._bytes, at)
            except DamagedError:
                return
            if op == _FOOTER:
                return
            if op == _CHUNK_INDEX and len(place := self._bytes.read(data_at + 16, 8)) == 8:
                yield int(_U64.unpack(place)[0])
            at = data_at + length

    def _is_chunk(self, at: int) -> bool:
        try:
            op, data_at, length = _record(self._bytes, at)
            chunk = _chunk_head(self._bytes.read(data_at, _MOST_HEAD_BYTES), data_at)
        except DamagedError:
            return False
        known = chunk.method in ("", "zstd", "lz4")
        return op == _CHUNK and known and chunk.length <= length and chunk.unpacked_length <= MOST_CHUNK_BYTES


def _walk(reader: Bytes | FileBytes, at: int, end: int, origin: tuple[int, int], known: _Known) -> Iterator[Found]:
    """Yield the messages in an unpacked chunk; raises DamagedError, and DataError where its records are too many."""
    while at < end:
        known.budget.take()
        op, data_at, length = _record(reader, at)
        if data_at + length > end:
            raise DamagedError("message cut short")
        yield from _one(reader, op, (data_at, length), origin, known)
        at = data_at + length


def _one(
    reader: Bytes | FileBytes, op: int, data: tuple[int, int], origin: tuple[int, int], known: _Known
) -> Iterator[Found]:
    at, length = data
    if op == _MESSAGE:
        head = reader.read(at, min(length, _MESSAGE_HEAD.size + HEAD_BYTES))
        if len(head) < _MESSAGE_HEAD.size or at + length > reader.size:
            raise DamagedError("message cut short")
        if length > MOST_MESSAGE_BYTES:
            raise DamagedError(f"message of {length} bytes")
        channel, _sequence, log_ns, _publish_ns = _MESSAGE_HEAD.unpack_from(head)
        topic = known.topics.get(channel)
        if topic is None:
            raise DamagedError("message on a channel that was never announced")
        place = Place(*origin, at + _MESSAGE_HEAD.size, length - _MESSAGE_HEAD.size)
        yield Found(topic, log_ns, place, head[_MESSAGE_HEAD.size :])
    elif op in (_SCHEMA, _CHANNEL):
        if length > _MOST_RECORD_BYTES or len(known.schemas) + len(known.topics) >= 2 * MOST_TOPICS:
            raise DamagedError("schema or channel that is larger than any, or one too many")
        fields = _Fields(reader.read(at, length))
        number = fields.number(_U16)
        if op == _SCHEMA:
            name = fields.text()
            known.schemas.setdefault(number, _Schema(name, foxglove.why_refused(name, fields.text(), fields.data())))
        else:
            schema = known.schemas.get(fields.number(_U16), _Schema("without a schema"))
            known.topics.setdefault(number, _topic(fields.text(), schema, fields.text()))


def _topic(name: str, schema: _Schema, encoding: str) -> Topic:
    """Return a channel as a topic; one in a schema of Foxglove has the type of the ROS message that it stands for."""
    if encoding in (foxglove.PROTOBUF, foxglove.JSON) and schema.name in foxglove.ROS_TYPES:
        return Topic(name, foxglove.ROS_TYPES[schema.name], encoding, schema=schema.name, refused=schema.refused)
    return Topic(name, message_type(schema.name), encoding)


class _Fields:
    """Reads the fields of a record one after the other; raises DamagedError at its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def number(self, kind: struct.Struct) -> int:
        return int(kind.unpack(self._take(kind.size))[0])

    def text(self) -> str:
        return self.data().decode("utf-8", "replace")

    def data(self) -> bytes:
        return self._take(self.number(_U32))

    def _take(self, length: int) -> bytes:
        data = self._data[self._at : self._at + length]
        if len(data) != length:
            raise DamagedError("record cut short")
        self._at += length
        return data


def _record(reader: Bytes | FileBytes, at: int) -> tuple[int, int, int]:
    """Return the kind of a record, where its data begin and how long they are; raises DamagedError."""
    head = reader.read(at, _RECORD.size)
    if len(head) != _RECORD.size:
        raise DamagedError("record cut short")
    op, length = _RECORD.unpack(head)
    if op == 0 or length > 2**62:
        raise DamagedError("record of an impossible kind or length")
    return op, at + _RECORD.size, length


def _chunk_head(data: bytes, at: int) -> _Chunk:
    if len(data) < _CHUNK_HEAD.size + 8:
        raise DamagedError("chunk cut short")
    _, _, unpacked_length, _, name_length = _CHUNK_HEAD.unpack_from(data)
    name_end = _CHUNK_HEAD.size + name_length
    if name_end + 8 > len(data):
        raise DamagedError("chunk packed by a method of an impossible name")
    method = data[_CHUNK_HEAD.size : name_end].decode("utf-8", "replace")
    return _Chunk(method, at + name_end + 8, int(_U64.unpack_from(data, name_end)[0]), unpacked_length)
