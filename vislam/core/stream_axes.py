"""The numbers of a stream's rows: what is no measurement, what leaps and comes back, and what repeats by itself."""

from collections.abc import Sequence
from typing import Any, NamedTuple

_CHANGES = 100  # pairs of neighbours that differ, after which equal ones are a surprise
_BY_CHANCE = 1e-6  # runs of equal values as long that a whole stream has by chance


class Axis(NamedTuple):
    """One number of a row."""

    name: str
    most: float  # beyond every sensor
    leap: float  # more than a body that carries a camera does from one row to the next, and back in the one after


class Run:
    """Finds values that equal more before them than chance explains, by how often neighbours were equal up to now.

    Attributes:
        last: the newest value.
        since_ns: when it came for the first time.
        length: how many equal ones followed.
        is_stuck: they are too many.
        changes: values so far that differed from the one before.
    """

    def __init__(self) -> None:
        """Begin before the first value."""
        self.last: Any = None
        self.since_ns, self.length, self.is_stuck, self.changes = 0, 0, False, 0
        self._equal = 0  # pairs of neighbours, those that were stuck left out

    def take(self, t_ns: int, value: Any) -> bool:
        """Take the next value; return whether it is stuck."""
        if value != self.last:
            self._equal += 0 if self.is_stuck else self.length
            self.changes += 1
            self.last, self.since_ns, self.length, self.is_stuck = value, t_ns, 0, False
            return False
        self.length += 1
        self.is_stuck = self.changes >= _CHANGES and self.is_surprise(0.0)
        return self.is_stuck

    def is_surprise(self, share: float) -> bool:
        """Whether the equal ones are too many for chance, where at least a share of neighbours is equal by it."""
        pairs = self.changes + self._equal
        return bool(pairs * max((self._equal + 1.0) / (pairs + 1.0), share) ** self.length < _BY_CHANCE)


class AxisWatch:
    """Owns what each axis of a stream showed, and what the axes of its sensor, three together, did meanwhile."""

    def __init__(self, axes: Sequence[Axis]) -> None:
        """Take the axes; without any, nothing is asked of rows."""
        self.axes = axes
        self._runs = [Run() for _ in axes]
        self._others = [[0] * len(axes) for _ in axes]  # changes of all, when the value of an axis came again
        self._low, self._high = [float("inf")] * len(axes), [-float("inf")] * len(axes)

    def are_possible(self, row: Sequence[float]) -> bool:
        """Whether numbers are such that a sensor may give them; NaN is not."""
        for value, axis in zip(row, self.axes, strict=False):  # noqa: SIM110 `all` takes thrice as long, each sample
            if not abs(value) <= axis.most:
                return False
        return True

    def leaps(self, row: Sequence[float], before: Sequence[float]) -> bool:
        """Whether a row is farther from another than a body moves within a sample."""
        for a, b, axis in zip(before, row, self.axes, strict=False):  # noqa: SIM110 as above
            if abs(b - a) > axis.leap:
                return True
        return False

    def stuck(self, t_ns: int, row: Sequence[float]) -> list[tuple[str, int]]:
        """Take a row; return the axes that repeat a value though the others of their sensor go on, and since when.

        At an end of its range an axis is cut off, and no less alive.
        """
        low, high, is_any = self._low, self._high, False
        for k, (run, value) in enumerate(zip(self._runs, row, strict=False)):
            is_any |= run.take(t_ns, value)
            if value < low[k]:  # noqa: PLR1730 as above
                low[k] = value
            if value > high[k]:  # noqa: PLR1730
                high[k] = value
            if run.length == 1:
                self._others[k] = [other.changes for other in self._runs]
        if not is_any:
            return []
        return [
            (self.axes[k].name, run.since_ns)
            for k, run in enumerate(self._runs)
            if run.is_stuck and low[k] < run.last < high[k] and run.is_surprise(self._quiet(k))
        ]

    def _quiet(self, k: int) -> float:
        """Return the share of equal neighbours of the quieter other axis since the last change of this one."""
        length, begin = self._runs[k].length, k // 3 * 3
        others = [i for i in range(begin, min(begin + 3, len(self._runs))) if i != k]
        changes = min((self._runs[i].changes - self._others[k][i] for i in others), default=length)
        return (length - changes + 1.0) / (length + 1.0)
