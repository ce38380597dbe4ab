"""Files of rosbag 1 (format 2.0), read front to back.

The index at the end of such a file repeats what its chunks state, so it is not read: a bag without one, cut
off or never closed, is read in the same way as a whole one, and no number in an index can mislead.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator

from vislam.core.errors import DataError
from vislam.core.reading import Budget
from vislam.core.recording import Problems
from vislam.datasets.bags.chunks import Bytes, ChunkedFile, FileBytes
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

MAGIC = b"#ROSBAG V2.0\n"
_CHUNK, _CONNECTION, _MESSAGE = 5, 7, 2
_KNOWN = frozenset((2, 3, 4, 5, 6, 7))
_MOST_HEADER_BYTES = 2**16
_MOST_DEFINITION_BYTES = 2**22
_MARK = b"\x04\x00\x00\x00op=\x05"  # in the header of every chunk
_BLOCK_BYTES = 2**16
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")
Fields = dict[bytes, bytes]


class Rosbag1(ChunkedFile):
    """One file of rosbag 1."""

    def scan(self, problems: Problems) -> Iterator[Found]:
        """Yield the messages in the order in which they were stored; raises DataError when it is no rosbag."""
        if self._bytes.read(0, len(MAGIC)) != MAGIC:
            raise DataError(f"{self._path} is no rosbag of format 2.0; `rosbag migrate` converts older ones")
        topics: dict[int, Topic] = {}
        budget = Budget(self._path, self._bytes.size)
        at = len(MAGIC)
        while at < self._bytes.size:
            budget.take()
            try:
                fields, data_at, length = _record(self._bytes, at)
                if _op(fields) not in _KNOWN:
                    raise DamagedError("record of an unknown kind")
                if _op(fields) == _CHUNK:
                    yield from self._chunk(at, fields, (data_at, length), topics, budget, problems)
                else:
                    yield from _one(self._bytes, fields, (data_at, length), (self._file, -1), topics)
                if data_at + length > self._bytes.size:
                    problems.count(f"{self._path.name}: cut off", f"byte {self._bytes.size}")
                at = data_at + length
            except DamagedError as error:
                problems.count(f"{self._path.name}: {error}", f"byte {at}")
                at = self._next_chunk(at + 1)

    def _chunk(
        self,
        at: int,
        fields: Fields,
        data: tuple[int, int],
        topics: dict[int, Topic],
        budget: Budget,
        problems: Problems,
    ) -> Iterator[Found]:
        if fields.get(b"compression") == b"none":
            end = min(sum(data), self._bytes.size)
            yield from _walk(self._bytes, data[0], end, (self._file, -1), topics, budget)
            return
        unpacked, whole = self._chunk_at(at)
        budget.take(0, len(unpacked))
        yield from _walk(Bytes(unpacked), 0, len(unpacked), (self._file, at), topics, budget)
        if not whole:
            problems.count(f"{self._path.name}: chunk that cannot be unpacked to its end", f"byte {at}")

    def _unpack(self, at: int) -> tuple[bytes, bool]:
        reader = Bytes(self._bytes.fetch(at, _MOST_HEADER_BYTES))
        fields, data_at, length = _record(reader, 0)
        method = fields.get(b"compression", b"").decode("ascii", "replace")
        return self._unpacked(at + data_at, length, method, _number(fields, b"size"))

    def _next_chunk(self, at: int) -> int:
        """Return where the next chunk begins; the file's end when there is none."""
        while at < self._bytes.size:
            block = self._bytes.fetch(at, _BLOCK_BYTES)
            for match in re.finditer(re.escape(_MARK), block):
                head = block[max(0, match.start() - 100) : match.start()]
                for zeros in re.finditer(rb"(?<=.)(?=\0\0\0)", head, re.DOTALL):
                    back = len(head) - zeros.start() + 1  # its header begins with its own length, the mark is within
                    if head[-back] >= back + 4 and self._is_chunk(at + match.start() - back):
                        return at + match.start() - back
            at += len(block) - 200 if len(block) == _BLOCK_BYTES else len(block)
        return self._bytes.size

    def _is_chunk(self, at: int) -> bool:
        try:
            fields, _, _ = _record(self._bytes, at)
            return _op(fields) == _CHUNK and {b"compression", b"size"} <= set(fields)
        except DamagedError:
            return False


def _walk(
    reader: Bytes | FileBytes, at: int, end: int, origin: tuple[int, int], topics: dict[int, Topic], budget: Budget
) -> Iterator[Found]:
    """Yield the messages in an unpacked chunk; raises DamagedError, and DataError where its records are too many."""
    while at < end:
        budget.take()
        fields, data_at, length = _record(reader, at)
        if data_at + length > end:
            raise DamagedError("message cut short")
        yield from _one(reader, fields, (data_at, length), origin, topics)
        at = data_at + length


def _one(
    reader: Bytes | FileBytes,
    fields: Fields,
    data: tuple[int, int],
    origin: tuple[int, int],
    topics: dict[int, Topic],
) -> Iterator[Found]:
    op, (at, length) = _op(fields), data
    if op == _MESSAGE:
        topic = topics.get(_number(fields, b"conn"))
        if topic is None:
            raise DamagedError("message on a connection that was never announced")
        if length > MOST_MESSAGE_BYTES:
            raise DamagedError(f"message of {length} bytes")
        if at + length > reader.size:
            raise DamagedError("message cut short")
        if len(time := fields.get(b"time", b"")) != 8:
            raise DamagedError("message without a time")
        seconds, rest_ns = _TIME.unpack(time)
        head = reader.read(at, min(length, HEAD_BYTES))
        yield Found(topic, seconds * 10**9 + rest_ns, Place(*origin, at, length), head)
    elif op == _CONNECTION:
        if length > _MOST_DEFINITION_BYTES or len(topics) >= MOST_TOPICS:
            raise DamagedError("connection that is larger than any, or one too many")
        about = _fields(reader.read(at, length))
        name = fields.get(b"topic", b"").decode("utf-8", "replace")
        type_ = message_type(about.get(b"type", b"").decode("utf-8", "replace"))
        digest = about.get(b"md5sum", b"").decode("ascii", "replace")
        topics.setdefault(_number(fields, b"conn"), Topic(name, type_, "ros1", digest))


def _record(reader: Bytes | FileBytes, at: int) -> tuple[Fields, int, int]:
    """Return the fields of a record's header, where its data begin and how long they are; raises DamagedError."""
    length = _u32(reader.read(at, 4))
    if length > _MOST_HEADER_BYTES:
        raise DamagedError("record whose header is larger than any")
    header = reader.read(at + 4, length)
    if len(header) != length:
        raise DamagedError("record cut short")
    fields = _fields(header)
    if b"op" not in fields:
        raise DamagedError("record that does not state its kind")
    return fields, at + length + 8, _u32(reader.read(at + 4 + length, 4))


def _fields(data: bytes) -> Fields:
    fields, at = {}, 0
    while at < len(data):
        length = _u32(data[at : at + 4])
        field = data[at + 4 : at + 4 + length]
        name, equals, value = field.partition(b"=")
        if len(field) != length or not equals:
            raise DamagedError("record with a header that cannot be read")
        fields[name] = value
        at += 4 + length
    return fields


def _op(fields: Fields) -> int:
    return fields[b"op"][0] if len(fields.get(b"op", b"")) == 1 else -1


def _number(fields: Fields, name: bytes) -> int:
    return _u32(fields.get(name, b""))


def _u32(data: bytes) -> int:
    if len(data) != 4:
        raise DamagedError("record cut short")
    return int(_U32.unpack(data)[0])
