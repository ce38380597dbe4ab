"""A fix as a reading of `position`: which are good enough, how sure they are, and where the local frame begins."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vislam.config.ranges import Finite, NonNegative, Positive
from vislam.core.readings import Reading
from vislam.sensors.geodetic import Geodetic, LocalFrame, why_nowhere

FixKind = Literal["none", "single", "differential", "float", "rtk"]
FIX_KINDS: tuple[FixKind, ...] = ("none", "single", "differential", "float", "rtk")  # the better the later


@dataclass(frozen=True, slots=True)
class Fix:
    """What a receiver said of one time."""

    t_ns: int  # of UTC since 1970, or the stamp of the program that recorded it
    place: Geodetic
    kind: FixKind
    sigma_m: float = math.nan  # per horizontal axis; nan: not stated
    sigma_up_m: float = math.nan
    hdop: float = math.nan


@dataclass(frozen=True, slots=True)
class GnssSettings:
    """Which fixes are taken, and how sure they are where the receiver does not say."""

    datum: tuple[Finite, Finite, Finite] | None = None  # latitude, longitude in deg, height in m; None: the first fix
    least_fix: FixKind = "single"  # worse ones are refused
    single_m: Positive = 2.0  # sigma per horizontal axis at an hdop of 1
    differential_m: Positive = 1.0
    float_m: Positive = 0.4
    rtk_m: Positive = 0.02
    up_factor: Positive = 2.0  # by which heights are worse
    least_sigma_m: Positive = 0.01  # of a receiver that states less: neighbouring fixes share their errors
    inflation: Positive = 1.0  # of what the receiver states
    max_sigma_m: NonNegative = 30.0  # fixes less sure are refused


class FixReadings:
    """Turns fixes into readings east, north, up, each with its covariance."""

    def __init__(self, name: str, settings: GnssSettings) -> None:
        """Take the sensor's name, and settings. Raises UsageError for a datum that is not on the earth."""
        self._name, self._settings = name, settings
        self.frame = LocalFrame(Geodetic(*settings.datum)) if settings.datum else None  # None: before the first fix

    def reading(self, fix: Fix) -> Reading | None:
        """Return a fix as a reading; None for one without a position.

        Raises ValueError with the reason for one that is not good enough.
        """
        if fix.kind == "none":
            return None
        s = self._settings
        if FIX_KINDS.index(fix.kind) < FIX_KINDS.index(s.least_fix):
            raise ValueError(f"fix of kind {fix.kind}, {s.least_fix} is asked")
        if why := why_nowhere(fix.place):
            raise ValueError(why)
        sigma, up = self._sigmas(fix)
        if not max(sigma, up) <= s.max_sigma_m:
            raise ValueError(f"fix less sure than {s.max_sigma_m:g} m")
        self.frame = self.frame or LocalFrame(fix.place)
        return Reading(self._name, fix.t_ns, self.frame.enu(fix.place), np.diag([sigma**2, sigma**2, up**2]))

    def _sigmas(self, fix: Fix) -> tuple[float, float]:
        """Return sigmas per horizontal axis and up."""
        s = self._settings
        usual = {"single": s.single_m, "differential": s.differential_m, "float": s.float_m, "rtk": s.rtk_m}
        guess = usual[fix.kind] * (max(1.0, fix.hdop) if math.isfinite(fix.hdop) else 1.0)
        sigma = s.inflation * fix.sigma_m if fix.sigma_m > 0.0 else guess
        up = s.inflation * fix.sigma_up_m if fix.sigma_up_m > 0.0 else s.up_factor * guess
        return max(sigma, s.least_sigma_m), max(up, s.least_sigma_m)
