"""Files that are either whole or not there: written beside their name, then renamed."""

import csv
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from vislam.core.errors import DataError, StorageError

_LINES_AT_ONCE = 4096


@contextmanager
def storage(path: Path) -> Iterator[None]:
    """Turn a refusal of the system to write into StorageError with the next step."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise StorageError(f"{path} cannot be written: {reason}; free disk space or choose another folder") from error


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that takes the place of `path` when the block ends well, and vanishes when it does not.

    Raises StorageError when it cannot be written: full disk, missing folder or permission.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")  # two processes may write the same file
    try:
        with storage(path):
            with partial.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        raise


@contextmanager
def partial_folder(path: Path) -> Iterator[Path]:
    """Make a folder beside `path`, to write and rename from; what is left of it goes when the block ends.

    Raises StorageError when it cannot be made, or the block cannot write.
    """
    with storage(path):
        folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".partial", dir=path.parent))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write a file of UTF-8 text; the old file or none is left when that fails. Raises StorageError."""
    with replacing(path) as file:
        file.write(text.encode())


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write a file of UTF-8 lines, as `write_text` does, without holding more than some of what `lines` yields."""
    rest = iter(lines)
    with replacing(path) as file:
        while some := list(islice(rest, _LINES_AT_ONCE)):
            file.write(("\n".join(some) + "\n").encode())


def write_json(path: Path, data: Any) -> None:
    """Write plain data as JSON, atomically; numbers that are not finite become null."""
    write_text(path, json.dumps(plain(data), indent=1) + "\n")


def plain(data: Any) -> Any:
    """Return data as JSON has it: no numpy, and null for numbers that are not finite."""
    if isinstance(data, dict):
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [plain(value) for value in data]
    if isinstance(data, (float, np.floating)):
        return float(data) if np.isfinite(data) else None
    return data.item() if isinstance(data, np.generic) else data


def leads_out(path: Path, folder: Path) -> bool:
    """Return whether a path in a folder is a link that leads out of it, or lies behind one."""
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def refuse_links_out(run: Path) -> None:
    """Raise DataError for a link that leads out of a run folder: what is written there would be written elsewhere."""
    for path in (*run.glob("*"), *run.glob("*/*")):
        if path.is_symlink() and leads_out(path, run):
            raise DataError(f"{path} is a link that leads out of the run folder; put there what it leads to")


def check_writable(out: Path) -> None:
    """Raise StorageError where a folder that is there, or is to be made, takes no files."""
    there = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    if not os.access(there, os.W_OK | os.X_OK):
        raise StorageError(f"{out} cannot be written: no right to write in {there}; choose another --out")


def csv_text(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return rows as CSV with a header."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
