"""What the inertial samples themselves show of their errors: the floor of their spectrum, and how much they move.

White noise is in every band alike, so it cannot exceed what the quietest band shows. What stands above that floor is
motion, at low frequencies, or vibration, at high ones: neither is noise. Vibration integrates to nothing over a frame,
and a rule that takes it for white noise (the spread of second differences, say) is an order of magnitude too large on
a flying machine. The floor is a density as `ImuNoise` has it (Welch, "The use of fast Fourier transform for the
estimation of power spectra", IEEE Trans. Audio Electroacoust. 1967).

Errors of scale factor and misalignment are no noise either, but grow with motion: a relative error s of a signal of
variance v, most of it near the frequency f at which bodies move, has the density s^2 v / (2 f) there.
"""

from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import AS_MODELLED, Array, ImuSample, NoiseScale

_WINDOW_S, _HOP_S = 1.0, 0.5  # resolves 2 Hz; half a second is short against how long a ride or a rest lasts
_MOST_SAMPLES = 8192  # in a window, whatever rate is given: no IMU is faster
_AVERAGED = 4  # windows; alone, the quietest band of a window is 20 % quieter than the noise, by chance
_LOWEST_HZ = 3.0  # below, even slow machines move
_HIGHEST_SHARE = 0.25  # of the rate; above, the low-pass filters of sensors take noise out that is there lower down
_MOTION_HZ = 1.0  # where bodies that people, wheels and rotors move have most of their motion
_CHANCE = 1.08  # how much the quietest of the averaged bands is below a flat spectrum, by simulation
_SHAKEN = 10.0  # times the data sheet: usual in flight and on wheels
_CHANGED = 1.25  # a scale that moved by less is the same
_LONGEST_STEP = 2.5  # sample intervals; more is a hole
_KEPT_S = 60.0  # of levels, for spans that are cut later; longer than any buffer


@dataclass(frozen=True, slots=True)
class NoiseRatios:
    """White noise seen over white noise of the model, in the quietest window and in the median one."""

    gyro_quiet: float
    accel_quiet: float
    gyro_typical: float
    accel_typical: float


@dataclass(frozen=True, slots=True)
class SeenNoise:
    """White noise since a time."""

    t_ns: int
    scale: NoiseScale


