"""The self-calibration of the paper's cart at power-up: the current attitude is horizontal, the current rate is zero.

Karpov 2026, section 2. It is refused while the cart moves, for a wrong zero would stay wrong for the whole drive.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import PowerUpConfig
from vislam.core.angles import angle_deg
from vislam.core.errors import DataError
from vislam.core.files import write_text
from vislam.core.geometry import level_rotation
from vislam.core.messages import Array, ImuSpan
from vislam.core.reading import read_json

_MAX_BYTES = 100_000
_MAX_RATE_RAD_S = 10.0
_MIN_SPAN_C = 5.0  # a slope over less is noise
_NEAR_C = 3.0  # without a slope, a bias is good for temperatures this near
_TEMPERATURE_RANGE_C = (-60.0, 150.0)
# between the means of the window's halves: a bias stays, white noise leaves 0.0003
_MAX_TURN_RAD_S = 0.005
_MAX_GYRO_STD_RAD_S = 0.02  # per axis; an ITG3205 at 98 Hz has 0.0065, a hand on the cart gives 0.03
_MAX_ACCEL_STD_M_S2 = 0.25  # per axis; an ADXL345 at 400 Hz has 0.08
# from what was remembered for this temperature: an even turn looks like a bias
_MAX_BIAS_CHANGE_RAD_S = 0.05
_GRAVITY_TOLERANCE_M_S2 = 0.5  # of the measured norm: an accelerometer after calibration
_NS = 1e-9
_MAX_STEP_S = 0.1  # a hole in which the cart may have moved


class BiasMemory:
    """One bias [3] per degree of temperature, the newest; at most `limit` of them, the nearest to the last added."""

    def __init__(self, limit: int) -> None:
        """Start empty."""
        self._limit = limit
        self._entries: dict[int, tuple[float, Array]] = {}  # rounded temperature -> (temperature, bias)

    def __len__(self) -> int:
        """Return how many biases are kept."""
        return len(self._entries)

    def add(self, temperature_c: float, gyro_bias_rad_s: Array) -> None:
        """Remember a bias [3] in place of an older one at the same temperature."""
        self._entries[round(temperature_c)] = (temperature_c, np.asarray(gyro_bias_rad_s, dtype=np.float64))
        while len(self._entries) > self._limit:
            del self._entries[max(self._entries, key=lambda degree: abs(degree - temperature_c))]

    def at(self, temperature_c: float) -> Array | None:
        """Return the bias [3] to expect at a temperature; None when nothing near it is known."""
        line = self._line()
        if line is not None:
            mean_c, mean, slope = line
            known = [t for t, _ in self._entries.values()]
            if min(known) - _MIN_SPAN_C <= temperature_c <= max(known) + _MIN_SPAN_C:
                return mean + slope * (temperature_c - mean_c)
        near = [(abs(t - temperature_c), degree) for degree, (t, _) in self._entries.items()]
        if not near or min(near)[0] > _NEAR_C:
            return None
        return self._entries[min(near)[1]][1]

    def per_c(self) -> Array:
        """Return the change of the bias [3] per deg C; zero as long as too small a range of temperature is known."""
        line = self._line()
        return np.zeros(3) if line is None else line[2]

    def _line(self) -> tuple[float, Array, Array] | None:
        """Return mean temperature, mean bias and slope of the straight line through all that is known."""
        if len(self._entries) < 3:
            return None
        t = np.array([temperature for temperature, _ in self._entries.values()])
        b = np.array([bias for _, bias in self._entries.values()])
        if np.ptp(t) < _MIN_SPAN_C:
            return None
        centred = t - t.mean()
        return float(t.mean()), b.mean(axis=0), centred @ (b - b.mean(axis=0)) / float(centred @ centred)

    @staticmethod
    def read(path: Path, limit: int) -> BiasMemory:
        """Read a file that `write` left; a missing one is empty. Raises DataError for anything else."""
        if not path.exists():
            return BiasMemory(limit)
        try:
            entries = [_entry(item) for item in read_json(path, _MAX_BYTES)["gyro_biases"]]
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise DataError(f"{path} holds no gyro biases ({error}); delete it to begin again") from error
        memory = BiasMemory(limit)
        for temperature_c, bias in entries:
            memory.add(temperature_c, bias)
        return memory

    def write(self, path: Path) -> None:
        """Write the file atomically; raises StorageError."""
        items = [
            {"temperature_c": temperature, "gyro_bias_rad_s": bias.tolist()}
            for _, (temperature, bias) in sorted(self._entries.items())
        ]
        write_text(path, json.dumps({"gyro_biases": items}, indent=1))


def _entry(item: Any) -> tuple[float, Array]:
    temperature_c, bias = float(item["temperature_c"]), [float(value) for value in item["gyro_bias_rad_s"]]
    low, high = _TEMPERATURE_RANGE_C
    if not low < temperature_c < high:
        raise ValueError(f"temperature {temperature_c} deg C")
    if len(bias) != 3 or not all(math.isfinite(value) and abs(value) < _MAX_RATE_RAD_S for value in bias):
        raise ValueError(f"bias {bias} rad/s")
    return temperature_c, np.array(bias)


@dataclass(frozen=True, slots=True, eq=False)
class PowerUp:
    """What standing still has shown."""

    t_ns: int  # end of the window
    gyro_bias_rad_s: Array  # [3]
    gyro_bias_sigma_rad_s: Array  # [3] of white noise alone
    up_body: Array  # [3] unit vector, the direction of the measured force
    R_level_body: Array  # [3, 3] zero yaw; turns what the body measures into a frame whose z is that direction
    tilt_deg: float  # of the body against it: mounting and floor together
    force_m_s2: float  # norm; how far it is from gravity is what bias and scale of the accelerometer leave
    temperature_c: float | None


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why there is no zero: what was asked for and what was measured."""

    reason: str


