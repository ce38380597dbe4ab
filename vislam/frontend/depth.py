"""What metric front ends need of a depth sensor: the inverse depth of pixels, with its standard deviation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, Frame


@dataclass(frozen=True, slots=True, eq=False)
class DepthReading:
    """Inverse z-depths of pixels in cam0."""

    rho: Array  # [N] in 1/m, NaN where unknown
    sigma_rho: Array  # [N] in 1/m
    right_px: Array | None = None  # [N, 2] in cam1 for stereo, NaN where not matched
    by_delay: Array | None = None  # [N] derivative of `rho` by how much later depth was taken, 1/m/s; None: zero

    @property
    def depth_m(self) -> Array:
        """Return z-depths [N], NaN where unknown or at infinity."""
        depth: Array = np.full(len(self.rho), np.nan)
        near = np.isfinite(self.rho) & (self.rho > 1e-3)
        depth[near] = 1.0 / self.rho[near]
        return depth

    def joined(self, other: DepthReading) -> DepthReading:
        """Return this reading followed by another of the same sensor."""
        right = None
        if self.right_px is not None and other.right_px is not None:
            right = np.vstack([self.right_px, other.right_px])
        rho, sigma = np.concatenate([self.rho, other.rho]), np.concatenate([self.sigma_rho, other.sigma_rho])
        return DepthReading(rho, sigma, right)

    @property
    def slope(self) -> Array:
        """Return `by_delay` [N]; NaN where it could not be measured, as at the edge of what has depth."""
        return np.zeros(len(self.rho)) if self.by_delay is None else self.by_delay


class DepthSensor(Protocol):
    """A source of inverse depth for pixels of cam0."""

    every_frame: bool  # whether measuring is cheap enough to do in every frame, not only in keyframes

    def available(self, frame: Frame) -> bool:
        """Return whether this frame carries depth at all."""
        ...

    def measure(
        self, frame: Frame, pixels: Array, xy: Array, expected_rho: Array, ids: NDArray[np.int64] | None = None
    ) -> DepthReading:
        """Measure the depth of raw pixels [N, 2] with directions `xy` [N, 2], where about `expected_rho` [N] is likely.

        NaN in `expected_rho` means that nothing is expected. `ids` [N] are the tracks that the pixels belong to: where
        a frame brings its tracks with it, only their depth is known.
        """
        ...
