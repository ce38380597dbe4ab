"""What a sensor has to say of itself: the one definition that every estimator uses."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vislam.core.errors import UsageError
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.body import BodyState

USER_ERRORS = (Exception, SystemExit)  # whatever a sensor's own code raises, or ends with: the run goes on


class Variable(NamedTuple):
    """One number that is estimated beside the body: a lever arm, a scale, an offset, a coordinate of a frame."""

    name: str  # with its unit
    sigma: float  # of what is known before the first reading
    start: float = 0.0
    walk: float = 0.0  # per square root of a second; 0: it does not change
    of_machine: bool = True  # another run finds the same; False: it is of one run's world, as the heading of a frame
    correlation_s: float = 0.0  # above 0: it forgets all but 1/e in this, and differs by `sigma` from `start`

    @property
    def changes(self) -> bool:
        """Whether time changes it."""
        return self.walk > 0.0 or self.correlation_s > 0.0

    def after(self, dt_s: float) -> tuple[float, float]:
        """Return which part of its distance from `start` is left after a time, and the variance that came meanwhile."""
        if self.correlation_s > 0.0:
            decay = math.exp(-max(dt_s, 0.0) / self.correlation_s)
            return decay, self.sigma**2 * (1.0 - decay**2)
        return 1.0, self.walk**2 * max(dt_s, 0.0)


class Begun(NamedTuple):
    """First values of the own variables, good enough to linearise at."""

    values: Array  # [V]
    sigmas: Array  # [V]


class Sensor(ABC):
    """One kind of measurement. A subclass holds settings only: the same reading gives the same answer, always.

    Attributes:
        columns: what the values of a reading are, with units; also the columns of its file.
        touches: the parts of the body's state that show in it: "rotation", "position", "velocity", "gyro_bias",
            "accel_bias". Numerical derivatives are taken by these only.
        sees_motion_only: neither place nor heading nor a frame of its own shows in it, as with wheels: the same motion
            elsewhere gives the same reading. Then the sliding window takes it, too, where the camera is blind.
        gives_fixes: its values are a point [3] in metres, in axes that stay: so they show motion from the first on.
        variables: own ones, estimated with the body's state by every estimator; each has its own values.
        sources: all that `channel` may return.
        gate_probability: that a good reading passes the test of its innovation.
        regain_m: how far readings that the gate refused, but that agree, may move a filter at most; 0: never.
        slips: the columns that a slip of wheels makes larger; a sensor that has some is watched for slips.
        from_magnetometer: its readings are the samples of the machine's own magnetometer, as they come with the IMU's.
    """

    columns: ClassVar[tuple[str, ...]] = ()
    touches: ClassVar[tuple[str, ...]] = ("rotation", "position", "velocity")
    sees_motion_only: ClassVar[bool] = False
    gives_fixes: ClassVar[bool] = False
    slips: ClassVar[tuple[str, ...]] = ()
    variables: tuple[Variable, ...] = ()
    sources: tuple[int, ...] = (0,)
    gate_probability: float = 0.999
    regain_m: float = 1000.0
    from_magnetometer: bool = False

    @abstractmethod
    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted [m].

        Args:
            values: [C] of the reading.
            body: at its time.
            own: [V] the own variables, in the order of `variables`.
        """

    @abstractmethod
    def noise(self, values: Array) -> Array:
        """Return the covariance [m, m] of the residual of a reading, where the device states none."""

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array] | None:
        """Return what the residual hangs on: H [m, 15] and H_own [m, V] with `residual ~ H @ error + H_own @ error`.

        That is minus the derivative of the residual by the estimate. None: derived numerically.
        """
        return None

    def begin(self, readings: Sequence[Reading], bodies: Sequence[BodyState]) -> Begun | None:
        """Return first values of the own variables from all readings so far, and the body at each; None: too early.

        Override it where the variables' start is too far from the truth for one linear step, as the heading of a frame.
        """
        return Begun(
            np.array([variable.start for variable in self.variables], dtype=np.float64),
            np.array([variable.sigma for variable in self.variables], dtype=np.float64),
        )

    def channel(self, values: Array) -> int:
        """Return which of several things a reading measured; two of one thing and one stamp are a mistake."""
        return 0

    def check(self, values: Array) -> str:
        """Return why values [C] that are finite cannot be a reading; empty: they can."""
        return ""


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
