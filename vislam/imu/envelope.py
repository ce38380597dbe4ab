"""What the inertial samples themselves say about their noise, against the model that came with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vislam.imu.noise import ImuNoise
from vislam.messages import Array, ImuSample

_WINDOW_S = 0.5  # long enough for 5 % accuracy at 100 Hz, short enough to fall between two movements
_SLACK, _STEP = 1.25, 1.5  # of a level over the model that is chance, and between two levels
_MIN_SAMPLES = 20  # in a window; fewer say too little


@dataclass(frozen=True, slots=True)
class NoiseRatios:
    """White noise seen over white noise of the model, in the quietest window and in the median one."""

    gyro_quiet: float
    accel_quiet: float
    gyro_typical: float
    accel_typical: float


@dataclass(frozen=True, slots=True)
class SeenNoise:
    """White noise since a time, as a multiple of the model's."""

    t_ns: int
    gyro: float
    accel: float


class NoiseEnvelope:
    """Owns the noise level of every half second so far.

    The second difference of samples hardly sees motion, so its spread is white noise plus vibration. The quietest
    window bounds the sensor's own noise from above (EuRoC: 0.8 to 1.2 times the data sheet's densities when the drone
    stands); the median window adds the vibration of the ride. A low-pass filter inside the sensor takes noise out of
    the second difference that is still there at low frequencies: a small ratio is a hint, a large one is a fact.
    """

    def __init__(self, noise: ImuNoise) -> None:
        """Take the model to compare with."""
        self._noise = noise
        self._per_window = max(_MIN_SAMPLES, round(_WINDOW_S * noise.rate_hz))
        self._longest_step_ns = round(2.5e9 / noise.rate_hz)
        self._pending: list[Array] = []  # [6] each
        self._last_t_ns = self._begin_ns = 0
        self._levels: list[tuple[float, float]] = []  # (gyro, accel) sigma of one sample, per window

    def add(self, sample: ImuSample) -> bool:
        """Take a sample and return whether it ended a window; a hole begins a new one."""
        if sample.t_ns - self._last_t_ns > self._longest_step_ns:
            self._pending = []
        self._last_t_ns = sample.t_ns
        if not self._pending:
            self._begin_ns = sample.t_ns
        self._pending.append(np.concatenate([sample.gyro_rad_s, sample.accel_m_s2]))
        if len(self._pending) == self._per_window:
            rms = np.sqrt(np.mean(np.diff(np.array(self._pending), n=2, axis=0) ** 2, axis=0) / 6.0)
            self._levels.append((float(rms[:3].mean()), float(rms[3:].mean())))
            self._pending = []
            return True
        return False

    @property
    def ratios(self) -> NoiseRatios | None:
        """Return how the recording compares with the model; None before the first whole window."""
        if not self._levels:
            return None
        root_rate = np.sqrt(self._noise.rate_hz)
        model = np.array([self._noise.gyro_noise_density, self._noise.accel_noise_density]) * root_rate
        seen = np.array(self._levels) / np.maximum(model, np.finfo(float).tiny)
        quiet, typical = seen.min(axis=0), np.median(seen, axis=0)
        return NoiseRatios(float(quiet[0]), float(quiet[1]), float(typical[0]), float(typical[1]))

    def newest_over(self, noise: ImuNoise, told: SeenNoise) -> SeenNoise:
        """Return the noise of the newest window since its begin, over that of a model, and never below it.

        It moves in steps of half as much again, and down by two of them or all the way, so that a level that hovers is
        no news; `told` is what it was before. Raises IndexError before the first window.
        """
        root_rate = np.sqrt(noise.rate_hz)
        model = np.array([noise.gyro_noise_density, noise.accel_noise_density]) * root_rate
        over = np.array(self._levels[-1]) / np.maximum(model, np.finfo(float).tiny)
        steps = np.maximum(np.ceil(np.log(np.maximum(over, 1.0) / _SLACK) / np.log(_STEP)), 0.0)
        before = np.log([told.gyro, told.accel]) / np.log(_STEP)
        gyro, accel = (_STEP ** np.where((steps > 0.5) & (np.abs(steps - before + 0.5) < 1.0), before, steps)).tolist()
        return SeenNoise(self._begin_ns, gyro, accel)

    def at_least_seen(self, tolerance: float) -> ImuNoise:
        """Return the model, its densities raised to what the quietest window shows divided by `tolerance`.

        They are never lowered: a filtered sensor only looks quiet.
        """
        ratios = self.ratios
        if ratios is None:
            return self._noise
        return replace(
            self._noise,
            gyro_noise_density=self._noise.gyro_noise_density * max(1.0, ratios.gyro_quiet / tolerance),
            accel_noise_density=self._noise.accel_noise_density * max(1.0, ratios.accel_quiet / tolerance),
        )

    def warnings(self, tolerance: float) -> list[str]:
        """Return what a user should know: a model that the recording contradicts by more than `tolerance`."""
        ratios = self.ratios
        if ratios is None:
            return []
        found = []
        for name, quiet, density in (
            ("gyroscope", ratios.gyro_quiet, self._noise.gyro_noise_density),
            ("accelerometer", ratios.accel_quiet, self._noise.accel_noise_density),
        ):
            setting = "imu.gyro-noise-density" if name == "gyroscope" else "imu.accel-noise-density"
            if quiet > tolerance:
                found.append(
                    f"{name} noise: even the quietest half second has {quiet:.1f} times the model's {density:.2g}; "
                    f"the model is too small or the ride never stops shaking; set --{setting} {density * quiet:.2g}"
                )
            elif quiet < 1.0 / tolerance:
                found.append(
                    f"{name} noise: a half second has only {quiet:.2f} times the model's {density:.2g}; unless the "
                    f"sensor filters strongly, the model is too large: set --{setting} {density * quiet:.2g}"
                )
        return found
