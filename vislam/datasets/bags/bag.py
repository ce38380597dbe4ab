"""A bag: one file or a folder of several, as one run of messages by topic."""

from __future__ import annotations

import re
import weakref
from collections.abc import Iterator
from pathlib import Path

from vislam.core.encoded_image import most_pixels
from vislam.core.errors import DataError
from vislam.core.reading import Budget, open_file
from vislam.core.recording import Problems
from vislam.datasets.bags import mcap, rosbag1, sqlite
from vislam.datasets.bags.chunks import unpacked_message
from vislam.datasets.bags.stored import HEAD_BYTES, MOST_MESSAGE_BYTES, DamagedError, Found, Place
from vislam.datasets.calibration import load_yaml

SUFFIXES = (".bag", ".mcap", ".db3")
_ACTIVE = ".bag.active"  # of a recorder that was killed
_STORED = (".mcap", ".db3")
_PACKED = (".mcap.zstd", ".db3.zstd")
_ZSTD = b"\x28\xb5\x2f\xfd"
_MOST_FILES = 10_000
_PIXEL_BYTES, _AROUND_BYTES = 8, 2**16  # of an image message
_FREE_BYTES, _TIMES = 2**25, 100  # of another that was packed by itself, of which a first image may be one
Container = mcap.Mcap | rosbag1.Rosbag1 | sqlite.Database


class Bag:
    """The files of one bag, open for reading; `close` lets go of them."""

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            DataError: there is none, or a part of it is no file of its kind.
        """
        self.path = path
        self.files = bag_files(path)
        self._containers: list[Container] = []
        weakref.finalize(self, _close, self._containers)  # who reads rows may hold nothing but their iterator
        try:
            for number, file in enumerate(self.files):
                self._containers.append(_container(file, number))
            self._budget = Budget(path, self.size_bytes)  # of messages that are packed one by one
        except OSError as error:
            raise DataError(f"{error.filename or path} cannot be read: {error.strerror or error}") from error

    @property
    def size_bytes(self) -> int:
        """How large its files are."""
        return sum(file.stat().st_size for file in self.files)

    def scan(self, problems: Problems) -> Iterator[Found]:
        """Yield all messages in the order in which they were stored; damage is counted and passed over.

        Raises DataError when no file of it is what it should be.
        """
        refused: list[DataError] = []
        for container in self._containers:
            try:
                for found in container.scan(problems):
                    yield found if not _is_packed(found.head) else self._with_unpacked_head(found)
            except DataError as error:
                refused.append(error)
                problems.count(str(error))
            except OSError as error:
                problems.count(f"{self.path.name} cannot be read: {error.strerror or error}")
        if refused and len(refused) == len(self._containers):
            raise refused[0]

    def read(self, place: Place, size_px: tuple[int, int] | None = None) -> bytes:
        """Return the bytes of a message, which may be an image of `size_px`.

        Raises DamagedError, OSError when the disk fails, and DataError once packed ones ask for far too much.
        """
        data = self._containers[place.file].read(place)
        if not _is_packed(data):
            return data
        if size_px is not None:
            pixels = min(size_px[0] * size_px[1], most_pixels(len(data)))
            return unpacked_message(data, _PIXEL_BYTES * pixels + _AROUND_BYTES)
        out = unpacked_message(data, min(MOST_MESSAGE_BYTES, _FREE_BYTES + _TIMES * len(data)))
        self._budget.take(0, len(out))
        return out

    def _with_unpacked_head(self, found: Found) -> Found:
        try:
            packed = self._containers[found.place.file].read(found.place)
            return found._replace(head=unpacked_message(packed, HEAD_BYTES, HEAD_BYTES))
        except (DamagedError, OSError):
            return found._replace(head=b"")  # counted where it is decoded

    def close(self) -> None:
        """Close its files."""
        _close(self._containers)


def _close(containers: list[Container]) -> None:
    for container in containers:
        container.close()


def bag_files(path: Path) -> list[Path]:
    """Return the files of a bag in their order; raises DataError when there are none that can be read."""
    if path.is_file():
        return [path]
    there = [file for file in sorted(path.iterdir(), key=_by_number) if file.suffix.lower() in _STORED]
    if not there and any(file.name.endswith(_PACKED) for file in path.iterdir()):
        raise DataError(f"{path}: its files are packed as a whole; unpack them first: zstd -d {path}/*.zstd")
    if not there:
        raise DataError(f"{path} holds no .mcap or .db3 file")
    if len(there) > _MOST_FILES:
        raise DataError(f"{path} holds {len(there)} files, more than {_MOST_FILES}")
    order = _order(path / "metadata.yaml")
    return sorted(there, key=lambda file: order.get(file.name, len(order)))


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a bag by its name and, for a folder, the names in it."""
    if path.is_file():
        return path.suffix.lower() in SUFFIXES or path.name.endswith(_ACTIVE)
    return path.is_dir() and any(
        file.suffix.lower() in _STORED or file.name.endswith(_PACKED) for file in path.iterdir()
    )


def _is_packed(data: bytes) -> bool:
    """Return whether rosbag 2 packed a message by itself; no message of CDR begins so."""
    return data.startswith(_ZSTD)


def _container(path: Path, number: int) -> Container:
    """Return a file's reader by what it begins with: names lie."""
    with open_file(path) as file:
        head = file.read(16)
    if head.startswith(mcap.MAGIC):
        return mcap.Mcap(path, number)
    if head.startswith(sqlite.MAGIC):
        return sqlite.Database(path, number)
    if head.startswith(b"#ROSBAG"):
        return rosbag1.Rosbag1(path, number)
    raise DataError(
        f"{path} begins neither as a rosbag nor as MCAP nor as a database" + ("" if head else ": it is empty")
    )


def _order(metadata: Path) -> dict[str, int]:
    """Return the numbers of the files that a recorder's metadata names; what cannot be read gives none."""
    try:
        names = load_yaml(metadata)["rosbag2_bagfile_information"]["relative_file_paths"]
        return {Path(str(name)).name: number for number, name in enumerate(names)}
    except (DataError, OSError, KeyError, TypeError, ValueError):
        return {}


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Return a key by which drive_2 comes before drive_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d{1,18})", path.name)]
