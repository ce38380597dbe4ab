"""Gyro biases by temperature, kept from one power-up to the next."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.errors import DataError
from vislam.core.files import write_text
from vislam.core.messages import Array
from vislam.core.reading import read_json

_MAX_BYTES = 100_000
_MAX_RATE_RAD_S = 10.0
_MIN_SPAN_C = 5.0  # a slope over less is noise
_NEAR_C = 3.0  # without a slope, a bias is good for temperatures this near
_TEMPERATURE_RANGE_C = (-60.0, 150.0)


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
