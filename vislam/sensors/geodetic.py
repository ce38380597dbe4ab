"""Latitude, longitude and height as east, north, up in a local frame, and back: WGS84, closed form."""

import math
from dataclasses import dataclass

import numpy as np

from vislam.core.errors import UsageError
from vislam.core.messages import Array

A_M = 6378137.0  # WGS84: half the larger axis
FLATTENING = 1.0 / 298.257223563
E2 = FLATTENING * (2.0 - FLATTENING)


@dataclass(frozen=True, slots=True)
class Geodetic:
    """A place on WGS84; the height is above the ellipsoid, not above the sea."""

    latitude_deg: float
    longitude_deg: float
    height_m: float


def ecef(place: Geodetic) -> Array:
    """Return the place [3] in metres from the earth's centre."""
    latitude, longitude = math.radians(place.latitude_deg), math.radians(place.longitude_deg)
    sine, cosine = math.sin(latitude), math.cos(latitude)
    normal_m = A_M / math.sqrt(1.0 - E2 * sine * sine)
    level_m = (normal_m + place.height_m) * cosine
    up_m = (normal_m * (1.0 - E2) + place.height_m) * sine
    return np.array([level_m * math.cos(longitude), level_m * math.sin(longitude), up_m])


def geodetic(place_m: Array) -> Geodetic:
    """Return the inverse of `ecef`.

    Vermeille, "Direct transformation from geocentric coordinates to geodetic coordinates", J. Geodesy 76, 2002: closed
    form, for all places more than 45 km from the earth's centre. Raises UsageError for one nearer than that.
    """
    x, y, z = (float(value) for value in place_m)
    level2 = x * x + y * y
    p, q = level2 / A_M**2, (1.0 - E2) / A_M**2 * z * z
    r = (p + q - E2 * E2) / 6.0
    if not r > 1e-6 or not math.isfinite(r):
        raise UsageError(f"[{x:g}, {y:g}, {z:g}] m is at the earth's centre; is a datum or a number damaged?")
    s = E2 * E2 * p * q / (4.0 * r**3)
    t = float(np.cbrt(1.0 + s + math.sqrt(s * (2.0 + s))))
    u = r * (1.0 + t + 1.0 / t)
    v = math.sqrt(u * u + E2 * E2 * q)
    w = E2 * (u + v - q) / (2.0 * v)
    k = math.sqrt(u + v + w * w) - w
    level = k * math.sqrt(level2) / (k + E2)
    slant = math.hypot(level, z)
    latitude = 2.0 * math.atan2(z, level + slant)
    return Geodetic(math.degrees(latitude), math.degrees(math.atan2(y, x)), (k + E2 - 1.0) / k * slant)


class LocalFrame:
    """East, north and up at a datum: a plane that touches the ellipsoid there, exact at any distance."""

    def __init__(self, datum: Geodetic) -> None:
        """Take the origin. Raises UsageError for one that is not on the earth."""
        if why := why_nowhere(datum):
            raise UsageError(f"datum: {why}")
        self.datum = datum
        latitude, longitude = math.radians(datum.latitude_deg), math.radians(datum.longitude_deg)
        s, c, sl, cl = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
        self._R_enu_ecef: Array = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
        self._origin = ecef(datum)

    def enu(self, place: Geodetic) -> Array:
        """Return east, north, up [3] in metres."""
        return self._R_enu_ecef @ (ecef(place) - self._origin)

    def geodetic(self, enu_m: Array) -> Geodetic:
        """Return latitude, longitude and height of east, north, up [3]."""
        return geodetic(self._origin + self._R_enu_ecef.T @ enu_m)


def why_nowhere(place: Geodetic) -> str:
    """Return why numbers are no place on or near the earth; empty: they are."""
    if not abs(place.latitude_deg) <= 90.0:
        return f"latitude {place.latitude_deg:g} deg, -90 to 90 is asked"
    if not abs(place.longitude_deg) <= 180.0:
        return f"longitude {place.longitude_deg:g} deg, -180 to 180 is asked"
    return "" if abs(place.height_m) <= 1e5 else f"height {place.height_m:g} m, 100 km at most"
