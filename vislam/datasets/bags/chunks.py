"""Bytes of a bag's file: read by place, unpacked within bounds whatever a file declares, kept while they are hot."""

from __future__ import annotations

import abc
import bz2
import importlib
import os
import sys
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

from vislam.core.reading import open_file
from vislam.datasets.bags.stored import DamagedError, Place

MOST_CHUNK_BYTES = 2**27  # unpacked; recorders make chunks of 1 to 16 MiB, and of one image where that is more
_FREE_CHUNK_BYTES, _MOST_RATIO = 2**25, 1000  # unpacked: a dark image of 8K, or what any other packs to
_KEPT_BYTES = 2**25  # of unpacked chunks beside the newest: images and samples of one stretch unpack it once
_WINDOW_BYTES = 2**14
_PIECE_BYTES = 2**14


class Bytes:
    """A stretch of bytes in memory, read by place as those of a file are."""

    def __init__(self, data: bytes) -> None:
        """Take the bytes."""
        self.data = data
        self.size = len(data)

    def read(self, at: int, length: int) -> bytes:
        """Return up to `length` bytes from `at`."""
        return self.data[at : at + length]


class FileBytes:
    """The bytes of a regular file; short reads that follow each other cost one call of the system in many."""

    def __init__(self, path: Path) -> None:
        """Open a file. Raises OSError."""
        self._file = open_file(path)
        self.size = os.fstat(self._file.fileno()).st_size
        self._begin, self._window = 0, b""

    def read(self, at: int, length: int) -> bytes:
        """Return up to `length` bytes from `at`, through a small window; for one thread. Raises OSError."""
        begin = at - self._begin
        if not (begin >= 0 and begin + length <= len(self._window)):
            if length > _WINDOW_BYTES // 2:
                return self.fetch(at, length)
            self._begin, self._window, begin = at, self.fetch(at, _WINDOW_BYTES), 0
        return self._window[begin : begin + length]

    def fetch(self, at: int, length: int) -> bytes:
        """Return up to `length` bytes from `at`; for any thread. Raises OSError."""
        if at >= self.size or length <= 0:
            return b""
        return os.pread(self._file.fileno(), min(length, self.size - at), at)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class ChunkedFile(abc.ABC):
    """A bag of chunks; the latest ones are kept unpacked, and several threads may read at once."""

    def __init__(self, path: Path, file: int) -> None:
        """Open it; `file` is its number in the bag. Raises OSError."""
        self._path, self._file = path, file
        self._bytes = FileBytes(path)
        self._kept: OrderedDict[int, tuple[bytes, bool]] = OrderedDict()
        self._lock = threading.Lock()

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()

    def read(self, place: Place) -> bytes:
        """Return the bytes of a message, which lies open in the file or in one of its chunks; raises DamagedError."""
        if place.chunk < 0:
            data = self._bytes.fetch(place.at, place.length)
        else:
            data = self._chunk_at(place.chunk)[0][place.at : place.at + place.length]
        if len(data) != place.length:
            raise DamagedError("message cut short")
        return data

    @abc.abstractmethod
    def _unpack(self, at: int) -> tuple[bytes, bool]:
        """Return the bytes in the chunk at a place, and whether they are all there; raises DamagedError."""

    def _chunk_at(self, at: int) -> tuple[bytes, bool]:
        with self._lock:
            if at in self._kept:
                self._kept.move_to_end(at)
                return self._kept[at]
            while sum(len(kept) for kept, _ in self._kept.values()) > _KEPT_BYTES:
                self._kept.popitem(last=False)  # before the next is unpacked: both may be large
            data = self._kept[at] = self._unpack(at)
            return data

    def _unpacked(self, at: int, length: int, method: str, declared: int) -> tuple[bytes, bool]:
        if length > MOST_CHUNK_BYTES:
            raise DamagedError(f"packed chunk of {length} bytes")
        data = self._bytes.fetch(at, length)
        out, whole = unpacked(data, method, declared)
        return out, whole and len(data) == length


def unpacked(data: bytes, method: str, declared: int) -> tuple[bytes, bool]:
    """Return what is packed in data, at most what its container declares, and whether it is all there.

    Damage in the middle leaves what came before it. Raises DamagedError for a method that is unknown and for a chunk
    that is larger than any recorder's, declared or not.
    """
    if declared > (most := min(MOST_CHUNK_BYTES, _FREE_CHUNK_BYTES + _MOST_RATIO * len(data))):
        raise DamagedError(f"chunk of {declared} bytes, more than the {most} that are unpacked of its size")
    try:
        out = _decompressor(method).decompress(data, declared + 1)
    except _errors(method):
        return _in_pieces(data, method, declared), False
    if len(out) > declared:
        raise DamagedError("chunk that unpacks to more than it states")
    return out, len(out) == declared


def unpacked_message(data: bytes, most_bytes: int, head_bytes: int | None = None) -> bytes:
    """Return a message that a recorder packed by zstd for itself, or its first bytes; raises DamagedError."""
    try:
        out: bytes = _decompressor("zstd").decompress(data, head_bytes or most_bytes + 1)
    except _errors("zstd") as error:
        raise DamagedError(f"message that cannot be unpacked: {error}") from error
    if len(out) > most_bytes:
        raise DamagedError("message that unpacks to far more than its size or its camera justifies")
    return out


def _in_pieces(data: bytes, method: str, declared: int) -> bytes:
    out, decompressor = bytearray(), _decompressor(method)
    try:
        for begin in range(0, len(data), _PIECE_BYTES):
            piece = data[begin : begin + _PIECE_BYTES]
            while len(out) < declared:
                fresh = decompressor.decompress(piece, declared - len(out))
                out += fresh
                piece = b""
                if not fresh or decompressor.eof or decompressor.needs_input:
                    break
            if decompressor.eof or len(out) >= declared:
                break
    except _errors(method):
        pass
    return bytes(out)


def _decompressor(method: str) -> Any:
    if method == "bz2":
        return bz2.BZ2Decompressor()
    if method == "lz4":
        return importlib.import_module("lz4.frame").LZ4FrameDecompressor()
    if method == "zstd":
        return _zstd().ZstdDecompressor()
    raise DamagedError(f"chunk packed by '{method[:20]}', which is unknown")


def _errors(method: str) -> tuple[type[Exception], ...]:
    usual = (OSError, RuntimeError, EOFError, ValueError, MemoryError)
    return (*usual, _zstd().ZstdError) if method == "zstd" else usual


def _zstd() -> Any:
    return importlib.import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
