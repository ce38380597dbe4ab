"""Host time of what a device stamped with a clock of its own: a line under the arrivals.

A message can only be late, so the host's time over the device's time is the line that lies below all arrivals and as
close to them as possible (Moon, Skelly and Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999). Delays of a busy host then do not move the stamps.
"""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

from vislam.config import BridgeClockConfig

_WINDOW_S = 20.0  # of arrivals that the line is laid under; 0.1 ms of jitter then costs 5 ppm of rate
_MAX_DRIFT = 0.025  # of the rate; a ceramic resonator, as on an Arduino Nano, is off by up to 0.5 %
_STEP_S = 0.1  # before its time by so much is no jitter: the device restarted or the host slept
_MAX_SLEW = 0.05  # share of an interval by which a better line may stretch it: 5 ms are caught up in 0.1 s
_LATE_S = 2.0  # everything late by step_s for so long: the device's clock lost time
_WRAP_US = 2**32


@dataclass(frozen=True, slots=True)
class _Point:
    device_ns: int  # unwrapped device time
    host_ns: int  # of arrival


class DeviceClock:
    """Turns device stamps [us, 32 bits] into host time [ns], rising strictly.

    Device time that runs off its line (the device restarted, or the host slept while it ran on) begins a new line:
    `steps` counts that. A single such stamp is not believed: `doubted` counts it.
    """

    def __init__(self, config: BridgeClockConfig) -> None:
        self.steps = 0
        self.doubted = 0
        self.rate = 1.0  # host ns per device ns
        self._config = config
        self._step_ns = _STEP_S * 1e9
        self._rate_known = False
        self._newest_stamp_ns = -1
        self._suspect: tuple[int, int] | None = None  # device us and arrival ns of a stamp that is off the line
        self._begin()

    @property
    def seen_ns(self) -> int:
        """How much of the device's time the line is laid under, 20 s at most."""
        return 0 if self._last is None else self._last.device_ns - self._lowest[0].device_ns

    def restart(self) -> None:
        """Begin a new line: the device was restarted or plugged in again."""
        if self._last is not None:
            self.steps += 1
        self._begin()

    def stamp(self, device_us: int, arrival_ns: int, is_newest: bool = True) -> int | None:
        """Return the host time of a device stamp that has just arrived; None while the line is not to be trusted.

        Of what was read at once only the newest, which the others lay in wait for, shows where a line begins.
        """
        point = _Point(self._unwrapped(device_us), arrival_ns)
        if self._last is not None and self._delay_ns(point) < -self._step_ns:  # before its time: no delay explains it
            suspect, self._suspect = self._suspect, (device_us, arrival_ns)
            if suspect is None or (device_us - suspect[0]) % _WRAP_US > _STEP_S * 1e6:
                self.doubted += 1
                return None
            self.restart()
            if is_newest:
                self._add(_Point(suspect[0] * 1000, suspect[1]))
            point = _Point(self._unwrapped(device_us), arrival_ns)
        self._suspect = None
        if self._last is None and not is_newest:
            return None
        self._add(point)
        return self._stamped(point) if self._rate_known else None

    def host_ns(self, device_us: int) -> int | None:
        """Return the host time of a device stamp near the newest one, which changes nothing; None where none is known.

        For what the device stamped besides, before or after it: within 0.1 s of the newest stamp, and by the same
        slow approach to a better line, so that its intervals stay true as well.
        """
        if self._last is None or self._slewed is None or self._slewed[0] != self._last.device_ns:
            return None
        since_us = (device_us - self._last.device_ns // 1000 + _WRAP_US // 2) % _WRAP_US - _WRAP_US // 2
        if abs(since_us) > _STEP_S * 1e6:
            return None
        return self._slewed[1] + round(self.rate * since_us * 1000)

    def _begin(self) -> None:
        self._last: _Point | None = None
        self._suspect = None
        self._lowest: deque[_Point] = deque()  # the least delayed arrival of each bin of device time
        self._anchor = _Point(0, 0)  # on the line
        self._slewed: tuple[int, int] | None = None  # device ns and host ns of the last stamp given

    def _unwrapped(self, device_us: int) -> int:
        """Return device time in ns, as many wraps after the last one as it takes not to go back."""
        if self._last is None:
            return device_us * 1000
        return self._last.device_ns + (device_us - self._last.device_ns // 1000) % _WRAP_US * 1000

    def _line_ns(self, device_ns: int) -> float:
        return self._anchor.host_ns + self.rate * (device_ns - self._anchor.device_ns)

    def _delay_ns(self, point: _Point) -> float:
        """Return how long after the line a point arrived."""
        return point.host_ns - self._line_ns(point.device_ns)

    def _add(self, point: _Point) -> None:
        bin_ns = int(self._config.bin_s * 1e9)
        if self._last is None or point.device_ns // bin_ns != self._last.device_ns // bin_ns:
            if self._last is None or point.host_ns > self._last.host_ns:  # what was read at once shows no rate
                self._fit(point.device_ns)
            self._lowest.append(point)
        elif self._delay_ns(point) < self._delay_ns(self._lowest[-1]):
            self._lowest[-1] = point
        if self._last is None or self._delay_ns(point) < 0.0:
            self._anchor = point  # the line is above no arrival
        self._last = point

    def _fit(self, now_ns: int) -> None:
        """Lay the line again under the least delayed arrivals of the window."""
        config, points = self._config, self._lowest
        while points and points[0].device_ns < now_ns - _WINDOW_S * 1e9:
            points.popleft()
        if not points:
            return
        self._forget_before_step(now_ns)
        seen_ns = min(points[-1].device_ns - points[0].device_ns, points[-1].host_ns - points[0].host_ns)
        if seen_ns >= config.settle_s * 1e9:
            self._rate_known = True
            self.rate = min(max(_slope_below(list(points)), 1.0 - _MAX_DRIFT), 1.0 + _MAX_DRIFT)
        self._anchor = min(points, key=self._delay_ns)

    def _forget_before_step(self, now_ns: int) -> None:
        """Begin again where everything has been late for long: the device's clock lost time.

        What was only read late, in one burst after the host was busy, arrived within no time and is no such case.
        """
        points = self._lowest
        late = [point for point in points if point.device_ns >= now_ns - _LATE_S * 1e9]
        if not late or late[-1].host_ns - late[0].host_ns < _LATE_S * 0.5e9:
            return
        if min(map(self._delay_ns, late)) > self._step_ns:
            self.steps += 1
            points.clear()
            points.extend(late)
            self._slewed = None

    def _stamped(self, point: _Point) -> int | None:
        """Return the line at a point, approached at a limited rate so that intervals between samples stay true.

        Stamps far off a better line are taken back: it begins behind a hole as long as they were wrong.
        """
        line_ns = self._line_ns(point.device_ns)
        if self._slewed is not None:
            passed_ns = (point.device_ns - self._slewed[0]) * self.rate
            off_ns, reach_ns = line_ns - self._slewed[1] - passed_ns, passed_ns * _MAX_SLEW
            if abs(off_ns) < self._step_ns:
                line_ns = self._slewed[1] + passed_ns + min(max(off_ns, -reach_ns), reach_ns)
            elif line_ns < self._slewed[1] - off_ns:
                self.doubted += 1
                self._lowest = deque(known for known in self._lowest if self._delay_ns(known) < self._step_ns)
                return None
            else:
                self.steps += 1
        stamp_ns = round(line_ns)
        self._slewed = (point.device_ns, stamp_ns)
        if stamp_ns <= self._newest_stamp_ns:
            self.doubted += 1
            return None
        self._newest_stamp_ns = stamp_ns
        return stamp_ns


def _slope_below(points: list[_Point]) -> float:
    """Return the slope of the line below all points that is closest to them.

    It is that of the edge of their lower convex hull over the mean of their times.
    """
    first = points[0]
    hull: list[tuple[int, int]] = []
    for point in points:
        x, y = point.device_ns - first.device_ns, point.host_ns - first.host_ns
        while len(hull) >= 2 and _turn(hull[-2], hull[-1], (x, y)) <= 0:
            hull.pop()
        hull.append((x, y))
    middle = sum(point.device_ns - first.device_ns for point in points) / len(points)
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle:
            return (y1 - y0) / (x1 - x0)
    return 1.0


def _turn(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> int:
    """Return a positive number when the way from a over b to c turns left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
