"""Positions in a local level frame: GNSS turned into east, north, up, a total station, ultrasound."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.config.ranges import NonNegative, Positive
from vislam.config.sensors import Vector3
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.alignment import aligned_frame, with_shared_errors, with_starts
from vislam.sensors.body import BodyState
from vislam.sensors.measuring_frame import (
    FrameKind,
    frame_variables,
    lever_point,
    placed,
    thinned_pairs,
    vector_variables,
)
from vislam.sensors.sensor import Begun, Configured, noisy


@dataclass(frozen=True, slots=True)
class PositionSettings:
    """Settings of `position`."""

    sigma_m: Positive = 1.5  # per horizontal axis, where the device states none: one frequency under an open sky
    sigma_up_m: Positive = 3.0
    frame: FrameKind = "own"  # "known": positions are in the world already
    lever_m: Vector3 = (0.0, 0.0, 0.0)  # of the antenna in the body
    lever_sigma_m: NonNegative = 0.0  # above 0 it is estimated


class Position(Configured):
    """A point of the body, in a frame whose heading and origin against the world are estimated."""

    Settings = PositionSettings
    columns = ("east_m", "north_m", "up_m")
    sigma_columns = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
    touches = ("rotation", "position")
    gives_fixes = True

    def __init__(self, settings: PositionSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        self.settings = settings or PositionSettings()
        frame = frame_variables(self.settings.frame)
        lever = vector_variables("lever", self.settings.lever_m, self.settings.lever_sigma_m)
        self.variables = frame + lever
        self._frame = len(frame)
        self._lever_m: Array = np.array(self.settings.lever_m, dtype=np.float64)

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted position [3] in the measuring frame."""
        return values - lever_point(body, own[: self._frame], self._lever(own))

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [3, 15] and H_own [3, V]."""
        found = placed(body, own[: self._frame], self._lever(own))
        lever = found.by_lever if len(own) > self._frame else np.zeros((3, 0))
        return found.H, np.hstack([found.by_frame, lever])

    def noise(self, values: Array) -> Array:
        """Return the covariance [3, 3] of a fix that brings none."""
        return np.diag([self.settings.sigma_m**2, self.settings.sigma_m**2, self.settings.sigma_up_m**2])

    def begin(self, readings: Sequence[Reading], bodies: Sequence[BodyState]) -> Begun | None:
        """Return the frame once the body has moved enough for its heading."""
        if not self._frame:
            return super().begin(readings, bodies)
        readings, bodies = thinned_pairs(readings, bodies)
        if not readings:
            return None
        world = np.array([body.position_m + body.R_world_body @ self._lever_m for body in bodies])
        covariances = [self.noise(r.values) if r.covariance is None else r.covariance for r in readings]
        variances = np.array([[0.5 * (c[0, 0] + c[1, 1]), c[2, 2]] for c in covariances])
        variances += self.settings.lever_sigma_m**2
        values = np.array([r.values for r in readings])
        found = with_starts(aligned_frame(world, values, variances), self.variables)
        if found is None:
            return None
        H_own = np.vstack([self.jacobians(r.values, b, found.values)[1] for r, b in zip(readings, bodies, strict=True)])
        noise = np.sqrt(variances[:, [0, 0, 1]]).ravel()
        return with_shared_errors(found, range(self._frame), self.variables, H_own, noise)

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return a fix of a true body."""
        exact = lever_point(body, own[: self._frame], self._lever(own))
        return noisy(exact, self.noise(exact), rng)

    def _lever(self, own: Array) -> Array:
        return own[self._frame :] if len(own) > self._frame else self._lever_m
