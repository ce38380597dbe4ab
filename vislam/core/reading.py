"""Files that were given from outside, opened so that they cannot hurt.

What is no regular file is refused before anything is read of it: a FIFO or a terminal would block for ever, and a
device may have no end. All refusals are OSErrors with a `strerror`, as those of the system are.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from io import BufferedReader
from pathlib import Path
from typing import Any

_MAX_JSON_BYTES = 256 * 2**20  # metrics of the longest runs come to a tenth
_POINTER, _MAX_POINTER_BYTES = b"version https://git-lfs.github.com/spec/", 1024
_MAX_TEXT_BYTES = 16 * 2**20  # settings, plans, calibrations


def open_file(path: Path) -> BufferedReader:
    """Return a regular file, open for reading bytes. Raises OSError."""
    # without O_NONBLOCK the call itself would wait for a writer of a FIFO
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        found = os.fstat(descriptor)
        _check_mode(found.st_mode, path)
        if found.st_size <= _MAX_POINTER_BYTES and os.pread(descriptor, len(_POINTER), 0) == _POINTER:
            raise OSError(
                errno.EINVAL, "a Git LFS pointer, not the file that it stands for; run git lfs pull", str(path)
            )
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_file(path: Path) -> None:
    """Raise OSError unless a path is that of a regular file; for files that a library opens by their names."""
    open_file(path).close()


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """Return what is in a regular file. Raises OSError, also for a larger file."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(min(size, most_bytes) + 1)  # takes as much memory as it is asked for
    if max(size, len(data)) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than the {most_bytes / 2**20:.0f} MiB that are read", str(path))
    return data


def read_text(path: Path, most_bytes: int = _MAX_TEXT_BYTES) -> str:
    """Return the text in a regular file; raises OSError, and ValueError for what is not UTF-8."""
    return read_bytes(path, most_bytes).decode("utf-8")


def read_json(path: Path, most_bytes: int = _MAX_JSON_BYTES) -> Any:
    """Return the data in a JSON file; raises OSError, and ValueError for what is no JSON or too deep."""
    return parse_json(read_text(path, most_bytes))


def parse_json(text: str) -> Any:
    """Return the data in JSON; raises ValueError for what is none or too deep."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("JSON nested too deep") from error


def _check_mode(mode: int, path: Path) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "a FIFO, a device or a socket, not a file; copy its contents to one", str(path))
