"""From the values of a chip to the calibrated body frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vislam.config import Axes, Matrix3, Vector3
from vislam.core.errors import HardwareError
from vislam.core.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class Affine:
    """From counts or chip units to calibrated body axes: `matrix @ value + offset`."""

    matrix: Array  # [3, 3]
    offset: Array  # [3]

    def __call__(self, value: Any) -> Array:
        """Return what a value [3] is in body axes."""
        return self.matrix @ np.asarray(value, dtype=np.float64) + self.offset

    @staticmethod
    def of(axes: Axes, matrix: Matrix3, bias: Vector3, unit: float) -> Affine:
        """Return the map from a chip's values of `unit` each; see `config.SensorCalibration`.

        Raises HardwareError if the axes name one axis of the chip twice.
        """
        turned = np.zeros((3, 3))
        for row, axis in enumerate(axes):
            turned[row, "xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
        if abs(np.linalg.det(turned)) < 0.5:
            raise HardwareError(f"axes {axes} name an axis of the chip twice; each of x, y, z is needed once")
        left = np.array(matrix)
        return Affine(left @ turned * unit, -left @ np.array(bias))
