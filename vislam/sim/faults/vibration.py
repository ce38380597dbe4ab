"""Vibration as a fault: what a real IMU showed above the motion of its body, in the samples of another recording.

Rotors and wheels shake an IMU at tens of hertz and more. No model of white noise describes that, and a recording at
rest or in the hand does not have it.
"""

from collections.abc import Iterator
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, filtfilt, resample_poly

from vislam.core.errors import DataError
from vislam.core.messages import Array, Frame, ImuSample, MagSample
from vislam.core.recording import Recording, WrappedRecording

_ORDER = 4  # of the Butterworth filter, run to and fro: no phase
_MARGIN_S = 1.0  # that is filtered with the window, so that its ends are not those of the filter
_MIN_WINDOW_S = 1.0
_MAX_GAP_PERIODS = 2.5  # between two samples of a filter that takes them as evenly spaced


class Vibration:
    """Gyro and accelerometer readings (rad/s, m/s²) of what shakes a body, evenly spaced in time."""

    def __init__(
        self, t_ns: NDArray[np.int64], values: Array, begin_s: float, length_s: float | None, above_hz: float
    ) -> None:
        """Take what samples [N, 6] at times [N] show above a frequency, from `begin_s` on; without a length to the end.

        Raises DataError when the window is shorter than a second, has a gap, or the samples are too slow.
        """
        since_s = (t_ns - t_ns[0]) * 1e-9 if len(t_ns) else np.empty(0)
        end_s = begin_s + (np.inf if length_s is None else length_s)
        near = (since_s >= begin_s - _MARGIN_S) & (since_s <= end_s + _MARGIN_S)
        kept_s = since_s[near]
        window = (kept_s >= begin_s) & (kept_s <= end_s)
        length = float(np.ptp(kept_s[window])) if window.any() else 0.0
        if length < _MIN_WINDOW_S:
            lasts_s = float(since_s[-1]) if len(since_s) else 0.0
            raise DataError(f"vibration from {begin_s:g} s on lasts {length:.1f} s of a recording of {lasts_s:.1f} s")
        period_s = float(np.median(np.diff(kept_s)))
        if np.diff(kept_s).max() > _MAX_GAP_PERIODS * period_s:
            at_s = kept_s[int(np.argmax(np.diff(kept_s)))]
            raise DataError(f"samples of the vibration have a gap at {at_s:.2f} s; choose another window")
        self.rate_hz = 1.0 / period_s
        if above_hz >= 0.5 * self.rate_hz:
            raise DataError(f"{self.rate_hz:.0f} samples a second hold nothing above {above_hz:g} Hz")
        b, a = butter(_ORDER, above_hz, "high", fs=self.rate_hz)
        self._values = np.asarray(filtfilt(b, a, values[near], axis=0)[window])

    def at_rate(self, rate_hz: float) -> Array:
        """Return the readings [M, 6] at `rate_hz` a second."""
        ratio = Fraction(rate_hz / self.rate_hz).limit_denominator(200)
        if ratio == 1:
            return self._values
        return np.asarray(resample_poly(self._values, ratio.numerator, ratio.denominator, axis=0))


class ShakenRecording(WrappedRecording):
    """A recording (see `vislam.core.recording.Recording`) whose inertial samples also hold a vibration, to and fro."""

    def __init__(self, recording: Recording, vibration: Vibration, gain: float) -> None:
        """Wrap a recording; its nth sample gets the nth reading, times the gain."""
        super().__init__(recording)
        rate_hz = 0.0 if recording.imu_noise is None else recording.imu_noise.rate_hz
        readings = gain * vibration.at_rate(rate_hz or vibration.rate_hz)
        self._readings = np.concatenate([readings, readings[-2:0:-1]])  # and back: no jump where it begins again

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield the recording's values."""
        count = 0
        for value in self._recording.events(from_ns):
            if isinstance(value, ImuSample):
                shaken = self._readings[count % len(self._readings)]
                count += 1
                yield ImuSample(value.t_ns, value.gyro_rad_s + shaken[:3], value.accel_m_s2 + shaken[3:])
            else:
                yield value
