"""What verbs share on the terminal: a progress bar, a status line, tables of numbers."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from vislam.errors import printable


@contextmanager
def progress_bar(name: str, unit: str = "frames") -> Iterator[Callable[[int, int, str], None] | None]:
    """Show a progress bar on stderr when that is a terminal; it is told what is done, of how much, and a note."""
    if not sys.stderr.isatty():
        yield None
        return
    columns = (
        TextColumn(name),
        BarColumn(),
        TextColumn(f"{{task.completed}}/{{task.total}} {unit}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, note="")
        yield lambda done, total, note: bar.update(task, completed=done, total=total, note=note)


@contextmanager
def rewritten_line() -> Iterator[Callable[[str], None]]:
    """Give what writes one line again and again on stderr when that is a terminal, and nothing otherwise."""
    if not sys.stderr.isatty():
        yield lambda line: None
        return
    try:
        yield lambda line: print(f"\r{line}\033[K", end="", file=sys.stderr)
    finally:
        print(file=sys.stderr)


def print_table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None, words: Sequence[str] | None = None
) -> None:
    """Print a table whose columns are numbers, set to the right, but for those of `words` (None: the first)."""
    table = Table(title=title)
    left = columns[:1] if words is None else words
    for column in columns:
        table.add_column(column, justify="left" if column in left else "right")
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    Console().print(table)


def number(value: float | None, digits: int) -> str:
    """Write a number that may be missing."""
    return "-" if value is None else f"{value:.{digits}f}"
