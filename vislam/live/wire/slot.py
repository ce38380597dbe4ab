"""A place in shared memory that holds the newest value of one writer, for any number of readers.

A sequence counter before and after the value (a seqlock) shows a reader that the writer came in between; a checksum
shows the same on processors that reorder writes. The file in /dev/shm is what `shm_open` opens in C. It belongs to the
user who runs the writer: no other can read it but the members of a group that is named, and no other's is read but that
of an owner who is named.
"""

import errno
import mmap
import os
import pwd
import secrets
import shutil
import stat
import struct
import time
import zlib
from contextlib import suppress
from pathlib import Path

from vislam.core.errors import DataError, StorageError, UsageError

_HEAD = struct.Struct("<QII")  # sequence, length of the value, its CRC-32
_TAIL = struct.Struct("<Q")  # sequence again
_TRIES = 8  # a reader that met the writer so often in a row meets one that is stuck half way
_FOLDER = Path("/dev/shm")


class SlotWriter:
    """Owns the memory: makes it, replaces what a killed process left there, and removes it when closed."""

    def __init__(self, name: str, capacity: int, group: str | None = None) -> None:
        """Make `/dev/shm/NAME` for values of at most `capacity` bytes, to be read by the members of `group`, too.

        Raises StorageError when it cannot be made, UsageError when there is no such group.
        """
        self._path = _FOLDER / name
        self._capacity = capacity
        self._sequence = 0
        fresh = self._path.with_name(f".{name}.{os.getpid()}.{secrets.token_hex(4)}")
        try:
            descriptor = os.open(fresh, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o600)
            try:
                # not ftruncate, which promises pages that a full /dev/shm lacks: writing there would kill the process
                os.posix_fallocate(descriptor, 0, _HEAD.size + capacity + _TAIL.size)
                self._memory = mmap.mmap(descriptor, _HEAD.size + capacity + _TAIL.size)
                give_to_group(descriptor, group, 0o640)
            finally:
                os.close(descriptor)
            fresh.rename(self._path)  # readers of an older one keep it, and see that it gets no newer
        except (OSError, UsageError) as error:
            fresh.unlink(missing_ok=True)
            if isinstance(error, UsageError):
                raise
            is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            step = f"{_FOLDER} is full: remove what is left there" if is_full else "choose another --live.name"
            raise StorageError(f"shared memory {self._path} cannot be made: {error.strerror}; {step}") from error
        self._inode = self._path.stat().st_ino

    def write(self, value: bytes | memoryview) -> None:
        """Replace the value. Raises ValueError when it is longer than the capacity."""
        if len(value) > self._capacity:
            raise ValueError(f"{len(value)} bytes do not fit into a slot of {self._capacity}")
        self._sequence += 1
        memory = self._memory
        # not pack_into, which clears first: a reader would meet length 0 and CRC 0, a sound value of no bytes
        memory[_HEAD.size + self._capacity :] = _TAIL.pack(self._sequence)
        memory[_HEAD.size : _HEAD.size + len(value)] = bytes(value)
        memory[: _HEAD.size] = _HEAD.pack(self._sequence, len(value), zlib.crc32(value))

    def close(self) -> None:
        """Remove the memory, unless another writer has taken its name; may be called twice."""
        with suppress(OSError):  # it was removed, or is another user's
            if self._path.lstat().st_ino == self._inode:
                self._path.unlink()
        self._memory.close()


class SlotReader:
    """Reads what a `SlotWriter` of another process wrote last."""

    def __init__(self, name: str, owner: str | None = None) -> None:
        """Open `/dev/shm/NAME`; `owner` is a user who may have written it, besides this one and root.

        Raises DataError when it does not exist, is another user's, or others may write to it.
        """
        path, trusted = _FOLDER / name, {os.geteuid(), 0} | ({user_of(owner)} if owner else set())
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
            try:
                found = os.fstat(descriptor)
                if found.st_uid not in trusted:
                    who = f"that of user {found.st_uid}; if that is who runs `vislam live`, name this owner"
                    raise DataError(f"shared memory {path} is {who}")
                if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                    raise DataError(f"shared memory {path} is open to others, who may write anything into it")
                self._memory = mmap.mmap(descriptor, 0, prot=mmap.PROT_READ)
            finally:
                os.close(descriptor)
        except PermissionError as error:
            raise DataError(f"shared memory {path} is another user's, who may let groups read: --live.group") from error
        except (OSError, ValueError) as error:
            raise DataError(f"there is no shared memory {path}: {error}; is `vislam live` running?") from error
        self._tail = len(self._memory) - _TAIL.size
        self._path, self._found = path, found

    @property
    def is_replaced(self) -> bool:
        """Whether another writer has the name now; this memory gets no more values then."""
        try:
            return not os.path.samestat(self._path.stat(), self._found)
        except OSError:
            return False

    @property
    def sequence(self) -> int:
        """Number of the newest value, 0 before the first; costs nothing."""
        return int(_HEAD.unpack_from(self._memory, 0)[0])

    def read(self) -> tuple[int, bytes] | None:
        """Return the sequence number, from 1, and the newest value.

        None before the first value, or when the writer was met in the middle of its work every time.
        """
        for _ in range(_TRIES):
            sequence, length, checksum = _HEAD.unpack_from(self._memory, 0)
            if sequence == 0:
                return None
            if length > self._tail - _HEAD.size:
                continue
            value = self._memory[_HEAD.size : _HEAD.size + length]
            after = _TAIL.unpack_from(self._memory, self._tail)[0]
            if after == sequence and zlib.crc32(value) == checksum:
                return sequence, value
        return None

    def close(self) -> None:
        """Let go of the memory; may be called twice."""
        self._memory.close()


def give_to_group(file: int | Path, group: str | None, mode: int) -> None:
    """Let the members of a group do with a file what `mode` has; raises UsageError where there is none such."""
    if group is not None:
        try:
            shutil.chown(file, group=group)
        except (LookupError, PermissionError) as error:
            raise UsageError(f"group {group}: {error}; give one that this user is in (`id -Gn`)") from error
        os.chmod(file, mode)


def user_of(name: str) -> int:
    """Return the number of a user; raises UsageError where there is none such."""
    try:
        return pwd.getpwnam(name).pw_uid
    except KeyError as error:
        raise UsageError(f"there is no user {name}; give the one who runs `vislam live`") from error


def remove(name: str) -> None:
    """Remove a slot whose writer was killed, if there is one."""
    (_FOLDER / name).unlink(missing_ok=True)


def wait_for(name: str, timeout_s: float = 60.0) -> SlotReader:
    """Open a slot that another process is about to make. Raises DataError when it does not."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            return SlotReader(name)
        except DataError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)
