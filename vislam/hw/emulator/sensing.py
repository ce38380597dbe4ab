"""What a virtual chip measures: the truth in its own axes, with the errors of a real one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vislam.core.messages import Array

Triple = tuple[float, float, float]
# t_ns -> rate (rad/s), specific force (m/s^2), field (uT), all [3] in the body frame, and temperature in deg C
Truth = Callable[[int], tuple[Sequence[float], Sequence[float], Sequence[float], float]]

_REFERENCE_C = 25.0
_CHUNK = 512  # random numbers drawn at once


@dataclass(frozen=True, slots=True)
class SensorError:
    """Errors of one chip; axes are the chip's, units those of the quantity (rad/s, m/s^2 or uT).

    The chip's axes are given by the body's: `axes` ("-y", "x", "z") means that body x is the chip's -y, and so on, as
    in `config.SensorCalibration`.
    """

    axes: tuple[str, str, str] = ("x", "y", "z")
    bias: Triple = (0.0, 0.0, 0.0)
    scale: Triple = (1.0, 1.0, 1.0)
    misalignment_rad: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # xy xz yx yz ..
    density: Triple = (0.0, 0.0, 0.0)  # white noise, per sqrt(Hz)
    walk: float = 0.0  # of the bias, per sqrt(s)
    bias_per_c: Triple = (0.0, 0.0, 0.0)  # from 25 deg C
    rate_error: float = 0.0  # of the chip's own clock, relative

    def matrix(self) -> Array:
        """Return the matrix [3, 3] from body axes to what the chip shows, without bias."""
        turned = np.zeros((3, 3))
        for body, axis in enumerate(self.axes):
            turned["xyz".index(axis[-1]), body] = -1.0 if axis.startswith("-") else 1.0
        xy, xz, yx, yz, zx, zy = self.misalignment_rad
        skewed = np.array([[1.0, xy, xz], [yx, 1.0, yz], [zx, zy, 1.0]])
        return np.asarray(np.diag(self.scale) @ skewed @ turned)

    @staticmethod
    def drawn(
        rng: np.random.Generator,
        bias: float,
        scale: float = 0.0,
        misalignment_rad: float = 0.0,
        density: Triple = (0.0, 0.0, 0.0),
        walk: float = 0.0,
        bias_per_c: float = 0.0,
        axes: tuple[str, str, str] = ("x", "y", "z"),
        rate_error: float = 0.0,
    ) -> SensorError:
        """Return a chip drawn from these standard deviations."""

        def triple(centre: float, sigma: float) -> Triple:
            x, y, z = (centre + sigma * rng.standard_normal(3)).tolist()
            return x, y, z

        a, b = triple(0.0, misalignment_rad), triple(0.0, misalignment_rad)
        return SensorError(
            axes, triple(0.0, bias), triple(1.0, scale), (*a, *b), density, walk, triple(0.0, bias_per_c), rate_error
        )


IDEAL = SensorError()


class Sensing:
    """Owns noise and bias of one chip; plain floats, so that 400 samples a second cost next to nothing."""

    def __init__(self, error: SensorError, seed: int) -> None:
        """Take the errors; same seed, same noise."""
        self._error, self.scale = error, error.scale
        self._rows = [tuple(row) for row in error.matrix().tolist()]
        self._bias = list(error.bias)
        self._rng = np.random.default_rng(seed)
        self._normals: list[list[float]] = []
        self._filtered = [0.0, 0.0, 0.0]
        self._last_ns: int | None = None

    def __call__(self, value: Sequence[float], t_ns: int, temperature_c: float, bandwidth_hz: float) -> Triple:
        """Return what the chip shows of a value [3] of the body frame; times of calls must not go back.

        Noise is white up to a bandwidth (first order), so that its density does not depend on how often it is read.
        """
        a, b, c = value[0], value[1], value[2]
        error, bias, filtered = self._error, self._bias, self._filtered
        elapsed_s = 1.0 if self._last_ns is None else max(t_ns - self._last_ns, 0) * 1e-9
        self._last_ns = t_ns
        kept = math.exp(-2.0 * math.pi * bandwidth_hz * elapsed_s)
        gain = math.sqrt((1.0 - kept * kept) * bandwidth_hz * math.pi / 2.0)
        walk = error.walk * math.sqrt(elapsed_s)
        warm = temperature_c - _REFERENCE_C
        if not self._normals:
            self._normals = self._rng.standard_normal((_CHUNK, 6)).tolist()
        normal = self._normals.pop()
        shown = []
        for i, (x, y, z) in enumerate(self._rows):
            filtered[i] = kept * filtered[i] + gain * error.density[i] * normal[i]
            bias[i] += walk * normal[3 + i]
            shown.append(x * a + y * b + z * c + bias[i] + error.bias_per_c[i] * warm + filtered[i])
        return shown[0], shown[1], shown[2]


def quantised(value: Triple, lsb: float, low: int, high: int) -> tuple[int, int, int]:
    """Return counts of `lsb` per unit, clipped."""
    x, y, z = value
    return (
        min(max(round(x * lsb), low), high),
        min(max(round(y * lsb), low), high),
        min(max(round(z * lsb), low), high),
    )
