"""The temperature at which a gyro's biases were taken, and how they go on from there."""

from dataclasses import dataclass, field

import numpy as np

from vislam.core.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class GyroZero:
    """What is known of a gyro's biases as its temperature changes."""

    temperature_c: float | None = None  # None: not known
    per_c: Array = field(default_factory=lambda: np.zeros(3))  # rad/s per deg C

    def drift_rad_s(self, now_c: float | None) -> Array:
        """Return what the biases [3] have changed by at a temperature."""
        if self.temperature_c is None or now_c is None:
            return np.zeros(3)
        return self.per_c * (now_c - self.temperature_c)

    def is_far(self, now_c: float | None, limit_c: float) -> bool:
        """Return whether a temperature is too far from the biases' own."""
        return self.temperature_c is not None and now_c is not None and abs(now_c - self.temperature_c) > limit_c
