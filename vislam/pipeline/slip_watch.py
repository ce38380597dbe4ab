"""Whether the wheels of a sensor slip: its readings contradict what inertial data and vision say, again and again."""

from typing import Any

# Chosen, not fitted to any drive: three good readings in a row that fail a gate of 0.999 come once in 10^9.
_BEGINS = 3  # readings in a row that fail the gate
_ENDS = 3  # readings in a row that would pass it,
_ENDS_NS = 500_000_000  # over at least so long: a wheel that finds its hold for a moment loses it again
_MOST_NS = 60_000_000_000  # what lasts longer is no slip: filter or sensor is wrong, and the gates have to see to it


class SlipWatch:
    """Follows the answers of the filter's gate to one sensor, in the order in which they come.

    Attributes:
        slips: now; its readings are not to be used.
        contradicts: it seemed to slip for longer than a slip lasts; its readings are used again, as far as gates let.
        times: how often it slipped.
    """

    def __init__(self) -> None:
        """Begin without a slip."""
        self.slips = self.contradicts = False
        self.times = 0
        self._past_ns = 0  # that past slips lasted
        self._begin_ns = self._newest_ns = 0
        self._failed = self._passed = 0  # in a row
        self._failing_ns = self._passing_ns = 0  # since when

    @property
    def begin_ns(self) -> int:
        """When the slip began that goes on, or the last one."""
        return self._begin_ns

    @property
    def seconds(self) -> float:
        """For how long it slipped, all slips together."""
        return (self._past_ns + (self._newest_ns - self._begin_ns if self.slips else 0)) * 1e-9

    def judge(self, t_ns: int, passes: bool) -> None:
        """Take whether a reading passes the gate, or would if it were used."""
        self._newest_ns = max(self._newest_ns, t_ns)
        if passes:
            self._passing_ns = min(self._passing_ns, t_ns) if self._passed else t_ns
            self._failed, self._passed = 0, self._passed + 1
        else:
            self._failing_ns = min(self._failing_ns, t_ns) if self._failed else t_ns
            self._failed, self._passed = self._failed + 1, 0
        agrees = self._passed >= _ENDS and self._newest_ns - self._passing_ns >= _ENDS_NS
        if self.contradicts:
            self.contradicts = not agrees
        elif self.slips and (agrees or self._newest_ns - self._begin_ns > _MOST_NS):
            self.slips, self.contradicts = False, not agrees
            self._past_ns += (self._passing_ns if agrees else self._newest_ns) - self._begin_ns
        elif not self.slips and self._failed >= _BEGINS:
            self.slips, self.times, self._begin_ns = True, self.times + 1, self._failing_ns

    def summary(self) -> dict[str, Any]:
        """Return the entries of a report; empty where nothing slipped."""
        if not self.times:
            return {}
        return {"times": self.times, "seconds": self.seconds, "slips": self.slips, "contradicts": self.contradicts}

    def status(self) -> str:
        """Return what a driver should know now; empty: nothing."""
        if self.slips:
            return f"slips for {(self._newest_ns - self._begin_ns) * 1e-9:.1f} s"
        return "contradicts inertial data and vision" if self.contradicts else ""
