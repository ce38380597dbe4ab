"""From the values of a chip to the calibrated body frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vislam.config import Axes, Matrix3, Vector3
from vislam.core.errors import HardwareError
from vislam.core.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class Affine:
    """From counts or chip units to calibrated body axes: `matrix @ value + offset`."""

    matrix: Array  # [3, 3]
    offset: Array  # [3]

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