class NoiseFloor:
    """Owns the spectrum of the last seconds and the noise level that it showed so far.

    The scale that estimators use never falls below the model: a low-pass filter inside the sensor makes it look
    quieter than it is.

    Attributes:
        now: the scale since when, in steps of a quarter at least, so that a level that hovers is no change.
    """

    def __init__(self, noise: ImuNoise) -> None:
        """Take the model to compare with."""
        self._model = noise
        self._size = min(max(round(_WINDOW_S * noise.rate_hz), 8), _MOST_SAMPLES)
        self._hop = max(self._size // 2, 4)
        self._taper = np.hanning(self._size + 2)[1:-1]
        self._ramp = np.arange(self._size) - 0.5 * (self._size - 1)
        self._bands = _bands(self._size, noise.rate_hz)
        self._longest_step_ns = round(_LONGEST_STEP * 1e9 / noise.rate_hz)
        self._rows = np.empty((self._size, 6))
        self._times: NDArray[np.int64] = np.empty(self._size, dtype=np.int64)
        self._filled = 0
        self._spectra: deque[Array] = deque(maxlen=_AVERAGED)  # [bands, 2] variance density of gyro and accel
        self._scale_sigmas = np.array([noise.gyroscope_scale_sigma or 0.0, noise.accelerometer_scale_sigma or 0.0])
        self._motions: deque[Array] = deque(maxlen=_AVERAGED)  # [2] variance of rates and forces in a window
        self._floors: list[tuple[float, float]] = []  # density of gyro and accel over the model's, per window
        self.now = SeenNoise(0, AS_MODELLED)
        self._given: deque[SeenNoise] = deque([self.now])

    def add(self, sample: ImuSample) -> bool:
        """Take a sample and return whether the scale changed with it; a hole begins a new window."""
        if self._filled and sample.t_ns - int(self._times[self._filled - 1]) > self._longest_step_ns:
            self._filled = 0
            self._spectra.clear()
            self._motions.clear()
        row = self._rows[self._filled]
        row[:3], row[3:] = sample.gyro_rad_s, sample.accel_m_s2
        self._times[self._filled] = sample.t_ns
        self._filled += 1
        if self._filled < self._size or not len(self._bands):
            self._filled %= self._size
            return False
        self._take_window()
        left = self._size - self._hop
        self._rows[:left], self._times[:left] = self._rows[self._hop :].copy(), self._times[self._hop :].copy()
        self._filled = left
        return self._follow(int(self._times[left - 1]))

    def between(self, t0_ns: int, t1_ns: int) -> NoiseScale:
        """Return the scale over a span of time: the root mean square of what was given out."""
        begins = [seen.t_ns for seen in self._given]
        ends = [*begins[1:], t1_ns]
        lengths = [max(min(e, t1_ns) - max(b, t0_ns), 0) for b, e in zip(begins, ends, strict=True)]
        if sum(lengths) == 0:
            return self._given[0].scale
        squares = np.average([np.square(seen.scale) for seen in self._given], axis=0, weights=lengths)
        gyro, accel = np.sqrt(squares).tolist()
        return NoiseScale(gyro, accel)

    @property
    def ratios(self) -> NoiseRatios | None:
        """Return how the recording compares with the model; None before the first whole window."""
        if not self._floors:
            return None
        seen = np.array(self._floors)
        quiet, typical = seen.min(axis=0), np.median(seen, axis=0)
        return NoiseRatios(float(quiet[0]), float(quiet[1]), float(typical[0]), float(typical[1]))

    def summary(self) -> dict[str, dict[str, float]]:
        """Return the white noise densities that were given and those that the run showed, by sensor; empty before."""
        ratios = self.ratios
        if ratios is None:
            return {}
        model, now = self._model, self.now.scale
        gyro = model.gyroscope_noise_density, ratios.gyro_quiet, ratios.gyro_typical, now.gyro
        accel = model.accelerometer_noise_density, ratios.accel_quiet, ratios.accel_typical, now.accel
        return {
            name: {"told": given, "quietest": given * quiet, "typical": given * typical, "used_last": given * last}
            for name, (given, quiet, typical, last) in (("gyro", gyro), ("accel", accel))
        }

    def at_least_seen(self) -> ImuNoise:
        """Return the model, its densities raised to what the median window shows; never lowered."""
        ratios = self.ratios
        if ratios is None:
            return self._model
        return replace(
            self._model,
            gyroscope_noise_density=self._model.gyroscope_noise_density * max(1.0, ratios.gyro_typical),
            accelerometer_noise_density=self._model.accelerometer_noise_density * max(1.0, ratios.accel_typical),
        )

    def warnings(self, tolerance: float) -> list[str]:
        """Return what a user should know: a model that is `tolerance` times too large, or small beyond all vibration.

        A machine that shakes has ten times the noise of a data sheet, and estimators use it: that is no fault.
        """
        ratios = self.ratios
        if ratios is None:
            return []
        found = []
        for name, quiet, density in (
            ("gyroscope", ratios.gyro_quiet, self._model.gyroscope_noise_density),
            ("accelerometer", ratios.accel_quiet, self._model.accelerometer_noise_density),
        ):
            if quiet > _SHAKEN * tolerance:
                found.append(
                    f"{name} noise: even the quietest second has {quiet:.0f} times the model's {density:.2g}; check "
                    f"the unit of the sensor and how it is mounted, or set --imu.{name}-noise-density "
                    f"{density * quiet:.2g}"
                )
            elif quiet < 1.0 / tolerance:
                found.append(
                    f"{name} noise: a second has only {quiet:.2f} times the model's {density:.2g}; unless the "
                    f"sensor filters strongly, the model is too large: set --imu.{name}-noise-density "
                    f"{density * quiet:.2g}"
                )
        return found

    def _take_window(self) -> None:
        """Add the spectrum of the window that is full: detrended, tapered, averaged over axes and bands."""
        rows = self._rows - self._rows.mean(axis=0)
        self._motions.append(np.array([np.mean(self._rows[:, :3] ** 2), np.mean(rows[:, 3:] ** 2)]))
        rows -= np.outer(self._ramp, self._ramp @ rows / (self._ramp @ self._ramp))
        rate_hz = (self._size - 1) * 1e9 / float(self._times[-1] - self._times[0])
        power = np.abs(np.fft.rfft(rows * self._taper[:, None], axis=0)) ** 2 / (rate_hz * (self._taper**2).sum())
        self._spectra.append(np.array([[power[b, :3].mean(), power[b, 3:].mean()] for b in self._bands]))

    def _follow(self, newest_t_ns: int) -> bool:
        """Return whether the floor, as the last windows or the newest alone show it, has changed."""
        quietest = np.maximum(np.mean(self._spectra, axis=0).min(axis=0), self._spectra[-1].min(axis=0))
        model = np.maximum(
            [self._model.gyroscope_noise_density, self._model.accelerometer_noise_density], np.finfo(float).tiny
        )
        gyro, accel = (_CHANCE * np.sqrt(quietest) / model).tolist()
        self._floors.append((gyro, accel))
        by_motion = self._scale_sigmas**2 * np.mean(self._motions, axis=0) / (2.0 * _MOTION_HZ) / model**2
        gyro, accel = np.sqrt(np.maximum([gyro, accel], 1.0) ** 2 + by_motion).tolist()
        old = self.now.scale
        scale = NoiseScale(_followed(old.gyro, gyro), _followed(old.accel, accel))
        if scale == old:
            return False
        is_first = len(self._floors) == 1  # it also holds for what was before
        self.now = SeenNoise(0 if is_first else newest_t_ns - round(_HOP_S * 1e9), scale)
        self._given.append(self.now)
        while len(self._given) > 1 and newest_t_ns - self._given[1].t_ns > _KEPT_S * 1e9:
            self._given.popleft()
        return True


def _bands(size: int, rate_hz: float) -> list[NDArray[np.bool_]]:
    """Return the half-octaves in which noise is looked for, as masks over the frequencies of a window."""
    highest_hz = _HIGHEST_SHARE * rate_hz
    count = int(np.floor(2.0 * np.log2(max(highest_hz / _LOWEST_HZ, 1.0))))
    frequencies = np.fft.rfftfreq(size, 1.0 / rate_hz)
    edges: Array = np.geomspace(_LOWEST_HZ, max(highest_hz, _LOWEST_HZ), count + 1)
    masks = [(frequencies >= low) & (frequencies < high) for low, high in pairwise(edges)]
    return [mask for mask in masks if mask.any()]


def _followed(old: float, new: float) -> float:
    return old if 1.0 / _CHANGED < new / old < _CHANGED else new
