"""How a long job reports how far it is."""

from collections.abc import Callable

Progress = Callable[[int, int, str], None]  # done, of how much (0: unknown), a short note


def silent(done: int, total: int, note: str) -> None:
    """Say nothing."""
