"""What became of readings in the graph, counted by sensor."""

from collections import Counter

_ENDS = ("used", "in_window", "early", "dropped", "unusable")  # of a reading that came with a keyframe


class ReadingCounts:
    """Counts, by sensor, how readings end; of those in factors also which the sensor's own code failed at."""

    def __init__(self) -> None:
        """Start with none."""
        self._ended: dict[str, Counter[str]] = {}
        self._failed: dict[str, set[tuple[int, int]]] = {}  # factors and the readings in them

    def add(self, name: str, end: str, number: int = 1) -> None:
        """Count readings of a sensor that end so."""
        self._ended.setdefault(name, Counter())[end] += number

    def fail(self, name: str, factor: int, reading: int) -> None:
        """Take it that a sensor's own code failed at a reading of a factor; once or often is the same."""
        self._failed.setdefault(name, set()).add((factor, reading))

    @property
    def total(self) -> dict[str, int]:
        """Return how the readings of all sensors ended, as far as there are any that did."""
        failed = sum(map(len, self._failed.values()))
        return {**sum(self._ended.values(), Counter[str]()), "failed": failed}

    def of(self, name: str) -> dict[str, int]:
        """Return how the readings of a sensor ended, each way."""
        ended = self._ended.get(name, Counter[str]())
        return {**{end: ended[end] for end in _ENDS}, "failed": len(self._failed.get(name, ()))}
