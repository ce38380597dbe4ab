"""Readings of any sensor as both filters take them: refused, linearised, whitened and gated alike."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import UsageError
from vislam.core.messages import Array
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.history import Innovation, Outcome
from vislam.ekf.loose.kernels import pose
from vislam.ekf.regain import Refused, Regain, Watch
from vislam.sensors import USER_ERRORS, BodyState, Linear, SensorError, Suite, linearised

_ENDS = (
    "accepted",
    "gated",  # failed the chi-square gate
    "failed",  # the sensor's own code did
    "refused",  # not a reading that could ever be used
    "waiting",  # its sensor had not begun
    "begun",  # own variables set
    "regained",  # refused readings that agreed were believed, see `regain`
)


class OwnVariables(NamedTuple):
    """The own variables of all sensors, as `Suite` orders them."""

    values: Array  # [K]
    covariance: Array  # [K, K]
    since_ns: Mapping[str, int]  # by sensor that has begun: when it last corrected; the walk since then is to come


class Rows(NamedTuple):
    """A reading at an estimate, its noise white: `residual ~ H @ error + H_own @ own_error + noise of 1`."""

    H: Array  # [m, 15] by the error of `NavState`
    H_own: Array  # [m, V]
    residual: Array  # [m]
    linear: Linear  # as it was before


class Sensing:
    """The sensors of a filter. Settings only: the same reading on the same state gives the same answer.

    Attributes:
        suite: the sensors.
        counters: every counter that one of their readings can end in.
    """

    def __init__(self, suite: Suite | None, taken: Iterable[str]) -> None:
        """Take the sensors, if there are any.

        Raises:
            UsageError: a sensor has a name whose counters are `taken` by the filter.
        """
        self.suite = Suite() if suite is None else suite
        self.counters = tuple(f"{name}_{end}" for name in self.suite.names for end in _ENDS)
        self._limits: dict[tuple[str, int], float] = {}
        twice = sorted(set(taken) & set(self.counters))
        if twice:
            raise UsageError(f"a sensor's name makes {', '.join(twice)}, which the filter counts itself; rename it")

    def why_unusable(self, reading: Reading) -> str:
        """Return why a reading cannot be used; empty: it can."""
        try:
            return self.suite.why_unusable(reading)
        except USER_ERRORS as error:
            return f"the check of sensor {reading.sensor!r}: {type(error).__name__}: {error}"

    def why_no_start(self, start: OwnStart) -> str:
        """Return why own variables cannot be set to these; empty: they can."""
        asked = (len(self.suite[start.sensor].variables),)
        if asked == (0,):
            return f"sensor {start.sensor!r} has no variables of its own; its readings are used at once"
        if np.shape(start.values) != asked or np.shape(start.sigmas) != asked:
            return f"{np.shape(start.values)} values and {np.shape(start.sigmas)} sigmas, {asked} asked"
        if not (np.isfinite(start.values).all() and np.isfinite(start.sigmas).all() and np.min(start.sigmas) >= 0.0):
            return "values that are not finite, or sigmas that are not finite and at least 0"
        return ""

    def begin(self, start: OwnStart, values: Array, P: Array) -> None:
        """Set a sensor's own `values` [K] and their rows of P [n, n], which end it, in place: sure of nothing else."""
        at = self.suite.own(start.sensor)
        values[at] = start.values
        rows = np.arange(at.start, at.stop) + len(P) - len(values)
        P[rows] = 0.0
        P[:, rows] = 0.0
        P[rows, rows] = np.asarray(start.sigmas, dtype=np.float64) ** 2

    def grow(self, name: str, t_ns: int, since_ns: Mapping[str, int], values: Array, P: Array) -> None:
        """Take a sensor's own variables from when it last corrected to a time, in place.

        They are among `values` [K] and end P [n, n]. Until then they stand for what they were when it corrected, which
        others may correct, too: late is exact.
        """
        if name not in since_ns or not any(variable.changes for variable in self.suite[name].variables):
            return
        at = self.suite.own(name)
        decays, variances = self.suite.after(name, (t_ns - since_ns[name]) * 1e-9)
        rows = np.arange(at.start, at.stop) + len(P) - self.suite.size
        values[at] = self.suite.starts[at] + decays * (values[at] - self.suite.starts[at])
        P[rows] *= decays[:, None]
        P[:, rows] *= decays
        P[rows, rows] += variances

    def own(self, name: str, own: OwnVariables, t_ns: int) -> tuple[Array, Array]:
        """Return a sensor's own values [V] and their covariance [V, V]; before it begins, what it assumes of them."""
        at = self.suite.own(name)
        if name not in own.since_ns:
            return self.suite.starts[at].copy(), np.diag(self.suite.sigmas[at] ** 2)
        values, covariance = own.values.copy(), own.covariance.copy()
        self.grow(name, t_ns, own.since_ns, values, covariance)
        return values[at], covariance[at, at]

    def rows(self, reading: Reading, body: BodyState, own: OwnVariables, out: Outcome) -> Rows | None:
        """Return a reading as whitened rows; None, counted, where its sensor has not begun or fails."""
        name = reading.sensor
        if self.suite[name].variables and name not in own.since_ns:
            out.count(f"{name}_waiting")
            out.reason = f"sensor {name!r} has not begun: its own variables are not set"
            return None
        try:
            # a copy: no code of a sensor may change the state
            linear = linearised(self.suite[name], reading, body, own.values[self.suite.own(name)].copy())
            root = np.linalg.cholesky(linear.noise)
        except SensorError as error:
            out.count(f"{name}_failed")
            out.reason = str(error)
            return None
        except np.linalg.LinAlgError:
            out.count(f"{name}_failed")
            out.reason = f"sensor {name!r} at {reading.t_ns} ns: noise that is not positive definite"
            return None
        H, H_own, residual = (np.linalg.solve(root, part) for part in (linear.H, linear.H_own, linear.residual))
        return Rows(H, H_own, residual, linear)

    def limit(self, name: str, degrees: int) -> float:
        """Return what the normalised innovation squared of a good reading stays below."""
        key = name, degrees
        if key not in self._limits:
            self._limits[key] = chi_square_limit(self.suite[name].gate_probability, degrees)
        return self._limits[key]

    def judge(self, reading: Reading, rows: Rows, S: Array, nis: float, out: Outcome) -> bool:
        """Write down what the gate finds with a residual of covariance S [m, m]; return whether the reading passes."""
        name, degrees = reading.sensor, len(S)
        limit, out.nis = self.limit(name, degrees), nis
        if nis <= limit:
            out.accept(f"{name}_accepted")
            out.test(name, 1, nis, degrees)
            root, own = np.linalg.inv(np.linalg.cholesky(S)), rows.linear
            out.innovation = Innovation(
                name, self.suite[name].channel(reading.values), reading.t_ns, root @ rows.residual, own.residual,
                np.diag(own.noise), float((root**2).sum()) / degrees,
            )  # fmt: skip
            return True
        out.count(f"{name}_gated")
        out.reason = f"innovation {nis:.1f} of at most {limit:.1f}"
        return False

    def refuse(
        self, watch: Watch, reading: Reading, rows: Rows, body: BodyState, out: Outcome
    ) -> tuple[Watch, Regain | None]:
        """Remember a reading that the gate refused; return also how to believe its sensor again, if that is time."""
        name = reading.sensor
        if not rows.H[:, 3:6].any():
            return watch, None  # it shows nothing of places
        watch = watch.refused(name, Refused(reading.t_ns, rows.H[:, 3:6], rows.residual))
        speed_m_s = float(np.linalg.norm(body.velocity_m_s))
        return watch, watch.regain(name, reading.t_ns, speed_m_s, self.suite[name].regain_m)

    def regained(self, name: str, regain: Regain, out: Outcome) -> None:
        """Write down that a sensor is believed again."""
        out.counts.pop(f"{name}_gated")
        out.accept(f"{name}_accepted")
        out.count(f"{name}_regained")
        out.reason = f"{name} {regain.text}"


def body_of(t_ns: int, x: Array, gyro_rad_s: Array) -> BodyState:
    """Return the body as a sensor sees it, by a nominal state x [16 or more] and what the gyro [3] showed."""
    bias = x[13:16].copy()
    return BodyState(
        t_ns, pose(x, 0, 6)[:3, :3].copy(), x[0:3].copy(), x[3:6].copy(), bias, x[10:13].copy(), gyro_rad_s - bias
    )
