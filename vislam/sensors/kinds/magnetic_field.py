"""The magnetometer of the machine: the direction of a field that is the same wherever the body goes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.config.ranges import NonNegative, Positive
from vislam.config.sensors import Vector3
from vislam.core.geometry import skew
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.body import BodyState
from vislam.sensors.sensor import Begun, Configured, Variable, noisy

_MOST_UT = 1000.0  # the earth's field has 25 to 65; a motor's magnet close by has a thousand
_LEAST_UT = 2.0


@dataclass(frozen=True, slots=True)
class MagneticFieldSettings:
    """Settings of `magnetic_field`."""

    # noise, and what iron in the building adds to one reading as independent of the next, per axis; a chip has 0.2 to 1
    sigma_ut: Positive = 5.0
    field_ut: Vector3 = (0.0, 0.0, 0.0)  # in the world; (0, 0, 0): as the first reading has it
    field_sigma_ut: Positive = 60.0
    field_walk_ut_per_sqrt_s: NonNegative = 0.0  # the field of a building changes along the way
    bias_sigma_ut: NonNegative = 0.0  # above 0 what calibration left of the body's own iron is estimated


class MagneticField(Configured):
    """The field in the body's axes: one vector of the world, which is estimated, and what the body's own iron adds.

    The world's heading is arbitrary, so the field's direction is not given but found; from then on it holds heading.
    """

    Settings = MagneticFieldSettings
    columns = ("field_x_ut", "field_y_ut", "field_z_ut")
    sigma_columns = ("sigma_field_ut",) * 3
    touches = ("rotation",)
    from_magnetometer = True

    def __init__(self, settings: MagneticFieldSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        self.settings = s = settings or MagneticFieldSettings()
        self.variables = tuple(
            Variable(f"field_{axis}_ut", s.field_sigma_ut, start, s.field_walk_ut_per_sqrt_s, of_machine=False)
            for axis, start in zip("xyz", s.field_ut, strict=True)
        )
        if s.bias_sigma_ut > 0.0:
            self.variables += tuple(Variable(f"bias_{axis}_ut", s.bias_sigma_ut) for axis in "xyz")

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted field [3], uT, in the body's axes."""
        return values - self._predicted(body, own)

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [3, 15] and H_own [3, 3 or 6]."""
        H = np.zeros((3, 15))
        H[:, :3] = skew(body.R_world_body.T @ own[:3])
        return H, np.hstack([body.R_world_body.T, np.eye(3)[:, : len(own) - 3]])

    def noise(self, values: Array) -> Array:
        """Return the covariance [3, 3], uT^2."""
        return self.settings.sigma_ut**2 * np.eye(3)

    def begin(self, readings: Sequence[Reading], bodies: Sequence[BodyState]) -> Begun | None:
        """Return the field as the first reading has it where none is given, and as little known as before.

        It is only where to be linear: at a field of zero a reading would not tie heading and field together.
        """
        begun = super().begin(readings, bodies)
        if begun is None or not readings or any(self.settings.field_ut):
            return begun
        values = begun.values.copy()
        values[:3] = bodies[0].R_world_body @ readings[0].values
        return Begun(values, begun.sigmas)

    def check(self, values: Array) -> str:
        """Return why a field is none: a disconnected chip gives zeros, and other units other sizes."""
        size_ut = float(np.linalg.norm(values))
        if _LEAST_UT <= size_ut <= _MOST_UT:
            return ""
        return f"a field of {size_ut:.3g} uT, {_LEAST_UT:g} to {_MOST_UT:g} asked; gauss (100 uT) or nT?"

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return the field at a true body."""
        exact = self._predicted(body, own)
        return noisy(exact, self.noise(exact), rng)

    def _predicted(self, body: BodyState, own: Array) -> Array:
        field = body.R_world_body.T @ own[:3]
        return field + own[3:] if len(own) > 3 else field
