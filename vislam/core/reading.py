"""Files that were given from outside, opened so that they cannot hurt.

What is no regular file is refused before anything is read of it: a FIFO or a terminal would block for ever, and a
device may have no end. All refusals are OSErrors with a `strerror`, as those of the system are.

What is parsed here has one budget: what a text asks for is bounded by its length before anything of it is built.
"""

import errno
import json
import os
import stat
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

from vislam.core.errors import DataError

_MAX_JSON_BYTES = 256 * 2**20  # metrics of the longest runs come to a tenth
_POINTER, _MAX_POINTER_BYTES = b"version https://git-lfs.github.com/spec/", 1024
_MAX_TEXT_BYTES = 16 * 2**20  # settings, plans, calibrations
MAX_YAML_BYTES = MAX_TOML_BYTES = 2**18  # written by hand, or by a calibration; a second's work at most
MAX_PIXELS = 2**25  # of an image: 8K video; whatever else a camera, a header or a message states is refused
_FREE_NODES = 10_000  # of YAML, beside one for each byte: what aliases and merge keys may add
_MAX_DOTS = 100  # in a line of TOML: work and memory go with the square of a dotted key's parts
_MAX_DEPTH = 64  # of tables within tables
_MAX_DIGITS = 1000  # of a number of YAML: work goes with the square of those of 1:1:1..., which is one to base 60


class Budget:
    """What may come out of one file, by its size: a dark camera's packed images may be a gigabyte, a bomb is more."""

    def __init__(self, path: Path, size_bytes: int) -> None:
        """Begin with all that a file of `size_bytes` justifies."""
        self._path = path
        self._records, self._bytes = 200_000 + size_bytes // 16, 2**30 + 100 * size_bytes

    def take(self, records: int = 1, unpacked_bytes: int = 0) -> None:
        """Count what was met, however often; raises DataError beyond what is justified."""
        self._records -= records
        self._bytes -= unpacked_bytes
        if self._records < 0 or self._bytes < 0:
            what = "records" if self._records < 0 else "unpacked bytes"
            raise DataError(f"{self._path} asks for far more {what} than its size justifies; convert it again")


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


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn a refusal of the system to read a file into DataError."""
    try:
        yield
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error


@contextmanager
def opened(path: Path) -> Iterator[BufferedReader]:
    """Open a regular file for reading bytes while the block lasts; what the system refuses in it is a DataError."""
    with readable(path), open_file(path) as file:
        yield file


def check_file(path: Path) -> None:
    """Raise OSError unless a path is that of a regular file; for files that a library opens by their names."""
    open_file(path).close()


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """Return what is in a regular file. Raises OSError, also for a larger file."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(min(size, most_bytes) + 1)  # takes as much memory as it is asked for
    if max(size, len(data)) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than the {most_bytes / 2**20:.3g} MiB that are read", str(path))
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


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables in TOML; raises ValueError for what is none, too large or too deep."""
    if len(text) > MAX_TOML_BYTES:
        raise ValueError(f"more than the {MAX_TOML_BYTES} characters that are read of TOML")
    for number, line in enumerate(text.split("\n"), 1):  # keys end with their line
        if line.count(".") > _MAX_DOTS:
            raise ValueError(f"line {number} has more than {_MAX_DOTS} dots: dotted keys, or numbers to be wrapped")
    try:
        data = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("TOML nested too deep") from error
    _check_depth(data)
    return data


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables in a TOML file; raises OSError, and ValueError as `parse_toml`."""
    return parse_toml(read_text(path, MAX_TOML_BYTES))


def parse_yaml(text: str) -> Any:
    """Return the data in YAML; raises ValueError for what is none, too deep, or more than its length justifies."""
    import yaml  # late: most never read any

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's is five times as fast
    try:
        _check_yaml(yaml.parse(text, loader), len(text) + _FREE_NODES)
        return yaml.load(text, loader)  # noqa: S506 (a safe one, either of the two)
    except (yaml.YAMLError, ArithmeticError, LookupError, AttributeError, TypeError, RecursionError) as error:
        # besides its own errors PyYAML raises what comes of `!!int ""`, `!!bool x` or `!!timestamp x`
        raise ValueError(" ".join(str(error).split())[:200]) from error


def _check_yaml(events: Iterable[Any], most_nodes: int) -> None:
    """Raise ValueError for YAML that is deep, or has more nodes than `most_nodes` once its aliases are spelt out."""
    sizes: dict[str, int] = {}  # of what has an anchor, once it is complete
    open_nodes: list[tuple[str, int]] = [("", 0)]
    for event in events:
        kind, anchor = type(event).__name__, str(getattr(event, "anchor", None) or "")
        if kind in ("SequenceStartEvent", "MappingStartEvent"):
            sizes.pop(anchor, None)
            open_nodes.append((anchor, 1))
            if len(open_nodes) > _MAX_DEPTH:
                raise ValueError(f"nested deeper than {_MAX_DEPTH}")  # libyaml's composer would exhaust the stack
            continue
        if kind in ("SequenceEndEvent", "MappingEndEvent"):
            anchor, size = open_nodes.pop()
        elif kind == "AliasEvent":
            if anchor not in sizes:
                raise ValueError(f"alias *{anchor[:40]} within what it stands for, or of nothing")
            size = sizes[anchor]
        elif kind == "ScalarEvent":
            size = 1
            if len(event.value) > _MAX_DIGITS and event.value.lstrip("+-. ")[:1].isdigit():
                raise ValueError(f"a number of more than {_MAX_DIGITS} digits")
        else:
            continue
        if anchor:
            sizes[anchor] = size
        outer, so_far = open_nodes[-1]
        open_nodes[-1] = (outer, so_far + size)
        if so_far + size > most_nodes:
            raise ValueError("aliases or merge keys that ask for far more than any such file holds")


def _check_depth(data: Any) -> None:
    """Raise ValueError for tables or lists deeper than any settings."""
    level = [data]
    for _ in range(_MAX_DEPTH):
        parts = [part.values() if isinstance(part, dict) else part for part in level if isinstance(part, dict | list)]
        level = [part for group in parts for part in group]
        if not level:
            return
    raise ValueError(f"tables nested deeper than {_MAX_DEPTH}")


def _check_mode(mode: int, path: Path) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "a FIFO, a device or a socket, not a file; copy its contents to one", str(path))
