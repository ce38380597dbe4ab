"""Fixes from lines of NMEA 0183: GGA for the place, RMC for the date, GST for how sure it is."""

import math
from dataclasses import dataclass
from datetime import date, timedelta
from functools import reduce
from operator import xor

from vislam.sensors.geodetic import Geodetic
from vislam.sensors.gnss.fixes import Fix, FixKind

_QUALITY: dict[str, FixKind] = {"1": "single", "2": "differential", "3": "single", "4": "rtk", "5": "float"}
_DAY_NS = 86_400_000_000_000
_EPOCH = date(1970, 1, 1)
_MOST_CHARACTERS = 256  # the standard has 82; some receivers write longer ones


@dataclass(slots=True)
class _Epoch:
    """What the sentences of one time say."""

    of_day_ns: int
    stamp_ns: int | None = None  # of the program that recorded the line
    place: Geodetic | None = None
    kind: FixKind = "none"
    hdop: float = math.nan
    day: date | None = None
    sigmas_m: tuple[float, float] = (math.nan, math.nan)


class NmeaFixes:
    """Collects the sentences of one time into a fix. A stamp in ns or s before the `$` is taken for the fix's own."""

    def __init__(self) -> None:
        """Begin without a date: fixes before the first RMC need stamps of their own."""
        self._epoch: _Epoch | None = None
        self._day: date | None = None
        self._last_of_day_ns: int | None = None
        self.undated = 0  # fixes without a date

    def feed(self, line: str) -> Fix | None:
        """Return the fix that a line ends, by being of another time. Raises ValueError for a damaged sentence."""
        stamp, dollar, rest = line.partition("$")
        if not dollar or len(rest) > _MOST_CHARACTERS:
            raise ValueError("no sentence")
        fields = _checked(rest).split(",")
        kind = fields[0][2:]
        if kind not in ("GGA", "RMC", "GST") or len(fields) < 9:
            return None
        if not fields[1]:
            return None  # a receiver that does not know the time yet
        of_day_ns = _time_of_day(fields[1])
        done = None
        if self._epoch is None or self._epoch.of_day_ns != of_day_ns:
            done = self.end()
            self._epoch = _Epoch(of_day_ns)
        _take(self._epoch, kind, fields, _stamp(stamp))
        return done

    def end(self) -> Fix | None:
        """Return the fix that is still being collected."""
        epoch, self._epoch = self._epoch, None
        if epoch is None:
            return None
        if epoch.day is not None:
            self._day = epoch.day
        elif self._day and self._last_of_day_ns and self._last_of_day_ns - epoch.of_day_ns > _DAY_NS // 2:
            self._day += timedelta(days=1)  # midnight, before the first RMC of the new day
        self._last_of_day_ns = epoch.of_day_ns
        if epoch.place is None or epoch.kind == "none":
            return None
        t_ns = epoch.stamp_ns
        if t_ns is None and self._day is not None:
            t_ns = (self._day - _EPOCH).days * _DAY_NS + epoch.of_day_ns
        if t_ns is None:
            self.undated += 1
            return None
        return Fix(t_ns, epoch.place, epoch.kind, *epoch.sigmas_m, epoch.hdop)


def _take(epoch: _Epoch, kind: str, fields: list[str], stamp_ns: int | None) -> None:
    if kind == "RMC":
        if len(fields) > 9 and fields[2] == "A":
            epoch.day = _date(fields[9])
    elif kind == "GST":
        axes = [_number(field) for field in fields[6:9]]
        if all(sigma > 0.0 for sigma in axes):
            epoch.sigmas_m = (math.sqrt(0.5 * (axes[0] ** 2 + axes[1] ** 2)), axes[2])
    elif fields[6] in _QUALITY and len(fields) > 11:
        latitude, longitude = _degrees(fields[2], fields[3], 2, "NS"), _degrees(fields[4], fields[5], 3, "EW")
        above_sea, geoid = _number(fields[9]), _number(fields[11]) if fields[11] else 0.0
        epoch.place, epoch.kind = Geodetic(latitude, longitude, above_sea + geoid), _QUALITY[fields[6]]
        epoch.hdop = _number(fields[8]) if fields[8] else math.nan
        epoch.stamp_ns = stamp_ns


def _checked(rest: str) -> str:
    """Return what stands between `$` and `*`, if the checksum after it is right."""
    body, star, checksum = rest.strip().rpartition("*")
    if not star or len(checksum) != 2 or int(checksum, 16) != reduce(xor, body.encode("utf-8"), 0):
        raise ValueError("checksum")
    return body


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _degrees(text: str, side: str, digits: int, sides: str) -> float:
    """Return degrees of `ddmm.mmm` and a side such as N."""
    minutes = _number(text[digits:])
    degrees = int(text[:digits]) + minutes / 60.0
    if not text[:digits].isdecimal() or not 0.0 <= minutes < 60.0 or side not in sides or len(side) != 1:
        raise ValueError(text)
    return -degrees if side == sides[1] else degrees


def _time_of_day(text: str) -> int:
    """Return ns of `hhmmss.sss`; a leap second is the first one of the next minute."""
    hours, minutes, seconds = int(text[:2]), int(text[2:4]), _number(text[4:])
    if not (text[:6].isdecimal() and hours < 24 and minutes < 60 and 0.0 <= seconds < 61.0):
        raise ValueError(text)
    return (hours * 3600 + minutes * 60) * 10**9 + round(seconds * 1e9)


def _date(text: str) -> date:
    """Return the day of `ddmmyy`, of the years 1980 to 2079."""
    if len(text) != 6 or not text.isdecimal():
        raise ValueError(text)
    year = int(text[4:])
    return date(year + (1900 if year >= 80 else 2000), int(text[2:4]), int(text[:2]))


def _stamp(text: str) -> int | None:
    """Return ns of what stands before a sentence: nanoseconds, or seconds with a point; None: nothing."""
    text = text.strip(" ,;\t")
    if not text:
        return None
    if text.isdecimal() and len(text) < 20:
        return int(text)
    whole, point, part = text.partition(".")
    if point and whole.isdecimal() and part.isdecimal() and len(whole) < 11:
        return int(whole) * 10**9 + int(part[:9].ljust(9, "0"))
    raise ValueError(text)