def power_up(
    span: ImuSpan,
    config: PowerUpConfig,
    gravity_m_s2: float,
    temperature_c: float | None = None,
    memory: BiasMemory | None = None,
) -> PowerUp | Refusal:
    """Take the newest `config.window_s` of a span as rest, or say why they are not.

    An even turn looks like a bias; it is distinguished by what the gyro is remembered to have at this temperature.
    Horizontal is by gravity here; vision needs the tilt against the floor, which on a slope is not it.
    """
    t_s = (span.t_ns - span.t_ns[-1]) * _NS
    inside = t_s >= -config.window_s - 0.5 * _MAX_STEP_S
    t_s, gyro, accel = t_s[inside], span.gyro_rad_s[inside], span.accel_m_s2[inside]
    duration_s = float(-t_s[0])
    if duration_s < config.window_s - _MAX_STEP_S or len(t_s) < 20:
        return Refusal(f"{config.window_s:g} s of samples asked, got {duration_s:.2f} s with {len(t_s)}; wait")
    if np.diff(t_s).max() > _MAX_STEP_S:
        return Refusal(f"a hole of {np.diff(t_s).max():.2f} s in the samples, {_MAX_STEP_S:g} s allowed; check the IMU")
    rate, force = gyro.mean(axis=0), accel.mean(axis=0)
    half = len(t_s) // 2
    norm = float(np.linalg.norm(force))
    up = force / norm if norm > 0.0 else np.array([0.0, 0.0, 1.0])
    tilt_deg = angle_deg(up, np.array([0.0, 0.0, 1.0]))
    checks = [
        ("the rate varies by", gyro.std(axis=0).max(), _MAX_GYRO_STD_RAD_S, "rad/s", "stand still"),
        ("the force varies by", accel.std(axis=0).max(), _MAX_ACCEL_STD_M_S2, "m/s^2", "stand still"),
        ("the mean rate is", float(np.linalg.norm(rate)), config.max_rate_rad_s, "rad/s", "stand still"),
        (
            "the mean rate changed within the window by",
            abs(gyro[:half].mean(axis=0) - gyro[half:].mean(axis=0)).max(),
            _MAX_TURN_RAD_S,
            "rad/s",
            "stand still",
        ),
        (
            "the measured force is off gravity by",
            abs(norm - gravity_m_s2),
            _GRAVITY_TOLERANCE_M_S2,
            "m/s^2",
            "calibrate the accelerometer (vislam calibrate imu)",
        ),
        ("the body is tilted by", tilt_deg, config.max_tilt_deg, "deg", "check the axes of the IMU, or level the cart"),
    ]
    expected = None if memory is None or temperature_c is None else memory.at(temperature_c)
    if expected is not None:
        changed = float(np.linalg.norm(rate - expected))
        what = f"at {temperature_c:.0f} deg C the bias differs from the remembered one by"
        checks.append((what, changed, _MAX_BIAS_CHANGE_RAD_S, "rad/s", "stand still, or forget what is kept"))
    for what, got, allowed, unit, next_step in checks:
        if not got <= allowed:  # NaN is no rest either
            return Refusal(f"{what} {got:.3g} {unit}, {allowed:g} allowed; {next_step}")
    return PowerUp(
        t_ns=int(span.t_ns[-1]),
        gyro_bias_rad_s=rate,
        gyro_bias_sigma_rad_s=gyro.std(axis=0) / np.sqrt(len(t_s)),
        up_body=up,
        R_level_body=level_rotation(up),
        tilt_deg=tilt_deg,
        force_m_s2=norm,
        temperature_c=temperature_c,
    )
