"""Sensors that a configuration file can name: made from settings, and able to draw readings of themselves."""

from typing import Any, ClassVar

import numpy as np

from vislam.core.errors import UsageError
from vislam.core.messages import Array
from vislam.sensors.body import BodyState
from vislam.sensors.sensor import Sensor


class Configured(Sensor):
    """A sensor with a dataclass of settings, whose fields are the keys of its table in a configuration file.

    Attributes:
        Settings: that dataclass; ranges of its numbers stand in their types (`vislam.config.ranges`).
        sigma_columns: of a file, one name for each number of the residual; a name may come several times. Where a file
            has them all, its rows bring their own covariance. Empty: a file cannot.
    """

    Settings: ClassVar[type[Any]]
    sigma_columns: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: Any = None) -> None:
        """Take settings; the defaults without any."""

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return the values [C] of a reading of a true body at true own variables [V], with the noise of `noise`."""
        raise UsageError(f"{type(self).__name__} cannot draw readings; give it a method `draw(body, own, rng)`")

    def about(self, path_m: Array, own: Array) -> Array:
        """Return own variables [V], drawn by their sigmas, as they can be where a true path [N, 3] is measured.

        Override it where that is not anywhere: a radio hears its anchors only among them.
        """
        return own


def noisy(exact: Array, covariance: Array, rng: np.random.Generator) -> Array:
    """Return numbers [m] with noise of a covariance [m, m] added."""
    return exact + np.linalg.cholesky(covariance) @ rng.normal(size=len(exact))
