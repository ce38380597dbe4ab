"""Every error of the package crosses from one process to another whole."""

import errno
import os
import pkgutil
import re
from collections.abc import Iterator
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from types import SimpleNamespace

import vislam
from vislam.core.errors import VislamError, storage_failure
from vislam.hw.chips.bus import BusError
from vislam.live.processes.child import Failure, Flag, Life, Signals, guarded

_OPTIONAL = {"cyclonedds", "pymavlink"}
_ARGUMENTS: dict[type[VislamError], tuple[object, ...]] = {
    BusError: ("/dev/i2c-7: it cannot be opened", OSError(errno.ENOENT, os.strerror(errno.ENOENT))),
}


def errors_of(root: type[VislamError]) -> Iterator[type[VislamError]]:
    yield root
    for error in root.__subclasses__():
        yield from errors_of(error)


def every_error() -> list[type[VislamError]]:
    """All classes of expected failures, in whatever module of the package they stand."""
    for module in pkgutil.walk_packages(vislam.__path__, "vislam."):
        if module.name == "vislam.__main__":
            continue  # it runs
        try:
            import_module(module.name)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in _OPTIONAL:
                raise
    return sorted({*errors_of(VislamError)}, key=lambda kind: kind.__qualname__)


def made(kind: type[VislamError]) -> VislamError:
    error = kind(*_ARGUMENTS.get(kind, (f"{kind.__name__}: what, where\x1b, and the next step",)))
    error.add_note("and a note")
    return error


def raise_one(life: Life, error: VislamError) -> None:
    raise error


def raise_all(report: Connection, kinds: list[type[VislamError]]) -> None:
    """In the child: end once with each of the errors."""
    for kind in kinds:
        error = made(kind)
        try:
            guarded("x", report, Signals(Flag(), Flag()), lambda life, error=error: raise_one(life, error))
        except SystemExit as end:
            assert end.code == 1
    report.close()


def test_every_error_of_the_package_crosses_processes_whole() -> None:
    kinds = every_error()
    assert len(kinds) >= 8 and BusError in kinds
    context = get_context("spawn")
    hears, says = context.Pipe(duplex=False)
    child = context.Process(target=raise_all, args=(says, kinds))
    child.start()
    says.close()
    try:
        for kind in kinds:
            assert hears.poll(60.0), f"nothing came of {kind.__name__}"
            failure, expected = hears.recv(), made(kind)
            assert isinstance(failure, Failure)
            assert type(failure.error) is kind, f"{kind.__name__} came as {failure.error!r}:\n{failure.traceback}"
            assert str(failure.error) == str(expected)
            assert failure.error.exit_code == expected.exit_code
            assert vars(failure.error) == vars(expected)  # the kind of a bus error, and notes
    finally:
        child.kill()
        child.join()


def test_full_shared_memory_is_named_where_the_system_does_not_name_it(monkeypatch):
    for free, words in ((0, "^/dev/shm: .*remount"), (10**9, "^No space left on device; free disk space")):
        monkeypatch.setattr("shutil.disk_usage", lambda path, free=free: SimpleNamespace(free=free))
        assert re.search(words, str(storage_failure(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))))
    assert str(storage_failure(OSError(errno.ENOSPC, "full", "/x/y"))).startswith("/x/y: full; free disk space")
