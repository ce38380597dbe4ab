"""Compares the turns of what drives with the gyroscope's, before any filter: swapped wheels, a wrong width, a delay."""

from bisect import bisect_left, bisect_right
from collections import deque
from typing import Any

import numpy as np

from vislam.core.messages import ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.sensors import USER_ERRORS, BodyState, Correlated, Suite
from vislam.sensors.kinds.driven import Driven

_DELAYS_S = np.arange(-10, 11) * 0.05  # of the reading's stamp, that are tried
_HALF_S = 0.025  # on either side of a reading the gyroscope's rate is averaged over
_REACH_NS = round((_DELAYS_S[-1] + _HALF_S) * 1e9)  # on either side of a reading
_KEPT_NS = 3_000_000_000  # of the gyroscope: readings may come late
_NOW = len(_DELAYS_S) // 2  # the delay of none
_LEAST = 200  # readings
_ALIKE = 4  # readings in a row err alike: a slip, a bend of a tyre
_LEAST_TURN_RAD_S = 0.05  # rms, of a drive that shows anything


class TurnWitness:
    """Owns the sums of a regression, at each delay: turn by the sensor = offset + factor * gyroscope + share * speed.

    The factor is 1 where axes and sizes are as stated, and the share that of one wheel that is larger than the other.
    """

    def __init__(self, name: str, sensor: Driven) -> None:
        """Take a sensor and what it is called."""
        self.name, self._sensor = name, sensor
        self._own = own = np.array([variable.start for variable in sensor.variables])
        zero = np.zeros(3)
        still = [BodyState(0, np.eye(3), zero, zero, zero, zero, rate) for rate in np.eye(3)]
        self._up = np.array([sensor.base_motion(body, own)[3] for body in still])
        self._gyro_ns, self._angles = list[int](), list[float]()  # times, and the angle turned up to each
        self._waiting = deque[tuple[int, float, float]](maxlen=_LEAST)  # time, speed and turn by the sensor
        self._N = np.zeros((len(_DELAYS_S), 3, 3))
        self._c = np.zeros((len(_DELAYS_S), 3))
        self._count, self._sum, self._squares = 0, 0.0, 0.0

    def hear(self, value: ImuSample | MagSample | Reading) -> None:
        """Take what comes of any sensor."""
        if isinstance(value, ImuSample):
            self._turn(value)
        elif isinstance(value, Reading) and value.sensor == self.name:
            self._drive(value)

    def report(self) -> dict[str, dict[str, Any]]:
        """Return own variables as stated, with sigmas; and how turns agree with the gyroscope's, if there were some."""
        stated, turns = {one.name: (one.start, one.sigma) for one in self._sensor.variables}, self._summary()
        return {"stated": stated} | ({"turns": turns} if turns else {})

    def _turn(self, sample: ImuSample) -> None:
        """Compare the readings whose surroundings are known by now."""
        t_ns, angle = (self._gyro_ns[-1], self._angles[-1]) if self._gyro_ns else (sample.t_ns, 0.0)
        if sample.t_ns < t_ns or not np.isfinite(sample.gyro_rad_s).all():
            return
        self._gyro_ns.append(sample.t_ns)
        self._angles.append(angle + (sample.t_ns - t_ns) * 1e-9 * float(self._up @ sample.gyro_rad_s))
        old = bisect_left(self._gyro_ns, sample.t_ns - _KEPT_NS)
        del self._gyro_ns[:old], self._angles[:old]
        while self._waiting and self._waiting[0][0] + _REACH_NS <= sample.t_ns:
            t_ns, speed_m_s, turn_rad_s = self._waiting.popleft()
            if t_ns - _REACH_NS >= self._gyro_ns[0]:
                self._compare(t_ns, speed_m_s, turn_rad_s)

    def _drive(self, reading: Reading) -> None:
        try:
            seen = self._sensor.compared(np.asarray(reading.values), np.zeros(4), self._own)
            motion = np.linalg.lstsq(seen.by_motion, seen.residual, rcond=None)[0]
        except (*USER_ERRORS, np.linalg.LinAlgError):
            return  # the intake refuses it
        if np.isfinite(motion).all():
            self._waiting.append((reading.t_ns, float(motion[0]), float(motion[3])))

    def _compare(self, t_ns: int, speed_m_s: float, turn_rad_s: float) -> None:
        first, last = bisect_right(self._gyro_ns, t_ns - _REACH_NS) - 1, bisect_left(self._gyro_ns, t_ns + _REACH_NS)
        at_s = (np.array(self._gyro_ns[first : last + 1]) - t_ns) * 1e-9
        angles = np.array(self._angles[first : last + 1])
        before, after = (np.interp(side - _DELAYS_S, at_s, angles) for side in (-_HALF_S, _HALF_S))
        x = np.column_stack([np.ones_like(before), (after - before) / (2.0 * _HALF_S), np.full_like(before, speed_m_s)])
        self._N += x[:, :, None] * x[:, None]
        self._c += x * turn_rad_s
        self._count += 1
        self._sum, self._squares = self._sum + turn_rad_s, self._squares + turn_rad_s**2

    def _summary(self) -> dict[str, float]:
        """Return factor and delay with their sigmas, and the share of the turns that they explain; empty: unknown."""
        n, N = self._count, self._N + 1e-9 * np.eye(3)
        if n < _LEAST or self._N[_NOW, 1, 1] / n - (self._N[_NOW, 0, 1] / n) ** 2 < _LEAST_TURN_RAD_S**2:
            return {}
        solved = np.linalg.solve(N, self._c[..., None])[..., 0]
        left = np.maximum(self._squares - (solved * self._c).sum(axis=1), 1e-12)
        best = int(np.argmin(left))
        delay_s, delay_sigma_s = float(_DELAYS_S[best]), float(_DELAYS_S[1] - _DELAYS_S[0])
        variance = left[best] / n * _ALIKE
        if 0 < best < len(left) - 1:
            rise, bend = 0.5 * (left[best + 1] - left[best - 1]), left[best + 1] - 2.0 * left[best] + left[best - 1]
            delay_s -= delay_sigma_s * rise / max(bend, 1e-12)
            delay_sigma_s *= float(np.sqrt(2.0 * variance / max(bend, 1e-12)))
        return {
            "factor": float(solved[best, 1]), "factor_sigma": float(np.sqrt(variance * np.linalg.inv(N[best])[1, 1])),
            "delay_s": float(delay_s), "delay_sigma_s": delay_sigma_s,
            "slip": getattr(getattr(self._sensor, "settings", None), "turn_slip", 0.0),
            "explained": float(1.0 - left[best] / max(self._squares - self._sum**2 / n, 1e-12)),
        }  # fmt: skip


def turn_witnesses(suite: Suite | None) -> list[TurnWitness]:
    """Return a witness for each sensor of what drives."""
    sensors = {} if suite is None else {name: suite[name] for name in suite.names}
    alone = {name: one.sensor if isinstance(one, Correlated) else one for name, one in sensors.items()}
    return [TurnWitness(name, sensor) for name, sensor in alone.items() if isinstance(sensor, Driven)]
