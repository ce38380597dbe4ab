"""Heights, as a barometer measures them: good from minute to minute, with an offset that walks with the weather."""

from dataclasses import dataclass

import numpy as np

from vislam.config.ranges import Finite, NonNegative, Positive
from vislam.config.sensors import Vector3
from vislam.core.geometry import skew
from vislam.core.messages import Array
from vislam.sensors.body import PARTS, BodyState
from vislam.sensors.measuring_frame import ANYWHERE_M
from vislam.sensors.sensor import Configured, Variable, noisy


@dataclass(frozen=True, slots=True)
class HeightSettings:
    """Settings of `height`."""

    sigma_m: Positive = 0.3  # from reading to reading: 3 Pa
    offset_m: Finite = 0.0  # height that is measured at the world's origin
    offset_sigma_m: Positive = ANYWHERE_M
    offset_walk_m_per_sqrt_s: NonNegative = 0.01  # 0.6 m in an hour of changing weather
    lever_m: Vector3 = (0.0, 0.0, 0.0)  # of the sensor in the body


class Height(Configured):
    """The height of a point of the body above a level that is estimated."""

    Settings = HeightSettings
    columns = ("height_m",)
    sigma_columns = ("sigma_height_m",)
    touches = ("rotation", "position")

    def __init__(self, settings: HeightSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        self.settings = s = settings or HeightSettings()
        walk = s.offset_walk_m_per_sqrt_s
        self.variables = (Variable("offset_m", s.offset_sigma_m, s.offset_m, walk, of_machine=False),)
        self._lever_m: Array = np.array(s.lever_m, dtype=np.float64)

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted height [1]."""
        return values - self._predicted(body, own)

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [1, 15] and H_own [1, 1]."""
        H = np.zeros((1, 15))
        H[0, PARTS["rotation"]] = -body.R_world_body[2] @ skew(self._lever_m)
        H[0, 5] = 1.0
        return H, np.ones((1, 1))

    def noise(self, values: Array) -> Array:
        """Return the variance [1, 1]."""
        return np.array([[self.settings.sigma_m**2]])

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return a height of a true body."""
        exact = self._predicted(body, own)
        return noisy(exact, self.noise(exact), rng)

    def _predicted(self, body: BodyState, own: Array) -> Array:
        return np.array([body.position_m[2] + body.R_world_body[2] @ self._lever_m + own[0]])
