"""The first state of a body without a camera: from rest, or in motion where a sensor measures its speed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vislam.config import InitConfig
from vislam.core.errors import DataError
from vislam.core.messages import ImuSample, ImuSpan, Observations, VoMeasurement
from vislam.frontend.start import Initialisation, level_at_once
from vislam.imu import ImuNoise, join, state_at_rest

_SPEED_SIGMA_M_S = 30.0  # of what drives, until its sensor of speed is heard
_NS = 1_000_000_000


class BlindStart:
    """Owns the newest inertial data and decides, as `Initialiser` does with a camera.

    Attributes:
        refusals: how often a start was refused, by cause.
        taken_back: how many starts were; none is provisional here.
        time_offset_sigma_s: of a camera's clock, which is not there.
    """

    def __init__(
        self, config: InitConfig, noise: ImuNoise, gravity_m_s2: float, moves: Callable[[], bool | None]
    ) -> None:
        """Start empty; `moves` gives whether the body moves by sensors of motion, None: no reading."""
        self.refusals: dict[str, int] = {}
        self.taken_back, self.time_offset_sigma_s = 0, 0.0
        self._config, self._noise, self._gravity, self._moves = config, noise, gravity_m_s2, moves
        self._spans: deque[ImuSpan] = deque()

    def add(
        self, span: ImuSpan | None, vo: VoMeasurement, still: bool, observations: Observations | None = None
    ) -> Initialisation:
        """Take one frame and answer.

        Args:
            span: inertial data since the frame before; None for the first frame or across a hole.
            vo: of the frame, which shows nothing.
            still: whether inertial data have been those of rest for `config.rest_s`.
            observations: of the frame, which there are none of.
        """
        if span is None:
            self._spans.clear()
            return self._refused("inertial data", "inertial data has a hole, or only begins")
        self._spans.append(span)
        while len(self._spans) > 1 and vo.t_ns - self._spans[1].t_ns[0] >= self._config.rest_s * _NS:
            self._spans.popleft()
        whole, moves = join(list(self._spans)), self._moves()
        length_s = (vo.t_ns - int(whole.t_ns[0])) / _NS
        if length_s < self._config.rest_s:
            reason = f"{length_s:.2f} s of inertial data, {self._config.rest_s:g} s needed"
            return self._refused("duration", reason)
        if still and not moves:
            return self._from_rest(whole, length_s)
        if moves is None:
            reason = "the body moves, and no sensor measures its speed: begin at rest, or give wheels or another speed"
            return self._refused("motion", reason)
        return self._in_motion(whole)

    def restamp(self, shift_ns: int, cut: Callable[[int, int], ImuSpan | None]) -> None:
        """Do nothing: there is no camera whose clock could be off."""

    def _from_rest(self, span: ImuSpan, length_s: float) -> Initialisation:
        samples = [ImuSample(*row) for row in zip(span.t_ns.tolist(), span.gyro_rad_s, span.accel_m_s2, strict=True)]
        try:
            state = state_at_rest(samples, self._noise, self._gravity, self._config)
        except DataError:
            return self._refused("gravity", f"the last {length_s:.2f} s are not those of rest: keep the body still")
        reason = f"at rest for {length_s:.2f} s"
        return Initialisation("static", reason, state, state, np.eye(4), (state.t_ns,), state.T_world_body[None])

    def _in_motion(self, span: ImuSpan) -> Initialisation:
        """Level by the mean force; the filter has the speed at once from its sensor."""
        found = level_at_once(span, int(span.t_ns[-1]), np.eye(4), self._gravity, self._config)
        assert found.last is not None
        covariance = found.last.covariance.copy()
        covariance[6:9, 6:9] = np.eye(3) * _SPEED_SIGMA_M_S**2
        state = replace(found.last, covariance=covariance)
        reason = f"in motion, {found.reason}"
        return replace(found, status="moving", reason=reason, first=state, last=state, is_settled=True)

    def _refused(self, cause: str, reason: str) -> Initialisation:
        self.refusals[cause] = self.refusals.get(cause, 0) + 1
        return Initialisation("waiting", reason, cause=cause)
