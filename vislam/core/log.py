"""What `log.txt` of a run folder is: records of the standard library's `logging`, and warnings of whatever is called.

Modules write to `logging.getLogger(__name__)`. Each record is one line, appended by one call of the system, so that a
crash loses nothing that was said before, and lines of several processes do not mix.
"""

import fcntl
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from logging.handlers import QueueHandler
from pathlib import Path

from vislam.core.errors import UsageError, VislamError, storage_failure
from vislam.core.revision import version

FILE_NAME = "log.txt"
LEVELS = ("debug", "info", "warning", "error")
_OURS = logging.getLogger("vislam")  # other packages are asked for warnings only: numba logs a lot at lower levels
_LOG = logging.getLogger(__name__)


def set_level(name: str) -> None:
    """Set from which level on records are kept, here and in processes that are given `level()`."""
    if name not in LEVELS:
        raise UsageError(f"no log level '{name}'; there are: {', '.join(LEVELS)}")
    _OURS.setLevel(name.upper())


def level() -> str:
    """Return the level from which on records are kept."""
    return logging.getLevelName(_OURS.level or logging.INFO).lower()


@contextmanager
def log_to(folder: Path, command: Sequence[str]) -> Iterator[None]:
    """Append what is logged and warned of meanwhile to log.txt of a folder, from when the folder is there.

    How it ends is logged, too: an error as its one line, a bug with its traceback.
    """
    with _handled_by(_File(folder / FILE_NAME)):
        _LOG.info("%s: %s", version(), " ".join(command))
        try:
            yield
        except VislamError as error:
            _LOG.error("%s", error)
            raise
        except KeyboardInterrupt:
            _LOG.warning("interrupted")
            raise
        except OSError as error:
            _LOG.exception("%s", storage_failure(error) or "this is a bug")
            raise
        except BaseException:
            _LOG.exception("this is a bug")
            raise
        _LOG.info("done")


def log_in_run(run: Path, command: Sequence[str]) -> AbstractContextManager[None]:
    """Return `log_to` for a run that is there, and nothing for a folder that holds none.

    Raises DataError for links that lead out of it.
    """
    from vislam.core.files import refuse_links_out  # and numpy, which --help does without

    refuse_links_out(run)
    return log_to(run, command) if (run / "manifest.json").is_file() else nullcontext()


@contextmanager
def log_through(send: Callable[[logging.LogRecord], None], level_name: str) -> Iterator[None]:
    """Hand what is logged and warned of meanwhile to `send`, ready to travel to the process that has the file."""
    set_level(level_name)
    with _handled_by(_Sender(send)):
        yield


def is_written_to(folder: Path) -> bool:
    """Return whether a process, this one included, has the log of a folder open."""
    try:
        descriptor = os.open(folder / FILE_NAME, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False  # a file system without locks
    finally:
        os.close(descriptor)
    return False


def take_record(record: logging.LogRecord) -> None:
    """Log what another process sent."""
    logging.getLogger(record.name).handle(record)


@contextmanager
def _handled_by(handler: logging.Handler) -> Iterator[None]:
    root = logging.getLogger()
    set_level(level())
    handler.setLevel(_OURS.level)
    root.addHandler(handler)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        root.removeHandler(handler)
        handler.close()


class _Lines(logging.Formatter):
    """Time (UTC), process, level, module and message; what follows in further lines is indented."""

    converter = staticmethod(time.gmtime)

    def __init__(self) -> None:
        form = "%(asctime)s.%(msecs)03dZ %(processName)s[%(process)d] %(levelname)s %(name)s: %(message)s"
        super().__init__(form, "%Y-%m-%dT%H:%M:%S")

    def format(self, record: logging.LogRecord) -> str:
        return super().format(record).rstrip().replace("\n", "\n    ") + "\n"


class _File(logging.Handler):
    """Appends lines to a file; a disk that is full or gone must not end what is logged."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.setFormatter(_Lines())
        self._path = path
        self._waiting = b""  # until the folder is there
        self._descriptor = -1

    def emit(self, record: logging.LogRecord) -> None:
        self._waiting += self.format(record).encode(errors="replace")
        with suppress(OSError):
            if self._descriptor < 0:
                self._descriptor = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
                fcntl.flock(self._descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # see `is_written_to`
            waiting, self._waiting = self._waiting, b""
            os.write(self._descriptor, waiting)

    def close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
        super().close()


class _Sender(QueueHandler):
    """Makes a record ready to travel and hands it on."""

    def __init__(self, send: Callable[[logging.LogRecord], None]) -> None:
        super().__init__(None)  # type: ignore[arg-type]  # `enqueue` needs no queue
        self._send = send

    def enqueue(self, record: logging.LogRecord) -> None:
        self._send(record)
