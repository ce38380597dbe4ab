"""What verbs share on the terminal: a progress bar, a status line, tables of numbers."""

import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from vislam.core.errors import printable

_EVERY_S = 10.0


@contextmanager
def progress_bar(name: str, unit: str = "frames") -> Iterator[Callable[[int, int, str], None]]:
    """Show a progress bar on stderr, or a line now and then where that is no terminal.

    It takes what is done, of how much, 0 where that is unknown, and a note.
    """
    if not sys.stderr.isatty():
        with progress_lines(name, unit) as say:
            yield say
        return
    columns = (
        TextColumn(name),
        BarColumn(),
        TextColumn("{task.fields[share]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=None, note="", share="")
        yield lambda done, total, note: bar.update(
            task, completed=done, total=total or None, note=note, share=_share(done, total, unit)
        )


@contextmanager
def progress_lines(name: str, unit: str = "frames") -> Iterator[Callable[[int, int, str], None]]:
    """Show a line on stderr now and then; it takes what `progress_bar` takes."""
    say = _now_and_then()
    yield lambda done, total, note: say(f"{name}: {_share(done, total, unit)}  {note}".rstrip())


def _share(done: int, total: int, unit: str) -> str:
    return f"{done}/{total} {unit}" if total else f"{done} {unit}"


@contextmanager
def rewritten_line() -> Iterator[Callable[[str], None]]:
    """Give what writes one line again and again on stderr, or now and then a new one where that is no terminal."""
    if not sys.stderr.isatty():
        yield _now_and_then()
        return

    def show(line: str) -> None:
        with suppress(OSError):  # a terminal that is gone ends nothing by itself: SIGHUP does
            print(f"\r{line[: shutil.get_terminal_size().columns - 1]}\033[K", end="", file=sys.stderr)

    try:
        yield show
    finally:
        with suppress(OSError):
            print(file=sys.stderr)


def _now_and_then() -> Callable[[str], None]:
    """Return what prints the newest line it is given on stderr, ten seconds after the one before."""
    last_s = time.monotonic()

    def say(line: str) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= _EVERY_S:
            last_s = time.monotonic()
            print(line, file=sys.stderr, flush=True)

    return say


def print_table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    title: str | None = None,
    words: Sequence[str] | None = None,
    margin: int = 1,
) -> None:
    """Print a table whose columns are numbers, set to the right, but for those of `words` (None: the first)."""
    table = Table(title=title, padding=(0, margin))
    left = columns[:1] if words is None else words
    for column in columns:
        table.add_column(column, justify="left" if column in left else "right", overflow="fold")
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    Console().print(table)


def number(value: float | None, digits: int) -> str:
    """Write a number that may be missing."""
    return "-" if value is None else f"{value:.{digits}f}"
