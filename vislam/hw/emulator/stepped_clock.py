"""A clock that takes no time: sleeping moves it on at once, and so do transfers of an emulated bus."""


class SteppedClock:
    """Satisfies `vislam.hw.timing.Clock`; tests of minutes run in a second, the same every time."""

    def __init__(self, t_ns: int = 1_000_000_000_000) -> None:
        """Start at a time since boot."""
        self._t_ns = t_ns

    def now_ns(self) -> int:
        """Return the time in ns."""
        return self._t_ns

    def sleep_until(self, t_ns: int) -> None:
        """Move on to `t_ns`, never back."""
        self._t_ns = max(self._t_ns, t_ns)

    def advance(self, duration_ns: int) -> None:
        """Let time pass."""
        self._t_ns += duration_ns
