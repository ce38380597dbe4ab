"""How long one camera has moved without the accelerations that show scale."""

from __future__ import annotations

from collections import deque

import numpy as np

from vislam.config import InitConfig
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, ImuSpan, NavState

_PIECE_S = 0.2  # over which force is averaged: noise and vibration show no scale
_PIECES = 20  # 4 s, the longest that the search for a first scale looks at, too


class UniformMotion:
    """Measures the excitation of the motion as the initialisation does: the rms change of acceleration.

    Attributes:
        frames: how many frames came while it was less than the initialisation asks for.
        longest_s: the longest time in a row that it was.
    """

    def __init__(self, config: InitConfig) -> None:
        """Take the least excitation."""
        self._least_m_s2 = config.min_excitation_m_s2
        self._forces: deque[Array] = deque(maxlen=_PIECES)  # [3] m/s^2 in odom
        self._sum_m_s: Array = np.zeros(3)
        self._piece_s = 0.0
        self._lasted_s = 0.0
        self.frames = 0
        self.longest_s = 0.0

    @property
    def shows_scale(self) -> bool:
        """Whether the last 4 s show scale, or are not yet over."""
        return self._lasted_s == 0.0

    def add(self, span: ImuSpan | None, state: NavState | None, at_rest: bool) -> None:
        """Take a frame's inertial span and the filter's state at its end; rest holds scale, and outages start anew."""
        if span is None or state is None or at_rest:
            self._forces.clear()
            self._sum_m_s, self._piece_s, self._lasted_s = np.zeros(3), 0.0, 0.0
            return
        dt_s = float(span.t_ns[-1] - span.t_ns[0]) * 1e-9
        rate = span.gyro_rad_s.mean(axis=0) - state.gyro_bias_rad_s
        R_middle = state.T_world_body[:3, :3] @ so3_exp(-0.5 * dt_s * rate)
        self._sum_m_s = self._sum_m_s + dt_s * (R_middle @ span.accel_m_s2.mean(axis=0))
        self._piece_s += dt_s
        if self._piece_s >= _PIECE_S:
            self._forces.append(self._sum_m_s / self._piece_s)
            self._sum_m_s, self._piece_s = np.zeros(3), 0.0
        if len(self._forces) < _PIECES:
            return
        change = np.asarray(self._forces) - np.mean(self._forces, axis=0)
        if np.sqrt(np.mean(np.sum(change * change, axis=1))) >= self._least_m_s2:
            self._lasted_s = 0.0
            return
        self.frames += 1
        self._lasted_s = max(self._lasted_s, _PIECES * _PIECE_S) + dt_s
        self.longest_s = max(self.longest_s, self._lasted_s)
