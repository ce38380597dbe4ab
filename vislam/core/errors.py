"""The errors a user of vislam can meet. Each message has what happened, where, asked versus got, and the next step."""

import copyreg
import errno
import os
import shutil
from contextlib import suppress

_MOST_OF_END = 1000  # characters of a message that quotes a file without end


def printable(text: object) -> str:
    """Return text with escapes in the place of what a terminal would obey or not show.

    Whatever is quoted from a file may hold such: control characters, escape sequences, bytes that are no text, marks
    that turn the direction of writing.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text))


def install_line(extra: str) -> str:
    """Return the command that installs an optional part of vislam. No package index has vislam yet."""
    return f"pip install '.[{extra}]' in a clone of vislam"


class VislamError(Exception):
    """Root of every expected failure; the command line turns it into one line and `exit_code`.

    Its text is `printable`, whatever it quotes. It travels between processes with its class, text and attributes.
    """

    exit_code = 3

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle without `__init__`, whose arguments in a subclass are not those that the message was made of."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]

    def __str__(self) -> str:
        """Return the message in one line of printable characters; the middle of a very long one is left out."""
        said = super().__str__()
        if len(said) > 2 * _MOST_OF_END:
            said = f"{said[:_MOST_OF_END]} [...] {said[-_MOST_OF_END:]}"
        return printable(said)


class UsageError(VislamError):
    """The caller asked for something that does not exist or does not fit together (exit code 2)."""

    exit_code = 2


class DataError(VislamError):
    """A recording, file or calibration cannot be used as it is (exit code 3)."""


class TrackingLostError(VislamError):
    """A run ended without a usable trajectory, or a quality gate failed (exit code 4)."""

    exit_code = 4


class HardwareError(VislamError):
    """A sensor, bus or port does not answer as its datasheet states (exit code 5)."""

    exit_code = 5


class StorageError(VislamError):
    """Something could not be written: full disk, missing permission (exit code 3)."""


_SHARED = "/dev/shm"  # memory that processes share
_SURROUNDINGS = {
    errno.ENOSPC: "free disk space", errno.EDQUOT: "free disk space", errno.EFBIG: "raise the limit of a file's size",
    errno.EROFS: "choose another folder", errno.EACCES: "choose another folder, or get the right to use this one",
    errno.EPERM: "choose another folder, or get the right to use this one", errno.EIO: "check the disk",
    errno.EMFILE: "raise the limit of open files (ulimit -n)", errno.ENFILE: "end other programs",
}  # fmt: skip


def storage_failure(error: OSError) -> StorageError | None:
    """Return what the system refused as the expected failure that it is; None where a bug may be the reason."""
    next_step = _SURROUNDINGS.get(error.errno or 0)
    if next_step is None:
        return None
    name = error.filename
    if name is None and error.errno == errno.ENOSPC:  # semaphores, too, are files there, which the system does not name
        with suppress(OSError):
            if shutil.disk_usage(_SHARED).free < os.sysconf("SC_PAGESIZE"):
                name, next_step = _SHARED, "remove what fills it, or give it more (mount -o remount,size=1G /dev/shm)"
    where = "" if name is None else f"{name}: "
    return StorageError(f"{where}{error.strerror}; {next_step}")
